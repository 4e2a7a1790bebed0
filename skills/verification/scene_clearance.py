"""Distances of a planned motion from a scene: both arms' tools, along the whole motion, in closed form.

    Trajectory, Scene --clearance_of--> SceneReport, and the least distance at every sample

The tools are the capsules of `skills.verification.clearance.links_of`, the scene is that of `skills.gridworld.scene`: a
link's distance from a box or a capsule is exact, that from a height map a lower bound. The distances are computed at
samples between which no link moves further than `LOOK_MM`; from one to the next, no distance is less than the mean of
both minus half of that way, and this bound is what is judged. So nothing is missed in between.

The margin of a scene stands for the tool's size in the grid world, where the tip is a point. Here it is a distance that
must be kept, if it is larger than `SceneReport.limit_mm` would be without it. A scene's capsules are the other arm, so
they are not compared with PSM_M. The needle and the arms' parts outside of the patient are not compared either.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from skills.arrays import Floats, Ints, xyz
from skills.fields import Count, Figure, Point, schema
from skills.gridworld.scene import Scene
from skills.kinematics import matrix_of
from skills.planning.handoff import HOLDING_RAD, OPEN_RAD
from skills.planning.motion_laws import PHASES
from skills.planning.trajectory import Trajectory
from skills.verification.clearance import (
    FINGER_REACH_MM,
    FINGERS,
    RADII_MM,
    Links,
    links_of,
    openings,
    psm_m_poses,
    travel_mm,
)
from skills.verification.playback import CLEARANCE_SEEN_MM, LINKS, PSM_A, PSM_M

LEAST_MM = 1.0  # ours, as of the pad: the error of a calibrated arm (0.65 mm) and half as much again
LOOK_MM = 0.25  # ours: a distance that is judged is at most half of this too small, for that reason
# PSM_M's jaw comes open and closes on the needle, at times that a trajectory does not state: its fingers, 2.2 mm thick,
# move by 1.1 mm at their tips from one opening to the next, so nothing passes between two of them.
JAWS_RAD = np.linspace(HOLDING_RAD, OPEN_RAD, 5).tolist()


@schema
@dataclass(frozen=True)
class NearestToScene:
    """The least distance of an arm's tool from a part of the scene.

    Attributes:
        body: The arm.
        link: Its link, by its name in the URDF.
        part: tissue, or box or capsule with its index, such as "box 0".
        least_mm: The distance; negative inside.
        sample: The sample.
        pass_index: Its pass.
        phase: The name of its phase.
        stamp_s: Its time.
        tip_mm: Position of the arm's tip there, in the frame of the plan.
    """

    body: str
    link: str
    part: str
    least_mm: Figure
    sample: Count
    pass_index: Count
    phase: str
    stamp_s: float
    tip_mm: Point

    def __str__(self) -> str:
        """Return it as part of a sentence."""
        apart = "nan" if self.least_mm is None else f"{self.least_mm:.2f}"
        return (
            f"{self.body} {self.link} is {apart} mm from {self.part}, in pass {self.pass_index}, {self.phase}, at "
            f"{self.stamp_s:.2f} s"
        )


@schema
@dataclass(frozen=True)
class SceneReport:
    """The comparison of a motion with a scene.

    Attributes:
        limit_mm: The distance that must be kept: 1 mm, or the margin of the scene if that is larger.
        at_least_mm: Lower bound on the distance of both tools from the scene along the whole motion; null if none came
            within `seen_within_mm`.
        seen_within_mm: Greater distances are not distinguished.
        looks: Number of samples at which distances were computed.
        nearest: The least distance of each arm from each part within `seen_within_mm`, the least first.
    """

    limit_mm: float
    at_least_mm: Figure
    seen_within_mm: float
    looks: Count
    nearest: tuple[NearestToScene, ...]


@dataclass(frozen=True, eq=False)
class SceneClearance:
    """The report, and the lower bound on the distance from each sample until the next look, (T,)."""

    report: SceneReport
    at_least_mm: Floats


def clearance_of(trajectory: Trajectory, scene: Scene) -> SceneClearance:
    """Compare a motion with a scene.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it moves.
        scene: The scene, in the frame of PSM_A's base.

    Returns:
        The distances.
    """
    at_least, looked = np.full(len(trajectory), np.inf), np.zeros(len(trajectory), bool)
    nearest: list[tuple[float, NearestToScene]] = []
    for body in (PSM_A, PSM_M) if trajectory.psm_m is not None else (PSM_A,):
        way = _way_mm(trajectory, body)
        looks = _looks(way)
        of_parts = dict(_from_parts(_links(trajectory, body, looks), scene, body))
        seen = np.min([np.full((len(looks), len(LINKS)), np.inf), *of_parts.values()], axis=0)
        ahead = np.diff(way[looks], axis=0, append=way[looks[-1:]])
        after = np.concatenate([seen[1:], seen[-1:]])
        at_least[looks] = np.minimum(at_least[looks], np.minimum(seen, (seen + after - ahead) / 2).min(axis=1))
        looked[looks] = True
        nearest += [_nearest(trajectory, body, part, looks, apart) for part, apart in of_parts.items()]
    nearest.sort(key=lambda pair: float(np.nan_to_num(pair[0], nan=-np.inf)))
    least = float(at_least.min())
    return SceneClearance(
        SceneReport(
            limit_mm=max(LEAST_MM, scene.margin_mm),
            at_least_mm=None if least >= CLEARANCE_SEEN_MM else least,
            seen_within_mm=CLEARANCE_SEEN_MM,
            looks=int(np.count_nonzero(looked)),
            nearest=tuple(one for apart, one in nearest if not apart >= CLEARANCE_SEEN_MM),
        ),
        at_least,
    )


def _links(trajectory: Trajectory, body: str, at: Ints) -> tuple[Links, ...]:
    """Return an arm's links at some samples, in the frame of PSM_A's base; PSM_M's with each opening of its jaw."""
    m = trajectory.psm_m
    if body == PSM_A or m is None:
        return (links_of(trajectory.joints[at], trajectory.instrument, openings(trajectory)[at]),)
    base = matrix_of(m.base_xyzw[None])[0]
    return tuple(links_of(m.joints[at], m.instrument, jaw).seen_from(base, m.base_mm) for jaw in JAWS_RAD)


def _way_mm(trajectory: Trajectory, body: str) -> Floats:
    """Return the greatest distance that each link of an arm can have moved since the first sample, (T, 4)."""
    m = trajectory.psm_m
    if body == PSM_A or m is None:
        steps = travel_mm(trajectory.joints, trajectory.instrument)
        steps[:, FINGERS] += FINGER_REACH_MM * np.abs(np.diff(openings(trajectory)))[:, None]
    else:
        steps = travel_mm(m.joints, m.instrument)
    return np.concatenate([np.zeros((1, len(LINKS))), np.cumsum(steps, axis=0)])


def _looks(way_mm: Floats) -> Ints:
    """Return the samples to look at: the first and the last, and as few as keep every link's way below `LOOK_MM`.

    Where a single step is longer, both of its samples are looked at.
    """
    looks = [0]
    for sample in range(1, len(way_mm)):
        if (way_mm[sample] - way_mm[looks[-1]]).max() > LOOK_MM and sample - 1 > looks[-1]:
            looks.append(sample - 1)
    return np.unique([*looks, len(way_mm) - 1])


def _from_parts(links: tuple[Links, ...], scene: Scene, body: str) -> Iterator[tuple[str, Floats]]:
    """Yield each part of a scene with the distances of an arm's links from it, (C, 4)."""
    parts: list[tuple[str, Callable[[Floats, Floats], Floats]]] = []
    if scene.tissue is not None:
        parts.append(("tissue", partial(scene.tissue.from_lines_mm, within_mm=CLEARANCE_SEEN_MM + RADII_MM.max())))
    parts += [(f"box {k}", box.from_lines_mm) for k, box in enumerate(scene.boxes)]
    if body == PSM_A:
        parts += [(f"capsule {k}", capsule.from_lines_mm) for k, capsule in enumerate(scene.capsules)]
    for part, from_lines_mm in parts:
        yield part, np.min([from_lines_mm(one.begin_mm, one.end_mm) for one in links], axis=0) - RADII_MM


def _nearest(
    trajectory: Trajectory, body: str, part: str, looks: Ints, apart_mm: Floats
) -> tuple[float, NearestToScene]:
    """Return the least distance of an arm from a part, NaN before all, and where it is."""
    look, link = np.unravel_index(int(np.nan_to_num(apart_mm, nan=-np.inf).argmin()), apart_mm.shape)
    sample, least = int(looks[look]), float(apart_mm[look, link])
    tip = trajectory.tip_mm[sample] if body == PSM_A else psm_m_poses(trajectory, looks[look : look + 1])[0][0]
    return least, NearestToScene(
        body=body,
        link=LINKS[link],
        part=part,
        least_mm=least,
        sample=sample,
        pass_index=int(trajectory.pass_index[sample]),
        phase=PHASES[trajectory.phase[sample]],
        stamp_s=float(trajectory.stamps_s[sample]),
        tip_mm=xyz(tip),
    )
