"""The command that redraws the paper's figures."""

from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from skills.cli.commands import command
from skills.cli.output import Answer, err, say, show_table
from skills.errors import BadInput

commands = typer.Typer()


@command(commands)
def report(
    to: Path = Path("build/report"),
    irl_iterations: Annotated[int, typer.Option(min=1)] = 200,
    seeds: Annotated[int, typer.Option(min=1)] = 200,
    runs: Annotated[int, typer.Option(min=1)] = 1000,
) -> Answer:
    """Redraw the paper's Figures 5 to 9 and Table I, compared with rivals: pictures and one HTML page.

    Args:
        to: The folder to write to.
        irl_iterations: Iterations of maximum-entropy IRL, for Fig. 5.
        seeds: Number of seeds for each learner.
        runs: Runs of each policy and rival, for each probability of a slip.
    """
    if find_spec("movement_primitives") is None:
        raise BadInput(
            "The figures have a movement primitive as a rival, whose library is not installed here.",
            "Install the extra 'report': pip install 'suture-skills[report]'",
        )
    from skills.report import write_report
    from skills.report.numbers import ABSENT, Effort
    from skills.settings import settings

    with err.status("...") as status:
        effort = Effort(irl_iterations=irl_iterations, seeds=seeds, runs=runs)
        written = write_report(to, settings().paper_data, effort, status.update)
    if not written.has_paper_data:
        err.print(ABSENT, soft_wrap=True)

    def show() -> None:
        for one in written.tables:
            say(f"\n{one.caption}")
            show_table([dict(zip(one.columns, row, strict=True)) for row in one.rows], one.columns)
        say(f"\n{len(written.pictures)} pictures and the page: {written.page}")

    return Answer([asdict(one) for one in written.tables], show)
