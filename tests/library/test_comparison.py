"""A recorded replay compared with its plan."""

import numpy as np
import pytest

from skills.db.models import Demonstration, Plan
from skills.db.session import Database
from skills.errors import BadPlan, NotFound
from skills.library.plans.plans import find_plan, trajectory_of
from skills.library.plans.replay_comparison import compare_with_plan
from tests.library import cases
from tests.library.cases import fetch


def stored(database: Database, bag: bytes, surgeon: str) -> Demonstration:
    return cases.store(database, cases.upload(bag, "application/vnd.mcap"), surgeon, segment="whole")


@pytest.fixture
def plan(database: Database) -> Plan:
    cases.add_surgeon(database, "robot")
    stored(database, cases.bag("PSM2"), "kestrel")
    cases.train(database, release=True)
    return cases.add_plan(database)


def recorded(database: Database, plan: Plan, *, off_mm: tuple[float, float, float], arm: str = "PSM2") -> Demonstration:
    """Record a replay with an offset of the tip, at a different sampling rate."""
    with database.reading() as session:
        tip_mm = trajectory_of(find_plan(session, plan.sha256).plan).tip_mm
    return stored(database, cases.bag(arm, tip=tip_mm[::3] + off_mm), "robot")


def test_a_replay_that_was_off_by_a_millimetre_is_said_to_be(database: Database, plan: Plan):
    demo = recorded(database, plan, off_mm=(0.0, 0.0, 1.0))
    found = fetch(database, compare_with_plan, plan.sha256, demo.sha256)
    assert found.start_mm == pytest.approx(1.0, abs=1e-9)
    assert found.end_mm == pytest.approx(1.0, abs=0.1)  # mm; the last sample was not recorded
    assert 0.4 <= found.mean_mm <= 1.0  # the offset is along z, where the alignment can shift the paths
    assert found.max_mm <= 1.2
    assert found.recorded_s > found.planned_s > 1


def test_a_replay_that_went_as_planned_is_nowhere_off(database: Database, plan: Plan):
    demo = recorded(database, plan, off_mm=(0.0, 0.0, 0.0))
    found = fetch(database, compare_with_plan, plan.sha256, demo.sha256)
    assert found.mean_mm < 0.1
    assert np.max(found.rmse_mm) < 0.2
    assert found.max_mm < 0.5


def test_a_recording_of_another_arm_or_of_nothing_is_refused(database: Database, plan: Plan):
    demo = recorded(database, plan, off_mm=(0.0, 0.0, 0.0), arm="PSM1")
    with database.reading() as session:
        with pytest.raises(BadPlan, match="recording is of PSM1 in 'PSM1_base'"):
            compare_with_plan(session, plan.sha256, demo.sha256)
        with pytest.raises(BadPlan, match="0 to 0"):
            compare_with_plan(session, plan.sha256, find_plan(session, plan.sha256).policy.demonstration.sha256, 1)
        with pytest.raises(NotFound):
            compare_with_plan(session, plan.sha256, "0" * 64)
