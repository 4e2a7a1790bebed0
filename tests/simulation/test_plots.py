"""The plots show the measurements: their lines, limits, shades and marks are checked one by one."""

import io
import subprocess
import sys
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from skills.kinematics import CLASSIC, JOINTS
from skills.planning.handoff import PsmM
from skills.planning.trajectory import A2, PSM_A, TRANSFER, Trajectory, time_parametrise
from skills.simulation import pictures
from skills.verification.playback import PAD, Playback, link_pairs
from tests.planning.motions import PSM_M, hand_off, ideal_playback, small_trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HALF = np.radians(45) / 2
BESIDE = PsmM(PSM_M, (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(HALF)), float(np.cos(HALF))))  # invented
FEASIBLE = {
    "failure": None,
    "failure_sentence": None,
    "settings": {"clearance_pad_mm": 1.0, "clearance_psm_m_mm": 0.5},
}
ALONE = small_trajectory(rate_hz=100.0)


@cache
def both_arms() -> Trajectory:
    return time_parametrise([hand_off(-8.0 * k) for k in range(2)], rate_hz=100.0, psm_m=BESIDE)


def measured(motion: Trajectory) -> Playback:
    """Return measurements in which every pair of links has a different distance, measured at every third sample."""
    at = np.unique(np.concatenate([np.arange(0, len(motion), 3), motion.last_samples]))
    pairs = len(link_pairs(motion.psm_m is not None))
    apart = 10.0 + np.arange(pairs) + np.sin(at / 50.0)[:, None]
    seen = None if motion.psm_m is None else np.zeros((len(at), 3))
    return replace(
        ideal_playback(replace(motion, psm_m=None)),
        looked_at=at,
        clearances_mm=apart,
        shaft_off_mm=np.zeros(len(at)),
        psm_m_tip_mm=seen,
    )


def lines(figure: "Figure", panel: int) -> dict[str, np.ndarray]:
    """Read the lines of a panel by their labels, each of shape (2, K); of equal labels the last."""
    return {line.get_label(): np.array(line.get_data()) for line in figure.axes[panel].lines}


@pytest.mark.parametrize("joint", range(6), ids=JOINTS)
def test_a_joint_is_drawn_in_degrees_or_mm_between_its_limits(joint: int):
    motion = both_arms()
    figure = pictures.draw_joints(motion, measured(motion), FEASIBLE)
    scale = 1.0 if JOINTS[joint] == "insertion" else 180 / np.pi
    for name, joints in ((PSM_A, motion.joints), ("PSM_M", motion.psm_m.joints)):
        _, values = lines(figure, joint)[name]
        np.testing.assert_allclose(values[~np.isnan(values)], joints[:, joint] * scale, atol=1e-9)
    limits = sorted(line.get_ydata()[0] for line in figure.axes[joint].lines if line.get_label() == "limit")
    np.testing.assert_allclose(limits, [CLASSIC.lower[joint] * scale, CLASSIC.upper[joint] * scale])
    low, high = figure.axes[joint].get_ylim()
    assert low < limits[0] < limits[1] < high
    assert figure.axes[joint].get_ylabel().endswith("(mm)" if JOINTS[joint] == "insertion" else "(deg)")


def test_time_runs_from_0_and_lines_break_between_passes():
    times, values = lines(pictures.draw_joints(ALONE, measured(ALONE), FEASIBLE), 0)[PSM_A]
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(ALONE.duration_s)
    [gap] = np.flatnonzero(np.isnan(values))
    assert gap == ALONE.last_samples[0] + 1


def test_the_phases_of_every_pass_are_shaded_where_they_are():
    motion = both_arms()
    times = motion.stamps_s - motion.stamps_s[0]
    axes = pictures.draw_joints(motion, measured(motion), FEASIBLE).axes[0]
    for shade, phase in zip(axes.collections, (TRANSFER, A2), strict=True):
        drawn = sorted((path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in shade.get_paths())
        mine = [np.flatnonzero((motion.pass_index == p) & (motion.phase == phase)) for p in range(motion.passes)]
        meant = [(times[one[0]], times[one[-1]]) for one in mine if len(one)]
        np.testing.assert_allclose(drawn, meant)
    assert [text.get_text() for text in axes.texts] == ["0", "1"]


def test_the_nearest_links_of_each_kind_are_drawn_where_it_was_looked():
    motion = both_arms()
    playback = measured(motion)
    figure = pictures.draw_clearance(motion, playback, FEASIBLE)
    times = (motion.stamps_s - motion.stamps_s[0])[playback.looked_at]
    found = lines(figure, 0) | lines(figure, 1)
    pairs = playback.link_pairs
    nearest = {  # each pair is a millimetre further apart than the one before it
        "PSM_A to the pad": next(k for k, p in enumerate(pairs) if p.other == PAD),
        "PSM_M to the pad": next(k for k, p in enumerate(pairs) if p.other == PAD and p.body == "PSM_M"),
        pictures.FINGERS_OF_BOTH: next(k for k, p in enumerate(pairs) if p.may_touch),
        pictures.OTHERS: next(k for k, p in enumerate(pairs) if p.other == "PSM_M"),
    }
    for label, column in nearest.items():
        drawn_at, values = found[label]
        there = ~np.isnan(values)
        np.testing.assert_allclose(values[there], playback.clearances_mm[:, column])
        np.testing.assert_allclose(drawn_at[there], times)
    assert lines(figure, 0)["limit"][1][0] == 1.0
    assert lines(figure, 1)["limit"][1][0] == 0.5


def test_an_arm_alone_has_its_distance_to_the_pad_only():
    figure = pictures.draw_clearance(ALONE, measured(ALONE), FEASIBLE)
    assert len(figure.axes) == 1
    assert set(lines(figure, 0)) == {"PSM_A to the pad", "limit"}


def test_the_first_sample_that_fails_is_marked_in_every_panel_and_said():
    words = "Pass 1, A1, sample 500: clearance of PSM_A finger_1 to the pad is 0.4 mm, the limit is 1."
    report = FEASIBLE | {"failure": {"sample": 500}, "failure_sentence": words}
    failed_s = ALONE.stamps_s[500] - ALONE.stamps_s[0]
    for draw in (pictures.draw_joints, pictures.draw_clearance):
        figure = draw(ALONE, measured(ALONE), report)
        assert words in figure.get_suptitle()
        for panel in range(len(figure.axes)):
            assert lines(figure, panel)["first sample that fails"][0].tolist() == [failed_s, failed_s]
        assert "Feasible in an exact simulation." in draw(ALONE, measured(ALONE), FEASIBLE).get_suptitle()


@pytest.mark.nightly  # rarely breaks
def test_the_same_playback_gives_the_same_picture_and_nothing_is_cut_off():
    motion = both_arms()
    report = FEASIBLE | {"failure": {"sample": 500}, "failure_sentence": "Pass 1 ..."}
    for draw in (pictures.draw_joints, pictures.draw_clearance):
        png = pictures.png(draw(motion, measured(motion), report))
        assert pictures.png(draw(motion, measured(motion), report)) == png
        image = np.asarray(Image.open(io.BytesIO(png)).convert("L"))
        assert image.shape[1] == round(pictures.WIDE_INCH * pictures.DPI)
        edges = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert (edges == 255).all()


def test_the_simulator_starts_without_matplotlib():
    code = "import sys, skills.simulation.simulator, skills.simulation.film; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0, "it would double the time of the start"
