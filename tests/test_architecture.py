"""Architecture rules: imports go downwards only, each outside library has one door, and the domain is pure."""

import ast
import logging
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

import skills
from tests import house

ROOT = Path(skills.__file__).parent
PROJECT = ROOT.parent
LAYERS = PROJECT / "pyproject.toml"
DATA = {ROOT / "migrations", ROOT / "urdf"}
FILES = sorted(file for file in ROOT.rglob("*.py") if not DATA & set(file.parents))
FILES += [file for file in sorted((ROOT / "seeds").glob("*.py")) if file not in FILES]  # a link, skipped by rglob


def named(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


@cache
def source(file: Path) -> str:
    return file.read_text()


@cache
def nodes(file: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(source(file))))


def imported(file: Path) -> Iterator[str]:
    """Name every module that a file imports, at its top or inside a function."""
    for node in nodes(file):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def importers(library: str) -> list[str]:
    named_in = [file for file in FILES if library in source(file)]  # only these are parsed, which takes longest
    return [named(file) for file in named_in if any(name.split(".")[0] == library for name in imported(file))]


def test_the_scan_sees_the_whole_package():
    for part in ("errors.py", "settings.py", "gridworld/grid.py", "learning/q_learning.py", "seeds/__init__.py"):
        assert part in [named(file) for file in FILES]


def test_every_folder_is_a_package():
    """The import contract does not see a folder without `__init__.py`, nor the imports of its files."""
    folders = {file.parent for file in FILES}
    assert [named(folder) for folder in folders if not (folder / "__init__.py").is_file()] == []


@pytest.fixture
def loggers() -> Iterator[None]:
    """Restore every logger: import-linter disables them all, also for later tests."""
    off = {one: one.disabled for one in logging.Logger.manager.loggerDict.values() if isinstance(one, logging.Logger)}
    yield
    for one, was in off.items():
        one.disabled = was


@pytest.mark.usefixtures("loggers")
def test_imports_lead_downwards_only_and_every_module_has_its_floor(monkeypatch, capsys):
    monkeypatch.chdir(PROJECT)
    failed = lint_imports(config_filename=str(LAYERS), no_cache=True, no_logo=True)
    assert not failed, capsys.readouterr().out


def test_the_table_of_rooms_names_each_after_those_that_it_imports():
    contract = tomllib.loads(LAYERS.read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    heights = {name: height for height, layer in enumerate(reversed(contract)) for name in re.findall(r"\w+", layer)}
    page = (PROJECT / "ARCHITECTURE.md").read_text()
    rows = re.findall(r"^\| (`[^|]*) \|", page[page.index("| room |") : page.index("| weighed")], re.MULTILINE)
    rooms = [max(heights[room] for room in re.findall(r"`(\w+)", row)) for row in rows]
    assert len(rooms) > 10
    assert rooms == sorted(rooms)


@pytest.mark.parametrize(
    ("library", "door"),
    [
        ("mcap", "formats/"),
        ("mcap_ros2", "formats/"),
        ("rosbags", "formats/rosbag.py"),
        ("yaml", "formats/bag_folder.py"),
        ("pyarrow", ("formats/lerobot/", "formats/cells.py")),
        ("pybullet", "simulation/"),
        ("pybullet_data", "simulation/"),
        ("mujoco", "simulation/referee.py"),
        ("numba", "compiled.py"),
        ("cyclonedds", "live/dds.py"),
        ("movement_primitives", "report/rivals.py"),
        ("safetensors", ("learning/networks.py", "db/packed.py")),
        ("torch", "deep/"),
        ("gymnasium", "deep/"),
        ("stable_baselines3", "deep/"),
        ("sb3_contrib", "deep/"),
        ("dbos", ("jobs/__init__.py", "jobs/bell.py", "jobs/workflows.py", "jobs/watch.py")),
        ("sqlalchemy", ("db/", "library/", "jobs/", "api/")),
        ("fastapi", "api/"),
        ("prometheus_client", "api/metrics.py"),
        ("typer", "cli/"),
        ("cachetools", "db/weighted_cache.py"),
        ("cryptography", "transparency/signing_keys.py"),
    ],
)
def test_each_outside_library_has_one_door(library, door):
    assert [file for file in importers(library) if not file.startswith(door)] == []


def test_only_workers_import_the_makers_of_all_jobs():
    """It imports the whole library: everything else names the use case that it calls."""
    importing = [named(file) for file in FILES if "skills.library.perform" in imported(file)]
    assert [file for file in importing if not file.startswith("jobs/")] == []


def test_one_name_stands_for_one_thing():
    """A name that a layer shares with another by design is in `NOUNS` of tests/house.py, with the reason."""
    found = house.Measures()
    for file in house.sources(ROOT):
        house.add_names(found, nodes(file), Path(named(file)))
    assert found.two_things() == []


def test_no_room_is_heavier_than_its_budget():
    """The budgets stand in ARCHITECTURE.md; raise one only where an issue says what it may add."""
    of_parts = house.measure(PROJECT, "skills").rooms
    listed = house.rooms(PROJECT)
    assert sorted(part for room in listed for part in room.parts) == sorted(of_parts)
    weighed = {room: sum(of_parts[part] for part in room.parts) for room in listed}
    assert {room.parts: lines for room, lines in weighed.items() if lines > room.budget} == {}
    assert {
        room.parts: lines for room, lines in weighed.items() if abs(lines - room.stated) > max(20, lines // 50)
    } == {}
    assert sum(room.budget for room in listed) <= house.CEILING


def test_imports_come_first_and_free_objects_are_few():
    found = house.measure(PROJECT, "skills")
    assert found.late_imports == []
    assert found.free_objects <= house.FREE_OBJECTS


def test_no_name_of_a_test_is_longer_than_the_limit():
    """The limit is that of CONTRIBUTING.md; `python -m tests.house` counts the names that are longer."""
    names = {
        (name, file.relative_to(PROJECT).as_posix())
        for file in house.sources(PROJECT / "tests")
        for name in re.findall(r"^ *(?:async )?def (test_\w+)", source(file), re.MULTILINE)
    }
    assert len(names) > 1000
    assert sorted(one for one in names if len(one[0]) > house.LONGEST_TEST_NAME) == []


@pytest.mark.parametrize("library", ["pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"])
def test_nothing_is_pickled(library):
    assert importers(library) == []


def test_no_array_is_loaded_or_saved_with_pickles_in_it():
    allowed = [
        named(file)
        for file in FILES
        for node in nodes(file)
        if isinstance(node, ast.keyword)
        and node.arg == "allow_pickle"
        and not (isinstance(node.value, ast.Constant) and node.value.value is False)
    ]
    assert allowed == []


ROOMS = ("demonstration", "gridworld", "learning", "planning", "verification", "comparison", "scoring")
ALONE = ("arithmetic", "arrays", "dynamics", "kinematics", "quaternions")
DOMAIN = [file for file in FILES if named(file).split("/")[0].removesuffix(".py") in (*ROOMS, *ALONE)]
MAY_IMPORT = {
    *("bisect", "collections", "dataclasses", "functools", "itertools", "math", "types", "typing"),
    *("numpy", "safetensors", "skills", "scipy"),
    "concurrent",  # threads that compute concurrently, each writing only its own part of an array
}


@pytest.mark.parametrize("file", DOMAIN, ids=named)
def test_the_domain_knows_no_file_clock_log_environment_or_database(file):
    assert {name.split(".")[0] for name in imported(file)} <= MAY_IMPORT
    calls = [node.func for node in nodes(file) if isinstance(node, ast.Call)]
    names = {call.id for call in calls if isinstance(call, ast.Name)}
    assert not names & {"open", "print", "input", "exec", "eval", "__import__"}


def test_the_domain_draws_no_random_number_that_no_seed_decides():
    for file in DOMAIN:
        text = file.read_text()
        for call in ("np.random.rand", "np.random.seed", "np.random.choice", "default_rng()", "PCG64()"):
            assert call not in text, named(file)


def test_only_the_api_knows_status_codes():
    assert "status_code" not in "".join(file.read_text() for file in DOMAIN)


OPENS = {"reading", "writing", "connect", "begin", "_sessions"}  # of databases, engines and makers
WAITS = (ast.Yield, ast.YieldFrom, ast.Await, ast.AsyncFor, ast.AsyncWith)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)
MAY_YIELD_A_SESSION = {
    "db/session.py: reading",
    "db/session.py: ending",
    "db/session.py: writing",
}  # a `with` of their own


def opens_a_session(call: ast.expr) -> bool:
    """Return whether an expression opens a session or a connection."""
    target = call.func if isinstance(call, ast.Call) else None
    if isinstance(target, ast.Attribute):
        return target.attr in OPENS
    return isinstance(target, ast.Name) and target.id == "Session"


def own(node: ast.AST) -> Iterator[ast.AST]:
    """Walk through a node, but not into the functions that are defined in it."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, FUNCTIONS):
            yield child
            yield from own(child)


def waits_in_a_session(tree: ast.AST) -> list[str]:
    """Name the functions that yield or await while a session or connection of the database is open."""
    found = []
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            blocks = [node for node in own(function) if isinstance(node, ast.With | ast.AsyncWith)]
            open_ = [one for one in blocks if any(opens_a_session(item.context_expr) for item in one.items)]
            if any(isinstance(node, WAITS) for block in open_ for node in own(block)):
                found.append(function.name)
    return found


def test_nothing_waits_for_its_caller_or_client_while_a_session_is_open():
    """A generator that is abandoned at a `yield` keeps its resources until the garbage collector finds it."""
    opening = [file for file in FILES if any(word in source(file) for word in (*OPENS, "Session("))]
    found = [f"{named(file)}: {name}" for file in opening for name in waits_in_a_session(ast.parse(source(file)))]
    assert set(found) == MAY_YIELD_A_SESSION


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        ("def f(db):\n with db.reading() as session:\n  yield from rows(session)", True),
        ("def f(db):\n with a() as x, db.writing() as session:\n  for row in rows(session):\n   yield row", True),
        ("async def f(db):\n with db.reading() as session:\n  await send(session)", True),
        ("def f(db):\n def g():\n  with db.reading() as session:\n   yield 1\n return g", True),
        ("def f(db):\n with db.reading() as session:\n  rows = list(session)\n yield rows", False),
        ("def f(db):\n with open('x') as file:\n  yield file", False),
    ],
)
def test_the_scan_for_open_sessions_finds_those_that_wait(source: str, wrong: bool):
    assert bool(waits_in_a_session(ast.parse(source))) == wrong


def test_routes_send_lazy_responses_only_through_the_closing_stream():
    lazy = {"StreamingResponse", "FileResponse", "EventSourceResponse"}
    users = [named(file) for file in FILES for node in nodes(file) if isinstance(node, ast.alias) and node.name in lazy]
    assert users == ["api/streams.py"]


ASKS = {"Client", "AsyncClient", "get", "head", "options", "post", "put", "patch", "delete", "request", "stream"}


def test_each_connection_of_a_test_says_how_long_it_waits_for_an_answer():
    """By default it waits 5 s, and a disk of a busy machine may take longer to store what a request asks for."""
    impatient = [
        f"{file.relative_to(PROJECT)}:{node.lineno}"
        for file in sorted((PROJECT / "tests").rglob("*.py"))
        if "httpx" in source(file)
        for node in nodes(file)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and ast.unparse(node.func.value) == "httpx"
        and node.func.attr in ASKS
        and not {"timeout", "transport"} & {word.arg for word in node.keywords}
    ]
    assert impatient == []


def test_no_generator_of_the_api_takes_a_session():
    """Its caller could leave the session before the generator, or the generator before its end."""
    found = [
        f"{named(file)}: {node.name}"
        for file in FILES
        if named(file).startswith("api/")
        for node in nodes(file)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and any(isinstance(inner, ast.Yield | ast.YieldFrom) for inner in own(node))
        and any("Session" in ast.dump(one.annotation) for one in node.args.args if one.annotation is not None)
    ]
    assert found == []
