"""Routes that sign in to the pages with a key, and out."""

import re
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import APIRouter, Query, Request, Response

from skills.api.authorisation import Asking, needs, open_to_all
from skills.api.dependencies import Callers, Configured
from skills.api.gate import COOKIE, refuse_without_token
from skills.api.pages import render
from skills.errors import BadInput, NotSignedIn
from skills.library.people.sign_ins import sign_in, sign_out
from skills.settings import Settings

FORM_BYTES, FIELDS = 4096, 4
HERE = re.compile(r"/(?![/\\])[^\\\x00-\x20\x7f]*")  # a path of this service, never the URL of another
sign_in_router = APIRouter(include_in_schema=False, max_body_size=FORM_BYTES)
Next = Annotated[str, Query(max_length=2000)]


@sign_in_router.get("/sign-in", dependencies=[open_to_all()])
def show_sign_in(request: Request, next: Next = "/") -> Response:
    """Show the form that takes a key."""
    return render(request, "sign_in.html", None, next=_here(next), wrong=None)


@sign_in_router.post("/sign-in", dependencies=[open_to_all()])
async def begin(request: Request, settings: Configured, access: Callers) -> Response:
    """Exchange a key for a session cookie."""
    form = await _form(request)
    where = _here(form.get("next", "/"))
    try:
        caller = await access.by_key(form.get("key", "").strip(), request.client.host if request.client else "")
        # `by_key` also accepts this process's own key, which belongs to no user
        if caller.key is None:
            raise NotSignedIn("This key cannot be used to sign in.")
    except NotSignedIn:
        said = "The key is unknown to this service, revoked or expired."
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


@sign_in_router.post("/sign-out", dependencies=[needs("reader")])
async def end(request: Request, caller: Asking, access: Callers) -> Response:
    """End a sign-in; the form carries its CSRF token."""
    cookie = request.cookies.get(COOKIE)
    answer = _go(request, "/sign-in")
    if cookie is not None and caller.csrf is not None:
        form = await _form(request)
        refuse_without_token(caller, request.headers.get("x-csrf-token", form.get("csrf", "")))
        await access.write(lambda session: sign_out(session, cookie))
        access.forget()
        answer.delete_cookie(COOKIE, path=_root(request) or "/", httponly=True, samesite="strict")
    return answer


async def _form(request: Request) -> dict[str, str]:
    """Return the fields of a form, the first value of each name.

    Raises:
        BadInput: There are more fields than any of our forms has.
    """
    try:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=FIELDS)
    except ValueError:
        raise BadInput("The form has more fields than this page has.") from None
    return {name: values[0] for name, values in fields.items()}


def _here(where: str) -> str:
    """Return a path of this service, else "/": a link must not redirect through the sign-in to another site."""
    return where if HERE.fullmatch(where) else "/"


def _root(request: Request) -> str:
    return str(request.scope.get("root_path", "")).rstrip("/")


def _go(request: Request, where: str) -> Response:
    return Response(status_code=303, headers={"Location": _root(request) + where, "Cache-Control": "no-store"})


def _is_secure(request: Request, settings: Settings) -> bool:
    """Return whether the cookie is restricted to TLS: always, except over plain HTTP on loopback."""
    by_tls = settings.tls_cert is not None or settings.tls_by_proxy or settings.beyond_loopback
    return by_tls or request.headers.get("origin", "").startswith("https://")
