"""Gather the pages of the documentation site in build/docs, where zensical.toml expects them.

Most pages are those of `docs/`. Added here: the pages at the top of the repository, the reference of the HTTP API, from
the OpenAPI document of the application, and that of the library, from the public names. `make docs` builds the site.
"""

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
TO = ROOT / "build" / "docs"
OF_THE_TOP = {
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
OF_THE_TOP |= {"urdf/README.md": "urdf.md", "README.md": "index.md"}
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(#[^)]*)?\)")
METHODS = ("get", "put", "post", "patch", "delete")
CLIENTS = ("Client", "AsyncClient")


def main(to: Path) -> None:
    """Write the pages into a folder, and say how many."""
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    more = {"api.md": "".join(calls(document())), "library.md": "".join(names())}
    for file in sorted((ROOT / "docs").iterdir()):
        if file.suffix == ".md":
            (to / file.name).write_text(linked(file, file.read_text()) + more.get(file.name, ""))
        elif file.suffix in (".png", ".toml", ".css"):
            shutil.copyfile(file, to / file.name)
    for name, as_page in OF_THE_TOP.items():
        (to / as_page).write_text(linked(ROOT / name, (ROOT / name).read_text()))
    print(f"{len(list(to.glob('*.md')))} pages in {to}")


def linked(page: Path, text: str) -> str:
    """Return the text of a page with its links as they are on the site, where all pages are in one folder.

    A link to a file that is no page becomes the name of that file: the site is read without the repository.
    """

    def there(found: re.Match[str]) -> str:
        target, anchor = found[1], found[2] or ""
        if not target:
            return found[0]
        name = (page.parent / target).resolve().relative_to(ROOT.resolve()).as_posix()
        if name in OF_THE_TOP:
            return f"]({OF_THE_TOP[name]}{anchor})"
        return f"]({Path(name).name}{anchor})" if name.startswith("docs/") else "]()"

    return re.sub(r"\[([^]]*)\]\(\)", r"\1", LINK.sub(there, text))


def document() -> dict[str, Any]:
    """Return the OpenAPI document of this version; nothing is asked over a network."""
    from skills.api.app import create_app
    from skills.settings import Settings

    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{Path(folder) / 'empty.sqlite'}"
        return create_app(Settings(database_url=url, signing_key=Path(folder) / "key")).openapi()


def calls(api: dict[str, Any]) -> Iterator[str]:
    """Yield the reference of every call: its parameters, its body and its answers."""
    by_tag: dict[str, list[tuple[str, str, dict[str, Any]]]] = {}
    for path, methods in api["paths"].items():
        for method in METHODS:
            if method in methods:
                call = methods[method]
                by_tag.setdefault(call.get("tags", ["service"])[0], []).append((method.upper(), path, call))
    yield "\n## Every call\n\nFrom the OpenAPI document of this version; `/docs` of a running service tries them.\n"
    for tag, group in by_tag.items():
        yield f"\n### {tag.capitalize()}\n"
        for method, path, call in group:
            yield f"\n#### `{method} {path}`\n\n{flat(call.get('description') or call.get('summary', ''))}\n"
            yield from table(
                ("parameter", "in", "type", "meaning"), (parameter(one) for one in call.get("parameters", []))
            )
            if body := call.get("requestBody"):
                kinds = ", ".join(
                    f"`{kind}`: {kind_of(one.get('schema', {}))}" for kind, one in body["content"].items()
                )
                yield f"\nBody: {kinds}.\n"
            answers = ((code, flat(one["description"])) for code, one in call["responses"].items())
            yield from table(("status", "answer"), answers)
    yield "\n### Schemas\n"
    for name, schema in sorted(api["components"]["schemas"].items()):
        yield f"\n#### {name}\n\n{flat(schema.get('description', ''))}\n"
        required = set(schema.get("required", ()))
        fields = schema.get("properties", {}).items()
        rows = (
            (f"`{key}`" + " *" * (key in required), kind_of(one), flat(one.get("description", "")))
            for key, one in fields
        )
        yield from table(("field (* required)", "type", "meaning"), rows)


def parameter(one: dict[str, Any]) -> tuple[str, str, str, str]:
    """Return the row of a parameter."""
    schema = one.get("schema", {})
    given = f" Default: `{schema['default']}`." if schema.get("default") is not None else ""
    name = f"`{one['name']}`" + " *" * bool(one.get("required"))
    return name, one["in"], kind_of(schema), flat(one.get("description", "")) + given


def kind_of(schema: dict[str, Any]) -> str:
    """Return the type of a schema in words, with a link where it has a name."""
    if ref := schema.get("$ref"):
        name = ref.rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    for among in ("anyOf", "oneOf", "allOf"):
        if among in schema:
            return " or ".join(dict.fromkeys(kind_of(one) for one in schema[among]))
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{one}`" for one in schema["enum"])
    if schema.get("type") == "array":
        items = schema.get("items") or {}
        return f"list of {kind_of(items)}" if items else "list"
    return str(schema.get("format") or schema.get("type") or "any")


def table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    """Yield a table, nothing if it has no rows."""
    first = next(rows, None)
    if first is None:
        return
    yield f"\n| {' | '.join(head)} |\n|{'---|' * len(head)}\n"
    for row in (first, *rows):
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n"


def flat(text: str) -> str:
    """Return a description in one line, with braces and angles as text."""
    return " ".join(text.split()).replace("<", "&lt;")


def names() -> Iterator[str]:
    """Yield the reference of every public name, in the order of `skills/__init__.py`, and of the clients."""
    sys.path.insert(0, str(ROOT))
    skills = import_module("skills")
    yield "\n## Every name\n\nIn the order of the data flow. Each is imported as `skills.NAME`.\n"
    for name, home in skills._CONTENTS.items():
        yield f"\n::: skills.{home}.{name}\n"
    yield "\n## Clients\n\n[The client's page](client.md) has examples.\n"
    for name in CLIENTS:
        home = getattr(import_module("skills.client"), name).__module__
        yield f"\n::: {home}.{name}\n"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else TO)
