"""A model of skill that a person can read: a rating and a level as sums of a few figures, each with its weight.

    rating    = mean + sum of weight * (figure - its mean) / its standard deviation
    p(level)  ~ exp(the same sum with weights of its own)

So a weight says by how many points the rating changes when a figure changes by one standard deviation of those that the
model was calibrated on. What lies outside of what it was calibrated on is said, for there a sum means nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from skills.style._arrays import Floats, frozen
from skills.style.scoring.figures import KIND_OF, Numbers, modelled

Level = Literal["novice", "intermediate", "expert"]
LEVELS: tuple[Level, ...] = get_args(Level)
LEAST_RATING, MOST_RATING = 6.0, 30.0  # of the global rating score: six parts of one to five points


@dataclass(frozen=True, eq=False)
class SkillModel:
    """What was fitted; F figures and L levels.

    Attributes:
        figures: The names of the figures.
        centre: Their means, shape (F,).
        scale: Their standard deviations, 1 where a figure never varied, shape (F,).
        lowest: The smallest value of each that was seen, shape (F,).
        highest: The greatest, shape (F,).
        rating: The rating at the means.
        rating_weights: Points per standard deviation, shape (F,).
        rating_margin: Of surgeons that it had not seen, 90 % of the ratings were as near as this.
        levels: The levels that were seen.
        level_offsets: Log odds at the means, shape (L,).
        level_weights: Log odds per standard deviation, shape (L, F).
    """

    figures: tuple[str, ...]
    centre: Floats
    scale: Floats
    lowest: Floats
    highest: Floats
    rating: float
    rating_weights: Floats
    rating_margin: float
    levels: tuple[Level, ...]
    level_offsets: Floats
    level_weights: Floats

    def __post_init__(self) -> None:
        count, levels = len(self.figures), len(self.levels)
        shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("centre", "scale", "lowest", "highest", "rating_weights"), (count,)),
            "level_offsets": (levels,),
            "level_weights": (levels, count),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))

    def ratings(self, values: Floats) -> Floats:
        """Predict the ratings of motions, (N, F) to (N,), within what a rating can be."""
        sums = self.rating + self._standard(values) @ self.rating_weights
        return np.asarray(sums.clip(LEAST_RATING, MOST_RATING))

    def probabilities(self, values: Floats) -> Floats:
        """Predict how likely each level is, (N, F) to (N, L)."""
        odds = self.level_offsets + self._standard(values) @ self.level_weights.T
        likely = np.exp(odds - odds.max(axis=1, keepdims=True))
        return np.asarray(likely / likely.sum(axis=1, keepdims=True))

    def _standard(self, values: Floats) -> Floats:
        return np.asarray((values - self.centre) / self.scale)


@dataclass(frozen=True)
class Predicted:
    """What a model says of one motion.

    Attributes:
        rating: The global rating score, 6 to 30.
        interval: Where it is with 90 %, as far as the motion is like those of the calibration.
        levels: How likely each level is.
        terms: By how many points each figure moved the rating away from the mean's.
        outside: What lies outside of what the model has seen, in words; empty where nothing does.
    """

    rating: float
    interval: tuple[float, float]
    levels: Mapping[str, float]
    terms: Mapping[str, float]
    outside: tuple[str, ...]


def predict(model: SkillModel, numbers: Numbers) -> Predicted | None:
    """Predict rating and level of a motion from its figures; None where one was not recorded."""
    values = modelled(numbers, model.figures)
    if values is None:
        return None
    rating = float(model.ratings(values[None])[0])
    low, high = np.clip([rating - model.rating_margin, rating + model.rating_margin], LEAST_RATING, MOST_RATING)
    terms = (values - model.centre) / model.scale * model.rating_weights
    return Predicted(
        rating=rating,
        interval=(float(low), float(high)),
        levels=dict(zip(model.levels, model.probabilities(values[None])[0].tolist(), strict=True)),
        terms=dict(zip(model.figures, terms.tolist(), strict=True)),
        outside=tuple(_outside(model, values)),
    )


def _outside(model: SkillModel, values: Floats) -> Sequence[str]:
    said = []
    for name, value, low, high in zip(model.figures, values, model.lowest, model.highest, strict=True):
        if not low <= value <= high:
            kind = KIND_OF[name]
            unit = f" {kind.unit}" if kind.unit else ""
            said.append(f"{kind.label} is {value:.3g}{unit}; the calibration saw {low:.3g} to {high:.3g}{unit}.")
    return said


def as_numbers(model: SkillModel) -> dict[str, Any]:
    """Write a model as plain numbers, for JSON; every bit of them is kept."""
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(model).items()}


def from_numbers(numbers: Mapping[str, Any]) -> SkillModel:
    """Read a model back.

    Raises:
        BadInput: The numbers are none of a model.
    """
    named = {name: tuple(numbers[name]) for name in ("figures", "levels")}
    return SkillModel(**{**numbers, **named})
