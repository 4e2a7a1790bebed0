"""Fig. 8: three policies of one demonstration, in the paper's state, in ours, and those that the authors published.

Beside them two rivals that learn no policy: the demonstration replayed, and a dynamic movement primitive.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from skills.report import dmp, published
from skills.report.sources import Source
from skills.style import paper
from skills.style._arrays import Ints
from skills.style.certificate import coverage
from skills.style.evaluation import dtw, measure
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning
from skills.style.policy import Policy, Rollout, learn_policy, rollout_from
from skills.style.reward import RewardMap, sparse_reward
from skills.style.rivals import replay

SEEDS = tuple(range(paper.N_POLICIES))
PUBLISHED, CELL, PHASE = "published by the authors", "the paper's state: cell", "ours: phase and cell"
REPLAY, PRIMITIVE = "rival: shortest way, then replay", "rival: dynamic movement primitive"
PUBLISHED_PARAMETERS = "the paper's state, the authors' parameters"


@dataclass(frozen=True, eq=False)
class Learnt:
    """A policy's or a rival's way from the demonstrated start, DTW's pairs with the demonstration (K, 2), and how many
    starts reach the goal.
    """

    by: str
    which: str
    rollout: Rollout
    pairs: Ints
    dtw_total_mm: float
    exact_states: int
    starts_reaching: int


@dataclass(frozen=True)
class Tried:
    """On how many seeds a learner reaches the goal from the demonstrated start, and gives the demonstration back."""

    by: str
    seeds: int
    reached: int
    exact: int


def three_policies(source: Source) -> tuple[Learnt, ...]:
    """Follow the published policies where there are any, and those that seeds 0, 1 and 2 learn in either state."""
    start = source.path.start
    theirs = [
        _learnt(
            PUBLISHED,
            f"policy {number}",
            published.follow(actions, source.path, start),
            published.starts_reaching(actions, source.path),
        )
        for number, actions in enumerate(source.published, start=1)
    ]
    cell, phase = learn_three(source, CellQLearning()), learn_three(source, PhaseQLearning())
    learnt = [
        _learnt(by, f"seed {policy.seed}", rollout_from(policy, start), int(coverage(policy).reaches.sum()))
        for by, policies in ((CELL, cell), (PHASE, phase))
        for policy in policies
    ]
    return (*theirs, *learnt)


def two_rivals(source: Source, primitive: dmp.Primitive) -> tuple[Learnt, ...]:
    """Follow the two rivals, undisturbed: nothing of them is drawn at random."""
    path, everywhere = source.path, np.arange(source.path.grid.n_states)
    replays = [replay(path, state) for state in everywhere.tolist()]
    passes = dmp.rollouts(primitive, everywhere)
    basis = f"{primitive.weights.shape[1]} basis functions"
    return tuple(
        _learnt(by, which, ways[path.start], sum(way.finished for way in ways))
        for by, which, ways in ((REPLAY, "as recorded", replays), (PRIMITIVE, basis, passes))
    )


def learn_three(source: Source, learner: CellQLearning | PhaseQLearning) -> list[Policy]:
    """Learn the policies of seeds 0, 1 and 2."""
    return [learn_policy(sparse_reward(source.path), learner, seed) for seed in SEEDS]


def _learnt(by: str, which: str, followed: Rollout, starts_reaching: int) -> Learnt:
    metrics = measure(followed)
    pairs = dtw(followed.tip_mm, followed.path.tip_mm).pairs
    return Learnt(by, which, followed, pairs, metrics.dtw_total_mm, metrics.exact_states, starts_reaching)


def try_seeds(source: Source, seeds: int) -> tuple[Tried, ...]:
    """Learn with the seeds from 0 on, on all processors: what the paper's three policies cannot tell."""
    learners: dict[str, CellQLearning | PhaseQLearning] = {
        PUBLISHED_PARAMETERS: CellQLearning.published(),
        CELL: CellQLearning(),
        PHASE: PhaseQLearning(),
    }
    reward = sparse_reward(source.path)
    with ThreadPoolExecutor(os.cpu_count()) as threads:  # the loops let go of the interpreter
        return tuple(
            _count(by, list(threads.map(partial(_try, reward, learner), range(seeds))))
            for by, learner in learners.items()
        )


def _try(reward: RewardMap, learner: CellQLearning | PhaseQLearning, seed: int) -> Rollout:
    return rollout_from(learn_policy(reward, learner, seed), reward.path.start)


def _count(by: str, rollouts: Sequence[Rollout]) -> Tried:
    exact = [one.finished and np.array_equal(one.states, one.path.states) for one in rollouts]
    return Tried(by, len(rollouts), sum(one.finished for one in rollouts), sum(exact))
