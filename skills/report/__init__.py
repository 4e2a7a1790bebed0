"""`skills report`: the paper's Figures 5 to 9 and Table I, computed and drawn from the pure core, with rivals.

    sources  --compute-->  Numbers  --draw_all-->  PNG
                                    --tables_of-->  tables  --write_page-->  one HTML page

`rivals` computes the numbers of the rivals, `numbers` those of the figures and of Table I and all of them together;
`figures` draws them, `summary` formats them as tables, and `page` adds the text and writes HTML. No server is needed.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from skills.errors import BadInput
from skills.report.numbers import ABSENT, Effort, compute, paper_source, sample_source
from skills.report.page import Chapter, write_page
from skills.report.summary import Table, printed_rmse, tables_of

__all__ = ["ABSENT", "Effort", "Report", "write_report"]

PRIVATE = "Some pictures show the paper's data, which was published without a licence: do not distribute this page."


@dataclass(frozen=True)
class Report:
    """The written files: the page, the pictures of it, the tables in it, and whether the paper's data was available."""

    page: Path
    numbers: Path
    pictures: tuple[Path, ...]
    tables: tuple[Table, ...]
    has_paper_data: bool


def write_report(
    to: Path, paper_data: Path | None, effort: Effort, tell: Callable[[str], None] = lambda _: None
) -> Report:
    """Compute, draw and write the report into a folder; the same arguments give the same numbers.

    Args:
        to: The folder, which is created.
        paper_data: Folder of the paper's data; None: use the sample alone.
        effort: The amount of computation.
        tell: Callback with a line of progress.

    Raises:
        BadInput: `to` is a file, or `paper_data` does not hold the paper's data.
        BadSettings: The effort is impossible, such as 0 iterations.
    """
    if to.exists() and not to.is_dir():
        raise BadInput(f"{to} is a file; name a folder to write the report to.")
    from skills.report.figures import draw_all  # here, because it imports matplotlib

    theirs = paper_source(paper_data)
    to.mkdir(parents=True, exist_ok=True)
    parts = []
    for source in (sample_source(), *([theirs] if theirs else [])):
        tell(f"computing and drawing: {source.title} ...")
        numbers = compute(source, effort)
        parts.append(Chapter(source.title, draw_all(numbers, to), tables_of(numbers)))
    page, data = to / "index.html", to / "numbers.json"
    options = f"--irl-iterations {effort.irl_iterations} --seeds {effort.seeds} --runs {effort.runs}"
    page.write_text(write_page(parts, printed_rmse(), [PRIVATE if theirs else ABSENT], options))
    tables = (printed_rmse(), *(table for part in parts for some in part.tables.values() for table in some))
    data.write_text(json.dumps([asdict(table) for table in tables], indent=1))
    pictures = tuple(picture for part in parts for picture in part.pictures.values())
    return Report(page, data, pictures, tables, theirs is not None)
