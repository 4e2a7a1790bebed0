"""The film: its content, its playback in a browser, and failures of the film process."""

import importlib.util
import io
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from skills.errors import SimulationFailed
from skills.kinematics import POINTING_DOWN, matrix_of
from skills.planning.handoff import NEEDLE_RADIUS_MM, TAKEN_MM, PsmM
from skills.planning.trajectory import A1, A2, TRANSFER, PassPath, Trajectory, time_parametrise
from skills.simulation import film, pictures
from skills.verification.clearance import needle_poses, psm_m_poses
from tests.planning.motions import PSM_M, hand_off, small_trajectory

needs_simulator = pytest.mark.needs("simulator")
HALF = np.radians(45) / 2
BESIDE = PsmM(PSM_M, (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(HALF)), float(np.cos(HALF))))  # invented
PAD_TOP_MM = -150.0


@cache
def one_pass() -> Trajectory:
    return small_trajectory(passes=1, rate_hz=60.0)


@cache
def both_arms() -> Trajectory:
    return time_parametrise([hand_off(-8.0 * k) for k in range(2)], rate_hz=100.0, psm_m=BESIDE)


def shown() -> np.ndarray:
    """Return a frame of each phase, and the hand-off."""
    motion = both_arms()
    of_second = motion.pass_index == 1
    begins = [np.flatnonzero(of_second & (motion.phase == phase))[5] for phase in (TRANSFER, A1, A2)]
    return np.array([0, *begins, len(motion) - 1])


@pytest.fixture(scope="module")
def shot() -> film.Film:
    return film.make_film(both_arms(), pad_top_mm=PAD_TOP_MM, samples=shown())


def frames_of(mp4: bytes) -> np.ndarray:
    """Decode a film, shape (frames, height, width, 3)."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", "pipe:0", "-f", "rawvideo"]
    raw = subprocess.run([*command, "-pix_fmt", "rgb24", "pipe:1"], input=mp4, capture_output=True, check=True)
    return np.frombuffer(raw.stdout, np.uint8).reshape(-1, film.HEIGHT, film.WIDTH, 3)


# ---- the content -----------------------------------------------------------------------------------------------


@needs_simulator
def test_the_film_has_a_frame_for_every_sample_and_stays_at_the_end(shot):
    frames = frames_of(shot.mp4).astype(int)
    assert len(frames) == 5 + film.HELD_FRAMES - 1
    changed = np.abs(np.diff(frames, axis=0)).mean(axis=(1, 2, 3))
    assert (changed[:4] > 0.5).all()
    assert (changed[4:] < 0.1).all()


@needs_simulator
def test_the_gif_shows_the_same_frames(shot):
    gif = Image.open(io.BytesIO(shot.gif))
    assert gif.size == (film.WIDTH, film.HEIGHT)
    assert gif.info["loop"] == 0
    for number, frame in enumerate(frames_of(shot.mp4)[:5]):
        gif.seek(number)
        assert np.abs(np.asarray(gif.convert("RGB"), int) - frame).mean() < 3.0


@needs_simulator
def test_both_arms_the_pad_and_the_way_of_each_pass_are_in_it(shot):
    end = frames_of(shot.mp4)[-1].astype(int)
    pad, green = (np.abs(end - colour).sum(axis=2) < 40 for colour in ((222, 172, 149), (51, 80, 50)))
    assert pad.mean() > 0.15
    assert green.mean() > 0.01
    for number in range(2):
        assert (np.abs(end - pictures.colour_of(number)).sum(axis=2) < 90).sum() > 150  # pixels


@needs_simulator
def test_what_is_to_come_is_paler_than_what_has_passed(shot):
    first, last = (frame[film._HEAD : -film._FOOT].astype(int) for frame in frames_of(shot.mp4)[[0, -1]])
    for number in range(2):
        strong = [(np.abs(frame - pictures.colour_of(number)).sum(axis=2) < 60).sum() for frame in (first, last)]
        assert strong[0] < 0.2 * strong[1]


@needs_simulator
def test_a_browser_can_play_it_from_its_beginning(shot):
    assert shot.mp4.index(b"moov") < shot.mp4.index(b"mdat")
    assert b"avc1" in shot.mp4
    words = subprocess.run(
        [importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe(), "-i", "pipe:0"],
        input=shot.mp4,
        capture_output=True,
    ).stderr
    assert b"yuv420p" in words and b"480x368" in words and b"10 fps" in words


@needs_simulator
def test_the_same_trajectory_gives_the_same_bytes(shot):
    assert film.make_film(both_arms(), pad_top_mm=PAD_TOP_MM, samples=shown()) == shot


@needs_simulator
def test_an_arm_alone_is_filmed_too():
    assert (
        len(frames_of(film.make_film(one_pass(), pad_top_mm=PAD_TOP_MM, samples=[0, 9]).mp4))
        == 2 + film.HELD_FRAMES - 1
    )


@needs_simulator
def test_a_pass_of_a2_alone_is_filmed_too():
    a2 = PassPath(hand_off().tip_mm[-1:], POINTING_DOWN, hand_off().target_rotation)
    turning = time_parametrise([a2], rate_hz=60.0)
    assert film.make_film(turning, pad_top_mm=PAD_TOP_MM, samples=[0, len(turning) - 1]).gif.startswith(b"GIF89a")


# ---- the choice of samples -------------------------------------------------------------------------------------


def stretched(passes: int, samples: int) -> Trajectory:
    """Return passes of a number of samples each; only the numbers of samples matter."""
    one = one_pass()
    at = np.tile(np.linspace(0, len(one) - 1, samples).round().astype(int), passes)
    number = np.repeat(np.arange(passes), samples)
    same = {name: getattr(one, name)[at] for name in ("tip_mm", "rotation_xyzw", "joints", "phase")}
    return replace(one, stamps_s=np.arange(len(at)) / 60.0, pass_index=number, **same)


@given(st.integers(1, 200), st.integers(1, 50))
def test_every_pass_has_its_share_of_the_frames_and_its_hand_off(passes: int, samples: int):
    motion = stretched(passes, samples)
    at = film.frames_of(motion)
    assert (np.diff(at) > 0).all()
    assert len(at) <= film.MOST_FRAMES
    assert set(motion.last_samples) <= set(at)
    share = np.bincount(motion.pass_index[at], minlength=passes)
    assert share.max() - share.min() <= 2
    if samples >= film.FRAMES:
        assert len(at) >= film.FRAMES - passes


def test_a_plan_of_five_passes_has_about_sixty_frames():
    assert 55 <= len(film.frames_of(stretched(5, 2000))) <= 60
    assert 290 <= len(film.frames_of(stretched(200, 40))) <= 300


# ---- the needle ------------------------------------------------------------------------------------------------


def test_psm_m_takes_the_needle_where_it_runs_along_the_hinge_of_its_jaws():
    motion = both_arms()
    ends = motion.last_samples
    place, rotation = needle_poses(motion, ends)
    # A quarter of the circle on from PSM_A's grip: x along the needle, y towards the circle's centre.
    quarter = place + NEEDLE_RADIUS_MM * (rotation[:, :, 0] + rotation[:, :, 1])
    tip_mm, jaws = psm_m_poses(motion, ends)
    np.testing.assert_allclose(quarter, tip_mm + TAKEN_MM * jaws[:, :, 2], atol=1e-6)  # mm
    along = np.einsum("fi,fi->f", rotation[:, :, 1], jaws[:, :, 0])
    np.testing.assert_allclose(np.abs(along), 1.0, atol=1e-9)


def test_the_needle_goes_with_the_arm_that_holds_it():
    motion = both_arms()
    away = np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    held = np.flatnonzero((motion.pass_index == 1) & (motion.phase != TRANSFER))
    for at, (tip_mm, jaws) in (
        (away, psm_m_poses(motion, away)),
        (held, (motion.tip_mm[held], matrix_of(motion.rotation_xyzw[held]))),
    ):
        place, rotation = needle_poses(motion, at)
        in_jaws = np.einsum("fji,fj->fi", jaws, place - tip_mm)
        np.testing.assert_allclose(in_jaws, np.broadcast_to(in_jaws[0], in_jaws.shape), atol=1e-6)
        turned = np.swapaxes(jaws, 1, 2) @ rotation
        np.testing.assert_allclose(turned, np.broadcast_to(turned[0], turned.shape), atol=1e-9)


# ---- failing film processes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crew", "cause"),
    [
        ("garbage", "nonsense"),
        ("no_film", "nonsense"),
        ("no_gif", "nonsense"),
        ("film_in_words", "nonsense"),
        ("crash", "crashed"),
        ("fail", "failed"),
    ],
)
def test_a_crew_that_makes_no_film_is_refused(crew: str, cause: str):
    with pytest.raises(SimulationFailed) as caught:
        film.make_film(small_trajectory(rate_hz=60.0), pad_top_mm=PAD_TOP_MM, target=f"tests.simulation.faults:{crew}")
    assert caught.value.numbers["cause"] == cause
