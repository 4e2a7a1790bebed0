#!/bin/sh
# Install the built wheel into a bare environment of each interpreter given, without a compiler, and use it: `--version`,
# `serve`, and a training. `make wheel-check PYTHONS="python3.11 python3.12 python3.13"`; the packages come from pip's index.
set -eu
built=$(mktemp -d)
trap 'rm -rf "$built"' EXIT
"$1" -m venv "$built/builder"
"$built/builder/bin/python" -m pip wheel -q --no-deps -w "$built" .
for python in "$@"; do
  bare="$built/$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
  "$python" -m venv "$bare"
  # `--only-binary` refuses every package that would have to be compiled
  "$bare/bin/python" -m pip install -q --only-binary :all: "$built"/*.whl
  (
    cd "$bare"
    export CC=/bin/false XDG_STATE_HOME="$bare/state" XDG_DATA_HOME="$bare/data"
    echo "$python: $(bin/skills --version)"
    bin/skills seed >/dev/null
    bin/skills train kestrel simple-running --release --json >trained.json
    bin/python -c 'import json; assert json.load(open("trained.json"))["result"]["released"]'
    bin/skills serve --port 8631 >serve.txt 2>&1 &
    service=$!
    trap 'kill $service' EXIT
    bin/python - <<'PYTHON'
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
    echo "$python: trained, released and served"
  )
done
