"""What stands where: floors that import downwards only, one door for each outside library, and a pure domain."""

import ast
import logging
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

import skills

ROOT = Path(skills.__file__).parent
PROJECT = ROOT.parent
LAYERS = PROJECT / "pyproject.toml"
DATA = {ROOT / "migrations", ROOT / "urdf"}
FILES = sorted(file for file in ROOT.rglob("*.py") if not DATA & set(file.parents))
FILES += [file for file in sorted((ROOT / "seeds").glob("*.py")) if file not in FILES]  # a link, which rglob passes by


def named(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


@cache
def nodes(file: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(file.read_text())))


def imported(file: Path) -> Iterator[str]:
    """Name every module that a file imports, at its top or inside a function."""
    for node in nodes(file):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def importers(library: str) -> list[str]:
    return [named(file) for file in FILES if any(name.split(".")[0] == library for name in imported(file))]


def test_the_scan_sees_the_whole_package():
    for part in ("errors.py", "settings.py", "style/grid.py", "style/learning/_kernels.py", "seeds/__init__.py"):
        assert part in [named(file) for file in FILES]


@pytest.fixture
def loggers() -> Iterator[None]:
    """Give every logger back as it was: import-linter switches them all off, for whatever runs after it too."""
    off = {one: one.disabled for one in logging.Logger.manager.loggerDict.values() if isinstance(one, logging.Logger)}
    yield
    for one, was in off.items():
        one.disabled = was


@pytest.mark.usefixtures("loggers")
def test_imports_lead_downwards_only_and_every_module_has_its_floor(monkeypatch, capsys):
    monkeypatch.chdir(PROJECT)
    failed = lint_imports(config_filename=str(LAYERS), no_cache=True, no_logo=True)
    assert not failed, capsys.readouterr().out


@pytest.mark.parametrize(
    ("library", "door"),
    [
        ("mcap", "recordings/"),
        ("mcap_ros2", "recordings/"),
        ("rosbags", "recordings/ros.py"),
        ("pybullet", "sim/"),
        ("pybullet_data", "sim/"),
        ("numba", "compiled.py"),
        ("movement_primitives", "report/dmp.py"),
        ("safetensors", "style/network.py"),
        ("torch", "deep/"),
        ("sklearn", "style/scoring/calibrating.py"),
        ("gymnasium", "deep/"),
        ("stable_baselines3", "deep/"),
        ("sb3_contrib", "deep/"),
        ("dbos", "jobs/"),
        ("sqlalchemy", ("db/", "library/", "jobs/", "api/")),
        ("fastapi", "api/"),
        ("prometheus_client", "api/metrics.py"),
        ("typer", "cli/"),
    ],
)
def test_each_outside_library_has_one_door(library, door):
    assert [file for file in importers(library) if not file.startswith(door)] == []


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


DOMAIN = [file for file in FILES if named(file).startswith("style/")]
MAY_IMPORT = {
    *("collections", "dataclasses", "functools", "itertools", "math", "types", "typing"),
    *("numpy", "safetensors", "skills", "scipy"),
    *("sklearn", "threadpoolctl"),  # regression, and on how many threads it adds up
    "concurrent",  # threads that count beside each other, and change nothing but their own part of an array
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
