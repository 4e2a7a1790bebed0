"""Signing in to the page with a key, and out again."""

import re
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import APIRouter, Query, Request, Response

from skills.api.access import Asking, needs, open_to_all
from skills.api.deps import Configured
from skills.api.gate import COOKIE, Access, refuse_without_token
from skills.api.pages.page import render
from skills.errors import BadInput, NotSignedIn
from skills.library.sign_ins import sign_in, sign_out
from skills.settings import Settings

FORM_BYTES, FIELDS = 4096, 4
HERE = re.compile(r"/(?![/\\])[^\\\x00-\x20\x7f]*")  # a path of this service, and no address of another

router = APIRouter(include_in_schema=False, max_body_size=FORM_BYTES)

Next = Annotated[str, Query(max_length=2000)]


@router.get("/sign-in", dependencies=[open_to_all()])
def show_sign_in(request: Request, next: Next = "/") -> Response:
    """Ask for a key."""
    return render(request, "sign_in.html", None, next=_here(next), wrong=None)


@router.post("/sign-in", dependencies=[open_to_all()])
async def begin(request: Request, settings: Configured) -> Response:
    """Take a key, and give a cookie for it."""
    form = await _form(request)
    access: Access = request.app.state.access
    where = _here(form.get("next", "/"))
    try:
        caller = await access.by_key(form.get("key", "").strip(), request.client.host if request.client else "")
        if caller.key is None:
            raise NotSignedIn("This is no key for people.")
    except NotSignedIn:
        said = "This is none of the keys here, or it was revoked or has run out."
        return render(request, "sign_in.html", None, status=401, next=where, wrong=said)
    key = caller.key
    cookie = await access.write(lambda session: sign_in(session, key, access.lasts))
    answer = _go(request, where)
    answer.set_cookie(
        COOKIE,
        cookie,
        max_age=int(settings.sign_in_s),
        path=_root(request) or "/",
        secure=_is_secure(request, settings),
        httponly=True,
        samesite="strict",
    )
    return answer


@router.post("/sign-out", dependencies=[needs("reader")])
async def end(request: Request, caller: Asking) -> Response:
    """Forget a sign-in; the form carries its token."""
    cookie = request.cookies.get(COOKIE)
    answer = _go(request, "/sign-in")
    if cookie is not None and caller.csrf is not None:
        form = await _form(request)
        refuse_without_token(caller, request.headers.get("x-csrf-token", form.get("csrf", "")))
        access: Access = request.app.state.access
        await access.write(lambda session: sign_out(session, cookie))
        answer.delete_cookie(COOKIE, path=_root(request) or "/", httponly=True, samesite="strict")
    return answer


async def _form(request: Request) -> dict[str, str]:
    """Read the fields of a form, the first of each name.

    Raises:
        BadInput: There are more than any form of ours has.
    """
    try:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=FIELDS)
    except ValueError:
        raise BadInput("The form has more fields than this page's.") from None
    return {name: values[0] for name, values in fields.items()}


def _here(where: str) -> str:
    """Keep to this service: a link must not lead through its sign-in to somewhere else."""
    return where if HERE.fullmatch(where) else "/"


def _root(request: Request) -> str:
    return str(request.scope.get("root_path", "")).rstrip("/")


def _go(request: Request, where: str) -> Response:
    return Response(status_code=303, headers={"Location": _root(request) + where, "Cache-Control": "no-store"})


def _is_secure(request: Request, settings: Settings) -> bool:
    """Keep the cookie to TLS, unless this is plain HTTP on this very machine."""
    by_tls = settings.tls_cert is not None or settings.tls_by_proxy or settings.beyond_loopback
    return by_tls or request.headers.get("origin", "").startswith("https://")
