"""The report as one HTML page, from the template beside this module: text, tables, and pictures as data URIs.

The text of each figure states the paper's claim, our observation, and the command, seed and tolerance.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from skills.learning.evaluation import TIE_BREAK
from skills.learning.slip_runs import BUDGET
from skills.report.numbers import PAPER_PAIRS, SEEDS
from skills.report.rivals import SEED
from skills.report.summary import Table

ROUNDING_MM = 0.0005  # of a number in the printed Table I


@dataclass(frozen=True)
class Chapter:
    """The content of one source for the page: its title, and a picture and the tables of each figure."""

    title: str
    pictures: Mapping[str, Path]
    tables: Mapping[str, Sequence[Table]]


def write_page(chapters: Sequence[Chapter], printed: Table, notices: Sequence[str], options: str) -> str:
    """Return the HTML of the page.

    Args:
        chapters: One for each source, the paper's own after the sample.
        printed: The table of the printed RMSE, which does not depend on a source.
        notices: Sentences at the top of the page.
        options: The command's options, shown so that the page can be reproduced.
    """
    templates = Environment(loader=PackageLoader("skills.report", ""), autoescape=True, undefined=StrictUndefined)
    return templates.get_template("page.html").render(
        chapters=chapters,
        printed=printed,
        notices=notices,
        options=options,
        base64=lambda picture: b64encode(picture.read_bytes()).decode(),
        seeds=", ".join(map(str, SEEDS)),
        slip_seed=SEED,
        pairs=PAPER_PAIRS,
        rounding=f"{3 * ROUNDING_MM * PAPER_PAIRS:.2g}",
        tie_break=TIE_BREAK,
        budget=BUDGET,
    )
