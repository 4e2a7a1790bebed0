"""The same digests on every machine: each value is made again in processes that differ as machines differ.

A process differs by its environment: numpy without the vector instructions that it chooses at run time, BLAS with the
kernels of other processors and with one thread or two, numba for a processor without any extension, and the C library
without its fused variants. What must be equal to the last bit is, and what an engine measures is within a tolerance.
"""

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy._core import _multiarray_umath as numpy_core

import skills
from skills.verification.gates import TOLERANCE

PACKAGE = Path(skills.__file__).parent
PLAIN_NUMPY = {"NPY_DISABLE_CPU_FEATURES": " ".join(numpy_core.__cpu_dispatch__)}
PLAIN_C = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"}
MACHINES = {
    "numpy without extensions": PLAIN_NUMPY,
    "C library without extensions": PLAIN_C,
    "BLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "BLAS for Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "BLAS for SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "one thread": {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    "two threads": {"OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
    "numba without extensions": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
}
OLDEST = PLAIN_NUMPY | PLAIN_C | {"OPENBLAS_CORETYPE": "Nehalem", "OPENBLAS_NUM_THREADS": "1"}
# Functions whose result depends on the processor or the library's build, by the module that has them.
CHOSEN_BY_PROCESSOR = {
    "np": "sin cos tan arcsin arccos arctan arctan2 sinc hanning exp expm1 log log1p log2 log10 logaddexp power "
    "float_power hypot cbrt dot vdot inner matmul tensordot convolve correlate",
    "math": "sin cos tan asin acos atan atan2 exp expm1 log log1p log2 log10 pow cbrt",
    "np.linalg": "svd eig eigh inv pinv solve lstsq qr cholesky",
    "scipy": "Rotation Slerp gaussian_filter1d",
}
EXACT = """
arithmetic quaternions kinematics dynamics comparison/combining formats/columns formats/jigsaws gridworld/domain
gridworld/grid
gridworld/reward gridworld/scene learning/certificate learning/evaluation learning/in_scene learning/pose_style
learning/q_learning gridworld/slip learning/slip_runs learning/tube
planning/handoff planning/motion_laws planning/passes planning/path_fit
planning/plan planning/trajectory demonstration/demonstration demonstration/identification demonstration/motion
demonstration/recording
"""  # these make what is digested and computed again; docs/decisions.md has the others, with their reasons


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the recordings that all machines read."""
    folder = tmp_path_factory.mktemp("machines")
    run("write", folder)
    return folder


def run(part: str, folder: Path, **different: str) -> str:
    command = [sys.executable, "-m", "tests.machines.digests", part, str(folder)]
    environment = os.environ | {"PYTHONWARNINGS": "ignore"} | different
    done = subprocess.run(command, env=environment, cwd=PACKAGE.parent, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return done.stdout


def made(part: str, folder: Path, **different: str) -> tuple[dict[str, str], dict[str, Any]]:
    digests, figures = json.loads(run(part, folder, **different))
    return digests, figures


def differing(one: dict[str, str], other: dict[str, str]) -> list[str]:
    assert one.keys() == other.keys()
    return [name for name in one if one[name] != other[name]]


def test_the_oldest_processor_makes_the_same_digests(folder: Path):
    here, there = made("day", folder), made("day", folder, **OLDEST)
    assert len(here[0]) > 50
    assert differing(here[0], there[0]) == []


@pytest.fixture(scope="module")
def here(folder: Path) -> tuple[dict[str, str], dict[str, Any]]:
    return made("night", folder)


@pytest.mark.nightly
@pytest.mark.parametrize("machine", MACHINES)
def test_every_machine_makes_the_same_digests(folder: Path, here: tuple[dict[str, str], dict[str, Any]], machine: str):
    digests, figures = made("night", folder, **MACHINES[machine], NUMBA_CACHE_DIR=str(folder / f"numba {machine}"))
    assert differing(here[0], digests) == []
    assert len(figures) == 6
    for name, report in figures.items():
        assert list(apart(here[1][name], report)) == [], name


def apart(one: Any, other: Any, where: str = "") -> Iterator[str]:
    """Yield the names of the parts of two reports that are not equal, numbers within the tolerance of the gates."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            yield from apart(one[name], other[name], f"{where}.{name}")
    elif isinstance(one, list):
        assert len(one) == len(other), where
        for number, pair in enumerate(zip(one, other, strict=True)):
            yield from apart(*pair, f"{where}[{number}]")
    elif isinstance(one, float) and isinstance(other, float):
        if not abs(one - other) <= TOLERANCE:
            yield f"{where}: {one!r} and {other!r}"
    elif one != other:
        yield f"{where}: {one!r} and {other!r}"


def test_the_environments_differ_in_what_they_should():
    code = (
        "import math, numpy as np; x = np.linspace(0.1, 1.3, 4001); a = np.outer(x[:60], x[-60:]);"
        "print([b.tobytes().hex() for b in (np.power(0.1, x * 9), np.array([math.sin(v) for v in x]), a @ a)])"
    )
    read = {}
    command = [sys.executable, "-W", "ignore", "-c", code]
    for name, different in (("here", {}), ("numpy", PLAIN_NUMPY), ("C", PLAIN_C), ("BLAS", OLDEST)):
        done = subprocess.run(command, env=os.environ | different, capture_output=True, check=True)
        read[name] = ast.literal_eval(done.stdout.decode())
    if "X86_V4" not in {name for name, there in numpy_core.__cpu_features__.items() if there}:
        pytest.skip("This processor has no instructions to leave out.")
    assert read["here"][0] != read["numpy"][0]
    assert read["here"][1] != read["C"][1]
    assert read["here"][2] != read["BLAS"][2]


@pytest.mark.parametrize("module", EXACT.split())
def test_digested_values_are_made_of_fixed_arithmetic(module: str):
    tree = ast.parse((PACKAGE / f"{module}.py").read_text())
    tree = WithoutLogarithms().visit(tree)
    assert [f"line {line}: {what}" for line, what in sorted(chosen_by_processor(tree))] == []


class WithoutLogarithms(ast.NodeTransformer):
    """Leave out the functions on faint values: the certificate compares them within 1e-9, and only counts the rows."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef | None:
        return None if node.name == "log_expected" else node


def chosen_by_processor(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the lines of matrix products, powers, functions of `CHOSEN_BY_PROCESSOR`, and norms without an axis."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            yield node.lineno, "@"
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and not is_exact(node):
            yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and (module := (node.module or "").split(".")[0]) in ("math", "scipy"):
            banned = CHOSEN_BY_PROCESSOR[module].split()
            yield from ((node.lineno, f"{module}.{one.name}") for one in node.names if one.name in banned)
        elif isinstance(node, ast.Attribute) and (owner := ast.unparse(node.value)) in CHOSEN_BY_PROCESSOR:
            yield from ((node.lineno, node.attr) for name in CHOSEN_BY_PROCESSOR[owner].split() if name == node.attr)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "np.linalg.norm" and not has_axis(node):
            yield node.lineno, "np.linalg.norm without an axis"


def has_axis(call: ast.Call) -> bool:
    return "axis" in {one.arg for one in call.keywords}


def is_exact(power: ast.BinOp) -> bool:
    """Return whether a power is a square, or one of a stated number."""
    return isinstance(power.left, ast.Constant | ast.UnaryOp) or ast.unparse(power.right) == "2"


LINES = "a @ b; a @= b; u**3; gamma**moves; from math import atan2; np.exp(1); np.linalg.eigh(a); np.linalg.norm(a)"


@pytest.mark.parametrize("line", LINES.split("; "))
def test_the_check_of_the_arithmetic_can_fail(line: str):
    assert len(list(chosen_by_processor(ast.parse(line)))) == 1


def test_a_figure_within_the_tolerance_is_not_apart():
    one = {"a": [1.0, None, "x"]}
    assert list(apart(one, {"a": [1.0 + TOLERANCE / 2, None, "x"]})) == []
    assert list(apart(one, {"a": [1.0 + 2 * TOLERANCE, None, "y"]})) == [
        f".a[0]: 1.0 and {1.0 + 2 * TOLERANCE!r}",
        ".a[2]: 'x' and 'y'",
    ]
    assert list(apart({"a": np.nan}, {"a": 1.0})) != []
