"""Speed of learning and certification, compared with plain Python, plain C and the gain of two threads."""

import hashlib
from io import BytesIO

import numpy as np
from rich.table import Table

from skills.demonstration.demonstration import cut_demo
from skills.formats import read_recording
from skills.gridworld.grid import PAPER_GRID, discretize
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning import q_learning
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw
from skills.learning.policy import Learner, learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.report.numbers import paper_source
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings
from tests.bench.plain_c import plain_c
from tests.bench.timing import best_s, gain, in_turn
from tests.measured import measured

ROUNDS = 5


def learning(table: Table) -> None:
    """Learn the paper's demonstration, or the loop of a sample if that is absent; then larger grids."""
    theirs = paper_source(Settings().paper_data)
    name, reward = ("the paper's user", sparse_reward(theirs.path)) if theirs else ("the loop of wren", _loop())
    learners(name, reward, table)
    compiled(reward, table)
    against_c(reward, table)
    two_threads(reward, table)
    sizes(table)
    warping(table)


def _loop() -> RewardMap:
    sample = next(s for s in sample_recordings() if s.surgeon == "wren")
    demo = cut_demo(read_recording(BytesIO(sample.data)), start_s=sample.segments[0][0], end_s=sample.segments[0][1])
    return sparse_reward(discretize(demo.tip_mm, PAPER_GRID))


def learners(name: str, reward: RewardMap, table: Table) -> None:
    """Time both learners, and the certificate next to the learning."""
    for learner in (PhaseQLearning(), CellQLearning()):
        policy = learn_tabular(reward, learner)
        took, both = best_s(lambda: learn_tabular(reward, learner)), best_s(lambda: learn_and_certify(reward, learner))  # noqa: B023
        training = policy.training
        table.add_row(f"{learner.kind}, {name}", f"{took * 1e3:.1f} ms", f"{training.steps} moves")
        table.add_row("  with the certificate", f"{both * 1e3:.1f} ms", f"{both / took:.2f} x the learning alone")


def learn_and_certify(reward: RewardMap, learner: Learner) -> None:
    """Do the computation of one training."""
    certify(learn_tabular(reward, learner))


def compiled(reward: RewardMap, table: Table) -> None:
    """Compare the compiled kernel with the same function as plain Python."""
    learner = CellQLearning(episodes=20)
    fast = best_s(lambda: learn_tabular(reward, learner))
    loop = q_learning.run_episodes
    try:
        q_learning.run_episodes = loop.plain
        slow = best_s(lambda: learn_tabular(reward, learner), rounds=1)
    finally:
        q_learning.run_episodes = loop
    table.add_row("plain Python, 20 episodes", f"{slow * 1e3:.1f} ms", f"{slow / fast:.0f} x the compiled one")


def against_c(reward: RewardMap, table: Table) -> None:
    """Compare the paper's budget of moves with a plain C scan of the 27 actions, compiled on the spot; in turn."""
    steps = learn_tabular(reward, CellQLearning()).training.steps
    scan = plain_c()
    if scan is None:
        table.add_row("the paper's budget, cell state", "no C compiler here", "")
        return
    ours, theirs = in_turn(lambda: learn_tabular(reward, CellQLearning()), lambda: scan(reward), rounds=ROUNDS**2)
    table.add_row("the paper's budget, cell state", f"{ours / steps * 1e9:.1f} ns a move", f"{steps} moves")
    table.add_row("  plain C, -O3", f"{theirs / steps * 1e9:.1f} ns a move", f"ours takes {ours / theirs:.2f} of it")


def two_threads(reward: RewardMap, table: Table) -> None:
    """Learn the same styles on one thread and on two, in turn: the loops release the interpreter lock.

    For comparison, hashing shows the possible gain of two threads: other processes may use the cores.
    """
    learner, data = CellQLearning(episodes=200_000), bytes(64 << 20)
    learning = gain(lambda: learn_tabular(reward, learner), 4, ROUNDS)
    hashing = gain(lambda: hashlib.sha256(data), 4, ROUNDS)
    table.add_row("four policies, two threads", "", f"{learning:.2f} x one thread's rate")
    table.add_row("  four hashes, two threads", "", f"{hashing:.2f} x one thread's rate")


def sizes(table: Table) -> None:
    """Learn and certify winding paths in larger grids, each in a separate interpreter."""
    for side, waypoints in ((11, 40), (21, 100), (51, 400), (101, 400)):
        cost, path = measured(side, waypoints), f"{waypoints} waypoints"
        learning, certificate = f"peak {cost.learning_mib:.0f} MiB", f"peak {cost.certificate_mib:.0f} MiB"
        table.add_row(f"{side} cells a side, {path}", f"{cost.learning_s * 1e3:.0f} ms", learning)
        table.add_row("  certificate", f"{cost.certificate_s * 1e3:.0f} ms", certificate)


def warping(table: Table) -> None:
    """Time DTW next to the distances that it needs."""
    rng = np.random.default_rng(0)
    long = rng.normal(size=(1000, 3)), rng.normal(size=(1200, 3))
    warped, summed = best_s(lambda: dtw(*long)), best_s(lambda: np.abs(long[0][:, None] - long[1]).sum(-1))
    table.add_row("DTW, 1000 x 1200 points", f"{warped * 1e3:.1f} ms", f"{warped / summed:.1f} x its distances alone")
