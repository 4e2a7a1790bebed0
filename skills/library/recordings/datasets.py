"""Exports of demonstrations as LeRobot datasets: requested, written by a worker, and stored as a zip file in chunks.

    DatasetIn --request_dataset--> Job, with its demonstrations and their splits
    Job's request --export_dataset--> zip --store--> StoredDataset with its chunks

An episode is the interval of one demonstration, or one whole recording. The zip has no pseudonym and no digest of a
demonstration. It is written one episode at a time, so memory depends on the longest recording only.

The consent to export is checked when a dataset is requested, when it is stored, and for each chunk of a download: of
every surgeon who is recorded in it, also of one whose demonstration was added to the recording afterwards.
"""

import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from hashlib import file_digest
from json import load
from shutil import copyfileobj
from tempfile import TemporaryFile
from time import monotonic
from typing import IO, Any, ClassVar, Literal, NamedTuple, TypeVar, cast
from zipfile import ZipFile, ZipInfo

from sqlalchemy import ColumnElement, Select, Table, delete, exists, insert, or_, select
from sqlalchemy.orm import Session

from skills.db import in_parts
from skills.db.models import CHUNK_BYTES, SUCCESS, Demonstration, StoredRecording, Surgeon, SutureType
from skills.db.service_tables import DatasetChunk, DatasetDemonstration, Job, StoredDataset, record_event, record_events
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound, TooLarge
from skills.formats.lerobot import INFO
from skills.formats.lerobot.writer import (
    SHARES,
    SPLITS,
    AboutDataset,
    ExportedEpisode,
    Split,
    Version,
    action_rule,
    dataset_files,
)
from skills.library.operation import jobs
from skills.library.operation.integrity import find_by_digest
from skills.library.operation.jobs import EXPORT, UNSYNCHRONISED, JobRequest, RequestedJob, Store
from skills.library.people import consent
from skills.library.people.recorded import RECORDED, episodes_of, overlap, recorded_in
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.recordings.demos import find_demo
from skills.library.recordings.recordings import Parser, confined_reader, stored_recording
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.schemas.datasets import DatasetEpisode, DatasetEpisodes, DatasetIn
from skills.schemas.results import DatasetResult
from skills.settings import Settings

Group = TypeVar("Group", int, str)
MOST = 20_000  # demonstrations of a dataset, ours: their rows are in memory at once
MARKED: tuple[Split, ...] = ("recovery", "failure")  # the splits of demonstrations that are marked so
PROGRESS_S = 0.5  # progress is stored about so often, each time in a transaction

_EXPORTED, _DEMOS = (cast(Table, one.__table__).alias() for one in (DatasetDemonstration, Demonstration))
EPISODE = (_DEMOS.c.recording_row, _DEMOS.c.surgeon_row, _DEMOS.c.start_s, _DEMOS.c.end_s)


# ---- request -------------------------------------------------------------------------------------------------------


class DatasetRequest(JobRequest):
    """The request of an export's job: the contents of its README, and the digest of its demonstrations and splits."""

    kind: ClassVar[str] = EXPORT

    name: str
    version: Version
    fps: int
    arms: list[str]
    whole: bool
    split: Literal["surgeon", "session"]
    licence: str
    description: str
    procedure: str
    consent: str  # as sentences, without a pseudonym
    episodes: int
    demos_sha256: str


class _Chosen(NamedTuple):
    """A demonstration to export: as few of its columns as needed, because there may be many."""

    row: int
    sha256: str
    recording_row: int
    surgeon_row: int
    withdrawn_at: object
    outcome: str | None


def request_dataset(session: Session, asked: DatasetIn, actor: str) -> RequestedJob:
    """Queue an export, with all defaults resolved.

    Args:
        session: The caller's transaction.
        asked: The request. Without `demos` all demonstrations are meant that the caller may see, and that fit the
            filters and the outcomes; without `arms` those that all of their recordings have.
        actor: The owner of the caller's key.

    Raises:
        NotFound: A demonstration, a surgeon or a suture type is unknown.
        Conflict: No demonstration fits, or too many; one was withdrawn, or is marked recovery or failure without
            outcomes "any"; or a consent does not cover the export.
        BadInput: A demonstration is named twice; or the recordings have no arm in common, or not the requested ones.
    """
    chosen = _chosen(session, asked)
    splits = _splits(chosen, asked)
    arms = _arms(session, chosen, asked.arms)
    recorded = recorded_in(session, episodes_of([one.row for one in chosen], whole=asked.whole))
    try:
        recorded.require("export", {one.surgeon_row for one in chosen})
    except Conflict as refused:
        if asked.demos is None:
            refused.remedies = (*refused.remedies, Remedy(Action.LEAVE_OUT_SURGEON))
        raise
    request = DatasetRequest(
        **asked.model_dump(include={*DatasetRequest.model_fields}) | {"arms": arms},
        consent=describe_consents(recorded.surgeons),
        episodes=len({one.recording_row for one in chosen}) if asked.whole else len(chosen),
        demos_sha256=sha256(canonical([[one.sha256, splits[one.row]] for one in chosen])),
    )
    requested = jobs.ask(session, request, None, actor)
    if requested.new:
        exported = [
            {"job_row": requested.job.row, "demonstration_row": one.row, "split": splits[one.row], "whole": asked.whole}
            for one in chosen
        ]
        session.execute(insert(DatasetDemonstration), exported)
    return requested


def _chosen(session: Session, asked: DatasetIn) -> list[_Chosen]:
    of = Demonstration
    query = select(of.row, of.sha256, of.recording_row, of.surgeon_row, of.withdrawn_at, of.outcome).order_by(of.row)
    if asked.demos is not None:
        rows = sorted(find_demo(session, one).row for one in asked.demos)
        if len({*rows}) < len(rows):
            raise BadInput("A demonstration is named twice; name each once.")
        found = [_Chosen(*one) for some in in_parts(rows) for one in session.execute(query.where(of.row.in_(some)))]
        for one in found:
            _refuse_unfit(one, any_outcome=asked.outcomes == "any")
        return found
    query = query.where(of.withdrawn_at.is_(None) if asked.outcomes == "any" else of.learnable)
    if asked.surgeons is not None:
        query = query.where(of.surgeon_row.in_([find_surgeon(session, one).row for one in asked.surgeons]))
    if asked.without_surgeons is not None:
        query = query.where(of.surgeon_row.not_in([find_surgeon(session, one).row for one in asked.without_surgeons]))
    if asked.sutures is not None:
        query = query.where(of.suture.in_([find_suture_type(session, one).slug for one in asked.sutures]))
    found = [_Chosen(*one) for one in session.execute(query.limit(MOST + 1))]
    if not found:
        raise Conflict("There is no demonstration to export.", Remedy(Action.LIST_DEMOS))
    if len(found) > MOST:
        raise Conflict(f"More than {MOST} demonstrations would be exported; narrow the request by surgeon or suture.")
    return found


def _refuse_unfit(one: _Chosen, *, any_outcome: bool) -> None:
    if one.withdrawn_at is not None:
        raise Conflict(f"The demonstration {one.sha256[:12]} was withdrawn; leave it out.")
    if one.outcome not in (None, SUCCESS, *(MARKED if any_outcome else ())):
        raise Conflict(
            f"The demonstration {one.sha256[:12]} is marked {one.outcome}; leave it out, or export it with "
            "outcomes 'any', in a split of its own."
        )


def _splits(chosen: Sequence[_Chosen], asked: DatasetIn) -> dict[int, Split]:
    """Return the split of each demonstration, by row; those of one episode are in the same one.

    A failure or a recovery is in the split of this name, and of a whole recording all demonstrations with it.
    """
    episode = {one.row: one.recording_row if asked.whole else one.row for one in chosen}
    split: dict[int, Split] = {}  # by episode
    for outcome in MARKED:  # of both, the failure counts
        split |= {episode[one.row]: outcome for one in chosen if one.outcome == outcome}
    groups = _groups(chosen, asked)
    left = {episode[one.row]: groups[one.row] for one in chosen if episode[one.row] not in split}
    of_group = splits_by_group(Counter(left.values()))
    split |= {at: of_group[group] for at, group in left.items()}
    return {one.row: split[episode[one.row]] for one in chosen}


def _groups(chosen: Sequence[_Chosen], asked: DatasetIn) -> dict[int, int]:
    """Return the group of each demonstration that one split has all of: its recording, or its surgeon.

    Surgeons in one whole recording are one group.
    """
    if asked.split == "session":
        return {one.row: one.recording_row for one in chosen}
    group = {one.surgeon_row: one.surgeon_row for one in chosen}
    if asked.whole:
        first: dict[int, int] = {}  # a surgeon of each recording
        for one in chosen:
            mine, other = group[one.surgeon_row], group[first.setdefault(one.recording_row, one.surgeon_row)]
            if mine != other:
                group = {surgeon: other if now == mine else now for surgeon, now in group.items()}
    return {one.row: group[one.surgeon_row] for one in chosen}


def _arms(session: Session, chosen: Sequence[_Chosen], wanted: list[str] | None) -> list[str]:
    """Return the arms to export: the wanted ones, or those that all recordings have.

    Raises:
        BadInput: A recording has no pose of a wanted arm; or the recordings have no arm in common.
    """
    common: set[str] | None = None
    of = StoredRecording
    for some in in_parts(sorted({one.recording_row for one in chosen})):
        for name, about in session.execute(select(of.sha256, of.about).where(of.row.in_(some))):
            arms = {motion.arm for motion in about.motions}
            if missing := {*(wanted or ())} - arms:
                arm = sorted(missing)[0]
                raise BadInput(f"The recording {name[:12]} has no pose of {arm}; leave out one of the two.")
            common = arms if common is None else common & arms
    if not common:
        raise BadInput("The recordings have no arm in common; export those of each arm as a dataset of its own.")
    return sorted(common) if wanted is None else wanted


# ---- consent -------------------------------------------------------------------------------------------------------


def require_exportable(session: Session, job: Job) -> list[Surgeon]:
    """Refuse an export whose demonstrations may not be passed on now; return all surgeons who are recorded in it.

    Raises:
        Conflict: A consent does not cover it, or a demonstration was withdrawn.
    """
    exported = _DEMOS.join(_EXPORTED, _EXPORTED.c.demonstration_row == _DEMOS.c.row)
    of = select(_DEMOS.c.surgeon_row, _DEMOS.c.withdrawn_at).select_from(exported).distinct()
    found = session.execute(of.where(_EXPORTED.c.job_row == job.row)).all()
    episodes = select(*EPISODE, _EXPORTED.c.whole).select_from(exported).where(_EXPORTED.c.job_row == job.row)
    recorded = recorded_in(session, [episodes])
    recorded.require("export", {one.surgeon_row for one in found})
    if any(one.withdrawn_at is not None for one in found):
        raise Conflict("A demonstration in this dataset was withdrawn; export the others again.")
    return recorded.surgeons


def describe_consents(surgeons: Sequence[Surgeon]) -> str:
    """Return the consents of some surgeons as sentences for a README, without their pseudonyms."""
    agreed = [one for one in surgeons if one.consent is not None]
    ends = [day for one in agreed if (day := consent.last_day(one.consent)) is not None]
    until = f"; the first of these consents ends on {min(ends)}" if ends else ""
    words = [f"Surgeons recorded: {len(surgeons)}."]
    words += [f"Agreed to an export: {len(agreed)}{until}."] if agreed else []
    if rest := len(surgeons) - len(agreed):
        words.append(f"Without a recorded consent, so that the protocol of the study decides: {rest}.")
    return " ".join(words)


# ---- the job -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Episode:
    """An episode to write: a recording or an interval of it, and the demonstrations in it that were chosen."""

    recording: str  # the SHA-256 of its bytes
    split: Split
    task: str
    demos: tuple[str, ...]
    interval_s: tuple[float, float] | None


def export_dataset(database: Database, request: DatasetRequest, settings: Settings) -> Store[DatasetResult]:
    """Write the zip of a dataset to a temporary file; the returned function stores it.

    Raises:
        Conflict: The job was cancelled, or a consent does not cover the export any more.
        TooLarge: The zip would exceed the limit of the settings.
        BadRecording: A recording cannot be written as an episode; the message names its demonstration.
    """
    with database.reading() as session:
        job = jobs.find_live(session, request)
        if job is None:
            raise Conflict("The export was cancelled.")
        require_exportable(session, job)
        row, export, episodes = job.row, job.id, _episodes(session, job.row)
    unit = "whole recording" if request.whole else "needle hand-off, cut out of a recording"
    about = AboutDataset(
        name=request.name,
        arms=tuple(request.arms),
        fps=request.fps,
        licence=request.licence,
        consent=request.consent,
        description=f"{request.description} Each episode is one {unit}.",
        procedure=request.procedure,
        split_by=request.split,
        export=export,
    )
    progress = jobs.progress_callback(database, request)
    with ExitStack() as opened:
        file = opened.enter_context(TemporaryFile())
        read = confined_reader(settings)
        with closing(read.server):  # it starts at the first recording that is not cached
            # Read once more than written: whether all episodes have setpoints is known after the last one.
            rule = action_rule(_exported(database, read.parse, episodes, lambda _: progress(0.0)), about)
            about = replace(about, action=rule)
            exported = _exported(database, read.parse, episodes, progress)
            frames = write_dataset(file, exported, about, request.version, settings)
        size_bytes = file.tell()
        file.seek(0)
        made = file_digest(file, "sha256").hexdigest()
        until_stored = opened.pop_all()

    def store(session: Session, actor: str) -> DatasetResult:
        job = session.get_one(Job, row)
        surgeons = require_exportable(session, job)
        dataset = StoredDataset(sha256=made, job_row=row, size_bytes=size_bytes)
        session.add(dataset)
        session.flush()
        file.seek(0)
        for number, data in enumerate(iter(partial(file.read, CHUNK_BYTES), b"")):
            session.execute(insert(DatasetChunk), {"dataset_row": dataset.row, "number": number, "data": data})
        record_events(session, actor, "export", EXPORT, [(made, surgeon) for surgeon in surgeons])
        return DatasetResult(dataset=made, size_bytes=size_bytes, episodes=len(episodes), frames=frames)

    weakref.finalize(store, until_stored.close)  # and not at its end: a cancelled export is never stored
    return store


def _episodes(session: Session, job_row: int) -> list[_Episode]:
    """Return the episodes of an export, in the order of their splits, those of one recording after each other."""
    exported, of, recorded = DatasetDemonstration, Demonstration, StoredRecording
    columns = (exported.split, exported.whole, of.row, of.sha256, of.recording_row, of.start_s, of.end_s)
    query = select(*columns, recorded.sha256.label("recording"), SutureType.name.label("suture")).select_from(exported)
    query = query.join(of, of.row == exported.demonstration_row).join(recorded, recorded.row == of.recording_row)
    query = query.join(SutureType, SutureType.slug == of.suture).where(exported.job_row == job_row)
    found: dict[tuple[int, ...], list[Any]] = {}
    for one in session.execute(query.order_by(of.recording_row, of.start_s, of.row)):
        key = (one.recording_row,) if one.whole else (one.recording_row, one.row)
        found.setdefault(key, []).append(one)
    episodes = [
        _Episode(
            recording=some[0].recording,
            split=some[0].split,
            task=", ".join(sorted({one.suture for one in some})),
            demos=tuple(one.sha256 for one in some),
            interval_s=None if some[0].whole else (some[0].start_s, some[0].end_s),
        )
        for some in found.values()
    ]
    return sorted(episodes, key=lambda one: SPLITS.index(one.split))  # stable: of one split, recordings in order


def _exported(
    database: Database, read: Parser, episodes: Sequence[_Episode], progress: Callable[[float], None]
) -> Iterator[ExportedEpisode]:
    """Read the recordings one after another, and yield their episodes."""
    at, recording, due_s = None, None, 0.0
    for number, episode in enumerate(episodes):
        if (now_s := monotonic()) >= due_s:
            progress(number / (len(episodes) + 1))
            due_s = now_s + PROGRESS_S
        if recording is None or at != episode.recording:
            recording = None  # before the next one is read, so that only one is in memory
            try:
                recording, at = stored_recording(database, episode.recording, read).recording, episode.recording
            except NotFound:
                raise NotFound("A recording of the export was erased meanwhile; request it again.") from None
        source = f"demonstration {episode.demos[0][:12]}"
        spans = {
            name: recording.origin_ns + round(1e9 * at_s)
            for name, at_s in zip(("start_ns", "end_ns"), episode.interval_s or (), strict=False)
        }
        yield ExportedEpisode(recording, episode.task, episode.split, source=source, **spans)


def write_dataset(
    file: IO[bytes], episodes: Iterable[ExportedEpisode], about: AboutDataset, version: Version, settings: Settings
) -> int:
    """Write a dataset as a zip into an empty file; return the number of its frames.

    Nothing is compressed, because Parquet is already; and members have no date, so that a second attempt at a job
    writes the same bytes.

    Raises:
        TooLarge: The zip would exceed `max_dataset_bytes`.
    """
    frames = 0
    with ZipFile(file, "w") as archive:
        for name, content in dataset_files(episodes, about, version):
            if name == INFO:
                frames = load(content)["total_frames"]
                content.seek(0)
            with archive.open(ZipInfo(name), "w") as member:
                copyfileobj(content, member, CHUNK_BYTES)
            if file.tell() > settings.max_dataset_bytes:
                raise TooLarge(
                    f"The dataset is larger than {settings.max_dataset_bytes} bytes; export fewer demonstrations."
                )
    return frames


# ---- stored datasets -----------------------------------------------------------------------------------------------


def find_dataset(session: Session, dataset_sha256: str) -> StoredDataset:
    """Return a dataset by its digest."""
    return find_by_digest(session, StoredDataset, dataset_sha256, "dataset", Remedy(Action.LIST_DATASETS))


def episodes_of_dataset(session: Session, dataset_sha256: str) -> DatasetEpisodes:
    """Return the recording and the demonstrations of each episode of a dataset, in the order of their numbers."""
    found = _episodes(session, find_dataset(session, dataset_sha256).job_row)
    return DatasetEpisodes(
        whole=all(one.interval_s is None for one in found),
        episodes=[DatasetEpisode(recording=one.recording, demos=list(one.demos)) for one in found],
    )


def served_dataset(session: Session, dataset_sha256: str) -> StoredDataset:
    """Return a dataset, for a download.

    Raises:
        Conflict: A consent does not cover its export any more, or a demonstration in it was withdrawn.
    """
    dataset = find_dataset(session, dataset_sha256)
    require_exportable(session, session.get_one(Job, dataset.job_row))
    return dataset


def dataset_chunk(database: Database, dataset_sha256: str, number: int) -> bytes | None:
    """Return one chunk of a dataset, counted from 0, in a transaction of its own; None: there are no more.

    Raises:
        NotFound: It was erased since.
        Conflict: It may not be passed on any more.
    """
    with database.reading() as session:
        dataset = served_dataset(session, dataset_sha256)
        of = DatasetChunk.dataset_row == dataset.row, DatasetChunk.number == number
        return session.scalar(select(DatasetChunk.data).where(*of))


def delete_dataset(session: Session, dataset_sha256: str, actor: str) -> None:
    """Delete a dataset with its job, so that it can be requested again."""
    dataset = find_dataset(session, dataset_sha256)
    record_event(session, actor, "erase", EXPORT, dataset.sha256)
    drop_exports(session, [dataset.job_row])


def exports_of(which: ColumnElement[bool]) -> Select[int]:
    """Return the query of the jobs whose episodes have a demonstration, for a condition on `Demonstration`."""
    erased = select(Demonstration.row).where(which)
    mine = _EXPORTED.c.demonstration_row == _DEMOS.c.row
    of = select(_EXPORTED.c.job_row, _DEMOS.c.row, *EPISODE, _EXPORTED.c.whole).join(_EXPORTED, mine).subquery().c
    seen = exists().where(RECORDED.c.row.in_(erased), overlap(of))
    return select(of.job_row).where(or_(of.row.in_(erased), seen)).distinct()


def exports_from(recordings: Select[int]) -> Select[int]:
    """Return the query of the jobs that export some recordings or parts of them."""
    of_job = _EXPORTED.c.demonstration_row == _DEMOS.c.row
    seen = select(_EXPORTED.c.job_row).select_from(_EXPORTED).join(_DEMOS, of_job)
    return seen.where(_DEMOS.c.recording_row.in_(recordings)).distinct()


def drop_exports(session: Session, job_rows: Sequence[int]) -> None:
    """Delete exports with their jobs, in the caller's transaction."""
    for some in in_parts(job_rows):
        made = select(StoredDataset.row).where(StoredDataset.job_row.in_(some))
        for statement in (  # from the leaves to the roots, because of the foreign keys
            delete(DatasetChunk).where(DatasetChunk.dataset_row.in_(made)),
            delete(StoredDataset).where(StoredDataset.job_row.in_(some)),
            delete(DatasetDemonstration).where(DatasetDemonstration.job_row.in_(some)),
            delete(Job).where(Job.row.in_(some)),
        ):
            session.execute(statement, **UNSYNCHRONISED)


def splits_by_group(episodes: Mapping[Group, int]) -> dict[Group, Split]:
    """Assign each group of episodes, such as all of a surgeon, to training, validation or test.

    Args:
        episodes: The number of episodes of each group.

    Returns:
        The split of each group. The shares of the episodes approach `SHARES` as well as whole groups allow; one group
        alone is for training. Of equally large groups the first in their order is assigned first.
    """
    wanted: dict[Split, float] = {split: SHARES[split] * sum(episodes.values()) for split in SPLITS[:3]}
    chosen: dict[Group, Split] = {}
    for group, count in sorted(episodes.items(), key=lambda one: (-one[1], one[0])):
        split = max(SPLITS[:3], key=lambda split: wanted[split])
        chosen[group] = split
        wanted[split] -= count
    return chosen
