"""The model as plain numbers: predictions by hand, and its report on motions outside of its data."""

import json

import numpy as np
import pytest

from skills.errors import BadInput
from skills.scoring.calibration import Skill, SkillModel, as_numbers, from_numbers, rate
from skills.scoring.features import KINDS, MODELLED, Numbers, compare, measure
from tests.comparison.cohort import demo_of

TWO = ("duration_s", "path_length_mm")
ABOUT = {
    "data": {"task": "Suturing", "of": "hand-off", "trials": 40, "surgeons": 8},
    "validated": {
        "all_figures": {"rho": 0.9, "rho_interval": [0.8, 0.95], "accuracy": 0.75},
        "duration_only": {"rho": 0.5},
        "chance": {"rho": -0.2, "accuracy": 0.2},
    },
}


def model(**changed: object) -> SkillModel:
    """Return a model of two figures: ten seconds and 100 mm have 18 points; two seconds more cost 3, 10 mm more 1."""
    numbers: dict[str, object] = {
        "figures": TWO,
        "centre": [10.0, 100.0],
        "scale": [2.0, 10.0],
        "lowest": [4.0, 60.0],
        "highest": [20.0, 200.0],
        "rating": 18.0,
        "rating_weights": [-3.0, -1.0],
        "rating_margin": 2.5,
        "levels": ("novice", "expert"),
        "level_offsets": [0.0, 0.0],
        "level_weights": [[0.0, 0.0], [-np.log(3.0), 0.0]],
    }
    return SkillModel(**(numbers | changed))


def test_levels_that_are_refused_are_not_given_and_the_rating_is() -> None:
    numbers = {"duration_s": 12.0, "path_length_mm": 120.0}
    found = rate(model(), numbers, "0" * 64, ABOUT, ["Random levels are right as often."])
    assert found.rating == rated(model(), numbers).rating
    assert found.levels is None
    said = " ".join(found.words)
    assert "no skill level. Random levels are right as often." in said and "predicts" not in said


def rated(by: SkillModel, numbers: Numbers) -> Skill:
    return rate(by, numbers, "0" * 64, ABOUT)


def test_a_rating_is_the_sum_of_its_terms() -> None:
    found = rated(model(), {"duration_s": 12.0, "path_length_mm": 120.0})
    assert found.calibrated
    assert found.rating == pytest.approx(18.0 - 3.0 - 2.0)
    assert found.terms == pytest.approx({"duration_s": -3.0, "path_length_mm": -2.0})
    assert found.interval == pytest.approx((10.5, 15.5))
    assert found.levels == pytest.approx({"novice": 0.75, "expert": 0.25})  # odds of 1 to 3, one deviation away
    assert found.outside == ()


def test_what_lies_outside_is_said_in_words_and_the_rating_stays_one() -> None:
    found = rated(model(), {"duration_s": 200.0, "path_length_mm": 50.0})
    assert found.calibrated
    assert found.rating == 6.0
    assert found.interval == (6.0, 8.5)
    assert found.outside == (
        "Duration is 200 s; the calibration data has 4 to 20 s.",
        "Path length is 50 mm; the calibration data has 60 to 200 mm.",
    )


def test_nan_is_outside() -> None:
    found = rated(model(), {"duration_s": float("nan"), "path_length_mm": 100.0})
    assert found.calibrated
    assert len(found.outside) == 1


def test_without_a_figure_there_is_no_prediction() -> None:
    found = rated(model(), {"duration_s": 12.0, "path_length_mm": None})
    why = "Not rated: the calibrated model needs figures that were not recorded (Path length)."
    assert found == Skill(calibrated=False, calibration=None, words=(why,))


def test_every_bit_of_it_survives_as_numbers() -> None:
    one = model(centre=np.random.default_rng(1).normal(size=2))
    again = from_numbers(json.loads(json.dumps(as_numbers(one))))
    assert as_numbers(again) == as_numbers(one)
    numbers = {"duration_s": 7.7, "path_length_mm": 123.4}
    assert rated(again, numbers) == rated(one, numbers)


@pytest.mark.parametrize("wrong", [{"centre": [1.0]}, {"rating_weights": [np.nan, 1.0]}, {"level_offsets": [0.0] * 3}])
def test_numbers_that_are_no_model_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(BadInput):
        model(**wrong)


def test_figures_stand_beside_the_references() -> None:
    humps = np.zeros((3, 2))
    slow, quick = (measure(demo_of(humps, 0.0, np.zeros(3), lasts)) for lasts in (4.0, 2.0))
    found = {figure.name: figure for figure in compare(slow, quick)}
    assert found["duration_s"].ratio == pytest.approx(2.0, rel=0.01)
    assert found["path_length_mm"].ratio == pytest.approx(1.0, rel=0.01)
    assert found["size_mm"].value == pytest.approx(np.linalg.norm([40, 5, 10]))
    assert found["clutch_presses"].ratio is None  # the reference has none
    assert found["orientation_change_rad"].ratio is None  # not recorded
    assert {kind.name for kind in KINDS} >= set(MODELLED)
