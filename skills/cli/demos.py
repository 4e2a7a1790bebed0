"""Commands of demonstrations: cut from recordings, proposals or the trials of JIGSAWS, marked, and exported."""

import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.recordings import (
    Columns,
    Decimal,
    Frame,
    Instrument,
    OneEpisode,
    RateHz,
    RecordingPath,
    TableArm,
    Tool,
    Units,
    ready_one,
)
from skills.cli.shell import (
    AsJson,
    OfSurgeon,
    OfSuture,
    bar,
    complete_surgeons,
    complete_sutures,
    err,
    out,
    print_json,
    refusing,
    service,
    show,
)
from skills.errors import BadInput, SkillsError
from skills.remedies import Door, did_you_mean

if TYPE_CHECKING:
    from skills.schemas.demos import Demonstration, Proposal

    Part = Literal["whole"] | int | None
from collections.abc import Mapping
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

from skills.cli.recordings import DatasetColumns, pairs
from skills.cli.shell import (
    finished,
    result_of,
)

if TYPE_CHECKING:
    from skills.client import Client
    from skills.formats.lerobot.videos import EpisodeSource


commands = typer.Typer()
demos = typer.Typer(no_args_is_help=True, help="Demonstrations: one hand-off each.")
proposals = typer.Typer(no_args_is_help=True, help="Proposed hand-offs: to be accepted, corrected or rejected.")
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors provide on request.")
commands.add_typer(demos, name="demo")
commands.add_typer(proposals, name="proposal")
commands.add_typer(jigsaws, name="jigsaws")

Demo = Annotated[str, typer.Argument(help="The demonstration's digest.")]
Outcome = Literal["success", "recovery", "failure"]

ABOUT = ("id", "surgeon", "suture", "arm", "state", "outcome", "created_at")


@demos.command("add")
@refusing
def demo_add(
    path: RecordingPath,
    surgeon: Annotated[str, typer.Option(help="The surgeon's pseudonym.", autocompletion=complete_surgeons)],
    suture: Annotated[
        str, typer.Option(help="The suture type, such as simple-running.", autocompletion=complete_sutures)
    ],
    arm: Annotated[str | None, typer.Option(help="Needed if a recording has several arms.")] = None,
    topic: Annotated[str | None, typer.Option(help="Needed if an arm has several topics.")] = None,
    start_s: Annotated[float | None, typer.Option(help="Start of the hand-off in the recording.")] = None,
    end_s: Annotated[float | None, typer.Option(help="End of the hand-off in the recording.")] = None,
    segment: Annotated[
        str | None,
        typer.Option(
            help="A proposed hand-off, counted from 1, or whole; without it and without times, the only proposal is "
            "taken."
        ),
    ] = None,
    proposal: Annotated[int | None, typer.Option(help="The same as --segment with a number.")] = None,
    grid: Annotated[Literal["auto", "paper", "fit"], typer.Option(help="auto, paper or fit.")] = "auto",
    cell_mm: Annotated[float | None, typer.Option(help="Length of a cell's edge, mm; 5 by default.")] = None,
    hysteresis: Annotated[
        float,
        typer.Option(
            help="Hysteresis in cells: a sample this far beyond its cell still counts to it; 0 to 0.5, 0.25 against "
            "tremor."
        ),
    ] = 0.0,
    session: Annotated[str | None, typer.Option(help="Name of the session, such as 2026-11-23-a.")] = None,
    outcome: Annotated[Outcome | None, typer.Option(help="What became of the hand-off, if it is known.")] = None,
    reason: Annotated[str | None, typer.Option(help="Why; needed for a recovery or a failure.")] = None,
    rate_hz: RateHz = None,
    frame: Frame = None,
    column: Columns = None,
    unit: Units = None,
    decimal: Decimal = None,
    table_arm: TableArm = None,
    instrument: Instrument = None,
    episode: OneEpisode = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> None:
    """Store a recording and one demonstration of it; if several hand-offs are proposed, name one with --segment."""
    if segment is not None and proposal is not None:
        raise BadInput("Use --segment or --proposal, not both.")
    from skills.client import Problem

    part = proposal if segment is None else part_of(segment)
    table = column, rate_hz, frame, unit, decimal, table_arm, instrument
    with service() as client, ready_one(path, episode, tool, *table) as (file, how):

        def add(part: "Part") -> "Demonstration":
            return client.add_demo(
                file,
                surgeon=surgeon,
                suture=suture,
                arm=arm,
                topic=topic,
                start_s=start_s,
                end_s=end_s,
                segment=part,
                grid=grid,
                cell_mm=cell_mm,
                hysteresis=hysteresis,
                session=session,
                outcome=outcome,
                outcome_reason=reason,
                **how,
            )

        try:
            added = add(part)
        except Problem as problem:
            # a program has to name the segment; only a user at a terminal is prompted
            if problem.kind != "segment-not-named" or as_json:
                raise
            _list_proposals(problem.body["numbers"]["segments"])
            if not on_terminal():
                raise
            added = add(part_of(typer.prompt("Which one? A number, or whole", err=True).strip()))
    _measured(added, as_json)
    if added.segment is not None and not as_json:
        which = f"{added.segment.taken}, {added.segment.start_s:.2f} to {added.segment.end_s:.2f} s"
        out.print(f"Taken: {which}; {added.segment.because}", markup=False, soft_wrap=True)


def part_of(segment: str) -> "Part":
    """Return the value of --segment: a number, or "whole"."""
    if segment == "whole":
        return "whole"
    if not segment.isdecimal():
        raise BadInput(
            f"--segment {segment!r} is neither the number of a proposed hand-off nor whole.",
            *did_you_mean(segment, ["whole"]),
            "List the proposed hand-offs: skills recording add FILE",
        )
    return int(segment)


def on_terminal() -> bool:
    """Return whether a user can be prompted."""
    return sys.stdin.isatty()


def _list_proposals(proposed: "list[dict[str, Any]]") -> None:
    shown = [one | {name: f"{one[name]:.2f}" for name in ("start_s", "end_s")} for one in proposed]
    show(shown, False, ("segment", "arm", "start_s", "end_s", "reason"))


def _measured(demo: "Demonstration", as_json: bool) -> None:
    show(demo, as_json, ("id", "surgeon", "suture", "arm", "frame", "report.path_states"))
    if not as_json:
        x, y, z = demo.report.discretisation_rmse_mm
        loss = f"{x:.2f}, {y:.2f}, {z:.2f} mm off their cells along x, y, z (RMSE)"
        out.print(f"{demo.report.revisits} crossings; samples are {loss}")


@demos.command("list")
@refusing
def demo_list(
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    outcome: Annotated[
        Literal["success", "recovery", "failure", "unknown"] | None, typer.Option(help="Only those marked so.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List demonstrations, the newest first."""
    with service() as client:
        show(client.demos(surgeon, suture, outcome=outcome), as_json, ABOUT)


@demos.command("show")
@refusing
def demo_show(demo: Demo, as_json: AsJson = False) -> None:
    """Show a demonstration, with the figures measured when it was stored."""
    with service() as client:
        shown = client.demo(demo)
    _measured(shown, as_json)
    if not as_json:
        out.print(f"{shown.state}, {shown.start_s:.2f} to {shown.end_s:.2f} s of {shown.recording}", soft_wrap=True)
        _tell_outcome(shown)


@demos.command("report")
@refusing
def demo_report(
    demo: Demo,
    html: Annotated[Path | None, typer.Option(help="Write the report to this file as HTML.")] = None,
    as_json: AsJson = False,
) -> None:
    """Report the quality of a demonstration, and how to improve it."""
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
def demo_save(
    demo: Demo, to: Annotated[Path, typer.Argument(help="The file to write.", dir_okay=False)], as_json: AsJson = False
) -> None:
    """Write the recording of a demonstration to a file, exactly as it was uploaded."""
    with service() as client, bar("fetching") as progress:
        client.save_recording(demo, to, progress)
    _written(to, as_json)


def _written(to: Path, as_json: bool) -> None:
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: {to.stat().st_size / 1e6:.1f} MB.", soft_wrap=True)


@demos.command("mark")
@refusing
def demo_mark(
    demo: Demo,
    outcome: Annotated[Outcome, typer.Argument(help="What became of the hand-off.")],
    reason: Annotated[str | None, typer.Option(help="Why; needed for a recovery or a failure.")] = None,
    as_json: AsJson = False,
) -> None:
    """Mark a demonstration; a recovery or a failure is not learnt from, and releases that rest on it are withdrawn."""
    with service() as client:
        marked = client.mark_demo(demo, outcome, reason=reason)
    if as_json:
        print_json(marked)
    else:
        _tell_outcome(marked)


def _tell_outcome(demo: "Demonstration") -> None:
    if demo.outcome is not None:
        why = "" if demo.outcome_reason is None else f": {demo.outcome_reason}"
        out.print(f"marked {demo.outcome}{why}", markup=False, soft_wrap=True)


@demos.command("withdraw")
@refusing
def demo_withdraw(
    demo: Demo,
    erase: Annotated[bool, typer.Option("--erase", help="Delete it and everything derived from it.")] = False,
    as_json: AsJson = False,
) -> None:
    """Withdraw a demonstration and the releases that rest on it."""
    with service() as client:
        client.withdraw_demo(demo, erase=erase)
    done = "erased" if erase else "withdrawn"
    if as_json:
        print_json({"demo": demo, "state": done})
    else:
        out.print(f"The demonstration is {done}, and no release depends on it.")


PROPOSAL = ("recording", "number", "state", "arm", "start_s", "end_s", "found_by", "surgeon", "suture", "note")

OfRecording = Annotated[str, typer.Argument(help="The recording's digest.")]
Number = Annotated[int, typer.Argument(help="The number of the proposal, counted from 1.")]
Note = Annotated[str | None, typer.Option(help="Why.")]


@proposals.command("list")
@refusing
def proposal_list(
    state: Annotated[
        Literal["open", "accepted", "rejected"] | None, typer.Option(help="Only those in this state.")
    ] = None,
    recording: Annotated[str | None, typer.Option(help="Only those of this recording, by its digest.")] = None,
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    as_json: AsJson = False,
) -> None:
    """List the hand-offs proposed in recordings, those of the newest recording first."""
    with service() as client:
        _tell_proposals(client.proposals(state, recording=recording, surgeon=surgeon, suture=suture), as_json)


@proposals.command("accept")
@refusing
def proposal_accept(
    recording: OfRecording,
    number: Number,
    surgeon: Annotated[str, typer.Option(help="The surgeon's pseudonym.", autocompletion=complete_surgeons)],
    suture: Annotated[
        str, typer.Option(help="The suture type, such as simple-running.", autocompletion=complete_sutures)
    ],
    start_s: Annotated[float | None, typer.Option(help="Corrected start, s.")] = None,
    end_s: Annotated[float | None, typer.Option(help="Corrected end, s.")] = None,
    session: Annotated[str | None, typer.Option(help="Name of the session, such as 2026-11-23-a.")] = None,
    outcome: Annotated[Outcome | None, typer.Option(help="What became of the hand-off, if it is known.")] = None,
    reason: Annotated[str | None, typer.Option(help="Why; needed for a recovery or a failure.")] = None,
    as_json: AsJson = False,
) -> None:
    """Cut a demonstration where a hand-off is proposed, with its times or with corrected ones."""
    with service() as client:
        proposed = client.recording(recording).segments
        if not 1 <= number <= len(proposed):
            raise BadInput(
                f"There is no proposal {number} in this recording; it has {len(proposed)}.",
                f"List them: skills proposal list --recording {recording}",
            )
        one = proposed[number - 1]
        cut = client.cut_demo(
            recording,
            surgeon=surgeon,
            suture=suture,
            arm=one.arm,
            start_s=one.start_s if start_s is None else start_s,
            end_s=one.end_s if end_s is None else end_s,
            session=session,
            outcome=outcome,
            outcome_reason=reason,
        )
    _measured(cut, as_json)


@proposals.command("reject")
@refusing
def proposal_reject(recording: OfRecording, number: Number, note: Note = None, as_json: AsJson = False) -> None:
    """Reject a proposed hand-off; it stays rejected until it is opened again."""
    with service() as client:
        _tell_proposals([client.decide_proposal(recording, number, "rejected", note=note)], as_json)


@proposals.command("open")
@refusing
def proposal_open(recording: OfRecording, number: Number, note: Note = None, as_json: AsJson = False) -> None:
    """Open a rejected proposal again."""
    with service() as client:
        _tell_proposals([client.decide_proposal(recording, number, "open", note=note)], as_json)


def _tell_proposals(found: "list[Proposal]", as_json: bool) -> None:
    if as_json:
        print_json(found)
        return
    rows = [one.model_dump() | {"recording": one.recording[:12]} for one in found]
    show([row | {name: f"{row[name]:.2f}" for name in ("start_s", "end_s")} for row in rows], False, PROPOSAL)


@jigsaws.command("add")
@refusing
def jigsaws_add(
    folder: Annotated[
        Path,
        typer.Argument(help="A folder with TASK/kinematics/AllGestures/*.txt, their transcriptions and meta files."),
    ],
    task: Annotated[list[str] | None, typer.Option(help="Only this task, such as Suturing; repeatable.")] = None,
    suture: Annotated[
        str | None,
        typer.Option(
            help="Make a demonstration of this suture type from each proposed hand-off.",
            autocompletion=complete_sutures,
        ),
    ] = None,
    arm: Annotated[Literal["PSM_left", "PSM_right"] | None, typer.Option(help="Only this arm.")] = None,
    prefix: Annotated[str, typer.Option(help="Prefix of the pseudonyms, before the surgeon's letter.")] = "jigsaws",
    as_json: AsJson = False,
) -> None:
    """Store every trial of a folder; exit code 1 if one was refused, while the others are stored."""
    from rich.progress import track

    from skills.samples import find_trials, send_trials

    found = find_trials(folder, task or ())
    with service() as client:
        worded = partial(SkillsError.words, door=Door.COMMAND)
        sending = send_trials(client, found, suture=suture, arm=arm, prefix=prefix, worded=worded)
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


@jigsaws.command("evaluate")
@refusing
def jigsaws_evaluate(
    folder: Annotated[Path, typer.Argument(help="A folder with TASK/kinematics/AllGestures/*.txt.", file_okay=False)],
    task: Annotated[list[str] | None, typer.Option(help="Only this task, such as Suturing; repeatable.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare the hand-offs proposed from both hands' motion with the transcribed ones; nothing is stored."""
    from rich.progress import track

    from skills.samples import evaluate_hand_offs, find_trials

    found = find_trials(folder, task or ())
    read = track(found, "reading", console=err, transient=True, disable=not err.is_terminal)
    rows = evaluate_hand_offs(read)
    if as_json:
        print_json([asdict(row) for row in rows])
        return
    columns = ("task", "trials", "left_out", "proposed", "a_trial", "transcribed", "precision", "recall", "brier")
    show([{**asdict(row), "a_trial": round(row.a_trial, 1)} for row in rows], False, columns)


@commands.command("export-dataset")
@refusing
def export_dataset(
    to: Annotated[Path, typer.Argument(metavar="OUT", help="A new folder, or a new file that ends in .zip.")],
    surgeon: Annotated[
        list[str] | None,
        typer.Option(help="Only of this surgeon; repeatable.", autocompletion=complete_surgeons),
    ] = None,
    suture: Annotated[
        list[str] | None,
        typer.Option(help="Only of this suture type; repeatable.", autocompletion=complete_sutures),
    ] = None,
    demo: Annotated[list[str] | None, typer.Option(help="This demonstration, by its digest; repeatable.")] = None,
    outcomes: Annotated[
        Literal["success", "any"],
        typer.Option(help="any: with those marked recovery or failure, in splits of these names."),
    ] = "success",
    whole: Annotated[
        bool, typer.Option("--whole", help="Whole recordings, where all surgeons in them consent.")
    ] = False,
    version: Annotated[Literal["v2.1", "v3.0"], typer.Option(help="The version of LeRobot's format.")] = "v2.1",
    fps: Annotated[int, typer.Option(help="Frames per second, at most the rate of the recordings.")] = 30,
    split: Annotated[
        Literal["surgeon", "session"], typer.Option(help="Keep a surgeon, or a recording, in one split.")
    ] = "surgeon",
    arm: Annotated[
        list[str] | None, typer.Option(help="This arm, such as PSM1; repeatable. By default all common ones.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The dataset's title.")] = None,
    licence: Annotated[str | None, typer.Option(help="Its licence, such as CC-BY-4.0.")] = None,
    description: Annotated[str | None, typer.Option(help="What it contains.")] = None,
    procedure: Annotated[str | None, typer.Option(help="How it was collected.")] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            help="Add the videos of this LeRobot dataset of yours, from which the recordings were uploaded; "
            "repeatable, with --whole. They stay on this machine."
        ),
    ] = None,
    pictures_consented: Annotated[
        bool,
        typer.Option(
            "--pictures-consented",
            help="Declare that everyone in the videos consented to passing them on: the service knows no such consent.",
        ),
    ] = False,
    column: DatasetColumns = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> None:
    """Export demonstrations as a LeRobot dataset, and verify it; the consent to export is required."""
    from skills.formats.lerobot.manifest import refuse_existing

    refuse_existing(to)
    sources: dict[str, EpisodeSource] = {}
    if videos:
        _refuse_videos(to, whole=whole, consented=pictures_consented)
        from skills.formats.lerobot.videos import find_recorded

        sources = find_recorded(videos, fps, columns=pairs("--column", column), tools=pairs("--tool", tool))
    elif pictures_consented or column or tool:
        raise BadInput("--pictures-consented, --column and --tool are about --videos; name the folder of the videos.")
    with service(workers=1) as client:
        job = client.export_dataset(
            demos=demo,
            surgeons=surgeon,
            sutures=suture,
            outcomes=outcomes,
            whole=whole,
            version=version,
            fps=fps,
            split=split,
            arms=arm,
            name=name,
            licence=licence,
            description=description,
            procedure=procedure,
        )
        result = result_of(finished(client, job))
        if videos:
            _save_with_videos(client, result["dataset"], to, sources, version)
        else:
            with bar("fetching") as progress:
                client.save_dataset(result["dataset"], to, progress)
    if as_json:
        print_json({"file": to, **result})
        return
    out.print(f"{result['dataset']}  episodes: {result['episodes']}, frames: {result['frames']}")
    out.print(f"{to}: every file is verified against SHA256SUMS. Research use only.", soft_wrap=True)
    if videos:
        out.print("It has videos. Its README says that you declared the consent of everyone in them.", soft_wrap=True)


def _refuse_videos(to: Path, *, whole: bool, consented: bool) -> None:
    """Refuse an export with videos that is not possible, or not declared."""
    if not whole:
        raise BadInput(
            "A video is not cut at a hand-off, since it would have to be encoded again; with --videos, export whole "
            "recordings, with --whole."
        )
    if to.suffix == ".zip":
        raise BadInput("A dataset with videos is written to a folder; name one that does not end in .zip.")
    if not consented:
        raise BadInput(
            "Videos may show persons, and the consent that the service knows is not about pictures. If everyone in "
            "them agreed to passing them on, declare it with --pictures-consented."
        )


def _save_with_videos(
    client: "Client", dataset: str, to: Path, sources: Mapping[str, "EpisodeSource"], version: Literal["v2.1", "v3.0"]
) -> None:
    """Download a dataset and add its videos, in a folder beside `to` that is renamed when all is there."""
    from skills.formats.lerobot.manifest import refuse_existing
    from skills.formats.lerobot.videos import add_videos, choose_videos

    recordings = [one.recording for one in client.dataset_episodes(dataset).episodes]
    chosen = choose_videos(recordings, sources, version)
    with TemporaryDirectory(prefix=".dataset-", dir=to.parent) as folder:
        part = Path(folder) / to.name
        with bar("fetching") as progress:
            client.save_dataset(dataset, part, progress)
        add_videos(part, chosen)
        refuse_existing(to)
        part.rename(to)
