"""Recordings and demonstrations."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from skills.cli.shell import AsJson, err, out, refusing, service, show
from skills.errors import BadInput

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


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, Callable[[int], None]]]:
    """Make the recording that a path means ready to be sent: the file to send, and what is told of bytes sent."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    from skills.recordings.folder import find_bag, ready_to_send

    bag = find_bag(path)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as bar:
        reading = bar.add_task("reading", total=bag.size_bytes)
        with ready_to_send(bag, lambda count: bar.advance(reading, count)) as file:
            bar.update(reading, visible=False)
            sending = bar.add_task("sending", total=file.stat().st_size)
            yield file, lambda count: bar.advance(sending, count)


@recordings.command("add")
@refusing
def recording_add(path: RecordingPath, rate_hz: RateHz = None, frame: Frame = None, as_json: AsJson = False) -> None:
    """Store a recording and see which hand-offs it seems to hold."""
    with service() as client, ready(path) as (file, sent):
        stored = client.add_recording(file, sent=sent, rate_hz=rate_hz, frame=frame)
    if as_json:
        out.print_json(json.dumps(stored))
        return
    out.print(
        f"{stored['sha256']}  {stored['format']}, {stored['duration_s']:.1f} s, integrity {stored['integrity']}",
        soft_wrap=True,
    )
    for name, value in stored["notes"].items():
        out.print(f"{name}: {value}", markup=False, soft_wrap=True)
    show(stored["segments"], False, ("arm", "start_s", "end_s", "reason"))


@demos.command("add")
@refusing
def demo_add(
    path: RecordingPath,
    surgeon: Annotated[str, typer.Option()],
    suture: Annotated[str, typer.Option()],
    arm: Annotated[str | None, typer.Option(help="Needed where a recording has several arms.")] = None,
    topic: Annotated[str | None, typer.Option()] = None,
    start_s: Annotated[float | None, typer.Option(help="Start of the hand-off in the recording.")] = None,
    end_s: Annotated[float | None, typer.Option(help="Its end.")] = None,
    proposal: Annotated[int | None, typer.Option(help="Take this proposed hand-off, counted from 1.")] = None,
    grid: Annotated[str, typer.Option(help="auto, paper or fit.")] = "auto",
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
    asked: dict[str, Any] = {"arm": arm, "topic": topic, "session": session}
    asked |= {"grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis}
    how: dict[str, Any] = {"rate_hz": rate_hz, "frame": frame}
    with service() as client, ready(path) as (file, sent):
        if proposal is None:
            asked |= {"start_s": start_s, "end_s": end_s}
            answer = client.add_demo(file, surgeon=surgeon, suture=suture, sent=sent, **how, **asked)
        else:
            stored = client.add_recording(file, sent=sent, **how)
            proposed = [s for s in stored["segments"] if arm in (None, s["arm"])]
            if not 1 <= proposal <= len(proposed):
                raise BadInput(f"The recording has {len(proposed)} proposed hand-offs; see `skills recording add`.")
            part = proposed[proposal - 1]
            asked |= {"arm": part["arm"], "start_s": part["start_s"], "end_s": part["end_s"]}
            answer = client.cut_demo(stored["sha256"], surgeon=surgeon, suture=suture, **asked)
    answer["path_states"] = answer["report"]["path_states"]
    show(answer, as_json, ("id", "surgeon", "suture", "arm", "frame", "path_states"))
    if not as_json:
        x, y, z = answer["report"]["discretisation_rmse_mm"]
        loss = f"{x:.2f}, {y:.2f}, {z:.2f} mm off their cells along x, y, z (RMSE)"
        out.print(f"{answer['report']['revisits']} crossings; samples are {loss}")


@demos.command("list")
@refusing
def demo_list(surgeon: str | None = None, suture: str | None = None, as_json: AsJson = False) -> None:
    """List demonstrations, the newest first."""
    with service() as client:
        show(client.demos(surgeon, suture), as_json, ("id", "surgeon", "suture", "arm", "state", "created_at"))


@demos.command("show")
@refusing
def demo_show(demo: str) -> None:
    """Show a demonstration and its report, as JSON."""
    with service() as client:
        out.print_json(json.dumps(client.demo(demo)))


@demos.command("report")
@refusing
def demo_report(
    demo: str,
    html: Annotated[Path | None, typer.Option(help="Write it to this file as a page for a browser.")] = None,
) -> None:
    """Tell how good a demonstration is, and what would make it better."""
    with service() as client:
        if html is None:
            out.print_json(json.dumps(client.demo_report(demo)))
        else:
            html.write_bytes(client.demo_report_page(demo))
            out.print(f"The report: {html}")


@demos.command("withdraw")
@refusing
def demo_withdraw(demo: str) -> None:
    """Withdraw a demonstration and the releases that rest on it."""
    with service() as client:
        client.withdraw_demo(demo)


@jigsaws.command("add")
@refusing
def jigsaws_add(
    folder: Annotated[Path, typer.Argument(help="With TASK/kinematics/AllGestures/*.txt and what belongs to them.")],
    task: Annotated[list[str] | None, typer.Option(help="Only this task, such as Suturing; once for each.")] = None,
    suture: Annotated[
        str | None, typer.Option(help="Make demonstrations of this suture type of the proposed hand-offs.")
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
        done = [asdict(sent) for sent in track(sending, "sending", total=len(found), console=err, transient=True)]
    if as_json:
        out.print_json(json.dumps(done))
    else:
        rows = [one | {"recording": (one["recording"] or "")[:12], "demos": len(one["demos"])} for one in done]
        show(rows, False, ("trial", "surgeon", "skill_level", "score", "recording", "proposed", "demos"))
        for one in done:
            for problem in one["problems"]:
                err.print(f"{one['trial']}: {problem}", style="red", markup=False, soft_wrap=True)
    if any(one["problems"] for one in done):
        raise typer.Exit(1)
