"""Playing a trajectory: the response is checked, and its verdict is correct."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from skills.db import models  # noqa: F401 - it declares what has a digest
from skills.db.packed import digest
from skills.errors import BadInput, SimulationFailed
from skills.kinematics import POINTING_DOWN
from skills.planning.handoff import OtherArm
from skills.planning.trajectory import PSM_M, PassPath, Trajectory, time_parametrise
from skills.simulation import simulator
from skills.simulation.player import default_pad_top, play
from skills.verification.gates import Limits
from skills.verification.playback import Playback
from skills.verification.verdict import judge
from tests.bench.playing import stacked
from tests.by_day import some
from tests.planning.motions import hand_off, small_trajectory
from tests.planning.test_hand import at_home, recorded_psm_m, turning
from tests.planning.test_trajectory import BESIDE

needs_simulator = pytest.mark.needs("simulator")
TRAJECTORY = small_trajectory(passes=2, rate_hz=60.0)


@pytest.fixture(scope="module")
def played() -> Playback:
    return play(TRAJECTORY)


# ---- the simulator ---------------------------------------------------------------------------------------------


@needs_simulator
def test_a_small_plan_is_feasible(played):
    report = judge(played, TRAJECTORY)
    assert report.feasible, report.failure
    assert report.fk_error_mm < 1e-4
    assert report.fk_error_deg < 1e-3
    assert report.shaft_off_mm < 1e-4
    assert report.clearance_pad_mm == pytest.approx(5.0, abs=0.1)  # the fingers are a little open, and round
    assert report.clearance_psm_m_mm is None
    assert report.engine == "PyBullet 3.2.7"
    assert played.picture_png.startswith(b"\x89PNG")


@needs_simulator
def test_the_same_trajectory_gives_identical_bytes_in_another_process(played):
    again = play(TRAJECTORY)
    assert judge(again, TRAJECTORY) == judge(played, TRAJECTORY)
    assert digest(again) == digest(played)


@needs_simulator
def test_the_picture_shows_every_pass(played):
    from io import BytesIO

    from PIL import Image

    from skills.simulation.pictures import PASS_COLOURS

    image = np.asarray(Image.open(BytesIO(played.picture_png)).convert("RGB"), int)
    assert image.shape == (480, 640, 3)
    for colour in PASS_COLOURS[:2]:
        near = np.abs(image - colour).sum(axis=2) < 60
        assert near.sum() > 50  # pixels
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 500


def with_psm_m(motion: Trajectory, base_mm: list[float], joints: np.ndarray) -> Trajectory:
    """Add PSM_M to a motion, its base oriented as PSM_A's is."""
    return replace(motion, psm_m=OtherArm(base_mm, [0.0, 0.0, 0.0, 1.0], "400006", joints))


@needs_simulator
def test_psm_m_beside_it_is_at_the_distance_worked_by_hand():
    still = time_parametrise([hand_off(with_a2=False)], rate_hz=60.0)
    last = still.joints[-1:]
    # The same pose, 40 mm along x: two parallel shafts of 8 mm, whose lines are 40 mm sqrt(1 - s_x^2) apart.
    beside = with_psm_m(still, [40.0, 0.0, 0.0], np.tile(last, (len(still), 1)))
    along_x = np.cos(last[0, 1]) * np.sin(last[0, 0])
    playback = play(beside)
    column = [str(pair) for pair in playback.link_pairs].index("PSM_A roll_link to PSM_M roll_link")
    assert playback.clearances_mm[-1, column] == pytest.approx(40.0 * np.sqrt(1 - along_x**2) - 8.0, abs=1e-3)
    report = judge(playback, beside, Limits(clearance_bodies_mm=-1000.0))  # remote centres cannot be so near
    # On the way the yaws differ by 13 degrees, and above the remote centres the shafts cross.
    assert report.failure is not None
    assert report.failure.quantity == "clearance of PSM_A roll_link to PSM_M roll_link"
    assert report.psm_m_fk_error_mm < 1e-4


@needs_simulator
def test_a_recorded_hand_off_is_played_with_both_arms():
    shown = replace(recorded_psm_m(), base_mm=BESIDE.base_mm, base_xyzw=BESIDE.base_xyzw)
    both, plan = at_home(psm_m=shown, rate_hz=100.0)
    playback = play(both)
    report = judge(playback, both)
    assert report.feasible, report.failure
    assert plan.a2 == "recorded" and report.psm_m_in_scene
    assert playback.psm_m_tip_mm[-1] == pytest.approx(shown.taken_mm, abs=1e-3)
    demo, _ = turning()
    assert playback.tip_mm[-1] == pytest.approx(demo.tip_mm[-1], abs=1e-3)


@needs_simulator
def test_a_two_arm_hand_off_is_feasible_and_reports_its_nearest_links():
    both = stacked(passes=2, rate_hz=100.0)
    report = judge(play(both), both)
    assert report.feasible, report.failure
    assert report.psm_m_in_scene
    assert [arm.name for arm in report.arms] == ["PSM_A", PSM_M]
    assert report.ends[0].n_to_a_m_deg == pytest.approx(0.0, abs=1e-6)
    assert report.ends[0].a_to_a_m_deg == pytest.approx(90.0, abs=1e-6)
    at_hand_off = next(one for one in report.clearances if one.phase == "A2" and one.other == PSM_M)
    # A quarter of the needle's circle apart, and PSM_M's fingers open, one of them towards PSM_A's wrist.
    assert (at_hand_off.link, at_hand_off.other_link) == ("wrist_pitch_link", "finger_2")
    assert at_hand_off.least_mm == pytest.approx(7.3, abs=0.1)
    assert at_hand_off.at_least_mm <= at_hand_off.least_mm
    assert {one.phase for one in report.needle} == {"transfer", "A1", "A2"}


@pytest.mark.nightly  # by day test_clearance compares bounds with every sample
@needs_simulator
def test_looking_at_every_sample_finds_nothing_nearer_than_the_bounds():
    both = stacked(passes=1, rate_hz=100.0)
    seldom, always = judge(play(both, clearance_every=12), both), judge(play(both, clearance_every=1), both)
    assert always.looks == len(both)
    assert always.moved_between_looks_mm < seldom.moved_between_looks_mm
    everywhere = {(one.phase, one.body, one.link, one.other, one.other_link): one for one in always.clearances}
    for one in seldom.clearances:
        true_mm = everywhere[one.phase, one.body, one.link, one.other, one.other_link].least_mm
        assert one.at_least_mm - 1e-6 <= true_mm <= one.least_mm + 1e-6


@needs_simulator
def test_where_surfaces_are_close_every_sample_is_looked_at():
    one = time_parametrise([hand_off(with_a2=False)], rate_hz=60.0)
    low = play(one, pad_top_mm=default_pad_top(one) + 4.0)
    near = np.flatnonzero(np.diff(low.looked_at) == 1)
    assert len(low.looked_at) > len(one) / 4 + 10
    assert low.clearances_mm[near].min() == low.clearances_mm.min()


@pytest.mark.nightly  # by day rows of two passes
@needs_simulator
def test_a_long_row_of_passes_has_a_pad_under_all_of_it():
    far = time_parametrise([hand_off(-25.0 * k, with_a2=False) for k in range(6)], rate_hz=20.0, speed_mm_s=40.0)
    report = judge(play(far, pad_top_mm=-150.0), far)
    ends = [one.sample for one in report.clearances if one.link == "finger_1"]
    assert report.feasible, report.failure
    assert ends
    sunk = judge(play(far, pad_top_mm=-135.0), far)
    assert sunk.failure is not None
    assert sunk.failure.sample == 0


@needs_simulator
def test_the_si_plays_beyond_the_classics_limits():
    deep = PassPath([[0, 60, -235], [0, 60, -230]], POINTING_DOWN)
    motion = time_parametrise([deep], instrument="420006", rate_hz=60.0)
    assert motion.joints[:, 2].max() > 240.0
    report = judge(play(motion), motion)
    assert report.feasible, report.failure


@needs_simulator
@pytest.mark.parametrize(("instrument", "further_in_mm"), some([("400006-Si", 50.8), ("420006-Classic", -50.8)], 2))
def test_an_instrument_on_the_other_arm_plays_the_same_motion(played, instrument, further_in_mm):
    motion = time_parametrise([hand_off(-8.0 * k) for k in range(2)], instrument=instrument, rate_hz=60.0)
    np.testing.assert_allclose(motion.joints[:, 2], TRAJECTORY.joints[:, 2] + further_in_mm, atol=1e-9)
    report = judge(play(motion), motion)
    assert report.feasible, report.failure
    assert report.fk_error_mm < 1e-4
    usual = judge(played, TRAJECTORY)
    assert report.clearance_pad_mm == pytest.approx(usual.clearance_pad_mm, abs=0.01)


@needs_simulator
def test_an_instrument_still_in_the_cannula_is_infeasible_on_any_arm():
    # The wrist is 18 mm deep: for a 400006 on a Si that is an insertion of 84 mm, which is not out of the cannula.
    high = PassPath([[0, 4, -26.5], [0, 3, -27.0]], POINTING_DOWN)
    for instrument, insertion_mm in (("400006", 33), ("400006-Si", 84)):
        motion = time_parametrise([high], instrument=instrument, rate_hz=60.0)
        assert motion.joints[:, 2].min() == pytest.approx(insertion_mm, abs=1.5)
        failure = judge(play(motion), motion).failure
        assert failure is not None
        assert "insertion out of the cannula" in failure.quantity


@needs_simulator
def test_a_pass_of_a2_alone_is_played_and_pictured():
    alone = PassPath(hand_off().tip_mm[-1:], POINTING_DOWN, hand_off().target_rotation)
    motion = time_parametrise([alone], rate_hz=60.0)
    assert judge(play(motion), motion).feasible


def test_importing_the_simulators_package_does_not_need_pybullet():
    code = "import sys; sys.modules['pybullet'] = None; import skills.simulation.player, skills.simulation.simulator"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---- the response ----------------------------------------------------------------------------------------------


def faulty(fault: str) -> Playback:
    return play(TRAJECTORY, target=f"tests.simulation.faults:{fault}")


def test_a_sound_answer_is_taken_whoever_gives_it():
    assert judge(faulty("sound"), TRAJECTORY).feasible


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("crash", "crashed"),
        ("eat_memory", "out of memory"),
        ("garbage", "nonsense"),
        ("nothing", "nonsense"),
        ("with_pickles", "nonsense"),
        ("not_a_number", "nonsense"),
        ("nan_joint", "nonsense"),
        ("nan_clearance", "nonsense"),
        ("looked_the_other_way", "nonsense"),
        ("no_such_file", "nonsense"),
        ("too_short", "nonsense"),
        ("no_numbers", "nonsense"),
        ("another_arm", "nonsense"),
        ("no_picture", "nonsense"),
        ("no_bytes", "nonsense"),
        ("no_name", "nonsense"),
        ("no_digest", "nonsense"),
        ("incomplete", "nonsense"),
    ],
)
def test_a_faulty_simulator_is_refused_by_its_fault(fault, cause):
    with pytest.raises(SimulationFailed) as caught:
        faulty(fault)
    assert caught.value.numbers["cause"] == cause


def test_its_last_words_are_a_note_and_not_in_the_message():
    with pytest.raises(SimulationFailed, match="play it again, and report it if it happens again") as caught:
        faulty("fail")
    assert "nobody knows" in caught.value.__notes__[0]
    assert "nobody knows" not in str(caught.value)


def test_a_simulator_that_hangs_is_refused():
    with pytest.raises(SimulationFailed, match=r"within 0\.5 s"):
        play(TRAJECTORY, target="tests.simulation.faults:hang", timeout_s=0.5)


def test_without_pybullet_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setattr(simulator.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulationFailed, match="pip install pybullet"):
        play(TRAJECTORY)


def test_a_pad_without_a_height_and_distances_at_no_sample_are_refused():
    with pytest.raises(BadInput, match="height"):
        play(TRAJECTORY, pad_top_mm=float("nan"))
    with pytest.raises(BadInput, match="step between samples"):
        play(TRAJECTORY, clearance_every=0)


def test_the_pad_lies_under_the_finger_tips_and_not_under_the_hinge():
    assert default_pad_top(time_parametrise([hand_off(with_a2=False)])) == pytest.approx(-135 - 10.2 - 5, abs=0.5)


def test_a_trajectory_that_was_tampered_with_is_found_out():
    tips = TRAJECTORY.tip_mm.copy()
    tips[7] += [0.0, 0.0, 0.05]
    bent = replace(TRAJECTORY, tip_mm=tips)
    failure = judge(play(TRAJECTORY, target="tests.simulation.faults:sound"), bent).failure
    assert failure is not None
    assert (failure.sample, failure.quantity) == (7, "tip off the closed form")
