"""The paper redrawn."""

from pathlib import Path
from typing import Annotated

import typer

from skills.cli.shell import AsJson, err, out, refusing, show

commands = typer.Typer()


@commands.command()
@refusing
def report(
    to: Annotated[Path, typer.Option(help="The folder to write to.")] = Path("build/report"),
    irl_iterations: Annotated[int, typer.Option(min=1, help="Of maximum-entropy IRL, for Fig. 5.")] = 200,
    seeds: Annotated[int, typer.Option(min=1, help="Try each learner on this many seeds.")] = 200,
    runs: Annotated[int, typer.Option(min=1, help="Of each policy and rival, for each probability of a slip.")] = 1000,
    as_json: AsJson = False,
) -> None:
    """Redraw the paper's Figures 5 to 9 and Table I, with rivals beside them: pictures and one HTML page."""
    from skills.report import ABSENT, Effort, write_report
    from skills.settings import settings

    with err.status("...") as status:
        effort = Effort(irl_iterations=irl_iterations, seeds=seeds, runs=runs)
        written = write_report(to, settings().paper_data, effort, status.update)
    if not written.has_paper_data:
        err.print(ABSENT, soft_wrap=True)
    if as_json:
        out.print(written.numbers.read_text(), markup=False, soft_wrap=True)
        return
    for one in written.tables:
        out.print(f"\n{one.caption}", markup=False, soft_wrap=True)
        show([dict(zip(one.columns, row, strict=True)) for row in one.rows], False, one.columns)
    out.print(f"\n{len(written.pictures)} pictures and the page: {written.page}", soft_wrap=True)
