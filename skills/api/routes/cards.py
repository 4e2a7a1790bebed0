"""Routes of policy cards: the JSON or HTML description of a version, built from verified values only."""

import hashlib
from collections.abc import Callable

from fastapi import Response
from sqlalchemy.orm import Session

from skills.api.dependencies import Accept, Db, Digest, Slug, Version
from skills.api.openapi import gives, router_of
from skills.api.pages import standalone_headers
from skills.api.pages.drawings import card_page
from skills.api.responses import HTML, JSON, Give, Giving, json_of, negotiate
from skills.db.models import PolicyVersion
from skills.db.session import Database
from skills.library.operation.proofs import head_over, sign_files
from skills.library.policies import versions
from skills.library.policies.cards import Card, card_of
from skills.schemas.cards import PolicyCard
from skills.transparency.notes import read_notes
from skills.transparency.statements import SignedEnvelope

router = router_of("policies")


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}/card",
    **gives("reader", PolicyCard, 404, 409, 410, 415, as_well=(HTML,)),
)
def get_policy_card(surgeon: Slug, suture: Slug, version: Version, db: Db, give: Giving, accept: Accept) -> Response:
    """Return the policy card of a version: JSON, or with `Accept: text/html` one file to attach to a paper.

    It states whether the version is released now and what rests on it, so its ETag changes with these.
    """
    as_page = _as_page(accept)
    find = versions.choose if as_page else versions.find_version
    return _answer(give, _card(db, lambda session: find(session, surgeon, suture, version)), as_page)


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}/card/signature", **gives("reader", SignedEnvelope, 404, 410)
)
def get_policy_card_signature(surgeon: Slug, suture: Slug, version: Version, db: Db, give: Giving) -> Response:
    """Return this service's signature of the policy card of a version as it is now: of its JSON and of its page."""
    card = _card(db, lambda session: versions.find_version(session, surgeon, suture, version))
    assert card.facts.history is not None
    (head,) = read_notes(card.facts.history.note)
    files = {"card.json": _content(card, as_page=False), "card.html": _content(card, as_page=True)}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    policy = card.facts.policy.sha256
    facts = {"surgeon": surgeon, "suture": suture, "version": version, "policy": policy}
    return give.bytes(sign_files(db.history, head, digests, kind="card", **facts), JSON)


@router.get("/policy-versions/{policy}/card", **gives("reader", PolicyCard, 404, 409, 415, as_well=(HTML,)))
def get_policy_version_card(policy: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return the policy card of a version by the digest under which it is cited."""
    as_page = _as_page(accept)
    checked = versions.followable if as_page else lambda version: version
    return _answer(give, _card(db, lambda session: checked(versions.find_by_digest(session, policy))), as_page)


def _as_page(accept: str) -> bool:
    return negotiate(accept, "A policy card", JSON, HTML) == HTML


def _card(db: Database, find: Callable[[Session], PolicyVersion]) -> Card:
    with db.reading() as session:
        version = find(session)
        card, row = card_of(session, version), version.row
    return card.under(head_over(db, [("policy_versions", row)]))


def _content(card: Card, *, as_page: bool) -> bytes:
    return card_page(card).encode() if as_page else json_of(card.facts, indented=True)


def _answer(give: Give, card: Card, as_page: bool) -> Response:
    policy, kind = card.facts.policy, "html" if as_page else "json"
    answer = give.bytes(_content(card, as_page=as_page), HTML if as_page else JSON)
    name = f"{policy.surgeon}-{policy.suture}-v{policy.version}-card.{kind}"
    answer.headers["Content-Disposition"] = f'inline; filename="{name}"'  # the name under which a browser saves it
    if as_page:
        answer.headers.update(standalone_headers("card"))
    return answer
