"""The fit of a model of skill: against scikit-learn, without the surgeon that is left out, and its numbers."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skills.errors import BadInput
from skills.scoring import calibration
from tests.scoring.cohorts import cohort


def fitted_by_sklearn(drawn: calibration.Cohort, inside: np.ndarray, design: calibration.Design) -> np.ndarray:
    """Return the scores of all trials by scikit-learn, as one would write it: shape (N,)."""
    from sklearn.linear_model import Ridge  # here, because the import takes a second

    figures = drawn.values.mean(axis=1) if design.masters else drawn.values[:, 0]
    standard, aims, shares = np.empty_like(figures), np.empty(len(figures)), np.empty(len(figures))
    for task in range(len(drawn.names)):
        here, seen = drawn.tasks == task, inside & (drawn.tasks == task)
        standard[here] = (figures[here] - figures[seen].mean(axis=0)) / figures[seen].std(axis=0)
        aims[here] = (drawn.ratings[here, 0] - drawn.ratings[seen, 0].mean()) / drawn.ratings[seen, 0].std()
        shares[here] = 1.0 / seen.sum()
    scores = np.empty(len(figures))
    for task in range(len(drawn.names)):
        seen = inside if design.together else inside & (drawn.tasks == task)
        ridge = Ridge(alpha=design.strength, fit_intercept=False)
        ridge.fit(standard[seen], aims[seen], sample_weight=shares[seen])
        size = np.sqrt(np.average(ridge.predict(standard[seen]) ** 2, weights=shares[seen]))
        here = drawn.tasks == task
        scores[here] = ridge.predict(standard[here]) / size
    return scores


@pytest.mark.parametrize(("tasks", "sides"), [(1, 1), (2, 2)])
def test_scores_of_surgeons_left_out_are_those_of_scikit_learn(tasks: int, sides: int) -> None:
    drawn = cohort(tasks=tasks, sides=sides, surgeons=5, trials=3)
    found = calibration.left_out_scores(drawn, drawn.surgeons, drawn.ratings[:, :1, None])
    designs = calibration.designs_of(drawn)
    assert len(designs) == 3 * tasks * sides
    for surgeon, (best,) in enumerate(found.chosen):
        out = drawn.surgeons == surgeon
        expected = fitted_by_sklearn(drawn, ~out, designs[best])
        np.testing.assert_allclose(found.scores[out, 0, 0], expected[out], atol=1e-9)


def test_the_chosen_design_is_the_best_on_the_other_surgeons() -> None:
    drawn = cohort(seed=2, tasks=2, surgeons=4, trials=3)
    designs = calibration.designs_of(drawn)
    found = calibration.left_out_scores(drawn, drawn.surgeons, drawn.ratings[:, :1, None])
    for out, (best,) in enumerate(found.chosen[:2]):
        rhos = []
        for number, design in enumerate(designs):
            scores = np.zeros(len(drawn.tasks))
            for other in set(range(4)) - {out}:
                mine = drawn.surgeons == other
                scores[mine] = fitted_by_sklearn(drawn, ~mine & (drawn.surgeons != out), design)[mine]
            if number == best:
                np.testing.assert_allclose(found.inner[out, :, 0], scores, atol=1e-9)
            rows = [of_task[drawn.surgeons[of_task] != out] for of_task in drawn.by_task]
            rhos.append(
                np.mean([calibration.rank_correlations(scores[None, one], drawn.ratings[one, 0])[0] for one in rows])
            )
        assert rhos[best] == pytest.approx(max(rhos))


def test_a_surgeon_left_out_is_not_seen() -> None:
    """A surgeon's own ratings, parts and levels change nothing for that surgeon, and something for all others."""
    drawn = cohort(tasks=2)
    mine = drawn.surgeons == 3
    ratings = np.where(mine[:, None], [6.0, *[1.0] * 6], drawn.ratings)
    lied = replace(drawn, ratings=ratings, levels=np.where(mine, 0, drawn.levels))
    one, other = calibration.held_out(drawn), calibration.held_out(lied)
    for of_one, of_other in ((one.scores, other.scores), (one.ratings, other.ratings), (one.levels, other.levels)):
        np.testing.assert_array_equal(of_one[mine], of_other[mine])
    assert (one.scores[~mine, 0] != other.scores[~mine, 0]).all()


def test_variants_are_predicted_as_each_alone() -> None:
    drawn = cohort(surgeons=5)
    rng = np.random.default_rng(1)
    several = np.stack([drawn.ratings[rng.permutation(25), :1] for _ in range(3)], axis=2)
    levels = np.stack([drawn.levels, drawn.levels[::-1], drawn.levels], axis=1)
    together = calibration.held_out(drawn, several, levels)
    for variant in range(3):
        alone = calibration.held_out(drawn, several[:, :, variant : variant + 1], levels[:, variant : variant + 1])
        np.testing.assert_allclose(together.scores[:, :, variant], alone.scores[:, :, 0], atol=1e-12)
        np.testing.assert_array_equal(together.levels[:, variant], alone.levels[:, 0])


def test_a_task_without_a_trial_in_the_fit_is_scored_as_average() -> None:
    """With one repetition in a task, none is left when it is left out."""
    drawn = cohort(tasks=2, surgeons=5, trials=3)
    once = replace(drawn, repetitions=np.where(drawn.tasks == 1, 0, drawn.repetitions))
    scores = calibration.left_out_scores(once, once.repetitions, once.ratings[:, :1, None]).scores
    np.testing.assert_array_equal(scores[once.tasks == 1], 0.0)
    assert (scores[once.tasks == 0] != 0.0).all()


def test_the_model_rates_in_points_and_the_levels_are_the_nearest() -> None:
    drawn = cohort(surgeons=10)
    found = calibration.held_out(drawn)
    model = calibration.calibrate(drawn, found)
    predicted = model.ratings(0, drawn.figures(model.masters))
    assert np.abs(predicted[:, 0] - drawn.ratings[:, 0]).mean() < 0.5 * drawn.ratings[:, 0].std()
    assert calibration.rank_correlations(predicted[:, 0][None], drawn.ratings[:, 0])[0] > 0.9
    np.testing.assert_allclose(model.ratings(0, model.centre)[0, 0], drawn.ratings[:, 0].mean())
    mean = [drawn.ratings[drawn.levels == level, 0].mean() for level in range(len(calibration.LEVELS))]
    np.testing.assert_allclose(model.level_ratings[0], mean)
    np.testing.assert_allclose(model.level_shares[0].sum(axis=1), 1.0)
    right = (found.levels[:, 0] == drawn.levels).mean()
    assert right > 0.5
    held = (np.abs(found.ratings[:, 0] - drawn.ratings[:, 0]) <= model.margins[0]).mean()
    assert 0.9 <= held <= 0.95


def test_ratings_stay_in_their_range() -> None:
    drawn = cohort()
    model = calibration.calibrate(drawn, calibration.held_out(drawn))
    far = model.centre[0] + 100.0 * np.sign(model.weights[0, 0]) * model.scale[0]
    best, worst = model.ratings(0, far), model.ratings(0, 2 * model.centre[0] - far)
    assert best[0] == 30.0 and worst[0] == 6.0
    assert (best[1:] <= 5.0).all() and (worst[1:] >= 1.0).all()


def test_a_figure_that_never_varies_weighs_nothing() -> None:
    drawn = cohort()
    values = drawn.values.copy()
    values[:, :, 4] = 0.1
    still = replace(drawn, values=values)
    model = calibration.calibrate(still, calibration.held_out(still))
    np.testing.assert_allclose(model.weights[0, :, 4], 0.0, atol=1e-12)


def test_rank_correlation_is_that_of_scipy_ties_included() -> None:
    from scipy.stats import spearmanr

    rng = np.random.default_rng(2)
    for _ in range(20):
        one, other = rng.integers(0, 6, 15).astype(float), rng.integers(0, 6, 15).astype(float)
        assert calibration.rank_correlations(one[None], other)[0] == pytest.approx(spearmanr(one, other).statistic)
    assert calibration.rank_correlations(np.ones((1, 4)), np.arange(4.0))[0] == 0.0


def test_every_bit_of_a_model_survives_as_numbers() -> None:
    drawn = cohort(tasks=2)
    model = calibration.calibrate(drawn, calibration.held_out(drawn))
    again = calibration.from_numbers(json.loads(json.dumps(calibration.as_numbers(model))))
    assert calibration.as_numbers(again) == calibration.as_numbers(model)


@pytest.mark.parametrize("wrong", [{"centre": [[1.0]]}, {"margins": [np.nan]}, {"means": [[1.0] * 6]}])
def test_numbers_that_are_no_model_are_refused(wrong: dict[str, Any]) -> None:
    drawn = cohort()
    with pytest.raises(BadInput):
        calibration.SkillModel(**vars(calibration.calibrate(drawn, calibration.held_out(drawn))) | wrong)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"surgeons": np.zeros(40, int)}, "Task_A has rated trials of 1 surgeon; at least 4"),
        ({"surgeons": np.arange(40) % 3}, "of 3 surgeons; at least 4"),
        ({"ratings": np.full((40, 7), 4.0)}, "Task_A have the same rating"),
        ({"ratings": np.full((40, 7), np.nan)}, "NaN"),
        ({"values": np.full((40, 1, 17), np.inf)}, "NaN or infinity"),
        ({"thirds": np.zeros((40, 1, 2, 17))}, "thirds has shape"),
    ],
)
def test_what_nothing_can_be_learnt_from_is_refused(changed: dict[str, np.ndarray], said: str) -> None:
    with pytest.raises(BadInput, match=said):
        replace(cohort(), **changed)
