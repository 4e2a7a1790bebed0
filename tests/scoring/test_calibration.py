"""Calibration on a cohort of known truth: skill is found, not invented, and reported correctly."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from skills.errors import BadInput
from skills.scoring.calibration import (
    ACCEPTED_P,
    LEAST_PERMUTATIONS,
    LOGISTIC,
    RIDGE,
    RIVALS,
    Cohort,
    calibrate,
    held_out,
    level_refusals,
    refusals,
    rival_predictions,
    shuffled,
    spearman,
    validate,
)
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
    found = validate(cohort(3, told=0.0), permutations=20)
    print(found)
    assert found.chance.rho_p > 0.05
    assert found.all_figures.rho < found.chance.rho_95


@pytest.mark.nightly
def test_the_chance_of_a_small_p_is_small_where_nothing_shows() -> None:
    """Of 40 cohorts without any effect, at most a fifth may claim p < 0.1."""
    small = sum(validate(cohort(seed, told=0.0), permutations=40).chance.rho_p < 0.1 for seed in range(40))
    assert small <= 8


# ---- acceptance, where the truth is known --------------------------------------------------------------------------


def drawn_cohort(kind: str, seed: int) -> Cohort:
    """Draw figures with an effect of the surgeon and one of the trial, and ratings by a known rule, with noise.

    Args:
        kind: The rule. "nothing", "surgeon" (an effect of the surgeon that no figure shows), "duration", "shared" (the
            duration, which every figure shows with noise) or "smoothness".
        seed: Seed of the draw.
    """
    rng = np.random.default_rng([seed, len(kind)])
    whose = np.repeat(np.arange(SURGEONS), TRIALS)

    def effects(size: float) -> np.ndarray:
        return size * (rng.normal(size=SURGEONS)[whose] + rng.normal(size=len(whose)))

    values = np.stack([effects(0.7) for _ in MODELLED], axis=1)
    if kind == "shared":
        values[:, 1:] = values[:, :1] + 0.5 * values[:, 1:]
    told = {
        "nothing": rng.normal(size=len(whose)),
        "surgeon": effects(1.0),
        "duration": effects(0.3) - values[:, 0],
        "shared": effects(0.3) - values[:, 0],
        "smoothness": effects(0.15) + values[:, 3],
    }[kind]
    ratings = np.rint(np.clip(18.0 + 5.0 * told / told.std(), 6, 30))
    means = np.array([ratings[whose == surgeon].mean() for surgeon in range(SURGEONS)])
    levels = means.argsort().argsort() * 3 // SURGEONS
    return Cohort(values, np.arange(len(whose)), whose, ratings, levels[whose])


def accepted(kind: str, draws: int) -> int:
    """Return the number of draws whose model is accepted."""
    judged = (validate(drawn_cohort(kind, seed), permutations=20) for seed in range(draws))
    count = sum(not refusals(asdict(one)) for one in judged)
    print(f"{kind}: {count} of {draws} accepted")
    return count


HOPELESS = ("nothing", "surgeon", "duration", "shared")


def test_models_of_nothing_and_of_the_duration_alone_are_refused() -> None:
    assert sum(accepted(kind, 1) for kind in ("surgeon", "shared")) == 0  # the most deceptive; all of them at night


def test_a_model_that_truly_predicts_is_accepted() -> None:
    assert accepted("smoothness", 1) == 1


@pytest.mark.nightly
@pytest.mark.parametrize("kind", HOPELESS)
def test_of_many_hopeless_models_at_most_a_twentieth_is_accepted(kind: str) -> None:
    assert accepted(kind, 100) <= 5


@pytest.mark.nightly
def test_of_many_predictive_models_most_are_accepted() -> None:
    assert accepted("smoothness", 100) >= 95


def test_the_duration_of_the_trial_competes_with_a_model_of_hand_offs() -> None:
    """Hand-offs whose own durations say nothing, in trials whose duration says everything."""
    drawn = drawn_cohort("smoothness", 0)
    whole = np.stack([30.0 - drawn.ratings, np.ones(40), np.ones(40)], axis=1)
    told = Cohort(drawn.values, drawn.trials, drawn.surgeons, drawn.ratings, drawn.levels, whole)
    found = validate(told, permutations=20)
    assert found.rivals["motion_duration"].rho < 0.5
    assert found.duration_only.rho == found.rivals["shorter_first"].rho == pytest.approx(1.0)
    assert found.over_duration[1] <= 0.0
    assert any("no better than the duration alone (1.00" in why for why in refusals(asdict(found)))


# ---- few permutations ------------------------------------------------------------------------------------------------


def judged_by(as_good: int, permutations: int) -> dict[str, Any]:
    """Return the figures of an excellent model, with p from the permutations that do as well."""
    p = (1 + as_good) / (1 + permutations)
    return {
        "all_figures": {"rho": 0.9, "rho_interval": (0.8, 0.95), "accuracy": 0.9},
        "duration_only": {"rho": 0.1, "accuracy": 0.3},
        "chance": {"permutations": permutations, "rho_p": p, "accuracy_p": p, "commonest": 0.4},
        "over_duration": (0.5, 0.8),
    }


@pytest.mark.parametrize(
    ("as_good", "permutations", "said"),
    [
        (1, 20, "p = 0.095; at most 0.05 is accepted; it may be 0.009 to 0.236, because 20 permutations are few"),
        (10, 200, "p = 0.055; at most 0.05 is accepted; it may be 0.027 to 0.090, because 200 permutations are few"),
    ],
)
def test_a_refusal_that_few_permutations_may_have_made_says_so(as_good: int, permutations: int, said: str) -> None:
    judged = judged_by(as_good, permutations)
    (order,), (levels,) = refusals(judged), level_refusals(judged)
    assert order == f"A random order does as well ({said}: calibrate again with more)."
    assert levels == f"Random levels are right as often ({said}: calibrate again with more)."


def test_a_refusal_that_more_permutations_would_confirm_asks_for_none() -> None:
    for as_good, permutations in ((10, 20), (20, 200), (600, 10_000)):
        judged = judged_by(as_good, permutations)
        (one,), (other,) = refusals(judged), level_refusals(judged)
        assert "with more" not in one + other
    older = judged_by(1, 20)
    del older["chance"]["permutations"]
    assert ["with more" in why for why in (*refusals(older), *level_refusals(older))] == [False, False]
    assert refusals(judged_by(0, 20)) == level_refusals(judged_by(0, 20)) == []


@pytest.mark.parametrize("permutations", [0, 1, 18])
def test_permutations_that_could_accept_no_model_are_refused(permutations: int) -> None:
    with pytest.raises(BadInput, match=rf"{permutations} permutations .* at least 19"):
        validate(cohort(), permutations=permutations)
    assert 1 / (1 + LEAST_PERMUTATIONS) <= ACCEPTED_P < 1 / LEAST_PERMUTATIONS


def test_rivals_are_the_trivial_predictions_and_have_not_seen_the_surgeon() -> None:
    from sklearn.linear_model import Ridge  # here and below, because the import takes a second
    from sklearn.preprocessing import StandardScaler

    drawn = cohort(motions=2)
    found = rival_predictions(drawn)
    assert list(found) == list(RIVALS)
    means = [drawn.ratings[drawn.surgeons != surgeon].mean() for surgeon in drawn.surgeons]
    np.testing.assert_allclose(found["mean"].ratings, means)
    duration_s = drawn.values[:, 0].reshape(-1, 2).sum(axis=1)  # of both motions, by default
    np.testing.assert_allclose(drawn.whole[:, 0], duration_s)
    np.testing.assert_allclose(found["shorter_first"].ratings, -duration_s)
    np.testing.assert_allclose(found["gestures"].ratings, means)  # two in every trial
    mine = drawn.surgeons == 3
    theirs, trial = ~mine, np.flatnonzero(mine)[0]
    standard = StandardScaler().fit(duration_s[theirs, None])
    ridge = Ridge(alpha=RIDGE).fit(standard.transform(duration_s[theirs, None]), drawn.ratings[theirs])
    expected = ridge.predict(standard.transform(duration_s[[trial], None]))
    np.testing.assert_allclose(found["trial_duration"].ratings[trial], expected[0])


def test_the_model_is_that_of_scikit_learn_as_one_would_write_it() -> None:
    from sklearn.linear_model import LogisticRegression, Ridge
    from sklearn.preprocessing import StandardScaler

    drawn = cohort()
    model = calibrate(drawn)
    standard = StandardScaler().fit_transform(drawn.values)
    ridge = Ridge(alpha=RIDGE).fit(standard, drawn.ratings)
    logistic = LogisticRegression(C=LOGISTIC, max_iter=1000).fit(standard, drawn.levels)
    np.testing.assert_allclose(model.ratings(drawn.values), ridge.predict(standard).clip(6, 30))
    np.testing.assert_allclose(model.probabilities(drawn.values), logistic.predict_proba(standard), atol=1e-6)
    assert model.levels == ("novice", "intermediate", "expert")


def test_of_two_levels_the_probability_is_that_of_scikit_learn_too() -> None:
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import StandardScaler

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
    from scipy.stats import spearmanr

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
