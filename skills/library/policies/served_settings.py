"""Settings of served policies with which a batch trains their styles again: learner, scene and combination."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, Text, cast, select
from sqlalchemy.orm import Session

from skills.comparison.combining import Combining
from skills.db.models import PolicyVersion, Release
from skills.gridworld.hazards import Surroundings
from skills.learning.policy import describe_learner
from skills.library.operation.jobs import JOIN_AS_SERVED, RetrainingRequest
from skills.library.policies.outcomes import Style
from skills.library.policies.releases import is_served
from skills.schemas.policies import PolicyManifest

ROWS_AT_ONCE = 1000  # of a query that reads many manifests, some 3 kB each


@dataclass(frozen=True)
class ServedSettings:
    """The settings of a served policy that a batch keeps.

    Attributes:
        learner: The learner as JSON.
        join_share: Its joining rule; None: the nearest waypoint.
        surroundings: The scene that the policy was learnt in, with its costs; None for none.
        demos: The number of its demonstrations.
        combining: The way that several ones were combined; None for one.
    """

    learner: dict[str, Any]
    join_share: float | None
    surroundings: Surroundings | None
    demos: int
    combining: Combining | None

    @classmethod
    def of(cls, manifest: PolicyManifest) -> "ServedSettings":
        """Return the settings that a manifest states."""
        learner = manifest.learnt_with
        return cls(
            learner=describe_learner(learner),
            join_share=learner.join_share or None,
            surroundings=manifest.surroundings,
            demos=len(manifest.demos),
            combining=None if manifest.combined is None else manifest.combined.kind,
        )


def settings_of_served(session: Session, surgeons: Collection[int] | None = None) -> dict[Style, ServedSettings]:
    """Return the settings of all served policies, by style, with one statement.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.
    """
    by = PolicyVersion
    query = select(Release.surgeon_row, Release.suture, cast(by.manifest, Text)).join(by, by.row == Release.policy_row)
    query = query.where(is_served())
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    return {
        (who, suture): ServedSettings.of(PolicyManifest.model_validate_json(text))
        for who, suture, text in in_pieces(session, query)
    }


def in_pieces(session: Session, query: Select[*tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the rows of a query that may return very many, without having all of them in memory."""
    yield from session.execute(query, execution_options={"yield_per": ROWS_AT_ONCE})


def learner_for(request: RetrainingRequest, served: ServedSettings | None) -> dict[str, Any]:
    """Return the JSON of the learner by which a batch learns a style.

    Args:
        request: The batch. If it names no learner, a style that serves a policy keeps its joining rule, and the learner
            of one that was learnt in a scene.
        served: The settings of the policy that the style serves; None: it serves none.
    """
    if served is None or request["joins"] != JOIN_AS_SERVED:
        return request["learner"]
    if served.surroundings is not None:
        return served.learner
    return request["learner"] | ({} if served.join_share is None else {"join_share": served.join_share})
