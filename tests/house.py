"""Measures of the code base: files, lines, functions, language and names, for any checkout of the project.

    python -m tests.house              this checkout
    python -m tests.house FOLDER ...   others, side by side: `git worktree add FOLDER COMMIT`

Lines are counted without docstrings, comments and blank lines. Words are those of docstrings, comments and documents.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

QUESTION_WORDS = ("What", "Who", "Whose", "How", "Where", "Whether", "Why", "When", "Which")
PURE = ("demonstration", "gridworld", "learning", "planning", "verification", "comparison", "scoring", "kinematics")
PURE_BEFORE = ("style",)  # the one room of the theory until it was divided
LONGEST_TEST_NAME = 70
# A noun of the service is a module in each of these, and its class a row, a value and the schema of both.
LAYERS = ("db", "library", "schemas", "api", "api/routes", "client", "cli", "verification")
NOUNS = {
    "Demonstration": "row, schema",
    "Job": "row, schema",
    "Key": "row, schema",
    "Plan": "row, schema",
    "Surgeon": "row, schema",
    "SutureType": "row, schema",
    "Combined": "value, schema",
    "Label": "value, schema",
    "Motion": "value, schema",
    "Pass": "value, schema",
    "Playback": "value, and its verdict as the schema",
    "Policy": "value, schema",
    "PoseStyle": "value, schema",
    "Proposal": "value, schema",
    "PsmM": "value, schema",
    "Recording": "value, schema",
    "RewardMap": "value, schema",
    "Rollout": "value, schema",
    "Trajectory": "value, schema",
    "History": "of a database, and its calls at the client",
    "Problem": "schema, and the error of the client that carries it",
    "Coverage": "value, stored under this name, and the schema of its figures",
    "SuturePoint": "value, stored under this name, and the schema of one that was found",
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Measures:
    """Counts over the files of one part of a checkout."""

    files: int = 0
    lines: int = 0
    comments: int = 0
    functions: list[int] = field(default_factory=list)
    docstrings: list[str] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    public: int = 0
    with_args: int = 0
    places: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    long_tests: int = 0
    tests: int = 0

    def two_things(self) -> list[str]:
        """List the names of several classes or modules that are not one noun by design."""
        several = {name: places for name, places in self.places.items() if len(places) > 1}
        return sorted(name for name, places in several.items() if name not in NOUNS and not one_noun(places))

    def row(self) -> dict[str, str]:
        """Format the measures, by their names."""
        asked = sum(text.startswith(QUESTION_WORDS) for text in self.docstrings)
        twice = self.two_things()
        return {
            "files": str(self.files),
            "lines": str(self.lines),
            "median function": f"{median(self.functions or [0]):g} lines",
            "comments": f"{100 * self.comments / max(self.lines, 1):.1f} in 100 lines",
            "docstrings that begin with a question word": f"{100 * asked / max(len(self.docstrings), 1):.1f} %",
            '"what"': f"{1000 * self.words.count('what') / max(len(self.words), 1):.1f} in 1000 words",
            "names of two things": f"{len(twice)}: {', '.join(twice)}",
            "public functions of the pure rooms with Args": f"{self.with_args} of {self.public}",
            f"test names over {LONGEST_TEST_NAME} characters": f"{self.long_tests} of {self.tests}",
        }


def one_noun(places: set[str]) -> bool:
    """Return whether modules of one name are of different layers, in which a noun of the service has its file."""
    rooms = [place.removeprefix("module ").rpartition("/")[0] for place in places if place.startswith("module ")]
    return len(rooms) == len(places) and len(set(rooms)) == len(rooms) and set(rooms) <= set(LAYERS)


def sources(folder: Path) -> Iterator[Path]:
    """List the Python files below a folder, without those reached through links, and without migrations."""
    for file in sorted(folder.rglob("*.py")):
        inside = file.relative_to(folder).parents
        if not any((folder / part).is_symlink() for part in inside) and "versions" not in file.parts:
            yield file


def measure(root: Path, part: str) -> Measures:
    """Measure `skills` or `tests` of a checkout."""
    found = Measures()
    for file in sources(root / part):
        add(found, file, file.relative_to(root / part))
    if part == "skills":
        for document in (*root.glob("*.md"), *(root / "docs").glob("*.md")):
            found.words += words_of(document.read_text())
    return found


def add(found: Measures, file: Path, name: Path) -> None:
    """Add one file to the measures."""
    text = file.read_text()
    tree = ast.parse(text)
    found.files += 1
    comments = [
        token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type == tokenize.COMMENT
    ]
    found.comments += len(comments)
    for token in comments:
        found.words += words_of(token.string)
    found.lines += code_lines(text, tree)
    add_names(found, ast.walk(tree), name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | Function) and (said := ast.get_docstring(node)):
            found.docstrings.append(said)
            found.words += words_of(said)
        if isinstance(node, Function):
            found.functions.append((node.end_lineno or node.lineno) - node.lineno + 1)
            if node.name.startswith("test_"):
                found.tests += 1
                found.long_tests += len(node.name) > LONGEST_TEST_NAME
    if name.parts[0].removesuffix(".py") in (*PURE, *PURE_BEFORE):
        for node in tree.body:
            if isinstance(node, Function) and not node.name.startswith("_") and node.args.args:
                found.public += 1
                found.with_args += "Args:" in (ast.get_docstring(node) or "")


def add_names(found: Measures, nodes: Iterable[ast.AST], name: Path) -> None:
    """Add the names of a module and of its public classes."""
    if name.name != "__init__.py":
        found.places[name.stem].add(f"module {name}")
    for node in nodes:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found.places[node.name].add(f"class {name}")


def code_lines(text: str, tree: ast.Module) -> int:
    """Count the lines that are neither blank, nor a comment alone, nor part of a docstring."""
    docstrings: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node) is not None:
            docstrings.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    lines = enumerate(text.splitlines(), start=1)
    return sum(bool(line.strip()) and not line.strip().startswith("#") and row not in docstrings for row, line in lines)


def words_of(text: str) -> list[str]:
    """Split prose into words in lower case."""
    return re.findall(r"[a-z]+(?:'[a-z]+)?", text.lower())


def main() -> None:
    """Print the measures of checkouts side by side."""
    roots = [Path(one) for one in sys.argv[1:]] or [Path(__file__).parents[1]]
    for part in ("skills", "tests"):
        rows = [measure(root, part).row() for root in roots]
        print(f"\n{part}")
        for name in rows[0]:
            print(f"  {name:46} " + "   ".join(f"{row[name]:24}" for row in rows))


if __name__ == "__main__":
    main()
