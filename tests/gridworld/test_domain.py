import numpy as np
import pytest

from skills.gridworld.domain import Domain
from skills.gridworld.grid import MOVES
from tests.by_day import some
from tests.gridworld.paths import WALKS, named_path, random_path

PATHS = [named_path(name) for name in WALKS] + [random_path(seed) for seed in range(8)]
IDS = [*WALKS, *(f"random {seed}" for seed in range(8))]
on_every_path = pytest.mark.parametrize("path", PATHS, ids=IDS)
in_both_states = pytest.mark.parametrize("phased", [True, False], ids=["phase", "cell"])


@on_every_path
@in_both_states
def test_every_row_is_one_phase_and_cell(path, phased):
    domain = Domain(path, phased)
    assert (domain.rows_of(domain.phase_of, domain.cell_of) == np.arange(domain.n_rows)).all()
    assert len(set(zip(domain.phase_of.tolist(), domain.state_of.tolist(), strict=True))) == domain.n_rows


@on_every_path
def test_the_certified_domain_is_phase_0_and_2_cells_around_each_waypoint(path):
    domain = Domain(path, phased=True)
    rows = set(zip(domain.phase_of[domain.certified], domain.state_of[domain.certified], strict=True))
    for phase in range(domain.phases):
        for state, cell in enumerate(path.grid.cells_of(np.arange(path.grid.n_states))):
            near = [np.abs(cell - path.cells[w]).max() <= 2 for w in (phase - 1, phase)]
            assert ((phase, state) in rows) == (phase == 0 or any(near))


@on_every_path
def test_every_start_is_in_the_certified_domain(path):
    domain = Domain(path, phased=True)
    for state in range(path.grid.n_states):
        phase, _ = domain.start(state)
        assert domain.holds(phase, path.grid.cells_of(state))


def moved(path, phased, phase, state, action):
    """Return the interface's rule for one move: the phase and state after it, whether it finishes, and its kind."""
    nx, ny, nz = path.grid.shape
    a, b, c = MOVES[action].tolist()
    x, y, z = state // (ny * nz) + a, state // nz % ny + b, state % nz + c
    if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
        return phase, state, False, "off the grid"
    waypoints, after = path.states.tolist(), (x * ny + y) * nz + z
    if phase == 0:
        joined = waypoints.index(after) + 1 if phased and after in waypoints else 0
        return (0, after, True, "") if after == path.goal else (joined, after, False, "")
    if after != waypoints[phase]:
        return phase, after, False, ""
    if phase == len(waypoints) - 1:
        return phase, after, True, ""
    return phase + 1, after, False, "advances"


@pytest.mark.parametrize("path", some(PATHS[:8], 4), ids=IDS[:8])
@in_both_states
def test_every_move_of_the_domain_leads_where_the_interface_says(path, phased):
    domain = Domain(path, phased)
    places = list(zip(domain.phase_of.tolist(), domain.state_of.tolist(), strict=True))
    row_at = {places[row]: row for row in np.flatnonzero(domain.certified)}
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    moves = domain.move(np.repeat(live, 27), np.tile(np.arange(27), len(live)))
    for i, (row, action) in enumerate((row, action) for row in live for action in range(27)):
        before, state = places[row]
        phase, after, finishes, what = moved(path, phased, before, state, action)
        assert moves.state[i] == after
        assert moves.finishes[i] == finishes
        assert (moves.off_grid[i], moves.advances[i]) == (what == "off the grid", what == "advances")
        assert moves.row[i] == (-1 if finishes else row_at.get((phase, after), -1))
        if what != "off the grid":
            assert domain.enter(before, after) == (phase, finishes)


def test_a_start_where_the_path_comes_twice_joins_at_the_first_visit():
    path = named_path("to and fro")  # 19 34 19 34 ...
    domain = Domain(path, phased=True)
    assert domain.start(19) == (1, False)
    assert domain.start(34) == (2, False)
    assert domain.enter(0, 34) == (2, False)


def test_a_start_on_an_early_goal_runs_on_but_entering_the_goal_finishes():
    path = named_path("through its goal")
    domain = Domain(path, phased=True)
    first = path.states.tolist().index(path.goal)
    assert 0 < first < len(path.states) - 1
    assert domain.start(path.goal) == (first + 1, False)
    assert domain.enter(0, path.goal) == (0, True)


def test_a_start_on_a_goal_that_is_only_the_end_is_finished():
    path = named_path("an angle")
    assert Domain(path, phased=True).start(path.goal) == (6, True)
    assert Domain(path, phased=False).start(path.goal) == (0, True)


def test_staying_in_the_cell_of_the_next_waypoint_enters_it():
    path = named_path("an angle")
    domain = Domain(path, phased=True)
    row = domain.rows_of(3, path.cells[3])
    stayed = domain.move(np.array([row]), np.array([13]))
    assert stayed.advances[0]
    assert stayed.row[0] == domain.rows_of(4, path.cells[3])


def test_the_papers_state_has_one_phase_of_all_cells():
    path = named_path("a figure of eight")
    domain = Domain(path, phased=False)
    assert (domain.phases, domain.n_rows) == (1, path.grid.n_states)
    assert domain.certified.all()
    assert np.flatnonzero(domain.terminal).tolist() == [path.goal]
