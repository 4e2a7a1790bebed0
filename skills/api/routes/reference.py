"""The calls for a person to read; the page needs nothing from outside."""

from fastapi import APIRouter, Request, Response

from skills.api.access import open_to_all
from skills.api.documented import REFUSALS
from skills.api.pages.page import render
from skills.api.pages.reference import models, operations
from skills.settings import MEBIBYTE

router = APIRouter(include_in_schema=False, max_body_size=MEBIBYTE)


@router.get("/docs", dependencies=[open_to_all()])
def show_reference(request: Request) -> Response:
    """Show what /openapi.json says: every call, and every model."""
    document = request.app.openapi()
    return render(
        request,
        "reference.html",
        None,
        about=document["info"],
        operations=operations(document),
        models=models(document),
        known=[*document["components"]["schemas"]],
        refusals=REFUSALS,
    )
