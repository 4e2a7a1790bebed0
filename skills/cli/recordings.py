"""Commands of surgeons, suture types, recordings and demonstrations."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.shell import (
    AsJson,
    OfSurgeon,
    OfSuture,
    Surgeon,
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

surgeon_commands = typer.Typer()
surgeons = typer.Typer(no_args_is_help=True, help="Surgeons, by pseudonym; never by name.")
sutures = typer.Typer(no_args_is_help=True, help="The catalogue of suture types.")
surgeon_commands.add_typer(surgeons, name="surgeon")
surgeon_commands.add_typer(sutures, name="suture")

ABOUT_SURGEON = ("surgeon", "skill_level", "handedness", "protocol", "created_at")


@surgeons.command("put")
@refusing
def surgeon_put(
    surgeon: Annotated[str, typer.Argument(help="A pseudonym: lower-case letters, digits, - and _.")],
    skill_level: Annotated[Literal["novice", "intermediate", "expert"] | None, typer.Option()] = None,
    handedness: Annotated[Literal["right", "left", "ambidextrous"] | None, typer.Option()] = None,
    protocol: Annotated[str | None, typer.Option(help="The study's protocol, such as an ethics number.")] = None,
    consent: Annotated[
        list[str] | None, typer.Option(help="A use that the surgeon agreed to: training, export or atlas; repeatable.")
    ] = None,
    until: Annotated[str | None, typer.Option(help="The last day of the consent, such as 2030-12-31.")] = None,
    as_json: AsJson = False,
) -> None:
    """Create or replace a surgeon; options that are left out are cleared."""
    agreed = {"uses": consent, "until": until} if consent else None
    with service() as client:
        written = client.put_surgeon(
            surgeon, skill_level=skill_level, handedness=handedness, protocol=protocol, consent=agreed
        )
    show(written, as_json, ABOUT_SURGEON)


@surgeons.command("list")
@refusing
def surgeon_list(as_json: AsJson = False) -> None:
    """List the surgeons."""
    with service() as client:
        show(client.surgeons(), as_json, ABOUT_SURGEON)


@surgeons.command("show")
@refusing
def surgeon_show(surgeon: Surgeon, as_json: AsJson = False) -> None:
    """Show a surgeon."""
    with service() as client:
        show(client.surgeon(surgeon), as_json, (*ABOUT_SURGEON, "consent"))


@sutures.command("list")
@refusing
def suture_list(as_json: AsJson = False) -> None:
    """List the suture types."""
    with service() as client:
        show(client.suture_types(), as_json, ("suture", "name", "family"))


@surgeon_commands.command()
@refusing
def erase(
    surgeon: Surgeon,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Erase a surgeon and everything derived from their data, permanently."""
    if not yes:
        typer.confirm(f"Erase '{surgeon}', all recordings, policies and plans, permanently?", abort=True, err=True)
    with service() as client:
        client.erase_surgeon(surgeon)
    if as_json:
        print_json({"surgeon": surgeon, "erased": True})
    else:
        out.print(f"'{surgeon}' and everything derived from them is erased.")
        out.print(
            "Not reached: recordings that were uploaded without --surgeon and from which nothing was cut, since "
            "their surgeon is unknown (`skills recording delete`), and older backups.",
            soft_wrap=True,
        )


if TYPE_CHECKING:
    from skills.client import Progress
    from skills.formats.lerobot import Dataset
    from skills.formats.lerobot.cut import Episode
    from skills.schemas.given import Demonstration, Recording, RecordingPreview

    Part = Literal["whole"] | int | None

commands = typer.Typer()
recordings = typer.Typer(no_args_is_help=True, help="Raw recordings.")
demos = typer.Typer(no_args_is_help=True, help="Demonstrations: one hand-off each.")
jigsaws = typer.Typer(no_args_is_help=True, help="The JIGSAWS data set, which its authors provide on request.")
commands.add_typer(recordings, name="recording")
commands.add_typer(demos, name="demo")
commands.add_typer(jigsaws, name="jigsaws")

RateHz = Annotated[float | None, typer.Option(help="Samples per second, for a table without times.")]
Frame = Annotated[
    str | None,
    typer.Option(
        help="The frame of the poses in a table or a LeRobot dataset; base, the default for a table of one arm: the "
        "arm's base."
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        help="A column under another name, of a table as x_mm=PosX (docs/tables.md), of a LeRobot dataset as "
        "psm1_jaw=observation.state[7]; repeatable.",
    ),
]
Units = Annotated[
    list[str] | None,
    typer.Option("--unit", help="The unit of columns that name none: m, mm, rad, deg, s, ms, us or ns; repeatable."),
]
Decimal = Annotated[
    Literal["point", "comma"] | None, typer.Option(help="The decimal mark of a table: point, the default, or comma.")
]
TableArm = Annotated[str | None, typer.Option(help="The arm of a table; PSM by default.")]
Instrument = Annotated[
    str | None, typer.Option(help="The instrument with which a table's joints become poses, such as 400006.")
]
OneEpisode = Annotated[
    str | None, typer.Option(help="The episode of a LeRobot dataset, by its number; needed if it has several.")
]
Tool = Annotated[
    list[str] | None,
    typer.Option(help="The instrument of an arm in a LeRobot dataset, such as PSM1=400006; repeatable."),
]
RecordingPath = Annotated[
    Path,
    typer.Argument(
        help="A recording, a bag folder, a session's folder with one, or a LeRobot dataset; pictures are not sent."
    ),
]
Demo = Annotated[str, typer.Argument(help="The demonstration's digest.")]
Outcome = Literal["success", "recovery", "failure"]

ABOUT = ("id", "surgeon", "suture", "arm", "state", "outcome", "created_at")


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for a path, and the callback for its progress; a bag folder becomes one file."""
    from skills.formats.upload import find_bag, ready_to_send

    bag = find_bag(path)
    read = 0
    with bar("reading") as reading:

        def advance(count: int) -> None:
            nonlocal read
            read += count
            reading(read, bag.size_bytes)

        with ready_to_send(bag, advance) as file, bar("sending") as sending:
            yield file, sending


@contextmanager
def ready_episode(
    dataset: "Dataset", episode: "Episode", column: list[str] | None, tool: Sequence[str] | None
) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for an episode of a LeRobot dataset, and the callback for its progress."""
    from skills.formats.lerobot.cut import cut_episode

    with TemporaryDirectory() as folder, bar("sending") as sending:
        file = Path(folder) / "episode.zip"
        with file.open("wb") as out:
            columns, tools = _pairs("--column", column), _pairs("--tool", tool)
            cut_episode(dataset, episode, out, columns=columns, tools=tools)
        yield file, sending


@contextmanager
def ready_one(
    path: Path, episode: str | None, column: list[str] | None, tool: Sequence[str] | None
) -> Iterator[tuple[Path, "Progress", list[str] | None]]:
    """Yield the file to upload for a path, the callback for progress, and the columns that the service is to map.

    The path is a recording, or a dataset with the episode; in the episode's file the columns are mapped already.
    """
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    with find_dataset(path) as dataset:
        if dataset is None:
            _refuse_statements(path, episode, tool)
            with ready(path) as (file, progress):
                yield file, progress, column
            return
        if episode == "all":
            raise BadInput("Name one episode: a demonstration is of one.")
        with ready_episode(dataset, choose_episodes(dataset, episode)[0], column, tool) as (file, progress):
            yield file, progress, None


def _refuse_statements(path: Path, *given: object) -> None:
    if any(given):
        raise BadInput(f"{path} is no LeRobot dataset; --episode and --tool are about one.")


def _pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    pairs = [one.partition("=") for one in given or ()]
    wrong = next((one for one in pairs if not (one[0] and one[2])), None)
    if wrong is not None:
        raise BadInput(f"{option} takes two names with = between them, not {''.join(wrong)!r}.")
    return {ours: theirs for ours, _, theirs in pairs}


@recordings.command("add")
@refusing
def recording_add(
    path: RecordingPath,
    rate_hz: RateHz = None,
    frame: Frame = None,
    column: Columns = None,
    unit: Units = None,
    decimal: Decimal = None,
    table_arm: TableArm = None,
    instrument: Instrument = None,
    episode: Annotated[
        str | None,
        typer.Option(help="An episode of a LeRobot dataset by its number, or all: each becomes a recording."),
    ] = None,
    tool: Tool = None,
    surgeon: Annotated[
        str | None,
        typer.Option(
            help="The surgeon who was recorded: `skills erase` then finds it.", autocompletion=complete_surgeons
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Store a recording, and list the hand-offs proposed in it."""
    if episode == "all":
        _add_all(path, frame, column, tool, surgeon, as_json)
        return
    with service() as client, ready_one(path, episode, column, tool) as (file, progress, sent_columns):
        stored = client.add_recording(
            file,
            rate_hz=rate_hz,
            frame=frame,
            column=sent_columns,
            unit=unit,
            decimal=decimal,
            table_arm=table_arm,
            instrument=instrument,
            surgeon=surgeon,
            progress=progress,
        )
    _tell(stored, as_json)


@recordings.command("preview")
@refusing
def recording_preview(
    path: RecordingPath,
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
    """Show what would be understood of a recording, above all of a table; nothing is stored."""
    with service() as client, ready_one(path, episode, column, tool) as (file, progress, sent_columns):
        seen = client.preview_recording(
            file,
            rate_hz=rate_hz,
            frame=frame,
            column=sent_columns,
            unit=unit,
            decimal=decimal,
            table_arm=table_arm,
            instrument=instrument,
            progress=progress,
        )
    if as_json:
        print_json(seen)
        return
    for one in seen.columns:
        meaning = f"{one.quantity} in {one.unit}" if one.unit else one.quantity or "not used"
        out.print(f"column {one.name}: {meaning}", markup=False, soft_wrap=True)
    for motion, quality in zip(seen.motions, seen.quality, strict=True):
        x, y, z = quality.extent_mm
        rate = "" if quality.rate_hz is None else f" in {quality.duration_s:.3f} s, {quality.rate_hz:.1f} Hz"
        where = f"arm {motion.arm}, frame {motion.frame}, {motion.topic}"
        extent = f"extent x {x:.1f}, y {y:.1f}, z {z:.1f} mm"
        out.print(f"{where}: {motion.samples} samples{rate}; {extent}", markup=False, soft_wrap=True)
    for left in seen.left_out:
        out.print(f"left out {left.topic}: {left.because}", markup=False, soft_wrap=True)
    _tell_notes(seen)
    _tell_identified(seen)
    for line in count_dropped(seen):
        out.print(line, markup=False, soft_wrap=True)
    if not seen.timed:
        out.print("No times: it is stored only with a rate (--rate-hz) or a column of times.", soft_wrap=True)
    out.print("Nothing was stored.")


def _add_all(
    path: Path,
    frame: str | None,
    column: list[str] | None,
    tool: Sequence[str] | None,
    surgeon: str | None,
    as_json: bool,
) -> None:
    """Store every episode of a LeRobot dataset; those that are refused do not stop the others, and give exit code 1."""
    from skills.client import Problem
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    done: list[dict[str, Any]] = []
    with service() as client, find_dataset(path) as dataset:
        if dataset is None:
            _refuse_statements(path, "all")
            return
        for episode in choose_episodes(dataset, "all"):
            one: dict[str, Any] = {"episode": episode.number, "recording": None, "proposed": 0, "problem": None}
            try:
                with ready_episode(dataset, episode, column, tool) as (file, progress):
                    stored = client.add_recording(file, frame=frame, surgeon=surgeon, progress=progress)
                one |= {"recording": stored.sha256, "proposed": len(stored.segments)}
            except (Problem, BadInput) as error:
                one["problem"] = error.words(Door.COMMAND)
            done.append(one)
    show(done, as_json, ("episode", "recording", "proposed", "problem"))
    if any(one["problem"] for one in done):
        raise typer.Exit(1)


@recordings.command("show")
@refusing
def recording_show(
    recording: Annotated[str, typer.Argument(help="The recording's digest.")], as_json: AsJson = False
) -> None:
    """Show the content of a recording, and the hand-offs proposed in it."""
    with service() as client:
        _tell(client.recording(recording), as_json)


@recordings.command("delete")
@refusing
def recording_delete(
    recording: Annotated[str, typer.Argument(help="The recording's digest.")], as_json: AsJson = False
) -> None:
    """Delete a recording without demonstrations permanently; allowed to its uploader and to admins."""
    with service() as client:
        client.delete_recording(recording)
    if as_json:
        print_json({"recording": recording, "deleted": True})
    else:
        out.print(f"The recording {recording} is deleted.", soft_wrap=True)


def _tell(stored: "Recording", as_json: bool) -> None:
    if as_json:
        print_json(stored)
        return
    about = f"{stored.format}, {stored.duration_s:.1f} s, integrity {stored.integrity}"
    out.print(f"{stored.sha256}  {about}", soft_wrap=True)
    _tell_notes(stored)
    for line in count_dropped(stored):
        out.print(line, markup=False, soft_wrap=True)
    _tell_identified(stored)
    show(stored.segments, False, ("arm", "start_s", "end_s", "reason"))


def _tell_notes(found: "Recording | RecordingPreview") -> None:
    for name, value in found.notes.items():
        out.print(f"{name}: {value}", markup=False, soft_wrap=True)


def _tell_identified(found: "Recording | RecordingPreview") -> None:
    for one in found.identifications:
        out.print(f"{one.topic}: {one.found.verdict}: {one.found.reason}", markup=False, soft_wrap=True)


def count_dropped(stored: "Recording | RecordingPreview") -> list[str]:
    """Return a line for each count of samples that were dropped, or repeat the one before."""
    repeated = [(one.duplicate_stamps, one.topic, "with a repeated stamp dropped") for one in stored.motions]
    back = [(one.backward_stamps, one.topic, "with a stamp that went back dropped") for one in stored.dropped]
    equal = [(one.equal_samples, one.topic, "equal to the sample before") for one in stored.quality]
    return [f"{topic}: samples {what}: {count}" for count, topic, what in (*repeated, *back, *equal) if count]


@demos.command("add")
@refusing
def demo_add(
    path: RecordingPath,
    surgeon: Annotated[str, typer.Option(autocompletion=complete_surgeons)],
    suture: Annotated[str, typer.Option(autocompletion=complete_sutures)],
    arm: Annotated[str | None, typer.Option(help="Needed if a recording has several arms.")] = None,
    topic: Annotated[str | None, typer.Option()] = None,
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
    cell_mm: Annotated[float | None, typer.Option()] = None,
    hysteresis: Annotated[
        float,
        typer.Option(
            help="Hysteresis in cells: a sample this far beyond its cell still counts to it; 0 to 0.5, 0.25 against "
            "tremor."
        ),
    ] = 0.0,
    session: Annotated[str | None, typer.Option()] = None,
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

    part = proposal if segment is None else _part_of(segment)
    with service() as client, ready_one(path, episode, column, tool) as (file, progress, sent_columns):

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
                rate_hz=rate_hz,
                frame=frame,
                column=sent_columns,
                unit=unit,
                decimal=decimal,
                table_arm=table_arm,
                instrument=instrument,
                progress=progress,
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
            added = add(_part_of(typer.prompt("Which one? A number, or whole", err=True).strip()))
    _measured(added, as_json)
    if added.segment is not None and not as_json:
        which = f"{added.segment.taken}, {added.segment.start_s:.2f} to {added.segment.end_s:.2f} s"
        out.print(f"Taken: {which}; {added.segment.because}", markup=False, soft_wrap=True)


def _part_of(segment: str) -> "Part":
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
def demo_save(demo: Demo, to: Annotated[Path, typer.Argument(dir_okay=False)], as_json: AsJson = False) -> None:
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
