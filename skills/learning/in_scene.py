"""Learning and certifying in a scene: a policy that does not touch it, and the odds of finishing and of touching.

    RewardMap, Hazards --learn_in_scene--> Policy --certify_in_scene--> SceneCertificate, SceneOdds

The decision process is that of the phase state with slips (`skills.learning.dynamic_programming`), with Algorithm 1's
rewards, less the costs of the scene (`skills.gridworld.hazards.SceneCosts`). A move that touches, intended or by a
slip, ends the pass at the cost of touching.

Gamma must be near 1 here. With 0.1 the reward of finishing, ten moves away, is worth 10^-9, and any risk of touching
outweighs it: the best policy then stays away from the path. With 0.95 it follows the path from its beginning, because a
policy that joins later visits less of it.

A `Policy` keeps its scene, and never commands a move that touches it (`Policy.greedy`): where the best move would, and
in forbidden cells, it stops. `skills.learning.certificate.certify` checks it in that scene too.
"""

from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, freeze
from skills.errors import BadSettings
from skills.fields import Count, schema
from skills.gridworld.grid import MOVES
from skills.gridworld.hazards import Hazards
from skills.gridworld.reward import RewardMap
from skills.gridworld.slip import SlipModel
from skills.learning.certificate import mdp_of, optimal_in_scene
from skills.learning.dynamic_programming import MAX_SWEEPS, ValueIteration
from skills.learning.policy import Learner, Policy, learn_values
from skills.learning.q_learning import PhaseQLearning

SETTLED_ODDS = 1e-13  # a probability that changes by less has settled


@dataclass(frozen=True, eq=False)
class SceneOdds:
    """Probabilities from every state as a start of a pass that moves on until it ends, arrays of shape (n_states,).

    The rest leaves the certified domain, where a client stops, or never ends.

    Attributes:
        finishes: The pass reaches the goal in the phase state's sense, without touching.
        touches: It touches the scene; 1 in a forbidden cell.
    """

    finishes: Floats
    touches: Floats

    def __post_init__(self) -> None:
        freeze(self, finishes=(None,), touches=(None,))


@schema
@dataclass(frozen=True)
class SceneCertificate:
    """The result of checking every greedy action against exact values in a scene, and of every start.

    Attributes:
        checked: Number of states (phase and cell) that were checked: those of the certified domain where it moves on.
        suboptimal: Number of them whose greedy action is worse than the best one.
        starts: Number of allowed cells.
        least_finishing: Smallest probability of finishing, over these starts.
        mean_finishing: Its mean.
        most_touching: Greatest probability of touching.
        mean_touching: Its mean.
    """

    checked: Count
    suboptimal: Count
    starts: Count
    least_finishing: float
    mean_finishing: float
    most_touching: float
    mean_touching: float

    @property
    def every_action_optimal(self) -> bool:
        """True if at least one state was checked and no greedy action is worse than the best one."""
        return self.checked > 0 and self.suboptimal == 0


def learn_in_scene(
    reward: RewardMap, learner: PhaseQLearning | ValueIteration, hazards: Hazards, seed: int = 0
) -> Policy:
    """Learn to follow a demonstration without touching a scene; the same arguments give the same bytes.

    Q-learning finds out by moving what slips and what touches; value iteration knows both.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner, in the phase state.
        hazards: The scene on the path's grid.
        seed: Seed of all random numbers, 0 to 2^63 - 1.

    Returns:
        The policy, with its scene.

    Raises:
        BadSettings: As for `skills.learning.policy.learn_values`.
    """
    q, training = learn_values(reward, learner, seed, hazards)
    return Policy(reward.path, reward.levels, learner, seed, training, q, surroundings=hazards.surroundings)


def scene_learner(learner: Learner) -> PhaseQLearning | ValueIteration:
    """Return a learner that learns in a scene.

    Args:
        learner: Any learner.

    Returns:
        The same learner.

    Raises:
        BadSettings: It does not: it has no phases, or a network.
    """
    if isinstance(learner, PhaseQLearning | ValueIteration):
        return learner
    raise BadSettings(
        f"The learner '{learner.kind}' does not learn in a scene; use {PhaseQLearning.kind} or {ValueIteration.kind}."
    )


def certify_in_scene(policy: Policy, hazards: Hazards) -> tuple[SceneCertificate, SceneOdds]:
    """Check a policy against exact dynamic programming in a scene, with the gamma and the slip of its learner.

    Args:
        policy: The policy, in the phase state.
        hazards: The scene on its grid.

    Returns:
        The certificate, and the odds of all starts.

    Raises:
        BadSettings: Exact values do not settle, or some are too small to be compared, because gamma is too small.
    """
    mdp, domain = replace(mdp_of(policy), hazards=hazards), policy.domain
    live = domain.certified & ~domain.terminal & ~hazards.forbidden[domain.state_of] & (policy.greedy >= 0)
    optimal, _ = optimal_in_scene(mdp, policy.greedy, live)
    odds = odds_in_scene(policy, hazards, mdp.slip)
    starts = ~hazards.forbidden
    certificate = SceneCertificate(
        checked=int(live.sum()),
        suboptimal=int(np.count_nonzero(live & ~optimal)),
        starts=int(starts.sum()),
        least_finishing=float(odds.finishes[starts].min()),
        mean_finishing=float(odds.finishes[starts].mean()),
        most_touching=float(odds.touches[starts].max()),
        mean_touching=float(odds.touches[starts].mean()),
    )
    return certificate, odds


def odds_in_scene(policy: Policy, hazards: Hazards, slip: SlipModel) -> SceneOdds:
    """Compute exactly the probabilities that a policy finishes, and that it touches, from every start.

    Its rows, finishing, touching and stopping are an absorbing Markov chain. No random numbers are used, so this is a
    second method for `skills.learning.slip_runs.walk`.

    Args:
        policy: The policy, in the phase state.
        hazards: The scene on its grid.
        slip: How moves slip.

    Returns:
        The odds of every state as a start.

    Raises:
        BadSettings: The probabilities do not settle.
    """
    domain, grid = policy.domain, policy.path.grid
    rows, live = np.arange(domain.n_rows), policy.greedy >= 0
    intended = policy.greedy.astype(np.int64).clip(0)
    moves = [domain.move(rows, np.full(len(rows), action)) for action in range(len(MOVES))]
    touches = hazards.touches[domain.state_of].T & live
    finishes = np.stack([move.finishes for move in moves]) & live & ~touches
    after = np.where(live & ~touches & ~finishes, np.stack([move.row for move in moves]), -1)
    found = []
    for ends in (finishes, touches):
        odds = np.zeros(len(rows))
        for _ in range(MAX_SWEEPS):
            each = ends + np.append(odds, 0.0)[after]
            before, odds = odds, slip.expected(each[intended, rows], each)
            if np.abs(odds - before).max() <= SETTLED_ODDS:
                break
        else:
            raise BadSettings("The probabilities of finishing and touching do not settle.", slip=slip.probability)
        found.append(odds)
    states = np.arange(grid.n_states)
    phases, over = domain.start(states)
    at = domain.rows_of(phases, grid.cells_of(states))
    forbidden = hazards.forbidden
    return SceneOdds(
        finishes=np.where(forbidden, 0.0, np.where(over, 1.0, found[0][at])).clip(0, 1),
        touches=np.where(forbidden, 1.0, np.where(over, 0.0, found[1][at])).clip(0, 1),
    )
