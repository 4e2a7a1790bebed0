"""A style at another wound line: a demonstration turned, scaled and moved, so that its shape stays what it was.

    Demo, start, goal --moved--> Demo

A plan turns and moves the passes of a policy as they are (`plan.stack`). Where start and goal are further apart than in
the demonstration, or nearer, a pass has to be scaled too, and by the same factor in every direction: only then is the
shape the surgeon's. So the demonstration is moved, before it is put into its grid and learnt from, and all that is
certified of a policy holds of this one as well. Of the turns that bring the way from start to goal onto the new one,
the one is taken that keeps its upside up (`comparing.shapes.placed`); gravity and the arm above the wound turn with
nothing. Ours; the paper moves passes only.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadPath
from skills.style._arrays import Floats, frozen
from skills.style.comparing.shapes import placed
from skills.style.demo import Demo
from skills.style.kinematics import matrix_of, quaternion_of

SCALES = (0.25, 4.0)  # ours: a stitch of 10 mm is no picture of one above 40, and tremor would become motion


def moved(demo: Demo, start_mm: ArrayLike, goal_mm: ArrayLike) -> Demo:
    """Move a demonstration, so that it begins at a start and ends at a goal, (3,) mm in its own frame.

    The tool turns with it. Time stays, so speeds are scaled. Where the other arm takes the needle there, nobody knows:
    `partner` is None.

    Raises:
        BadPath: The demonstration or the new way ends within a millimetre of its start, or the one is not between
            `SCALES` times as long as the other.
    """
    start, goal = (frozen(one, np.float64, (3,), name) for one, name in ((start_mm, "start_mm"), (goal_mm, "goal_mm")))
    scale = np.linalg.norm(goal - start) / max(np.linalg.norm(demo.tip_mm[-1] - demo.tip_mm[0]), np.finfo(float).tiny)
    if not SCALES[0] <= scale <= SCALES[1]:
        raise BadPath(
            f"From its start to its goal the new way is {scale:.3g} times as long as the demonstrated one; a style is "
            f"scaled by {SCALES[0]:g} to {SCALES[1]:g}.",
            scale=float(scale),
        )
    tip_mm = laid(placed(demo.tip_mm, scaled=True), start, goal)
    turn = axes(start, goal).T @ axes(demo.tip_mm[0], demo.tip_mm[-1])
    seen = demo.rotation_xyzw
    rotation = None if seen is None else quaternion_of(turn @ matrix_of(seen))
    return replace(demo, tip_mm=tip_mm, rotation_xyzw=rotation, partner=None)


def laid(shape: Floats, start_mm: Floats, goal_mm: Floats) -> Floats:
    """Lay a shape in lengths of start to goal, (T, 3), between a start and a goal: what `placed(scaled=True)` undoes.

    Raises:
        BadPath: They lie within a millimetre of each other.
    """
    length_mm = np.linalg.norm(goal_mm - start_mm)
    return np.asarray(start_mm + length_mm * shape @ axes(start_mm, goal_mm))


def axes(start_mm: Floats, goal_mm: Floats) -> Floats:
    """Give the axes of a hand-off's own frame as rows, (3, 3): along the way, sideways and upwards.

    Raises:
        BadPath: Start and goal lie within a millimetre of each other.
    """
    return placed(np.stack([start_mm, *(start_mm + np.eye(3)), goal_mm]))[1:4].T
