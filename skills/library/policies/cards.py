"""The policy card: a document on one policy version, to attach to a paper.

    PolicyVersion --card_of--> Card: its facts (`skills.schemas.policies`), and the values of its pictures

A card is written from verified values alone: before it is written, every digest on it is computed again, that of the
recording over its bytes. It holds neither the time of the request nor the caller's name: the same state gives the same
bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills import __version__
from skills.comparison.combining import Combined
from skills.db.models import Demonstration, Plan, PolicyVersion, Release, StoredPlayback, StoredRewardMap, Surgeon
from skills.db.packed import digest
from skills.demonstration.demonstration import Demo
from skills.errors import Corrupt
from skills.gridworld.domain import REACH
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import Coverage
from skills.library.operation.inspection import AGREES
from skills.library.operation.integrity import covered, learnt, what_identifies
from skills.library.people import consent
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import card_words as words
from skills.library.policies import releases
from skills.library.policies.card_words import sentence, sentences
from skills.library.policies.combined import learnt_from
from skills.library.recordings.reports import full_report
from skills.remedies import Action, Remedy
from skills.schemas import PolicyName
from skills.schemas.cards import (
    CardCombined,
    CardCoverage,
    CardDemonstration,
    CardHistory,
    CardLearner,
    CardLimits,
    CardLineage,
    CardLink,
    CardMetric,
    CardPolicy,
    CardRecording,
    CardRelease,
    CardStatus,
    CardSurgeon,
    PolicyCard,
    RestingOnIt,
    StartCounts,
    StartLayer,
    StartShares,
    TipErrors,
)
from skills.schemas.people import SutureType
from skills.transparency.notes import Note
from skills.verification.arm_errors import CALIBRATED_MM, UNCALIBRATED_MM

FORMAT = 1  # of the JSON: raise it when a field is removed or changes its meaning


@dataclass(frozen=True, eq=False)
class Card:
    """The facts of a policy version, and the demonstration, path and coverage that its pictures are drawn from.

    The ETag is the digest of exactly the bytes of `facts`.
    """

    facts: PolicyCard
    demo: Demo
    path: GridPath
    coverage: Coverage
    combined: Combined | None

    def under(self, head: Note) -> "Card":
        """Return the card with a checkpoint of the history on it."""
        signed = head.checkpoint
        history = CardHistory(origin=signed.origin, size=signed.size, root=signed.root.hex(), note=head.text)
        return replace(self, facts=self.facts.model_copy(update={"history": history}))


def card_of(session: Session, version: PolicyVersion) -> Card:
    """Return the card of a policy version.

    Raises:
        Corrupt: A value on the card, or one that the version was derived from, does not match its digest.
    """
    demonstrations = version.demonstrations
    of_them = StoredRewardMap.demonstration_row.in_([one.row for one in demonstrations])
    rewards = session.scalars(select(StoredRewardMap).where(of_them)).all()
    released = session.scalars(select(Release).where(Release.policy_row == version.row).order_by(Release.row)).all()
    recordings = {one.recording.row: one.recording for one in demonstrations}.values()
    # First, so that no fact is taken from a damaged row.
    _refuse_damaged([*recordings, *demonstrations, *rewards, version, *released])
    coverage, learnt_path, combined = covered(version), learnt_from(version), _combined(version)
    facts = PolicyCard.model_construct(  # without the checkpoint of the history, see `Card.under`
        format=FORMAT,
        written_by=f"suture-skills {__version__}",
        title=f"{version.surgeon.slug}, {version.suture}, version {version.version}",
        use=words.USE,
        what_it_is=sentences("introduction", len(demonstrations), combined and combined.in_words),
        what_it_is_not=words.IS_NOT,
        policy=_policy(version),
        status=_status(session, version, released),
        surgeon=_surgeon(version.surgeon),
        suture_type=SutureType.model_validate(find_suture_type(session, version.suture)),
        demonstrations=[_demonstration(one) for one in demonstrations],
        combined=combined,
        learner=_learner(version),
        metrics=_metrics(version),
        certificate=version.manifest.grid_certificate,
        coverage=_coverage(version, coverage),
        limits=_limits(version, learnt_path.demo),
        lineage=_lineage(session, version),
        citation=words.citation(version),
    )
    return Card(facts, learnt_path.demo, learnt(version).path, coverage, learnt_path.combined)


def _refuse_damaged(rows: Sequence[Any]) -> None:
    """Verify rows as `skills verify` does.

    Raises:
        Corrupt: A row does not match its digest, or contradicts a row that it refers to.
    """
    for row in rows:
        why = next(AGREES[type(row)](row), None)
        if why is not None:
            raise Corrupt(
                f"No card can be written: in {row.__tablename__}, {why}; restore the row from a backup.",
                Remedy(Action.VERIFY),
            )


def _policy(version: PolicyVersion) -> CardPolicy:
    return CardPolicy.from_attributes_of(
        version.manifest,
        sha256=version.sha256,
        version=version.version,
        training=version.training,
        created_at=version.created_at,
        n_states=version.manifest.coverage.n_states,
        where=f"/policy-versions/{version.sha256}",
    )


def _status(session: Session, version: PolicyVersion, released: Sequence[Release]) -> CardStatus:
    """Return the releases of a version, and the version that its style serves now."""
    serving = releases.served(session, version.surgeon, version.suture)
    served = None if serving is None else serving.policy
    # The certificate's reasons are final; the two below can arise after training.
    final = version.manifest.grid_certificate.refused_because
    refused = [one.text for one in (*final, *releases.changed_demonstrations(version))]
    if not consent.may(version.surgeon, "training"):
        refused.append("the surgeon's consent no longer covers training")
    return CardStatus(
        released_now=served is not None and served.row == version.row,
        served_now=None if served is None else PolicyName(version=served.version, sha256=served.sha256),
        releasable=version.releasable and not refused,
        refused_because=refused,
        releases=[
            CardRelease.from_attributes_of(one, serving=serving is not None and serving.row == one.row)
            for one in released
        ],
        in_words=sentence("status", version.version, served and served.version, refused, bool(released)),
    )


def _surgeon(surgeon: Surgeon) -> CardSurgeon:
    words = sentence("consent", surgeon.consent)
    return CardSurgeon.from_attributes_of(surgeon, pseudonym=surgeon.slug, consent_in_words=words)


def _demonstration(row: Demonstration) -> CardDemonstration:
    report, here = full_report(row), f"/demos/{row.sha256}"
    return CardDemonstration.from_attributes_of(
        row,
        state_in_words=sentence("demonstration_state", row.withdrawn_at, row.outcome, row.outcome_reason),
        path_states=len(row.path.states),
        report=report,
        quality_in_words=sentences("quality", report),
        lost_in_words=sentence("lost", report),
        where=here,
        recording=CardRecording.from_attributes_of(row.recording, where=f"{here}/recording"),
    )


def _combined(version: PolicyVersion) -> CardCombined | None:
    """Return how several demonstrations were combined into one path; None for a single demonstration."""
    combined = version.manifest.combined
    if combined is None:
        return None
    return CardCombined(**vars(combined), in_words=sentence("how_combined", combined, len(version.demonstrations)))


def _learner(version: PolicyVersion) -> CardLearner:
    marked = any(one.outcome is not None for one in version.demonstrations)
    return CardLearner.from_attributes_of(
        version.manifest,
        kind=version.manifest.learner,
        version=version.manifest.learner_version,
        in_words=sentence("learner", version.manifest, marked),
    )


def _metrics(version: PolicyVersion) -> list[CardMetric]:
    """Return the metrics of a policy, each with its unit and the way it is measured."""
    measured = vars(version.manifest.metrics)
    return [
        CardMetric(name, label, measured[name], unit.format(**measured), how.format(**measured))
        for name, label, unit, how in words.METRICS
        if measured[name] is not None
    ]


def _coverage(version: PolicyVersion, coverage: Coverage) -> CardCoverage:
    """Return the numbers of starts by how they reach the goal, in total and for every layer of the grid."""
    grid = learnt(version).path.grid
    follows = coverage.reaches & coverage.joins_nearest
    otherwise = coverage.reaches & ~coverage.joins_nearest
    sums = [one.reshape(grid.shape).sum(axis=(0, 1)).tolist() for one in (follows, otherwise, ~coverage.reaches)]
    z_mm = [grid.origin_mm[2] + grid.cell_mm * layer for layer in range(grid.shape[2])]
    layers = tuple(StartLayer(*counts) for counts in zip(z_mm, *sums, strict=True))
    follow, reach_otherwise, do_not_reach = map(sum, sums)
    counts = StartCounts(follow=follow, reach_otherwise=reach_otherwise, do_not_reach=do_not_reach)
    stated, scene = version.manifest.coverage, version.manifest.scene
    there = [] if scene is None else [sentence("in_scene", scene, version.manifest.settings["slip"])]
    return CardCoverage(
        **vars(stated),
        **vars(counts),
        shares=StartShares(**{name: count / grid.n_states for name, count in vars(counts).items()}),
        layers=layers,
        in_words=" ".join([sentence("coverage", counts, stated), *there]),
    )


def _limits(version: PolicyVersion, demo: Demo) -> CardLimits:
    return CardLimits(
        certified_domain=sentence("domain", version.manifest.phases, REACH),
        joint_limits=sentence("joint_limits", version.manifest, demo.rotation_xyzw is not None),
        tip_accuracy=sentence("tip_accuracy", CALIBRATED_MM, UNCALIBRATED_MM),
        tip_error_mm=TipErrors(calibrated=CALIBRATED_MM, not_calibrated=UNCALIBRATED_MM),
        not_checked=words.not_checked(version.manifest.scene),
    )


def _lineage(session: Session, version: PolicyVersion) -> CardLineage:
    """Return the chain of digests from the recordings to the policy, and the input of each digest.

    Where that input is JSON, `digest_of` holds all of it, so that a reader can compute the digest without this service.
    """
    links: list[tuple[str, str, Any]] = []
    for one in version.demonstrations:
        recording = one.recording.sha256
        taken_of = what_identifies(recording, version.surgeon.slug, version.suture, one.demo, one.path)
        links += [("recording", recording, None), ("demonstration", one.sha256, taken_of)]
    policy = learnt(version)
    links += [
        ("reward map", digest(sparse_reward(policy.path, policy.levels)), None),
        ("policy", version.sha256, [version.manifest.digested, digest(policy)]),
    ]
    return CardLineage(
        chain=[CardLink(what=what, sha256=sha256, how=words.DIGESTS[what], digest_of=of) for what, sha256, of in links],
        rests_on_it=_resting_on(session, version),
        verify=words.VERIFY,
    )


def _resting_on(session: Session, version: PolicyVersion) -> RestingOnIt:
    plans = select(func.count()).select_from(Plan).where(Plan.policy_row == version.row)
    played = select(func.count()).select_from(StoredPlayback).join(Plan).where(Plan.policy_row == version.row)
    counts = {
        "plans": session.scalar(plans) or 0,
        "playbacks": session.scalar(played) or 0,
        "feasible_playbacks": session.scalar(played.where(StoredPlayback.feasible)) or 0,
    }
    return RestingOnIt(**counts, in_words=sentence("resting", counts))
