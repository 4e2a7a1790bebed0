"""Calibration on a cohort of known truth: skill is found, not invented, and reported correctly."""

import numpy as np
import pytest
from scipy.stats import spearmanr
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.preprocessing import StandardScaler

from skills.errors import BadInput
from skills.scoring.calibration import LOGISTIC, RIDGE, Cohort, calibrate, held_out, shuffled, spearman, validate
from skills.scoring.features import MODELLED

SURGEONS, TRIALS = 8, 5


def cohort(seed: int = 0, surgeons: int = SURGEONS, motions: int = 1, told: float = 1.0) -> Cohort:
    """Return a cohort whose figures depend on skill, with noise, the duration least; with `told` 0 they do not."""
    rng = np.random.default_rng(seed)
    skill = np.linspace(-1.0, 1.0, surgeons)
    whose = np.repeat(np.arange(surgeons), TRIALS)
    trials = np.repeat(np.arange(surgeons * TRIALS), motions)
    weights = told * np.array([-0.4, -1.0, 1.0, 1.0, -1.0, -1.0])
    values = np.array([10.0, 80.0, -2.0, -8.0, 0.1, 0.6]) + np.array([2.0, 15.0, 0.5, 2.0, 0.05, 0.2]) * (
        skill[whose][trials][:, None] * weights + rng.normal(0.0, 0.6, (len(trials), len(MODELLED)))
    )
    ratings = np.rint(np.clip(18.0 + 8.0 * skill[whose] + rng.normal(0.0, 1.0, len(whose)), 6, 30))
    return Cohort(values, trials, whose, ratings, np.searchsorted([-0.35, 0.35], skill)[whose])


def test_skill_that_shows_is_found_at_surgeons_left_out() -> None:
    found = validate(cohort(), permutations=20)
    best, chance = found.all_figures, found.chance
    print(best, found.duration_only, chance)
    assert best.rho > 0.8
    assert best.rho_interval[0] > 0.4
    assert best.rho > found.duration_only.rho + 0.1
    assert best.accuracy_interval[0] > chance.commonest
    assert chance.rho < 0.3 and chance.rho_p < 0.1 and chance.accuracy_p < 0.2  # of 20; one in 21 is the least


def fallen_to_chance(seeds: range) -> None:
    """Shuffle labels among surgeons, and assert that neither figure is above chance on average."""
    rhos, rights, claims = [], [], 0
    for seed in seeds:
        drawn = cohort(seed)
        dealt = shuffled(drawn, np.random.default_rng([seed, 1]))
        found = held_out(dealt)
        rhos.append(spearman(found.ratings, dealt.ratings))
        rights.append(float((found.levels == dealt.levels).mean()))
        claims += rhos[-1] > 0.8
    print(f"{len(seeds)} shuffles: rho {np.mean(rhos):.2f}, right {np.mean(rights):.2f}")
    assert np.mean(rhos) < 0.1
    assert np.mean(rights) < 0.4
    assert claims <= 0.1 * len(seeds)


def test_with_labels_shuffled_rho_and_accuracy_fall_to_chance() -> None:
    fallen_to_chance(range(10))


@pytest.mark.nightly
def test_with_labels_shuffled_many_times() -> None:
    fallen_to_chance(range(300))


def test_chance_is_told_where_nothing_shows() -> None:
    found = validate(cohort(3, told=0.0), permutations=40)
    print(found)
    assert found.chance.rho_p > 0.05
    assert found.all_figures.rho < found.chance.rho_95


@pytest.mark.nightly
def test_the_chance_of_a_small_p_is_small_where_nothing_shows() -> None:
    """Of 40 cohorts without any effect, at most a fifth may claim p < 0.1."""
    small = sum(validate(cohort(seed, told=0.0), permutations=40).chance.rho_p < 0.1 for seed in range(40))
    assert small <= 8


def test_the_model_is_that_of_scikit_learn_as_one_would_write_it() -> None:
    drawn = cohort()
    model = calibrate(drawn)
    standard = StandardScaler().fit_transform(drawn.values)
    ridge = Ridge(alpha=RIDGE).fit(standard, drawn.ratings)
    logistic = LogisticRegression(C=LOGISTIC, max_iter=1000).fit(standard, drawn.levels)
    np.testing.assert_allclose(model.ratings(drawn.values), ridge.predict(standard).clip(6, 30))
    np.testing.assert_allclose(model.probabilities(drawn.values), logistic.predict_proba(standard), atol=1e-6)
    assert model.levels == ("novice", "intermediate", "expert")


def test_of_two_levels_the_probability_is_that_of_scikit_learn_too() -> None:
    drawn = cohort()
    two = Cohort(drawn.values, drawn.trials, drawn.surgeons, drawn.ratings, np.where(drawn.levels == 0, 0, 2))
    model = calibrate(two)
    standard = StandardScaler().fit_transform(two.values)
    logistic = LogisticRegression(C=LOGISTIC, max_iter=1000).fit(standard, two.levels)
    assert model.levels == ("novice", "expert")
    np.testing.assert_allclose(model.probabilities(two.values), logistic.predict_proba(standard), atol=1e-6)


def test_the_margin_holds_nine_tenths_of_what_was_left_out() -> None:
    drawn = cohort(motions=3)
    held = (np.abs(held_out(drawn).off) <= calibrate(drawn).rating_margin).mean()
    assert 0.9 <= held <= 0.95


def test_a_surgeon_left_out_is_not_seen() -> None:
    """A surgeon's own ratings do not change the prediction for that surgeon."""
    drawn = cohort()
    ratings = np.where(drawn.surgeons == 3, 6.0, drawn.ratings)
    lied = Cohort(drawn.values, drawn.trials, drawn.surgeons, ratings, drawn.levels)
    mine = drawn.surgeons == 3
    np.testing.assert_array_equal(held_out(lied).ratings[mine], held_out(drawn).ratings[mine])
    assert (held_out(lied).ratings[~mine] != held_out(drawn).ratings[~mine]).all()


def test_a_trial_of_many_motions_weighs_as_much_as_any_other() -> None:
    once = cohort()
    twice = Cohort(
        np.concatenate([once.values, once.values[:5]]), np.append(once.trials, np.arange(5)),
        once.surgeons, once.ratings, once.levels,
    )  # fmt: skip
    values = once.values
    np.testing.assert_allclose(calibrate(twice).ratings(values), calibrate(once).ratings(values), atol=1e-9)
    np.testing.assert_allclose(held_out(twice).ratings, held_out(once).ratings, atol=1e-9)


def test_a_figure_that_never_varies_weighs_nothing() -> None:
    drawn = cohort()
    values = drawn.values.copy()
    values[:, 4] = 0.1
    model = calibrate(Cohort(values, drawn.trials, drawn.surgeons, drawn.ratings, drawn.levels))
    assert model.rating_weights[4] == pytest.approx(0.0, abs=1e-9)


def test_rank_correlation_is_that_of_scipy_ties_included() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        one, other = rng.integers(0, 6, 15).astype(float), rng.integers(0, 6, 15).astype(float)
        assert spearman(one, other) == pytest.approx(spearmanr(one, other).statistic)
    assert spearman(np.ones(4), np.arange(4.0)) == 0.0


def test_shuffling_deals_whole_surgeons_out() -> None:
    drawn = cohort()
    dealt = shuffled(drawn, np.random.default_rng(5))
    blocks = {tuple(drawn.ratings[drawn.surgeons == s]) for s in range(SURGEONS)}
    assert {tuple(dealt.ratings[dealt.surgeons == s]) for s in range(SURGEONS)} == blocks
    assert (dealt.ratings != drawn.ratings).any()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"surgeons": np.zeros(40, int)}, "There is 1 surgeon"),
        ({"surgeons": np.arange(40) % 2}, "There are 2 surgeons"),
        ({"levels": np.zeros(40, int)}, "one skill level"),
        ({"ratings": np.full(40, 18.0)}, "the same rating"),
        ({"ratings": np.full(40, np.nan)}, "NaN"),
        ({"values": np.full((40, 6), np.inf)}, "NaN or infinity"),
    ],
)
def test_what_nothing_can_be_learnt_from_is_refused(changed: dict[str, np.ndarray], said: str) -> None:
    drawn = cohort()
    whole = {name: getattr(drawn, name) for name in ("values", "trials", "surgeons", "ratings", "levels")}
    with pytest.raises(BadInput, match=said):
        Cohort(**(whole | changed))
