"""Keys, for admins; an installation's first key is made by `skills keys create`."""

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from skills.api.access import needs
from skills.api.deps import Actor, Db, Limit, RowCursor
from skills.api.documented import gives_page, makes, says
from skills.api.replies import Giving, say
from skills.api.schemas.given import Key, NewKey, Page
from skills.api.schemas.sent import KeyIn
from skills.api.strict import Strict
from skills.library.keys import about_key, create_key, list_keys, revoke_key
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["keys"], max_body_size=MEBIBYTE)

KeyId = Annotated[str, Path(pattern=r"^[0-9a-f]{8}$")]


@router.get("/keys", dependencies=[needs("admin")], **gives_page(Page[Key]))
def list_all_keys(db: Db, give: Giving, limit: Limit = 50, cursor: RowCursor = None) -> Response:
    """List all keys, also those that do not count any more."""
    with db.reading() as session:
        found = list_keys(session, limit, cursor)
        return give.page([about_key(key) for key in found], limit, found[-1].row if found else None)


@router.post("/keys", dependencies=[needs("admin")], **makes(NewKey, 404, 410, located=False))
def make_key(body: KeyIn, db: Db, actor: Actor, request: Request) -> Response:
    """Make a key; the answer is the only place where it is ever shown."""
    with db.writing() as session:
        key, text = create_key(
            session, body.owner, body.role, actor, expires_at=body.expires_at, surgeons=body.surgeons
        )
        made = about_key(key) | {"secret": text}
    request.app.state.access.forget()
    return say(made, 201, {"Cache-Control": "no-store"})


@router.delete("/keys/{key}", dependencies=[needs("admin")], **says(Key, 404))
def end_key(key: KeyId, db: Db, actor: Actor, request: Request) -> Response:
    """Revoke a key, for good: it lets nobody in any more, and ends what was signed in with it."""
    with db.writing() as session:
        revoked = about_key(revoke_key(session, key, actor))
    request.app.state.access.forget()
    return say(revoked)
