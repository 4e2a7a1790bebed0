"""The policy card of a version, as JSON or as one HTML file, from verified values alone."""

import orjson
from fastapi import APIRouter, Response

from skills.api.access import needs
from skills.api.conditions import Condition, names, tag_of
from skills.api.deps import Db, Digest, Slug
from skills.api.documented import gives
from skills.api.pages.card import HEADERS, card_page
from skills.api.pages.wanted import HTML, JSON, wants_page
from skills.api.routes.policies import Accept, Version
from skills.api.schemas.given import PolicyCard
from skills.library import policies
from skills.library.cards import Card, card_of
from skills.settings import MEBIBYTE

router = APIRouter(tags=["policies"], max_body_size=MEBIBYTE)


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}/card",
    dependencies=[needs("reader")],
    **gives(PolicyCard, 404, 410, 415, as_well=(HTML,)),
)
def get_policy_card(
    surgeon: Slug, suture: Slug, version: Version, db: Db, accept: Accept = "*/*", if_none_match: Condition = None
) -> Response:
    """Give the card of one version of a style: JSON, or with `Accept: text/html` one file to attach to a paper.

    It says whether the version is released now and what rests on it, so its ETag changes with these.
    """
    as_page = wants_page(accept, "A policy card")
    with db.reading() as session:
        card = card_of(session, policies.find_version(session, surgeon, suture, version))
    return _answer(card, as_page, if_none_match)


@router.get(
    "/policy-versions/{policy}/card",
    dependencies=[needs("reader")],
    **gives(PolicyCard, 404, 415, as_well=(HTML,)),
)
def get_policy_version_card(
    policy: Digest, db: Db, accept: Accept = "*/*", if_none_match: Condition = None
) -> Response:
    """Give the card of a policy version by its digest, as it is cited."""
    as_page = wants_page(accept, "A policy card")
    with db.reading() as session:
        card = card_of(session, policies.find_by_digest(session, policy))
    return _answer(card, as_page, if_none_match)


def _answer(card: Card, as_page: bool, if_none_match: str | None) -> Response:
    content = card_page(card).encode() if as_page else orjson.dumps(card.facts, option=orjson.OPT_INDENT_2)
    tag, told = tag_of(content), card.facts["policy"]
    name = f"{told['surgeon']}-{told['suture']}-v{told['version']}-card.{'html' if as_page else 'json'}"
    headers = {
        "ETag": tag,
        "Vary": "Accept",
        "Cache-Control": "no-cache",
        "Content-Disposition": f'inline; filename="{name}"',  # so that it is saved under a name that says what it is
        **(HEADERS if as_page else {}),
    }
    if if_none_match is not None and names(if_none_match, tag):
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=HTML if as_page else JSON)
