"""The script that tests mutants: its changes by hand, and a list of explanations without stale ones."""

import re
import sys
from pathlib import Path

import pytest

from tests.mutants import EQUIVALENT, GUARDS, PATIENCE_S, ROOT, Mutant, drawn, mutants_of, run

SOURCE = b'''
"""A docstring with 1 < 2 stays."""
LIMIT = 0.4


def within(value: float = 3.0) -> bool:
    if not value <= LIMIT:
        raise ValueError(f"{value + 1} is more")
    return value >= 0 and value != 7
'''


def test_the_changes_of_a_small_source_by_hand():
    found = [one.name(SOURCE) for one in mutants_of("a.py", SOURCE)]
    assert found == [
        ": LIMIT = 1.05",
        "within: if (not (not value <= LIMIT)):",
        "within: if (value <= LIMIT):",
        "within: if not value < LIMIT:",
        "within: if not value > LIMIT:",
        "within: pass",
        "within: return None",
        "within: return value >= 0 or value != 7",
        "within: return value > 0 and value != 7",
        "within: return value < 0 and value != 7",
        "within: return value >= 1 and value != 7",
        "within: return value >= 0 and value == 7",
        "within: return value >= 0 and value != 8",
    ]


def test_filters_of_queries_and_statements_are_removed():
    source = b"def rows(session):\n    session.flush()\n    return select(A).where(~A.gone).limit(1)\n"
    assert [one.name(source) for one in mutants_of("a.py", source)] == [
        "rows: pass",
        "rows: return None",
        "rows: return select(A).where(~A.gone)",
        "rows: return select(A).limit(1)",
        "rows: return select(A).where((A.gone)).limit(1)",
        "rows: return select(A).where(~A.gone).limit(2)",
    ]


def test_a_seed_draws_the_same_mutants_of_every_guard_and_at_least_200():
    first, again = ([one for guard in GUARDS for one in drawn(guard, 1, None)] for _ in range(2))
    assert first == again
    assert len(first) >= 200
    files = {one.partition("::")[0] for guard in GUARDS for one in (guard.file, *guard.tests)}
    assert all((ROOT / file).exists() for file in files)


def test_the_tests_and_functions_that_guards_name_exist():
    named = [one.partition("::") for guard in GUARDS for one in guard.tests if "::" in one]
    named += [(guard.file, "", name) for guard in GUARDS for name in guard.parts]
    gone = [
        (file, name)
        for file, _, name in named
        if not re.search(rf"^ *(def|class) {name.partition('[')[0]}\b", (ROOT / file).read_text(), re.MULTILINE)
        and not re.search(rf"^{name} = ", (ROOT / file).read_text(), re.MULTILINE)
    ]
    assert gone == []


def test_every_explanation_is_of_a_mutant_that_exists():
    there = {
        (guard.file, one.name(source))
        for guard in GUARDS
        for source in [(ROOT / guard.file).read_bytes()]
        for one in mutants_of(guard.file, source, guard.parts)
    }
    assert set(EQUIVALENT) <= there
    assert all(EQUIVALENT.values())


@pytest.mark.nightly  # a run of pytest in a run of pytest
@pytest.mark.parametrize(("new", "status"), [(b"1 + 1 == 2", 0), (b"1 + 1 == 3", 1)])
def test_a_fork_tells_how_its_tests_ended(new, status, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The tree is a folder with one test; the process of the fork never returns here."""
    (tmp_path / "test_one.py").write_bytes(b"def test_one():\n    assert " + new + b"\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    monkeypatch.setattr("tests.mutants._reuse_filled", lambda kept: None)
    words = ["test_one.py", "-p", "no:schemathesis"]
    assert run(tmp_path, words, object(), PATIENCE_S, tmp_path / "said.txt") == status
    assert "tests" in sys.modules


def test_the_difference_names_the_changed_line():
    source = b"def f(x):\n    y = 1\n    return x < y\n"
    (mutant,) = [one for one in mutants_of("a.py", source) if one.new == "<="]
    assert mutant == Mutant("a.py", 3, 3, 33, 34, "<=", "f")
    assert mutant.diff(source) == ("return x < y", "return x <= y")
