"""What is told of a playback: the verdict, and the figures that it rests on, as plain numbers."""

from collections.abc import Mapping
from dataclasses import dataclass

from skills.style.gates import Failure, JudgeSettings
from skills.style.kinematics import Instrument


@dataclass(frozen=True)
class JointReport:
    """How far one joint went, in its unit, beside its limits."""

    name: str
    unit: str
    lowest: float
    highest: float
    lower_limit: float
    upper_limit: float
    margin: float
    peak_speed_ratio: float
    peak_acceleration_ratio: float


@dataclass(frozen=True)
class ArmReport:
    """One arm: the constants of its instrument, and its joints."""

    name: str
    instrument: Instrument
    joints: tuple[JointReport, ...]


@dataclass(frozen=True)
class ClearanceReport:
    """How near two links came in one phase of any pass.

    Attributes:
        phase: Its name.
        body: Whose link it is.
        link: Its name in the URDF.
        other: The other body.
        other_link: Its link.
        least_mm: The least distance seen; pairs that were never within `seen_within_mm` are not listed.
        sample: Where it was.
        at_least_mm: What the distance was at least, at every sample, also where nobody looked.
    """

    phase: str
    body: str
    link: str
    other: str
    other_link: str
    least_mm: float
    sample: int
    at_least_mm: float


@dataclass(frozen=True)
class PassEnd:
    """The end of a pass: the jaw's angles, and how well it was reached.

    Attributes:
        sample: Where it is.
        turn_deg: What A2 turned the jaw.
        alignment_error_deg: How far its end is from the target.
        goal_error_mm: How far the servo's tip is from the target.
        n_to_a_m_deg: Angle between PSM_A's hinge axis n and PSM_M's approach a_M; None where that is not known.
        a_to_a_m_deg: Angle between PSM_A's approach and a_M: the paper wants it to be right.
    """

    sample: int
    turn_deg: float
    alignment_error_deg: float
    goal_error_mm: float
    n_to_a_m_deg: float | None
    a_to_a_m_deg: float | None


@dataclass(frozen=True)
class NeedleReport:
    """How near the needle came to the pad in one phase of any pass, negative inside: told, and no gate."""

    phase: str
    to_pad_mm: float
    sample: int


@dataclass(frozen=True)
class PlaybackReport:
    """The verdict and its figures: plain numbers, the same for the same trajectory wherever it was played.

    `least_margin` is the part of its range that the joint `least_margin_joint` of PSM_A was from its limit, and the
    peak ratios are PSM_A's; `arms` has every joint of both. `clearance_pad_mm` is of either arm. Between two looks for
    distances a pair of links can have come nearer by `moved_between_looks_mm`, which the gates allow for.
    `peak_effort_ratio` is over the whole servo pass, `peak_contact_effort_ratio` where the arm touches the pad.
    """

    feasible: bool
    failure: Failure | None
    samples: int
    passes: int
    duration_s: float
    rate_hz: float
    unreachable_samples: int
    least_margin: float
    least_margin_joint: str
    least_insertion_mm: float
    peak_speed_ratio: float
    peak_acceleration_ratio: float
    fk_error_mm: float
    fk_error_deg: float
    psm_m_fk_error_mm: float | None
    shaft_off_mm: float
    tracking_max_mm: float
    tracking_rms_mm: float
    goal_error_mm: float
    peak_contact_n: float
    peak_effort_ratio: float
    peak_contact_effort_ratio: float
    deviation_mm: float
    clearance_pad_mm: float
    clearance_psm_m_mm: float | None
    looks: int
    moved_between_looks_mm: float
    seen_within_mm: float
    psm_m_in_scene: bool
    arms: tuple[ArmReport, ...]
    clearances: tuple[ClearanceReport, ...]
    needle: tuple[NeedleReport, ...]
    ends: tuple[PassEnd, ...]
    pad_top_mm: float
    engine: str
    files: Mapping[str, str]
    settings: JudgeSettings
