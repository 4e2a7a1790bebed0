"""Slip: the grid world's disturbance, by which another move is made than the intended one; ours.

    probability --slip_model--> SlipModel

With the probability `slip` a move slips: then one of the 27 moves, each as likely, is made instead of the intended one.
It may be the intended one; off the grid the arm stays. This is the only place that says so: learning, exact values,
odds and runs take a `SlipModel`, and follow from its numbers. Another model is another function beside `slip_model`,
and a setting in `skills.learning.learner_state` that selects it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from skills.arithmetic import product
from skills.arrays import Bytes, Floats, freeze
from skills.errors import BadSettings
from skills.gridworld.grid import MOVES

STEADY = -1  # in place of a slip: the intended move is made


@dataclass(frozen=True, eq=False)
class SlipModel:
    """The moves that are made in place of an intended one.

    Attributes:
        probability: That a move slips, 0 to 1.
        drawn: Probability of each of the 27 moves if it does, whatever was intended, shape (27,).
    """

    probability: float
    drawn: Floats

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise BadSettings("A slip must be a probability, from 0 to 1.", slip=self.probability)
        freeze(self, drawn=(len(MOVES),))
        if not ((self.drawn >= 0).all() and abs(self.drawn.sum() - 1) < 1e-9):
            raise BadSettings("The probabilities of the drawn moves must be 0 or more, with the sum 1.")

    @property
    def intended(self) -> float:
        """The probability that a move does not slip."""
        return 1 - self.probability

    @cached_property
    def cumulated(self) -> Floats:
        """The probability that a slip is one of the moves up to each, (27,), from which one is drawn."""
        return np.cumsum(self.drawn)

    def expected(self, intended: Floats, slipped: Floats) -> Floats:
        """Return the expected value of intended moves, shape (..., N).

        Args:
            intended: The value of each of them if it does not slip, shape (..., N).
            slipped: The value of each of the 27 moves if it is made by a slip, shape (27, N).
        """
        return self.intended * intended + self.probability * product(self.drawn, slipped)

    def log_expected(self, intended: Floats, slipped: Floats) -> Floats:
        """Return the logarithm of `expected` of values whose logarithms are given."""
        anywhere = np.logaddexp.reduce(np.log(self.drawn)[:, None] + slipped)
        logs = np.logaddexp(np.log1p(-self.probability) + intended, np.log(self.probability) + anywhere)
        return np.asarray(logs)

    def draw(self, *, runs: int, moves: int, seed: int) -> Bytes:
        """Draw the slips of all moves of all runs.

        The same arguments give the same bytes. With the same seed, a larger probability adds slips to those of a
        smaller one, so all controllers can be given the same disturbances.

        Args:
            runs: Number of runs.
            moves: Number of moves of each run.
            seed: The seed, 0 or more.

        Returns:
            The action that replaces the intended one, or `STEADY`, shape (moves, runs).

        Raises:
            BadSettings: There are no runs or moves, or the seed is negative.
        """
        if runs < 1 or moves < 1 or seed < 0:
            raise BadSettings(
                "Slips need at least one run and one move, and a seed of 0 or more.", runs=runs, moves=moves
            )
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        # Both are drawn for every move, so that the probability decides only which moves slip.
        chance, drawn = rng.random((moves, runs)), rng.choice(len(MOVES), (moves, runs), p=self.drawn)
        return np.where(chance < self.probability, drawn, STEADY).astype(np.int8)


def slip_model(probability: float) -> SlipModel:
    """Return the model in which each of the 27 moves is as likely if a move slips.

    Args:
        probability: That a move slips.

    Raises:
        BadSettings: It is not a probability.
    """
    return SlipModel(probability, np.full(len(MOVES), 1 / len(MOVES)))


def slip_of_elsewhere(elsewhere: float) -> float:
    """Return the probability of a slip by the share of moves that end in another cell than the intended one.

    Args:
        elsewhere: The share, 0 to 1; above 26/27 the result is above 1.
    """
    return elsewhere * len(MOVES) / (len(MOVES) - 1)
