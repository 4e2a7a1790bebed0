"""Timelines as values: motions as columns on one clock, to be played and compared.

    Timeline
    ├── ArmTrack   the motion of one arm: tip, jaws, joints, speed, outer bodies
    ├── Trace      one number over time: a distance, a probability
    └── Stage      a named interval

The clock is even: row i of a column is at `start_s` + i / `rate_hz`. Values between two samples are interpolated, turns
on the shorter way; where an arm was not recorded they are NaN. `skills.verification.timelines` makes them. Nothing is
learnt or judged from a timeline.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skills.arrays import Floats
from skills.fields import Column, Count, schema

Kind = Literal["recording", "demonstration", "learnt path", "plan"]


@schema
@dataclass(frozen=True)
class Stage:
    """A named interval: a stage of a session, a gesture, a phase of a pass."""

    name: str
    start_s: float
    end_s: float


@schema
@dataclass(frozen=True, eq=False)
class Trace:
    """One number over time that belongs to no single arm: a distance, a probability.

    Attributes:
        name: Its name.
        unit: Its unit; "" for a share.
        limit: The least value that is permitted; null if there is none.
        values: One for each row.
    """

    name: str
    unit: str
    limit: float | None
    values: Column


@schema
@dataclass(frozen=True, eq=False)
class ArmTrack:
    """The motion of one arm, a row for each time.

    Attributes:
        arm: Its name.
        frame: The frame of its poses.
        instrument: Number of its instrument; null if it is not known.
        tip_mm: Positions of the jaws' hinge: 3 numbers a row.
        rotation_xyzw: Orientations of the jaws, whose third axis is their direction: 4 numbers a row; null if they were
            not recorded.
        jaw_rad: Angle of the jaws; null if it was not recorded.
        joints: Joints in rad, the third in mm: 6 numbers a row; null if they were not recorded.
        speed_mm_s: Speed of the tip, without tremor.
        bodies: Names of the outer bodies and of the shaft; empty if joints, instrument or base are not known.
        radii_mm: Their radii.
        bodies_mm: Both ends of the axis of each: 6 numbers a body, the bodies of every `every`-th row.
    """

    arm: str
    frame: str
    instrument: str | None
    tip_mm: Column
    rotation_xyzw: Column | None
    jaw_rad: Column | None
    joints: Column | None
    speed_mm_s: Column
    bodies: tuple[str, ...]
    radii_mm: tuple[float, ...]
    bodies_mm: Column | None

    def __post_init__(self) -> None:
        for name, row in (
            ("tip_mm", (3,)),
            ("rotation_xyzw", (4,)),
            ("joints", (6,)),
            ("bodies_mm", (len(self.bodies), 6)),
        ):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, getattr(self, name).reshape(-1, *row))


@schema
@dataclass(frozen=True, eq=False)
class Timeline:
    """A motion as columns: base64 of little-endian 32-bit floats, row by row, NaN where nothing is known.

    Attributes:
        kind: The kind of its source.
        rate_hz: Rows in a second.
        rows: Number of rows.
        start_s: Time of the first row: in the recording, or 0.
        arms: The arms; the first is the one that was demonstrated or planned, if one was.
        in_one_frame: Whether all arms are in one frame; if not, each is in its own, as the bases are not known.
        way: For each row the share of the arms' whole way that lies before it, from 0 to 1, to compare two motions.
        clutch_s: The intervals in which the clutch was down: beginning and end.
        stages: The stages, in order.
        traces: Distances and probabilities.
        every: Rows between two rows of bodies.
        finger_mm: Length of a jaw's finger.
    """

    kind: Kind
    rate_hz: float
    rows: Count
    start_s: float
    arms: tuple[ArmTrack, ...]
    in_one_frame: bool
    way: Column
    clutch_s: tuple[tuple[float, float], ...]
    stages: tuple[Stage, ...]
    traces: tuple[Trace, ...]
    every: Count
    finger_mm: float

    def seconds(self) -> Floats:
        """Return the times of the rows, in s."""
        return self.start_s + np.arange(self.rows) / self.rate_hz
