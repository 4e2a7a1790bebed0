"""Plans whose numbers were meant in another unit, order or frame: refused, with the reading under which they fit."""

import math
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from skills.db.models import Plan
from skills.db.session import Database
from skills.errors import BadPlan
from skills.kinematics import matrix_of, quaternion_of
from skills.library.plans.plans import plan_sutures
from skills.schemas.plans import PlanIn
from tests.library import cases

POINT, APPROACH, BASE_MM = (5.0, 55.0, -125.0), (-0.94, 0.10, -0.33), (160.0, 20.0, 20.0)
HALF = math.radians(45) / 2
X, Y, Z, W = BASE_XYZW = (0.0, 0.0, math.sin(HALF), math.cos(HALF))
TURN = matrix_of(np.array([BASE_XYZW]))[0]
INVERSE_MM = tuple((-TURN.T @ np.array(BASE_MM)).tolist())
INVERSE_XYZW = tuple(quaternion_of(TURN.T[None])[0].tolist())


def planned(database: Database, base_mm: Any = BASE_MM, xyzw: Any = BASE_XYZW, **changes: Any) -> None:
    base = {"position_mm": base_mm, "rotation_xyzw": xyzw}
    asked = {"surgeon": "kestrel", "suture": cases.SUTURE, "suture_points": [{"position_mm": POINT}]}
    asked |= {"psm_m": {"approach": changes.pop("approach", APPROACH), "base": base}, "tissue_mm": -170.0}
    plan_sutures(database, PlanIn.model_validate(asked | changes), "test")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"base_mm": (0.16, 0.02, 0.02)}, "Read with the position of PSM_M's base in metres, every pass is within"),
        ({"xyzw": (W, X, Y, Z)}, "Read with the rotation of PSM_M's base as w, x, y, z, every pass is within reach"),
        ({"base_mm": INVERSE_MM, "xyzw": INVERSE_XYZW}, "with the base of PSM_A in PSM_M's frame, the inverse"),
        ({"base_mm": (-160.0, 20.0, 20.0), "xyzw": (0.0, 0.0, -Z, W)}, "with left and right exchanged, x negated"),
        ({"approach": (0.94, -0.10, 0.33)}, "with the approach reversed, from PSM_M to the needle"),
        ({"tissue_mm": -17.0}, "below tissue at a height of -17 mm; this seems to be in centimetres. Give -170 mm."),
        ({"tissue_mm": -0.17}, "this seems to be in metres. Give -170 mm."),
    ],
)
def test_a_usual_mistake_is_named_and_not_applied(database: Database, changes: dict[str, Any], words: str):
    cases.trained(database, release=True)
    planned(database)
    with pytest.raises(BadPlan) as refused:
        planned(database, **changes)
    assert words in str(refused.value)
    with database.reading() as session:
        assert len(session.scalars(select(Plan)).all()) == 1


def test_where_no_reading_fits_none_is_named(database: Database):
    cases.trained(database, release=True)
    with pytest.raises(BadPlan) as refused:
        planned(database, suture_points=[{"position_mm": (5.0, 555.0, -125.0)}])
    assert "is that meant" not in str(refused.value)
