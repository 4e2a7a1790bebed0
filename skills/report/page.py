"""The report as one HTML page: its text, pictures as data URIs, no script, nothing from another address.

The text of each figure states the paper's claim, our observation, and the command, seed and tolerance.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from skills.learning.evaluation import TIE_BREAK
from skills.learning.slip import BUDGET
from skills.report.figures import SEEDS
from skills.report.numbers import PAPER_PAIRS
from skills.report.rivals import SEED
from skills.report.tables import Table

COMMAND = "skills report"
_SEEDS = ", ".join(map(str, SEEDS))
EXACT = "exact: sums of whole cells, 1e-9 mm"


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
