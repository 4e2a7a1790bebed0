"""Joints and poses of one arm as recorders write them: synthetic and real, with and without a planted mistake.

`drawn` moves an arm with a known instrument through smooth random joints, and spoils what real recorders spoil: stamps
that are a fraction of a millisecond apart, rounded numbers, and in half of the files a joint topic that is late.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from skills.demonstration.identification import Identification, identify
from skills.kinematics import INSTRUMENTS, forward, instrument_of, matrix_of, quaternion_of
from tests.formats.bags import sample_folder

RATE_HZ = 100.0


@dataclass(frozen=True)
class Recorded:
    """What a recording has of one arm, and what it states: joints rad and mm, positions mm, rotations [n o a]."""

    joints: np.ndarray
    tip_mm: np.ndarray
    rotation: np.ndarray | None
    in_base: bool
    stated: str | None
    truth: str

    def identified(self) -> Identification:
        """Identify it."""
        speeds = np.gradient(self.joints, 1.0 / RATE_HZ, axis=0)
        found = identify(
            self.joints, self.tip_mm, self.rotation, speeds=speeds, in_base=self.in_base, stated=self.stated
        )
        assert found is not None
        return found


def drawn(seed: int) -> Recorded:
    """Draw a sound recording of 5 to 60 s."""
    rng = np.random.default_rng((17, seed))
    name = str(rng.choice(list(INSTRUMENTS)))
    tool = instrument_of(name)
    count = int(RATE_HZ * rng.uniform(5, 60))
    seconds = np.arange(count) / RATE_HZ
    middle = np.array(
        [rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4), tool.cannula_mm + rng.uniform(60, 110)] + [0.0] * 3
    )
    middle[3:] = rng.uniform([-2.0, -0.5, -0.5], [2.0, 0.5, 0.5])
    sizes = rng.uniform(0.5, 1.0, 6) * [0.15, 0.15, 25.0, 0.6, 0.5, 0.5]
    late_s = rng.choice([0.0, rng.uniform(-0.004, 0.004)])
    waves = [(rng.uniform(0.05, 0.4, 4), rng.uniform(0, 2 * np.pi, 4), rng.dirichlet(np.ones(4))) for _ in range(6)]

    def joints_at(times: np.ndarray) -> np.ndarray:
        moved = [(part * np.sin(2 * np.pi * times[:, None] * hz + phase)).sum(1) for hz, phase, part in waves]
        return middle + sizes * np.stack(moved, axis=1)

    tip_mm, rotation = forward(joints_at(seconds), name)
    in_base = bool(rng.random() < 0.5)
    if not in_base:
        turn = matrix_of(rng.normal(size=(1, 4)))[0]
        tip_mm, rotation = rng.uniform(-200, 200, 3) + tip_mm @ turn.T, turn @ rotation
    joints = joints_at(seconds + late_s + rng.normal(0, 0.0002, count))
    tip_mm = np.round(tip_mm, int(rng.integers(2, 7)))
    rotation = matrix_of(np.round(quaternion_of(rotation), int(rng.integers(4, 9))))
    number = name.partition("-")[0]
    stated = [None, number, f"LARGE_NEEDLE_DRIVER:{number}", f"LARGE_NEEDLE_DRIVER:{number}[..11]"][
        int(rng.integers(4))
    ]
    return Recorded(joints, tip_mm, rotation, in_base, stated, name)


def real(name: str) -> Recorded:
    """Read a published table of a real arm: joints, positions in m, rotation vectors, all in the arm's base."""
    table = np.genfromtxt(sample_folder() / "calibration" / f"{name}.csv", delimiter=",", names=True)
    joints = np.stack([table[f"measured_q{number}"] for number in range(1, 7)], axis=1) * [1, 1, 1000, 1, 1, 1]
    tip_mm = 1000.0 * np.stack([table[f"measured_{axis}"] for axis in "xyz"], axis=1)
    vector = np.stack([table[f"measured_r{axis}"] for axis in "xyz"], axis=1)
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    rotation = matrix_of(np.hstack([vector / angle * np.sin(angle / 2), np.cos(angle / 2)]))
    truth = "420006-Classic" if name == "Si_tool_fixed" else "400006"
    return Recorded(joints, tip_mm, rotation, True, None, truth)


REAL = ("classic_tool_fixed", "Si_tool_fixed", "raw_sensor_rosbag_09_traj3")


def cut(one: Recorded, seed: int) -> Recorded:
    """Cut a piece of 200 to 500 samples out of a recording."""
    rng = np.random.default_rng((18, seed))
    length = int(rng.integers(200, 501))
    first = int(rng.integers(0, len(one.joints) - length + 1))
    here = slice(first, first + length)
    rotation = None if one.rotation is None else one.rotation[here]
    return replace(one, joints=one.joints[here], tip_mm=one.tip_mm[here], rotation=rotation)


# ---- mistakes ---------------------------------------------------------------------------------------------------

Mistake = Callable[[Recorded, np.random.Generator], Recorded]
MIRRORS = [np.diag(signs) for signs in ([-1.0, 1, 1], [1, -1.0, 1], [1, 1, -1.0])]


def another_instrument(one: Recorded, rng: np.random.Generator) -> Recorded:
    """State an instrument of another wrist or another shaft."""
    own = one.truth[:2]
    others = ["194", "309", "093", "205", "172"]
    named = [f"{own}0{number}" for number in others] + ["420006" if own == "40" else "400006", "400117", "410298"]
    if (own == "40" and "-" not in one.truth) or one.truth == "420006":
        named.remove("420006" if own == "40" else "400006")  # of equal lengths: no pose can tell them apart
    return replace(one, stated=str(rng.choice(named)))


def another_generation(one: Recorded, rng: np.random.Generator) -> Recorded:
    """State an arm of the other generation; where tool and arm do not belong together, both swapped."""
    number, _, on = one.truth.partition("-")
    # A bare number leaves the arm open, so both have the generation in their name.
    wrong = {"400006": ("400006-Si", "420006-Classic"), "420006": ("420006-Classic", "400006-Si")}[number]
    return replace(one, stated=wrong[1] if on else wrong[0])


def another_unit(one: Recorded, rng: np.random.Generator) -> Recorded:
    """Take degrees for radians, millimetres for metres, or the reverse, or inches, in joints or positions."""
    kind, joints = int(rng.integers(7)), one.joints.copy()
    if kind < 2:
        joints[:, [0, 1, 3, 4, 5]] *= [180 / np.pi, np.pi / 180][kind]
    elif kind < 5:
        joints[:, 2] *= [1000.0, 0.001, 25.4][kind - 2]
    else:
        return replace(one, tip_mm=one.tip_mm * [1000.0, 0.001][kind - 5])
    return replace(one, joints=joints)


def another_frame(one: Recorded, rng: np.random.Generator) -> Recorded:
    """Give poses of another frame than the stated one; in a camera's frame, of another frame half-way."""
    axis = rng.normal(size=3)
    angle = np.radians(rng.uniform(2, 180))
    turn = matrix_of(np.append(axis / np.linalg.norm(axis) * np.sin(angle / 2), np.cos(angle / 2))[None])[0]
    shift = rng.normal(size=3)
    shift *= rng.uniform(2, 300) / np.linalg.norm(shift)
    from_here = 0 if one.in_base else int(len(one.tip_mm) * rng.uniform(0.3, 0.7))
    tip_mm, rotation = one.tip_mm.copy(), None if one.rotation is None else one.rotation.copy()
    tip_mm[from_here:] = shift + tip_mm[from_here:] @ turn.T
    if rotation is not None:
        rotation[from_here:] = turn @ rotation[from_here:]
    return replace(one, tip_mm=tip_mm, rotation=rotation)


def another_hand(one: Recorded, rng: np.random.Generator) -> Recorded:
    """Mirror the frame, or the positions alone; invert the orientations; or give their quaternions as w, x, y, z."""
    kind, mirror = int(rng.integers(4)), MIRRORS[int(rng.integers(3))]
    assert one.rotation is not None
    if kind == 0:
        return replace(one, tip_mm=one.tip_mm @ mirror, rotation=mirror @ one.rotation @ mirror)
    if kind == 1:
        return replace(one, tip_mm=one.tip_mm @ mirror)
    if kind == 2:
        return replace(one, rotation=one.rotation.swapaxes(1, 2))
    return replace(one, rotation=matrix_of(quaternion_of(one.rotation)[:, [3, 0, 1, 2]]))


MISTAKES: tuple[Mistake, ...] = (another_instrument, another_generation, another_unit, another_frame, another_hand)
