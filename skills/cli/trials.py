"""Commands of the JIGSAWS data set: its trials as recordings, and an evaluation of the proposed hand-offs."""

from collections.abc import Iterable
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

from skills.cli.commands import command
from skills.cli.completion import complete_sutures
from skills.cli.connecting import service
from skills.cli.output import Answer, err, say, show_table, table, warn
from skills.errors import SkillsError
from skills.remedies import Door

T = TypeVar("T")

commands = typer.Typer()
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors provide on request.")
commands.add_typer(jigsaws, name="jigsaws")

Folder = Annotated[Path, typer.Argument(file_okay=False)]
Primitives = Annotated[Path | None, typer.Option(exists=True, file_okay=False)]
Tasks = Annotated[list[str] | None, typer.Option("--task", help="Only this task, such as Suturing; repeatable.")]


@command(jigsaws, "add")
def jigsaws_add(
    folder: Path,
    task: Tasks = None,
    suture: Annotated[str | None, typer.Option(autocompletion=complete_sutures)] = None,
    arm: Literal["PSM_left", "PSM_right"] | None = None,
    prefix: str = "jigsaws",
    primitives: Primitives = None,
) -> Answer:
    """Store every trial of a folder; exit code 1 if one was refused, while the others are stored.

    Args:
        folder: A folder with TASK/kinematics/AllGestures/*.txt, their transcriptions, motion primitives and meta files.
        suture: Make a demonstration of this suture type from each proposed hand-off.
        arm: Only this arm.
        prefix: Prefix of the pseudonyms, before the surgeon's letter.
        primitives: Folder of the motion primitives, such as those of COMPASS; TASK/motion_primitives by default.
    """
    from skills.samples import find_trials, send_trials

    found = find_trials(folder, task or (), primitives)
    with service() as client:
        worded = partial(SkillsError.words, door=Door.COMMAND)
        sending = send_trials(client, found, suture=suture, arm=arm, prefix=prefix, worded=worded)
        done = [*_tracked(sending, "sending", len(found))]

    def show() -> None:
        rows = [asdict(one) | {"recording": (one.recording or "")[:12], "demos": len(one.demos)} for one in done]
        show_table(rows, ("trial", "surgeon", "skill_level", "score", "recording", "proposed", "demos"))
        warn(*(f"{one.trial}: {problem}" for one in done for problem in one.problems))
        say(*(f"{one.trial}, left out: {part}" for one in done for part in one.left_out))

    return Answer([asdict(one) for one in done], show, exit_code=1 if any(one.problems for one in done) else 0)


@command(jigsaws, "evaluate")
def jigsaws_evaluate(folder: Folder, task: Tasks = None, primitives: Primitives = None) -> Answer:
    """Compare what is proposed from both hands' motion with transcriptions and motion primitives; nothing is stored.

    Hand-offs are compared with transcribed gestures, transfers from hand to hand with the changes of hands in motion
    primitives, beside the rule that every opening of a jaw is one.

    Args:
        folder: A folder with TASK/kinematics/AllGestures/*.txt.
        primitives: Folder of the motion primitives, such as those of COMPASS; TASK/motion_primitives by default.
    """
    from skills.samples import NO_LABELS, Evaluated, evaluate_hand_offs, find_trials

    found = find_trials(folder, task or (), primitives)
    rows = evaluate_hand_offs(_tracked(found, "reading", len(found)))
    why = (f"{row.task}: {NO_LABELS}" for row in rows if row.labels is None)
    return table([asdict(row) for row in rows], [one.name for one in fields(Evaluated)], *why)


def _tracked(items: Iterable[T], doing: str, total: int) -> Iterable[T]:
    """Show a progress bar while items are taken."""
    from rich.progress import track

    return track(items, doing, total=total, console=err, transient=True, disable=not err.is_terminal)
