"""Faults planted in a plan, in the scene or in the simulator: each is detected and named."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest

from skills.db.models import Plan, StoredPlayback
from skills.db.session import Database
from skills.dynamics import Servo
from skills.errors import BadPlan, SimulationFailed, Unreachable
from skills.kinematics import POINTING_DOWN, forward, inverse, matrix_of, quaternion_of
from skills.library.people.surgeons import find_surgeon
from skills.library.plans.playbacks import find_playback, request_playback
from skills.library.policies import releases
from skills.library.recordings.demos import upload_demo
from skills.planning import handoff
from skills.planning.handoff import OtherArm
from skills.planning.trajectory import A1, PassPath, Trajectory, time_parametrise
from skills.schemas.demos import DemoIn
from skills.schemas.recordings import TableIn
from skills.settings import Settings
from skills.simulation.player import play
from skills.verification.deviations import LIMITS
from skills.verification.gates import Limits
from skills.verification.verdict import PlaybackReport, judge
from tests import backends
from tests.bench.playing import stacked
from tests.library import cases
from tests.planning.motions import PSM_M, hand_off, small_trajectory
from tests.verification.hands import about

pytestmark = pytest.mark.needs("simulator")
MOTION = small_trajectory(passes=2, rate_hz=60.0)


def found(trajectory: Trajectory, **how: float) -> PlaybackReport:
    """Play it, and assert that a fault was found."""
    report = judge(play(trajectory, **how), trajectory)
    assert not report.feasible
    assert report.failure is not None
    return report


def moved(trajectory: Trajectory, joints: np.ndarray) -> Trajectory:
    """Return the same trajectory with other joints and consistent poses."""
    tip, rotation = forward(joints, trajectory.instrument)
    return replace(trajectory, joints=joints, tip_mm=tip, rotation_xyzw=quaternion_of(rotation))


# ---- in the plan -----------------------------------------------------------------------------------------------


def test_planning_refuses_an_unreachable_point_with_its_pass_and_sample():
    far = PassPath([[0, 55, -125], [0, 200, -60]], POINTING_DOWN)
    with pytest.raises(Unreachable) as caught:
        time_parametrise([hand_off(with_a2=False), far], rate_hz=60.0)
    assert (caught.value.numbers["pass"], caught.value.numbers["phase"]) == (1, A1)
    assert caught.value.numbers["sample"] > 0
    assert "pitch" in str(caught.value)


def test_a_limit_crossed_by_one_degree_is_named():
    joints = np.array(MOTION.joints)
    joints[:, 5] += np.radians(81.0) - joints[:, 5].max()
    report = found(moved(MOTION, joints))
    assert report.failure.quantity == "wrist_yaw"
    assert report.failure.limit == pytest.approx(np.radians(80.0), abs=1e-6)
    assert report.failure.limit < report.failure.value <= report.failure.limit + np.radians(1.0) + 1e-6
    assert report.arms[0].joints[5].margin == pytest.approx(-np.radians(1.0), abs=1e-6)


def test_a_speed_above_the_limits_is_named():
    hurried = replace(MOTION, rate_hz=900.0, stamps_s=MOTION.stamps_s * 60.0 / 900.0)
    assert "acceleration of" in found(hurried).failure.quantity
    halved = np.array(MOTION.stamps_s)
    halved[40:] -= 0.5 / 60.0
    failure = found(replace(MOTION, stamps_s=halved)).failure
    assert (failure.quantity, failure.sample) == ("time since the sample before", 40)


# ---- in the scene ----------------------------------------------------------------------------------------------


def test_jaws_in_the_pad_are_named():
    report = found(MOTION, pad_top_mm=-141.0)
    failure = report.failure
    assert (failure.sample, failure.pass_index, failure.phase) == (0, 0, A1)
    assert failure.quantity.startswith("clearance of PSM_A finger_")
    assert failure.quantity.endswith("to the pad")
    assert -5.0 < report.clearance_pad_mm < -3.0


def test_where_an_arm_may_press_into_the_pad_its_force_is_what_is_judged():
    lenient = Limits(clearance_pad_mm=-10.0)
    report = judge(play(MOTION, servo=Servo(), pad_top_mm=-141.0), MOTION, lenient)
    assert report.failure is not None
    assert report.failure.quantity == "force of contact"
    assert report.failure.value > report.failure.limit == 1.0


def test_psm_m_in_the_way_during_a1_is_named_with_the_links():
    """PSM_M waits across the path; the same arm that arrives after A1, as planned, is no fault."""
    one = stacked(passes=1, rate_hz=60.0)
    assert judge(play(one), one).feasible
    middle = int(np.flatnonzero(one.phase == A1)[len(np.flatnonzero(one.phase == A1)) // 2])
    base = matrix_of(one.psm_m.base_xyzw[None])[0]
    jaws = base.T @ matrix_of(one.rotation_xyzw[middle][None])[0]
    place = (one.tip_mm[middle] + [0.0, 0.0, 2.0] - one.psm_m.base_mm) @ base
    waiting = np.tile(inverse(place[None], jaws[None]), (len(one), 1))
    blocked = replace(one, psm_m=replace(one.psm_m, joints=waiting))
    failure = found(blocked, pad_top_mm=-160.0).failure
    assert failure.phase == A1
    assert failure.sample <= middle
    assert "to PSM_M" in failure.quantity
    assert "clearance of PSM_A" in failure.quantity


def test_psm_m_beyond_its_own_limit_is_named_as_psm_m():
    one = stacked(passes=1, rate_hz=60.0)
    joints = np.array(one.psm_m.joints)
    joints[:, 1] += np.radians(54.0) - joints[:, 1].max()
    outside = replace(one, psm_m=OtherArm(one.psm_m.base_mm, one.psm_m.base_xyzw, "400006", joints))
    failure = found(outside).failure
    assert failure.quantity == "PSM_M's pitch"
    assert failure.limit == pytest.approx(np.radians(53.0), abs=1e-6)


def test_psm_m_in_the_pad_is_named():
    """It stands 150 mm from PSM_A, upright, its hinge 3 mm above the pad: open by 30 degrees, its fingers are in it.

    A finger's axis is 9.1 mm long and 0.6 mm from the middle, its round end has a radius of 1.1 mm.
    """
    one = time_parametrise([hand_off(with_a2=False)], rate_hz=60.0)
    joints = np.tile(inverse([[-75.0, 55.0, -148.0]], POINTING_DOWN), (len(one), 1))
    both = replace(one, psm_m=OtherArm([110.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], "400006", joints))
    failure = found(both, pad_top_mm=-151.0).failure
    assert failure.sample == 0
    assert failure.quantity.startswith("clearance of PSM_M finger_")
    assert failure.value == pytest.approx(3.0 - (9.1 * cos(radians(30)) - 0.6 * sin(radians(30)) + 1.1), abs=0.01)


# ---- in the simulator ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("crash", "crashed"),
        ("eat_memory", "out of memory"),
        ("garbage", "nonsense"),
        ("nan_joint", "nonsense"),
        ("nan_clearance", "nonsense"),
        ("not_a_number", "nonsense"),
    ],
)
def test_a_faulty_simulator_gives_no_verdict(fault, cause):
    with pytest.raises(SimulationFailed) as caught:
        play(MOTION, target=f"tests.simulation.faults:{fault}", timeout_s=30.0)
    assert caught.value.numbers["cause"] == cause


def test_a_simulator_that_hangs_gives_no_verdict():
    with pytest.raises(SimulationFailed, match="did not finish") as caught:
        play(MOTION, target="tests.simulation.faults:hang", timeout_s=0.5)
    assert caught.value.numbers["cause"] == "hung"


# ---- in the library --------------------------------------------------------------------------------------------


@pytest.fixture
def databases(tmp_path: Path) -> Iterator[tuple[Database, Database]]:
    """Yield two independent databases, with the same style trained and released."""
    urls = [backends.fresh("sqlite", tmp_path) for _ in range(2)]
    both = [Database(url) for url in urls]
    for one in both:
        cases.add_surgeon(one)
        cases.add_demo(one)
        cases.train(one, release=True)
    yield both[0], both[1]
    for one, url in zip(both, urls, strict=True):
        one.close()
        backends.drop(url)


def played(database: Database, plan: Plan) -> StoredPlayback:
    with database.writing() as session:
        job, *_ = request_playback(session, plan.sha256, "test", Settings())
    job = cases.work(database, job)
    assert job.state == "succeeded", job.error
    with database.reading() as session:
        return find_playback(session, job.result["playback"])


@pytest.mark.nightly  # by day tests/simulation/test_player.py, in another process
def test_the_same_plan_has_the_same_playback_in_another_database(databases):
    one, other = (played(database, cases.add_plan(database)) for database in databases)
    assert one.sha256 == other.sha256
    assert one.report == other.report
    assert one.report.feasible is True
    assert {deviation.kind for deviation in one.report.intent} == set(LIMITS)
    assert one.report.plan == one.plan.sha256
    assert one.report.files.keys() == {"psm.urdf", "suture_pad.urdf", "needle.urdf"}
    assert one.report.arms[0].instrument.arm.remote_centre_mm == 431.8


def test_a_mistake_of_planning_is_found_by_the_service(databases, monkeypatch):
    """A2 is planned 30 degrees off; plan and trajectory agree on it."""

    def wrong(rotation, approach_m):
        found = handoff.realign(rotation, approach_m)
        return replace(found, rotation=about(np.array(approach_m), radians(30)) @ found.rotation)

    monkeypatch.setattr("skills.planning.plan.realign", wrong)
    database, _ = databases
    found = played(database, cases.add_plan(database, psm_m={"approach": PSM_M})).report
    assert (found.feasible, found.failure.quantity) == (False, "A2 off the paper's hand-off")
    assert found.failure.value == pytest.approx(30.0)
    assert "A2 off the paper's hand-off is 30 deg, the limit is 0.1" in found.failure_sentence


def test_a_policy_withdrawn_after_planning_is_told_with_the_playback(databases):
    database, _ = databases
    plan = cases.add_plan(database)
    with database.reading() as session:
        before = played(database, plan)
        assert releases.serves(session, find_playback(session, before.sha256).plan.policy)
    with database.writing() as session:
        releases.withdraw(session, find_surgeon(session, "kestrel"), cases.SUTURE, "test")
    with database.reading() as session:
        assert not releases.serves(session, find_playback(session, before.sha256).plan.policy)
    assert played(database, plan).sha256 == before.sha256  # playing it again is harmless, and the verdict is the same


def test_a_plan_in_another_frame_than_the_arms_base_is_refused(databases):
    database, _ = databases
    upload_demo(
        database,
        cases.upload(cases.hand_off((5.0, 0.0, 0.0)), reading=TableIn(frame="ECM")),
        DemoIn(surgeon="kestrel", suture=cases.SUTURE),
        "test",
    )
    version = cases.train(database)
    plan = cases.add_plan(database, version=version.version)
    assert plan.about.frame == "ECM"
    with database.writing() as session, pytest.raises(BadPlan, match="not the frame of the arm's base"):
        request_playback(session, plan.sha256, "test", Settings())


# ---- decisions by the plan alone -------------------------------------------------------------------------------

REPORTED = """
import hashlib
from dataclasses import asdict
from skills.packing import canonical
from skills.settings import Settings
from skills.simulation.player import play
from skills.verification.verdict import judge
from tests.bench.playing import stacked
one = stacked(passes=1, rate_hz=60.0)
print(canonical(asdict(judge(play(one), one))).decode())
"""


@pytest.mark.nightly  # by day `test_player` compares two processes
def test_two_processes_report_the_same_bytes():
    said = []
    for seed in ("1", "2"):
        environment = {"PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(__file__).parents[2])}
        code = [sys.executable, "-c", REPORTED]
        said.append(subprocess.run(code, check=True, capture_output=True, env=environment).stdout)
    assert said[0] == said[1]
    report = json.loads(said[0])
    assert report["feasible"] is True
    assert report["psm_m_in_scene"] is True
