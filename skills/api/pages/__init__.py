"""Web pages: templates, static assets, content negotiation, and the formatting of values.

There are two kinds of pages. `render` renders a page of the site from a template; it loads its scripts, style and data
from this server only. `standalone` renders a document to be stored or sent; a browser runs and fetches nothing for it.

Assets are our scripts and styles, and those of Swagger UI from its package. They are read once, and their
URL contains a digest of all of them: a browser may cache a file permanently and never mixes two versions. Our scripts
import each other by relative URLs, and so stay within a version.
"""

import gzip
import hashlib
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, lru_cache
from importlib import resources
from math import degrees
from typing import Any, get_args

from fastapi import Request, Response
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from pydantic_core import to_jsonable_python

from skills.api.authorisation import Caller, Role
from skills.errors import UnknownFormat
from skills.formats import READABLE
from skills.library.operation.overview import StyleState
from skills.library.plans.headline import describe_error

HTML = "text/html"
JSON = "application/json"


def wants_page(accept: str, what: str) -> bool:
    """Return whether the client prefers a page to JSON: the first of them that its `Accept` header names.

    Args:
        accept: The header.
        what: The resource, as the subject of the error's sentence.

    Raises:
        UnknownFormat: The client accepts neither.
    """
    for wanted in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if wanted in (HTML, "text/*"):
            return True
        if wanted in (JSON, "application/*", "*/*"):
            return False
    raise UnknownFormat(f"{what} is available as {JSON} or {HTML}; name one of them in Accept.")


TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
BORROWED = {  # from their packages: name, package, folder in it
    "swagger-ui-bundle.js": ("fastapi_swagger", "resources"),
    "swagger-ui.css": ("fastapi_swagger", "resources"),
}


@dataclass(frozen=True)
class Asset:
    """A static file: its bytes, the same compressed with gzip, and its media type."""

    content: bytes
    packed: bytes
    media_type: str


@cache
def assets() -> dict[str, Asset]:
    """Return all assets by name; a name from a URL is looked up here and never used as a path."""
    own = resources.files("skills") / "api" / "pages" / "static"
    files = {file.name: file.read_bytes() for file in own.iterdir() if file.is_file()}
    for name, (package, folder) in BORROWED.items():
        files[name] = (resources.files(package) / folder / name).read_bytes()
    return {name: _asset(name, content) for name, content in files.items() if _ending(name) in TYPES}


@cache
def build() -> str:
    """Return the digest of all assets, which is part of their URLs."""
    seen = hashlib.sha256()
    for name, asset in sorted(assets().items()):
        seen.update(name.encode() + hashlib.sha256(asset.content).digest())
    return seen.hexdigest()[:16]


def _asset(name: str, content: bytes) -> Asset:
    return Asset(content, gzip.compress(content, compresslevel=5, mtime=0), TYPES[_ending(name)])


def _ending(name: str) -> str:
    return name[name.rfind(".") :]


MISSING = "–"
STATE_MARKS = {"released": "●", "trained": "◐", "stored": "○", "empty": "·"}
JOB_MARKS = {"queued": "○", "running": "◐", "succeeded": "●", "failed": "✕", "cancelled": "–", "done": "●"}
STATE_WORDS = {
    "released": "served to clients",
    "trained": "learnt, not released",
    "stored": "demonstrated, not learnt",
    "empty": "nothing yet",
}


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """Return a number with its unit, rounded, and without a fraction if that is 0."""
    if value is None:
        return MISSING
    text = f"{value:,.{digits}f}" if isinstance(value, float) else f"{value:,}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return f"{text} {unit}".strip()


def triple(values: Sequence[float] | None, unit: str = "mm", digits: int = 2) -> str:
    """Return the coordinates x, y and z with their unit."""
    if values is None:
        return MISSING
    return ", ".join(f"{value:.{digits}f}" for value in values) + f" {unit}"


def moment(value: datetime | str | None) -> str:
    """Return a time in UTC, to the second."""
    if value is None:
        return MISSING
    seen = datetime.fromisoformat(value) if isinstance(value, str) else value
    return seen.replace(tzinfo=seen.tzinfo or UTC).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def short(digest: str) -> str:
    """Return the first 12 characters of a digest, enough to distinguish it from the others on a page."""
    return digest[:12]


def size(count: int) -> str:
    """Return a number of bytes with a unit."""
    for unit, scale in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count >= scale:
            return f"{count / scale:.1f} {unit}"
    return f"{count} bytes"


def share(value: float | None, digits: int = 1) -> str:
    """Return a fraction as percent; less than all is never rounded to 100 %."""
    if value is None:
        return MISSING
    text = f"{100 * value:.{digits}f}"
    if value < 1 and float(text) >= 100:
        return f"> {100 - 10**-digits:.{digits}f} %"
    return f"{text} %"


def outline(style: StyleState) -> dict[str, Any] | None:
    """Return the drawing of a style as a thumbnail: its path in the box of its grid, in a square of 100 by 100 units.

    The view is orthographic, from above one corner. None if there is nothing to draw.
    """
    if style.shown is None:
        return None
    nx, ny, nz = style.shown.grid_shape
    seen, box = _box(nx, ny, nz)
    path = [seen(at // (ny * nz), at // nz % ny, at % nz) for at in style.shown.waypoints]
    return {**box, "path": _line(path), "start": path[0], "goal": path[-1]}


Seen = tuple[float, float]  # a point in the square


@lru_cache(maxsize=1000)
def _box(nx: int, ny: int, nz: int) -> tuple[Callable[[int, int, int], Seen], dict[str, str]]:
    """Return where a cell of a grid of this shape is seen, and the lines of the grid's box; many styles share them."""
    x, y, z = ends = nx - 1, ny - 1, nz - 1
    across = [(0.94, -0.34, 0.0), (0.14, 0.40, 0.91)]  # screen axes: turned by 20 degrees, seen from 25 degrees above
    low = [sum(min(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    high = [sum(max(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    scale = 92 / max(high[0] - low[0], high[1] - low[1], 1)
    (ux, uy, uz), (vx, vy, vz) = across
    middle_u, middle_v = ((below + above) / 2 for below, above in zip(low, high, strict=True))

    def seen(i: int, j: int, k: int) -> Seen:
        u, v = ux * i + uy * j + uz * k, vx * i + vy * j + vz * k
        return round(50 + scale * (u - middle_u), 1), round(50 - scale * (v - middle_v), 1)

    lines = {
        "floor": [(0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0), (0, 0, 0)],
        "back": [(0, y, 0), (0, y, z), (x, y, z), (x, 0, z), (x, 0, 0)],
        "spine": [(x, y, 0), (x, y, z)],
    }
    return seen, {name: _line([seen(*cell) for cell in cells]) for name, cells in lines.items()}


def _line(points: Sequence[Seen]) -> str:
    return " ".join(f"{u},{v}" for u, v in points)


FILTERS = {
    "number": number,
    "triple": triple,
    "moment": moment,
    "short": short,
    "size": size,
    "share": share,
    "degrees": degrees,
    "outline": outline,
    "state_mark": STATE_MARKS.__getitem__,
    "describe_error": describe_error,
    "state_words": STATE_WORDS.__getitem__,
    "job_mark": JOB_MARKS.__getitem__,
}


# Scripts and styles only from our files, none inline. Swagger UI has images at `data:` URLs.
SITE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
SITE_HEADERS = {
    "Content-Security-Policy": SITE_POLICY,
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",  # pages contain pseudonyms, and the CSRF token of the sign-in
}


@cache
def templates() -> Environment:
    """Return the template environment: everything is escaped, and an undefined name is an error."""
    made = Environment(
        loader=PackageLoader("skills.api.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= FILTERS
    made.policies["json.dumps_kwargs"] = {"sort_keys": True, "default": to_jsonable_python}  # values and models too
    return made


def render(request: Request, template: str, caller: Caller | None, *, status: int = 200, **context: Any) -> Response:
    """Render a page of the site; `caller` is None if the request is not authenticated.

    In the template `url` adds the proxy's prefix to a path, `static` returns the URL of a file of `static/`, and `may`
    returns whether the caller has a role or a higher one.
    """
    root = str(request.scope.get("root_path", "")).rstrip("/")
    ladder = get_args(Role)
    reached = -1 if caller is None else ladder.index(caller.role)
    about: Mapping[str, Any] = {
        "caller": caller,
        "root": root,
        "path": request.url.path.removeprefix(root),
        "url": lambda path: root + path,
        "static": lambda name: f"{root}/static/{build()}/{name}",
        "readable": READABLE,
        "may": lambda role: reached >= ladder.index(role),
    }
    html = templates().get_template(template).render(**about, **context)
    return Response(html, status, headers=SITE_HEADERS, media_type="text/html")


@cache
def style_of(name: str) -> str:
    """Return the style of a standalone document."""
    return (resources.files("skills") / "api" / "pages" / "templates" / f"{name}.css").read_text()


@cache
def standalone_headers(name: str) -> dict[str, str]:
    """Return the headers of a standalone document: its style is allowed by its digest, and nothing else is."""
    return {"Content-Security-Policy": f"{_policy(name)}; frame-ancestors 'none'", "Vary": "Accept"}


def _policy(name: str) -> str:
    digest = b64encode(hashlib.sha256(style_of(name).encode()).digest()).decode()
    return f"default-src 'none'; style-src 'sha256-{digest}'"


def standalone(name: str, **context: Any) -> str:
    """Render the template and the style of a name as one HTML document, which runs and fetches nothing."""
    template = templates().get_template(f"{name}.html")
    return template.render(style=Markup(style_of(name)), policy=_policy(name), **context)  # noqa: S704 - our own file
