"""The release gate: reasons on the grid and of the arm's joint limits against a release."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from skills.demonstration.demonstration import Demo
from skills.errors import BadPlan
from skills.fields import percent
from skills.kinematics import instrument_of
from skills.learning.certificate import Certificate, NearLimits, NearOdds, NearStarts, OddsLimits, least_gamma
from skills.learning.dynamic_programming import FAINT
from skills.learning.policy import Policy
from skills.learning.pose_step import near_share
from skills.learning.ties import OPTIMAL
from skills.learning.tube import CertifiedPoses
from skills.planning.plan import CONSTANT_TURN_DEG, DrivenPass, driven_pass
from skills.schemas.policies import GateRefusal, RefusalKind
from skills.settings import Settings

GATE_VERSION = 1  # part of a training's identity: raise it when the gate's result for an equal policy changes

_OTHERWISE = "Train it with other settings or another learner, or record the hand-off again."
# Of several reasons the first one here is remedied: training again is of no use before it.
_REMEDIES: dict[RefusalKind, str] = {
    "consent": "Record a consent of the surgeon that covers training, then request the release again.",
    "withdrawn": "Train from a demonstration that is active, and request its release.",
    "marked": "Train from another demonstration, or with outcomes 'any' from this one, and request the release.",
    "faint": "Train it with a gamma nearer to 1, or lay the demonstration on larger cells.",
    "not optimal": _OTHERWISE,
    "unreached": _OTHERWISE,
    "scene odds": "Train it with a smaller slip (by value-iteration, if another learner made it), or record the "
    "hand-off further from the scene; the limits are SKILLS_SCENE_LEAST_FINISHING and SKILLS_SCENE_MOST_TOUCHING.",
    "frame": "Record the arm's local/measured_cp, which is in its base, or its measured_js.",
    "joint limits": "Record the hand-off further inside the arm's reach, or with the arm's base elsewhere.",
    "jaw held": "Train it again, and request its release.",
}


class GateLimits(NamedTuple):
    """The gate's limits: at the starts near the demonstrated one, and in a scene."""

    near: NearLimits = NearLimits()
    odds: OddsLimits = OddsLimits()
    constant_turn_deg: float = CONSTANT_TURN_DEG

    @classmethod
    def of(cls, settings: Settings) -> "GateLimits":
        """Return those that an installation sets."""
        return cls(
            NearLimits(settings.near_radius_mm, settings.near_least_share),
            OddsLimits(settings.scene_least_finishing, settings.scene_most_touching),
            settings.constant_turn_deg,
        )


DEFAULT_LIMITS = GateLimits()


def remedy(reasons: Sequence[GateRefusal]) -> str:
    """Return the remedy for the reasons for which a version is not released."""
    kinds = {one.kind for one in reasons}
    return next((words for kind, words in _REMEDIES.items() if kind in kinds), _OTHERWISE)


def join_reasons(reasons: Sequence[GateRefusal]) -> str:
    """Return the reasons as one phrase."""
    return "; ".join(one.text for one in reasons)


def refusals(
    policy: Policy, certificate: Certificate, near: NearStarts, odds: NearOdds | None = None
) -> list[GateRefusal]:
    """Return the reasons on the grid against a release; the comparisons are written so that NaN fails.

    In a scene the odds count in place of optimal actions and of starts that reach the goal: sampled values are not
    exact beside rare and costly touches, and cells in tissue reach nothing.
    """
    first = _inexact(policy, certificate) if odds is None else _unlikely(odds)
    return [GateRefusal(kind, text) for kind, text in (*first, *_not_the_style(policy, certificate, near))]


def _inexact(policy: Policy, certificate: Certificate) -> Iterator[tuple[RefusalKind, str]]:
    """Yield the reasons why actions and starts are against a release."""
    if not certificate.every_action_optimal:
        yield "not optimal", f"{certificate.suboptimal} of {certificate.checked} greedy actions are not {OPTIMAL}"
    if not certificate.every_action_optimal and certificate.faint:
        gamma = least_gamma(policy)
        yield (
            "faint",
            f"{certificate.faint} of them are so far from the path that their values, with gamma "
            f"{policy.learner.gamma:g}, are below {FAINT:g}, too small to be learnt; train with larger cells, or with "
            f"a gamma {'nearer to 1' if gamma is None else f'of {gamma:g}'}",
        )
    if certificate.starts_reaching < certificate.starts:
        missing = certificate.starts - certificate.starts_reaching
        yield "unreached", f"{missing} of {certificate.starts} starts do not reach the goal"
    if certificate.off_rule:
        yield (
            "off rule",
            f"{certificate.off_rule} of {certificate.checked} greedy actions are not the ones that the rule among "
            "equally good actions selects",
        )


def _unlikely(odds: NearOdds) -> Iterator[tuple[RefusalKind, str]]:
    """Yield the reason why the odds in a scene are against a release, if they are."""
    if not odds.within:
        yield (
            "scene odds",
            f"of {odds.starts} starts near the demonstrated one, one finishes with a probability of "
            f"{odds.finishing:.1%}, and one touches the scene with {odds.touching:.1%}; the gate requires at least "
            f"{percent(odds.least_finishing)}% and at most {percent(odds.most_touching)}%",
        )


def _not_the_style(policy: Policy, certificate: Certificate, near: NearStarts) -> Iterator[tuple[RefusalKind, str]]:
    """Yield the reasons why a policy does not follow the demonstration from its start or near it."""
    if policy.learner.phased and not certificate.demonstration_reproduced:
        yield "not reproduced", "the rollout from the demonstrated start is not the demonstration"
    if policy.learner.phased and not near.within:
        yield (
            "near starts",
            f"of {near.starts} starts within {near.radius_mm:g} mm of the demonstrated one, one follows only "
            f"{percent(near.share)}% of the demonstration, and the gate requires {percent(near.least_share)}%; "
            "train with a "
            f"joining rule such as --join {max(near.least_share, 0.5):g}, which leads them back to an earlier part",
        )


def pose_refusals(poses: CertifiedPoses | None, near: NearLimits) -> list[GateRefusal]:
    """Return the reason why the pose style of a version is against its release, if it is; NaN fails."""
    share = 1.0 if poses is None else near_share(poses.path, poses.tube.limits, near.radius_mm)
    if share >= near.least_share:
        return []
    text = (
        f"of the starts within {near.radius_mm:g} mm of the pose style's first pose, one joins it where "
        f"{percent(share)}% is "
        f"left, and the gate requires {percent(near.least_share)}%; train phase-q-learning or value-iteration "
        "with a joining "
        f"rule such as --join {max(near.least_share, 0.5):g}"
    )
    return [GateRefusal("near starts", text)]


def driven_or_refused(policy: Policy, demo: Demo) -> tuple[DrivenPass | None, list[GateRefusal]]:
    """Solve the demonstrated pass in closed form; return the result, None if impossible, and reasons against a release.

    NaN fails: a position is within the limits only if joints within the limits were found that put the tip there.
    """
    if not demo.frame.endswith("_base"):
        text = (
            f"the frame '{demo.frame}' is not the arm's base, so its joint limits cannot be checked; demonstrate on a "
            "topic in the frame of the arm's base, such as local/measured_cp of a dVRK, or record its joints beside "
            "the poses"
        )
        return None, [GateRefusal("frame", text)]
    try:
        driven = driven_pass(policy, demo)
    except BadPlan as refused:
        why = refused.message.removesuffix(".")
        text = f"the demonstrated pass cannot be driven, so the joint limits were not checked: {why}"
        return None, [GateRefusal("joint limits", text)]
    if driven.beyond == 0:
        return driven, []
    nearest, arm = driven.nearest_limit, instrument_of(demo.instrument).arm.name
    where = ", ".join(f"{value:.1f}" for value in nearest.tip_mm)
    needs = (
        "no joints put the tip there"
        if nearest.value is None or nearest.margin is None
        else f"the arm needs {nearest.joint} {nearest.value:.4f} {nearest.unit}, {-nearest.margin:.4f} {nearest.unit} "
        f"beyond the limit {nearest.limit:.4f} of the {arm} with {demo.instrument}"
    )
    what = "the fitted path" if driven.path == "fitted" else "through the centres of its cells"
    text = (
        f"the demonstrated pass as it is driven ({what}) leaves the joint limits: at ({where}) mm in {demo.frame} "
        f"{needs}, the furthest of {driven.beyond} of {driven.samples} places; demonstrate it further from that limit, "
        "or with the arm's base elsewhere"
    )
    return driven, [GateRefusal("joint limits", text)]
