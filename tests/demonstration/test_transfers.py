import os
import tarfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from skills.demonstration.partner import NeedleTransfer, closed_jaw, find_transfers
from skills.demonstration.recording import Label, Recording, Signal, base_frames
from skills.demonstration.segments import propose_by_arm
from skills.formats.jigsaws import read_jigsaws
from skills.samples import agreement
from tests.demonstration.exchanges import Given, exchanges
from tests.demonstration.sessions import A, Kind, M, session
from tests.demonstration.strokes import RATE, along_x, line, motion
from tests.needs import need

WITHIN_S = 0.5


def found_in(recording: Recording) -> tuple[NeedleTransfer, ...]:
    closed = {arm: closed_jaw(recording, arm) for arm in recording.arms}
    return find_transfers(recording, closed, base_frames(recording))


def matched(found: tuple[NeedleTransfer, ...], given: list[Given]) -> list[bool]:
    """Return for each transfer found whether it is a true one; no true one is counted twice."""
    left, right = list(given), []
    for one in found:
        true = [t for t in left if t.giver == one.giver and abs(t.at_s - one.released_s) < WITHIN_S]
        right.append(bool(true))
        if true:
            left.remove(true[0])
    return right


def precision_and_recall(kinds, change=lambda recording: recording) -> tuple[float, float, list[tuple[float, bool]]]:
    right, given_in_all, judged = 0, 0, []
    for kind in kinds:
        recording, given = exchanges(kind)
        found = found_in(change(recording))
        hits = matched(found, given)
        judged += [(one.confidence, hit) for one, hit in zip(found, hits, strict=True)]
        right, given_in_all = right + sum(hits), given_in_all + len(given)
    return right / len(judged), right / given_in_all, judged


def own_frames_only(recording: Recording) -> Recording:
    return replace(recording, motions=tuple(one for one in recording.motions if "/local/" in one.topic))


# ---- sessions whose transfers are known -------------------------------------------------------------------------


def test_transfers_are_told_from_misses_regrips_and_play():
    precision, recall, _ = precision_and_recall([Kind(seed=seed, noisy=seed % 3 == 0) for seed in range(1000, 1008)])
    assert precision >= 0.9
    assert recall >= 0.9


@pytest.mark.nightly
def test_precision_recall_and_calibration_on_400_sessions():
    kinds = [Kind(seed=seed, noisy=seed % 3 == 0, rate_hz=(100.0, 200.0, 50.0)[seed % 3]) for seed in range(2000, 2400)]
    precision, recall, judged = precision_and_recall(kinds)
    print(f"precision {precision:.3f}, recall {recall:.3f}")
    assert precision >= 0.95
    assert recall >= 0.95
    confidence, hits = np.array(judged, np.float64).T
    for low, high in ((0.5, 0.9), (0.9, 1.0)):
        here = (confidence >= low) & (confidence <= high)
        print(f"{low} to {high}: said {confidence[here].mean():.3f}, true {hits[here].mean():.3f} of {here.sum()}")
        assert abs(confidence[here].mean() - hits[here].mean()) < (0.25 if high < 1 else 0.05)


@pytest.mark.nightly
def test_without_a_common_frame_more_is_mistaken():
    kinds = [Kind(seed=seed, noisy=seed % 3 == 0) for seed in range(2400, 2500)]
    precision, recall, _ = precision_and_recall(kinds, own_frames_only)
    print(f"precision {precision:.3f}, recall {recall:.3f}")
    assert precision >= 0.8
    assert recall >= 0.9


def test_each_hand_off_of_a_suturing_session_is_one_transfer():
    recording, truths = session(Kind(seed=5, passes=6))
    released = [one.released_s for one in found_in(recording) if one.giver == A]
    assert len(released) == len(truths)
    for second, truth in zip(released, truths, strict=True):
        assert truth.end_s < second < truth.end_s + 4.0


# ---- cases worked by hand ---------------------------------------------------------------------------------------

ARMS = ("PSM1", "PSM2")


def two_arms(gives_mm: np.ndarray, shut: list[tuple[float, float]], other_shut: list[tuple[float, float]]) -> Recording:
    """PSM1 gives and moves along x in one frame, PSM2 stays 20 mm beside; each jaw is shut in the given seconds."""
    seconds = np.arange(len(gives_mm)) / RATE
    motions = (motion(gives_mm, arm="PSM1"), motion(line(seconds[-1], 0) + np.array([0, 20, 0]), arm="PSM2"))
    jaws = []
    for arm, spans in zip(ARMS, (shut, other_shut), strict=True):
        is_shut = np.any([(seconds >= start) & (seconds < end) for start, end in spans], axis=0)
        jaws.append((arm, Signal(motions[0].stamps_ns, np.where(is_shut, 0.0, 0.9))))
    turned = tuple(replace(one, rotation_xyzw=np.tile([0.0, 0, 0, 1], (len(one.stamps_ns), 1))) for one in motions)
    return Recording("csv", "none", turned, jaws=tuple(jaws))


PULL_REST_LEAVE = along_x((2, 20), (4, 0), (2, -20), (2, 0))


def test_one_closes_before_the_other_opens_and_leaves():
    (one,) = found_in(two_arms(PULL_REST_LEAVE, [(0, 5)], [(4, 10)]))
    assert (one.giver, one.taker) == ARMS
    assert (one.held_s, one.taken_s, one.released_s) == pytest.approx((0, 4, 5), abs=0.02)
    assert one.slip_mm == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("shut", "other_shut"),
    [
        ([(0, 5)], [(5.5, 10)]),  # the needle was let go before it was taken
        ([(0, 5)], [(4, 4.5)]),  # the other arm lets go again
        ([(0, 5)], [(0, 10)]),  # the other arm was closed all along
        ([(0, 10)], [(4, 10)]),  # nobody opens
    ],
)
def test_any_other_order_is_no_transfer(shut, other_shut):
    assert found_in(two_arms(PULL_REST_LEAVE, shut, other_shut)) == ()


def test_an_arm_that_stays_has_only_taken_a_new_grip():
    assert found_in(two_arms(along_x((2, 20), (8, 0)), [(0, 5), (6, 10)], [(4, 10)])) == ()


def test_tips_that_slide_along_each_other_hold_no_common_needle():
    assert found_in(two_arms(along_x((8, 20), (2, 0)), [(0, 5)], [(4, 10)])) == ()


def test_a_trembling_jaw_neither_grips_nor_releases():
    recording = two_arms(PULL_REST_LEAVE, [(0, 5)], [(4, 10)])
    rng = np.random.default_rng(0)
    shaken = tuple(
        (arm, replace(jaw, values=jaw.values + rng.normal(0, 0.04, len(jaw.values)))) for arm, jaw in recording.jaws
    )
    assert len(found_in(replace(recording, jaws=shaken))) == 1


def test_one_value_far_outside_does_not_stretch_the_jaws_range():
    recording = two_arms(PULL_REST_LEAVE, [(0, 5)], [(4, 10)])
    arm, jaw = recording.jaws[0]
    values = jaw.values.copy()
    values[700] = 40.0
    assert len(found_in(replace(recording, jaws=((arm, replace(jaw, values=values)), recording.jaws[1])))) == 1


# ---- proposals --------------------------------------------------------------------------------------------------


def test_a_proposal_ends_at_the_transfer_and_has_a_confidence():
    one, *others = propose_by_arm(two_arms(PULL_REST_LEAVE, [(0, 5)], [(4, 10)]))
    assert not others
    assert (one.arm, one.found_by) == ("PSM1", "transfer")
    assert (one.start_s, one.end_s) == pytest.approx((0, 2), abs=0.3)
    assert one.confidence is not None and one.confidence > 0.9


def test_without_a_transfer_the_jaw_is_followed_as_before():
    (one,) = propose_by_arm(two_arms(PULL_REST_LEAVE, [(0, 5)], [(5.5, 10)]))
    assert (one.found_by, one.confidence) == ("jaw", None)


def test_proposals_are_compared_with_labels_that_they_do_not_see():
    recording = two_arms(PULL_REST_LEAVE, [(0, 5)], [(4, 10)])
    second = 10**9
    label = Label("hand-off", "stage", recording.origin_ns, recording.origin_ns + 2 * second)
    late = Label("hand-off", "stage", recording.origin_ns + 6 * second, recording.origin_ns + 8 * second)
    compared = agreement(replace(recording, labels=(label, late)))
    assert (compared.proposed, compared.labelled, compared.matched) == (1, 2, 1)
    assert [is_matched for _, is_matched in compared.confident] == [True]
    assert agreement(recording).labelled == 0


def test_both_arms_of_a_session_are_givers():
    recording, given = exchanges(Kind(seed=1003))
    assert {one.arm for one in propose_by_arm(recording)} == {A, M} == {one.giver for one in given}


# ---- real trials ------------------------------------------------------------------------------------------------


@pytest.mark.nightly  # by day synthetic sessions
def test_a_real_trial_of_four_stitches_has_about_four_transfers_a_hand():
    """In Needle_Passing the needle goes through four rings: to the left hand in each, and back after each."""
    need("jigsaws")
    folder = Path(os.environ["SKILLS_TEST_JIGSAWS"], "knot_tying_needle_passing.tar.xz")
    counts = []
    with tarfile.open(folder) as archive:
        for member in archive:
            name = Path(member.name).name
            if name.startswith("Needle_Passing_") and name.endswith("4.txt") and member.size:
                content = archive.extractfile(member)
                assert content is not None
                proposed = propose_by_arm(read_jigsaws(BytesIO(content.read())))
                counts.append([sum(one.arm == arm for one in proposed) for arm in ("PSM_left", "PSM_right")])
    assert len(counts) >= 5
    left, right = np.median(counts, axis=0)
    assert 4 <= left <= 5
    assert 3 <= right <= 4
    assert np.max(counts) <= 7
