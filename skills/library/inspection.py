"""Whether an installation is whole: every stored value, every digest, and what rests on what.

Tables and their packed values are found among the models, so a new table is looked at without being named here. What
a row's digest was taken of is another matter for each: `AGREES` says it. Rows are named by table and number, never by
a pseudonym. Nothing is changed, and nothing is held for long, so that others can go on working.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Column, Table, exists, func, select, text, tuple_
from sqlalchemy.orm import Mapper, Session, defer, object_session

from skills.db.base import Base
from skills.db.books import Job
from skills.db.models import (
    Demonstration,
    Plan,
    PolicyVersion,
    RecordingChunk,
    Release,
    StoredCalibration,
    StoredPlayback,
    StoredRecording,
    StoredRewardMap,
)
from skills.db.packed import Packed, digest
from skills.db.schema import revision_of, revisions
from skills.db.session import Database
from skills.errors import Busy, SkillsError
from skills.library.calibrations import read_calibration
from skills.library.combined import path_of
from skills.library.jobs import identity_of
from skills.library.recordings import recording_bytes
from skills.library.verified import covered, demo_identity, planned, policy_identity
from skills.packing import canonical, sha256
from skills.style.reward import sparse_reward

ROWS_AT_ONCE = 100
WITH_OTHERS = {RecordingChunk}  # read where the recording that they make up is
NAMED = 20  # orphans of one reference; their number is told in any case

Why = Iterator[str]


@dataclass
class Checked:
    """What was looked at, how many of it, and which of them are wrong and why."""

    what: str
    count: int = 0
    wrong: list[tuple[str, str]] = field(default_factory=list)


def inspect_installation(database: Database) -> Iterator[Checked]:
    """Look at everything that is stored, part by part; each is given out as it begins, as it goes on, and at its end.

    Raises:
        Busy: The database cannot be read any more.
    """
    yield from _at_once("schema", _schema, database)
    if database.engine.dialect.name == "sqlite":
        yield from _at_once("database file", _file, database)
    yield from _at_once("references", _references, database)
    for mapper in sorted(Base.registry.mappers, key=lambda one: one.local_table.name):  # type: ignore[attr-defined]
        if mapper.class_ not in WITH_OTHERS:
            yield from _rows(database, mapper)


def _at_once(what: str, look: Callable[[Session, Checked], None], database: Database) -> Iterator[Checked]:
    checked = Checked(what)
    yield checked
    try:
        with database.reading() as session:
            look(session, checked)
    except Busy:
        raise
    except Exception as error:
        checked.wrong.append((what, _in_words(error)))
    yield checked


# ---- the whole ---------------------------------------------------------------------------------------------------


def _schema(session: Session, checked: Checked) -> None:
    checked.count = 1
    revision = revision_of(session.connection())
    if revision != revisions()[0]:
        checked.wrong.append(("schema", f"it is at {revision}, this version's is {revisions()[0]}; `skills migrate`"))


def _file(session: Session, checked: Checked) -> None:
    checked.count = session.scalar(text("PRAGMA page_count")) or 0
    said = session.scalars(text(f"PRAGMA integrity_check({NAMED})")).all()
    checked.wrong += [("database file", line) for line in said if line != "ok"]


def _references(session: Session, checked: Checked) -> None:
    """Find rows that refer to rows that there are not."""
    for table in Base.metadata.sorted_tables:
        for key in table.foreign_keys:
            child, parent = key.parent, key.column
            other = parent.table.alias()
            orphan = (child.is_not(None), ~exists().where(other.c[parent.name] == child))
            checked.count += session.scalar(select(func.count()).select_from(table).where(child.is_not(None))) or 0
            for row in session.execute(select(*table.primary_key).where(*orphan).limit(NAMED)):
                checked.wrong.append((_name(table, row), f"its {child.name} is in no row of {parent.table.name}"))


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
        try:
            with database.reading() as session:
                page = [tuple(row) for row in session.execute(query)]
                for key, why in _look(session, mapper, keys, page):
                    checked.wrong.append((_name(table, key), why))
        except Busy:
            raise
        except Exception as error:  # of a file whose pages are damaged
            checked.wrong.append((table.name, f"after {last}: {_in_words(error)}"))
            break
        if not page:
            break
        last = page[-1]
        checked.count += len(page)
        yield checked
    yield checked


def _look(
    session: Session, mapper: Mapper[Any], keys: list[Column[Any]], page: list[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], str]]:
    """Look at a page of rows: the key of each that is wrong, and why."""
    packed = packed_values(mapper)
    later = [defer(getattr(mapper.class_, name)) for name in packed]
    try:
        rows = deque(session.scalars(select(mapper.class_).options(*later).where(tuple_(*keys).in_(page))))
    except Exception:  # one of them cannot be read: it is found by reading each alone
        rows = deque()
        for key in page:
            try:
                row = session.get(mapper.class_, key, options=later)
            except Exception as error:
                yield key, _in_words(error)
            else:
                rows.extend([] if row is None else [row])  # None: erased meanwhile
    while rows:
        row = rows.popleft()
        key = mapper.primary_key_from_instance(row)
        for why in _wrong_with(row, packed):
            yield tuple(key), why
        session.expire(row, packed)  # a page of large values is too much to hold


def packed_values(mapper: Mapper[Any]) -> list[str]:
    """Name the attributes of a model that hold whole values."""
    return [one.key for one in mapper.column_attrs if isinstance(one.columns[0].type, Packed)]


def _wrong_with(row: Any, packed: Sequence[str]) -> Why:
    """Say what is wrong with a row: a value that cannot be read, else what does not agree with its digest."""
    for name in packed:
        try:
            getattr(row, name)
        except Exception as error:
            yield f"{name}: {_in_words(error)}"
            return
    try:
        yield from AGREES.get(type(row), lambda _: iter(()))(row)
    except Exception as error:
        yield _in_words(error)


def _name(table: Table, key: Sequence[Any]) -> str:
    return f"{table.name} {'/'.join(map(str, key))}"


def _in_words(error: Exception) -> str:
    """Say what went wrong; what is not ours might repeat what was stored, and is only named."""
    return str(error) if isinstance(error, SkillsError) else f"it cannot be read ({type(error).__name__})"


# ---- what each digest was taken of, and what must agree ----------------------------------------------------------


def _recording(row: StoredRecording) -> Why:
    session = object_session(row)
    assert session is not None
    size = sum(len(piece) for piece in recording_bytes(session, row))  # raises where the digest is another
    if size != row.size_bytes:
        yield f"it has {size} bytes where its row says {row.size_bytes}"


def _demonstration(row: Demonstration) -> Why:
    if demo_identity(row.recording.sha256, row.surgeon.slug, row.suture, row.demo, row.path) != row.sha256:
        yield "it is not what its digest was taken of"
    if row.hysteresis != row.path.hysteresis:
        yield "its hysteresis is not its path's"
    for name in ("arm", "topic", "frame", "instrument", "start_s", "end_s"):
        if getattr(row, name) != getattr(row.demo, name):
            yield f"its {name} is not what was recorded"


def _reward_map(row: StoredRewardMap) -> Why:
    session = object_session(row)
    assert session is not None
    if digest(row.map) != row.sha256:
        yield "it is not what its digest was taken of"
    path = session.get_one(Demonstration, row.demonstration_row).path
    if digest(sparse_reward(path, row.map.levels)) != row.sha256:
        yield "it is not what Algorithm 1 writes for its demonstration"


def _policy(row: PolicyVersion) -> Why:
    manifest, demonstrations = row.manifest, row.demonstrations
    if policy_identity(manifest, row.learnt) != row.sha256:
        yield "it is not what was certified"
    covered(row)
    if row.releasable != (not manifest["grid_certificate"]["refused_because"]):
        yield "whether it may be released is not what its certificate says"
    if (manifest["surgeon"], manifest["suture"]) != (row.surgeon.slug, row.suture):
        yield "it is said to be of another style"
    if manifest["demos"] != [one.sha256 for one in demonstrations]:
        yield "it was learnt from another demonstration"
    if any((one.surgeon_row, one.suture) != (row.surgeon_row, row.suture) for one in demonstrations):
        yield "its demonstration is of another style"
    if digest(row.learnt.path) != digest(path_of(row)):
        yield "its path is not its demonstration's"


def _release(row: Release) -> Why:
    policy = row.policy
    if (policy.surgeon_row, policy.suture) != (row.surgeon_row, row.suture):
        yield "it releases a policy of another style"
    if not policy.releasable:
        yield "its policy did not pass the gate"
    if row.withdrawn_at is None and policy.rests_on_withdrawn:
        yield "it stands, and its demonstration was withdrawn"


def _plan(row: Plan) -> Why:
    planned(row)
    yield from ()


def _playback(row: StoredPlayback) -> Why:
    if sha256(canonical([row.plan.sha256, row.report])) != row.sha256:
        yield "it is not the verdict that was given on its plan"
    if row.feasible != row.report.get("feasible"):
        yield "whether it is feasible is not what its report says"


def _calibration(row: StoredCalibration) -> Why:
    read_calibration(row)
    yield from ()


def _job(row: Job) -> Why:
    if identity_of(row.kind, row.request) != row.identity:
        yield "it is not what was asked for"


AGREES: dict[type, Callable[[Any], Why]] = {
    StoredRecording: _recording,
    Demonstration: _demonstration,
    StoredRewardMap: _reward_map,
    PolicyVersion: _policy,
    Release: _release,
    Plan: _plan,
    StoredPlayback: _playback,
    StoredCalibration: _calibration,
    Job: _job,
}
