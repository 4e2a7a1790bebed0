"""`skills report`: the paper's Figures 5 to 9 and Table I, redrawn from the pure core, and rivals beside them.

    sources  --compute-->  Numbers  --draw_all-->  PNG
                                    --tables_of-->  tables  --write_page-->  one HTML page

A file for each figure (`fig_5` to `fig_9`, `table_1`, `slips`) computes its numbers; `drawings` draws them, `tables`
and `sections` put them into words, and `page` into HTML. Nothing is asked of a server.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from skills.errors import BadInput
from skills.report.drawings import draw_all
from skills.report.numbers import Effort, compute
from skills.report.page import Part, write_page
from skills.report.sources import ABSENT, paper_source, sample_source
from skills.report.tables import Table, printed_rmse, tables_of

__all__ = ["ABSENT", "Effort", "Report", "write_report"]

PRIVATE = (
    "Some pictures show the paper's data, which was published without a licence: keep this page, and do not pass it on."
)


@dataclass(frozen=True)
class Report:
    """What was written: the page, the pictures beside it, the tables in it, and whether the paper's data was there."""

    page: Path
    numbers: Path
    pictures: tuple[Path, ...]
    tables: tuple[Table, ...]
    has_paper_data: bool


def write_report(
    to: Path, paper_data: Path | None, effort: Effort, tell: Callable[[str], None] = lambda _: None
) -> Report:
    """Compute, draw and write everything into a folder; the same arguments give the same numbers.

    Args:
        to: The folder; it is made.
        paper_data: Where the paper's data is; None: from the sample alone.
        effort: How much to compute.
        tell: Is told what is being done.

    Raises:
        BadInput: `to` is a file, or `paper_data` does not hold the paper's data.
        BadSettings: So much effort cannot be meant.
    """
    if to.exists() and not to.is_dir():
        raise BadInput(f"{to} is a file; name a folder to write the report to.")
    theirs = paper_source(paper_data)
    to.mkdir(parents=True, exist_ok=True)
    parts = []
    for source in (sample_source(), *([theirs] if theirs else [])):
        tell(f"computing and drawing: {source.title} ...")
        numbers = compute(source, effort)
        parts.append(Part(source.title, draw_all(numbers, to), tables_of(numbers)))
    page, data = to / "index.html", to / "numbers.json"
    options = f"--irl-iterations {effort.irl_iterations} --seeds {effort.seeds} --runs {effort.runs}"
    page.write_text(write_page(parts, printed_rmse(), [PRIVATE if theirs else ABSENT], options))
    tables = (printed_rmse(), *(table for part in parts for some in part.tables.values() for table in some))
    data.write_text(json.dumps([asdict(table) for table in tables], indent=1))
    pictures = tuple(picture for part in parts for picture in part.pictures.values())
    return Report(page, data, pictures, tables, theirs is not None)
