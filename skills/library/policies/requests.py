"""Requests of trainings and of batches, all defaults resolved, and those of which stored policies are the results."""

from collections.abc import Collection, Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PlainSerializer, PlainValidator
from sqlalchemy import Select, Text, cast, select
from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion, Release
from skills.gridworld.hazards import Surroundings
from skills.learning.certificate import NearLimits, OddsLimits
from skills.learning.policy import LEARNER_VERSION, Learner, describe_learner, learner_of
from skills.library.operation.jobs import BATCH, TRAINING, JobRequest
from skills.library.policies.gate import GATE_VERSION
from skills.library.policies.releases import Style, is_served
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import CombineIn

ANY: Literal["any"] = "any"  # `outcomes` of a training from demonstrations of any outcome
# `joins` of a batch in which each style keeps the joining rule of its served policy
JOIN_AS_SERVED: Literal["as served"] = "as served"
POSES_VERSION = 1  # part of a training's identity: raise it when equal demonstrations give another pose style
ROWS_AT_ONCE = 1000  # of a query that reads many manifests, some 3 kB each


def _read_learner(given: Any) -> Learner:
    return learner_of(given) if isinstance(given, dict) else given


class LearningRequest(JobRequest):
    """The settings with which policies are learnt and checked; those that are None are left out of the digest."""

    learner: Annotated[Learner, PlainValidator(_read_learner), PlainSerializer(describe_learner)]
    # The versions are read when a request is made, so that a test can state others.
    learner_version: int = Field(default_factory=lambda: LEARNER_VERSION)
    gate: int = Field(default_factory=lambda: GATE_VERSION)
    poses: int = Field(default_factory=lambda: POSES_VERSION)
    near: NearLimits  # of the gate
    odds: OddsLimits | None = None  # of the gate in a scene
    seed: int = 0
    release: bool = False


class TrainingRequest(LearningRequest):
    """The request of a training's job; its digest is the identity of the training."""

    kind: ClassVar[str] = TRAINING

    surgeon: str
    suture: str
    demos: list[str]
    combine: CombineIn | None = None  # of several demonstrations
    outcomes: Literal["any"] | None = None
    depth_along: tuple[float, float, float] | None = None  # in a frame that is not the base of the arm
    surroundings: Surroundings | None = None


class RetrainingRequest(LearningRequest):
    """The request of a batch's job: the settings that its styles share, and the digest of what they are learnt from."""

    kind: ClassVar[str] = BATCH

    surgeon: str | None = None
    suture: str | None = None
    only_stale: bool
    joins: Literal["as served"] | None = None  # None where the request names a learner
    styles: int = 0
    demos_sha256: str | None = None
    after: str | None = None  # the equal batch whose styles serve something else now

    def training_of(self, style: tuple[str, str], demos: list[str], served: TrainingRequest | None) -> TrainingRequest:
        """Return the request for one style as `request_training` writes it, so that an equal training is recognised.

        Args:
            style: The surgeon and the suture type.
            demos: The digests of the demonstrations to learn from; several are combined as those of the served policy.
            served: The request of the policy that the style serves, whose scene is kept; None: it serves none.
        """
        shared = {name: getattr(self, name) for name in LearningRequest.model_fields}
        surroundings = None if served is None else served.surroundings
        return TrainingRequest(
            **shared | {"learner": self._learner(served), "odds": None if surroundings is None else self.odds},
            surgeon=style[0],
            suture=style[1],
            demos=demos,
            combine=served.combine if served is not None and len(demos) > 1 else None,
            surroundings=surroundings,
        )

    def _learner(self, served: TrainingRequest | None) -> Learner:
        """Return the learner of a style: unless the request names one, the served policy's joining rule is kept.

        A style that was learnt in a scene keeps its learner.
        """
        if served is None or self.joins != JOIN_AS_SERVED:
            return self.learner
        if served.surroundings is not None:
            return served.learner
        share = served.learner.join_share
        return learner_of(describe_learner(self.learner) | {"join_share": share}) if share else self.learner


def request_of(manifest: PolicyManifest) -> TrainingRequest:
    """Return the request of which a version is the result, at the versions of today, without a release."""
    near, scene = manifest.grid_certificate.near, manifest.scene
    return TrainingRequest(
        surgeon=manifest.surgeon,
        suture=manifest.suture,
        demos=manifest.demos,
        learner=manifest.learnt_with,
        near=NearLimits(near.radius_mm, near.least_share),
        odds=None if scene is None else OddsLimits(scene.near.least_finishing, scene.near.most_touching),
        seed=manifest.seed,
        combine=None if manifest.combined is None else CombineIn(kind=manifest.combined.kind),
        outcomes=None if manifest.outcomes is None else ANY,
        depth_along=None if manifest.ties is None else manifest.ties.depth_along,
        surroundings=manifest.surroundings,
    )


def requests_of_served(session: Session, surgeons: Collection[int] | None = None) -> dict[Style, TrainingRequest]:
    """Return the requests of all served policies, by style, with one statement.

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
        (who, suture): request_of(PolicyManifest.model_validate_json(text))
        for who, suture, text in in_pieces(session, query)
    }


def in_pieces(session: Session, query: Select[*tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the rows of a query that may return very many, without having all of them in memory."""
    yield from session.execute(query, execution_options={"yield_per": ROWS_AT_ONCE})
