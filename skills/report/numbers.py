"""All numbers of the report, computed from a source; nothing here draws or writes."""

from collections.abc import Sequence
from dataclasses import dataclass

from skills.report.dmp import learn_primitive
from skills.report.fig_5 import RewardFunctions, compare_rewards
from skills.report.fig_6 import Discretised, compare_path
from skills.report.fig_7 import Stacked, stack_passes
from skills.report.fig_8 import Learnt, Tried, three_policies, try_seeds, two_rivals
from skills.report.fig_9 import Arriving, OtherStart, arriving, other_starts
from skills.report.slips import Disturbed, disturb
from skills.report.sources import Source
from skills.report.table_1 import Row, as_printed, pooled
from skills.style.learning.irl import MaxEntIRL
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning
from skills.style.policy import learn_policy
from skills.style.reward import sparse_reward


@dataclass(frozen=True)
class Effort:
    """How much to compute: iterations of IRL, seeds on which each learner is tried, and runs for each slip."""

    irl_iterations: int = MaxEntIRL().iterations
    seeds: int = 200
    runs: int = 1000


@dataclass(frozen=True, eq=False)
class Numbers:
    """What is drawn and written about one source."""

    source: Source
    fig_5: RewardFunctions
    fig_6: Discretised
    fig_7: Stacked
    fig_8: tuple[Learnt, ...]
    fig_8_rivals: tuple[Learnt, ...]
    tried: tuple[Tried, ...]
    fig_9: tuple[OtherStart, ...]
    arriving: tuple[Arriving, ...]
    table_1: tuple[Row, ...]
    disturbed: tuple[Disturbed, ...]


def compute(source: Source, effort: Effort) -> Numbers:
    """Compute everything about one source; the same arguments give the same numbers.

    Raises:
        BadSettings: So many iterations cannot be meant.
    """
    reward, primitive = sparse_reward(source.path), learn_primitive(source.path)
    policy = learn_policy(reward, PhaseQLearning(), seed=0)
    fig_8 = three_policies(source)
    return Numbers(
        source=source,
        fig_5=compare_rewards(source.path, effort.irl_iterations),
        fig_6=compare_path(source.recorded),
        fig_7=stack_passes(policy),
        fig_8=fig_8,
        fig_8_rivals=two_rivals(source, primitive),
        tried=try_seeds(source, effort.seeds),
        fig_9=other_starts(source, policy, primitive),
        arriving=arriving(source, policy, primitive),
        table_1=_table_1(source, fig_8),
        disturbed=disturb(policy, learn_policy(reward, CellQLearning(), seed=0), primitive, effort.runs),
    )


def _table_1(source: Source, fig_8: Sequence[Learnt]) -> tuple[Row, ...]:
    """Take each learner's three policies together; the printed row is about the paper's user alone."""
    learners = dict.fromkeys(one.by for one in fig_8)
    rows = [pooled(by, [one.rollout for one in fig_8 if one.by == by]) for by in learners]
    return (as_printed(), *rows) if source.published else tuple(rows)
