"""The rating of a trial: a sum by hand, its interval, its terms and thirds, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from skills.errors import BadInput
from skills.scoring.calibration import PARTS, SkillModel
from skills.scoring.features import TRIAL_KIND_OF, TRIAL_KINDS, TRIAL_NAMES, TrialFigures
from skills.scoring.rating import Skill, rate
from skills.scoring.validation import RIVALS, Chance, Judged, TaskValidation

F = len(TRIAL_NAMES)
PATH, IDLE = TRIAL_NAMES.index("path_length_mm"), TRIAL_NAMES.index("idle_share")
HALF = Judged(0.5, (0.1, 0.9), accuracy=0.5)
JUDGED = TaskValidation(
    trials=40,
    surgeons=8,
    model=Judged(0.9, (0.8, 0.95), accuracy=0.75),
    repetition_out=HALF,
    rivals=dict.fromkeys(RIVALS, HALF),
    parts=dict.fromkeys(PARTS, HALF) | {PARTS[0]: Judged(0.5, (-0.1, 0.9))},
    chance=Chance(200, -0.2, rho_p=0.01, accuracy=0.2, accuracy_p=0.01, commonest=0.4),
    over_duration=(0.1, 0.6),
)


def model(**changed: object) -> SkillModel:
    """Return a model of one task: 1 m of path and a fifth of idle time have 18 points.

    Twice the path costs 3 points, and a tenth more of idle time 2; the model's other figures weigh nothing.
    """
    weights = np.zeros((1, 7, F))
    weights[0, 0, PATH], weights[0, 0, IDLE] = -3.0, -2.0
    weights[0, 2, IDLE] = -0.5
    centre, scale = np.zeros((1, F)), np.ones((1, F))
    centre[0, PATH], centre[0, IDLE] = np.log(1000.0), 0.2
    scale[0, PATH], scale[0, IDLE] = np.log(2.0), 0.1
    numbers: dict[str, object] = {
        "tasks": ("Knot_Tying",),
        "figures": TRIAL_NAMES,
        "masters": False,
        "together": True,
        "strength": 10.0,
        "centre": centre,
        "scale": scale,
        "lowest": np.where(np.arange(F) == PATH, np.log(500.0), -1e9)[None],
        "highest": np.where(np.arange(F) == PATH, np.log(3000.0), 1e9)[None],
        "thirds_centre": np.repeat(centre[:, None], 3, axis=1),
        "thirds_scale": np.repeat(scale[:, None], 3, axis=1),
        "means": [[18.0, *[3.0] * 6]],
        "weights": weights,
        "margins": [2.5],
        "level_ratings": [[9.0, 0.0, 20.0]],
        "level_shares": [[[0.8, 0.1, 0.1], [0.2, 0.6, 0.2], [0.1, 0.2, 0.7]]],
    }
    return SkillModel(**(numbers | changed))  # type: ignore[arg-type]


def trial(path_mm: float, idle: float, *, sides: int = 1, last_idle: float | None = None) -> TrialFigures:
    values = np.zeros((sides, F))
    values[:, PATH], values[:, IDLE] = np.log(path_mm), idle
    thirds = np.repeat(values[:, None], 3, axis=1)
    thirds[:, 2, IDLE] = idle if last_idle is None else last_idle
    return TrialFigures(values, thirds)


def rated(found: TrialFigures, by: SkillModel | None = None, judged: TaskValidation = JUDGED) -> Skill:
    return rate(by or model(), "Knot_Tying", found, "0" * 64, judged)


def test_a_rating_is_the_sum_of_its_terms() -> None:
    found = rated(trial(2000.0, 0.3))
    assert found.calibrated and found.task == "Knot_Tying"
    assert found.rating == pytest.approx(18.0 - 3.0 - 2.0)
    assert [(term.name, term.points) for term in found.terms[:2]] == [
        ("path_length_mm", pytest.approx(-3.0)),
        ("idle_share", pytest.approx(-2.0)),
    ]
    assert found.rating == pytest.approx(18.0 + sum(term.points for term in found.terms))
    assert (found.terms[0].value, found.terms[0].typical) == (pytest.approx(2000.0), pytest.approx(1000.0))
    assert found.interval == pytest.approx((10.5, 15.5))
    assert found.parts == {part: pytest.approx(2.5 if part == PARTS[1] else 3.0) for part in PARTS[1:]}
    assert found.levels == {"novice": 0.8, "intermediate": 0.1, "expert": 0.1}  # 13 is nearest to 9, and not to 0 or 20
    assert found.outside == ()
    said = " ".join(found.words)
    assert "40 rated trials of Knot_Tying by 8 surgeons" in said
    assert "0.90 (0.80 to 0.95; shorter trials first: 0.50, chance: -0.20)" in said
    assert "moves most by: Path length -3.0, Idle -2.0" in said
    assert "level novice: of the trials that it rated so without their surgeon, 80 %" in said


def test_the_third_that_differs_is_named() -> None:
    found = rated(trial(1000.0, 0.2, last_idle=0.5))
    idle = next(term for term in found.terms if term.name == "idle_share")
    assert idle.points == pytest.approx(0.0)
    assert idle.thirds == (pytest.approx(0.0), pytest.approx(0.0), pytest.approx(-6.0))
    assert "first +0.0, middle +0.0, last -6.0 points. The lowest is the last third, there most by Idle (-6.0)" in (
        found.words[3].replace("-0.0", "+0.0")
    )


def test_what_lies_outside_is_said_in_words_and_the_rating_stays_one() -> None:
    found = rated(trial(64_000.0, 0.2))
    assert found.rating == 6.0
    assert found.interval == (6.0, 8.5)
    assert found.outside == ("Path length is 6.4e+04 mm; the calibration data has 500 to 3e+03 mm.",)
    assert "do not rely on this rating" in found.words[-1]


def test_levels_that_are_refused_are_not_given_and_the_rating_is() -> None:
    judged = replace(JUDGED, chance=replace(JUDGED.chance, accuracy_p=0.5))
    found = rated(trial(1000.0, 0.2), judged=judged)
    assert found.rating == pytest.approx(18.0) and found.levels is None
    assert "It gives no skill level. Random levels are right as often" in " ".join(found.words)


def test_a_model_of_masters_needs_them_and_takes_the_mean() -> None:
    by = model(masters=True)
    with pytest.raises(BadInput, match="needs both masters"):
        rated(trial(1000.0, 0.2), by)
    both = trial(1000.0, 0.2, sides=2)
    values = both.values.copy()
    values[1, IDLE] = 0.4
    assert rated(TrialFigures(values, both.thirds), by).rating == pytest.approx(16.0)
    assert rated(TrialFigures(values, both.thirds)).rating == pytest.approx(18.0)


def test_a_trial_with_nan_is_no_trial() -> None:
    with pytest.raises(BadInput, match="NaN"):
        trial(float("nan"), 0.2)


def test_every_figure_can_be_read_in_its_unit() -> None:
    for kind in TRIAL_KINDS:
        assert kind.readable(kind.modelled(3.5)) == pytest.approx(3.5), kind.name
    assert len({kind.name for kind in TRIAL_KINDS}) == len(TRIAL_KINDS) == len(TRIAL_KIND_OF)
