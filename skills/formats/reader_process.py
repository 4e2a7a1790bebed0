"""Reading uploads in forks under limits.

    file --ConfinedReader--> Recording, or with `parse` ParsedContent

Uploads are untrusted: content that makes a reader hang, crash or exhaust memory affects only its own process, and
becomes a refusal of the file. The recording, or the refusal, is returned through a file, and its constructors check
every number again.

Processor time is limited in proportion to the size of the file, so that a small file cannot use as much as a large one.
Readers are shared by key (`skills.sandbox.turns`): a client that sends hostile files delays only its own uploads.
"""

import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, BinaryIO, Self, TypeVar

import numpy as np

from skills import errors, packing
from skills.compiled import cache_folders, check_cache_folder, make_ready
from skills.demonstration.identification import ArmIdentification, Identification
from skills.demonstration.recording import BaseFrame, Column, Joints, Label, Motion, Recording, Signal, Topic
from skills.demonstration.segments import Segment
from skills.errors import BadInput, SkillsError, TooLarge, Unanswered, UnknownFormat, UnreadableRecording
from skills.formats import read_recording, write_mcap
from skills.formats.cells import load_arrow
from skills.formats.parsed import ParsedContent, parse_recording
from skills.formats.rosbag import ros2_types
from skills.remedies import read_remedies
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import ForkServer
from skills.sandbox.turns import Turns

READER_VERSION = 1  # raised when equal bytes give another `ParsedContent`, so that cached ones are decoded again
READ, PARSE, READY = f"{__name__}:read", f"{__name__}:parse", f"{__name__}:get_ready"
WAITING = 24  # of the 40 threads that handle requests; the others stay available
WAITING_OF_ONE = 16  # of these, per key
SMALL_FILE_CPU_S = 4  # 100,000 poses in any format take less than 1 s
BYTES_PER_CPU_S = 1 << 20  # a .db3 bag, the slowest format, is read at 2 MB/s
MAX_MESSAGE = 5000

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", Recording, ParsedContent)

_ADVICE = {
    "hung": "cut the recording into parts and send each",
    "crashed": "the file may be damaged: send another copy of it",
    "contained": "a recording has no cause to attempt that: check where it comes from, and report it if it is intact",
    "out of memory": "cut the recording into parts and send each",
    "too much": "cut the recording into parts and send each",
    "failed": "the file may be damaged: check it with `mcap doctor`, and report it if it is intact",
    "nonsense": "the file may be damaged: send another copy of it",
}


@dataclass(frozen=True)
class Refusal:
    """A serialisable error of `read_recording`, to pass it between processes."""

    error: str
    message: str
    numbers: str  # JSON
    remedies: str  # JSON

    def __post_init__(self) -> None:
        self.message.encode()  # raises for unpaired surrogates, which no response can contain
        self.read()

    @classmethod
    def of(cls, error: SkillsError) -> "Refusal":
        """Convert an error."""
        said = [one if isinstance(one, str) else one.as_json() for one in error.remedies]
        numbers = json.dumps(error.numbers, default=str)
        return cls(type(error).__name__, error.message[:MAX_MESSAGE], numbers, json.dumps(said))

    def read(self) -> SkillsError:
        """Return the error as an exception.

        Only classes that mean a fault of the input are allowed: the reader's process is untrusted and must not be able
        to raise others.
        """
        kind = getattr(errors, self.error)
        if not issubclass(kind, BadInput | UnknownFormat | TooLarge):
            raise ValueError(self.error)
        error: SkillsError = kind(self.message, *read_remedies(json.loads(self.remedies)))
        error.numbers = dict(json.loads(self.numbers))
        return error


KNOWN = packing.known(
    *(Recording, Motion, Signal, Joints, Column, Label, Topic),
    *(ParsedContent, Segment, BaseFrame, ArmIdentification, Identification, Refusal),
)


class ConfinedReader:
    """`read_recording` in a fork for each call, with a limit on concurrent calls; thread-safe.

    Use it as a context manager: the fork server runs from the first call to the end of the block.
    """

    def __init__(self, limits: ProcessLimits, *, at_once: int, target: str = READ) -> None:
        self.limits = limits
        self.server = ForkServer(READY)
        self._target = target
        self._turns = Turns(at_once, waiting=WAITING, waiting_of_one=WAITING_OF_ONE)

    def __enter__(self) -> Self:
        """Return the reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the fork server and all running readers."""
        self.server.close()

    def __call__(self, file: BinaryIO, *, key: str = "", target: str | None = None, **options: Any) -> Recording:
        """Read a recording as `read_recording` does.

        Args:
            file: A real file, not one that is only in memory; left open.
            key: Identifies the client; readers are shared fairly between keys.
            target: Another reader, as `module:function`, with the signature of `read`.
            options: Further arguments of `read_recording`.

        Raises:
            BadRecording: As `read_recording`, or its process hung, crashed, ran out of memory or returned invalid data:
                `numbers["cause"]` has the cause.
            Busy: Too many callers are waiting already, or no process is available.
        """
        return self._answer(Recording, target or self._target, file, key, options)

    def parse(self, file: BinaryIO, *, key: str = "", **options: Any) -> ParsedContent:
        """Parse a recording as `parse_recording` does, in a fork under its limits.

        Arguments and errors are those of `__call__`.
        """
        return self._answer(ParsedContent, PARSE if self._target == READ else self._target, file, key, options)

    def _answer(self, kind: type[Answer], target: str, file: BinaryIO, key: str, options: dict[str, Any]) -> Answer:
        """Run a reader in a fork, and return its result, a value of the given class."""
        with self._turns.turn(key):
            limits = replace(self.limits, cpu_s=min(self.limits.cpu_s, allowed_cpu_s(file)))
            try:
                value = self.server.call(
                    target, file, returns=(kind, Refusal), classes=KNOWN, limits=limits, arguments=options
                )
            except Unanswered as error:
                words = "\n".join(getattr(error, "__notes__", ()))
                log.warning("The reader of an upload %s. %s", error.did, words, exc_info=error.__cause__)
                subject = "The recording cannot be used: its reader"
                raise error.translated(UnreadableRecording, subject, _ADVICE) from None
        if isinstance(value, Refusal):
            raise value.read()
        assert isinstance(value, kind)
        return value


def allowed_cpu_s(file: BinaryIO) -> int:
    """Return the limit of processor time for reading a file, in seconds.

    It is a constant plus a share in proportion to the file's size. The slowest format, .db3, takes 0.5 s per MiB on a
    busy machine.
    """
    return SMALL_FILE_CPU_S + file.seek(0, os.SEEK_END) // BYTES_PER_CPU_S


# ---- inside the process ----------------------------------------------------------------------------------------


def get_ready() -> None:
    """Read the shortest possible recording, so that every fork inherits the loaded compiled loops and imports.

    Each fork that reads a table would import `pyarrow` again, which takes 30 times as long as reading a small one.
    """
    load_arrow()
    ros2_types()
    for folder in cache_folders():
        check_cache_folder(folder)
    stamps_ns, tip_mm = np.array([0, 10_000_000]), np.zeros((2, 3))
    motion = Motion("PSM1", "/PSM1/measured_cp", "ECM", stamps_ns, tip_mm, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    data = write_mcap(Recording("mcap", "full", (motion,)))
    make_ready(lambda: parse_recording(BytesIO(data)))


def read(file: BinaryIO, answer: BinaryIO, **options: Any) -> None:
    """Read a recording, and write it or its refusal."""
    write_answer(read_recording, file, answer, **options)


def parse(file: BinaryIO, answer: BinaryIO, **options: Any) -> None:
    """Parse a recording, and write it or its refusal."""
    write_answer(parse_recording, file, answer, **options)


def write_answer(
    reader: Callable[..., Recording | ParsedContent], file: BinaryIO, answer: BinaryIO, **options: Any
) -> None:
    """Call one of our readers, and write its result or refusal."""
    try:
        value: Recording | ParsedContent | Refusal = reader(file, **options)
    except SkillsError as error:
        value = Refusal.of(error)
    except MemoryError:  # `skills.sandbox.perform` reports it by its exit code
        raise
    except OSError as error:  # likewise, by its number; its message names a file
        raise OSError(error.errno, "refused").with_traceback(error.__traceback__) from None
    except Exception as error:  # a bug: its message may quote the file, and must not be logged
        raise RuntimeError(type(error).__name__).with_traceback(error.__traceback__) from None
    packing.write(answer, value, KNOWN)
