"""Usual mistakes of units, order and frames in a plan's request: what else its numbers may have meant.

    PlanIn --readings--> a sentence, and the request that was meant, for each

None is ever applied by itself: a refusal names the one under which the plan would fit.
"""

from collections.abc import Iterator

import numpy as np

from skills.arrays import xyz
from skills.kinematics import matrix_of, quaternion_of
from skills.schemas.plans import BaseIn, PlanIn, PsmMIn

MIRROR_X = np.diag([-1.0, 1.0, 1.0])


def readings(request: PlanIn) -> Iterator[tuple[str, PlanIn]]:
    """Yield other readings of a request, each one mistake away."""
    upright = (0.0, 0.0, 0.0, 1.0)
    read = [
        point.model_copy(update={"rotation_xyzw": w_first(point.rotation_xyzw)})
        if point.rotation_xyzw != upright
        else point
        for point in request.suture_points
    ]
    if read != request.suture_points:
        other = request.model_copy(update={"suture_points": read})
        yield "with the rotations of the suture points as w, x, y, z", other
    psm_m = request.psm_m
    if psm_m is None:
        return
    if psm_m.approach is not None:
        away = xyz(-np.array(psm_m.approach))
        yield "with the approach reversed, from PSM_M to the needle", _with(request, psm_m, approach=away)
    if psm_m.base is None:
        return
    place, turn = np.array(psm_m.base.position_mm), matrix_of(np.array([psm_m.base.rotation_xyzw]))[0]
    if psm_m.approach is not None:
        there = xyz(turn @ np.array(psm_m.approach))
        yield "with the approach in the frame of PSM_M's own base", _with(request, psm_m, approach=there)
    order = psm_m.base.model_copy(update={"rotation_xyzw": w_first(psm_m.base.rotation_xyzw)})
    yield "with the rotation of PSM_M's base as w, x, y, z", _with(request, psm_m, base=order)
    metres = psm_m.base.model_copy(update={"position_mm": xyz(1000.0 * place)})
    yield "with the position of PSM_M's base in metres", _with(request, psm_m, base=metres)
    inverse = _base(-turn.T @ place, turn.T)
    yield "with the base of PSM_A in PSM_M's frame, the inverse", _with(request, psm_m, base=inverse)
    mirrored = _base(MIRROR_X @ place, MIRROR_X @ turn @ MIRROR_X)
    yield "with left and right exchanged, x negated", _with(request, psm_m, base=mirrored)


def w_first(given: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return a quaternion as x, y, z, w whose numbers were given as w, x, y, z."""
    w, x, y, z = given
    return x, y, z, w


def _base(place: np.ndarray, turn: np.ndarray) -> BaseIn:
    x, y, z, w = quaternion_of(turn[None])[0].tolist()
    return BaseIn(position_mm=xyz(place), rotation_xyzw=(x, y, z, w))


def _with(request: PlanIn, psm_m: PsmMIn, **changes: object) -> PlanIn:
    return request.model_copy(update={"psm_m": psm_m.model_copy(update=changes)})
