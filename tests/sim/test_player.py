"""Playing a trajectory: what comes back is checked, and the verdict on it is right."""

import importlib.util
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest

from skills.errors import BadInput, SimulationFailed
from skills.sim import scene
from skills.sim.player import default_pad_top, play
from skills.style.kinematics import POINTING_DOWN
from skills.style.playback import Playback, WaitingArm, judge
from skills.style.trajectory import PassPath, time_parametrise
from tests.style.motions import hand_off, small_trajectory

needs_pybullet = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None,
    reason="PYBULLET IS NOT INSTALLED: the playback in the simulator is not tested here",
)
TRAJECTORY = small_trajectory(passes=2, rate_hz=60.0)


@pytest.fixture(scope="module")
def played() -> Playback:
    return play(TRAJECTORY)


# ---- the simulator ---------------------------------------------------------------------------------------------


@needs_pybullet
def test_a_small_plan_is_feasible(played):
    report = judge(played, TRAJECTORY)
    assert report.feasible, report.failure
    assert report.fk_error_mm < 1e-4
    assert report.fk_error_deg < 1e-3
    assert report.tracking_max_mm < 1e-3
    assert report.clearance_pad_mm == pytest.approx(4.95, abs=0.1)  # 5 mm, and the open fingers' corners
    assert report.clearance_psm_m_mm is None
    assert report.engine == "PyBullet 3.2.7"
    assert played.picture_png.startswith(b"\x89PNG")


@needs_pybullet
def test_the_same_trajectory_gives_the_same_report_and_bytes_in_another_process(played):
    again = play(TRAJECTORY)
    assert judge(again, TRAJECTORY) == judge(played, TRAJECTORY)
    for field in fields(Playback):
        if field.name != "seconds_per_step":
            one, other = getattr(played, field.name), getattr(again, field.name)
            assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), field.name


@needs_pybullet
def test_jaws_in_the_pad_are_named():
    report = judge(play(TRAJECTORY, pad_top_mm=-140.0), TRAJECTORY)
    assert report.failure is not None
    assert (report.failure.quantity, report.failure.sample, report.failure.phase) == ("clearance to the pad", 0, 1)
    assert report.clearance_pad_mm < -3.0


@needs_pybullet
def test_the_picture_shows_every_pass(played):
    from io import BytesIO

    from PIL import Image

    from skills.sim.pictures import PASS_COLOURS

    image = np.asarray(Image.open(BytesIO(played.picture_png)).convert("RGB"), int)
    assert image.shape == (480, 640, 3)
    for colour in PASS_COLOURS[:2]:
        near = np.abs(image - colour).sum(axis=2) < 60
        assert near.sum() > 50  # pixels
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 500


@needs_pybullet
def test_psm_m_beside_it_is_at_the_distance_worked_by_hand():
    still = time_parametrise([hand_off(with_a2=False)], rate_hz=60.0)
    last = still.joints[-1:]
    # The same pose, 40 mm along x: two parallel shafts of 8 mm, whose lines are 40 mm sqrt(1 - s_x^2) apart.
    beside = WaitingArm([40.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], last, enters_after_a1=False)
    along_x = np.cos(last[0, 1]) * np.sin(last[0, 0])
    playback = play(still, psm_m=beside)
    assert playback.clearance_psm_m_mm is not None
    assert playback.clearance_psm_m_mm[-1] == pytest.approx(40.0 * np.sqrt(1 - along_x**2) - 8.0, abs=1e-3)
    report = judge(playback, still)
    # On the way the yaws differ by 13 degrees, and above the remote centres the shafts cross.
    assert report.failure is not None
    assert report.failure.quantity == "clearance to PSM_M"


@needs_pybullet
def test_psm_m_in_the_way_is_named_and_one_that_enters_after_a1_is_not():
    still = time_parametrise([hand_off(with_a2=False)], rate_hz=60.0)
    pose = [1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], still.joints[-1:]
    failure = judge(play(still, psm_m=WaitingArm(*pose, enters_after_a1=False)), still).failure
    assert failure is not None
    assert failure.quantity == "clearance to PSM_M"
    assert judge(play(still, psm_m=WaitingArm(*pose)), still).feasible


@needs_pybullet
def test_the_si_plays_beyond_the_classics_limits():
    deep = PassPath([[0, 60, -235], [0, 60, -230]], POINTING_DOWN)
    motion = time_parametrise([deep], instrument="420006", rate_hz=60.0)
    assert motion.joints[:, 2].max() > 240.0
    report = judge(play(motion), motion)
    assert report.feasible, report.failure


@needs_pybullet
def test_a_pass_of_a2_alone_is_played_and_pictured():
    alone = PassPath(hand_off().tip_mm[-1:], POINTING_DOWN, hand_off().target_rotation)
    motion = time_parametrise([alone], rate_hz=60.0)
    assert judge(play(motion), motion).feasible


def test_importing_the_simulators_package_does_not_need_pybullet():
    code = "import sys; sys.modules['pybullet'] = None; import skills.sim.player, skills.sim.scene"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---- what comes back -------------------------------------------------------------------------------------------


def faulty(fault: str) -> Playback:
    return play(TRAJECTORY, target=f"tests.sim.faults:{fault}", timeout_s=20.0)


def test_a_sound_answer_is_taken_whoever_gives_it():
    assert judge(faulty("sound"), TRAJECTORY).feasible


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("crash", "crashed"),
        ("eat_memory", "out of memory"),
        ("garbage", "nonsense"),
        ("nothing", "nonsense"),
        ("pickled", "nonsense"),
        ("not_a_number", "nonsense"),
        ("too_short", "nonsense"),
        ("whole_numbers", "nonsense"),
        ("no_picture", "nonsense"),
        ("incomplete", "nonsense"),
    ],
)
def test_a_faulty_simulator_is_refused_by_its_fault(fault, cause):
    with pytest.raises(SimulationFailed) as caught:
        faulty(fault)
    assert caught.value.numbers["cause"] == cause


def test_a_simulator_that_hangs_is_refused():
    with pytest.raises(SimulationFailed, match=r"within 0\.5 s"):
        play(TRAJECTORY, target="tests.sim.faults:hang", timeout_s=0.5)


def test_without_pybullet_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setattr(scene.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulationFailed, match="pip install pybullet"):
        play(TRAJECTORY)


def test_a_pad_without_a_height_and_a_pass_without_psm_m_are_refused():
    with pytest.raises(BadInput, match="height"):
        play(TRAJECTORY, pad_top_mm=float("nan"))
    with pytest.raises(BadInput, match="one for each"):
        play(TRAJECTORY, psm_m=WaitingArm([0, 0, 0], [0, 0, 0, 1], np.zeros((1, 6))))


def test_the_pad_lies_under_the_finger_tips_and_not_under_the_hinge():
    assert default_pad_top(time_parametrise([hand_off(with_a2=False)])) == pytest.approx(-135 - 10.2 - 5, abs=0.5)


def test_a_trajectory_that_was_tampered_with_is_found_out():
    tips = TRAJECTORY.tip_mm.copy()
    tips[7] += [0.0, 0.0, 0.05]
    bent = replace(TRAJECTORY, tip_mm=tips)
    failure = judge(play(TRAJECTORY, target="tests.sim.faults:sound"), bent).failure
    assert failure is not None
    assert (failure.sample, failure.quantity) == (7, "tip off the closed form")
