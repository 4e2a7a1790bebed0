"""Routes of health, readiness and metrics, the reference page of the calls, and signing in to the pages and out."""

import re
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import AwareDatetime

from skills.api.authentication import COOKIE, Access, refuse_without_token
from skills.api.authorisation import Asking, needs, open_to_all
from skills.api.dependencies import Configured, Db
from skills.api.metrics import CONTENT_TYPE, ServiceMetrics
from skills.api.openapi import router_of, says
from skills.api.pages import render
from skills.api.responses import say
from skills.errors import BadInput, NotSignedIn
from skills.jobs.readiness import refuse_unready
from skills.library.operation.proofs import checkpoint_json, served_json
from skills.library.people.sign_ins import sign_in, sign_out
from skills.sandbox.containment import LAYERS
from skills.sandbox.forked import layers_held
from skills.schemas.given import Alive, Ready, ServedAt, SignedCheckpoint
from skills.schemas.requests import SLUG
from skills.settings import MEBIBYTE, Settings

router = router_of(tags=["operating"])
FORM_BYTES, FIELDS = 4096, 4
HERE = re.compile(r"/(?![/\\])[^\\\x00-\x20\x7f]*")  # a path of this service, never the URL of another

sign_in_router = APIRouter(include_in_schema=False, max_body_size=FORM_BYTES)

Next = Annotated[str, Query(max_length=2000)]


@router.get("/healthz", dependencies=[open_to_all()], **says(Alive))
def alive() -> Response:
    """Report that the process answers requests."""
    return say({"status": "ok", "use": "research use only"})


@router.get("/readyz", dependencies=[needs("reader", whole=True)], **says(Ready))
def ready(request: Request) -> Response:
    """Check the database, the job queue and its workers; 503 with the name of the one that cannot be used.

    `containment` has the layers that contain readers, simulators and learners, and whether this system offers each.
    """
    settings: Settings = request.app.state.settings
    workers, held = refuse_unready(settings), layers_held()
    return say({"status": "ready", "workers": workers, "containment": {name: name in held for name in LAYERS}})


@router.get("/history", dependencies=[needs("reader")], **says(ServedAt, 404, 410))
def served_at(
    db: Db,
    surgeon: Annotated[str, Query(pattern=SLUG)],
    suture: Annotated[str, Query(pattern=SLUG)],
    at: Annotated[AwareDatetime, Query(description="A moment with its zone, such as 2026-01-31T12:00:00Z.")],
) -> Response:
    """Return the version of a style that was served at a time, with proofs that need no trust in this service."""
    with db.reading() as session:
        return say(served_json(session, db.history, surgeon, suture, at))


@router.get("/history/checkpoint", dependencies=[needs("reader")], **says(SignedCheckpoint))
def newest_head(db: Db) -> Response:
    """Return the newest signed checkpoint of the history, to be kept elsewhere."""
    with db.reading() as session:
        return say(checkpoint_json(session.connection(), db.history))


@router.get("/metrics", dependencies=[needs("reader", whole=True)], response_class=PlainTextResponse)
def metrics(request: Request) -> Response:
    """Return the metrics of this process and of the installation for Prometheus."""
    figures: ServiceMetrics = request.app.state.metrics
    return Response(figures.text(), media_type=CONTENT_TYPE)


reference_router = APIRouter(include_in_schema=False, max_body_size=MEBIBYTE)


@reference_router.get("/docs", dependencies=[open_to_all()])
def show_reference(request: Request) -> Response:
    """Show the calls of /openapi.json as a page on which they can be tried out."""
    return render(request, "reference.html", None)


# ---- signing in to the pages with a key ----------------------------------------------------------------------------


@sign_in_router.get("/sign-in", dependencies=[open_to_all()])
def show_sign_in(request: Request, next: Next = "/") -> Response:
    """Show the form that takes a key."""
    return render(request, "sign_in.html", None, next=_here(next), wrong=None)


@sign_in_router.post("/sign-in", dependencies=[open_to_all()])
async def begin(request: Request, settings: Configured) -> Response:
    """Exchange a key for a session cookie."""
    form = await _form(request)
    access: Access = request.app.state.access
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
async def end(request: Request, caller: Asking) -> Response:
    """End a sign-in; the form carries its CSRF token."""
    cookie = request.cookies.get(COOKIE)
    answer = _go(request, "/sign-in")
    if cookie is not None and caller.csrf is not None:
        form = await _form(request)
        refuse_without_token(caller, request.headers.get("x-csrf-token", form.get("csrf", "")))
        access: Access = request.app.state.access
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
