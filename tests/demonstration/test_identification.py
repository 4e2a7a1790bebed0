"""Arm, instrument and base from joints beside poses: of real arms, of synthetic ones, and with planted mistakes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from skills.demonstration.hypotheses import HYPOTHESES, stated_instrument
from skills.demonstration.identification import FEWEST_SAMPLES, identify
from skills.errors import BadInput
from skills.kinematics import JAW_TIP_MM, POINTING_DOWN, axes_of, forward, inverse, matrix_of
from tests.demonstration.arms import MISTAKES, REAL, Mistake, cut, drawn, real

TWINS = ("400006", "420006")  # each on an arm of its own generation: equal lengths
DEGREES = np.degrees([1, 1, np.pi / 180, 1, 1, 1])
FLAGGED = ("wrong instrument", "wrong frame", "moved frame", "contradiction")


def random_joints(count: int, seed: int, spread: float = 1.0) -> np.ndarray:
    """Return joints about the middle of the workspace, shape (count, 6), rad and mm."""
    middle, sizes = np.array([0.1, 0.2, 140.0, 0.3, 0.1, -0.2]), np.array([0.2, 0.2, 30.0, 0.8, 0.6, 0.6])
    return middle + spread * sizes * np.random.default_rng(seed).uniform(-1, 1, (count, 6))


@pytest.mark.needs("recordings")
@pytest.mark.parametrize(
    ("name", "instrument", "greatest_mm"),
    [(REAL[0], "400006", 0.0532), (REAL[1], "420006-Classic", 0.0719), (REAL[2], "400006", 0.0117)],
)
@pytest.mark.parametrize("in_base", [True, False])
def test_a_real_arm_is_identified(name, instrument, greatest_mm, in_base):
    one = replace(real(name), in_base=in_base)
    found = one.identified()
    assert (found.verdict, found.instrument, found.generation, found.in_base) == (
        "identified",
        instrument,
        "Classic",
        True,
    )
    assert found.greatest_mm < greatest_mm
    assert found.next_mm > 20 * found.residual_mm
    np.testing.assert_allclose(found.position_mm, 0.0, atol=0.002)  # mm: also where the base was not stated


@pytest.mark.needs("recordings")
def test_the_si_tool_of_a_real_table_is_on_a_classic_arm():
    one = real("Si_tool_fixed")
    away = {
        lengths: np.linalg.norm(forward(one.joints, name)[0] - one.tip_mm, axis=1)
        for name, lengths in (("400006", "15.6"), ("400006-Si", "66.4"), ("420006-Classic", "-35.2"))
    }
    assert {lengths: round(float(np.median(mm)), 1) for lengths, mm in away.items()} == {
        "15.6": 50.8,
        "66.4": 101.6,
        "-35.2": 0.0,
    }


def test_every_arm_and_instrument_is_told_from_all_others_but_its_twins():
    joints = random_joints(500, 1)
    for one in HYPOTHESES:
        shaft, wrist, rotation = axes_of(joints)
        tip_mm = (joints[:, 2:3] - one.offset_mm) * shaft + one.wrist_mm * wrist
        found = identify(joints, tip_mm, rotation)
        assert (found.verdict, set(found.candidates)) == ("identified", set(one.names))
        for name in one.names:
            stated = identify(joints, tip_mm, rotation, in_base=True, stated=name)
            assert (stated.verdict, stated.instrument) == ("identified", name)


def test_the_base_is_found_where_it_stands_and_needs_no_orientations():
    joints = random_joints(500, 2)
    tip_mm, rotation = forward(joints, "400006-Si")
    turn, place = matrix_of([[0.1, -0.4, 0.2, 0.8]])[0], np.array([30.0, -200.0, 80.0])
    for turned in (turn @ rotation, None):
        found = identify(joints, place + tip_mm @ turn.T, turned)
        assert (found.instrument, found.generation, found.in_base) == ("400006-Si", "Si", False)
        np.testing.assert_allclose(found.position_mm, place, atol=1e-9)
        np.testing.assert_allclose(matrix_of([found.rotation_xyzw])[0], turn, atol=1e-12)
        assert found.residual_mm < 1e-9


@pytest.mark.parametrize("off_mm", [0.5, 50.0])
def test_poses_that_are_off_the_stated_base_keep_the_stated_instrument(off_mm):
    joints = random_joints(500, 2)
    tip_mm, rotation = forward(joints)
    found = identify(joints, tip_mm + np.array([off_mm, 0, 0]), rotation, in_base=True, stated="400006")
    assert (found.verdict, found.stated) == ("wrong frame", "400006")


def test_a_motion_too_small_to_tell_two_shafts_apart_identifies_nothing():
    joints = random_joints(500, 3, spread=0.0) + [0, 0, 1, 0, 0, 0] * np.linspace(0, 10, 500)[:, None]  # straight in
    tip_mm, rotation = forward(joints)
    found = identify(joints, tip_mm, rotation, stated="400006")
    assert (found.verdict, found.instrument) == ("undetermined", None)
    assert {"400006", "400006-Si", "420006-Classic"} <= set(found.candidates)
    # In the base the place itself tells, without any motion.
    assert identify(joints, tip_mm, rotation, in_base=True).instrument == "400006"


def test_joints_beyond_a_classics_range_are_a_sis():
    joints = random_joints(500, 4)
    joints[:, 0] += 2.0
    found = identify(joints, *forward(joints), in_base=True)
    assert (found.instrument, found.generation) == ("420006", "Si")
    wrong = identify(joints, *forward(joints), in_base=True, stated="LARGE_NEEDLE_DRIVER:400006")
    assert wrong.verdict == "wrong instrument"


@pytest.mark.parametrize(
    ("words", "spoil"),
    [
        ("if the joints were in degrees", lambda q, p, r: (q * DEGREES, p, r)),
        ("if the insertion were in millimetres", lambda q, p, r: (q * [1, 1, 1000, 1, 1, 1], p, r)),
        ("if the insertion were in metres", lambda q, p, r: (q * [1, 1, 0.001, 1, 1, 1], p, r)),
        ("if the positions were in metres", lambda q, p, r: (q, p / 1000, r)),
        ("with y reversed", lambda q, p, r: (q, p * [1, -1, 1], np.diag([1, -1.0, 1]) @ r @ np.diag([1, -1.0, 1]))),
        ("with z of the positions reversed", lambda q, p, r: (q, p * [1, 1, -1], r)),
        ("if the positions were those of the finger tips", lambda q, p, r: (q, p + JAW_TIP_MM * r[:, :, 2], r)),
        ("if the orientations were inverted", lambda q, p, r: (q, p, r.swapaxes(1, 2))),
        ("without the orientations", lambda q, p, r: (q, p, r @ matrix_of([[0.0, 0.0, 0.7, 0.7]])[0])),
    ],
)
@pytest.mark.parametrize("in_base", [True, False])
def test_a_contradiction_names_the_mistake_that_would_explain_it(words, spoil, in_base):
    joints = random_joints(500, 5)
    joints, tip_mm, rotation = spoil(joints, *forward(joints))
    found = identify(joints, tip_mm, rotation, in_base=in_base)
    assert found.verdict == "contradiction"
    assert words in found.reason


def test_a_camera_that_moved_is_told_from_a_contradiction():
    one = next(one for one in map(drawn, range(100)) if not one.in_base)
    tip_mm, half = one.tip_mm.copy(), len(one.tip_mm) // 2
    tip_mm[half:] += [0.0, 40.0, 0.0]
    found = replace(one, tip_mm=tip_mm).identified()
    assert (found.verdict, found.instrument) == ("moved frame", None)


@pytest.mark.parametrize("delay_s", [0.03, 0.004, -0.01])
@pytest.mark.parametrize("in_base", [True, False])
def test_late_joints_are_told_and_do_not_hide_the_length_of_the_wrist(delay_s, in_base):
    seconds = np.arange(2000) / 100.0

    def at(times):
        phase = np.array([0.3, 0.2, 0.25, 0.15, 0.35, 0.4]) * 2 * np.pi * times[:, None] + np.arange(6)
        return np.array([0.1, 0.2, 140.0, 0.3, 0.1, -0.2]) + [0.1, 0.1, 20.0, 0.5, 0.5, 0.5] * np.sin(phase)

    tip_mm, rotation = forward(at(seconds))
    joints = at(seconds - delay_s)
    speeds = np.gradient(joints, 0.01, axis=0)
    found = identify(joints, tip_mm, rotation, speeds=speeds, in_base=in_base)
    assert (found.verdict, found.instrument) == ("identified", "400006")
    assert found.delay_s == pytest.approx(delay_s, abs=1e-4)
    assert found.residual_mm < 0.2
    wrong = identify(joints, tip_mm, rotation, speeds=speeds, in_base=in_base, stated="400194")
    assert wrong.verdict == "wrong instrument"


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("in_base", [True, False])
def test_a_recorder_that_repeats_values_is_sound_and_hides_no_wrist(seed, in_base):
    rng = np.random.default_rng(seed)
    seconds, phase = np.arange(900) / 30.0, rng.uniform(0, 2 * np.pi, 6)

    def held():
        times = seconds - rng.uniform(0.0, 0.033, 900)  # up to one sample old, joints and pose apart
        moved = np.sin(np.array([0.3, 0.2, 0.25, 0.15, 0.35, 0.4]) * 2 * np.pi * times[:, None] + phase)
        return np.array([0.1, 0.2, 140.0, 0.3, 0.1, -0.2]) + [0.1, 0.1, 20.0, 0.5, 0.5, 0.5] * moved

    joints, (tip_mm, rotation) = held(), forward(held())
    speeds = np.gradient(joints, 1 / 30.0, axis=0)
    found = identify(joints, tip_mm, rotation, speeds=speeds, in_base=in_base, stated="400006")
    assert (found.verdict, found.instrument) == ("identified", "400006"), found.reason
    for wrong in ("400309", "400194", "400006-Si"):
        again = identify(joints, tip_mm, rotation, speeds=speeds, in_base=in_base, stated=wrong)
        assert again.verdict == "wrong instrument"


def test_names_of_tools_are_read_as_the_console_writes_them():
    assert stated_instrument("LARGE_NEEDLE_DRIVER:400006") == "400006"
    assert stated_instrument("LARGE_NEEDLE_DRIVER:420006[..11]") == "420006"
    assert stated_instrument("LARGE_NEEDLE_DRIVER_GEARED:420006[12..]") == "420006"
    assert stated_instrument("420006-Classic") == "420006-Classic"
    for unknown in ("", "LARGE_NEEDLE_DRIVER", "NO_TOOL:0", "x:1234567"):
        assert stated_instrument(unknown) is None


def test_few_samples_show_nothing_and_wild_numbers_contradict():
    joints = random_joints(FEWEST_SAMPLES, 6)
    tip_mm, rotation = forward(joints)
    assert identify(joints[:-1], tip_mm[:-1], rotation[:-1]) is None
    assert identify(joints[:, :5], tip_mm, rotation) is None
    assert identify(np.hstack([joints, joints[:, :1]]), tip_mm, rotation, in_base=True).verdict == "identified"
    assert identify(joints * 1e300, tip_mm, rotation).verdict == "contradiction"
    assert identify(np.zeros((20, 6)), np.zeros((20, 3))).verdict == "undetermined"
    with pytest.raises(BadInput, match="NaN"):
        identify(joints * np.nan, tip_mm, rotation)


# ---- sound files and planted mistakes ---------------------------------------------------------------------------


def recorded(seed: int):
    """Return a sound file: of four one is a piece of a real one."""
    return drawn(seed) if seed % 4 else cut(real(REAL[seed // 4 % 3]), seed)


@pytest.mark.needs("recordings")
@pytest.mark.parametrize("seeds", [range(20), pytest.param(range(200), marks=pytest.mark.nightly)])
def test_no_sound_file_is_flagged(seeds):
    verdicts = Counter()
    for seed in seeds:
        one = recorded(seed)
        found = one.identified()
        verdicts[found.verdict] += 1
        assert found.verdict not in FLAGGED, (seed, found.reason)
        right = TWINS if one.truth in TWINS else (one.truth,)
        assert found.verdict == "undetermined" or found.instrument in right, seed
    print(dict(verdicts))
    assert verdicts["identified"] >= 0.95 * len(seeds)


@pytest.mark.needs("recordings")
@pytest.mark.parametrize("count", [4, pytest.param(200, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_no_planted_mistake_is_silent(mistake: Mistake, count):
    verdicts = Counter()
    for seed in range(count):
        planted = mistake(recorded(1000 + seed), np.random.default_rng((19, seed)))
        found = planted.identified()
        verdicts[found.verdict] += 1
        assert found.verdict in FLAGGED, (seed, planted.truth, planted.stated, found)
    print(mistake.__name__, dict(verdicts))


@pytest.mark.parametrize("fault", ["insertion", "frame", "none"])
@pytest.mark.parametrize("extent_mm", [3.0, 12.0, 30.0])
def test_a_motion_is_called_too_small_only_if_it_is(fault, extent_mm):
    """An insertion that is off, or a frame that moved half-way, is the reason where the motion is not."""
    at = np.arange(800) / 100
    way = np.stack([np.sin(at), 0.4 * np.cos(0.8 * at), 0.3 * np.sin(at / 2)], axis=1)
    tip = np.array([5.0, 45.0, -130.0]) + extent_mm * way
    q = inverse(tip, POINTING_DOWN) + np.outer(np.sin(0.6 * at), [0, 0, 0, 0.2, 0.2, 0.1])
    poses, turned = forward(q, "400006")
    if fault == "insertion":
        q[:, 2] += 4.0
    elif fault == "frame":
        poses[400:, 2] += 1.3
    found = identify(q, poses, turned, in_base=False)
    if fault == "none":
        assert found.verdict == "identified" or "too small" in found.reason
    else:
        assert "too small" not in found.reason
        assert found.verdict != "undetermined" or "the zero of a joint" in found.reason
