"""Web pages from templates.

There are two kinds of pages. `render` renders a page of the site from a template; it loads its scripts, style and data
from this server only. `standalone` renders a document to be stored or sent; a browser runs and fetches nothing for it.
"""

import hashlib
from base64 import b64encode
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any, get_args

from fastapi import Request, Response
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from pydantic_core import to_jsonable_python

from skills.api.authorisation import Caller, Role
from skills.api.pages.assets import build
from skills.api.pages.filters import FILTERS
from skills.api.responses import HTML
from skills.formats import READABLE
from skills.learning.ties import OPTIMAL

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
    made.globals["optimal"] = OPTIMAL
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
    return Response(html, status, headers=SITE_HEADERS, media_type=HTML)


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
