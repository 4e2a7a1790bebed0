"""What the page says beside each figure: what the paper shows, what is seen here, and how it was made."""

from dataclasses import dataclass

from skills.report.fig_8 import SEEDS
from skills.report.slips import SEED
from skills.report.table_1 import PAPER_PAIRS
from skills.style.disturbance import BUDGET
from skills.style.evaluation import TIE_BREAK

COMMAND = "skills report"
_SEEDS = ", ".join(map(str, SEEDS))
EXACT = "exact: sums of whole cells, 1e-9 mm"


@dataclass(frozen=True)
class Section:
    """One figure of the paper; `made` is command, seed and tolerance."""

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
        "Nearly all of the highest recovered rewards lie on the path: the reward is found. It still does not help. A "
        "state whose reward is positive pays again at every step, for standing still too, so the best policy of that "
        "reward walks to a good cell and stays. Value iteration explores nothing and misses nothing; the question is "
        "wrong, not the search.",
        "none: nothing is drawn at random",
        "rewards 1e-6, counts exact",
    ),
    Section(
        "fig-6",
        "Fig. 6: raw and discretised trajectory",
        "Rounding to 5 mm keeps the features of the user's trajectory.",
        "The error of rounding is about that of a uniform one, 5 mm / sqrt(12) = 1.44 mm along each axis. The user's "
        "own raw recording was not published; of the study only another motion's is, in another place.",
        "none",
        "1e-6 mm",
    ),
    Section(
        "fig-7",
        "Fig. 7: successive passes",
        "One policy, its grid world stacked so that the goal lies at each suture point.",
        "Five passes, each the whole demonstration moved. The spacing is wider than stitches are, so that the passes "
        "can be told apart. The hand-work between passes (M1, M2) is not drawn.",
        "0",
        EXACT,
    ),
    Section(
        "fig-8",
        "Fig. 8: three policies",
        "Three policies of one demonstration, with DTW's lines: slightly different, and the user's trajectory "
        "successfully learnt.",
        "In the paper's state a cell has one best action, so a path that crosses itself cannot be followed, and the "
        "exactly best policy cuts corners: the published policies and ours in that state alike skip most of the "
        "demonstration. With the phase in the state every seed gives the demonstration back, state by state; its DTW "
        "lines have no length. With the authors' published parameters hardly a seed arrives at all. Undisturbed, two "
        "rivals give the demonstration back as well: a replay by its nature, the movement primitive with as many basis "
        "functions as it is shown ticks. They are not drawn; see Rivals.",
        f"{_SEEDS}; the table of seeds: from 0 on",
        EXACT,
    ),
    Section(
        "fig-9",
        "Fig. 9: other starts",
        "A single policy from other starts: x from -25 to -5, y from 50 to 60, z from -130 to -135 mm.",
        "Ten of the range's 30 grid points (the paper does not list its own). Ours joins the path at its nearest state "
        "and follows it from there, so a start beside a later part has a large DTW: that is the part it did not need. "
        "Of several nearest states the replay takes the first, ours may take a later one and then leaves out more. "
        "The first published policy goes round in circles from some of them, (-25, 50, -135) mm among them. The "
        "authors' data of this figure has that start, and its other ways are the first policy's: it is not of a single "
        "policy.",
        "0",
        EXACT,
    ),
    Section(
        "table-1",
        "Table I: mean and standard deviation",
        f"Mean and standard deviation of the dissimilarity of three learnt trajectories along each axis, over "
        f'{PAPER_PAIRS} pairs, and an RMSE of [0.0044, 0.0027, 0.0020] "mm" for the three trajectories.',
        "The RMSE's three numbers are the axes x, y and z, not three trajectories, and they are metres: a thousand "
        "times what is printed. The published policies' totals, 140 + 145 + 145 mm, are Table I's 430 mm. The split "
        "over the axes is no property of the trajectories: many alignments are equally short. Ours is, "
        f"{TIE_BREAK}. The total needs no such rule. The paper's users had less than ten hours of experience: it is a "
        "user's path that is reproduced here, not an expert's.",
        _SEEDS,
        f"{EXACT}; the printed row {3 * 0.0005 * PAPER_PAIRS:.2g} mm, by its rounding",
    ),
    Section(
        "rivals",
        "Rivals: slips",
        "The paper compares its policies with nothing else, and disturbs nothing.",
        "With the probability given, instead of the intended move one of the 27 moves, drawn uniformly, is made. A "
        "run follows where it enters every state of the demonstration in order and ends at the goal; extra moves are "
        "the mean over those runs, DTW (total) and the farthest distance from the path over all runs. Without slips "
        "all but the paper's state follow exactly: a policy is no better than a recording then. With slips it is, for "
        "it looks where it is. A replay of moves never notices. A replay of positions, and the movement primitive, "
        "are pulled to where the clock says: they always arrive, soon, and leave out what they were late for. From "
        "one slip in five moves on, the replay of positions is as near to the path in DTW as ours, or nearer: ours "
        "goes back for what it missed, and where it was pushed too far for that, it stops. A replay that looked where "
        "it is and waited for each position would be our policy.",
        f"{SEED}, the same slips for all",
        f"sampled: the intervals given; by the Markov chain: 1e-9; at most {BUDGET} moves for each state of the path",
    ),
)
