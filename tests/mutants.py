"""Mutation testing: small changes of the code that guards, each of which the tests must notice.

    python -m tests.mutants [--seed 1] [--only FILE ...] [--each N] [--all]

A mutant is a copy of one file with one change: an operator replaced, a condition negated, a constant changed, a
statement, filter or `~` removed, None returned. The tests of `GUARDS` first run once unchanged, and what each executes
is recorded; then every mutant is tested by the tests that execute its lines, the fastest first, until one fails. A
mutant that no test notices survives. Those of `EQUIVALENT` change nothing that can be observed, each with its reason;
they are counted apart. A time-out counts as killed.

The tree is copied to a temporary folder. Every mutant is tested by a fork of one process, which has imported the
outside libraries and nothing of this project. Databases that tests copy are filled once, by the unchanged code.
"""

import argparse
import ast
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.leftovers import memory

ROOT = Path(__file__).parents[1]
WIDE = ("__pycache__", ".git", "build", ".venv", ".mypy_cache", ".ruff_cache", ".hypothesis")
OUTSIDE = (
    *("numpy", "numba", "scipy.optimize", "scipy.spatial", "sqlalchemy.orm", "sqlalchemy.dialects.sqlite"),
    *("alembic.command", "pydantic_settings", "fastapi", "uvicorn", "orjson", "cachetools", "mcap.reader"),
    *("mcap.writer", "rosbags.serde", "yaml", "dbos", "prometheus_client", "jinja2", "typer.testing"),
    *("rich.console", "httpx2", "websockets"),
)  # fmt: skip
AT_MOST_S = 25.0  # of the tests' own processor time, so that a survivor costs no more on a busy machine either
PATIENCE_S = 120.0
ROW = "{:36} {:4} mutants: {:4} killed, {:3} equivalent, {:3} survived, {:5.0f} s"
IMPORTS = "imports"  # in the place of a test
QUIET = ("-W", "ignore::pytest.PytestAssertRewriteWarning")  # the fork has imported plugins before pytest began


@dataclass(frozen=True)
class Guard:
    """A file that is changed, the number of mutants that are drawn, its tests, and the parts that are changed."""

    file: str
    draw: int
    tests: tuple[str, ...]
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mutant:
    """One change of a file: the text between two offsets is replaced."""

    file: str
    line: int
    last_line: int
    start: int
    end: int
    new: str
    part: str

    def text(self, source: bytes) -> bytes:
        """Return the changed source."""
        return source[: self.start] + self.new.encode() + source[self.end :]

    def diff(self, source: bytes) -> tuple[str, str]:
        """Return the first changed line before and after."""
        before, after = source.decode().splitlines(), self.text(source).decode().splitlines()
        at = next(i for i, pair in enumerate(zip(before, after, strict=False)) if pair[0] != pair[1])
        return before[at].strip(), after[at].strip()

    def name(self, source: bytes) -> str:
        """Return the part and its changed line; without the line's number, which other changes move."""
        return f"{self.part}: {self.diff(source)[1]}"


# ---- changes -------------------------------------------------------------------------------------------------------

OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"),
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
ORDERED = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<"}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
FILTERS = ("where", "desc", "clip", "order_by", "execution_options", "outerjoin", "limit")


def mutants_of(file: str, source: bytes, parts: tuple[str, ...] = ()) -> list[Mutant]:
    """List every mutant of a file, or of the named functions and classes in it."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Mutant] = []

    def at(line: int, column: int) -> int:
        return starts[line - 1] + column

    def span(node: Any) -> tuple[int, int]:
        return at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset)

    def add(node: Any, new: str, part: str, where: tuple[int, int] | None = None) -> None:
        start, end = where or span(node)
        found.append(Mutant(file, node.lineno, node.end_lineno, start, end, new, part))

    def text(node: Any) -> str:
        start, end = span(node)
        return source[start:end].decode()

    def operator(node: Any, left: Any, right: Any, old: str, new: str, part: str) -> None:
        start, end = span(left)[1], span(right)[0]
        place = source[start:end].decode().find(old)
        if place >= 0:
            add(node, new, part, (start + place, start + place + len(old)))

    def visit(node: ast.AST, part: str) -> None:
        match node:
            case ast.Compare(left=left, ops=ops, comparators=others):
                for op, (one, other) in zip(ops, zip([left, *others], others, strict=False), strict=True):
                    old, new = OPERATORS[type(op)]
                    operator(node, one, other, old, new, part)
                    if type(op) in ORDERED:
                        operator(node, one, other, old, ORDERED[type(op)], part)
            case ast.BoolOp(op=op, values=values):
                for one, other in pairwise(values):
                    operator(node, one, other, *OPERATORS[type(op)], part)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                operator(node, left, right, *OPERATORS[type(op)], part)
            case ast.UnaryOp(operand=operand) if not isinstance(operand, ast.Constant):
                add(node, f"({text(operand)})", part)
            case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
                if not isinstance(test, ast.Compare):  # its operator is negated
                    add(test, f"(not ({text(test)}))", part)
            case ast.comprehension(ifs=ifs):
                for test in ifs:
                    add(test, "True", part)
            case ast.Constant(value=bool() as value):
                add(node, str(not value), part)
            case ast.Constant(value=int() | float() as value):
                add(node, repr(value + 1 if isinstance(value, int) or abs(value) > 0.5 else value * 2 + 0.25), part)
            case ast.Expr(value=ast.Call() | ast.Await() | ast.Yield(value=ast.Call())) | ast.AugAssign():
                add(node, "pass", part)
            case ast.Return(value=value) if value is not None and not _is_none(value):
                add(node, "return None", part)
            case ast.Name(id=name) if name in NAMES:
                add(node, NAMES[name], part)
            case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in NAMES:
                place = span(node.func)[1]
                add(node, NAMES[name], part, (place - len(name), place))
            case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in FILTERS:
                add(node, text(value), part)
        descend(node, part)

    def descend(node: ast.AST, part: str) -> None:
        for name, field in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for child in field if isinstance(field, list) else [field]:
                match child:
                    # Messages and our own assertions are not changed.
                    case ast.JoinedStr() | ast.Assert() | ast.Import() | ast.ImportFrom() | ast.arguments():
                        continue
                    case ast.Raise():
                        add(child, "pass", part)
                    case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                        whole = f"{part}.{child.name}" if part else child.name
                        if not parts or part or child.name in parts:
                            descend(child, whole)
                    case ast.AST() if part or not parts or isinstance(child, ast.Module):
                        visit(child, part)

    descend(ast.parse(source), "")
    return list(dict.fromkeys(found))


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


# ---- tests ---------------------------------------------------------------------------------------------------------


class Recorder:
    """Plugin of pytest that records the processor time of every test, and the lines of some files that it executes."""

    def __init__(self, files: list[str], to: Path) -> None:
        self.files = {str(file): [] for file in files}
        self.lines: set[tuple[str, int]] = set()
        self.tests: dict[str, dict[str, Any]] = {}
        self.to = to

    def trace(self, frame: FrameType, event: str, _arg: object) -> Any:
        """Trace the lines of frames of these files alone."""
        if (file := frame.f_code.co_filename) not in self.files:
            return None
        if event == "line":
            self.lines.add((file, frame.f_lineno))
        return self.trace

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out the tests that run on SQLite too."""
        items[:] = [item for item in items if "postgresql" not in item.name.partition("[")[2]]

    def pytest_collection_finish(self) -> None:
        """Record what imports execute apart, because every test repeats it."""
        self.tests[IMPORTS] = {"s": 0.0, "passed": True, "lines": sorted(self.lines)}
        self.lines.clear()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        """Record the processor time of a test with its fixtures."""
        began_s = time.process_time()
        result = yield
        self.tests[item.nodeid]["s"] = time.process_time() - began_s
        return result

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Record a test after its setup, its call and its teardown."""
        test = self.tests.setdefault(report.nodeid, {"s": 0.0, "passed": True, "lines": []})
        test["passed"] &= report.passed
        test["lines"] = sorted({*map(tuple, test["lines"]), *self.lines})
        self.lines.clear()

    def begin(self) -> None:
        """Begin to trace, in all threads, before pytest imports anything."""
        threading.settrace(self.trace)
        sys.settrace(self.trace)

    def pytest_sessionfinish(self) -> None:
        """Write the record, and keep the filled databases."""
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]
        self.to.write_text(json.dumps(self.tests))
        for kept in Path(os.environ["TESTS_FOLDER"]).glob("template-*"):
            if kept.is_dir():
                shutil.copytree(kept, self.to.parent / "kept" / kept.name, dirs_exist_ok=True)


class Ordered:
    """Plugin of pytest that runs tests in a given order."""

    def __init__(self, tests: list[str]) -> None:
        self.rank = {test: place for place, test in enumerate(tests)}

    def pytest_collection_finish(self, session: Any) -> None:
        """Order the tests after all other plugins have."""
        session.items.sort(key=lambda item: self.rank[item.nodeid])


def run(tree: Path, tests: list[str], plugin: object, patience_s: float, said: Path) -> int | None:
    """Run tests in a fork, and return the exit status of pytest; None after too long a time."""
    child = os.fork()
    if child == 0:
        status = 3
        try:
            os.setsid()
            out = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(out, 1)
            os.dup2(out, 2)
            os.chdir(tree)
            sys.path[:] = [str(tree), *(one for one in sys.path if one not in ("", str(ROOT)))]
            os.environ["PYTHONPATH"] = str(tree)
            _reuse_filled(said.parent / "kept")
            if isinstance(plugin, Recorder):
                plugin.begin()
            status = int(pytest.main(["-x", "-q", "-n", "0", *QUIET, *tests], plugins=[plugin]))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status)
    return _waited(child, patience_s)


def _waited(child: int, patience_s: float) -> int | None:
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _reuse_filled(kept: Path) -> None:
    """Let each run begin with the databases that the unchanged code has filled."""
    for name in [name for name in sys.modules if name.split(".")[0] in ("skills", "tests")]:
        del sys.modules[name]
    leftovers = importlib.import_module("tests.leftovers")
    begin: Callable[[], Any] = leftovers.begin

    def begin_filled() -> Any:
        guarding = begin()
        if kept.exists():
            shutil.copytree(kept, os.environ["TESTS_FOLDER"], dirs_exist_ok=True)
        return guarding

    leftovers.begin = begin_filled


def copied(to: Path) -> Path:
    """Copy the tree, with the machine code of its loops."""

    def ignored(folder: str, names: list[str]) -> set[str]:
        kept = "__pycache__" not in folder
        return {name for name in names if name in WIDE[1:] or (not kept and not name.endswith((".nbi", ".nbc")))}

    shutil.copytree(ROOT, to, ignore=ignored, symlinks=True)
    return to


def covering(mutant: Mutant, tree: Path, tests: dict[str, dict[str, Any]], guard: Guard) -> list[str]:
    """Return the tests that execute a mutant's lines, the fastest first; for lines of imports, all."""
    file, lines = str(tree / mutant.file), range(mutant.line, mutant.last_line + 1)
    executed = [test for test, about in tests.items() if any(one == file and at in lines for one, at in about["lines"])]
    if IMPORTS in executed:
        executed = [test for test in tests if test.startswith(guard.tests)]
    chosen, spent_s = [], 0.0
    for test in sorted(executed, key=lambda test: tests[test]["s"]):
        spent_s += tests[test]["s"]
        if chosen and spent_s > AT_MOST_S:
            break
        chosen.append(test)
    return chosen


# ---- the run -------------------------------------------------------------------------------------------------------

TOLD = "tests/api/test_served.py::test_whatever_changes_what_is_served_is_told_on_postgresql"
GUARDS = (
    Guard(
        "skills/learning/certificate.py", 36,
        ("tests/learning/test_certificate.py", "tests/learning/test_share.py", "tests/learning/test_in_scene.py",
         "tests/library/test_joining.py", "tests/library/test_scenes.py", "tests/library/test_release_gate.py"),
    ),
    Guard(
        "skills/library/policies/learning.py", 6,
        ("tests/library/test_release_gate.py", "tests/library/test_joining.py", "tests/library/test_library.py",
         "tests/library/test_outcomes.py"),
        ("_refusal", "_version"),
    ),
    Guard(
        "skills/verification/gates.py", 36,
        ("tests/verification/test_verdict.py",
         "tests/verification/test_scene_clearance.py", "tests/verification/test_bodies.py",
         "tests/verification/test_intent.py::test_the_verdict_names_it_though_the_arms_did_as_the_trajectory_says"),
        ("figures_of", "_arm", "_rotation_error_deg", "Limits", "_Gate", "first_failure", "_gates", "_joint_gates",
         "_clearance_gates", "_handing_over"),
    ),
    Guard(
        "skills/library/operation/history.py", 12,
        ("tests/api/test_edited_rows.py", "tests/api/test_rollback.py", "tests/library/test_history.py"),
        ("edited_rows", "refuse_edited", "_is_signed", "covered_leaf", "is_last_signed", "sign_some_history"),
    ),
    Guard("skills/db/saved_heads.py", 8, ("tests/api/test_rollback.py", "tests/library/test_history.py")),
    Guard(
        "skills/library/policies/gate.py", 14,
        ("tests/library/test_release_gate.py", "tests/library/test_joining.py", "tests/library/test_scenes.py",
         "tests/api/test_policies.py::test_a_demo_in_a_frame_other_than_the_arms_base_is_not_released",
         "tests/library/test_hands.py", "tests/learning/test_pose_step.py"),
    ),
    Guard("skills/library/policies/fit.py", 4, ("tests/library/test_fair_batches.py",)),
    Guard(
        "skills/library/policies/releases.py", 18,
        ("tests/library/test_release_gate.py", "tests/library/test_joining.py", "tests/library/test_scenes.py",
         "tests/api/test_policies.py::test_a_demo_in_a_frame_other_than_the_arms_base_is_not_released",
         "tests/api/test_policies.py::test_after_a_withdrawal_nothing_older_comes_back_by_itself",
         "tests/library/test_consent.py", "tests/library/test_outcomes.py", "tests/library/test_combined.py",
         "tests/library/test_hands.py", "tests/api/test_repeated_releases.py", TOLD),
    ),
    Guard(
        "skills/api/authorisation.py", 22,
        ("tests/api/test_authorisation.py", "tests/api/test_roles.py", "tests/api/test_seen.py"),
    ),
    Guard("skills/library/people/consent.py", 18, ("tests/library/test_consent.py", "tests/api/test_uses.py")),
    Guard("skills/library/people/recorded.py", 14, ("tests/library/test_recorded.py",)),
    Guard(
        "skills/api/policy_cache.py", 14,
        ("tests/api/test_policy_cache.py", *(f"tests/api/test_served.py::test_{name}" for name in (
            "erased_policies_leave_all_processes_memory_without_a_request",
            "the_short_way_and_the_long_one_give_the_same_answers",
            "a_cached_policy_is_not_given_to_whoever_may_not_see_it",
            "a_policy_learnt_again_after_an_erasure_gets_its_own_dates",
        ))),
    ),
    Guard(
        "skills/library/people/erasure.py", 30,
        ("tests/library/test_erasing.py", "tests/library/test_sweep.py", "tests/api/test_deleting_recordings.py",
         "tests/library/test_parsed.py", "tests/library/test_what_remains.py", "tests/library/test_recorded.py", TOLD),
    ),
    Guard(
        "skills/library/operation/sweep.py", 14, ("tests/library/test_sweep.py", "tests/library/test_what_remains.py"),
    ),
    Guard(
        "skills/library/operation/proofs.py", 12, ("tests/api/test_signatures.py",),
        ("head_over", "first_head", "sign_files"),
    ),
    Guard("skills/library/policies/relearning.py", 16, ("tests/library/test_relearning.py",)),
    Guard(
        "skills/library/operation/erasure_list.py", 20,
        ("tests/library/test_restoring.py", "tests/library/test_backup.py"),
        ("Erasures", "_newer", "_merged", "_order", "_listed", "_in_order", "apply_erasures", "_mark_again", "_served",
         "_narrow", "_both"),
    ),
    Guard(
        "skills/verification/probabilities.py", 10, ("tests/verification/test_monte_carlo.py",),
        ("counted", "_pass", "share"),
    ),
    Guard(
        "skills/verification/pass_comparison.py", 24,
        ("tests/verification/test_intent.py", "tests/verification/test_pass_comparison.py"),
    ),
)  # fmt: skip

# By file and name (`Mutant.name`): why nobody can tell the mutant from the code.
EQUIVALENT: dict[tuple[str, str], str] = {
    (
        "skills/library/operation/sweep.py",
        "_sweep_ended: return None  # parts of a batch that has not ended so long ago",
    ): "the last of the conditions of a loop, for which None ends it as False does",
    (
        "skills/verification/gates.py",
        "figures_of: ticks=np.append(2.0, np.diff(trajectory.stamps_s) * trajectory.rate_hz),",
    ): "the first sample has none before it; its gate asks for 1 or more, and reports the number nowhere",
    (
        "skills/library/people/erasure.py",
        "erase_surgeon: salt = secrets.token_hex(33)",
    ): "a salt is random and kept beside its digest; one byte more recognises the same pseudonym",
    (
        "skills/library/people/erasure.py",
        "_delete_recordings: size = select(func.coalesce(func.sum(of.size_bytes), 1)).where(of.row.in_(rows))",
    ): "of no recording; 1 is no more than AT_ONCE_BYTES either, and there is nothing to delete",
    (
        "skills/verification/gates.py",
        "figures_of: if m is not None or playback.psm_m_tip_mm is not None:",
    ): "a verdict refuses a playback with PSM_M of a trajectory without, and the reverse, before there are figures",
    (
        "skills/verification/pass_comparison.py",
        "PassComparison._recording: at, firm = hand.index(clock_s), ~(clock_s <= firm_s)",
    ): "differs for a sample exactly at that moment alone, which is also one of those that it is then compared with",
    (
        "skills/verification/pass_comparison.py",
        "PassComparison._recording: "
        "rests_s = np.where(np.minimum(passed_s, passed_s[-1] - passed_s) < REST_S / self.tempo, 3 * REST_S, 0.0)",
    ): "within `REST_S` of an end a stand grows by no more than that: a longer one was too long before",
    (
        "skills/verification/pass_comparison.py",
        "PassComparison._stands: if speed.max(initial=0.0) <= _LEAST_MM:",
    ): "differs for a greatest step of exactly 0.0001 mm alone, which no joints of a motion give",
}


def drawn(guard: Guard, seed: int, each: int | None) -> list[Mutant]:
    """Draw the mutants of a file by a seed."""
    found = mutants_of(guard.file, (ROOT / guard.file).read_bytes(), guard.parts)
    draw = min(guard.draw if each is None else each, len(found))
    return sorted(random.Random(seed).sample(found, draw), key=lambda one: (one.start, one.new))


def main() -> int:
    """Test the mutants, print a table, and return 1 if one survives that is not explained."""
    words = argparse.ArgumentParser(prog="python -m tests.mutants", description="Tests of the tests.")
    words.add_argument("--seed", type=int, default=1, help="of the drawing")
    words.add_argument("--only", action="append", metavar="FILE", help="files whose names contain this")
    words.add_argument("--each", type=int, metavar="N", help="number of mutants of each file; 100000 for all")
    asked = words.parse_args()
    guards = [one for one in GUARDS if asked.only is None or any(name in one.file for name in asked.only)]
    for name in OUTSIDE:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory(prefix="mutants-", dir=memory()) as name:
        return tested(guards, Path(name), asked.seed, asked.each)


def tested(guards: list[Guard], place: Path, seed: int, each: int | None) -> int:
    """Test the drawn mutants of some files in a folder, and print what came of each."""
    tree = copied(place / "tree")
    (place / "kept").mkdir()
    unchanged = recorded(guards, tree, place)
    rows, survivors = [], 0
    for guard in guards:
        source, began_s = (ROOT / guard.file).read_bytes(), time.monotonic()
        told = {"killed": 0, "equivalent": 0, "survived": 0}
        for mutant in drawn(guard, seed, each):
            outcome, by = noticed(mutant, source, tree, place, covering(mutant, tree, unchanged, guard))
            if outcome == "survived" and (why := EQUIVALENT.get((guard.file, mutant.name(source)))):
                outcome, by = "equivalent", why
            told[outcome] += 1
            if outcome != "killed":
                old, new = mutant.diff(source)
                print(f"  {outcome} ({by}): {guard.file}:{mutant.line} {mutant.part}")
                print(f"    - {old}\n    + {new}", flush=True)
        rows.append((guard.file, sum(told.values()), *told.values(), time.monotonic() - began_s))
        survivors += told["survived"]
        print(ROW.format(*rows[-1]), flush=True)
    total, killed, equivalent = (sum(row[at] for row in rows) for at in (1, 2, 3))
    print(f"{total} mutants, {equivalent} equivalent; killed {killed} of {total - equivalent}, seed {seed}")
    return int(survivors > 0)


def recorded(guards: list[Guard], tree: Path, place: Path) -> dict[str, dict[str, Any]]:
    """Run the tests once on the unchanged code, and return what each executes; all must pass."""
    tests, to = list(dict.fromkeys(test for guard in guards for test in guard.tests)), place / "tests.json"
    recorder = Recorder([str(tree / guard.file) for guard in guards], to)
    began_s = time.monotonic()
    chosen = [*tests, "--maxfail=1000"]
    status = run(tree, chosen, recorder, 60 * PATIENCE_S, place / "said.txt")
    found: dict[str, dict[str, Any]] = json.loads(to.read_text()) if to.exists() else {}
    failed = [test for test, about in found.items() if not about["passed"]]
    print(f"{len(found) - 1} tests on the unchanged code: {time.monotonic() - began_s:.0f} s", flush=True)
    if status != 0:
        sys.exit((place / "said.txt").read_text()[-6000:] + f"\nRed without a mutant, mend this first: {failed}")
    return found


def noticed(mutant: Mutant, source: bytes, tree: Path, place: Path, tests: list[str]) -> tuple[str, str]:
    """Test one mutant; return "killed" or "survived", and by how many tests."""
    if not tests:
        return "survived", "no test executes it"
    file, changed = tree / mutant.file, mutant.text(source)
    compile(changed, mutant.file, "exec")  # a text that is no Python would be killed by anything
    file.write_bytes(changed)
    for old in file.parent.glob(f"__pycache__/{file.stem}.*.pyc"):
        old.unlink()  # a source of the same size and second would be taken for this one
    try:
        status = run(tree, tests, Ordered(tests), PATIENCE_S, place / "said.txt")
    finally:
        file.write_bytes(source)
    if status == 0:
        return "survived", f"{len(tests)} tests"
    said = (place / "said.txt").read_text()
    if status not in (1, 2, None) and "ImportError while loading conftest" not in said:
        sys.exit(f"pytest ended with {status}:\n{said[-4000:]}")
    return "killed", "" if status else "time"


if __name__ == "__main__":
    sys.exit(main())
