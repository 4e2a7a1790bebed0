"""ROS 1 bags, .db3 bags, and MCAP files with IDL types, read through rosbags; and limits on SQLite files.

rosbags decodes the messages; those that are used here are written again as MCAP and read as any other recording, so
that the checks exist once and a motion is the same whatever file it was in. rosbags needs paths: the bytes are copied
into a temporary folder. ROS 1 bags and .db3 files have no checksums: their integrity is "none".

A .db3 file is an SQLite database. A database can have views, triggers, generated columns and virtual tables, so that
reading a table may execute code of its author, without end if intended. `guard` checks every connection that rosbags
opens before its first query, and limits:

    objects      the tables and the one index that rosbag2 and rosbags write (rosbag2_storage_sqlite3, schema 1 to 4)
    statements   SELECT on them, with the three aggregates that rosbags uses; an authorizer refuses all others
    steps        of SQLite's virtual machine, in proportion to the file; a query that needs more is interrupted
    text         of the quality-of-service profiles, which are YAML and slow to parse
"""

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Literal

import apsw
import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.motion import forward_samples
from skills.demonstration.recording import NS_PER_S, Format, Integrity, Recording, Topic
from skills.errors import NoUsableTopic, UnreadableRecording
from skills.formats import topics
from skills.formats.archive import printable, refusing
from skills.formats.bag_writer import Message, write_messages
from skills.formats.mcap import read_mcap
from skills.remedies import did_you_mean

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

TABLES = frozenset({"schema", "metadata", "topics", "message_definitions", "messages"})
STATISTICS = frozenset({"sqlite_stat1", "sqlite_stat4", "sqlite_sequence", "sqlite_schema", "sqlite_temp_schema"})
INDEX = "timestamp_idx"
TOPICS = 4096  # as many channels as an MCAP file may have
PROFILES_CHARACTERS = 1 << 17  # the profiles of 60 topics have 60,000
STEPS, STEPS_PER_BYTE = 10_000_000, 20  # a row of 30 bytes takes fewer than 100 steps; a million steps take 20 ms
_EVERY_STEPS = 100_000
_ADVICE = "Send the bag as written by `ros2 bag record`, or convert it with `ros2 bag convert`."
_FUNCTIONS = frozenset({"count", "min", "max"})
_PRAGMAS = frozenset({"table_info"})


def guard_connections() -> None:
    """Install `guard` for every SQLite connection that rosbags opens from now on."""
    if guard not in apsw.connection_hooks:
        apsw.connection_hooks.append(guard)


def guard(connection: apsw.Connection) -> None:
    """Check that a database contains a rosbag2 and nothing else, and limit the work of any query on it.

    Raises:
        UnreadableRecording: It contains anything else, or is not a database.
    """
    size = Path(connection.filename).stat().st_size
    if not connection.readonly("main"):
        connection.pragma("locking_mode", "exclusive")  # so that a log beside it needs no shared memory
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_VIEW, 0)
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_TRIGGER, 0)
    connection.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
    connection.config(apsw.SQLITE_DBCONFIG_DEFENSIVE, 1)
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, max(size, 1 << 20))
    _limit_steps(connection, STEPS + STEPS_PER_BYTE * size)
    try:
        _check_objects(connection)
        _check_profiles(connection)
    except apsw.Error as error:
        raise UnreadableRecording("The SQLite bag (.db3) is truncated or corrupt. Copy it again.") from error
    connection.authorizer = _allowed


def _limit_steps(connection: apsw.Connection, steps: int) -> None:
    """Interrupt all queries of a connection once they have used so many steps together."""
    left = steps

    def over() -> bool:
        nonlocal left
        left -= _EVERY_STEPS
        return left < 0

    connection.set_progress_handler(over, _EVERY_STEPS)


def _check_objects(connection: apsw.Connection) -> None:
    """Refuse objects that rosbag2 does not write.

    Both SQLite's interpretation of the schema and the schema table in the file are checked.
    """
    found = {name: kind for schema, name, kind, *_ in connection.execute("PRAGMA table_list") if schema == "main"}
    for kind, named in (("view", "view"), ("virtual", "virtual table"), ("shadow", "shadow table"), ("table", "table")):
        for name in sorted(name for name, its_kind in found.items() if its_kind == kind):
            if kind != "table" or name not in TABLES | STATISTICS:
                raise _foreign(named, name)
    for kind, name, table in connection.execute("SELECT type, name, tbl_name FROM main.sqlite_schema"):
        own_index = kind == "index" and (name == INDEX or str(name).startswith("sqlite_autoindex_"))
        if table not in TABLES | STATISTICS or not (own_index or (kind == "table" and name == table)):
            raise _foreign(str(kind), name)
        if kind == "table" and any(column[6] for column in connection.pragma("table_xinfo", name) or ()):
            raise _foreign("computed column in the table", name)
        if kind == "index" and any(column[1] == -2 for column in connection.pragma("index_xinfo", name) or ()):
            raise _foreign("computed index", name)


def _check_profiles(connection: apsw.Connection) -> None:
    """Refuse more topics, or longer quality-of-service profiles, than a recorder writes."""
    columns = [column[1] for column in connection.pragma("table_xinfo", "topics") or ()]
    profiles = "total(length(offered_qos_profiles))" if "offered_qos_profiles" in columns else "0"
    ((count, characters),) = connection.execute(f"SELECT count(*), {profiles} FROM topics")  # noqa: S608 - ours
    if count > TOPICS or characters > PROFILES_CHARACTERS:
        raise UnreadableRecording(
            f"The SQLite bag (.db3) has {count} topics with {characters:.0f} characters of quality-of-service "
            f"profiles; at most {TOPICS} with {PROFILES_CHARACTERS} can be read. {_ADVICE}",
            topics=count,
        )


def _foreign(kind: str, name: object) -> UnreadableRecording:
    """Return the error for an object that rosbag2 does not write."""
    return UnreadableRecording(
        f"The SQLite bag (.db3) has a {kind} {printable(name)!r}, which rosbag2 does not write. {_ADVICE}",
        kind=kind,
    )


def _allowed(action: int, one: str | None, other: str | None, _schema: str | None, _inner: str | None) -> int:
    """Authorize the statements of rosbags, and deny all others: SQLite's authorizer callback."""
    fine = (
        action == apsw.SQLITE_SELECT
        or (action == apsw.SQLITE_READ and one in TABLES | {"sqlite_master", "sqlite_schema"})
        or (action == apsw.SQLITE_FUNCTION and other in _FUNCTIONS)
        or (action == apsw.SQLITE_PRAGMA and one in _PRAGMAS)
    )
    return apsw.SQLITE_OK if fine else apsw.SQLITE_DENY


ROS1_MAGIC = b"#ROSBAG V"
HEADER_BYTES = 4096  # of a bag of ROS 1: its first record
DB3_MAGIC = b"SQLite format 3\0"

Suffix = Literal[".bag", ".db3", ".mcap"]
_FORMATS: dict[Suffix, Format] = {".bag": "rosbag1", ".db3": "rosbag2", ".mcap": "mcap"}
_NAMES = {".bag": "ROS 1 bag", ".db3": "SQLite bag (.db3)", ".mcap": "MCAP file"}

guard_connections()


def is_in_wal_mode(file: BinaryIO) -> bool:
    """Return whether a file is an SQLite database whose last part may be in a write-ahead log beside it."""
    file.seek(0)
    head = file.read(20)
    return head.startswith(DB3_MAGIC) and head[18:] == b"\2\2"  # the versions of writers and readers (SQLite's format)


def merge_log(path: Path) -> None:
    """Move the write-ahead log or the journal beside a copy of a database into it, as SQLite does.

    Raises:
        UnreadableRecording: It contains anything but a rosbag2, or the log is damaged.
    """
    has_log = Path(f"{path}-wal").is_file()
    with (
        refusing(_NAMES[".db3"], "Copy the folder of the bag again, with its -wal."),
        closing(apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READWRITE)) as connection,
    ):
        connection.authorizer = None  # ours alone are the statements here
        frames, _ = connection.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_FULL)
        if (has_log and frames <= 0) or connection.pragma("journal_mode", "delete") != "delete":
            raise UnreadableRecording(
                "The write-ahead log (-wal) beside the SQLite bag (.db3) is damaged or of another. Copy both again."
            )


def read_rosbag(
    files: Sequence[BinaryIO],
    suffix: Suffix,
    integrity: Integrity = "none",
    *,
    logs: Mapping[int, tuple[str, BinaryIO]] | None = None,
    counted: bool = False,
) -> Recording:
    """Read a dVRK recording through rosbags.

    Args:
        files: The bag, or its parts in order; each is read from its beginning.
        suffix: Their format.
        integrity: The integrity of their checksums, where it is known.
        logs: The write-ahead logs or journals beside databases, with their suffixes, by the indices of the files.
        counted: Whether the caller compares the numbers of messages with a metadata.yaml.

    Returns:
        The recording, in millimetres.

    Raises:
        UnreadableRecording: Truncated, corrupt, not in the format of the suffix, or a part of it may be missing.
        NoUsableTopic: No topic has the pose of a PSM.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    with tempfile.TemporaryFile() as out:  # unnamed: deleted when closed
        with ExitStack() as opened:
            with tempfile.TemporaryDirectory() as folder:
                paths = [_copied(file, Path(folder) / f"part{number}{suffix}") for number, file in enumerate(files)]
                for number, (beside, log) in (logs or {}).items():
                    _copied(log, Path(f"{paths[number]}{beside}"))
                    merge_log(paths[number])
                if not counted:
                    _check_no_log_is_missing(paths)
                reader = opened.enter_context(_reading(paths))  # open files stay readable without their folder
            here = _convert(reader, out)
        out.seek(0)
        read = read_mcap(out)
        left_out = tuple(sorted((dict(topics.not_understood(here)) | dict(read.left_out)).items()))
        return replace(read, format=_FORMATS[suffix], integrity=integrity, topics=here, left_out=left_out)


def _check_no_log_is_missing(paths: Sequence[Path]) -> None:
    """Refuse databases whose last messages may be in a log that is not here.

    Raises:
        UnreadableRecording: One is in WAL mode.
    """
    for path in paths:
        with path.open("rb") as file:
            if is_in_wal_mode(file):
                raise UnreadableRecording(
                    "The SQLite bag (.db3) is in WAL mode: its last messages may be in the file with the suffix -wal "
                    "that was beside it and is not here. Send the whole folder as a zip. If the recorder closed the "
                    "bag and left no such file, say so to SQLite (sqlite3 BAG.db3 'PRAGMA journal_mode=DELETE')."
                )


def convert(paths: Sequence[Path], out: IO[bytes], notes: dict[str, str] | None = None) -> tuple[Topic, ...]:
    """Write the used messages of one recording, ROS 1 or ROS 2, as one MCAP file.

    Args:
        paths: The recording's files.
        out: The MCAP file.
        notes: Stored in a metadata record of the MCAP file.

    Returns:
        All topics of the recording, with the numbers of their messages.

    Raises:
        UnreadableRecording: rosbags cannot read it.
        NoUsableTopic: No topic has the pose of a PSM.
    """
    with _reading(paths) as reader:
        return _convert(reader, out, notes)


def topics_in(paths: Sequence[Path]) -> tuple[Topic, ...]:
    """Return the topics of a recording, with the numbers of their messages.

    Raises:
        UnreadableRecording: rosbags cannot read it.
    """
    with _reading(paths) as reader:
        return _topics(reader)


def numbers_on(path: Path, topic: str, of: "Numbers") -> tuple[Ints, Floats]:
    """Return numbers on any topic of a bag; messages where one of the first three is not finite are left out.

    Args:
        path: The bag, with the suffix of its format.
        topic: The topic.
        of: The numbers of a message by its type: `PLACES`, such as a tracker's of a marker, or `STATES` of joints.

    Returns:
        Stamps of the headers in ns, ascending, shape (N,), and the numbers in units of the bag, shape (N, K).

    Raises:
        UnreadableRecording: rosbags cannot read it.
        NoUsableTopic: There is no such topic of such messages, or it has no position.
        BackwardStamps, RepeatedStamps: More stamps than `forward_samples` drops do not increase.
    """
    with _reading([path]) as reader:
        kinds = [(one.topic, one.msgtype) for one in reader.connections]
        wanted = [one for one in reader.connections if one.topic == topic and one.msgtype in of]
        if not wanted:
            fitting = sorted({name for name, kind in kinds if kind in of})
            raise NoUsableTopic(
                f"The bag has no positions on {topic}, which are in {', '.join(of)} messages. It has such messages on "
                f"{', '.join(fitting[:20]) or 'no topic'}.",
                *did_you_mean(topic, fitting),
                topic=topic,
            )
        stamps, numbers = [], []
        for connection, _, data in reader.messages(connections=wanted):
            said: Any = reader.deserialize(data, connection.msgtype)
            stamps.append(int(said.header.stamp.sec) * NS_PER_S + int(said.header.stamp.nanosec))
            numbers.append([*of[connection.msgtype](said)])
    rows = np.array(numbers or np.zeros((0, 3)), np.float64)
    seen = np.isfinite(rows[:, :3]).all(axis=1)  # a tracker that has lost its marker says NaN
    stamps_ns = np.array(stamps, np.int64)[seen]
    if not len(stamps_ns):
        raise NoUsableTopic(f"{topic} has no position.", topic=topic)
    kept = forward_samples(topic, stamps_ns, rows[seen]).kept
    return (stamps_ns, rows[seen]) if kept is None else (stamps_ns[kept], rows[seen][kept])


@cache
def ros2_types() -> "Typestore":
    """Return the message definitions of ROS 2, with all of rosbags loaded: a fifth of a second that only bags need."""
    import rosbags.highlevel  # noqa: F401  before a process is forked for a bag
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def _reading(paths: Sequence[Path]) -> "Iterator[AnyReader]":
    """Open a recording with rosbags; raises `UnreadableRecording` if it cannot."""
    advice = "Copy it again, or convert it with `ros2 bag convert` or `rosbags-convert`."
    what = f"The {_NAMES.get(paths[0].suffix, 'bag')}"
    for path in paths:
        with path.open("rb") as file:
            _check_indexed(file.read(HEADER_BYTES))
    from rosbags.highlevel import AnyReader

    with refusing(what, advice), AnyReader(paths, default_typestore=ros2_types()) as reader:
        yield reader


def _check_indexed(head: bytes) -> None:
    """Refuse a bag of ROS 1 whose header has no place of an index, as while it is recorded (Bag format 2.0).

    Raises:
        UnreadableRecording: It was not closed.
    """
    at = head.find(b"index_pos=") if head.startswith(ROS1_MAGIC) else -1
    if at >= 0 and head[at + 10 : at + 18] == bytes(8):
        raise UnreadableRecording(
            "The ROS 1 bag has no index: its recorder was ended before it closed the bag (a .bag.active). Index it "
            "with `rosbag reindex FILE`, and send the result."
        )


def _convert(reader: "AnyReader", out: IO[bytes], notes: dict[str, str] | None = None) -> tuple[Topic, ...]:
    """Write the used messages as MCAP, and return all topics; raises as `convert`."""
    here = _topics(reader)
    if not any(topics.arm_of_pose(topic.name, topic.type) for topic in here):
        said = ", ".join(f"{topic.name} ({topic.type})" for topic in here[:20])
        raise NoUsableTopic(f"No topic has the pose of a PSM. It has {said or 'no topics'}.")
    used = [one for one in reader.connections if topics.meaning(one.topic, one.msgtype) is not None]
    types = reader.typestore if reader.is2 else ros2_types()
    definitions = {kind: types.generate_msgdef(kind, ros_version=2)[0] for kind in {one.msgtype for one in used}}
    write_messages(_messages(reader, used), out, notes, definitions)
    return here


def _topics(reader: "AnyReader") -> tuple[Topic, ...]:
    """Return the topics of an open recording, with the numbers of their messages."""
    counts: Counter[tuple[str, str]] = Counter()
    for connection in reader.connections:
        counts[connection.topic, connection.msgtype] += connection.msgcount
    return topics.counted(counts)


def _messages(reader: "AnyReader", used: Sequence[Any]) -> Iterator[Message]:
    """Yield the messages of some connections as CDR."""
    for connection, log_ns, data in reader.messages(connections=used):
        kind, publisher = connection.msgtype, getattr(connection.ext, "callerid", None) or ""
        yield Message(log_ns, connection.topic, kind, data if reader.is2 else _cdr(data, kind), publisher)


def _cdr(data: bytes, kind: str) -> bytes:
    """Convert a message of ROS 1; a damaged one becomes empty, so that `read_mcap` refuses or omits its topic."""
    try:
        return bytes(ros2_types().ros1_to_cdr(data, kind))
    except Exception:  # on a damaged message rosbags may raise anything
        return b"\0\1\0\0"


_AT = ((topics.POSE, "pose.position"), (topics.TRANSFORM, "transform.translation"), (topics.POINT, "point"))
_ROWS = attrgetter("position", "velocity", "effort")
Numbers = Mapping[str, Callable[[Any], Iterable[float]]]  # of a message, by its type
PLACES: Numbers = {kind: attrgetter(*(f"{place}.{axis}" for axis in "xyz")) for kind, place in _AT}
# Positions, velocities and efforts of six joints; NaN where there are fewer.
STATES: Numbers = {topics.JOINT_STATE: lambda said: np.ravel([[*row, *[np.nan] * 6][:6] for row in _ROWS(said)])}


def _copied(file: BinaryIO, path: Path) -> Path:
    file.seek(0)
    with path.open("wb") as out:
        shutil.copyfileobj(file, out, 1 << 20)
    return path
