"""Surgeons and suture types."""

from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response

from skills.api.access import needs
from skills.api.conditions import Condition, refuse_changed
from skills.api.deps import Actor, Db, Jobs, Limit, Slug, SlugCursor
from skills.api.documented import ends, gives, gives_page, makes
from skills.api.replies import Giving, stored
from skills.api.schemas.given import Page, Surgeon, SutureType
from skills.api.schemas.sent import SurgeonIn, SutureTypeIn
from skills.api.schemas.written import surgeon_out, suture_out
from skills.api.strict import Strict
from skills.library import catalogue, erasure
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["catalogue"], max_body_size=MEBIBYTE)

Search = Annotated[str | None, Query(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+$")]
SkillLevel = Literal["novice", "intermediate", "expert"]


@router.put("/surgeons/{surgeon}", dependencies=[needs("admin")], **makes(Surgeon, 410, 412))
def put_surgeon(
    surgeon: Slug, body: SurgeonIn, db: Db, actor: Actor, if_match: Condition = None, if_none_match: Condition = None
) -> Response:
    """Write a surgeon whole, under a pseudonym."""
    with db.writing() as session:
        if if_match or if_none_match:
            known = catalogue.known_surgeon(session, surgeon)
            refuse_changed(known and surgeon_out(known), if_match, if_none_match)
        row, created = catalogue.put_surgeon(session, surgeon, body.model_dump(mode="json"), actor)
        return stored(surgeon_out(row), created, f"/surgeons/{surgeon}")


@router.get("/surgeons", dependencies=[needs("reader")], **gives_page(Page[Surgeon]))
def list_surgeons(
    db: Db,
    give: Giving,
    search: Search = None,
    skill_level: SkillLevel | None = None,
    limit: Limit = 50,
    cursor: SlugCursor = None,
) -> Response:
    """List the surgeons by pseudonym, all or those in whose pseudonym the search is found."""
    with db.reading() as session:
        found = catalogue.list_surgeons(session, limit, cursor, search, skill_level)
        return give.page([surgeon_out(row) for row in found], limit, found[-1].slug if found else None)


@router.get("/surgeons/{surgeon}", dependencies=[needs("reader")], **gives(Surgeon, 404, 410))
def get_surgeon(surgeon: Slug, db: Db, give: Giving) -> Response:
    """Look a surgeon up."""
    with db.reading() as session:
        return give(surgeon_out(catalogue.find_surgeon(session, surgeon)))


@router.delete("/surgeons/{surgeon}", dependencies=[needs("admin")], **ends(404, 410, 412))
def erase_surgeon(surgeon: Slug, db: Db, jobs: Jobs, actor: Actor, if_match: Condition = None) -> None:
    """Erase a surgeon and everything derived from them, for good."""
    with db.writing() as session:
        if if_match:
            refuse_changed(surgeon_out(catalogue.find_surgeon(session, surgeon)), if_match)
        dropped = [(job.row, job.attempt) for job in erasure.erase_surgeon(session, surgeon, actor)]
    db.forget()
    for row, attempt in dropped:
        jobs.cancel(row, attempt)


@router.put("/suture-types/{suture}", dependencies=[needs("admin")], **makes(SutureType, 412))
def put_suture_type(
    suture: Slug, body: SutureTypeIn, db: Db, actor: Actor, if_match: Condition = None, if_none_match: Condition = None
) -> Response:
    """Write a suture type whole."""
    with db.writing() as session:
        if if_match or if_none_match:
            known = catalogue.known_suture_type(session, suture)
            refuse_changed(known and suture_out(known), if_match, if_none_match)
        row, created = catalogue.put_suture_type(session, suture, body.model_dump(), actor)
        return stored(suture_out(row), created, f"/suture-types/{suture}")


@router.get("/suture-types", dependencies=[needs("reader")], **gives_page(Page[SutureType]))
def list_suture_types(
    db: Db, give: Giving, search: Search = None, limit: Limit = 50, cursor: SlugCursor = None
) -> Response:
    """List the suture types, all or those in whose name, family or slug the search is found."""
    with db.reading() as session:
        found = catalogue.list_suture_types(session, limit, cursor, search)
        return give.page([suture_out(row) for row in found], limit, found[-1].slug if found else None)


@router.get("/suture-types/{suture}", dependencies=[needs("reader")], **gives(SutureType, 404))
def get_suture_type(suture: Slug, db: Db, give: Giving) -> Response:
    """Look a suture type up."""
    with db.reading() as session:
        return give(suture_out(catalogue.find_suture_type(session, suture)))
