"""The licences of what serving installs; `python -m tests.notices` prints the table of NOTICE."""

import re
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]


def locked(name: str) -> list[str]:
    """Return the packages of a lock file, as it spells them."""
    return sorted(set(re.findall(r"^([\w.-]+)==", (ROOT / name).read_text(), re.MULTILINE)))


def licence_of(package: str) -> str | None:
    """Return what the metadata of an installed package say: an expression, else its classifiers, else a line."""
    try:
        stated = metadata(package)
    except PackageNotFoundError:
        return None  # of another platform
    classifiers = [one.split(" :: ")[-1] for one in stated.get_all("Classifier", []) if one.startswith("License ::")]
    return stated.get("License-Expression") or ", ".join(classifiers) or stated["License"].splitlines()[0]


if __name__ == "__main__":
    for package in locked("requirements-serve.lock"):
        print(f"{package:24}{licence_of(package) or 'not installed here'}")
