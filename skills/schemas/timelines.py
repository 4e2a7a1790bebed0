"""Motions as columns on one clock, to be played."""

from typing import Literal

from skills.fields import Sha256
from skills.schemas import Given
from skills.verification.timeline import Timeline


class MotionTimeline(Given):
    """A recording, a demonstration, a learnt path or a plan as columns on one clock, to be played."""

    source: Literal["recordings", "demos", "policy-versions", "plans"]
    sha256: Sha256
    timeline: Timeline
