"""The report's numbers as tables, for the page, for programs and for the terminal; nothing is computed here."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from skills.arithmetic import wilson
from skills.gridworld import paper
from skills.learning.evaluation import measure
from skills.learning.policy import Rollout
from skills.report.numbers import Numbers, Row, as_printed, range_mm

Cell = str | int | float
Rows = tuple[tuple[Cell, ...], ...]
UNKNOWN: tuple[Cell, Cell, Cell] = ("not known", "not known", "not known")


@dataclass(frozen=True)
class Table:
    """A caption, named columns, and rows; `name` is unique on the page."""

    name: str
    caption: str
    columns: tuple[str, ...]
    rows: Rows

    def __post_init__(self) -> None:
        assert len(set(self.columns)) == len(self.columns), "rows become objects by the names of their columns"


def tables_of(numbers: Numbers) -> dict[str, tuple[Table, ...]]:
    """Return all numbers of a source as tables, by figure."""
    return {figure: tuple(write(numbers) for write in writers) for figure, writers in WRITERS.items()}


def _fig_5(numbers: Numbers) -> Table:
    found = numbers.fig_5
    rows: Rows = (
        ("iterations of IRL", found.iterations),
        ("negative log-likelihood of the demonstration, all rewards 0 (nat per move)", round(found.nats[0], 4)),
        ("the same with the recovered reward", round(found.nats[1], 4)),
        (f"of the {found.visited} highest recovered rewards, on visited states", found.found),
        ("starts from which value iteration on it reaches the goal, of 1331", found.starts_reaching),
        ("from the demonstrated start it", "reaches the goal" if found.walk.finished else _stops(numbers)),
    )
    return _named("fig-5", numbers, "The recovered reward", ("what", "value"), rows)


def _stops(numbers: Numbers) -> str:
    walk = numbers.fig_5.walk
    still = len(walk.states) > 1 and walk.states[-1] == walk.states[-2]
    moves = len(set(walk.states.tolist())) - 1
    return f"{'stands still' if still else 'goes round in circles'} after {moves} move{'' if moves == 1 else 's'}"


def _fig_6(numbers: Numbers) -> Table:
    recorded = numbers.source.recorded
    path = recorded.path
    rows: Rows = (
        ("samples", len(recorded.tip_mm)),
        ("cell (mm)", path.grid.cell_mm),
        ("states", len(path.states)),
        ("states visited before", path.revisits),
        ("states that no sample lies in", path.bridged),
        ("RMSE of the samples, x, y, z (mm)", _xyz(recorded.rmse_mm)),
    )
    caption = (
        "The raw recording (another motion of the study)" if numbers.source.recorded_elsewhere else "The recording"
    )
    return _named("fig-6", numbers, caption, ("what", "value"), rows)


def _fig_7(numbers: Numbers) -> Table:
    found = numbers.fig_7
    passes = zip(found.points_mm.tolist(), found.passes_mm, strict=True)
    rows = ((number, _xyz(point), len(tip), _xyz(tip[-1].tolist())) for number, (point, tip) in enumerate(passes, 1))
    caption = f"Five passes, at most {found.worst_miss_mm:g} mm from the demonstration moved there"
    return _named("fig-7", numbers, caption, ("pass", "suture point (mm)", "states", "ends at (mm)"), rows)


def _fig_8(numbers: Numbers) -> Table:
    rows = (
        (
            one.by,
            one.which,
            _arrives(one.rollout),
            len(one.rollout.states),
            one.metrics.exact_states,
            one.metrics.dtw_total_mm,
            one.starts_reaching,
        )
        for one in (*numbers.fig_8, *numbers.fig_8_rivals)
    )
    columns = ("policy", "which", "arrives", "states", "exact states", "DTW (mm)", "starts that arrive, of 1331")
    caption = f"From the demonstrated start; the demonstration has {len(numbers.source.path.states)} states"
    return _named("fig-8", numbers, caption, columns, rows)


def _tried(numbers: Numbers) -> Table:
    rows = ((one.by, one.seeds, one.tables, one.reached, one.exact) for one in numbers.tried)
    columns = ("learner", "seeds", "different tables", "arrive", "give the demonstration back")
    return _named("seeds", numbers, "The same learners on many seeds, from 0 on", columns, rows)


def _fig_9(numbers: Numbers) -> Table:
    theirs = tuple(f"published {number} arrives" for number in range(1, len(numbers.source.published) + 1))
    rows: Iterable[tuple[Cell, ...]] = (
        (
            _xyz(one.start_mm),
            _arrives(one.ours),
            one.joins_at,
            measure(one.ours).dtw_total_mm,
            *map(_arrives, one.published),
            *(measure(one.replayed).dtw_total_mm, measure(one.primitive).dtw_total_mm),
            _arrives(one.primitive),
        )
        for one in numbers.fig_9
    )
    ours = ("ours arrives", "joins the path at its state", "DTW of ours (mm)")
    rivals = ("DTW of the replay (mm)", "DTW of the movement primitive (mm)", "it arrives")
    columns = ("start (mm)", *ours, *theirs, *rivals)
    return _named("fig-9", numbers, "Ten starts in the printed range", columns, rows)


def _range(numbers: Numbers) -> Table:
    rows = ((by, len(range_mm()), arriving) for by, arriving in numbers.arriving.items())
    return _named("range", numbers, "All grid points of the printed range", ("policy", "starts", "arrive"), rows)


def _table_1(numbers: Numbers) -> Table:
    columns = ("trajectories", "mean (mm)", "standard deviation (mm)", "RMSE (mm)", "total DTW (mm)", "pairs")
    rows = (
        (_of(one), _xyz(one.mean_mm), _xyz(one.std_mm), _xyz(one.rmse_mm), round(one.total_mm, 3), one.pairs)
        for one in numbers.table_1
    )
    return _named("table-1", numbers, "Dissimilarity along x, y, z, three policies together", columns, rows)


def _ranges(numbers: Numbers) -> Table:
    """Show the values that do not depend on a tie-break: the possible range of each axis's sum."""
    columns = ("trajectories", "axis", "sum (mm)", "least (mm)", "most (mm)")
    rows = [
        (_of(one), "xyz"[axis], round(one.sum_mm[axis], 3), least[axis], most[axis])
        for one in numbers.table_1
        for least, most in [(one.least_mm or UNKNOWN, one.most_mm or UNKNOWN)]
        for axis in range(3)
    ]
    return _named("ranges", numbers, "The same as sums, and all that equally short alignments allow", columns, rows)


def _disturbed(numbers: Numbers) -> Table:
    rows = (
        (
            one.slip,
            one.by,
            *_share(one.outcome.followed, one.outcome.runs),
            *_share(one.outcome.arrived, one.outcome.runs),
            round(one.outcome.left_out, 2),
            "none followed" if one.outcome.extra_moves is None else round(one.outcome.extra_moves, 2),
            round(one.outcome.dtw_total_mm, 1),
            round(one.outcome.farthest_mm, 2),
        )
        for one in numbers.disturbed
    )
    shares = ("follow (%)", "95 % interval of it", "arrive (%)", "95 % interval of that")
    columns = ("slip", "by", *shares, "states left out", "extra moves", "DTW (mm)", "farthest (mm)")
    return _named("rivals", numbers, f"{numbers.disturbed[0].outcome.runs} runs each", columns, rows)


def _share(count: int, of: int) -> tuple[float, str]:
    low, high = wilson(count, of)
    return round(100 * count / of, 4), f"{100 * low:.1f} to {100 * high:.1f}"


def _exact(numbers: Numbers) -> Table:
    planned = len(numbers.source.path.states) - 1
    rows = (
        (
            one.slip,
            one.by,
            round(100 * one.exact.finishes, 4),
            "none follows" if one.exact.moves is None else round(one.exact.moves - planned, 3),
        )
        for one in numbers.disturbed
        if one.exact is not None
    )
    columns = ("slip", "by", "follow (%)", "extra moves")
    return _named("rivals-exact", numbers, "Ours by its Markov chain: nothing drawn", columns, rows)


def _of(row: Row) -> str:
    return f"{row.of} ({row.unfinished} never arrive)" if row.unfinished else row.of


def _arrives(way: Rollout) -> str:
    return "yes" if way.finished else "no"


def printed_rmse() -> Table:
    """Compare the printed RMSE with the one that follows from the printed Table I; it does not depend on a source."""
    printed = paper.RMSE_AS_PRINTED_MM
    follows = as_printed().rmse_mm
    rows = tuple(
        ("xyz"[axis], printed[axis], round(follows[axis], 3), round(follows[axis] / printed[axis])) for axis in range(3)
    )
    columns = ("axis", "printed, as mm", "follows from Table I (mm)", "times")
    return Table("rmse", "The paper's RMSE beside sqrt(mean^2 + std^2) of its own Table I", columns, rows)


def _named(
    name: str, numbers: Numbers, caption: str, columns: tuple[str, ...], rows: Iterable[tuple[Cell, ...]]
) -> Table:
    return Table(f"{name}-{numbers.source.name}", f"{caption}: {numbers.source.title}", columns, tuple(rows))


def _xyz(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.3f}".rstrip("0").rstrip(".") for value in values)


WRITERS: dict[str, tuple[Callable[[Numbers], Table], ...]] = {
    "fig-5": (_fig_5,),
    "fig-6": (_fig_6,),
    "fig-7": (_fig_7,),
    "fig-8": (_fig_8, _tried),
    "fig-9": (_fig_9, _range),
    "table-1": (_table_1, _ranges),
    "rivals": (_disturbed, _exact),
}
