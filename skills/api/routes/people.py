"""Routes of surgeons, suture types and API keys. An installation's first key is created by `skills keys create`."""

from typing import Annotated

from fastapi import Path, Query, Response

from skills.api.dependencies import Actor, Callers, Db, Jobs, ListingByRow, ListingBySlug, Slug
from skills.api.openapi import ends, gives, makes, router_of, says
from skills.api.responses import Conditional, Giving, IfMatch, say, stored
from skills.library.operation import locks
from skills.library.operation.sweep import drop_contents, sweep_erased
from skills.library.people import erasure, surgeons, suture_types
from skills.library.people.keys import about_key, create_key, list_keys, revoke_key
from skills.schemas import Page, SkillLevel
from skills.schemas.people import Key, KeyIn, NewKey, Surgeon, SurgeonIn, SutureType, SutureTypeIn
from skills.schemas.requests import KEY, LINE

router = router_of("catalogue")

Search = Annotated[str | None, Query(min_length=1, max_length=64, pattern=LINE)]


@router.put("/surgeons/{surgeon}", **makes("admin", Surgeon, 410, 412))
def put_surgeon(surgeon: Slug, body: SurgeonIn, db: Db, actor: Actor, conditions: Conditional) -> Response:
    """Create or replace a surgeon under a pseudonym; fields that are left out are cleared."""
    with db.reading() as session:  # a change may withdraw a consent
        write = db.writing if surgeons.known_surgeon(session, surgeon) is None else db.ending
    with write([locks.surgeon(surgeon)]) as session:
        known = surgeons.known_surgeon(session, surgeon)
        conditions.refuse_changed(known and Surgeon.model_validate(known))
        row, created = surgeons.put_surgeon(session, surgeon, body, actor)
        return stored(Surgeon.model_validate(row), created, f"/surgeons/{surgeon}")


@router.get("/surgeons", **gives("reader", Page[Surgeon]))
def list_surgeons(
    db: Db, listing: ListingBySlug, search: Search = None, skill_level: SkillLevel | None = None
) -> Response:
    """List the surgeons in the order of their pseudonyms: all, or those whose pseudonym contains the search."""
    with db.reading() as session:
        found = surgeons.list_surgeons(session, listing.limit, listing.cursor, search, skill_level)
        return listing.page([Surgeon.model_validate(row) for row in found], found, by="slug")


@router.get("/surgeons/{surgeon}", **gives("reader", Surgeon, 404, 410))
def get_surgeon(surgeon: Slug, db: Db, give: Giving) -> Response:
    """Return a surgeon."""
    with db.reading() as session:
        return give(Surgeon.model_validate(surgeons.find_surgeon(session, surgeon)))


@router.delete("/surgeons/{surgeon}", **ends("admin", 404, 410, 412))
def erase_surgeon(surgeon: Slug, db: Db, jobs: Jobs, actor: Actor, conditions: IfMatch) -> None:
    """Erase a surgeon and everything derived from their data, permanently."""
    with db.reading() as session:
        found = surgeons.find_surgeon(session, surgeon)
        conditions.refuse_changed(Surgeon.model_validate(found))
        recordings = erasure.erased_with(session, found)
    drop_contents(db, recordings)
    with db.ending() as session:
        conditions.refuse_changed(Surgeon.model_validate(surgeons.find_surgeon(session, surgeon)))
        dropped = erasure.erase_surgeon(session, surgeon, actor)
    sweep_erased(db)
    # after the commit, because one transaction cannot span our database and the engine's
    for row, attempt in dropped:
        jobs.cancel(row, attempt)


@router.put("/suture-types/{suture}", **makes("admin", SutureType, 412))
def put_suture_type(suture: Slug, body: SutureTypeIn, db: Db, actor: Actor, conditions: Conditional) -> Response:
    """Create or replace a suture type; fields that are left out get their defaults."""
    with db.writing() as session:
        known = suture_types.known_suture_type(session, suture)
        conditions.refuse_changed(known and SutureType.model_validate(known))
        row, created = suture_types.put_suture_type(session, suture, body, actor)
        return stored(SutureType.model_validate(row), created, f"/suture-types/{suture}")


@router.get("/suture-types", **gives("reader", Page[SutureType]))
def list_suture_types(db: Db, listing: ListingBySlug, search: Search = None) -> Response:
    """List the suture types: all, or those whose name, family or slug contains the search."""
    with db.reading() as session:
        found = suture_types.list_suture_types(session, listing.limit, listing.cursor, search)
        return listing.page([SutureType.model_validate(row) for row in found], found, by="slug")


@router.get("/suture-types/{suture}", **gives("reader", SutureType, 404))
def get_suture_type(suture: Slug, db: Db, give: Giving) -> Response:
    """Return a suture type."""
    with db.reading() as session:
        return give(SutureType.model_validate(suture_types.find_suture_type(session, suture)))


key_router = router_of("keys")

KeyId = Annotated[str, Path(pattern=KEY)]


@key_router.get("/keys", **gives("admin", Page[Key]))
def list_all_keys(db: Db, listing: ListingByRow) -> Response:
    """List all keys, including those that were revoked or have expired."""
    with db.reading() as session:
        found = list_keys(session, listing.limit, listing.cursor)
        return listing.page([about_key(key) for key in found], found)


@key_router.post("/keys", **makes("admin", NewKey, 404, 410, located=False))
def make_key(body: KeyIn, db: Db, actor: Actor, callers: Callers) -> Response:
    """Create a key; only this response ever contains its secret."""
    with db.writing() as session:
        key, secret = create_key(
            session, body.owner, body.role, actor, expires_at=body.expires_at, surgeons=body.surgeons
        )
        made = NewKey(**vars(about_key(key)), secret=secret)
    callers.forget()
    return say(made, 201, {"Cache-Control": "no-store"})  # no cache may store the secret


@key_router.delete("/keys/{key}", **says("admin", Key, 404))
def end_key(key: KeyId, db: Db, actor: Actor, callers: Callers) -> Response:
    """Revoke a key permanently: it is refused from now on, and sign-ins with it end."""
    with db.ending() as session:
        revoked = about_key(revoke_key(session, key, actor))
    callers.forget()
    return say(revoked)
