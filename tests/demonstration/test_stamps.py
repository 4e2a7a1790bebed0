"""Stamps that go back or repeat: a few samples are dropped and counted, more are refused."""

import io

import numpy as np
import pytest

from skills.demonstration.motion import DROPPED_GAP_NS, DROPPED_SHARE_LIMIT
from skills.demonstration.recording import equal_samples, recorded_joints, recorded_motion, recorded_signal
from skills.errors import BackwardStamps, NotFinite, NotMetres, RepeatedStamps
from skills.formats import read_recording
from skills.formats.parsed import parse
from skills.schemas.recordings import Dropped, Recording

STEP_NS = 10_000_000


def stamped(stamps_ns, tip_mm=None):
    """Return a motion whose x is the sample's number."""
    count = len(stamps_ns)
    tips = np.column_stack([np.arange(count), np.full(count, 50.0), np.full(count, -120.0)])
    return recorded_motion(
        arm="PSM1",
        topic="/PSM1/measured_cp",
        frame="ECM",
        stamps_ns=np.asarray(stamps_ns, dtype=np.int64),
        tip_mm=tips if tip_mm is None else tip_mm,
        rotation_xyzw=None,
    )


def even(count):
    return np.arange(count, dtype=np.int64) * STEP_NS


def test_one_sample_in_a_hundred_may_go_back_and_two_may_not():
    stamps = even(200)
    stamps[50] = stamps[49] - 558
    stamps[120] = stamps[119] - 1_000_000
    motion = stamped(stamps)
    assert (motion.backward_stamps, motion.duplicate_stamps, len(motion.stamps_ns)) == (2, 0, 198)
    assert np.delete(np.arange(200.0), [50, 120]).tolist() == motion.tip_mm[:, 0].tolist()
    stamps[150] = stamps[149] - 558
    with pytest.raises(BackwardStamps, match=r"3 of 200 samples.*up to 1%") as caught:
        stamped(stamps)
    assert caught.value.numbers["sample"] == 50
    assert DROPPED_SHARE_LIMIT == 0.01


def test_repeated_stamps_count_towards_the_same_limit():
    stamps = even(200)
    stamps[50], stamps[120] = stamps[49], stamps[119] - 1
    motion = stamped(stamps)
    assert (motion.duplicate_stamps, motion.backward_stamps) == (1, 1)
    stamps[150] = stamps[149]
    with pytest.raises(BackwardStamps):
        stamped(stamps)


@pytest.mark.parametrize(("gap_ns", "dropped"), [(DROPPED_GAP_NS, True), (DROPPED_GAP_NS + 1, False)])
def test_the_gap_that_is_left_may_be_50_ms(gap_ns, dropped):
    stamps = even(300)
    stamps[100] = stamps[99] - 1
    stamps[101:] += gap_ns - 2 * STEP_NS
    assert stamps[101] - stamps[99] == gap_ns
    if dropped:
        assert stamped(stamps).backward_stamps == 1
    else:
        with pytest.raises(BackwardStamps, match="gaps of at most 50 ms"):
            stamped(stamps)


@pytest.mark.parametrize(("back_ns", "dropped"), [(DROPPED_GAP_NS, True), (DROPPED_GAP_NS + 1, False)])
def test_a_stamp_may_go_back_by_50_ms(back_ns, dropped):
    stamps = even(300)
    stamps[299] = stamps[298] - back_ns  # the last one: no gap is left
    if dropped:
        assert stamped(stamps).backward_stamps == 1
    else:
        with pytest.raises(BackwardStamps):
            stamped(stamps)


def test_a_single_stamp_far_ahead_is_not_the_truth():
    stamps = even(1000)
    stamps[995] += 10**10
    with pytest.raises(BackwardStamps, match=r"decrease by 9\.99 s"):
        stamped(stamps)


def test_stamps_beyond_half_of_an_int64_do_not_wrap_to_a_small_step():
    stamps = np.concatenate([even(999) + 2**62, [-(2**62) - 2**61]])
    with pytest.raises(BackwardStamps):
        stamped(stamps)


def test_a_clock_that_repeats_too_often_is_refused_by_its_own_name():
    stamps = even(100)
    stamps[50:52] = stamps[49]
    with pytest.raises(RepeatedStamps, match="2 of 100"):
        stamped(stamps)


def test_nothing_wrong_hides_in_a_dropped_sample():
    stamps = even(200)
    stamps[50] = stamps[49] - 1
    tips = np.tile([0.0, 50.0, -120.0], (200, 1))
    tips[50, 0] = np.nan
    with pytest.raises(NotFinite):
        stamped(stamps, tips)
    tips[50, 0] = 2000.0
    with pytest.raises(NotMetres):
        stamped(stamps, tips)


@pytest.mark.parametrize("made", [recorded_signal, lambda s, v, t: recorded_joints("PSM1", t, s, v[:, None])])
def test_joints_and_jaws_keep_equal_stamps_and_drop_the_others(made):
    stamps = even(200)
    stamps[50], stamps[120] = stamps[49], stamps[119] - 1
    signal = made(stamps, np.arange(200.0) / 100, "/PSM1/measured_js")
    assert (signal.backward_stamps, len(signal.stamps_ns)) == (1, 199)
    stamps[[130, 140]] = stamps[[129, 139]] - 1
    with pytest.raises(BackwardStamps):
        made(stamps, np.arange(200.0) / 100, "/PSM1/measured_js")


def test_equal_samples_are_counted_and_not_dropped():
    tips = np.repeat(np.arange(50.0), 2)[:, None] * [1.0, 0.0, 0.0]
    assert equal_samples(tips, None) == 50
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))
    turns[1] = [0.0, 0.0, 1.0, 0.0]
    assert equal_samples(tips, turns) == 49
    assert len(stamped(even(100), tips).stamps_ns) == 100


def table(stamps_ns):
    rows = (f"{t / 1e9:.9f},{min(k, 90) * 0.5},50,-120\n" for k, t in enumerate(stamps_ns))
    return read_recording(io.BytesIO(("t_s,x_mm,y_mm,z_mm\n" + "".join(rows)).encode()))


def test_the_description_counts_dropped_and_equal_samples():
    sound = parse(table(even(91))).about
    assert (sound.dropped, sound.quality[0].equal_samples) == ([], 0)
    stamps = even(100)
    stamps[50] = stamps[49] - 1
    about = parse(table(stamps)).about
    assert about.dropped == [Dropped("table", 1)]
    assert about.quality[0].equal_samples == 9
    rest = {"id": "0" * 64, "sha256": "0" * 64, "size_bytes": 1, "media_type": "text/csv", "format": "csv"}
    rest |= {"integrity": "none", "created_at": "2026-01-01T00:00:00Z"}
    assert Recording.model_validate(rest | vars(sound)).dropped == []
    assert Recording.model_validate(rest | vars(about)).dropped[0].backward_stamps == 1
