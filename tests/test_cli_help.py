"""The command line itself: its help, the version, and completion in a shell."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import make_dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib.metadata import version
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from skills.cli import app
from skills.cli.completion import complete_surgeons, complete_sutures
from skills.cli.policies import DEFAULT_LEARNER, _learner
from skills.errors import BadInput
from skills.learning.policy import LEARNERS
from skills.settings import settings
from tests.by_day import some

STYLE = ("wren", "simple-running")


def groups(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from groups(command, (*path, name))
        else:
            yield (*path, name), command


def test_every_command_of_the_interface_is_there_and_speaks_to_programs() -> None:
    every = dict(groups(get_command(app)))
    named = "serve worker migrate seed backup restore verify train retrain rollout plan play export erase report"
    assert {(name,) for name in named.split()} <= set(every)
    for group, names in {
        "recording": "add show",
        "demo": "add list show report save mark withdraw",
        "policy": "list versions show card release withdraw export",
        "keys": "create list revoke",
        "job": "list show wait cancel",
        "surgeon": "put list show",
    }.items():
        assert {(group, name) for name in names.split()} <= set(every)
    silent = {path for path, command in every.items() if not any("--json" in one.opts for one in command.params)}
    assert silent == {("serve",), ("worker",)}, "they answer nothing"


def test_the_version_is_printed(skills) -> None:
    assert skills("--version") == (0, f"{version('suture-skills')}\n")


@pytest.mark.parametrize("words", [(), ("serve",), ("policy",), ("policy", "show")])
def test_minus_h_is_help(words: tuple[str, ...], skills) -> None:
    code, said = skills(*words, "-h")
    assert (code, said) == skills(*words, "--help")
    assert (code, "Usage" in said) == (0, True)


def test_an_address_on_the_command_line_is_checked_like_the_setting(skills) -> None:
    skills.refuses("serve", "--host", "0.0.0.0", says="keys must not be sent unencrypted")


HEAVY = {  # pydantic is not among them: typer itself uses it to parse arguments
    *("numpy", "numba", "scipy", "matplotlib", "sqlalchemy", "alembic", "fastapi", "starlette", "uvicorn"),
    *("pydantic_settings", "httpx2", "orjson", "mcap", "rosbags", "dbos", "pybullet", "jinja2", "psycopg"),
}


@pytest.mark.parametrize("words", some([["--help"], ["train", "--help"], ["policy", "--help"]], 3))
def test_help_is_quick_because_nothing_heavy_is_imported_for_it(words: list[str]) -> None:
    script = (
        "import sys; from skills.cli import app\n"
        "try: app(sys.argv[1:])\n"
        "finally: print(*{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    ended = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True)
    assert ended.returncode == 0 and "Usage" in ended.stdout
    loaded = set(ended.stderr.split())
    assert {"typer", "skills"} <= loaded
    assert loaded & HEAVY == set()
    assert "pydantic" not in loaded or words != ["--help"]


AT_FIRST_USE = {
    "numba",
    "scipy",
    "pyarrow",
    "matplotlib",
    "dbos",
    "rosbags",
    "pybullet",
    "uvicorn",
    "movement_primitives",
}
COMPUTING = AT_FIRST_USE | {"numpy", "sqlalchemy", "fastapi", "starlette", "mcap", "alembic", "jinja2"}


# The numbers of modules are ours: a twentieth above those of the day when this was written.
@pytest.mark.parametrize(
    ("server", "unused", "most"),
    [("http://127.0.0.1:9", COMPUTING, 590), ("", AT_FIRST_USE, 1350)],
    ids=["http", "database"],
)
def test_a_list_imports_what_it_shows_and_nothing_that_computes(
    server: str, unused: set[str], most: int, skills, tmp_path: Path
) -> None:
    skills.does("surgeon", "put", "kestrel")  # makes the database
    script = "import sys; from skills.cli import app\ntry: app()\nfinally: print(*sys.modules, file=sys.stderr)"
    given = {"SKILLS_SERVER": server} if server else {"SKILLS_DATABASE_URL": f"sqlite:///{tmp_path}/skills.sqlite"}
    ended = subprocess.run(
        [sys.executable, "-c", script, "surgeon", "list"], env=os.environ | given, capture_output=True, text=True
    )
    assert ("gave no answer" in ended.stderr) if server else ("kestrel" in ended.stdout), ended.stderr
    loaded = ended.stderr.split()
    assert {one.partition(".")[0] for one in loaded} & unused == set()
    assert len(loaded) <= most


def completed(line: str, **settings: str) -> tuple[list[str], str]:
    """Press Tab at the end of a line, in bash; return the proposals, and all other output."""
    words = line.split(" ")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SKILLS_")} | settings
    asked = {"_SKILLS_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    script = "import sys; sys.argv = ['skills']; from skills.cli import app; app(prog_name='skills')"
    ended = subprocess.run(
        [sys.executable, "-c", script], env=environment | asked, capture_output=True, text=True, check=False
    )
    return ended.stdout.split(), ended.stderr


def test_tab_proposes_the_surgeons_and_sutures_that_there_are(skills, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("skills.cli.completion.LIMIT_S", 60.0)
    (tmp_path / "skills.sqlite").unlink()
    assert complete_surgeons("") == [], "there is no database yet"
    assert not (tmp_path / "skills.sqlite").exists()
    for name in ("kestrel", "kite", "wren"):
        skills.does("surgeon", "put", name)
    assert (complete_surgeons(""), complete_surgeons("k")) == (["kestrel", "kite", "wren"], ["kestrel", "kite"])
    assert complete_sutures("simple-") == ["simple-buried", "simple-interrupted", "simple-running"]
    monkeypatch.setenv("SKILLS_SERVER", "http://127.0.0.1:9")
    settings.cache_clear()
    assert complete_surgeons("") == [], "where a service is set, it alone is asked"


def test_tab_in_a_shell_proposes_commands() -> None:
    assert completed("skills poli") == (["policy"], "")


@pytest.mark.parametrize(
    "wrong",
    [
        {"SKILLS_DATABASE_URL": "sqlite:///{folder}/no.sqlite"},
        pytest.param({"SKILLS_SERVER": "http://127.0.0.1:9"}, marks=pytest.mark.nightly),
        pytest.param({"SKILLS_DATABASE_URL": "no url at all"}, marks=pytest.mark.nightly),
        pytest.param({"SKILLS_PORT": "no port"}, marks=pytest.mark.nightly),
    ],
    ids=lambda wrong: " ".join(wrong.values()),
)
def test_tab_in_a_shell_is_silent_whatever_is_wrong(wrong: dict[str, str], tmp_path: Path) -> None:
    given = {name: value.format(folder=tmp_path) for name, value in wrong.items()}
    (tmp_path / "no.sqlite").write_bytes(b"this is no database" * 100)
    assert completed("skills policy show k", **given) == ([], "")


def test_tab_is_silent_if_a_library_is_still_at_work_when_time_is_up() -> None:
    """The destructor of the thread's own data aborts, as a library in C++ does whose thread is made to exit."""
    script = (
        "import ctypes, time; from skills.cli import completion; completion.LIMIT_S = 0.1\n"
        "def hangs():\n"
        "    libc, key = ctypes.CDLL(None), ctypes.c_uint()\n"
        "    libc.pthread_key_create(ctypes.byref(key), libc.abort)\n"
        "    libc.pthread_setspecific(key, ctypes.c_void_p(1))\n"
        "    while True: time.sleep(0.0001)\n"
        "print(completion._in_time(hangs, ''))"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "[]\n", "")


def test_the_joining_option_is_for_every_learner_that_has_such_a_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    added = make_dataclass("Added", [("join_share", float, 0.0)], frozen=True)
    monkeypatch.setitem(LEARNERS, "added", added)  # as by somebody who adds a learner, and names it nowhere else
    for kind in (DEFAULT_LEARNER, "value-iteration", "added"):
        assert _learner(kind, [], "0.5") == {"kind": kind, "join_share": 0.5}
    monkeypatch.setitem(LEARNERS, "phased", make_dataclass("Phased", [], namespace={"phased": True, "join_share": 0.0}))
    for kind in ("cell-q-learning", "dqn", "unknown", "phased"):
        with pytest.raises(BadInput, match=f"{kind} has no joining rule") as refused:
            _learner(kind, [], "0.5")
        assert "phase-q-learning, value-iteration, added" in str(refused.value.remedies)


@pytest.mark.parametrize("of", [6, pytest.param(1, marks=pytest.mark.nightly)])
def test_every_command_explains_each_option_within_eighty_columns(of: int) -> None:
    for number, (path, command) in enumerate(groups(get_command(app))):
        assert [one.name for one in command.params if not getattr(one, "help", "")] == [], path
        if number % of:
            continue  # by day every sixth is printed
        result = CliRunner().invoke(app, [*path, "--help"], terminal_width=80, env={"COLUMNS": "80"})
        assert result.exit_code == 0, result.output
        assert [line for line in result.output.splitlines() if len(line) > 80 or "…" in line] == [], path


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yield the address of a stand-in for a service, which is ready and has one layer of containment."""

    class Answers(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            said = json.dumps({"status": "ready", "workers": 3, "containment": {"own network": True}}).encode()
            self.send_response(200 if self.path == "/readyz" else 404)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(said)))
            self.end_headers()
            self.wfile.write(said)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Answers) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        address = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setenv("SKILLS_SERVER", address)
        settings.cache_clear()
        yield address
        server.shutdown()
        thread.join()
    settings.cache_clear()


def test_the_doctor_asks_the_service_that_is_set_and_nothing_here(skills, tmp_path: Path, elsewhere: str) -> None:
    (tmp_path / "skills.sqlite").unlink()
    code, said = skills("doctor", "--json")
    checks = {one["check"]: (one["state"], one["remark"]) for one in json.loads(said)}
    assert code == 0
    assert checks[f"service at {elsewhere}"] == ("ok", "live workers: 3")
    assert checks["containment: own network"] == ("ok", "")
    assert {state for state, _ in checks.values()} == {"ok", "missing"}
    assert not (tmp_path / "skills.sqlite").exists()


def test_the_doctor_fails_where_the_service_does_not_answer(skills, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "skills.sqlite").unlink()
    monkeypatch.setenv("SKILLS_SERVER", "http://127.0.0.1:9")
    settings.cache_clear()
    code, said = skills("doctor", "--json")
    (check,) = json.loads(said)
    assert (code, check["check"], check["state"]) == (1, "service at http://127.0.0.1:9", "failed")
    assert not (tmp_path / "skills.sqlite").exists()
