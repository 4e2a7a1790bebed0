"""Recognition of styles: known cohorts, chance if there is no information, and sessions that are left out."""

import numpy as np
import pytest

from skills.comparison.distances import distances, shape_of
from skills.comparison.recognition import Validated, calibrate, probabilities, recognise, validate
from skills.errors import BadInput
from tests.comparison.cohort import Cohort, cohort


def validated(drawn: Cohort, surgeons: np.ndarray | None = None) -> Validated:
    shapes = [shape_of(demo) for demo in drawn.demos]
    return validate(distances(shapes, shapes), drawn.surgeons if surgeons is None else surgeons, drawn.sessions)


def test_eight_surgeons_in_five_sessions_are_recognised():
    found = validated(cohort(1))
    print(f"{found.right} of {len(found.tested)}, {found.interval}, log loss {found.log_loss:.2f} nat")
    assert found.chance == 0.125
    assert found.interval[0] > 0.6
    assert found.log_loss < 0.5 * np.log(8)
    np.testing.assert_allclose(found.probability.sum(axis=1), 1.0)


def test_with_labels_shuffled_recognition_falls_to_chance():
    drawn = cohort(1)
    rng = np.random.default_rng(3)
    right = of = 0
    losses = []
    for _ in range(20):
        found = validated(drawn, rng.permutation(drawn.surgeons))
        right, of = right + found.right, of + len(found.tested)
        losses.append(found.log_loss)
    print(f"{right} of {of}, log loss {np.mean(losses):.2f} nat")
    assert abs(right / of - 0.125) < 4 * np.sqrt(0.125 * 0.875 / of)
    assert np.mean(losses) > 0.95 * np.log(8)  # and its confidence is not above chance


def test_what_only_the_session_tells_is_not_recognised():
    """All surgeons are alike, two demonstrations per session: nearest neighbours are right, but of the same session."""
    drawn = cohort(2, surgeons=4, sessions=4, own=0.0, day=5.0)
    twice = Cohort(drawn.demos * 2, np.tile(drawn.surgeons, 2), np.tile(drawn.sessions, 2))
    assert validated(twice).interval[0] < 0.25
    alone = Cohort(twice.demos, twice.surgeons, np.arange(len(twice.demos)))  # as if each were a separate session
    assert validated(alone).accuracy > validated(twice).accuracy


def test_probabilities_hold():
    """Of the statements with a probability of about p, about p are right."""
    drawn = [validated(cohort(seed, own=2.0, day=1.5)) for seed in range(6)]
    truth = np.tile(np.repeat(np.arange(8), 5), 6)
    said = np.concatenate([one.probability for one in drawn])
    sure, right = said.max(axis=1), said.argmax(axis=1) == truth
    low, high = sure < np.median(sure), sure >= np.median(sure)
    for part in (low, high):
        print(f"said {sure[part].mean():.2f}, was {right[part].mean():.2f}")
        assert abs(sure[part].mean() - right[part].mean()) < 0.15


def test_the_fitted_scale_is_the_likeliest():
    rng = np.random.default_rng(4)
    away, truth = rng.uniform(1.0, 9.0, (200, 3)), rng.integers(0, 3, 200)
    away[np.arange(200), truth] -= 0.8
    scale = calibrate(away, truth)

    def loss(of: float) -> float:
        return -np.log(probabilities(away, of)[np.arange(200), truth]).mean()

    assert all(loss(scale) <= loss(scale * factor) for factor in (0.5, 0.9, 0.99, 1.01, 1.1, 2.0))


def test_one_session_each_or_one_surgeon_is_refused():
    with pytest.raises(BadInput, match="two sessions"):
        validated(cohort(1, sessions=1))
    with pytest.raises(BadInput, match="two sessions"):
        validated(cohort(1, surgeons=1))


def test_copies_are_refused_for_the_median_distance_of_0():
    away = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 3.0]])  # the third demonstration is not the same
    with pytest.raises(BadInput, match="median distance") as refused:
        calibrate(away, np.array([0, 1, 0]))
    assert "All" not in str(refused.value)


def test_recognition_of_an_untestable_demo_ignores_its_own_session():
    drawn = cohort(1)
    shapes = [shape_of(demo) for demo in drawn.demos]
    shapes += [shapes[7]]  # a motion of surgeon 1 under another name, once in a separate session ...
    apart = distances(shapes, shapes)
    stranger = np.append(drawn.surgeons, 99)
    own = recognised(apart, stranger, np.append(drawn.sessions, 99))
    assert own.argmax() == 1 and own[1] > 0.9
    assert own[-1] == 0.0  # that name occurs in no other session
    assert own.sum() == pytest.approx(1.0)
    beside = recognised(apart, stranger, np.append(drawn.sessions, drawn.sessions[7]))  # ... and once in the same one
    apart[7, -1] = apart[-1, 7] = 1e6
    together = np.append(drawn.sessions, drawn.sessions[7])
    np.testing.assert_array_equal(recognised(apart, stranger, together), beside)
    assert recognised(apart, stranger, np.append(drawn.sessions, 99))[1] < own[1]


def recognised(apart: np.ndarray, surgeons: np.ndarray, sessions: np.ndarray) -> np.ndarray:
    return recognise(apart, surgeons, sessions, len(surgeons) - 1, validate(apart, surgeons, sessions))


def test_one_that_was_tested_is_recognised_as_it_was():
    drawn = cohort(3)
    shapes = [shape_of(demo) for demo in drawn.demos]
    apart, found = distances(shapes, shapes), validated(drawn)
    assert (recognise(apart, drawn.surgeons, drawn.sessions, 12, found) == found.probability[12]).all()
    assert abs(found.sureness - found.accuracy) < 0.25
