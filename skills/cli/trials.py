"""Commands of the JIGSAWS data set: its trials as recordings, and an evaluation of the proposed hand-offs."""

from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

from skills.cli.commands import command
from skills.cli.completion import complete_sutures
from skills.cli.connecting import service
from skills.cli.output import Answer, err, show_table, table, warn
from skills.errors import SkillsError
from skills.remedies import Door

T = TypeVar("T")

commands = typer.Typer()
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors provide on request.")
commands.add_typer(jigsaws, name="jigsaws")

Tasks = Annotated[list[str] | None, typer.Option("--task", help="Only this task, such as Suturing; repeatable.")]


@command(jigsaws, "add")
def jigsaws_add(
    folder: Path,
    task: Tasks = None,
    suture: Annotated[str | None, typer.Option(autocompletion=complete_sutures)] = None,
    arm: Literal["PSM_left", "PSM_right"] | None = None,
    prefix: str = "jigsaws",
) -> Answer:
    """Store every trial of a folder; exit code 1 if one was refused, while the others are stored.

    Args:
        folder: A folder with TASK/kinematics/AllGestures/*.txt, their transcriptions and meta files.
        suture: Make a demonstration of this suture type from each proposed hand-off.
        arm: Only this arm.
        prefix: Prefix of the pseudonyms, before the surgeon's letter.
    """
    from skills.samples import find_trials, send_trials

    found = find_trials(folder, task or ())
    with service() as client:
        worded = partial(SkillsError.words, door=Door.COMMAND)
        sending = send_trials(client, found, suture=suture, arm=arm, prefix=prefix, worded=worded)
        done = [*_tracked(sending, "sending", len(found))]

    def show() -> None:
        rows = [asdict(one) | {"recording": (one.recording or "")[:12], "demos": len(one.demos)} for one in done]
        show_table(rows, ("trial", "surgeon", "skill_level", "score", "recording", "proposed", "demos"))
        warn(*(f"{one.trial}: {problem}" for one in done for problem in one.problems))

    return Answer([asdict(one) for one in done], show, exit_code=1 if any(one.problems for one in done) else 0)


@command(jigsaws, "evaluate")
def jigsaws_evaluate(folder: Annotated[Path, typer.Argument(file_okay=False)], task: Tasks = None) -> Answer:
    """Compare the hand-offs proposed from both hands' motion with the transcribed ones; nothing is stored.

    Args:
        folder: A folder with TASK/kinematics/AllGestures/*.txt.
    """
    from skills.samples import evaluate_hand_offs, find_trials

    found = find_trials(folder, task or ())
    rows = evaluate_hand_offs(_tracked(found, "reading", len(found)))
    columns = ("task", "trials", "left_out", "proposed", "a_trial", "transcribed", "precision", "recall", "brier")
    shown = [{**asdict(row), "a_trial": round(row.a_trial, 1)} for row in rows]
    return table([asdict(row) for row in rows], columns, rows=shown)


def _tracked(items: Iterable[T], doing: str, total: int) -> Iterable[T]:
    """Show a progress bar while items are taken."""
    from rich.progress import track

    return track(items, doing, total=total, console=err, transient=True, disable=not err.is_terminal)
