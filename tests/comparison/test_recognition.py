"""Recognition of styles: signatures, known cohorts, chance if there is no information, and sessions that are left out.

Real surgeons are those of two tasks of JIGSAWS, leaving the trial out; docs/atlas.md has the figures.
"""

from dataclasses import replace
from math import log

import numpy as np
import pytest

from skills.comparison import recognition
from skills.comparison.distances import STATES
from skills.demonstration.demonstration import Demo
from skills.errors import BadInput
from skills.kinematics import matrix_of, quaternion_of
from tests.comparison.cohort import Cohort, cohort
from tests.needs import need

TEMPO = recognition.MetricSettings(("tempo",), 0.1)


def signatures(drawn: Cohort) -> np.ndarray:
    return np.array([recognition.signature_of(demo) for demo in drawn.demos])


def validated(drawn: Cohort, surgeons: np.ndarray | None = None) -> recognition.Validated:
    whose = drawn.surgeons if surgeons is None else surgeons
    return recognition.validate(signatures(drawn), whose, drawn.sessions, np.arange(len(whose)))


def test_eight_surgeons_in_five_sessions_are_recognised():
    found = validated(cohort(1))
    print(f"{found.right} of {len(found.tested)}, {found.interval}, log loss {found.log_loss:.2f} nat")
    assert found.chance == 0.125
    assert found.interval[0] > 0.6
    assert found.log_loss < 0.5 * np.log(8)
    np.testing.assert_allclose(found.probability.sum(axis=1), 1.0)


@pytest.mark.parametrize("shuffles", [1, pytest.param(20, marks=pytest.mark.nightly)])
def test_with_labels_shuffled_recognition_falls_to_chance(shuffles: int):
    drawn = cohort(1)
    rng = np.random.default_rng(3)
    right = of = 0
    losses = []
    for _ in range(shuffles):
        found = validated(drawn, rng.permutation(drawn.surgeons))
        right, of = right + found.right, of + len(found.tested)
        losses.append(found.log_loss)
    print(f"{right} of {of}, log loss {np.mean(losses):.2f} nat")
    assert abs(right / of - 0.125) < 4 * np.sqrt(0.125 * 0.875 / of)
    assert np.mean(losses) > 0.95 * np.log(8)  # and its confidence is not above chance


@pytest.mark.nightly  # by day an untestable demonstration ignores its session
def test_what_only_the_session_tells_is_not_recognised():
    """All surgeons are alike, two demonstrations per session: nearest neighbours are right, but of the same session."""
    drawn = cohort(2, surgeons=4, sessions=4, own=0.0, day=5.0)
    twice = Cohort(drawn.demos * 2, np.tile(drawn.surgeons, 2), np.tile(drawn.sessions, 2))
    assert validated(twice).interval[0] < 0.25
    alone = Cohort(twice.demos, twice.surgeons, np.arange(len(twice.demos)))  # as if each were a separate session
    assert validated(alone).accuracy > validated(twice).accuracy


@pytest.mark.nightly  # by day the probabilities of one cohort are scored (log loss)
def test_probabilities_hold():
    """Of the statements with a probability of about p, about p are right."""
    drawn = [validated(cohort(seed, own=2.0, day=1.5)) for seed in range(2)]
    curves = np.array([one.curve(2) for one in drawn])
    for _, said, was in curves.mean(axis=0):
        print(f"said {said:.2f}, was {was:.2f}")
        assert abs(said - was) < 0.15


def test_the_fitted_temperature_is_the_likeliest():
    rng = np.random.default_rng(4)
    away, truth = rng.uniform(1.0, 9.0, (200, 3)), rng.integers(0, 3, 200)
    away[np.arange(200), truth] -= 0.8
    temperature, loss = recognition.calibrate(away, truth)

    def loss_of(of: float) -> float:
        return -np.log(recognition.probabilities(away, of)[np.arange(200), truth]).mean()

    assert loss == pytest.approx(loss_of(temperature))
    assert all(loss <= loss_of(temperature * factor) for factor in (0.5, 0.9, 0.99, 1.01, 1.1, 2.0))


def test_one_session_each_or_one_surgeon_is_refused():
    with pytest.raises(BadInput, match="two sessions"):
        validated(cohort(1, sessions=1))
    with pytest.raises(BadInput, match="two sessions"):
        validated(cohort(1, surgeons=1))


def test_copies_are_refused_for_the_median_distance_of_0():
    away = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 3.0]])  # the third demonstration is not the same
    with pytest.raises(BadInput, match="median distance") as refused:
        recognition.calibrate(away, np.array([0, 1, 0]))
    assert "All" not in str(refused.value)
    drawn = cohort(1, surgeons=2, sessions=3)
    with pytest.raises(BadInput, match="median distance"):
        validated(Cohort((drawn.demos[0],) * 6, drawn.surgeons, drawn.sessions))


def test_recognition_of_an_untestable_demo_ignores_its_own_session():
    drawn = cohort(1)
    numbers = signatures(drawn)
    # A motion of surgeon 1 under another name, in another session and then in the same one.
    numbers = np.append(numbers, numbers[[7]], axis=0)
    stranger = np.append(drawn.surgeons, 99)
    apart, together = np.append(drawn.sessions, 99), np.append(drawn.sessions, drawn.sessions[7])
    recordings, last = np.arange(len(stranger)), len(stranger) - 1
    validated = recognition.validate(numbers, stranger, apart, recordings)
    own, none = recognition.recognise(numbers, stranger, apart, recordings, last, validated)
    assert own.argmax() == 1 and own[1] > 0.9
    assert own[-1] == 0.0  # that name occurs in no other session
    assert own.sum() == pytest.approx(1.0)
    beside, none_beside = recognition.recognise(numbers, stranger, together, recordings, last, validated)
    assert beside[1] < own[1] and none_beside > none


def test_a_copy_under_another_name_hides_no_stranger():
    """The distance of a copy is 0 but for rounding; its logarithm once outweighed those of all other surgeons."""
    drawn = cohort(1)
    numbers = signatures(drawn)
    numbers = np.append(numbers, numbers[[7]], axis=0)
    found = recognition.validate(
        numbers, np.append(drawn.surgeons, 99), np.append(drawn.sessions, 99), np.arange(len(numbers))
    )
    without = recognition.validate(numbers[:-1], drawn.surgeons, drawn.sessions, np.arange(len(drawn.surgeons)))
    assert found.stranger_fit[1] > 0.5 * without.stranger_fit[1] > 0.0


def test_one_that_was_tested_is_recognised_as_it_was():
    drawn = cohort(3)
    found = validated(drawn)
    given = signatures(drawn), drawn.surgeons, drawn.sessions, np.arange(40)
    probability, none = recognition.recognise(*given, 12, found)
    assert (probability == found.probability[12]).all() and none == found.stranger[12]
    assert abs(found.sureness - found.accuracy) < 0.25


def test_the_metric_is_the_linear_discriminant_of_another_library():
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    rng = np.random.default_rng(8)
    truth = np.repeat(np.arange(3), 40)
    numbers = np.full((120, recognition.NUMBERS), np.nan)
    mixed = rng.normal(size=(11, 11))
    numbers[:, recognition.FAMILIES["tempo"]] = rng.normal(size=(120, 11)) @ mixed + 0.5 * truth[:, None] * rng.normal(
        size=11
    )
    metric = recognition.fit(numbers, truth, 3, recognition.MetricSettings(("tempo",), 0.0))
    known = numbers[:, recognition.FAMILIES["tempo"]]
    theirs = LinearDiscriminantAnalysis(solver="lsqr", priors=np.full(3, 1 / 3)).fit(known, truth)
    # Theirs divides the covariance by N instead of N - S; ours counts the uncertainty of the means.
    ours = recognition.probabilities(metric.away(numbers) * 41 / 40 * 120 / 117, 2.0)
    np.testing.assert_allclose(ours, theirs.predict_proba(known), atol=1e-6)


def test_the_metric_by_hand_and_a_constant_number_tells_nothing():
    numbers = np.full((4, recognition.NUMBERS), np.nan)
    numbers[:, recognition.FAMILIES["tempo"]] = 0.0
    numbers[:, recognition.FAMILIES["tempo"].start] = [-1.0, 1.0, 9.0, 11.0]
    metric = recognition.fit(numbers, np.array([0, 0, 1, 1]), 3, TEMPO)
    away = metric.away(numbers)
    # One number varies by 2 within a surgeon (variance 4 / 2 = 2), ten do not; shrunk by 0.1 towards a mean of 2 / 11.
    np.testing.assert_allclose(away[0, :2], np.array([1.0, 11.0]) ** 2 * 2 / 3 / (0.9 * 2 + 0.1 * 2 / 11), rtol=1e-9)
    assert np.isinf(away[:, 2]).all() and (metric.nearest(numbers) < 1e-9).all()


@pytest.mark.nightly  # statistics of two cohorts
def test_a_stranger_is_told_when_far_and_not_when_amid_the_others():
    far = validated(cohort(1, own=8.0))
    assert far.unknown.mean() > 3 * far.stranger.mean()
    alike = validated(cohort(2, own=0.0))
    assert alike.unknown.mean() < 1.5 / 9  # the prior is 1 in 9
    assert (far.unknown >= 0).all() and (far.unknown <= 1).all()


def test_a_vote_adds_logarithms_and_no_single_one_rules_a_surgeon_out():
    votes = recognition.vote(np.array([[0.6, 0.4, 0.0], [0.6, 0.4, 0.0], [0.0, 1.0, 0.0]]))
    assert votes.argmax() == 1
    np.testing.assert_allclose(votes[0], 2 * np.log(0.6) + np.log(1e-3))


def test_sessions_of_a_surgeon_are_left_out_one_by_one_where_possible():
    truth, sessions = np.repeat([0, 1, 2], 8), np.tile(np.repeat(np.arange(4), 2), 3) + np.repeat([0, 4, 8], 8)
    fold = recognition.folds_of(sessions, truth, 4)
    assert {len(np.unique(fold[truth == one])) for one in range(3)} == {4}
    assert all(len(np.unique(fold[sessions == one])) == 1 for one in range(12))
    assert len(np.unique(recognition.folds_of(sessions, truth, 99))) == 12


def test_only_families_that_all_have_are_compared_and_place_only_if_asked():
    numbers = signatures(cohort(1, surgeons=2, sessions=2))
    assert recognition.usable(numbers) == [("shape",), ("shape", "tempo"), ("tempo",)]
    assert recognition.usable(numbers, place=True)[0] == ("shape", "place")
    full = np.zeros((2, recognition.NUMBERS))
    assert recognition.usable(full)[-1] == ("shape", "tempo", "jaw", "turning", "orientation")
    assert all("orientation" not in names for names in recognition.usable(full, one_frame=False))
    assert STATES > 0


def motion(rate_hz: float = 100.0) -> Demo:
    """Return a hand-off of 3 s with orientation and jaw, sampled at a rate."""
    drawn = cohort(1, surgeons=1, sessions=1).demos[0]
    u = np.arange(0.0, 3.0 + 1e-9, 1.0 / rate_hz)
    at = drawn.stamps_s / drawn.stamps_s[-1] * 3.0
    tip_mm = np.stack([np.interp(u, at, axis) for axis in drawn.tip_mm.T], axis=1)
    angle = 0.8 * np.sin(u)
    rotation = np.stack([np.sin(angle / 2), 0 * u, 0.2 * np.sin(u), np.cos(angle / 2)], axis=1)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Demo("PSM2", "/t", "PSM2_base", 0.0, 3.0, u, tip_mm, rotation, 0.3 + 0.2 * np.cos(2 * u))


def family(demo: Demo, name: str) -> np.ndarray:
    return recognition.signature_of(demo)[recognition.FAMILIES[name]]


def changed(one: Demo, other: Demo) -> set[str]:
    return {name for name in recognition.FAMILIES if not np.allclose(family(one, name), family(other, name), atol=1e-6)}


def test_each_change_changes_the_families_that_it_should():
    demo = motion()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the base's z axis
    turned = quaternion_of(turn @ matrix_of(demo.rotation_xyzw))
    assert changed(demo, replace(demo, tip_mm=demo.tip_mm + np.array([5.0, -3.0, 2.0]))) == {"place"}
    assert changed(demo, replace(demo, tip_mm=demo.tip_mm @ turn.T, rotation_xyzw=turned)) == {"place", "orientation"}
    assert changed(demo, replace(demo, jaw_rad=demo.jaw_rad + 0.1)) == {"jaw"}
    assert changed(demo, replace(demo, rotation_xyzw=-demo.rotation_xyzw)) == set()
    slower = replace(demo, stamps_s=2 * demo.stamps_s)
    assert {"tempo"} <= changed(demo, slower)
    assert recognition.FAMILIES["place"].stop == recognition.NUMBERS


@pytest.mark.parametrize("rate_hz", [30.0, 200.0])
def test_it_hardly_depends_on_the_sampling_rate(rate_hz: float):
    demo, other = recognition.signature_of(motion()), recognition.signature_of(motion(rate_hz))
    for name, part in recognition.FAMILIES.items():
        apart = np.abs(demo[part] - other[part])
        scale = 1.0 if name in ("shape", "place") else 0.05  # mm; logarithms, rad and cosines
        assert apart.max() < scale, (name, apart)


def test_what_was_not_recorded_is_nan():
    bare = replace(motion(), rotation_xyzw=None, jaw_rad=None)
    missing = {
        name for name, part in recognition.FAMILIES.items() if np.isnan(recognition.signature_of(bare)[part]).all()
    }
    assert missing == {"jaw", "turning", "orientation"}
    around = replace(bare, tip_mm=np.concatenate([bare.tip_mm[:150], bare.tip_mm[150::-1]]))
    assert np.isnan(family(around, "shape")).all() and np.isfinite(family(around, "tempo")).all()


def test_two_samples_a_nanosecond_apart_have_finite_numbers():
    short = Demo("PSM2", "/t", "PSM2_base", 0.0, 1e-9, np.array([0.0, 1e-9]), np.array([[0.0, 0, 0], [5.0, 0, 0]]))
    numbers = recognition.signature_of(short)
    assert (
        np.isfinite(numbers[recognition.FAMILIES["tempo"]]).all()
        and np.isfinite(numbers[recognition.FAMILIES["place"]]).all()
    )


@pytest.mark.nightly  # a minute of processor time
def test_real_surgeons_are_recognised_by_their_hand_offs_and_by_votes():
    need("jigsaws")
    from skills.demonstration.segments import movements_by_arm
    from tests.bench import recognition as bench  # imported here, because it imports much

    nearest_whole_trial = {"Knot_Tying": 0.92, "Needle_Passing": 0.95}  # by DTW on the raw positions
    movements = bench.by_task(movements_by_arm)
    for task, some in bench.by_task().items():
        for name in ("ours", "ours, with the place"):
            single, whole = (bench.judged(parts, bench.METHODS[name]) for parts in (some, movements[task]))
            print(task, name, single.accuracy, single.interval, single.log_loss, whole.accuracy, whole.votes)
            assert single.accuracy >= 0.55
            assert whole.votes > nearest_whole_trial[task]
            for found in (single, whole):
                assert found.log_loss < 0.75 * log(8)
                # Of fifths of 28 hand-offs, the least sure one is too modest by 0.29.
                assert all(abs(said - was) < 0.3 for said, was in found.curve())
