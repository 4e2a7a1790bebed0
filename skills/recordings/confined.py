"""Read recordings that somebody sent, each in a process of its own under limits.

A reader meets whatever bytes people send: what makes it hang, crash or eat memory ends that one process, and is a
refusal of the file. The recording, or the refusal, comes back through a file, and every number of it is checked again.
"""

import json
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from threading import BoundedSemaphore
from typing import IO, Any, BinaryIO, Self

import numpy as np

from skills import errors, packing
from skills.compiled import check_kept, kept_in, make_ready
from skills.confined.forked import ForkServer
from skills.confined.limits import Limits
from skills.errors import BadInput, Busy, SkillsError, TooLarge, Unanswered, UnknownFormat, UnreadableRecording
from skills.recordings import _kernels, read_recording, write_mcap
from skills.style.recording import BaseFrame, Joints, Label, Motion, Recording, Signal, TopicInfo

PARSE, READY = f"{__name__}:parse", f"{__name__}:get_ready"
WAITING = 24  # of the 40 threads that answer requests; the others go on answering
MAX_MESSAGE = 5000

log = logging.getLogger(__name__)

_ADVICE = {
    "hung": "cut the recording into parts and send each",
    "crashed": "the file may be damaged: send another copy of it",
    "out of memory": "cut the recording into parts and send each",
    "too much": "cut the recording into parts and send each",
    "failed": "the file may be damaged: check it with `mcap doctor`, and report it if it is whole",
}


@dataclass(frozen=True)
class Refusal:
    """What `read_recording` refused, on its way from one process to the other."""

    error: str
    message: str
    numbers: str  # JSON

    @classmethod
    def of(cls, error: SkillsError) -> "Refusal":
        """Write a refusal down."""
        return cls(type(error).__name__, str(error)[:MAX_MESSAGE], json.dumps(error.numbers, default=str))

    def read(self) -> SkillsError:
        """Make the refusal anew: of a class that says that what was sent is wrong, and no other."""
        kind = getattr(errors, self.error)
        if not issubclass(kind, BadInput | UnknownFormat | TooLarge):
            raise ValueError(self.error)
        self.message.encode()  # it can be shown
        error: SkillsError = kind(self.message)
        error.numbers = dict(json.loads(self.numbers))
        return error


KNOWN = packing.known(Recording, Motion, Signal, Joints, BaseFrame, Label, TopicInfo, Refusal)


class ConfinedReader:
    """`read_recording`, each time in a fork of its own, so many at once; others wait for their turn.

    Use it in a with block: it keeps a fork server for as long.
    """

    def __init__(self, limits: Limits, *, answer_bytes: int, at_once: int, target: str = PARSE) -> None:
        self.limits = limits
        self.answer_bytes = answer_bytes
        self.server = ForkServer(READY)
        self._target = target
        self._turns = BoundedSemaphore(at_once)
        self._places = BoundedSemaphore(WAITING)

    def __enter__(self) -> Self:
        """Start the fork server."""
        self.server.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End it, and what is being read."""
        self.server.close()

    def __call__(self, file: BinaryIO, *, target: str | None = None, **how: Any) -> Recording:
        """Read a recording as `read_recording` does.

        Args:
            file: A real file, not one that is only in memory; left open.
            target: What reads instead, as `module:function`; it is called as `parse` is.
            how: Further arguments of `read_recording`.

        Raises:
            BadRecording: As `read_recording`, or its process hung, crashed, ran out of memory or answered nonsense:
                `numbers["cause"]` says which.
            Busy: Too many are waiting already, or no process can be had.
        """
        with self._turn():
            try:
                with self.server.run(target or self._target, file, how, self.limits) as answer:
                    return _recording(answer, self.answer_bytes)
            except Unanswered as error:
                words = "\n".join(getattr(error, "__notes__", ()))
                log.warning("The reader of an upload %s. %s", error.did, words)
                raise _unreadable(error.cause, f"{error.did}; {_ADVICE[error.cause]}") from None

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._places.acquire(blocking=False):
            raise Busy("Too many recordings are being read just now; try again in a moment.")
        try:
            with self._turns:
                yield
        finally:
            self._places.release()


def _recording(answer: IO[bytes], most_bytes: int) -> Recording:
    """Build what a fork answered; nothing of it is believed.

    Raises:
        SkillsError: It refused, or answered too much, or nonsense.
    """
    if (size := answer.seek(0, os.SEEK_END)) > most_bytes:
        did = f"found {size >> 20} MiB of samples, and {most_bytes >> 20} are the most; {_ADVICE['too much']}"
        raise _unreadable("too much", did)
    answer.seek(0)
    try:
        if packing.unfolded_bytes(answer) > most_bytes:
            raise ValueError("too much")
        value = packing.read(answer, KNOWN)
        if isinstance(value, Recording):
            return value
        refused = value.read()
    except Exception as error:
        log.warning("The reader of an upload answered nonsense.", exc_info=error)
        advice = "the file may be damaged: send another copy of it"
        raise _unreadable("nonsense", f"answered nonsense; {advice}") from None
    raise refused


def _unreadable(cause: str, did: str) -> UnreadableRecording:
    return UnreadableRecording(f"The recording cannot be used: its reader {did}.", cause=cause)


# ---- inside the process ----------------------------------------------------------------------------------------


def get_ready() -> None:
    """Read the shortest recording there is, so that every fork finds the compiled loops loaded."""
    folder = kept_in(_kernels.follow_compiled)
    check_kept(folder)
    stamps_ns, tip_mm = np.array([0, 1]), np.zeros((2, 3))
    motion = Motion("PSM1", "/PSM1/measured_cp", "ECM", stamps_ns, tip_mm, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    data = write_mcap(Recording("mcap", "full", (motion,)))
    make_ready(lambda: read_recording(BytesIO(data)), folder)


def parse(file: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    """Read a recording, and write it or its refusal."""
    answered(read_recording, file, answer, **how)


def answered(read: Callable[..., Recording], file: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    """Read with one of our readers, and write what it gave or refused."""
    try:
        value: Recording | Refusal = read(file, **how)
    except SkillsError as error:
        value = Refusal.of(error)
    except MemoryError:
        raise
    except Exception as error:  # a fault of ours: its message may quote the file, and is not for the log
        raise RuntimeError(type(error).__name__).with_traceback(error.__traceback__) from None
    packing.write(answer, value, KNOWN)
