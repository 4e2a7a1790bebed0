#!/bin/sh
# Install the built wheel into a bare environment of each interpreter given, without a compiler, and use it: `--version`, a
# training, a playback (refused in words where PyBullet has no wheel), and `serve`.
# `make wheel-check PYTHONS="python3.11 python3.12 python3.13"`; the packages come from pip's index.
set -eu
unset PYTHONPATH  # pip would take this project for installed already
built=$(mktemp -d)
trap 'rm -rf "$built"' EXIT
"$1" -m venv "$built/builder"
"$built/builder/bin/python" -m pip wheel -q --no-deps -w "$built" .
for python in "$@"; do
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  bare="$built/$version"
  "$python" -m venv "$bare"
  # `--only-binary` refuses every package that would have to be compiled
  "$bare/bin/python" -m pip install -q --only-binary :all: "$built"/*.whl
  (
    mkdir "$bare/data"
    cd "$bare/data"
    export CC=/bin/false XDG_STATE_HOME="$bare/state" SKILLS_DATABASE_URL="sqlite:///$bare/data/skills.sqlite"
    unset SKILLS_SAMPLE_RECORDINGS
    skills="timeout 600 $bare/bin/skills"
    echo "$version: skills $($skills --version)"
    $skills seed >/dev/null
    $skills train kestrel simple-running --release --json >trained.json
    "$bare/bin/python" -c 'import json; assert json.load(open("trained.json"))["result"]["released"]'
    echo "$version: trained and released"
    $skills plan kestrel simple-running --point 5,55,-120 --tissue-mm=-165 --no-handoff --json >plan.json
    plan=$("$bare/bin/python" -c 'import json; print(json.load(open("plan.json"))["id"])')
    if "$bare/bin/python" -c 'import pybullet' >/dev/null 2>&1; then
      $skills play "$plan" >played.txt
      echo "$version: played"
    else
      ! $skills play "$plan" >played.txt 2>&1
      grep -q 'PyBullet is not installed' played.txt
      echo "$version: $(grep 'PyBullet is not installed' played.txt)"
    fi
    "$bare/bin/skills" serve --port 8631 >serve.txt 2>&1 &
    service=$!
    trap 'kill $service' EXIT
    "$bare/bin/python" - <<'PYTHON'
import time, urllib.request
for _ in range(600):
    try:
        assert b"kestrel" in urllib.request.urlopen("http://127.0.0.1:8631/policies").read()
        break
    except OSError:
        time.sleep(0.1)
else:
    raise SystemExit("the service did not answer")
PYTHON
    echo "$version: served"
  )
done
