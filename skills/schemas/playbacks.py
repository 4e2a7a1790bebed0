"""Playbacks: the request, the verdict on a plan, and its headline; and a replay compared with its plan."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from skills.dynamics import Servo
from skills.fields import Count, Point, Sha256, exact, schema
from skills.packing import canonical, sha256
from skills.schemas import Given, PolicyName
from skills.schemas.requests import LINE, DigestField, Schema, Size, Source, shown
from skills.verification.arm_errors import NAMED, ArmErrors, checked_own
from skills.verification.execution import ExecutionReport
from skills.verification.probabilities import Probability, SuccessEstimate
from skills.verification.scene_clearance import SceneReport
from skills.verification.verdict import PlaybackReport


class ErrorSources(Schema):
    """For each size of an arm's errors its source, and the reason for its value."""

    registration_mm: Source
    registration_deg: Source
    wrist_deg: Source
    tip_bias_mm: Source
    tip_noise_mm: Source
    tip_correlation_s: Source


class ArmErrorsIn(Schema):
    """A laboratory's own errors of its arms, standard deviations along or about each axis (docs/errors.md).

    Attributes:
        registration_mm: Offset of PSM_M's base.
        registration_deg: Rotation of PSM_M's base about its remote centre.
        wrist_deg: Rotation of either arm's jaws about their hinge.
        tip_bias_mm: Offset of either arm that stays over a pass.
        tip_noise_mm: Offset of either arm that varies during a pass.
        tip_correlation_s: Correlation time of that noise.
    """

    name: Annotated[str, Field(min_length=1, max_length=60, pattern=LINE)]
    registration_mm: Size
    registration_deg: Size
    wrist_deg: Size
    tip_bias_mm: Size
    tip_noise_mm: Size
    tip_correlation_s: Size
    sources: ErrorSources


ErrorsIn = Literal["calibrated", "uncalibrated"] | ArmErrorsIn | None


def errors_of(stated: ErrorsIn) -> ArmErrors | None:
    """Return the errors that a request states, as a value of the domain; None where it states none."""
    if isinstance(stated, ArmErrorsIn):
        return checked_own(ArmErrors(**stated.model_dump()))
    return None if stated is None else NAMED[stated]


@exact
@schema
@dataclass(frozen=True)
class ServoIn(Servo):
    """How a laboratory drives PSM_A, as a request states it; what is left out has its default (docs/execution.md)."""


class PlaybackIn(Schema):
    """A playback: the plan to play in the simulator, and the errors of the arms to judge it under.

    Attributes:
        errors: The errors of the arms that are to play it; by default those of the installation.
        servo: How PSM_A is driven (docs/execution.md); by default as the installation states.
    """

    model_config = shown({"plan": "0123456789abcdef" * 4}, {"plan": "0123456789abcdef" * 4, "errors": "calibrated"})

    plan: DigestField
    errors: ErrorsIn = None
    servo: ServoIn | None = None

    @property
    def arm_errors(self) -> ArmErrors | None:
        """The errors as a value of the domain."""
        return errors_of(self.errors)

    @property
    def driven(self) -> Servo | None:
        """The servo as a value of the domain."""
        return None if self.servo is None else Servo(**vars(self.servo))


@schema
@dataclass(frozen=True, kw_only=True)
class Verdict(PlaybackReport):
    """The verdict and its figures; peak ratios and margins are PSM_A's, `arms` has all joints.

    Attributes:
        failure_sentence: The failure as a sentence.
        estimate: Probabilities of success in worlds that differ from the plan.
        plan: Digest of the plan.
        trajectory: Digest of the stamps and joints that were checked.
        policy: The policy version that the plan follows.
        frame: Frame of the plan.
        scene: Distances from the plan's scene; null: it has none, so nothing was compared with tissue.
        tissue: Whether the motion was compared with tissue.
        executed: The motion that PSM_A is predicted to execute; null: not executed, as nobody states how it is driven.
        stated_by: Source of the errors of the arms, the playback's request or the installation.
        check_version: Version of the checks; a bag is given only of the present one.
    """

    failure_sentence: str | None
    estimate: SuccessEstimate
    plan: Sha256
    trajectory: Sha256
    policy: PolicyName
    frame: str
    scene: SceneReport | None
    tissue: Literal["judged", "not given"]
    executed: ExecutionReport | None
    stated_by: Literal["request", "installation"]
    check_version: Count

    @property
    def identity(self) -> str:
        """The digest of a playback: over its plan and this verdict as it is stored."""
        return sha256(canonical([self.plan, TypeAdapter(Verdict).dump_python(self, mode="json")]))


def finite(verdict: Verdict) -> Verdict:
    """Return a verdict with null for NaN and infinity, which JSON does not have."""
    verdicts = TypeAdapter(Verdict)
    return verdicts.validate_json(verdicts.dump_json(verdict))


class FollowedPolicy(PolicyName):
    """The policy version that a plan follows, and whether it is released now."""

    released: bool


class PictureLinks(Given):
    """Links to the pictures; all but the first are drawn after the verdict."""

    picture: str
    animation_mp4: str
    animation_gif: str
    joints: str
    clearance: str


Level = Literal["good", "caution", "bad"]
CountedEvent = Literal["hand-over", "clearance"]


class Headline(Given):
    """A playback's headline: the verdict, the missing parts of the plan, and its probability of success.

    Attributes:
        level: good: hands over, and succeeds as surely as the installation asks for a replay; bad: not feasible, or
            surely succeeds in less than half of the worlds.
        word: The level in a word or two.
        errors: Name of the errors of the arms: those of the playback's request, or else of the installation.
        probability: Of the whole plan; null where it was not judged, and where the plan is not feasible.
        counts: The event of the probability: the needle is handed over in every pass, or, without a hand-off, the
            motion only stays within reach and clear; null without a probability.
        event: That event in words; null without a probability.
        estimate: The probability as a sentence, with its event, its worlds and what it leaves out.
        under: A sentence on each of the errors of the arms under which the passes were judged.
        not_judged: What the probability leaves out, in words.
        costs_most: The error that costs the most, in words; null where none was judged.
        hand_over: How often friction would let PSM_M hold the needle, and straight, in words; null without a hand-off.
        executed: The predicted error of PSM_A in words, or that it was not executed.
    """

    level: Level
    word: str
    text: str
    errors: str
    probability: Probability | None
    counts: CountedEvent | None
    event: str | None
    estimate: str | None
    under: list[str]
    not_judged: list[str]
    costs_most: str | None
    hand_over: str | None
    executed: str


class Playback(Given):
    """The simulator's verdict on a plan.

    Attributes:
        feasible: In an exact simulation, as far as the plan goes; read `headline`.
    """

    id: Sha256
    sha256: Sha256
    plan: Sha256
    feasible: bool
    headline: Headline
    report: Verdict
    picture: str
    pictures: PictureLinks
    created_at: datetime
    policy: FollowedPolicy


class Comparison(Given):
    """A recorded replay compared with a pass of its plan; triples are x, y and z.

    Attributes:
        start_mm: Between the first samples.
        end_mm: Between the last samples.
    """

    plan: Sha256
    demo: Sha256
    pass_index: Count = Field(alias="pass")
    mean_mm: float
    max_mm: float
    start_mm: float
    end_mm: float
    dtw_mean_mm: Point
    rmse_mm: Point
    planned_s: float
    recorded_s: float
    tie_break: str
