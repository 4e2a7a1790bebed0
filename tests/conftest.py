import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from copy import deepcopy
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import pytest
from hypothesis import settings as hypothesis_settings

from skills.settings import Settings, settings
from tests import by_day, leftovers
from tests.needs import need, required

if TYPE_CHECKING:
    from skills.formats.reader_process import ConfinedReader, ForkServer

GUARD = pytest.StashKey[leftovers.subprocess.Popen[bytes]]()
PACKAGE = Path(__file__).parents[1] / "skills"
FIRST = ("tests/e2e/", "tests/test_", "tests/jobs/", "tests/library/", "tests/api/", "tests/learning/", "tests/report/")
WAITING = 3  # the first three start processes and wait
LEFT = pytest.StashKey[list[str]]()
GARBAGE = 50_000  # objects, some 10 MB
SMALL_BYTES = 100_000
STATEMENTS = 2000  # more than all tests of a process have; SQLAlchemy's own limit is 500 for each database

# No deadlines, because on a busy machine an example may take any time. By day every run has the same examples, so it is
# red only for a change; `make nightly` searches at random, with 100 examples in the place of 10.
hypothesis_settings.register_profile("tests", deadline=None, derandomize=True, max_examples=10)
hypothesis_settings.register_profile("nightly", deadline=None)
hypothesis_settings.load_profile("tests")


def pytest_configure(config: pytest.Config) -> None:
    required()  # a misspelt need is refused at once
    if not hasattr(config, "workerinput"):
        config.stash[GUARD] = leftovers.begin()
        if getattr(config.option, "numprocesses", None):
            compile_loops()
            compile_tests()
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: everything started is cleaned up


def compile_loops() -> None:
    """Compile the loops once, if they are not cached, before every process of the run compiles them."""
    for module in PACKAGE.rglob("*.py"):
        if "import compiled" not in module.read_text():
            continue
        cached = [file.stat().st_mtime for file in module.parent.glob(f"__pycache__/{module.stem}.*.nbi")]
        if not cached or min(cached) < module.stat().st_mtime:
            code = "import skills.jobs.warm_up as w, skills.formats.reader_process as c; w.learn_once(); c.get_ready()"
            subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent)
            return


def compile_tests() -> None:
    """Compile the tests once if none is compiled, as in CI, before every process of the run compiles all of them."""
    tests = Path(__file__).parent
    if not sys.dont_write_bytecode and not any(tests.glob("__pycache__/test_*-pytest-*.pyc")):
        command = [sys.executable, "-m", "pytest", "-n", "0", "--collect-only", "-qq"]
        subprocess.run(command, cwd=tests.parent, stdout=subprocess.DEVNULL)


@pytest.fixture(autouse=True)
def no_setting_stays() -> Iterator[None]:
    """Fail a test that leaves a setting in the environment, which another test would then find."""
    before = {name: value for name, value in os.environ.items() if name.startswith("SKILLS_")}
    yield
    after = {name: value for name, value in os.environ.items() if name.startswith("SKILLS_")}
    assert after == before


@pytest.fixture(scope="session")
def reading_server() -> Iterator["ForkServer"]:
    """Yield one fork server for all readers of a process: each takes a second to start, and 500 tests need one."""
    from skills.formats.reader_process import READY, ForkServer  # late: `--collect-only` and usage errors are fast

    server = ForkServer(READY)
    yield server
    server.close()


@pytest.fixture(scope="session", autouse=True)
def shared_fork_server(reading_server: "ForkServer") -> Iterator[object]:
    """Let all applications and verifications of a process share its fork server.

    It reads a small file once: most of the tests upload the same hand-off.
    """
    from skills.api import app as application
    from skills.library.recordings import recordings

    own = application.confined_reader
    read: dict[tuple[object, ...], Any] = {}

    def call(target: str, given: BinaryIO, **how: Any) -> Any:
        if given.seek(0, os.SEEK_END) > SMALL_BYTES:
            return reading_server.call(target, given, **how)
        given.seek(0)
        asked = (target, given.read(), json.dumps(how["arguments"]), how["limits"], how["returns"])
        if asked not in read:
            read[asked] = reading_server.call(target, given, **how)
        return deepcopy(read[asked])

    @contextmanager
    def shared(settings: Settings) -> Iterator["ConfinedReader"]:
        reader = own(settings)
        reading_server.start()
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(reader.server, "call", call)
            yield reader

    modules = (application, recordings)  # the commands import it from the last one
    for module in modules:
        module.confined_reader = shared
    yield own
    for module in modules:
        module.confined_reader = own


@pytest.fixture(scope="session", autouse=True)
def shared_simulator() -> Iterator[None]:
    """Let the simulators of a process be forks of one server, which imports PyBullet once for 90 tests.

    `tests/sandbox` calls functions in new interpreters, and so do the services that tests start.
    """
    from skills import packing
    from skills.sandbox.forked import ForkServer
    from skills.simulation import player

    with closing(
        ForkServer("skills.simulation.simulator:get_ready", *(("pybullet",) if find_spec("pybullet") else ()))
    ) as server:

        def call(target: str, request: object, *, classes: Any, ready: object = (), **how: Any) -> Any:
            with tempfile.TemporaryFile() as given:
                packing.write(given, request, classes)
                return server.call(target, given, classes=classes, **how)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(player, "call_alone", call)
            yield


@pytest.fixture(scope="session", autouse=True)
def shared_statements() -> Iterator[None]:
    """Let all databases of one kind in a process share their compiled statements, as those of one service do.

    Otherwise each test compiles its statements again for its own database, a fifth of the time of `tests/library`. Two
    dialects of one class are equal here, because SQLAlchemy looks statements up by the dialect.
    """
    from sqlalchemy import create_engine
    from sqlalchemy.dialects.postgresql.psycopg import PGDialect_psycopg
    from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
    from sqlalchemy.util import LRUCache

    statements: LRUCache[object, object] = LRUCache(STATEMENTS)

    def sharing(*about: Any, **how: Any) -> Any:
        return create_engine(*about, execution_options={"compiled_cache": statements}, **how)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("skills.db.engines.create_engine", sharing)
        for dialect in (PGDialect_psycopg, SQLiteDialect_pysqlite):
            patched.setattr(dialect, "__eq__", lambda one, other: type(one) is type(other))
            patched.setattr(dialect, "__hash__", lambda one: hash(type(one)))
        yield


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> None:
    """Let no file of tests find in this process's caches the settings or the policies of another."""
    from skills.library.operation import integrity

    settings.cache_clear()
    integrity.forget(integrity.remembered())


@pytest.fixture
def own_fork_server(shared_fork_server: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let applications start and stop a fork server each, as services do."""
    monkeypatch.setattr("skills.api.app.confined_reader", shared_fork_server)


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests on PostgreSQL that run at night, and order the files.

    Files that start processes and wait alternate with files that compute, and short ones come last.

    A file goes to one worker, so that its shared fixtures are made once (`--dist loadfile`). So no more than about half
    of the workers wait, and none is left alone with a long file at the end.
    """
    by_day.mark(items)
    rank = {item.path: place for item in items for place, name in enumerate(FIRST) if name in item.nodeid}
    files = list(dict.fromkeys(item.path for item in items))
    waiting = sorted((file for file in files if rank.get(file, WAITING) < WAITING), key=lambda file: rank[file])
    computing = sorted((file for file in files if file not in waiting), key=lambda file: rank.get(file, len(FIRST)))
    turn = {file: 2 * place for place, file in enumerate(waiting)}
    turn |= {file: 2 * place + 1 for place, file in enumerate(computing)}
    items.sort(key=lambda item: turn[item.path])


def pytest_collection_finish() -> None:
    """Collect garbage less often: what was imported stays, and an application leaves much that looks like garbage.

    At the default thresholds the collector takes a sixth of the processor time of `tests/api`.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE)


def pytest_runtest_setup(item: pytest.Item) -> None:
    for mark in item.iter_markers("needs"):
        need(*mark.args)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> Iterator[None]:
    """Fail a run that leaves processes or files behind, after its own processes have stopped."""
    yield
    if (guarding := session.config.stash.get(GUARD, None)) is not None:
        session.config.stash[LEFT] = leftovers.end(guarding)
        if session.config.stash[LEFT]:
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


def pytest_unconfigure(config: pytest.Config) -> None:
    """Print in the very last lines the leftovers, and the skipped tests with reason and remedy."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or hasattr(config, "workerinput"):
        return
    for what in config.stash.get(LEFT, ()):
        reporter.write_line(f"LEFT BEHIND - {what}", red=True, bold=True)
    skipped = [report.longrepr for report in reporter.stats.get("skipped", ())]
    reasons = Counter(said[2].removeprefix("Skipped: ") for said in skipped if isinstance(said, tuple))
    for reason, count in reasons.items():
        reporter.write_line(f"{count} NOT TESTED - {reason}", yellow=True, bold=True)


class Commands:
    """The command line in this process: a call returns the exit code and the output of a command."""

    def __call__(self, *words: str) -> tuple[int, str]:
        from typer.testing import CliRunner

        from skills.cli import app

        result = CliRunner().invoke(app, list(words))
        return result.exit_code, result.output

    def does(self, *words: str, says: str = "", code: int = 0) -> str:
        """Run a command that succeeds and says so, and return its output."""
        found, said = self(*words)
        assert (found, says in said) == (code, True), said
        return said

    def json(self, *words: str) -> Any:
        """Run a command that succeeds, and return its document."""
        return json.loads(self.does(*words, "--json"))

    def refuses(self, *words: str, says: str) -> str:
        """Run a command that is refused with these words, and return its output."""
        return self.does(*words, says=says, code=1)


@pytest.fixture
def with_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Commands]:
    """Yield the command line on a separate database."""
    from tests import backends

    monkeypatch.setenv("SKILLS_DATABASE_URL", backends.place(tmp_path / "skills.sqlite"))
    monkeypatch.setenv("SKILLS_WORKERS", "1")  # tests/jobs has several
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    settings.cache_clear()
    yield Commands()
    settings.cache_clear()


@pytest.fixture
def skills(with_worker: Commands, monkeypatch: pytest.MonkeyPatch) -> Commands:
    """Return the command line of `with_worker`, whose commands start no worker."""
    from tests.library import cases

    monkeypatch.setattr("skills.serving.working", cases.working)
    return with_worker
