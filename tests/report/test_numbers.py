"""The report's own computations, by cases worked by hand and by second methods."""

import numpy as np
import pytest

from skills.errors import BadInput
from skills.gridworld import paper
from skills.gridworld.grid import MOVES, PAPER_GRID, GridPath, GridWorld
from skills.learning.policy import Rollout
from skills.report import numbers
from skills.report.numbers import as_printed, axis_bounds_mm, follow, pooled, stack_passes, starts_reaching
from tests.gridworld.paths import learnt, named_path

LINE = GridWorld((0.0, 0.0, 0.0), 5.0, (6, 2, 2))
STAY, AHEAD, BACK = (MOVES.tolist().index(move) for move in ([0, 0, 0], [1, 0, 0], [-1, 0, 0]))


def way(grid: GridWorld, cells: list[tuple[int, int, int]], path: GridPath) -> Rollout:
    states = grid.states_of(cells)
    return Rollout(path, states, np.zeros(len(states), np.int64), finished=True)


def along_x(*xs: int) -> GridPath:
    return GridPath(LINE, LINE.states_of([(x, 0, 0) for x in xs]))


def test_a_published_policy_ends_at_the_goal_in_a_circle_or_at_the_edge():
    path = along_x(2, 3)
    ahead = np.full(LINE.n_states, AHEAD)
    assert follow(ahead, path, path.start).states.tolist() == path.states.tolist()
    assert follow(ahead, path, path.goal).finished
    assert starts_reaching(ahead, path) == 4  # x of 0 to 3 in its row; 4 and 5 run against the edge, other rows miss it
    behind = follow(ahead, path, int(LINE.states_of((4, 0, 0))))
    assert (behind.finished, behind.tip_mm[-1].tolist()) == (False, [25, 0, 0])
    turning = ahead.copy()
    turning[LINE.states_of([(0, 0, 0), (1, 0, 0)])] = AHEAD, BACK
    circling = follow(turning, path, 0)
    assert (circling.finished, circling.tip_mm[:, 0].tolist()) == (False, [0, 5, 0])
    assert starts_reaching(np.full(LINE.n_states, STAY), path) == 1


def test_a_tie_may_count_to_either_axis_and_the_range_says_so():
    # The demonstration's middle state is 5 mm from the first along x and 5 mm from the last along y.
    grid = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 2))
    path = GridPath(grid, grid.states_of([(0, 0, 0), (1, 0, 0), (1, 1, 0)]))
    assert axis_bounds_mm(way(grid, [(0, 0, 0), (1, 1, 0)], path)) == ((0, 0, 0), (5, 5, 0))
    assert axis_bounds_mm(way(grid, [(0, 0, 0), (1, 0, 0), (1, 1, 0)], path)) == ((0, 0, 0), (0, 0, 0))


@pytest.mark.parametrize("seed", range(20))
def test_the_range_holds_for_every_one_of_all_the_shortest_alignments(seed):
    rng = np.random.default_rng(seed)
    path = named_path("an angle")
    reference = GridPath(path.grid, path.states[:4])
    cells = path.grid.cells_of(reference.states)[[0, *rng.integers(0, 4, 2).tolist(), 3]]
    cells = np.clip(cells + rng.integers(-1, 2, cells.shape), 0, np.array(path.grid.shape) - 1)
    followed = Rollout(reference, path.grid.states_of(cells), np.zeros(len(cells), np.int64), finished=True)
    splits = [splits_of(pairs, cells, reference.cells) for pairs in alignments(len(cells), len(reference.cells))]
    fewest = min(split.sum() for split in splits)
    ties = np.array([split for split in splits if split.sum() == fewest])
    least, most = axis_bounds_mm(followed)
    assert (5.0 * ties.min(axis=0)).tolist() == list(least)
    assert (5.0 * ties.max(axis=0)).tolist() == list(most)


def alignments(n: int, m: int) -> list[list[tuple[int, int]]]:
    """List every warping of n points to m: all ways from (0, 0) to (n - 1, m - 1)."""
    if (n, m) == (1, 1):
        return [[(0, 0)]]
    before = [(a, b) for a, b in ((n - 1, m - 1), (n - 1, m), (n, m - 1)) if a > 0 and b > 0]
    return [[*one, (n - 1, m - 1)] for a, b in before for one in alignments(a, b)]


def splits_of(pairs: list[tuple[int, int]], cells: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return sum(np.abs(cells[i] - reference[j]) for i, j in pairs)


def test_pooled_numbers_hang_together():
    policy = learnt("an angle", phased=False)
    grid, path = policy.path.grid, policy.path
    short = way(grid, path.cells[[0, 3, 6]].tolist(), path)
    row = pooled("three", [short, short, way(grid, path.cells.tolist(), path)])
    assert np.hypot(row.mean_mm, row.std_mm) == pytest.approx(row.rmse_mm, abs=1e-6)  # mm
    assert np.multiply(row.mean_mm, row.pairs) == pytest.approx(row.sum_mm, abs=1e-6)
    assert sum(row.sum_mm) == row.total_mm > 0
    assert row.least_mm is not None and row.most_mm is not None
    assert all(a <= b <= c for a, b, c in zip(row.least_mm, row.sum_mm, row.most_mm, strict=True))


def test_the_printed_row_is_the_papers_and_its_total_430_mm():
    row = as_printed()
    assert (row.mean_mm, row.std_mm) == (paper.TABLE1_MEAN_MM, paper.TABLE1_STD_MM)
    assert row.total_mm == pytest.approx(430, abs=3 * 0.0005 * 84)  # mm, by its rounding


def test_the_ten_starts_differ_span_the_range_and_include_the_failing_one():
    starts = numbers.starts_mm()
    assert len(set(starts)) == 10
    assert (-25.0, 50.0, -135.0) in starts
    assert paper.USER_START_MM not in starts
    for axis, ends in enumerate(paper.FIG9_START_RANGE_MM):
        values = {start[axis] for start in starts}
        assert (min(values), max(values)) == (min(ends), max(ends))
        assert {value % 5 for value in values} == {0}


def test_five_passes_miss_the_moved_demonstration_by_nothing():
    stacked = stack_passes(learnt("a figure of eight"))
    assert (len(stacked.passes_mm), stacked.worst_miss_mm) == (5, 0)
    cut = stack_passes(learnt("a figure of eight", phased=False))
    assert cut.worst_miss_mm == np.inf  # a policy that cuts corners has other states


@pytest.fixture
def folder(tmp_path):
    """Return a folder in the form of the paper's data, with none of it."""
    path = named_path("an angle")
    tip_m = PAPER_GRID.centres_mm(PAPER_GRID.states_of(path.cells)) / 1000
    np.savetxt(tmp_path / numbers.USER_PATH, np.hstack((tip_m, np.zeros_like(tip_m))), delimiter=",")
    np.savetxt(tmp_path / numbers.RAW, np.hstack((np.zeros_like(tip_m), tip_m)), delimiter=",", header="r,p,y,X,Y,Z")
    for name in numbers.POLICIES:
        np.save(tmp_path / name, np.full(PAPER_GRID.n_states, 13.0))
    return tmp_path


def test_data_in_the_papers_form_is_read_in_mm(folder):
    source = numbers.paper_source(folder)
    assert source is not None
    assert source.path.cells.tolist() == named_path("an angle").cells.tolist()
    assert source.recorded_elsewhere
    assert [actions.tolist() for actions in source.published] == [[13] * 1331] * 3


@pytest.mark.parametrize("nowhere", [None, numbers.Path("")])
def test_no_folder_is_no_source(nowhere):
    assert numbers.paper_source(nowhere) is None


@pytest.mark.parametrize("name", [numbers.USER_PATH, numbers.RAW, *numbers.POLICIES])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(BadInput, match=name):
        numbers.paper_source(folder)


BAD_ARRAYS = {
    "shape": np.zeros(1330),
    "action": np.full(1331, 27.0),
    "half": np.full(1331, 0.5),
    "nan": np.full(1331, np.nan),
}


@pytest.mark.parametrize("actions", BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_actions_that_are_none_are_refused(folder, actions):
    np.save(folder / numbers.POLICIES[1], actions)
    with pytest.raises(BadInput, match="action from 0 to 26"):
        numbers.paper_source(folder)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (numbers.USER_PATH, "not,a,number"),
        (numbers.USER_PATH, "1,2"),
        (numbers.USER_PATH, ""),
        (numbers.RAW, "h\n1,2,3"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_a_damaged_table_is_refused(folder, name, text):
    (folder / name).write_text(text)
    with pytest.raises(BadInput, match="does not contain the paper's data"):
        numbers.paper_source(folder)


def test_metres_taken_for_millimetres_lie_outside_the_grid_and_are_refused(folder):
    table = np.loadtxt(folder / numbers.USER_PATH, delimiter=",")
    np.savetxt(folder / numbers.USER_PATH, 1000 * table, delimiter=",")
    with pytest.raises(BadInput, match="outside the grid"):
        numbers.paper_source(folder)
