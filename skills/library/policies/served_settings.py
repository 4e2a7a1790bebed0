"""Settings of served policies that a batch trains again with: combination, joining rule and scene."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import orjson
from sqlalchemy import Select, Text, cast, exists, func, select
from sqlalchemy.orm import Session

from skills.comparison.combining import Combining
from skills.db.models import PolicyDemonstration, PolicyVersion, Release
from skills.library.operation.jobs import KEPT, RetrainingRequest
from skills.library.policies.combined import combining_of
from skills.library.policies.releases import is_served

ROWS_AT_ONCE = 1000  # of a query that reads many manifests, some 3 kB each


@dataclass(frozen=True)
class Recipe:
    """The number of demonstrations of a style's served policy, and the way they were combined."""

    demos: int
    how: Combining


def recipes_of(session: Session, surgeons: Collection[int] | None = None) -> dict[tuple[int, str], Recipe]:
    """Return, with one statement, the recipes of the styles that serve a policy of several demonstrations.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.

    Returns:
        By style: a surgeon's row and a suture type.
    """
    if surgeons is not None and not surgeons:
        return {}
    by, other = PolicyVersion, PolicyDemonstration
    kind = by.manifest["combined"]["kind"].as_string()
    mine = other.policy_row == by.row
    others = select(func.count()).select_from(other).where(mine).correlate(by).scalar_subquery()
    several = exists().where(mine).correlate(by)
    query = select(Release.surgeon_row, Release.suture, kind, others).join(by, by.row == Release.policy_row)
    query = query.where(is_served(), several)
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    found = session.execute(query)
    return {(who, suture): Recipe(more + 1, combining_of({"kind": how})) for who, suture, how, more in found}


@dataclass(frozen=True)
class LearntIn:
    """The scene that a served policy was learnt in, its digest, and the learner, as JSON."""

    sha256: str
    surroundings: dict[str, Any]
    learner: dict[str, Any]


@dataclass
class Kept:
    """The properties of served policies that a batch keeps, by style: a surgeon's row and a suture type.

    A style has no rule if its policy joins at the nearest waypoint, and no scene if it was learnt in none.
    """

    rules: dict[tuple[int, str], float] = field(default_factory=dict)
    scenes: dict[tuple[int, str], LearntIn] = field(default_factory=dict)


def kept_of(session: Session, surgeons: Collection[int] | None = None) -> Kept:
    """Return the joining rules and the scenes of the styles that serve a policy.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.
    """
    kept = Kept()
    if surgeons is not None and not surgeons:
        return kept
    by = PolicyVersion
    query = select(Release.surgeon_row, Release.suture, cast(by.manifest, Text)).join(by, by.row == Release.policy_row)
    query = query.where(is_served())
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    for who, suture, text in in_pieces(session, query):
        about = orjson.loads(text)
        scene, settings = about.get("scene"), about["settings"]
        if share := settings.get("join_share"):
            kept.rules[who, suture] = share
        if scene is not None:
            surroundings = {name: scene[name] for name in ("scene", "costs")}
            kept.scenes[who, suture] = LearntIn(scene["sha256"], surroundings, {"kind": about["learner"], **settings})
    return kept


def in_pieces(session: Session, query: Select[*tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the rows of a query that may return very many, without having all of them in memory.

    Columns of JSON are requested as text, and parsed here: the databases parse them anew for each part of them.
    """
    yield from session.execute(query, execution_options={"yield_per": ROWS_AT_ONCE})


def learner_kept(asked: RetrainingRequest, rule: float | None, there: LearntIn | None) -> dict[str, Any]:
    """Return the JSON of the learner by which a batch learns a style.

    Args:
        asked: The batch. If it names no learner, a style keeps what the following say.
        rule: The joining rule of the policy that the style serves; None: the nearest waypoint.
        there: The scene that this policy was learnt in; None: none.
    """
    if asked["joins"] != KEPT:
        return asked["learner"]
    by_rule = asked["learner"] if rule is None else asked["learner"] | {"join_share": rule}
    return by_rule if there is None else there.learner
