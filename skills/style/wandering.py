"""What became of a policy of the continuous space where it is at home: followed from many starts, without a grid.

The certificate asks the policy as it is on the grid, cell by cell; this asks the network itself, step by step, from
positions drawn anywhere in the box, until it is in the goal's cell or the paper's 100 steps are over.
"""

from dataclasses import dataclass

import numpy as np

from skills.style import paper
from skills.style._arrays import Floats
from skills.style.evaluation import dtw
from skills.style.learning.beyond import DDPG, TRPO, InSpace, asked_step
from skills.style.network import Network
from skills.style.policy import Policy
from skills.style.space import Space

STARTS = 1000  # ours: the share that arrives is known to 3 of 100 then, with 95 % confidence at the worst


@dataclass(frozen=True)
class Rollouts:
    """So many starts drawn by a seed, how many of them reached the goal, and how far their ways were from the
    demonstration: total DTW in mm, the mean over all starts, and from the demonstrated start alone.
    """

    starts: int
    reached: int
    seed: int
    dtw_total_mm: float
    demonstrated_start_reached: bool
    demonstrated_start_dtw_mm: float


def check_in_space(policy: Policy, starts: int = STARTS, seed: int = 0) -> Rollouts | None:
    """Follow a policy from the demonstrated start and from others in its space; None for one that was learnt on a grid.

    The policy is followed as it is, without noise; the seed draws the starts, uniformly.
    """
    learner, network, path = policy.learner, policy.network, policy.path
    if network is None or not isinstance(learner, DDPG | TRPO):
        return None
    space = Space(path, policy.levels)
    drawn = np.random.Generator(np.random.PCG64(seed)).uniform(space.low_mm, space.high_mm, (starts, 3))
    ways = follow_in_space(learner, network, space, np.concatenate((path.tip_mm[:1], drawn)))
    reached = [bool(space.arrived(way[-1])) for way in ways]
    apart_mm = [dtw(way, path.tip_mm).total_mm for way in ways]
    return Rollouts(
        starts=starts,
        reached=sum(reached[1:]),
        seed=seed,
        dtw_total_mm=float(np.mean(apart_mm[1:])),
        demonstrated_start_reached=reached[0],
        demonstrated_start_dtw_mm=apart_mm[0],
    )


def follow_in_space(learner: InSpace, network: Network, space: Space, starts_mm: Floats) -> list[Floats]:
    """Follow a network from starts, (N, 3) mm, until each is in the goal's cell or out of steps: N ways, (T, 3) mm."""
    at_mm = np.asarray(starts_mm, float)
    going = ~space.arrived(at_mm)
    visited, lengths = [at_mm], np.ones(len(at_mm), np.int64)
    for _ in range(paper.MAX_STEPS):
        moved_mm = space.moved(at_mm, asked_step(learner, network, space, at_mm))
        at_mm = np.where(going[:, None], moved_mm, at_mm)
        visited.append(at_mm)
        lengths += going
        going &= ~space.arrived(at_mm)
    ways = np.stack(visited, axis=1)
    return [way[:length] for way, length in zip(ways, lengths, strict=True)]
