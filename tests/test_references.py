"""Names in documents, docstrings and comments: each file, link, command and name of code that they refer to exists."""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import skills
from skills.api.routes import routes_of
from skills.cli import app

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "urdf/README.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
CODE = sorted(
    file
    for folder in ("skills", "seeds", "migrations", "tests", "docs", "examples")
    for file in (ROOT / folder).rglob("*.py")
)
PACKAGES = {file.parent.name for file in CODE}
NAMES_FILE = re.compile(r"(?<![\w./*{}-])(?:[\w-]+/)*[\w-]+\.(?:py|md)\b")
DOTTED = re.compile(r"`([A-Za-z]\w*(?:\.[A-Za-z_]\w*)+)(?:\(\))?`")
SLASHED = re.compile(r"`([a-z_]+(?:/[a-z_]+)+)((?:\.\w+)*)`")
COMMAND = re.compile(r"(?:^(?:\$ )?|`)skills ([a-z][^`\n#|]*)", re.MULTILINE)
CALL = re.compile(r"\b(?:GET|POST|PUT|DELETE) (/[^\s`\"'?,)|]+)")
WRONG = ROOT / "docs" / "mistakes.md"  # its commands are misspelt on purpose
COMMENTED = re.compile(r"#.*(?:`|\.py|\.md)")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")
OF_OTHERS = {  # files of other projects, a pattern, and one that was rejected
    *("dvrk_bag_replay.py", "launch_crtk_interface.py", "simulator.launch.py", "docs/scene_coordinate_frames.md"),
    *("data-collection/scripts/validation/validate_formatting.py", "validate_formatting.py"),
    *("scripts/validation/validate_formatting.py", "0001_what_it_does.py", "bytes.py"),
}
ELSEWHERE = {  # other libraries, columns and JSON, by the first part of the name
    *("DBOS", "Rotation", "csv", "httpx", "np", "sys", "yaml"),
    *(
        "a",
        "lineage",
        "nearest_limit",
        "observation",
        "psmN_local_pose",
        "psmN_local_sp",
        "psmN_pose",
        "psmN_sp",
        "result",
    ),
}
ALSO_ELSEWHERE = {"policy.model_dump", "report.path_states"}  # pydantic's and JSON's, beginning as names of ours do
SUFFIXES = {
    *("c", "csv", "dsse", "json", "jsonl", "lock", "md", "parquet", "py", "sqlite", "toml", "txt", "urdf", "yaml"),
    "zip",
}


@dataclass(frozen=True)
class Code:
    """A file of code: its docstrings and comments, the names that it defines, and its classes with names and bases."""

    prose: str
    names: set[str]
    classes: list[tuple[str, set[str], list[str]]]


@cache
def code(file: Path) -> Code:
    """Read a file of code; it is parsed once for all tests, and its tree is not kept."""
    text = file.read_text()
    nodes = list(ast.walk(ast.parse(text)))
    told = [ast.get_docstring(node) or "" for node in nodes if isinstance(node, DOCUMENTED)]
    if COMMENTED.search(text):  # only such a comment can refer to anything, and tokenising takes longest
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        told += [token.string for token in tokens if token.type == tokenize.COMMENT]
    classes = [
        (node.name, set(defined(ast.walk(node))), [base.id for base in node.bases if isinstance(base, ast.Name)])
        for node in nodes
        if isinstance(node, ast.ClassDef)
    ]
    return Code("\n".join(told), set(defined(nodes)), classes)


@cache
def members() -> dict[str, set[str]]:
    """Return the names that are defined in all modules, packages and classes of one name."""
    found: dict[str, set[str]] = defaultdict(set)
    found["skills"] |= set(skills.__all__)  # imported at first use
    bases: list[tuple[str, str]] = []
    for file in CODE:
        found[file.parent.name].add(file.stem)
        found[file.parent.parent.name].add(file.parent.name)
        for name, names, of in code(file).classes:
            found[name] |= names
            bases += [(name, base) for base in of]
        found[file.parent.name if file.stem == "__init__" else file.stem] |= code(file).names
    for name, base in bases * 3:  # a class has the names of its bases, and of theirs
        found[name] |= found[base]
    return found


def defined(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield every name that is defined or imported by the nodes of a module or class."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.alias):
            yield (node.asname or node.name).partition(".")[0]


def is_defined(name: str) -> bool:
    """Return whether each part of a dotted name is defined in the part before it."""
    parts = name.split(".")
    return all(part in members().get(before, ()) for before, part in pairwise(parts))


@cache
def files() -> set[str]:
    """Return every end of the path of every file, such as `grid.py` and `gridworld/grid.py`."""
    paths = [file.relative_to(ROOT).parts for file in (*CODE, *PAGES, ROOT / "CHANGELOG.md")]
    return {"/".join(parts[at:]) for parts in paths for at in range(len(parts))}


def is_place(path: str, attributes: str) -> bool:
    """Return whether `room/module` or `room/module.name` exists; other words with a slash are not of the code."""
    first, *_, last = path.split("/")
    if first not in PACKAGES or attributes.removeprefix(".") in SUFFIXES:
        return True
    there = any((folder / path).exists() or (folder / f"{path}.py").exists() for folder in folders())
    return there and is_defined(f"{last}{attributes}")


@cache
def folders() -> set[Path]:
    return {ROOT} | {parent for file in CODE for parent in file.parents if ROOT in parent.parents}


def prose(file: Path) -> str:
    """Return a page, or the docstrings and comments of a file of code."""
    return file.read_text() if file.suffix == ".md" else code(file).prose


def dangling(text: str) -> list[str]:
    """List the references of a text that lead nowhere."""
    dotted = {name for name in DOTTED.findall(text) if name.rpartition(".")[2] not in SUFFIXES} - ALSO_ELSEWHERE
    dotted = {name for name in dotted if name.partition(".")[0] not in ELSEWHERE}
    return [
        *set(NAMES_FILE.findall(text)) - OF_OTHERS - files(),
        *(name for name in dotted if not is_defined(name)),
        *("".join(found) for found in SLASHED.findall(text) if not is_place(*found)),
    ]


def test_every_file_and_name_that_is_referred_to_exists() -> None:
    found = {str(file.relative_to(ROOT)): dangling(prose(file)) for file in [*PAGES, *CODE]}
    assert {file: names for file, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "text",
    [
        "as interface.md says",
        "in `tests/jobs/test_nothing.py`",
        "see `engine.STEPS`",
        "see `jobs.NO_STEPS`",
        "`skills.style.dtw` aligns",
        "calls `planning/plan.heap`",
        "in `library/nothing`",
    ],
)
def test_a_reference_that_leads_nowhere_is_found(text: str) -> None:
    assert dangling(text)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page: Path) -> None:
    for target, anchor in LINK.findall(page.read_text()):
        to = page.parent / target if target else page
        assert to.exists(), target
        assert not anchor or anchor in anchors(to), f"{target}#{anchor}"


@cache
def commands() -> Any:
    return get_command(app)


def unknown_words(line: str) -> list[str]:
    """List the words of a command line that are no command or option, without those that are values."""
    words, command = line.split(), commands()
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            return words[:1] or [line]
        command = command.commands[words.pop(0)]
    options = {option for one in command.params for option in (*one.opts, *one.secondary_opts)} | {"--help"}
    named = [word.partition("=")[0].rstrip(".,;:)") for word in words if word.startswith("--")]
    return [option for option in named if option not in options]


@pytest.mark.parametrize("page", [page for page in PAGES if page != WRONG], ids=lambda page: page.stem)
def test_every_command_of_a_page_exists_with_its_options(page: Path) -> None:
    found = {line: unknown_words(line) for line in COMMAND.findall(page.read_text())}
    assert {line: words for line, words in found.items() if words} == {}


@pytest.mark.parametrize(
    "line", ["surgen list", "demo", "demo list --surgon kestrel", "plan a b --point=0,0,0 --handof"]
)
def test_a_command_that_does_not_exist_is_found(line: str) -> None:
    assert unknown_words(line)


def is_call(path: str) -> bool:
    """Return whether the service has a path, as a page writes it: `/demos/{id}`, `/demos[/{id}]` or `/policies/...`."""
    given = re.sub(r"\{[^}]*\}", "x", re.sub(r"\[.*?\]", "", path)).rstrip(".:;/") or "/"
    served = ["/openapi.json", *(str(getattr(route, "path", "")) for route in routes_of())]
    return any(re.fullmatch(re.sub(r"\{[^}]*\}", "[^/]+", one), given) for one in served)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_call_of_a_page_exists(page: Path) -> None:
    assert [path for path in CALL.findall(page.read_text()) if not is_call(path)] == []


@pytest.mark.parametrize("path", ["/atlas/{suture}", "/demos/{id}/reading", "/policy"])
def test_a_call_that_does_not_exist_is_found(path: str) -> None:
    assert not is_call(path)
