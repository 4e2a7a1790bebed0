"""Inspection of an installation: the schema, every stored value and digest, and the references between rows.

    Database --inspect_installation--> Checked, part by part

Tables and their packed values are taken from the models, so a new table is checked without being named here. The input
of a row's digest differs from table to table: `AGREES` has a check for each. Cached contents of recordings are compared
with their bytes, decoded again; policies with their certificates, computed again, and on request with themselves,
learnt again (`skills.library.policies.relearning`). Rows are named by table and number, never by a pseudonym. Nothing
is changed, and transactions are short, so that other users are not blocked.
"""

import hashlib
import secrets
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from sqlalchemy import Column, ColumnElement, ForeignKey, Table, case, exists, func, select, text, tuple_
from sqlalchemy.orm import Mapper, Session, defer, object_session

from skills.db import Base, models
from skills.db.packed import Packed, digest
from skills.db.revisions import revision_of, revisions
from skills.db.service_tables import DatasetChunk, ErasedSurgeon, Job, StoredDataset
from skills.db.session import Database
from skills.errors import Busy, Corrupt, NotFound, SkillsError, StorageFull
from skills.formats.parsed import parse_recording
from skills.formats.reader_process import READER_VERSION
from skills.gridworld.reward import sparse_reward
from skills.library.comparison.calibrations import read_calibration
from skills.library.operation.history import Verified, verify_history
from skills.library.operation.integrity import OF_DEMO, covered, demo_identity, planned, posed
from skills.library.operation.jobs import identity_of
from skills.library.policies.combined import learnt_from
from skills.library.policies.pose_styles import poses_of_demonstrations
from skills.library.policies.relearning import Recomputed, StoredRecordings, compute_again, decoded, learn_again
from skills.library.recordings.content_cache import alike, cached_content, read_entry
from skills.library.recordings.recordings import Parser, recording_bytes
from skills.settings import Settings
from skills.transparency.notes import Note

ROWS_AT_ONCE = 100
WITH_OTHERS = {models.RecordingChunk, models.ParsedChunk, DatasetChunk}  # checked with the row that they belong to
HISTORY = "history signed"
NAMED = 20  # orphans that are named for one reference, of all that are counted

OTHER_DIGEST = "it does not match its digest"

Why = Iterator[str]


@dataclass
class Checked:
    """The result for one part: the number of items that were checked, and the faulty ones, each with the reason."""

    what: str
    count: int = 0
    wrong: list[tuple[str, str]] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)  # not, or not wholly, compared, each with the reason
    of: int | None = None  # the number of items that will be checked, where it is known before

    @contextmanager
    def noting(self, name: str) -> Iterator[None]:
        """Note an error of the block, such as of a damaged page of the database file, under a name.

        Raises:
            Busy: The database cannot be read any more.
        """
        try:
            yield
        except Busy:
            raise
        except Exception as error:
            self.wrong.append((name, _describe(error)))


def inspect_installation(
    database: Database,
    parse: Parser = parse_recording,
    *,
    decode_all: bool = False,
    heads: Sequence[Note] | None = None,
    relearn: Settings | None = None,
    limit: int | None = None,
) -> Iterator[Checked]:
    """Check everything that is stored, part by part.

    Args:
        database: The database, without restriction.
        parse: The reader of recordings, possibly in another process.
        decode_all: Decode every recording whose content is cached, and not only the newest.
        heads: Signed heads of the history that were kept elsewhere; None: those of the database's own file.
        relearn: The limits of time and memory with which every policy is learnt again; None: none is.
        limit: Learn at most this number of policies again, drawn at random each time; None: all.

    Yields:
        Each part at its start, during its progress, and at its end.

    Raises:
        Busy: The database cannot be read any more.
    """
    yield from _at_once("schema", _schema, database)
    if database.engine.dialect.name == "sqlite":
        yield from _at_once("database file", _file, database)
    yield from _at_once("references", _references, database)
    yield from _at_once(HISTORY, partial(_history, heads, database), database)
    for mapper in sorted(Base.registry.mappers, key=lambda one: one.local_table.name):  # type: ignore[attr-defined]
        # Every model that the registry knows, so that a new table cannot be forgotten.
        if mapper.class_ not in WITH_OTHERS:
            yield from _rows(database, mapper)
    yield from _decoded_again(database, parse, decode_all)
    yield from inspect_policies(database, parse, relearn, limit)


def _at_once(what: str, look: Callable[[Session, Checked], None], database: Database) -> Iterator[Checked]:
    checked = Checked(what)
    yield checked
    with checked.noting(what), database.reading() as session:
        look(session, checked)
    yield checked


# ---- the installation --------------------------------------------------------------------------------------------


def _schema(session: Session, checked: Checked) -> None:
    checked.count = 1
    revision = revision_of(session.connection())
    if revision != revisions()[0]:
        checked.wrong.append(("schema", f"it is at {revision}, this version needs {revisions()[0]}; migrate it"))


def _file(session: Session, checked: Checked) -> None:
    checked.count = session.scalar(text("PRAGMA page_count")) or 0
    said = session.scalars(text(f"PRAGMA integrity_check({NAMED})")).all()
    checked.wrong += [("database file", line) for line in said if line != "ok"]


def _references(session: Session, checked: Checked) -> None:
    """Find rows with a foreign key to a row that does not exist."""
    for table in Base.metadata.sorted_tables:
        keys = list(table.foreign_keys)
        if not keys:
            continue
        orphans = [key.parent.is_not(None) & ~_has_parent(key) for key in keys]
        counts = [func.count(key.parent) for key in keys] + [func.count(case((orphan, 1))) for orphan in orphans]
        found = session.execute(select(*counts).select_from(table)).one()
        checked.count += sum(found[: len(keys)])
        for key, orphan, lost in zip(keys, orphans, found[len(keys) :], strict=True):
            for row in session.execute(select(*table.primary_key).where(orphan).limit(NAMED)) if lost else ():
                why = f"its {key.parent.name} has no row in {key.column.table.name}"
                checked.wrong.append((_name(table, row), why))
    # Without a foreign key, because they are deleted after the row to which they belong.
    for column, owner, late in (
        (models.RecordingChunk.recording, models.StoredRecording, models.LooseChunks.recording_row),
        (Job.surgeon_row, models.Surgeon, ErasedSurgeon.surgeon_row),
    ):
        table = Base.metadata.tables[column.class_.__tablename__]
        left = (column.is_not(None), ~exists().where(owner.row == column), ~exists().where(late == column))
        for row in session.execute(select(*table.primary_key).where(*left).limit(NAMED)):
            checked.wrong.append((_name(table, row), f"its {column.key} has no row in {owner.__tablename__}"))
        due = Base.metadata.tables[late.class_.__tablename__]
        for number in session.scalars(select(late).where(exists().where(owner.row == late)).limit(NAMED)):
            why = f"it says that {owner.__tablename__} {number} was deleted, which exists"
            checked.wrong.append((_name(due, [number]), why))


def _has_parent(key: ForeignKey) -> ColumnElement[bool]:
    other = key.column.table.alias()
    return exists().where(other.c[key.column.name] == key.parent)


def _history(heads: Sequence[Note] | None, database: Database, session: Session, checked: Checked) -> None:
    """Verify the history in one transaction: its leaves and the rows must be of the same state."""
    done = Verified()
    checked.wrong += verify_history(session.connection(), database.history, heads, done)
    checked.count = done.leaves + done.rows


# ---- rows --------------------------------------------------------------------------------------------------------


def _rows(database: Database, mapper: Mapper[Any]) -> Iterator[Checked]:
    table = mapper.local_table
    assert isinstance(table, Table)
    checked = Checked(table.name)
    yield checked
    keys, last = list(table.primary_key), None
    while True:
        query = select(*keys).order_by(*keys).limit(ROWS_AT_ONCE)
        if last is not None:
            query = query.where(tuple_(*keys) > tuple_(*last))
        page: list[tuple[Any, ...]] = []
        with checked.noting(f"{table.name} after {last}"), database.reading() as session:
            page = [tuple(row) for row in session.execute(query)]
            for key, why in _look(session, mapper, keys, page):
                checked.wrong.append((_name(table, key), why))
        checked.count += len(page)
        if len(page) < ROWS_AT_ONCE:
            break
        last = page[-1]
        yield checked
    yield checked


def _look(
    session: Session, mapper: Mapper[Any], keys: list[Column[Any]], page: list[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], str]]:
    """Check a page of rows; yield the key of each faulty one, and the reason."""
    packed = packed_values(mapper)
    later = [defer(getattr(mapper.class_, name)) for name in packed]
    try:
        rows = deque(session.scalars(select(mapper.class_).options(*later).where(tuple_(*keys).in_(page))))
    except Exception:  # one of them cannot be read; reading each alone finds which
        rows = deque()
        for key in page:
            try:
                row = session.get(mapper.class_, key, options=later)
            except Exception as error:
                yield key, _describe(error)
            else:
                rows.extend([] if row is None else [row])  # None: erased since the page was read
    while rows:
        row = rows.popleft()
        key = mapper.primary_key_from_instance(row)
        for why in _wrong_with(row, packed):
            yield tuple(key), why
        session.expire(row, packed)  # frees the values: a page of large ones does not fit into memory


def packed_values(mapper: Mapper[Any]) -> list[str]:
    """Return the names of a model's attributes that hold packed values."""
    return [one.key for one in mapper.column_attrs if isinstance(one.columns[0].type, Packed)]


def _wrong_with(row: Any, packed: Sequence[str]) -> Why:
    """Yield the faults of a row: a value that cannot be read, otherwise values that do not match the digest."""
    for name in packed:
        try:
            getattr(row, name)
        except Exception as error:
            yield f"{name}: {_describe(error)}"
            return
    try:
        VERIFIED.get(type(row), lambda _: None)(row)
        yield from AGREES.get(type(row), lambda _: iter(()))(row)
    except Exception as error:
        yield _describe(error)


def _name(table: Table, key: Sequence[Any]) -> str:
    return f"{table.name} {'/'.join(map(str, key))}"


def _describe(error: Exception) -> str:
    """Return an error as text; one that is not ours might quote stored values, so only its type is named."""
    return error.words() if isinstance(error, SkillsError) else f"it cannot be read ({type(error).__name__})"


# ---- the cache of recordings -------------------------------------------------------------------------------------


def _decoded_again(database: Database, parse: Parser, every: bool) -> Iterator[Checked]:
    """Compare cached contents with their recordings decoded again: of the newest recording, or of every one."""
    checked = Checked("recordings decoded")
    yield checked
    query = select(models.ParsedRecording.recording_row).where(models.ParsedRecording.version == READER_VERSION)
    query = query.order_by(models.ParsedRecording.recording_row.desc())
    rows: Sequence[int] = ()
    with checked.noting(checked.what), database.reading() as session:
        rows = session.scalars(query if every else query.limit(1)).all()
    for row in rows:
        name = f"recordings {row}"
        try:
            with checked.noting(name):
                checked.wrong += [(name, why) for why in _decoded_otherwise(database, row, parse)]
        except StorageFull as full:  # of temporary files: all else is verified on a full disk too
            checked.left_out.append((name, full.message))
        checked.count += 1
        yield checked
    yield checked


def _decoded_otherwise(database: Database, row: int, parse: Parser) -> Why:
    """Yield the fault of a cached content: it differs from the recording's bytes. Damaged ones are found before."""
    with database.reading() as session:
        stored = session.get(models.StoredRecording, row)
        kept = None if stored is None else cached_content(session, stored)
    if kept is None:  # erased or replaced since, or damaged
        return
    try:
        again = decoded(database, row, parse)
    except Busy:
        raise
    except (Corrupt, NotFound):  # damaged bytes are reported with the recording; it was erased since
        return
    except SkillsError as error:
        yield f"its content is cached, but it cannot be decoded again: {error.words()}"
        return
    parts = ("recording", "proposed", "identifications", "bases")
    if not all(alike(getattr(kept, part), getattr(again, part)) for part in parts):
        rows = "parsed_chunks and parsed_recordings"
        yield f"its cached content differs from its bytes; delete its rows of {rows}, which are written again"


# ---- policies computed and learnt again ------------------------------------------------------------------------------


def inspect_policies(
    database: Database, parse: Parser, relearn: Settings | None, limit: int | None = None
) -> Iterator[Checked]:
    """Learn policies again if wanted, and compute the certificates of the others again; see `inspect_installation`."""
    done: set[int] = set()
    if relearn is not None:
        learn = partial(learn_again, database, recordings=StoredRecordings(database, parse), settings=relearn)
        yield from _again(database, Checked("policies learnt again"), limit, learn, done)
    yield from _again(database, Checked("certificates"), None, partial(compute_again, database), done)


def _again(
    database: Database, checked: Checked, limit: int | None, compare: Callable[[int], Recomputed], done: set[int]
) -> Iterator[Checked]:
    """Compute policy versions again that are not done yet, and compare each with what is stored."""
    yield checked
    rows: list[int] = []
    with checked.noting(checked.what), database.reading() as session:
        every = session.scalars(select(models.PolicyVersion.row).order_by(models.PolicyVersion.row))
        rows = [row for row in every if row not in done]
    if limit is not None and limit < len(rows):
        rows = sorted(secrets.SystemRandom().sample(rows, limit))
    checked.of = len(rows)
    for row in rows:
        name = f"{models.PolicyVersion.__tablename__} {row}"
        with checked.noting(name), suppress(Corrupt, NotFound):  # reported with the row; erased since
            found = compare(row)
            if found.left_out is None:
                done.add(row)
            else:
                checked.left_out.append((name, found.left_out))
            if found.differing:
                checked.wrong.append((name, f"computed again, it has other results: {', '.join(found.differing)}"))
        checked.count += 1
        yield checked
    yield checked


# ---- the input of each digest, and values that must agree --------------------------------------------------------


def _session_of(row: Any) -> Session:
    session = object_session(row)
    assert session is not None
    return session


def _recording(row: models.StoredRecording) -> Why:
    size = sum(len(piece) for piece in recording_bytes(_session_of(row), row))  # raises `Corrupt` if the digest differs
    if size != row.size_bytes:
        yield f"it has {size} bytes, its row has {row.size_bytes}"


def _entry(row: models.ParsedRecording) -> None:
    session = _session_of(row)
    if row.version == READER_VERSION:  # others are not used
        read_entry(session, session.get_one(models.StoredRecording, row.recording_row))


def _dataset(row: StoredDataset) -> Why:
    hasher, size = hashlib.sha256(), 0
    query = select(DatasetChunk.data).where(DatasetChunk.dataset_row == row.row).order_by(DatasetChunk.number)
    for data in _session_of(row).scalars(query.execution_options(yield_per=1)):
        hasher.update(data)
        size += len(data)
    if hasher.hexdigest() != row.sha256:
        yield OTHER_DIGEST
    if size != row.size_bytes:
        yield f"it has {size} bytes, its row has {row.size_bytes}"


def _demonstration(row: models.Demonstration) -> Why:
    if demo_identity(row.recording.sha256, row.surgeon.slug, row.suture, row.demo, row.path) != row.sha256:
        yield OTHER_DIGEST
    if row.hysteresis != row.path.hysteresis:
        yield "its hysteresis differs from that of its path"
    for name in OF_DEMO:
        if getattr(row, name) != getattr(row.demo, name):
            yield f"its {name} differs from the recording"


def _reward_map(row: models.StoredRewardMap) -> Why:
    if digest(row.map) != row.sha256:
        yield OTHER_DIGEST
    path = _session_of(row).get_one(models.Demonstration, row.demonstration_row).path
    if digest(sparse_reward(path, row.map.levels)) != row.sha256:
        yield "it differs from the result of Algorithm 1 for its demonstration"


def _policy(row: models.PolicyVersion) -> Why:
    manifest, demonstrations = row.manifest, row.demonstrations
    refused = manifest.grid_certificate.refused_because
    styles = {(one.surgeon_row, one.suture) for one in demonstrations}
    faults = {
        "it differs from the certified policy": manifest.identity(digest(row.learnt)) != row.sha256,
        "its flag `releasable` contradicts its certificate": row.releasable == bool(refused),
        "its manifest names another style": manifest.style != (row.surgeon.slug, row.suture),
        "its manifest states another scene than it was learnt in": manifest.surroundings != row.learnt.surroundings,
        "it was learnt from another demonstration": manifest.demos != [one.sha256 for one in demonstrations],
        "its demonstration is of another style": styles != {(row.surgeon_row, row.suture)},
    }
    yield from (why for why, has_it in faults.items() if has_it)
    if digest(row.learnt.path) != digest(learnt_from(row).path):
        yield "its path differs from that of its demonstration"
    covered(row)  # raises `Corrupt`


def _poses(row: models.StoredPoses) -> Why:
    poses = posed(row)
    own = replace(poses.path, partner=None)  # the other arm's motion is in recordings alone: `relearning.learn_again`
    again = poses_of_demonstrations(row.policy)
    if again is None or not alike(own, again.path) or poses.frame != again.frame:
        yield "it differs from the poses of its version's demonstrations"


def _release(row: models.Release) -> Why:
    policy = row.policy
    if (policy.surgeon_row, policy.suture) != (row.surgeon_row, row.suture):
        yield "it releases a policy of another style"
    if not policy.releasable:
        yield "its policy did not pass the gate"
    if row.withdrawn_at is None:
        yield from (f"it is not withdrawn, but its demonstration {one.text}" for one in policy.objections)


def _playback(row: models.StoredPlayback) -> Why:
    if (row.report.plan, row.report.identity) != (row.plan.sha256, row.sha256):
        yield "it does not match the digest of plan and verdict"
    if row.feasible != row.report.feasible:
        yield "its flag `feasible` contradicts its report"
    if digest(row.measured.trajectory) != row.report.trajectory:
        yield "its motion is not the one that was judged"


def _job(row: Job) -> Why:
    if identity_of(row.kind, row.request) != row.identity:
        yield "its request does not match its identity"


# By the class of a row: what raises an error where the row does not match its digest, and what yields its faults.
VERIFIED: dict[type, Callable[[Any], object]] = {
    models.ParsedRecording: _entry,
    models.Plan: planned,
    models.StoredCalibration: read_calibration,
}
AGREES: dict[type, Callable[[Any], Why]] = {
    models.StoredRecording: _recording,
    StoredDataset: _dataset,
    models.Demonstration: _demonstration,
    models.StoredRewardMap: _reward_map,
    models.PolicyVersion: _policy,
    models.StoredPoses: _poses,
    models.Release: _release,
    models.StoredPlayback: _playback,
    Job: _job,
}
