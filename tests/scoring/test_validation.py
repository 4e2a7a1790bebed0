"""Evidence before words: skill that shows is rated, and what cannot be known is refused, on cohorts of known truth."""

import json
import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from skills.errors import BadInput
from skills.fields import parse_json
from skills.scoring import validation
from skills.scoring.calibration import held_out, rank_correlations
from tests.scoring.cohorts import Rule, cohort


@pytest.fixture(scope="module")
def judged() -> validation.TaskValidation:
    """Return the figures of a model of a skill that shows."""
    return validation.validate(cohort(), permutations=39)[1].tasks["Task_A"]


def test_skill_that_shows_is_found_at_surgeons_left_out(judged: validation.TaskValidation) -> None:
    assert judged.model.rho > 0.8 and judged.model.rho_interval[0] > 0.6
    assert judged.repetition_out.rho > 0.8
    assert judged.over_duration[0] > 0 and judged.chance.rho_p == pytest.approx(1 / 40)
    assert parse_json(validation.TaskValidation, json.loads(json.dumps(asdict(judged)))) == judged
    assert validation.refusals(judged) == validation.level_refusals(judged) == []
    assert len(validation.known_parts(judged)) == 6


@pytest.mark.nightly  # by day models of nothing and of the duration are refused
def test_rivals_are_the_trivial_predictions() -> None:
    drawn = cohort(seed=5)
    found = asdict(validation.validate(drawn, permutations=39)[1])["tasks"]["Task_A"]["rivals"]
    assert list(found) == list(validation.RIVALS)
    ratings, surgeons = drawn.ratings[:, 0], drawn.surgeons
    means = np.array([ratings[surgeons != surgeon].mean() for surgeon in surgeons])
    own = np.array(
        [ratings[(surgeons == surgeon) & (np.arange(40) != row)].mean() for row, surgeon in enumerate(surgeons)]
    )
    expected = {"mean": means, "shorter_first": -drawn.values[:, 0, 0], "same_surgeon": own}
    for name, series in expected.items():
        assert found[name]["rho"] == pytest.approx(rank_correlations(series[None], ratings)[0]), name
    assert found["mean"]["rho"] < -0.5  # the better the one who is left out, the lower the mean of the others


@pytest.mark.nightly  # by day one task
def test_several_tasks_are_judged_one_by_one_and_their_mean() -> None:
    drawn = cohort(tasks=2)
    found = asdict(validation.validate(drawn, permutations=39)[1])
    assert list(found["tasks"]) == ["Task_A", "Task_B"]
    both = [one["model"]["rho"] for one in found["tasks"].values()]
    assert found["mean"]["model"]["rho"] == pytest.approx(np.mean(both))
    assert sum(found["chosen"].values()) == 8


def test_the_same_seed_gives_the_same_figures() -> None:
    one, other = (asdict(validation.validate(cohort(surgeons=5), permutations=39)[1]) for _ in range(2))
    assert one == other


def test_shuffling_deals_whole_surgeons_out_in_all_tasks() -> None:
    drawn = cohort(tasks=2)
    order = validation.shuffled(drawn, np.random.default_rng(5))
    giver = {int(a): int(b) for a, b in zip(drawn.surgeons, drawn.surgeons[order], strict=True)}
    assert sorted(giver.values()) == list(range(8))
    np.testing.assert_array_equal(drawn.surgeons[order], [giver[int(one)] for one in drawn.surgeons])
    np.testing.assert_array_equal(drawn.tasks[order], drawn.tasks)
    np.testing.assert_array_equal(drawn.repetitions[order], drawn.repetitions)


def test_shuffling_passes_over_surgeons_without_trials_of_a_task() -> None:
    drawn = cohort(tasks=2)
    kept = (drawn.tasks == 0) | (drawn.surgeons != 2)
    named = ("values", "thirds", "tasks", "surgeons", "repetitions", "ratings", "levels")
    without = replace(drawn, **{name: getattr(drawn, name)[kept] for name in named})
    for seed in range(10):
        order = validation.shuffled(without, np.random.default_rng(seed))
        first, second = (
            dict(zip(without.surgeons[rows].tolist(), without.surgeons[order[rows]].tolist(), strict=True))
            for rows in without.by_task
        )
        assert sorted(second.values()) == [0, 1, 3, 4, 5, 6, 7]
        for to, of in second.items():
            assert of == (first[2] if first[to] == 2 else first[to])


# ---- acceptance, where the truth is known --------------------------------------------------------------------------


def accepted(rule: Rule, seeds: range, **size: int) -> int:
    """Return the number of cohorts of which a task is rated."""
    found = (validation.validate(cohort(seed, rule, **size), permutations=39)[1] for seed in seeds)
    count = sum(any(not validation.refusals(task) for task in one.tasks.values()) for one in found)
    print(f"{rule}: {count} of {len(seeds)} accepted")
    return count


HOPELESS: tuple[Rule, ...] = ("nothing", "surgeon", "duration", "shared")


def test_models_of_nothing_and_of_the_duration_alone_are_refused() -> None:
    assert sum(accepted(rule, range(1)) for rule in ("surgeon", "shared")) == 0  # the most deceptive; all at night


@pytest.mark.nightly
@pytest.mark.parametrize("rule", HOPELESS)
def test_of_many_hopeless_models_at_most_a_twentieth_is_accepted(rule: Rule) -> None:
    assert accepted(rule, range(100)) <= 5


def dealt_and_rated(seeds: range) -> int:
    """Deal the ratings of a cohort of two tasks, with skill that shows, among its surgeons; count those rated."""
    count = 0
    for seed in seeds:
        drawn = cohort(tasks=2)
        order = validation.shuffled(drawn, np.random.default_rng([seed, 2]))
        dealt = replace(drawn, ratings=drawn.ratings[order], levels=drawn.levels[order])
        found = validation.validate(dealt, seed=seed, permutations=validation.LEAST_PERMUTATIONS)[1]
        count += any(not validation.refusals(task) for task in found.tasks.values())
    print(f"{count} of {len(seeds)} shuffles rated")
    return count


def test_shuffled_ratings_are_refused() -> None:
    """One of 200 shuffles; the nightly test has all of them."""
    assert dealt_and_rated(range(1)) == 0


@pytest.mark.nightly
def test_shuffled_ratings_are_refused_in_19_of_20() -> None:
    assert dealt_and_rated(range(200)) <= 10


@pytest.mark.nightly  # by day a smaller cohort
def test_a_plain_signal_in_a_cohort_of_the_stated_size_is_rated() -> None:
    surgeons, trials = validation.ENOUGH
    assert accepted("plain", range(1), surgeons=surgeons, trials=trials) == 1


@pytest.mark.nightly
def test_of_fifty_cohorts_of_the_stated_size_nine_tenths_are_rated() -> None:
    surgeons, trials = validation.ENOUGH
    assert accepted("plain", range(50), surgeons=surgeons, trials=trials) >= 45


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "field", "wrong", "said"),
    [
        ("model", "rho_interval", [-0.1, 0.9], "may be no better than by chance"),
        ("model", "rho_interval", [math.nan, math.nan], "may be no better than by chance"),
        ("chance", "rho", 0.95, "may be no better than by chance"),
        ("chance", "rho", math.nan, "may be no better than by chance"),
        ("chance", "rho_p", 0.026, "A random order does as well"),
        ("chance", "rho_p", math.nan, "A random order does as well"),
        ("chance", "accuracy_p", 0.2, "right as often"),
        ("chance", "accuracy_p", math.nan, "right as often"),
        ("model", "accuracy", 0.0, "in 0 % of the trials"),
        ("model", "accuracy", math.nan, "in nan % of the trials"),
        (None, "over_duration", [0.0, 0.4], "no better than the duration alone"),
        (None, "over_duration", [math.nan, 0.4], "no better than the duration alone"),
    ],
)
def test_each_comparison_can_refuse_and_nan_does(
    part: str | None, field: str, wrong: Any, said: str, judged: validation.TaskValidation
) -> None:
    changed: dict[str, Any] = {field: wrong}
    if part is not None:
        changed = {part: replace(getattr(judged, part), **changed)}
    spoilt = replace(judged, surgeons=100, **changed)
    of_levels = "accuracy" in field
    assert (validation.refusals(spoilt) == []) == of_levels
    why = validation.level_refusals(spoilt) if of_levels else validation.refusals(spoilt)
    assert len(why) == 1 and said in why[0]


def test_a_model_without_any_figure_is_refused_with_sentences() -> None:
    none = validation.Judged(math.nan, (math.nan, math.nan))
    nothing = replace(of_p(0, 39), surgeons=0, model=none, rivals=dict.fromkeys(validation.RIVALS, none))
    nothing = replace(nothing, chance=validation.Chance(39, math.nan, math.nan), over_duration=none.rho_interval)
    why = validation.refusals(nothing)
    assert len(why) == 4 and "about 40 with 5 trials each are needed" in why[3]
    assert len(validation.level_refusals(nothing)) == 2


def of_p(as_good: int, permutations: int) -> validation.TaskValidation:
    """Return the figures of an excellent model, with p from the permutations that do as well."""
    p = (1 + as_good) / (1 + permutations)
    excellent, poor = (
        validation.Judged(0.9, (0.8, 0.95), accuracy=0.9),
        validation.Judged(0.1, (0.0, 0.2), accuracy=0.3),
    )
    return validation.TaskValidation(
        trials=200,
        surgeons=40,
        model=excellent,
        repetition_out=excellent,
        rivals=dict.fromkeys(validation.RIVALS, poor),
        parts={},
        chance=validation.Chance(permutations, 0.0, rho_p=p, accuracy_p=p, commonest=0.4),
        over_duration=(0.5, 0.8),
    )


@pytest.mark.parametrize(
    ("as_good", "permutations", "said"),
    [
        (1, 40, "p = 0.049; at most 0.025 is accepted; it may be 0.004 to 0.129, because 40 permutations are few"),
        (6, 200, "p = 0.035; at most 0.025 is accepted; it may be 0.014 to 0.064, because 200 permutations are few"),
    ],
)
def test_a_refusal_that_few_permutations_may_have_made_says_so(as_good: int, permutations: int, said: str) -> None:
    (order,), (levels,) = (
        validation.refusals(of_p(as_good, permutations)),
        validation.level_refusals(of_p(as_good, permutations)),
    )
    assert order == f"A random order does as well ({said}: calibrate again with more)."
    assert levels == f"Random levels are right as often ({said}: calibrate again with more)."


def test_a_refusal_that_more_permutations_would_confirm_asks_for_none() -> None:
    for as_good, permutations in ((10, 20), (20, 200), (600, 10_000)):
        (one,), (other,) = (of(of_p(as_good, permutations)) for of in (validation.refusals, validation.level_refusals))
        assert "with more" not in one + other
    assert validation.refusals(of_p(0, 39)) == validation.level_refusals(of_p(0, 39)) == []


@pytest.mark.parametrize("permutations", [0, 1, 38])
def test_permutations_that_could_accept_no_model_are_refused(permutations: int) -> None:
    with pytest.raises(BadInput, match=rf"{permutations} permutations .* at least 39"):
        validation.validate(cohort(), permutations=permutations)
    assert 1 / (1 + validation.LEAST_PERMUTATIONS) <= validation.ACCEPTED_P < 1 / validation.LEAST_PERMUTATIONS


def test_predictions_are_of_the_validation_too() -> None:
    drawn = cohort(surgeons=5)
    found, judged = validation.validate(drawn, permutations=39)
    np.testing.assert_array_equal(found.scores, held_out(drawn).scores)
    rho = rank_correlations(found.scores[:, 0].T, drawn.ratings[:, 0])[0]
    assert judged.tasks["Task_A"].model.rho == pytest.approx(rho)
