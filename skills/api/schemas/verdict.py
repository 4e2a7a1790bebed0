"""The simulator's verdict on a plan: gates, figures, and in how many inexact worlds it succeeds.

A figure is null where it could not be measured; a gate that meets one has failed.
"""

from typing import Annotated

from pydantic import Field

from skills.api.schemas.shapes import Count, Given, PolicyName, Sha256, Share

Figure = float | None
Six = Annotated[list[float], Field(min_length=6, max_length=6, description="rad, of the insertion mm.")]


class Failure(Given):
    """The first sample at which a gate is not met."""

    sample: Count
    pass_index: Count
    phase: Count
    stamp_s: float
    quantity: str
    value: Figure
    limit: float
    unit: str


class Limits(Given):
    """What the gates allow."""

    fk_mm: float
    fk_deg: float
    joint_margin: float
    insertion_mm: float
    speed_ratio: float
    acceleration_ratio: float
    tracking_mm: float
    goal_mm: float
    alignment_deg: float
    clearance_pad_mm: float
    clearance_psm_m_mm: float
    contact_n: float
    contact_effort: float


class ArmConstants(Given):
    """The constants of an arm's joints."""

    name: str
    remote_centre_mm: float
    lower: Six
    upper: Six
    speed: Six = Field(description="Per second.")
    acceleration: Six = Field(description="Per second squared.")
    effort: Six = Field(description="Nm, of the insertion N.")


class InstrumentConstants(Given):
    """The constants of an instrument."""

    name: str
    arm: ArmConstants
    shaft_mm: float
    jaw_rad: tuple[float, float]


class JointFigures(Given):
    """How far one joint went, in its unit, beside its limits."""

    name: str
    unit: str
    lowest: Figure
    highest: Figure
    lower_limit: float
    upper_limit: float
    margin: Figure
    peak_speed_ratio: Figure
    peak_acceleration_ratio: Figure


class ArmFigures(Given):
    """One arm: its constants and its joints."""

    name: str
    instrument: InstrumentConstants
    joints: list[JointFigures]


class Clearance(Given):
    """How near two links came in one phase of any pass."""

    phase: str
    body: str
    link: str
    other: str
    other_link: str
    least_mm: Figure
    sample: Count
    at_least_mm: Figure = Field(description="Also where nobody looked.")


class NeedleClearance(Given):
    """How near the needle came to the pad in one phase of any pass, negative inside: told, and no gate."""

    phase: str
    to_pad_mm: Figure
    sample: Count


class PassEnd(Given):
    """The end of a pass: the jaw's angles, and how well it was reached."""

    sample: Count
    turn_deg: Figure = Field(description="What A2 turned the jaw.")
    alignment_error_deg: Figure
    goal_error_mm: Figure
    n_to_a_m_deg: Figure
    a_to_a_m_deg: Figure


class Probability(Given):
    """A share of the worlds that were tried, with its 95 % interval."""

    count: Count
    of: Count
    probability: Share
    lower: Share
    upper: Share


class Faults(Given):
    """In how many worlds which gate failed first; null where it was not tried."""

    reach: Count | None
    limits: Count | None
    pad: Count | None
    arms: Count | None
    place: Count | None
    angle: Count | None


class PassDoubt(Given):
    """How likely one pass succeeds: that it stays clear, and that PSM_M finds the needle."""

    succeeds: Probability
    clear: Probability
    caught: Probability | None
    faults: Faults


class TipDoubt(Given):
    """The same under one error of the arm's tip, for the whole plan and for each pass."""

    tip_error_mm: float
    plan: Probability
    passes: list[PassDoubt]


class DoubtSettings(Given):
    """How the worlds differ."""

    variations: Count
    tip_errors_mm: list[float]
    suture_point_mm: float
    needle_rad: float
    stated_rad: float
    opening_rad: float
    stretches: Count


class Doubt(Given):
    """In how many worlds that are not quite as planned the plan succeeds."""

    seed: Count
    pad_top_mm: Figure
    with_psm_m: bool
    hand_offs: Count
    looked_at: list[int]
    under: list[TipDoubt]
    settings: DoubtSettings
    limits: Limits


class Verdict(Given):
    """The verdict and the figures that it rests on; peak ratios and margins are PSM_A's, `arms` has all joints."""

    feasible: bool
    failure: Failure | None
    failure_in_words: str | None
    samples: Count
    passes: Count
    duration_s: float
    rate_hz: float
    unreachable_samples: Count
    least_margin: Figure = Field(description="Part of its range that a joint was from its limit.")
    least_margin_joint: str
    least_insertion_mm: Figure
    peak_speed_ratio: Figure
    peak_acceleration_ratio: Figure
    fk_error_mm: Figure
    fk_error_deg: Figure
    psm_m_fk_error_mm: Figure
    shaft_off_mm: Figure
    tracking_max_mm: Figure
    tracking_rms_mm: Figure
    goal_error_mm: Figure
    peak_contact_n: Figure
    peak_effort_ratio: Figure
    peak_contact_effort_ratio: Figure
    deviation_mm: Figure
    clearance_pad_mm: Figure
    clearance_psm_m_mm: Figure
    looks: Count
    moved_between_looks_mm: Figure
    seen_within_mm: float
    psm_m_in_scene: bool
    arms: list[ArmFigures]
    clearances: list[Clearance]
    needle: list[NeedleClearance]
    ends: list[PassEnd]
    pad_top_mm: Figure
    engine: str
    files: dict[str, Sha256] = Field(description="Digests of what the simulator was given.")
    settings: Limits
    doubt: Doubt
    plan: Sha256
    trajectory: Sha256 = Field(description="Digest of the stamps and joints that were checked.")
    policy: PolicyName
    frame: str
