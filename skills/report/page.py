"""The report's numbers as tables, and the report as one HTML page: text, tables, and pictures as data URIs.

The tables are for the page, for programs and for the terminal; nothing is computed here. The page has no script and
loads nothing from another address. The text of each figure states the paper's claim, our observation, and the command,
seed and tolerance.
"""

from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from skills.arithmetic import wilson
from skills.gridworld import paper
from skills.learning.evaluation import TIE_BREAK, measure
from skills.learning.slip_runs import BUDGET
from skills.report.numbers import PAPER_PAIRS, SEEDS, Numbers, Row, Triple, as_printed
from skills.report.rivals import SEED

Cell = str | int | float
COMMAND = "skills report"
_SEEDS = ", ".join(map(str, SEEDS))
EXACT = "exact: sums of whole cells, 1e-9 mm"


@dataclass(frozen=True)
class Table:
    """A caption, named columns, and rows; `name` is unique on the page."""

    name: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        assert len(set(self.columns)) == len(self.columns), "rows become objects by the names of their columns"


def tables_of(numbers: Numbers) -> dict[str, tuple[Table, ...]]:
    """Return all numbers of a source as tables, by figure."""
    return {figure: tuple(write(numbers) for write in writers) for figure, writers in WRITERS.items()}


def _fig_5(numbers: Numbers) -> Table:
    told = numbers.fig_5
    rows: tuple[tuple[Cell, ...], ...] = (
        ("iterations of IRL", told.iterations),
        ("negative log-likelihood of the demonstration, all rewards 0 (nat per move)", round(told.nats[0], 4)),
        ("the same with the recovered reward", round(told.nats[1], 4)),
        (f"of the {told.visited} highest recovered rewards, on visited states", told.found),
        ("starts from which value iteration on it reaches the goal, of 1331", told.starts_reaching),
        ("from the demonstrated start it", "reaches the goal" if told.walk.finished else _stops(numbers)),
    )
    return _named("fig-5", numbers, "The recovered reward", ("what", "value"), rows)


def _stops(numbers: Numbers) -> str:
    walk = numbers.fig_5.walk
    still = len(walk.states) > 1 and walk.states[-1] == walk.states[-2]
    moves = len(set(walk.states.tolist())) - 1
    return f"{'stands still' if still else 'goes round in circles'} after {moves} move{'' if moves == 1 else 's'}"


def _fig_6(numbers: Numbers) -> Table:
    told = numbers.fig_6
    rows: tuple[tuple[Cell, ...], ...] = (
        ("samples", told.samples),
        ("cell (mm)", told.cell_mm),
        ("states", told.states),
        ("states visited before", told.revisits),
        ("states that no sample lies in", told.bridged),
        ("RMSE of the samples, x, y, z (mm)", _xyz(told.rmse_mm)),
    )
    caption = (
        "The raw recording (another motion of the study)" if numbers.source.recorded_elsewhere else "The recording"
    )
    return _named("fig-6", numbers, caption, ("what", "value"), rows)


def _fig_7(numbers: Numbers) -> Table:
    told = numbers.fig_7
    passes = zip(told.points_mm.tolist(), told.passes_mm, strict=True)
    rows = ((number, _xyz(point), len(tip), _xyz(tip[-1].tolist())) for number, (point, tip) in enumerate(passes, 1))
    caption = f"Five passes, at most {told.worst_miss_mm:g} mm from the demonstration moved there"
    return _named("fig-7", numbers, caption, ("pass", "suture point (mm)", "states", "ends at (mm)"), rows)


def _fig_8(numbers: Numbers) -> Table:
    rows = (
        (
            one.by,
            one.which,
            "yes" if one.rollout.finished else "no",
            len(one.rollout.states),
            one.exact_states,
            one.dtw_total_mm,
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
    rows = (
        (
            _xyz(one.start_mm),
            "yes" if one.ours.finished else "no",
            one.joins_at,
            one.dtw_total_mm,
            *("yes" if way.finished else "no" for way in one.published),
            *(measure(one.replayed).dtw_total_mm, measure(one.primitive).dtw_total_mm),
            "yes" if one.primitive.finished else "no",
        )
        for one in numbers.fig_9
    )
    ours = ("ours arrives", "joins the path at its state", "DTW of ours (mm)")
    rivals = ("DTW of the replay (mm)", "DTW of the movement primitive (mm)", "it arrives")
    columns = ("start (mm)", *ours, *theirs, *rivals)
    return _named("fig-9", numbers, "Ten starts in the printed range", columns, rows)


def _range(numbers: Numbers) -> Table:
    rows = ((one.by, one.starts, one.arriving) for one in numbers.arriving)
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
    rows = (
        (_of(one), "xyz"[axis], round(one.sum_mm[axis], 3), _at(one.least_mm, axis), _at(one.most_mm, axis))
        for one in numbers.table_1
        for axis in range(3)
    )
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


def _at(ends: Triple | None, axis: int) -> Cell:
    return "not known" if ends is None else ends[axis]


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


# ---- the page ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Section:
    """One figure of the paper: its claim, our observation, and the seed and tolerance of our numbers."""

    name: str
    title: str
    paper: str
    here: str
    seed: str
    tolerance: str


SECTIONS = (
    Section(
        "fig-5",
        "Fig. 5: reward functions",
        "Maximum-entropy IRL (left) and the sparse reward (right). The paper sees no relation between its IRL reward "
        "and the path, and blames a lack of exploration for the failure of value iteration on it.",
        "Nearly all of the highest recovered rewards are on the path: the reward is recovered. It still does not "
        "help. A positive reward of a state is paid at every step, also for standing still, so the optimal "
        "policy of that reward moves to a good cell and stays there. Value iteration does not explore and is "
        "exact; the fault is in the formulation, not in the search.",
        "none: nothing is drawn at random",
        "rewards 1e-6, counts exact",
    ),
    Section(
        "fig-6",
        "Fig. 6: raw and discretised trajectory",
        "Rounding to 5 mm keeps the features of the user's trajectory.",
        "The error of rounding is about that of a uniform one, 5 mm / sqrt(12) = 1.44 mm along each axis. The "
        "user's own raw recording was not published; of the study, only the recording of another motion at "
        "another place was published.",
        "none",
        "1e-6 mm",
    ),
    Section(
        "fig-7",
        "Fig. 7: successive passes",
        "One policy, its grid world stacked so that the goal lies at each suture point.",
        "Five passes, each the whole demonstration moved. The spacing is wider than that of stitches, so that "
        "the passes can be distinguished. The hand-work between passes (M1, M2) is not drawn.",
        "0",
        EXACT,
    ),
    Section(
        "fig-8",
        "Fig. 8: three policies",
        "Three policies of one demonstration, with DTW's lines: slightly different, and the user's trajectory "
        "successfully learnt.",
        "In the paper's state a cell has one best action, so a path that crosses itself cannot be followed, and "
        "the optimal policy cuts corners: the published policies and ours in that state both skip most of the "
        "demonstration. With the phase in the state every seed reproduces the demonstration, state by state; its "
        "DTW lines have length 0. With the authors' published parameters hardly any seed reaches the goal. "
        "Undisturbed, two rivals reproduce the demonstration as well: a replay by definition, the movement "
        "primitive with as many basis functions as the demonstration has ticks. They are not drawn; see Rivals.",
        f"{_SEEDS}; the table of seeds: from 0 on",
        EXACT,
    ),
    Section(
        "fig-9",
        "Fig. 9: other starts",
        "A single policy from other starts: x from -25 to -5, y from 50 to 60, z from -130 to -135 mm.",
        "Ten of the range's 30 grid points (the paper does not list its own). Ours joins the path at its nearest "
        "state and follows it from there, so a start near a later part has a large DTW: the skipped part. Of "
        "several nearest states the replay takes the first; ours may take a later one and then skips more. The "
        "first published policy cycles from some of them, (-25, 50, -135) mm among them. The authors' data of "
        "this figure has that start, and its other paths are those of the first policy: it is not from a single "
        "policy.",
        "0",
        EXACT,
    ),
    Section(
        "table-1",
        "Table I: mean and standard deviation",
        f"Mean and standard deviation of the dissimilarity of three learnt trajectories along each axis, over "
        f'{PAPER_PAIRS} pairs, and an RMSE of [0.0044, 0.0027, 0.0020] "mm" for the three trajectories.',
        "The RMSE's three numbers are the axes x, y and z, not three trajectories, and they are metres: a "
        "thousand times the printed values. The published policies' totals, 140 + 145 + 145 mm, are Table I's "
        "430 mm. The split over the axes is not a property of the trajectories: many alignments are equally "
        f"short. Ours is, {TIE_BREAK}. The total needs no such rule. The paper's users had less than ten hours of "
        "experience: the reproduced path is that of a user, not of an expert.",
        _SEEDS,
        f"{EXACT}; the printed row {3 * 0.0005 * PAPER_PAIRS:.2g} mm, by its rounding",
    ),
    Section(
        "rivals",
        "Rivals: slips",
        "The paper does not compare its policies with other methods, and does not disturb them.",
        "With the stated probability, one of the 27 moves, drawn uniformly, replaces the intended move. A run "
        "follows the demonstration if it enters every state of it in order and ends at the goal; extra moves are "
        "the mean over those runs, DTW (total) and the farthest distance from the path over all runs. Without "
        "slips all but the paper's state follow exactly: then a policy is no better than a recording. With slips "
        "it is better, because it observes its state. A replay of moves does not notice a slip. A replay of "
        "positions, and the movement primitive, follow the clock: they always reach the goal, soon, and skip the "
        "states for which they are late. From one slip in five moves on, the replay of positions is as near to "
        "the path in DTW as ours, or nearer: ours returns to the states that it missed, and stops if it was "
        "pushed too far for that. A replay that observed its state and waited for each position would be our "
        "policy.",
        f"{SEED}, the same slips for all",
        f"sampled: the stated intervals; by the Markov chain: 1e-9; at most {BUDGET} moves for each state of the path",
    ),
)


STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 76rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 3rem; border-top: 1px solid #d0d7de; padding-top: 1.5rem; }
p { max-width: 48rem; } img { max-width: 100%; height: auto; }
table { border-collapse: collapse; margin: 1rem 0; } caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { border-bottom: 1px solid #d0d7de; padding: .25rem .8rem .25rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
.made { color: #57606a; font-size: .9rem; } .notice { border-left: 4px solid #d55e00; padding-left: .8rem; }
nav a { margin-right: 1rem; } .wide { overflow-x: auto; }
"""
# The page may fetch nothing, also when it is opened from a file or another server.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Chapter:
    """The content of one source for the page: its title, and a picture and the tables of each figure."""

    title: str
    pictures: Mapping[str, Path]
    tables: Mapping[str, Sequence[Table]]


def write_page(parts: Sequence[Chapter], printed: Table, notices: Sequence[str], options: str) -> str:
    """Return the HTML of the page.

    Args:
        parts: One for each source, the paper's own after the sample.
        printed: The table of the printed RMSE, which does not depend on a source.
        notices: Sentences at the top of the page.
        options: The command's options, shown so that the page can be reproduced.
    """
    links = " ".join(f'<a href="#{one.name}">{escape(one.title.split(":")[0])}</a>' for one in SECTIONS)
    body = "".join(_section(one, parts, printed, options) for one in SECTIONS)
    told = "".join(f'<p class="notice">{escape(one)}</p>' for one in notices)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f'<meta name="viewport" content="width=device-width"><title>The paper, redrawn</title>'
        f"<style>{STYLE}</style></head><body><h1>The paper, redrawn</h1>"
        "<p>Collaborative Suturing: A Reinforcement Learning Approach to Automate Hand-off Task in Suturing for "
        "Surgical Robots: its Figures 5 to 9 and Table I, computed again, with two comparisons which it lacks: two "
        "rivals, and arms that slip. Research use only.</p>"
        "<p>Axes are in mm in the frame of the arm's base, and not to one scale.</p>"
        f"{told}<nav>{links}</nav>{body}</body></html>\n"
    )


def _section(section: Section, parts: Sequence[Chapter], printed: Table, options: str) -> str:
    tables = [printed] if section.name == "table-1" else []
    drawn = "".join(_part(section, one) for one in parts)
    made = f"Command: {COMMAND} {options}. Seed: {section.seed}. Tolerance: {section.tolerance}."
    return (
        f'<section id="{section.name}"><h2>{escape(section.title)}</h2>'
        f"<p><b>The paper:</b> {escape(section.paper)}</p><p><b>Here:</b> {escape(section.here)}</p>"
        f'<p class="made">{escape(made)}</p>{"".join(map(_table, tables))}{drawn}</section>'
    )


def _part(section: Section, part: Chapter) -> str:
    picture = part.pictures.get(section.name)
    image = "" if picture is None else _image(picture, f"{section.title}, {part.title}")
    return f"<h3>{escape(part.title)}</h3>{image}" + "".join(map(_table, part.tables[section.name]))


def _image(picture: Path, alt: str) -> str:
    data = b64encode(picture.read_bytes()).decode()
    return f'<img alt="{escape(alt, quote=True)}" src="data:image/png;base64,{data}">'


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.columns)
    rows = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in table.rows)
    return (
        f'<div class="wide"><table id="{table.name}"><caption>{escape(table.caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _cell(value: str | int | float) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    return f'<td class="number">{value:g}</td>'
