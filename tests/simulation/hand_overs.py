"""Hand-overs as the closed form predicts them, beside the contact referee's: `python -m tests.simulation.hand_overs`.

The plans below `TESTED` were used for the fit of `clearance.GRASPS`, those from there on never.
"""

import sys
from typing import NamedTuple

import numpy as np

from skills.simulation.referee import referee
from skills.verification.clearance import GRASPS
from skills.verification.monte_carlo import estimate_success
from tests.verification.test_monte_carlo import some_plan

FITTED, TESTED = 10_000, 20_000  # the seeds of the first plans
WORLDS = 24
BINS = 10
RESAMPLED = 10_000


class Compared(NamedTuple):
    """The probability of an event in each plan, and in what part of the referee's worlds it came, (N,)."""

    said: np.ndarray
    seen: np.ndarray

    def bins(self) -> list[tuple[int, float, float]]:
        """Return the plans of each of ten bins of equal count, by what was said: count, and the means of both."""
        parts = np.array_split(np.argsort(self.said, kind="stable"), BINS)
        return [(len(part), float(self.said[part].mean()), float(self.seen[part].mean())) for part in parts]

    def calibration_error(self) -> float:
        """Return the expected calibration error: the mean distance of both, weighted by the plans of each bin."""
        return sum(count * abs(said - seen) for count, said, seen in self.bins()) / len(self.said)

    def brier_gain(self) -> tuple[float, float]:
        """Return the 95 % interval, by resampling plans, of how much less the Brier score is than a constant's."""

        def score(said: np.ndarray | float) -> np.ndarray:
            return said**2 * (1 - self.seen) + (1 - said) ** 2 * self.seen

        gain, rng = score(self.seen.mean()) - score(self.said), np.random.default_rng(0)
        means = gain[rng.integers(0, len(gain), (RESAMPLED, len(gain)))].mean(axis=1)
        low, high = np.percentile(means, [2.5, 97.5])
        return float(low), float(high)


def compare(first: int, plans: int) -> dict[str, Compared]:
    """Return what is said and seen of the events of `GRASPS` in plans of one pass."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in GRASPS}
    for seed in range(first, first + plans):
        trajectory, errors, _ = some_plan(seed)
        under = estimate_success(trajectory, approach_m=None, pad_top_mm=None, errors=errors, seed=seed + 1).under[0]
        seen = referee(trajectory, errors=errors, trials=WORLDS, seed=seed)
        for name, one in found.items():
            one.append((getattr(under, name).probability, getattr(seen, name).probability))
    return {name: Compared(*np.array(one).T) for name, one in found.items()}


if __name__ == "__main__":
    for event, one in compare(TESTED, int(sys.argv[1])).items():
        print(f"{event}: calibration error {one.calibration_error():.3f}, Brier score less by {one.brier_gain()}")
        for count, said, seen in one.bins():
            print(f"| {count} | {said:.3f} | {seen:.3f} |")
