"""Recordings and demonstrations."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.completing import surgeons, sutures
from skills.cli.shell import AsJson, OfSurgeon, OfSuture, bar, err, out, print_json, refusing, service, show
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.api.schemas.given import Demonstration, Recording
    from skills.client import Progress

commands = typer.Typer()
recordings = typer.Typer(no_args_is_help=True, help="Raw recordings.")
demos = typer.Typer(no_args_is_help=True, help="Demonstrations: one hand-off each.")
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors give on request.")
commands.add_typer(recordings, name="recording")
commands.add_typer(demos, name="demo")
commands.add_typer(jigsaws, name="jigsaws")

RateHz = Annotated[float | None, typer.Option(help="Samples per second, for a table without times.")]
Frame = Annotated[str | None, typer.Option(help="The frame of a table's positions; PSM_base where none is given.")]
RecordingPath = Annotated[
    Path, typer.Argument(help="A recording, a bag folder, or a session's folder with one; pictures stay here.")
]
Demo = Annotated[str, typer.Argument(help="The demonstration's digest.")]

ABOUT = ("id", "surgeon", "suture", "arm", "state", "created_at")


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, "Progress"]]:
    """Make the recording that a path means ready to be sent: the file to send, and what is told of bytes sent."""
    from skills.recordings.folder import find_bag, ready_to_send

    bag = find_bag(path)
    read = 0
    with bar("reading") as reading:

        def advance(count: int) -> None:
            nonlocal read
            read += count
            reading(read, bag.size_bytes)

        with ready_to_send(bag, advance) as file, bar("sending") as sending:
            yield file, sending


@recordings.command("add")
@refusing
def recording_add(path: RecordingPath, rate_hz: RateHz = None, frame: Frame = None, as_json: AsJson = False) -> None:
    """Store a recording and see which hand-offs it seems to hold."""
    with service() as client, ready(path) as (file, progress):
        stored = client.add_recording(file, rate_hz=rate_hz, frame=frame, progress=progress)
    _tell(stored, as_json)


@recordings.command("show")
@refusing
def recording_show(
    recording: Annotated[str, typer.Argument(help="The recording's digest.")], as_json: AsJson = False
) -> None:
    """Show what is in a recording, and the hand-offs that it seems to hold."""
    with service() as client:
        _tell(client.recording(recording), as_json)


def _tell(stored: "Recording", as_json: bool) -> None:
    if as_json:
        print_json(stored)
        return
    about = f"{stored.format}, {stored.duration_s:.1f} s, integrity {stored.integrity}"
    out.print(f"{stored.sha256}  {about}", soft_wrap=True)
    for name, value in stored.notes.items():
        out.print(f"{name}: {value}", markup=False, soft_wrap=True)
    show(stored.segments, False, ("arm", "start_s", "end_s", "reason"))


@demos.command("add")
@refusing
def demo_add(
    path: RecordingPath,
    surgeon: Annotated[str, typer.Option(autocompletion=surgeons)],
    suture: Annotated[str, typer.Option(autocompletion=sutures)],
    arm: Annotated[str | None, typer.Option(help="Needed where a recording has several arms.")] = None,
    topic: Annotated[str | None, typer.Option()] = None,
    start_s: Annotated[float | None, typer.Option(help="Start of the hand-off in the recording.")] = None,
    end_s: Annotated[float | None, typer.Option(help="Its end.")] = None,
    proposal: Annotated[int | None, typer.Option(help="Take this proposed hand-off, counted from 1.")] = None,
    grid: Annotated[Literal["auto", "paper", "fit"], typer.Option(help="auto, paper or fit.")] = "auto",
    cell_mm: Annotated[float | None, typer.Option()] = None,
    hysteresis: Annotated[
        float, typer.Option(help="How far beyond its cell a sample stays in it: 0 to 0.5 cells, 0.25 against tremor.")
    ] = 0.0,
    session: Annotated[str | None, typer.Option()] = None,
    rate_hz: RateHz = None,
    frame: Frame = None,
    as_json: AsJson = False,
) -> None:
    """Store a recording and one demonstration of it."""
    with service() as client, ready(path) as (file, progress):
        if proposal is None:
            added = client.add_demo(
                file,
                surgeon=surgeon,
                suture=suture,
                arm=arm,
                topic=topic,
                start_s=start_s,
                end_s=end_s,
                grid=grid,
                cell_mm=cell_mm,
                hysteresis=hysteresis,
                session=session,
                rate_hz=rate_hz,
                frame=frame,
                progress=progress,
            )
        else:
            stored = client.add_recording(file, rate_hz=rate_hz, frame=frame, progress=progress)
            proposed = [part for part in stored.segments if arm in (None, part.arm)]
            if not 1 <= proposal <= len(proposed):
                raise BadInput(f"The recording has {len(proposed)} proposed hand-offs; see `skills recording add`.")
            part = proposed[proposal - 1]
            added = client.cut_demo(
                stored.sha256,
                surgeon=surgeon,
                suture=suture,
                arm=part.arm,
                topic=topic,
                start_s=part.start_s,
                end_s=part.end_s,
                grid=grid,
                cell_mm=cell_mm,
                hysteresis=hysteresis,
                session=session,
            )
    _measured(added, as_json)


def _measured(demo: "Demonstration", as_json: bool) -> None:
    show(demo, as_json, ("id", "surgeon", "suture", "arm", "frame", "report.path_states"))
    if not as_json:
        x, y, z = demo.report.discretisation_rmse_mm
        loss = f"{x:.2f}, {y:.2f}, {z:.2f} mm off their cells along x, y, z (RMSE)"
        out.print(f"{demo.report.revisits} crossings; samples are {loss}")


@demos.command("list")
@refusing
def demo_list(surgeon: OfSurgeon = None, suture: OfSuture = None, as_json: AsJson = False) -> None:
    """List demonstrations, the newest first."""
    with service() as client:
        show(client.demos(surgeon, suture), as_json, ABOUT)


@demos.command("show")
@refusing
def demo_show(demo: Demo, as_json: AsJson = False) -> None:
    """Show a demonstration, and what was measured of it when it was stored."""
    with service() as client:
        shown = client.demo(demo)
    _measured(shown, as_json)
    if not as_json:
        out.print(f"{shown.state}, {shown.start_s:.2f} to {shown.end_s:.2f} s of {shown.recording}", soft_wrap=True)


@demos.command("report")
@refusing
def demo_report(
    demo: Demo,
    html: Annotated[Path | None, typer.Option(help="Write it to this file as a page for a browser.")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell how good a demonstration is, and what would make it better."""
    with service() as client:
        if html is not None:
            html.write_bytes(client.demo_report_page(demo))
            _written(html, as_json)
            return
        measured = client.demo_report(demo)
    _measured(measured, as_json)
    if not as_json:
        for sentence in measured.report.advice:
            out.print(f"- {sentence}", markup=False, soft_wrap=True)


@demos.command("save")
@refusing
def demo_save(demo: Demo, to: Annotated[Path, typer.Argument(dir_okay=False)], as_json: AsJson = False) -> None:
    """Write the recording of a demonstration to a file, exactly as it was sent."""
    with service() as client, bar("fetching") as progress:
        client.save_recording(demo, to, progress)
    _written(to, as_json)


def _written(to: Path, as_json: bool) -> None:
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: {to.stat().st_size / 1e6:.1f} MB.", soft_wrap=True)


@demos.command("withdraw")
@refusing
def demo_withdraw(
    demo: Demo,
    erase: Annotated[bool, typer.Option("--erase", help="Delete it and all that was derived from it.")] = False,
    as_json: AsJson = False,
) -> None:
    """Withdraw a demonstration and the releases that rest on it."""
    with service() as client:
        client.withdraw_demo(demo, erase=erase)
    done = "erased" if erase else "withdrawn"
    if as_json:
        print_json({"demo": demo, "state": done})
    else:
        out.print(f"The demonstration is {done}, and no release rests on it.")


@jigsaws.command("add")
@refusing
def jigsaws_add(
    folder: Annotated[Path, typer.Argument(help="With TASK/kinematics/AllGestures/*.txt and what belongs to them.")],
    task: Annotated[list[str] | None, typer.Option(help="Only this task, such as Suturing; once for each.")] = None,
    suture: Annotated[
        str | None,
        typer.Option(help="Make demonstrations of this suture type of the proposed hand-offs.", autocompletion=sutures),
    ] = None,
    arm: Annotated[str | None, typer.Option(help="Of PSM_left or PSM_right only.")] = None,
    prefix: Annotated[str, typer.Option(help="Before a surgeon's letter, in their pseudonym.")] = "jigsaws",
    as_json: AsJson = False,
) -> None:
    """Store every trial of a folder; exit code 1 where one was refused, and the others are stored."""
    from rich.progress import track

    from skills.dataset import find_trials, send_trials

    found = find_trials(folder, task or ())
    with service() as client:
        sending = send_trials(client, found, suture=suture, arm=arm, prefix=prefix)
        done = [
            asdict(sent)
            for sent in track(
                sending, "sending", total=len(found), console=err, transient=True, disable=not err.is_terminal
            )
        ]
    if as_json:
        print_json(done)
    else:
        rows = [one | {"recording": (one["recording"] or "")[:12], "demos": len(one["demos"])} for one in done]
        show(rows, False, ("trial", "surgeon", "skill_level", "score", "recording", "proposed", "demos"))
        for one in done:
            for problem in one["problems"]:
                err.print(f"{one['trial']}: {problem}", style="red", markup=False, soft_wrap=True)
    if any(one["problems"] for one in done):
        raise typer.Exit(1)
