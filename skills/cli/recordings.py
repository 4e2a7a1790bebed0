"""Commands of recordings and of the hand-offs proposed in them.

`skills recording table` shows what is understood of each recording in a folder, or why it is refused, as Markdown. What
a recording does not say itself is stated in a TOML file: a table for each name or pattern below the folder, with the
options of `skills recording preview` and the source of the recordings:

    ["calibration/*_fixed.csv"]
    source = "a public calibration"
    rate_hz = 100
"""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.commands import OfSurgeon, OfSuture, command, first_sentence
from skills.cli.completion import complete_surgeons
from skills.cli.connecting import service
from skills.cli.demos import measured
from skills.cli.output import Answer, outcome, say, show_table, table, text, typed
from skills.cli.uploading import OneEpisode, RecordingPath, Tool, ready_episode, ready_one, refused_of_dataset
from skills.errors import BadInput, SkillsError
from skills.keywords import DemoKeywords, TableKeywords
from skills.remedies import Door

if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.demos import Proposal
    from skills.schemas.recordings import Recording, RecordingPreview, StatedIn

REFUSES = (413, 415, 422)  # the status codes that are about a recording

commands = typer.Typer()
recordings = typer.Typer(no_args_is_help=True, help="Raw recordings.")
proposals = typer.Typer(no_args_is_help=True, help="Proposed hand-offs: to be accepted, corrected or rejected.")
commands.add_typer(recordings, name="recording")
commands.add_typer(proposals, name="proposal")

RecordingId = Annotated[str, typer.Argument(help="The recording's digest.")]


@command(recordings, "add")
def recording_add(
    path: RecordingPath,
    about: TableKeywords,
    episode: str | None = None,
    tool: Tool = None,
    surgeon: Annotated[str | None, typer.Option(autocompletion=complete_surgeons)] = None,
) -> Answer:
    """Store a recording, and list the hand-offs proposed in it.

    Args:
        episode: An episode of a LeRobot dataset by its number, or all: each becomes a recording.
        surgeon: The surgeon who was recorded: `skills erase` then finds it.
    """
    if episode == "all":
        return _add_all(path, about, tool, surgeon)
    with service() as client, ready_one(path, about, episode, tool) as (file, progress):
        stored = client.add_recording(file, surgeon=surgeon, progress=progress, **about)
    return _recording(stored)


@command(recordings, "preview")
def recording_preview(
    path: RecordingPath, about: TableKeywords, episode: OneEpisode = None, tool: Tool = None
) -> Answer:
    """Show what would be understood of a recording, above all of a table; nothing is stored."""
    with service() as client, ready_one(path, about, episode, tool) as (file, progress):
        seen = client.preview_recording(file, progress=progress, **about)
    return text(seen, *_understood(seen), "Nothing was stored.")


def _understood(seen: "RecordingPreview") -> Iterator[str]:
    for one in seen.columns:
        meaning = f"{one.quantity} in {one.unit}" if one.unit else one.quantity or "not used"
        yield f"column {one.name}: {meaning}"
    for motion, quality in zip(seen.motions, seen.quality, strict=True):
        x, y, z = quality.extent_mm
        rate = "" if quality.rate_hz is None else f" in {quality.duration_s:.3f} s, {quality.rate_hz:.1f} Hz"
        extent = f"extent x {x:.1f}, y {y:.1f}, z {z:.1f} mm"
        yield f"arm {motion.arm}, frame {motion.frame}, {motion.topic}: {motion.samples} samples{rate}; {extent}"
    for left in seen.left_out:
        yield f"left out {left.topic}: {left.because}"
    yield from (*_notes(seen), *_identified(seen), *count_dropped(seen))
    if not seen.timed:
        yield "No times: it is stored only with a rate (--rate-hz) or a column of times."


@dataclass
class _Sent:
    """The outcome of storing one episode."""

    episode: int
    recording: str | None = None
    proposed: int = 0
    problem: str | None = None


def _add_all(path: Path, about: TableKeywords, tool: Sequence[str] | None, surgeon: str | None) -> Answer:
    """Store every episode of a LeRobot dataset; those that are refused do not stop the others, and give exit code 1."""
    from skills.client import Problem
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    done: list[_Sent] = []
    column, frame = about.get("column"), about.get("frame")
    with service() as client, find_dataset(path) as dataset:
        if dataset is None:
            raise refused_of_dataset(path)
        for episode in choose_episodes(dataset, "all"):
            sent = _Sent(episode.number)
            try:
                with ready_episode(dataset, episode, column, tool) as (file, progress):
                    stored = client.add_recording(file, frame=frame, surgeon=surgeon, progress=progress)
                sent.recording, sent.proposed = stored.sha256, len(stored.segments)
            except (Problem, BadInput) as error:
                sent.problem = error.words(Door.COMMAND)
            done.append(sent)
    columns = ("episode", "recording", "proposed", "problem")
    return table([vars(one) for one in done], columns, exit_code=1 if any(one.problem for one in done) else 0)


@command(recordings, "list")
def recording_list() -> Answer:
    """List recordings, the newest first."""
    with service() as client:
        return table(client.recordings(), ("id", "format", "duration_s", "arms", "segments", "demos"))


@command(recordings, "show")
def recording_show(recording: RecordingId) -> Answer:
    """Show the content of a recording, and the hand-offs proposed in it."""
    with service() as client:
        return _recording(client.recording(recording))


@command(recordings, "delete")
def recording_delete(recording: RecordingId) -> Answer:
    """Delete a recording without demonstrations permanently; allowed to its uploader and to admins."""
    with service() as client:
        client.delete_recording(recording)
    return outcome(f"The recording {recording} is deleted.", recording=recording, deleted=True)


def _recording(stored: "Recording") -> Answer:
    def show() -> None:
        say(f"{stored.sha256}  {stored.format}, {stored.duration_s:.1f} s, integrity {stored.integrity}")
        say(*_notes(stored), *count_dropped(stored), *_identified(stored))
        show_table(stored.segments, ("arm", "start_s", "end_s", "reason"))

    return Answer(stored, show)


def _notes(found: "Recording | RecordingPreview") -> list[str]:
    return [f"{name}: {value}" for name, value in found.notes.items()]


def _identified(found: "Recording | RecordingPreview") -> list[str]:
    return [f"{one.topic}: {one.found.verdict}: {one.found.reason}" for one in found.identifications]


def count_dropped(stored: "Recording | RecordingPreview") -> list[str]:
    """Return a line for each count of samples that were dropped, or repeat the one before."""
    repeated = [(one.duplicate_stamps, one.topic, "with a repeated stamp dropped") for one in stored.motions]
    back = [(one.backward_stamps, one.topic, "with a stamp that went back dropped") for one in stored.dropped]
    equal = [(one.equal_samples, one.topic, "equal to the sample before") for one in stored.quality]
    return [f"{topic}: samples {what}: {count}" for count, topic, what in (*repeated, *back, *equal) if count]


# ---- the table of a folder -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Row:
    """A row of the table: a recording, or an episode of a dataset."""

    name: str
    source: str
    stated: str
    format: str
    samples: str = ""
    understood: str = ""
    refused: str = ""


HEADINGS = ("recording", "source", "stated", "format", "samples", "understood", "refused because")


@command(recordings, "table")
def recording_table(folder: Annotated[Path, typer.Argument(file_okay=False)], stated: Path | None = None) -> Answer:
    """Show what would be understood of each recording in a folder, and why others are refused; nothing is stored.

    Args:
        folder: A folder with recordings, at any depth.
        stated: A TOML file with what the recordings do not say (docs/recordings.md).
    """
    from skills.schemas.recordings import StatedIn

    statements = {} if stated is None else _statements(stated)
    rows: list[_Row] = []
    with service() as client:
        for path in _recordings_in(folder):
            name = path.relative_to(folder).as_posix()
            about = next((one for pattern, one in statements.items() if fnmatch(name, pattern)), StatedIn())
            rows += _rows(client, path, name, about)

    def show() -> None:
        for line in (HEADINGS, ["---"] * len(HEADINGS), *(vars(row).values() for row in rows)):
            print("|", " | ".join(cell.replace("|", "\\|") for cell in line), "|")

    return Answer([vars(row) for row in rows], show)


def _statements(path: Path) -> "dict[str, StatedIn]":
    """Read the statements about recordings, by name or pattern.

    Raises:
        BadInput: It is not TOML, or states something that a preview does not take.
    """
    from pydantic import ValidationError

    from skills.schemas.recordings import StatedIn

    try:
        return {name: StatedIn.model_validate(one) for name, one in tomllib.loads(path.read_text()).items()}
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


def _rows(client: "Client", path: Path, name: str, stated: "StatedIn") -> Iterator[_Row]:
    """Yield the row of a recording, or one for each episode of a dataset."""
    from skills.client import Problem
    from skills.formats.lerobot.cut import choose_episodes, find_dataset

    words = " ".join(f"`{word}`" for word in _words(stated))
    try:
        with find_dataset(path) as dataset:
            episodes = None if dataset is None else choose_episodes(dataset, stated.episode or "all")
    except SkillsError as error:
        yield _Row(name, stated.source, words, path.suffix[1:], refused=first_sentence(error))
        return
    for episode in [None] if episodes is None else [str(one.number) for one in episodes]:
        label = name if episode is None else f"{name}, episode {episode}"
        try:
            seen = _preview(client, path, stated, episode or stated.episode)
        except SkillsError as error:
            if not (isinstance(error, BadInput) or (isinstance(error, Problem) and error.status in REFUSES)):
                raise  # it says nothing about the recording
            yield _Row(label, stated.source, words, path.suffix[1:], refused=first_sentence(error))
        else:
            samples = dict.fromkeys(str(motion.samples) for motion in seen.motions)
            yield _Row(label, stated.source, words, seen.format, ", ".join(samples), "; ".join(_facts(seen)))


def _words(stated: "StatedIn") -> Iterator[str]:
    """Yield the options that state the same."""
    for option, value in stated.model_dump(exclude_unset=True, exclude={"source"}).items():
        for one in value if isinstance(value, list) else [value]:
            yield f"--{option.replace('_', '-')} {typed(one)}"


def _preview(client: "Client", path: Path, stated: "StatedIn", episode: str | None) -> "RecordingPreview":
    about: TableKeywords = stated.model_dump(exclude_none=True, exclude={"source", "episode", "tool"})  # type: ignore[assignment]
    with ready_one(path, about, episode, stated.tool) as (file, _):
        return client.preview_recording(file, **about)


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


# ---- proposals -------------------------------------------------------------------------------------------------------

PROPOSAL = ("recording", "number", "state", "arm", "start_s", "end_s", "found_by", "surgeon", "suture", "note")
Number = Annotated[int, typer.Argument(help="The number of the proposal, counted from 1.")]
Note = Annotated[str | None, typer.Option(help="Why.")]


@command(proposals, "list")
def proposal_list(
    state: Literal["open", "accepted", "rejected"] | None = None,
    recording: str | None = None,
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
) -> Answer:
    """List the hand-offs proposed in recordings, those of the newest recording first.

    Args:
        state: Only those in this state.
        recording: Only those of this recording, by its digest.
    """
    with service() as client:
        return _proposals(client.proposals(state, recording=recording, surgeon=surgeon, suture=suture))


@command(proposals, "accept", without=("arm", "topic", "segment"))
def proposal_accept(recording: RecordingId, number: Number, cut: DemoKeywords) -> Answer:
    """Cut a demonstration where a hand-off is proposed, with its times or with corrected ones."""
    with service() as client:
        proposed = client.recording(recording).segments
        if not 1 <= number <= len(proposed):
            raise BadInput(
                f"There is no proposal {number} in this recording; it has {len(proposed)}.",
                f"List them: skills proposal list --recording {recording}",
            )
        one = proposed[number - 1]
        cut["arm"] = one.arm
        cut.setdefault("start_s", one.start_s)
        cut.setdefault("end_s", one.end_s)
        added = client.cut_demo(recording, **cut)
    return measured(added)


@command(proposals, "reject")
def proposal_reject(recording: RecordingId, number: Number, note: Note = None) -> Answer:
    """Reject a proposed hand-off; it stays rejected until it is opened again."""
    with service() as client:
        return _proposals([client.decide_proposal(recording, number, "rejected", note=note)])


@command(proposals, "open")
def proposal_open(recording: RecordingId, number: Number, note: Note = None) -> Answer:
    """Open a rejected proposal again."""
    with service() as client:
        return _proposals([client.decide_proposal(recording, number, "open", note=note)])


def _proposals(found: "list[Proposal]") -> Answer:
    times = [{"start_s": f"{one.start_s:.2f}", "end_s": f"{one.end_s:.2f}"} for one in found]
    rows = [one.model_dump() | {"recording": one.recording[:12]} | at for one, at in zip(found, times, strict=True)]
    return table(found, PROPOSAL, rows=rows)
