"""What every page has. There are two kinds.

`render` makes a page of the site from a template: a browser loads its scripts, style and numbers from this server, and
nothing from anywhere else. `page` makes a document that stands alone, to be kept or sent on: a browser runs and fetches
nothing for it.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import cache
from hashlib import sha256
from html import escape
from typing import Any, get_args

from fastapi import Request, Response
from jinja2 import Environment, PackageLoader, StrictUndefined

from skills.api.access import Caller, Role
from skills.api.pages import words
from skills.api.pages.assets import PLOTLY_MAP_STYLE, build

# No script or style but our files, none inline. Of pictures, plotly asks with `data:` what a browser can show, and
# saves a view by way of a `blob:`.
SITE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
SITE_HEADERS = {
    "Content-Security-Policy": SITE_POLICY,
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",  # surgeons, and the token of the session
}

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 66rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h1 { margin-bottom: .3rem; } h2 { margin-top: 2.2rem; font-size: 1.25rem; }
p, li { max-width: 50rem; } .made, figcaption, .meaning { color: #57606a; font-size: .9rem; }
.advice { border-left: 4px solid #d55e00; padding: .2rem 0 .2rem 2rem; margin-left: 0; }
.advice li { margin: .4rem 0; } .well { border-left: 4px solid #009e73; padding-left: .8rem; }
table { border-collapse: collapse; width: 100%; max-width: 58rem; }
caption { text-align: left; font-weight: 600; padding: 1rem 0 .3rem; }
th, td { border-bottom: 1px solid #d0d7de; padding: .25rem 1rem .25rem 0; text-align: left; vertical-align: top; }
th { font-weight: 400; white-space: nowrap; width: 10rem; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; width: 12rem; }
figure { margin: 0; } .views { display: flex; flex-wrap: wrap; gap: .5rem; } svg { max-width: 100%; height: auto; }
svg text { font: 11px system-ui, sans-serif; fill: #57606a; } .axis { stroke: #d0d7de; stroke-width: 1; }
.cell { fill: #d55e00; fill-opacity: .13; } .grid { fill: none; stroke: #d55e00; stroke-width: 1.6; }
.raw { fill: none; stroke: #0072b2; stroke-width: 1.6; }
.pause { fill: none; stroke: #57606a; stroke-width: 1.2; stroke-dasharray: 3 3; } .paused { fill: #eaeef2; }
.start { fill: #009e73; } .goal { fill: #1b1f24; } .partner { fill: none; stroke: #cc79a7; stroke-width: 2; }
.key { display: flex; flex-wrap: wrap; gap: 1.2rem; padding: 0; list-style: none; font-size: .9rem; color: #57606a; }
@media print { body { margin: 0; max-width: none; } }
"""
# By its digest, so that no other style is taken; no script, picture or address at all.
POLICY = f"default-src 'none'; style-src 'sha256-{b64encode(sha256(STYLE.encode()).digest()).decode()}'"
HEADERS = {"Content-Security-Policy": f"{POLICY}; frame-ancestors 'none'", "Vary": "Accept"}


@cache
def templates() -> Environment:
    """Read templates in which all is escaped, and a name that is not there is an error."""
    made = Environment(
        loader=PackageLoader("skills.api.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= words.FILTERS
    made.globals |= {"plotly_map_style": PLOTLY_MAP_STYLE}
    return made


def render(request: Request, template: str, caller: Caller | None, *, status: int = 200, **context: Any) -> Response:
    """Make a page of the site; `caller` is None where nobody knows yet who asks.

    In the template `url` puts our prefix before a path, `static` names a file of `static/`, and `may` tells whether the
    caller has a role, or one above it.
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
        "may": lambda role: reached >= ladder.index(role),
    }
    html = templates().get_template(template).render(**about, **context)
    return Response(html, status, headers=SITE_HEADERS, media_type="text/html")


def page(title: str, body: str) -> str:
    """Write a document; `body` is HTML already, `title` is not."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY, quote=True)}">'
        f'<meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>{body}</body></html>\n"
    )


def table(caption: str, rows: Sequence[tuple[str, str, str]]) -> str:
    """Write a table of names, numbers with their units, and what they mean."""
    lines = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="number">{escape(number)}</td>'
        f'<td class="meaning">{escape(meaning)}</td></tr>'
        for name, number, meaning in rows
    )
    return f"<table><caption>{escape(caption)}</caption><tbody>{lines}</tbody></table>"
