"""Commands of demonstrations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.commands import AsJson, OfSurgeon, OfSuture, ToFile, command, on_terminal, parse_segment
from skills.cli.connecting import service
from skills.cli.output import Answer, bar, outcome, show_table, table, text, written
from skills.cli.uploading import OneEpisode, RecordingPath, Tool, ready_one
from skills.errors import BadInput
from skills.keywords import DemoKeywords, TableKeywords

if TYPE_CHECKING:
    from skills.client import Problem
    from skills.schemas.demos import Demonstration

commands = typer.Typer()
demos = typer.Typer(no_args_is_help=True, help="Demonstrations: one hand-off each.")
commands.add_typer(demos, name="demo")

Demo = Annotated[str, typer.Argument(help="The demonstration's digest.")]
COLUMNS = ("id", "surgeon", "suture", "arm", "state", "outcome", "created_at")


@command(demos, "add")
def demo_add(
    path: RecordingPath,
    cut: DemoKeywords,
    table: TableKeywords,
    proposal: int | None = None,
    episode: OneEpisode = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> Answer:
    """Store a recording and one demonstration of it; if several hand-offs are proposed, name one with --segment.

    Args:
        proposal: The same as --segment with a number.
    """
    from skills.client import Problem

    if proposal is not None:
        if "segment" in cut:
            raise BadInput("Use --segment or --proposal, not both.")
        cut["segment"] = proposal
    with service() as client, ready_one(path, table, episode, tool) as (file, progress):
        try:
            added = client.add_demo(file, progress=progress, **cut, **table)
        except Problem as problem:
            # a program has to name the segment; only a user at a terminal is prompted
            if problem.kind != "segment-not-named" or as_json:
                raise
            cut["segment"] = _choose(problem)
            added = client.add_demo(file, progress=progress, **cut, **table)
    taken = added.segment
    return measured(added, f"Taken: {taken.taken}, {taken.start_s:.2f} to {taken.end_s:.2f} s; {taken.because}")


def _choose(problem: "Problem") -> int | Literal["whole"]:
    """List the proposed hand-offs, and ask which one is meant; without a terminal raise the refusal."""
    from skills.schemas.results import ProposedSegments

    proposed = ProposedSegments.of(problem.numbers).segments
    rows = [vars(one) | {"start_s": f"{one.start_s:.2f}", "end_s": f"{one.end_s:.2f}"} for one in proposed]
    show_table(rows, ("segment", "arm", "start_s", "end_s", "reason"))
    if not on_terminal():
        raise problem
    return parse_segment(typer.prompt("Which one? A number, or whole", err=True).strip())


def measured(demo: "Demonstration", *sentences: str) -> Answer:
    """Return the answer that shows a demonstration with its measurements, and further sentences."""
    x, y, z = demo.report.discretisation_rmse_mm
    loss = f"{x:.2f}, {y:.2f}, {z:.2f} mm off their cells along x, y, z (RMSE)"
    columns = ("id", "surgeon", "suture", "arm", "frame", "report.path_states")
    return table(demo, columns, f"{demo.report.revisits} crossings; samples are {loss}", *sentences)


@command(demos, "list")
def demo_list(
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    outcome: Literal["success", "recovery", "failure", "unknown"] | None = None,
) -> Answer:
    """List demonstrations, the newest first.

    Args:
        outcome: Only those marked so.
    """
    with service() as client:
        return table(client.demos(surgeon, suture, outcome=outcome), COLUMNS)


@command(demos, "show")
def demo_show(demo: Demo) -> Answer:
    """Show a demonstration, with the figures measured when it was stored."""
    with service() as client:
        shown = client.demo(demo)
    place = f"{shown.state}, {shown.start_s:.2f} to {shown.end_s:.2f} s of {shown.recording}"
    return measured(shown, place, *_outcome(shown))


@command(demos, "report")
def demo_report(demo: Demo, html: Path | None = None) -> Answer:
    """Report the quality of a demonstration, and how to improve it.

    Args:
        html: Write the report to this file as HTML.
    """
    with service() as client:
        if html is not None:
            html.write_bytes(client.demo_report_page(demo))
            return written(html)
        reported = client.demo_report(demo)
    return measured(reported, *(f"- {sentence}" for sentence in reported.report.advice))


@command(demos, "save")
def demo_save(demo: Demo, to: ToFile) -> Answer:
    """Write the recording of a demonstration to a file, exactly as it was uploaded."""
    with service() as client, bar("fetching") as progress:
        client.save_recording(demo, to, progress)
    return written(to)


@command(demos, "mark")
def demo_mark(demo: Demo, outcome: Literal["success", "recovery", "failure"], reason: str | None = None) -> Answer:
    """Mark a demonstration; a recovery or a failure is not learnt from, and releases that rest on it are withdrawn.

    Args:
        outcome: What became of the hand-off.
        reason: Why; needed for a recovery or a failure.
    """
    with service() as client:
        marked = client.mark_demo(demo, outcome, reason=reason)
    return text(marked, *_outcome(marked))


def _outcome(demo: "Demonstration") -> list[str]:
    if demo.outcome is None:
        return []
    return [f"marked {demo.outcome}" + ("" if demo.outcome_reason is None else f": {demo.outcome_reason}")]


@command(demos, "withdraw")
def demo_withdraw(demo: Demo, erase: bool = False) -> Answer:
    """Withdraw a demonstration and the releases that rest on it.

    Args:
        erase: Delete it and everything derived from it.
    """
    with service() as client:
        client.withdraw_demo(demo, erase=erase)
    done = "erased" if erase else "withdrawn"
    return outcome(f"The demonstration is {done}, and no release depends on it.", demo=demo, state=done)
