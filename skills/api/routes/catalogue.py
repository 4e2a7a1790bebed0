"""Surgeons and suture types."""

from typing import Any

from fastapi import APIRouter, Response

from skills.api.deps import Actor, Db, Jobs, Limit, Slug, SlugCursor, page
from skills.api.schemas import SurgeonIn, SutureTypeIn, surgeon_out, suture_out
from skills.library import catalogue, erasure
from skills.settings import MEBIBYTE

router = APIRouter(tags=["catalogue"], max_body_size=MEBIBYTE)


@router.put("/surgeons/{surgeon}", responses={201: {}})
def put_surgeon(surgeon: Slug, body: SurgeonIn, db: Db, actor: Actor, response: Response) -> dict[str, Any]:
    """Write a surgeon whole, under a pseudonym."""
    with db.writing() as session:
        row, created = catalogue.put_surgeon(session, surgeon, body.model_dump(mode="json"), actor)
        response.status_code = 201 if created else 200
        return surgeon_out(row)


@router.get("/surgeons")
def list_surgeons(db: Db, limit: Limit = 50, cursor: SlugCursor = None) -> dict[str, Any]:
    """List the surgeons."""
    with db.reading() as session:
        found = [surgeon_out(row) for row in catalogue.list_surgeons(session, limit, cursor)]
        return page(found, limit, found[-1]["surgeon"] if found else None)


@router.get("/surgeons/{surgeon}")
def get_surgeon(surgeon: Slug, db: Db) -> dict[str, Any]:
    """Look a surgeon up."""
    with db.reading() as session:
        return surgeon_out(catalogue.find_surgeon(session, surgeon))


@router.delete("/surgeons/{surgeon}", status_code=204)
def erase_surgeon(surgeon: Slug, db: Db, jobs: Jobs, actor: Actor) -> None:
    """Erase a surgeon and everything derived from them, for good."""
    with db.writing() as session:
        dropped = [(job.row, job.attempt) for job in erasure.erase_surgeon(session, surgeon, actor)]
    db.forget()
    for row, attempt in dropped:
        jobs.cancel(row, attempt)


@router.put("/suture-types/{suture}", responses={201: {}})
def put_suture_type(suture: Slug, body: SutureTypeIn, db: Db, actor: Actor, response: Response) -> dict[str, Any]:
    """Write a suture type whole."""
    with db.writing() as session:
        row, created = catalogue.put_suture_type(session, suture, body.model_dump(), actor)
        response.status_code = 201 if created else 200
        return suture_out(row)


@router.get("/suture-types")
def list_suture_types(db: Db, limit: Limit = 50, cursor: SlugCursor = None) -> dict[str, Any]:
    """List the suture types."""
    with db.reading() as session:
        found = [suture_out(row) for row in catalogue.list_suture_types(session, limit, cursor)]
        return page(found, limit, found[-1]["suture"] if found else None)


@router.get("/suture-types/{suture}")
def get_suture_type(suture: Slug, db: Db) -> dict[str, Any]:
    """Look a suture type up."""
    with db.reading() as session:
        return suture_out(catalogue.find_suture_type(session, suture))
