"""Commands of surgeons, suture types and recordings.

`skills recording table` shows what is understood of each recording in a folder, or why it is refused, as Markdown. What
a recording does not say itself is stated in a TOML file: a table for each name or pattern below the folder, with the
options of `skills recording preview` and the source of the recordings:

    ["calibration/*_fixed.csv"]
    source = "a public calibration"
    rate_hz = 100
"""

import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.shell import (
    AsJson,
    Surgeon,
    bar,
    complete_surgeons,
    first_sentence,
    out,
    print_json,
    refusing,
    service,
    show,
)
from skills.errors import BadInput, SkillsError
from skills.remedies import Door

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
    skill_level: Annotated[
        Literal["novice", "intermediate", "expert"] | None, typer.Option(help="The surgeon's experience.")
    ] = None,
    handedness: Annotated[
        Literal["right", "left", "ambidextrous"] | None, typer.Option(help="The hand that the surgeon prefers.")
    ] = None,
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
    from skills.client import Client, Progress
    from skills.formats.lerobot import Dataset
    from skills.formats.lerobot.cut import Episode
    from skills.schemas.recordings import Recording, RecordingPreview

commands = typer.Typer()
recordings = typer.Typer(no_args_is_help=True, help="Raw recordings.")
commands.add_typer(recordings, name="recording")

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
        "psm1_jaw=THEIRS[7]; repeatable.",
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
DatasetColumns = Annotated[
    list[str] | None,
    typer.Option("--column", help="A column under another name in a LeRobot dataset, as in the upload; repeatable."),
]
RecordingPath = Annotated[
    Path,
    typer.Argument(
        help="A recording, a bag folder, a session's folder with one, or a LeRobot dataset; pictures are not sent."
    ),
]

COLUMNS = {
    "name": "recording", "source": "source", "stated": "stated", "format": "format", "samples": "samples",
    "understood": "understood", "refused": "refused because",
}  # fmt: skip
Row = dict[str, str]


@contextmanager
def ready(path: Path) -> Iterator[tuple[Path, "Progress"]]:
    """Yield the file to upload for a path, and the callback for its progress; a bag folder becomes one file."""
    from skills.formats.upload import find_bag, prepare_upload

    bag = find_bag(path)
    read = 0
    with bar("reading") as reading:

        def advance(count: int) -> None:
            nonlocal read
            read += count
            reading(read, bag.size_bytes)

        with prepare_upload(bag, advance) as file, bar("sending") as sending:
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
            columns, tools = pairs("--column", column), pairs("--tool", tool)
            cut_episode(dataset, episode, out, columns=columns, tools=tools)
        yield file, sending


TABLE = ("rate_hz", "frame", "unit", "decimal", "table_arm", "instrument")


@contextmanager
def ready_one(
    path: Path, episode: str | None, tool: Sequence[str] | None, column: list[str] | None, *table: Any
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the file to upload for a path, and the named arguments of its upload: `TABLE`, columns and progress.

    The path is a recording, or a dataset with the episode; in the episode's file the columns are mapped already.
    """
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    with find_dataset(path) as dataset:
        if dataset is None:
            _refuse_statements(path, episode, tool)
            with ready(path) as (file, progress):
                yield file, {**dict(zip(TABLE, table, strict=True)), "column": column, "progress": progress}
            return
        if episode == "all":
            raise BadInput("Name one episode: a demonstration is of one.")
        with ready_episode(dataset, choose_episodes(dataset, episode)[0], column, tool) as (file, progress):
            yield file, {**dict(zip(TABLE, table, strict=True)), "column": None, "progress": progress}


def _refuse_statements(path: Path, *given: object) -> None:
    if any(given):
        raise BadInput(f"{path} is no LeRobot dataset; --episode and --tool are about one.")


def pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Return the two names of each statement of an option such as --tool."""
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
    table = column, rate_hz, frame, unit, decimal, table_arm, instrument
    with service() as client, ready_one(path, episode, tool, *table) as (file, how):
        stored = client.add_recording(file, surgeon=surgeon, **how)
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
    table = column, rate_hz, frame, unit, decimal, table_arm, instrument
    with service() as client, ready_one(path, episode, tool, *table) as (file, how):
        seen = client.preview_recording(file, **how)
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


@recordings.command("list")
@refusing
def recording_list(as_json: AsJson = False) -> None:
    """List recordings, the newest first."""
    with service() as client:
        found = client.recordings()
    show(found, as_json, ("id", "format", "duration_s", "arms", "segments", "demos"))


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


@recordings.command("table")
@refusing
def recording_table(
    folder: Annotated[Path, typer.Argument(help="A folder with recordings, at any depth.", file_okay=False)],
    stated: Annotated[
        Path | None, typer.Option(help="A TOML file with what the recordings do not say (docs/recordings.md).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what would be understood of each recording in a folder, and why others are refused; nothing is stored."""
    statements = {} if stated is None else _statements(stated)
    rows: list[Row] = []
    with service() as client:
        for path in _recordings_in(folder):
            name = path.relative_to(folder).as_posix()
            said = next((one for pattern, one in statements.items() if fnmatch(name, pattern)), {})
            rows += _rows(client, path, name, said)
    if as_json:
        print_json(rows)
        return
    for line in (list(COLUMNS.values()), ["---"] * len(COLUMNS), *([row[one] for one in COLUMNS] for row in rows)):
        print("|", " | ".join(cell.replace("|", "\\|") for cell in line), "|")


def _statements(path: Path) -> dict[str, dict[str, Any]]:
    """Read the statements about recordings, by name or pattern.

    Raises:
        BadInput: It is not TOML, or states something that a preview does not take.
    """
    from pydantic import ValidationError

    from skills.schemas.recordings import StatedIn

    try:
        said = tomllib.loads(path.read_text())
        return {name: StatedIn.model_validate(one).model_dump(exclude_none=True) for name, one in said.items()}
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{path} is not TOML: {error}.") from error
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, fault["loc"]))
        raise BadInput(f"{path}: {where}: {fault['msg']}; {', '.join(StatedIn.model_fields)} can be stated.") from error


def _recordings_in(folder: Path) -> Iterator[Path]:
    """Yield the files with the suffix of a recording, and bag folders and LeRobot datasets, each as one, by name."""
    from skills.formats import SUFFIXES
    from skills.formats.bag_folder import METADATA
    from skills.formats.lerobot import INFO

    for path in sorted(folder.iterdir()):
        if path.is_dir() and not ((path / METADATA).is_file() or (path / INFO).is_file()):
            yield from _recordings_in(path)
        elif path.is_dir() or path.suffix.lower() in SUFFIXES.values():
            yield path


def _rows(client: "Client", path: Path, name: str, said: dict[str, Any]) -> Iterator[Row]:
    """Yield the row of a recording, or one for each episode of a dataset."""
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    options = {option: one for option, one in said.items() if option != "source"}
    row = dict.fromkeys(COLUMNS, "") | {
        "name": name,
        "source": said.get("source", ""),
        "stated": " ".join(f"`{word}`" for word in _words(options)),
    }
    try:
        with find_dataset(path) as dataset:
            episodes = [] if dataset is None else choose_episodes(dataset, options.get("episode", "all"))
    except SkillsError as error:
        yield row | {"format": path.suffix[1:], "refused": first_sentence(error)}
        return
    if dataset is None:
        yield row | _understood(client, path, options)
    for one in episodes:
        label = {"name": f"{name}, episode {one.number}"}
        yield row | label | _understood(client, path, options | {"episode": str(one.number)})


def _words(options: dict[str, Any]) -> Iterator[str]:
    for option, given in options.items():
        for one in given if isinstance(given, list) else [given]:
            yield f"--{option.replace('_', '-')} {one:g}" if isinstance(one, float) else f"--{option} {one}"


def _understood(client: "Client", path: Path, options: dict[str, Any]) -> Row:
    stated = [options.get(option) for option in ("episode", "tool", "column", *TABLE)]
    try:
        with ready_one(path, *stated) as (file, how):
            seen = client.preview_recording(file, **how | {"progress": None})
    except SkillsError as error:
        return {"format": path.suffix[1:], "refused": first_sentence(error)}
    samples = dict.fromkeys(str(motion.samples) for motion in seen.motions)
    return {"format": seen.format, "samples": ", ".join(samples), "understood": "; ".join(_facts(seen))}


def _facts(seen: "RecordingPreview") -> Iterator[str]:
    """Yield arms, frames and rates, what the joints show, and what was dropped, repeated or left out."""
    for motion, quality in zip(seen.motions, seen.quality, strict=True):
        rate = "without times" if quality.rate_hz is None else f"at {quality.rate_hz:.1f} Hz"
        yield f"{motion.arm} in {motion.frame} {rate}"
    for one in seen.identifications:
        found = one.found
        if found.verdict == "identified":
            fit = f"{found.residual_mm:.3f} mm RMS, {found.greatest_mm:.3f} mm at most"
            yield f"{one.arm} in {one.frame} is a {found.generation} with {found.instrument}: {fit}"
        else:
            yield f"{one.arm} in {one.frame}, {found.verdict}: {found.reason}"
    yield from count_dropped(seen)
    if "last row" in seen.notes:
        yield f"last row: {seen.notes['last row']}"
    if seen.left_out:
        yield f"left out: {', '.join(one.topic for one in seen.left_out)}"
