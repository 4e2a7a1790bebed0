"""All numbers of the report, computed from a source: the paper's Figures 5 to 9, Table I and the rivals.

A source is a shipped sample, or the paper's data if it is available. The paper's data has no licence, so it is not in
this package; `SKILLS_PAPER_DATA` names its folder. It contains the user's path through the grid, the greedy actions of
three published policies, and a raw recording of the study that belongs to another path. The user's own recording was
not published. A published policy is a greedy action for each state, without values.

    Fig. 5   the reward that maximum-entropy IRL recovers from a demonstration, and the sparse reward of Algorithm 1
    Fig. 6   a recorded motion and its discretisation to the grid, with the error of the discretisation
    Fig. 7   one policy, its grid world stacked at five suture points
    Fig. 8   three policies of one demonstration: in the paper's state, in ours, and those that the authors published;
             and two rivals that learn no policy: the demonstration replayed, and a dynamic movement primitive
    Fig. 9   one policy from ten other starts, in the range that the paper prints

In Table I the paper compares "the average of the three learnt trajectories" with the user's: its numbers are those of
all pairs of the three alignments together. Many alignments are equally short, and each splits the same total over x, y
and z differently; so the mean along an axis is meaningful only together with the tie-break that selects one alignment.
The range of its sum over all of them needs no tie-break.

Nothing here draws or writes.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from io import BytesIO
from itertools import product
from math import inf
from pathlib import Path

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import propose_segments
from skills.errors import BadInput, BadPath
from skills.formats import read_recording
from skills.gridworld import paper
from skills.gridworld.grid import PAPER_GRID, GridPath, discretisation_rmse, discretize, fit_grid
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning.certificate import coverage
from skills.learning.evaluation import Metrics, dtw, measure
from skills.learning.max_ent_irl import MaxEntIRL, recover_reward
from skills.learning.policy import Policy, Rollout, learn_tabular, rollout, rollout_from
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.learning.slip_runs import leads_to, replay
from skills.packing import sha256
from skills.planning.plan import SuturePoint, stack
from skills.report import rivals
from skills.report.rivals import Disturbed, disturb, learn_primitive
from skills.seeds.recordings import sample_recordings

SAMPLE = "wren-simple-running"  # it crosses its own path, as the paper's user does
USER_PATH = "user_path_grid11.csv"
RAW = "psm_poses_500hz.csv"
POLICIES = tuple(f"published_policy_{number}.npy" for number in range(1, paper.N_POLICIES + 1))
ABSENT = (
    "THE PAPER'S DATA IS MISSING: everything is drawn from the shipped sample alone. Set SKILLS_PAPER_DATA to "
    "the folder of the data to include the paper's user and the published policies."
)


N_PASSES = 5
SPACING_MM = (0.0, -15.0, 0.0)  # ours: wider than stitches are, so that five passes can be distinguished in a picture
SEEDS = tuple(range(paper.N_POLICIES))
PUBLISHED, CELL, PHASE = "published by the authors", "the paper's state: cell", "ours: phase and cell"
REPLAY, PRIMITIVE = "rival: shortest way, then replay", "rival: dynamic movement primitive"
PUBLISHED_PARAMETERS = "the paper's state, the authors' parameters"
N_STARTS = 10
IN_TURN = 7  # every seventh of the range's 30 grid points, cyclically: ten that spread over all three axes
Triple = tuple[float, float, float]
PAPER_PAIRS = 3 * 28  # each of the user's 28 states is paired with a state of each of three shorter rollouts


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded motion, shape (T, 3) in mm, and its path through a grid."""

    tip_mm: Floats
    path: GridPath

    @property
    def rmse_mm(self) -> Triple:
        """The error of the discretisation along each axis: of the samples against the centres of their cells."""
        return discretisation_rmse(self.tip_mm, self.path.grid)


@dataclass(frozen=True, eq=False)
class FigureSource:
    """A demonstration with everything that the figures need.

    Attributes:
        name: Part of file names.
        title: The demonstrator, for readers.
        path: The path through the paper's grid.
        recorded: The raw motion of Fig. 6; for the paper's data a motion other than `path`.
        published: The published policies: an action for each state, shape (n_states,) each; empty for a sample.
    """

    name: str
    title: str
    path: GridPath
    recorded: Recorded
    published: tuple[Ints, ...] = ()

    @property
    def recorded_elsewhere(self) -> bool:
        """Return whether `recorded` is a motion other than `path`."""
        return self.recorded.path is not self.path


def sample_source() -> FigureSource:
    """Return wren's hand-off, cut as the service would propose it."""
    sample = next(one for one in sample_recordings() if one.name == SAMPLE)
    recording = read_recording(BytesIO(sample.data))
    segment = propose_segments(recording)[0]
    demo = cut_demo(recording, start_s=segment.start_s, end_s=segment.end_s)
    path = discretize(demo.tip_mm, PAPER_GRID)
    return FigureSource("sample", "wren, a synthetic surgeon", path, Recorded(demo.tip_mm, path))


def paper_source(folder: Path | None) -> FigureSource | None:
    """Return the paper's user and the published policies; None if no folder is named.

    Raises:
        BadInput: The folder does not hold the data.
    """
    if folder is None or folder == Path():  # an empty SKILLS_PAPER_DATA counts as unset
        return None
    missing = [name for name in (USER_PATH, RAW, *POLICIES) if not (folder / name).is_file()]
    if missing:
        raise BadInput(f"SKILLS_PAPER_DATA={folder} has no {', '.join(missing)}; correct it or unset it.")
    try:
        # the files are in metres
        path = discretize(1000 * _table(folder / USER_PATH)[:, :3], PAPER_GRID)
        raw_mm = 1000 * _table(folder / RAW, header_rows=1)[:, 3:6]
        recorded = Recorded(raw_mm, discretize(raw_mm, fit_grid(raw_mm)))
        published = tuple(_actions(folder / name) for name in POLICIES)
    except (ValueError, BadPath) as error:
        raise BadInput(f"SKILLS_PAPER_DATA={folder} does not contain the paper's data: {error}") from error
    return FigureSource("paper", "the paper's user", path, recorded, published)


def _table(file: Path, header_rows: int = 0) -> Floats:
    table = np.loadtxt(file, delimiter=",", skiprows=header_rows, ndmin=2)
    if table.shape[1] != 6:
        raise ValueError(f"{file.name} should have 6 columns.")
    return table


def _actions(file: Path) -> Ints:
    actions = np.load(file)
    if actions.shape != (PAPER_GRID.n_states,) or not np.isin(actions, range(paper.N_ACTIONS)).all():
        raise ValueError(f"{file.name} should have an action from 0 to 26 for each of {PAPER_GRID.n_states} states.")
    return np.asarray(actions, np.int64)


def follow(actions: Ints, path: GridPath, start: int) -> Rollout:
    """Follow a published policy from a state to the path's goal; it stops unfinished when a state repeats."""
    after = steps_of(actions, path)
    states = [start]
    while states[-1] != path.goal and states[-1] not in states[:-1]:
        states.append(int(after[states[-1]]))
    return Rollout(path, np.array(states), np.zeros(len(states), np.int64), finished=states[-1] == path.goal)


def starts_reaching(actions: Ints, path: GridPath) -> int:
    """Return the number of states from which a published policy reaches the path's goal."""
    after = steps_of(actions, path)
    for _ in range(len(after).bit_length()):
        after = after[after]  # doubles the number of moves
    return int(np.count_nonzero(after == path.goal))


def steps_of(actions: Ints, path: GridPath) -> Ints:
    """Return the next state of each state, shape (n_states,): itself at the goal, and for a move off the grid."""
    after = leads_to(path.grid)[np.arange(path.grid.n_states), actions]
    after[path.goal] = path.goal
    return after


@dataclass(frozen=True, eq=False)
class RewardFunctions:
    """The recovered and the sparse reward of every state, and the result of planning on the recovered one.

    Attributes:
        recovered: Recovered reward of entering each state, shape (n_states,).
        sparse: The reward of Algorithm 1, same shape.
        visited: Number of distinct states that the demonstration visits.
        found: How many of the `visited` highest recovered rewards lie on visited states.
        nats: Negative log-likelihood of the demonstration per move, with all rewards 0 and with the recovered ones.
        iterations: Iterations of IRL.
        starts_reaching: Starts from which value iteration on the recovered reward leads to the goal.
        walk: Its rollout from the demonstrated start.
    """

    recovered: Floats
    sparse: Floats
    visited: int
    found: int
    nats: tuple[float, float]
    iterations: int
    starts_reaching: int
    walk: Rollout


def compare_rewards(path: GridPath, iterations: int) -> RewardFunctions:
    """Recover a reward by IRL, run value iteration on it, and compare it with Algorithm 1's. Nothing is random."""
    learner, reward = MaxEntIRL(iterations=iterations), sparse_reward(path)
    recovered, policy = recover_reward(path, learner), learn_tabular(reward, learner)
    visited = np.unique(path.states)
    # stable, so that equal rewards have the same order on every machine
    highest = np.argsort(-recovered.rewards, kind="stable")[: len(visited)]
    return RewardFunctions(
        recovered=recovered.rewards,
        sparse=reward.rewards,
        visited=len(visited),
        found=int(np.isin(highest, visited).sum()),
        nats=recovered.negative_log_likelihood,
        iterations=iterations,
        starts_reaching=int(coverage(policy).reaches.sum()),
        walk=rollout_from(policy, path.start),
    )


@dataclass(frozen=True, eq=False)
class Stacked:
    """Passes, each of shape (K, 3) in mm, and their suture points, shape (N, 3) in mm.

    `worst_miss_mm` is the largest difference, along any axis, between a pass and the demonstration moved to its point.
    """

    points_mm: Floats
    passes_mm: tuple[Floats, ...]
    worst_miss_mm: float


def stack_passes(policy: Policy) -> Stacked:
    """Stack a policy at five points from its own goal on, each pass from the demonstrated start moved with its grid."""
    path = policy.path
    goal_mm = path.grid.centres_mm(path.goal)
    points_mm = goal_mm + np.arange(N_PASSES)[:, None] * SPACING_MM
    points = [SuturePoint((x, y, z)) for x, y, z in points_mm.tolist()]
    plan = stack(policy, points, arm="PSM", frame="PSM_base", instrument="any", rotation=None)
    passes = tuple(one.tip_mm for one in plan.passes)
    moved = [path.tip_mm + (point - goal_mm) for point in points_mm]
    misses = [
        float(np.abs(one - demonstrated).max()) if one.shape == demonstrated.shape else inf
        for one, demonstrated in zip(passes, moved, strict=True)
    ]
    return Stacked(points_mm, passes, round(max(misses), 9))


@dataclass(frozen=True, eq=False)
class LearntStyle:
    """The rollout of a policy or rival from the demonstrated start, and the number of starts that reach the goal."""

    by: str
    which: str
    rollout: Rollout
    starts_reaching: int

    @cached_property
    def metrics(self) -> Metrics:
        """The rollout compared with the demonstration."""
        return measure(self.rollout)


@dataclass(frozen=True)
class Tried:
    """The number of seeds with which a learner reaches the goal from the demonstrated start, and follows it exactly.

    `tables` is the number of different tables that they learn: where it is 1, the number of seeds says nothing.
    """

    by: str
    seeds: int
    tables: int
    reached: int
    exact: int


def three_policies(source: FigureSource) -> tuple[LearntStyle, ...]:
    """Return the rollouts of the published policies, if there are any, and of seeds 0, 1 and 2 in either state."""
    path, reward = source.path, sparse_reward(source.path)
    styles = [
        LearntStyle(PUBLISHED, f"policy {number}", follow(actions, path, path.start), starts_reaching(actions, path))
        for number, actions in enumerate(source.published, start=1)
    ]
    for by, learner in ((CELL, CellQLearning()), (PHASE, PhaseQLearning())):
        for seed in SEEDS:
            policy = learn_tabular(reward, learner, seed)
            reaching = int(coverage(policy).reaches.sum())
            styles.append(LearntStyle(by, f"seed {seed}", rollout_from(policy, path.start), reaching))
    return tuple(styles)


def two_rivals(source: FigureSource, primitive: rivals.Primitive) -> tuple[LearntStyle, ...]:
    """Return the rollouts of the two rivals without slips; nothing is random."""
    path, everywhere = source.path, np.arange(source.path.grid.n_states)
    replays = [replay(path, state) for state in everywhere.tolist()]
    passes = rivals.rollouts(primitive, everywhere)
    basis = f"{primitive.weights.shape[1]} basis functions"
    return tuple(
        LearntStyle(by, which, ways[path.start], sum(way.finished for way in ways))
        for by, which, ways in ((REPLAY, "as recorded", replays), (PRIMITIVE, basis, passes))
    )


def try_seeds(source: FigureSource, seeds: int) -> tuple[Tried, ...]:
    """Learn with the seeds from 0 on, in a thread per processor: more evidence than the paper's three policies."""
    learners: dict[str, CellQLearning | PhaseQLearning] = {
        PUBLISHED_PARAMETERS: CellQLearning.published(),
        CELL: CellQLearning(),
        PHASE: PhaseQLearning(),
    }
    reward = sparse_reward(source.path)
    tried = []
    with ThreadPoolExecutor(os.cpu_count()) as threads:  # the compiled loops release the GIL
        for by, learner in learners.items():
            rows = list(threads.map(partial(_try, reward, learner), range(seeds)))
            tables, reached, exact = zip(*rows, strict=True)
            tried.append(Tried(by, seeds, len(set(tables)), sum(reached), sum(exact)))
    return tuple(tried)


def _try(reward: RewardMap, learner: CellQLearning | PhaseQLearning, seed: int) -> tuple[str, bool, bool]:
    """Return the digest of the learnt table, and whether its rollout reaches the goal, and follows the path exactly."""
    policy = learn_tabular(reward, learner, seed)
    followed = rollout_from(policy, reward.path.start)
    exact = followed.finished and np.array_equal(followed.states, reward.path.states)
    return sha256(policy.q.tobytes()), followed.finished, exact


@dataclass(frozen=True, eq=False)
class OtherStart:
    """The rollout from another start, and those of the published policies and of the rivals from there."""

    start_mm: Triple
    ours: Rollout
    published: tuple[Rollout, ...]
    replayed: Rollout
    primitive: Rollout

    @property
    def joins_at(self) -> int:
        """The index of the demonstration's state, from 0, at which ours joins it; the last one if it never does."""
        joined = self.ours.phases[self.ours.phases > 0]
        return int(joined[0]) - 1 if len(joined) else len(self.ours.path.states) - 1


def range_mm() -> list[Triple]:
    """Return the grid points of the printed range, in mm."""
    axes = [np.arange(min(ends), max(ends) + 1, paper.CELL_MM).tolist() for ends in paper.FIG9_START_RANGE_MM]
    return list(product(*axes))


def starts_mm() -> list[Triple]:
    """Return ten of them; the paper does not list its own."""
    points = range_mm()
    return [points[IN_TURN * number % len(points)] for number in range(N_STARTS)]


def other_starts(source: FigureSource, policy: Policy, primitive: rivals.Primitive) -> tuple[OtherStart, ...]:
    """Return the rollouts of a policy, of the published ones and of the rivals from each of the ten starts."""
    path, starts = source.path, starts_mm()
    states = path.grid.states_at(starts)
    primitives = rivals.rollouts(primitive, states)
    return tuple(
        OtherStart(
            start_mm,
            rollout(policy, start_mm),
            tuple(follow(actions, path, state) for actions in source.published),
            replay(path, state),
            by_primitive,
        )
        for start_mm, state, by_primitive in zip(starts, states.tolist(), primitives, strict=True)
    )


def arriving(source: FigureSource, policy: Policy, primitive: rivals.Primitive) -> dict[str, int]:
    """Count the starts of the complete range that reach the goal, for the published policies, ours and the rivals."""
    starts = source.path.grid.states_at(range_mm())
    states = starts.tolist()
    rollouts = {
        f"published policy {number}": [follow(actions, source.path, state) for state in states]
        for number, actions in enumerate(source.published, 1)
    }
    rollouts["ours, seed 0"] = [rollout_from(policy, state) for state in states]
    rollouts[REPLAY] = [replay(source.path, state) for state in states]
    rollouts[PRIMITIVE] = rivals.rollouts(primitive, starts)
    return {by: sum(way.finished for way in ways) for by, ways in rollouts.items()}


# ---- Table I, and all numbers together -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A row of Table I; triples are x, y and z, in mm.

    Attributes:
        of: The trajectories of the row.
        mean_mm: Mean of the differences of all pairs, with the tie-break of `evaluation.TIE_BREAK`.
        std_mm: Their standard deviation (of the population).
        rmse_mm: Their root mean square: sqrt(mean^2 + std^2).
        sum_mm: The mean times the number of pairs.
        least_mm: The smallest such sum in any equally short alignment; None if the paths are not known.
        most_mm: The largest such sum; None likewise.
        total_mm: The sum over all axes: the DTW distance, whatever the tie-break.
        pairs: Number of pairs.
        unfinished: Number of rollouts that never reach the goal; the row then compares an incomplete path.
    """

    of: str
    mean_mm: Triple
    std_mm: Triple
    rmse_mm: Triple
    sum_mm: Triple
    least_mm: Triple | None
    most_mm: Triple | None
    total_mm: float
    pairs: int
    unfinished: int


def as_printed() -> Row:
    """Return the paper's own row, with the RMSE that follows from its mean and standard deviation, in mm."""
    mean, std = np.array(paper.TABLE1_MEAN_MM), np.array(paper.TABLE1_STD_MM)
    return Row(
        of="the paper, as printed",
        mean_mm=paper.TABLE1_MEAN_MM,
        std_mm=paper.TABLE1_STD_MM,
        rmse_mm=_triple(np.hypot(mean, std)),
        sum_mm=_triple(mean * PAPER_PAIRS),
        least_mm=None,
        most_mm=None,
        total_mm=float(mean.sum() * PAPER_PAIRS),
        pairs=PAPER_PAIRS,
        unfinished=0,
    )


def pooled(of: str, rollouts: Sequence[Rollout]) -> Row:
    """Return the row of rollouts compared with their demonstration: all pairs of all alignments together."""
    apart = np.concatenate([dtw(one.tip_mm, one.path.tip_mm).differences_mm for one in rollouts])
    least, most = np.sum([axis_bounds_mm(one) for one in rollouts], axis=0)
    return Row(
        of=of,
        mean_mm=_triple(apart.mean(axis=0)),
        std_mm=_triple(apart.std(axis=0)),
        rmse_mm=_triple(np.sqrt((apart**2).mean(axis=0))),
        sum_mm=_triple(apart.sum(axis=0)),
        least_mm=_triple(least),
        most_mm=_triple(most),
        total_mm=float(apart.sum()),
        pairs=len(apart),
        unfinished=sum(not one.finished for one in rollouts),
    )


def axis_bounds_mm(rollout: Rollout) -> tuple[Triple, Triple]:
    """Return the least and largest sum of each axis, in mm, over all equally short alignments of a rollout."""
    cells = rollout.path.grid.cells_of(rollout.states)
    apart = np.abs(cells[:, None] - rollout.path.cells[None])  # in whole cells, so that ties are exact
    cell_mm = rollout.path.grid.cell_mm
    least = [cell_mm * _least_of_axis(apart.tolist(), axis, 1) for axis in range(3)]
    most = [-cell_mm * _least_of_axis(apart.tolist(), axis, -1) for axis in range(3)]
    return _triple(least), _triple(most)


def _least_of_axis(apart: list[list[list[int]]], axis: int, sign: int) -> int:
    """Return the least of `sign` times an axis's sum, in cells, over all equally short alignments.

    Warps with the cost (total, sign * share of the axis), compared in this order.
    """
    costs = {(-1, -1): (0, 0)}
    for i, row in enumerate(apart):
        for j, one in enumerate(row):
            before = (costs[at] for at in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if at in costs)
            total, share = min(before)
            costs[i, j] = (total + sum(one), share + sign * one[axis])
    return costs[len(apart) - 1, len(apart[0]) - 1][1]


def _triple(values: Sequence[float] | np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Triple:
    # 1e-9 mm, which removes rounding errors of sums; + 0.0 turns -0.0 into 0.0
    x, y, z = (round(float(v), 9) + 0.0 for v in values)
    return x, y, z


@dataclass(frozen=True)
class Effort:
    """The amount of computation: iterations of IRL, seeds for each learner, and runs for each slip probability."""

    irl_iterations: int = MaxEntIRL().iterations
    seeds: int = 200
    runs: int = 1000


@dataclass(frozen=True, eq=False)
class Numbers:
    """All computed numbers of one source."""

    source: FigureSource
    fig_5: RewardFunctions
    fig_7: Stacked
    fig_8: tuple[LearntStyle, ...]
    fig_8_rivals: tuple[LearntStyle, ...]
    tried: tuple[Tried, ...]
    fig_9: tuple[OtherStart, ...]
    arriving: dict[str, int]
    table_1: tuple[Row, ...]
    disturbed: tuple[Disturbed, ...]


def compute(source: FigureSource, effort: Effort) -> Numbers:
    """Compute all numbers of one source; the same arguments give the same numbers.

    Raises:
        BadSettings: The number of iterations is impossible.
    """
    reward, primitive = sparse_reward(source.path), learn_primitive(source.path)
    policy = learn_tabular(reward, PhaseQLearning(), seed=0)
    fig_8 = three_policies(source)
    printed = [as_printed()] if source.published else []  # only about the paper's user
    return Numbers(
        source=source,
        fig_5=compare_rewards(source.path, effort.irl_iterations),
        fig_7=stack_passes(policy),
        fig_8=fig_8,
        fig_8_rivals=two_rivals(source, primitive),
        tried=try_seeds(source, effort.seeds),
        fig_9=other_starts(source, policy, primitive),
        arriving=arriving(source, policy, primitive),
        table_1=(
            *printed,
            *(
                pooled(by, [one.rollout for one in fig_8 if one.by == by])
                for by in dict.fromkeys(one.by for one in fig_8)
            ),
        ),
        disturbed=disturb(policy, learn_tabular(reward, CellQLearning(), seed=0), primitive, effort.runs),
    )
