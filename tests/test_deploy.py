"""deploy/: every path, command and setting of the container's files exists. No container engine runs in the tests.

At night the installing lines of the Containerfile run in a new folder, in place of the image's.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from shutil import copytree, ignore_patterns
from threading import Thread
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from skills.cli import app
from skills.settings import Settings
from tests.waiting import crowded

ROOT = Path(__file__).parents[1]
LINES = re.sub(r"\\\n\s*", "", (ROOT / "deploy" / "Containerfile").read_text()).splitlines()
STEPS = [line.split(" ", 1) for line in LINES if line and not line.startswith("#")]
COMPOSE_TEXT = (ROOT / "deploy" / "compose.yaml").read_text()
COMPOSE = yaml.safe_load(COMPOSE_TEXT)
OURS = ("service", "worker")
# Without the paths of this process: pip would take the project for installed already.
BARE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def of(step: str) -> list[str]:
    return [said for name, said in STEPS if name == step]


def env(name: str) -> dict[str, str]:
    """Return the environment of a container of compose.yaml, with a password and a host."""
    given = dict(pair.split("=", 1) for pair in of("ENV")[0].split()) | COMPOSE["services"][name]["environment"]
    return {key: re.sub(r"\$\{(\w+):\?[^}]*\}", r"\1x", str(value)) for key, value in given.items()}


def test_every_path_that_is_copied_exists_and_so_does_the_python():
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert wanted == ">=3.11,<3.14"
    for image in of("FROM"):
        assert re.search(r"/python:3\.1[123]-slim[a-z-]*@sha256:[0-9a-f]{64}", image)
    for said in of("COPY"):
        if not said.startswith("--from="):
            assert all((ROOT / name).exists() for name in said.split()[:-1]), said


def test_installs_are_checked_by_hashes_and_need_no_compiler():
    installs = [said for said in of("RUN") if "pip install" in said]
    assert len(installs) == 2
    assert "--require-hashes --only-binary :all: -r /src/requirements-serve.lock" in installs[0]
    assert "--no-deps /src/wheels/" in installs[1]
    assert len({image.split()[0] for image in of("FROM")}) == 1
    images = [one["image"] for one in COMPOSE["services"].values()]
    assert [image for image in images if "@sha256:" not in image] == ["suture-skills", "suture-skills"]


def test_the_container_is_no_root_and_can_write_to_its_folders_alone():
    assert of("USER")[-1] == "skills"
    made = next(line for line in of("RUN") if line.startswith("install -d")).split()[-2:]
    for name in OURS:
        container = COMPOSE["services"][name]
        assert container["read_only"] is True
        assert container["cap_drop"] == ["ALL"]
        assert sorted(volume.split(":")[1] for volume in container["volumes"]) == sorted(made)
        assert env(name)["NUMBA_CACHE_DIR"] in made
        assert str(Path(env(name)["SKILLS_SIGNING_KEY"]).parent) in made
    used = {volume.split(":")[0] for one in COMPOSE["services"].values() for volume in one["volumes"]}
    assert used == set(COMPOSE["volumes"])


@pytest.mark.parametrize("name", OURS)
def test_every_setting_is_one_and_is_accepted(name):
    given = {
        key.removeprefix("SKILLS_").lower(): value for key, value in env(name).items() if key.startswith("SKILLS_")
    }
    assert set(given) <= set(Settings.model_fields)
    settings = Settings(**given)
    settings.check_address()
    assert settings.database_url == "postgresql://skills:POSTGRES_PASSWORDx@database/skills"
    assert settings.workers == 0


def test_every_command_and_option_exists():
    commands = [json.loads(of("CMD")[0]), *(COMPOSE["services"][name]["command"] for name in OURS)]
    commands += [said.split() for said in re.findall(r"service (skills .*)", COMPOSE_TEXT)]
    assert len(commands) == 5
    for _, *words in commands:
        options = [word for word in words if word.startswith("--")]
        named = [word for word in words if not word.startswith("--")][: 2 if words[0] == "keys" else 1]
        shown = CliRunner().invoke(app, [*named, "--help"])
        assert shown.exit_code == 0, words
        assert all(option in shown.output for option in options), words


def test_no_secret_is_in_a_file_and_the_port_is_on_loopback():
    assert set(re.findall(r"POSTGRES_PASSWORD: (.*)", COMPOSE_TEXT)) == {"${POSTGRES_PASSWORD:?write it into .env}"}
    assert COMPOSE["services"]["service"]["ports"] == ["127.0.0.1:8000:8000"]
    assert not any("ports" in one for name, one in COMPOSE["services"].items() if name != "service")
    assert not re.search(r":latest\b", COMPOSE_TEXT)


@pytest.mark.parametrize(("status", "code"), [(200, 0), (503, 1)])
def test_the_health_check_follows_the_answer(status, code):
    class Answering(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/healthz" else 404)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Answering) as server:
        Thread(target=server.handle_request, daemon=True).start()
        kind, _, option, program = COMPOSE["services"]["service"]["healthcheck"]["test"]
        assert (kind, option) == ("CMD", "-c")
        program = program.replace(":8000/", f":{server.server_port}/").replace("timeout=5", f"timeout={30 * crowded()}")
        ended = subprocess.run([sys.executable, option, program], stderr=subprocess.DEVNULL, check=False)
    assert ended.returncode == code


@pytest.mark.nightly
def test_the_installing_lines_run_in_a_new_folder(tmp_path):
    places = {"/src": str(tmp_path / "src"), "/opt/suture-skills": str(tmp_path / "opt")}
    last = STEPS.index(["FROM", of("FROM")[1]])
    for step, said in STEPS[:last]:
        if step == "COPY":
            *names, to = said.split()
            for name in names:
                target = tmp_path / to.strip("/") / ("" if to.endswith("/") else ".")
                if (ROOT / name).is_dir():
                    copytree(ROOT / name, target, symlinks=True, ignore=ignore_patterns("__pycache__"))
                else:
                    target.mkdir(parents=True, exist_ok=True)
                    (target / name).write_bytes((ROOT / name).read_bytes())
        elif step == "RUN":
            for place, here in places.items():
                said = said.replace(place, here)
            said = re.sub(r"^python ", f"{sys.executable} ", said)
            ended = subprocess.run(said, shell=True, env=BARE, capture_output=True, text=True, check=False)
            assert ended.returncode == 0, (said, ended.stderr[-2000:])
    assert ended.stdout.startswith(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])
