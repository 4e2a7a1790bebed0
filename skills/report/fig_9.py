"""Fig. 9: one policy from ten other starts, in the range that the paper prints."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from skills.report import dmp, published
from skills.report.fig_8 import PRIMITIVE, REPLAY
from skills.report.sources import Source
from skills.style import paper
from skills.style.evaluation import measure
from skills.style.policy import Policy, Rollout, rollout, rollout_from
from skills.style.rivals import replay

N_STARTS = 10
IN_TURN = 7  # every seventh of the range's 30 grid points, round and round: ten that spread over all three axes


@dataclass(frozen=True, eq=False)
class OtherStart:
    """The way from another start, and the ways of the published policies and of the rivals from there.

    `joins_at` is the number of the demonstration's state, counted from 0, from which on ours follows it.
    """

    start_mm: tuple[float, float, float]
    ours: Rollout
    joins_at: int
    dtw_total_mm: float
    published: tuple[Rollout, ...]
    replayed: Rollout
    primitive: Rollout


@dataclass(frozen=True)
class Arriving:
    """From how many of the grid points in the printed range a policy reaches the goal."""

    by: str
    starts: int
    arriving: int


def range_mm() -> list[tuple[float, float, float]]:
    """List the grid points of the printed range."""
    axes = [np.arange(min(ends), max(ends) + 1, paper.CELL_MM).tolist() for ends in paper.FIG9_START_RANGE_MM]
    return list(product(*axes))


def starts_mm() -> list[tuple[float, float, float]]:
    """Choose ten of them; the paper does not list its own."""
    points = range_mm()
    return [points[IN_TURN * number % len(points)] for number in range(N_STARTS)]


def other_starts(source: Source, policy: Policy, primitive: dmp.Primitive) -> tuple[OtherStart, ...]:
    """Follow a policy, the published ones and the rivals from each of the ten starts."""
    return tuple(_from(start_mm, source, policy, primitive) for start_mm in starts_mm())


def arriving(source: Source, policy: Policy, primitive: dmp.Primitive) -> tuple[Arriving, ...]:
    """Count for the published policies, ours and the rivals over the whole range."""
    starts = source.path.grid.states_at(range_mm())
    states = starts.tolist()
    theirs = [[published.follow(actions, source.path, state) for state in states] for actions in source.published]
    ours = [rollout_from(policy, state) for state in states]
    named = [
        *((f"published policy {number}", ways) for number, ways in enumerate(theirs, 1)),
        ("ours, seed 0", ours),
        (REPLAY, [replay(source.path, state) for state in states]),
        (PRIMITIVE, dmp.rollouts(primitive, starts)),
    ]
    return tuple(Arriving(by, len(ways), sum(way.finished for way in ways)) for by, ways in named)


def _from(start_mm: tuple[float, float, float], source: Source, policy: Policy, primitive: dmp.Primitive) -> OtherStart:
    ours, state = rollout(policy, start_mm), int(source.path.grid.states_at(start_mm))
    return OtherStart(
        start_mm,
        ours,
        _joins_at(ours),
        measure(ours).dtw_total_mm,
        tuple(published.follow(actions, source.path, state) for actions in source.published),
        replay(source.path, state),
        dmp.rollouts(primitive, np.array([state]))[0],
    )


def _joins_at(followed: Rollout) -> int:
    """Find the waypoint where the phase stops being 0; a way to the goal alone joins at the last one."""
    joined = followed.phases[followed.phases > 0]
    return int(joined[0]) - 1 if len(joined) else len(followed.path.states) - 1
