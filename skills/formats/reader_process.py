"""Reading uploads in forks under limits, and the description of a recording for clients.

    bytes --read_told--> Told: the Recording, the proposed hand-off segments and the description

Uploads are untrusted: content that makes a reader hang, crash or exhaust memory affects only its own process, and
becomes a refusal of the file. The recording, or the refusal, is returned through a file, and its constructors check
every number again.

Processor time is limited in proportion to the size of the file, so that a small file cannot use as much as a large one.
Readers are shared by key (`skills.sandbox.forked`): a client that sends hostile files delays only its own uploads.

The description has the contents of a recording, its quality, and the proposed hand-offs. Its computation takes time in
proportion to the recording's motions, and more for a hostile one. So the service computes it in the process that reads
the recording (`ConfinedReader.tell`), and never within a transaction.
"""

import json
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from typing import Any, BinaryIO, Self, TypeVar

import numpy as np

from skills import errors, packing
from skills.compiled import cache_folders, check_cache_folder, make_ready
from skills.demonstration.identification import ArmIdentification, Identification
from skills.demonstration.movement import press_times
from skills.demonstration.recording import (
    BaseFrame,
    Column,
    Joints,
    Label,
    Motion,
    Recording,
    Signal,
    Topic,
    base_frames,
    equal_samples,
)
from skills.demonstration.segments import Segment, propose_by_arm
from skills.errors import BadInput, SkillsError, TooLarge, Unanswered, UnknownFormat, UnreadableRecording
from skills.fields import as_json
from skills.formats import read_recording, write_mcap
from skills.formats.cells import load_arrow
from skills.remedies import read_remedies
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import ForkServer, Turns
from skills.schemas import recordings as described

READER_VERSION = 2  # raised when equal bytes give another `Told`, so that cached ones are decoded again
MOST = 200  # entries of each list of unlimited length; `counts` has the full numbers of segments and labels


@dataclass(frozen=True, eq=False)
class Told:
    """A recording with results that are slow to compute.

    Attributes:
        recording: The recording.
        proposed: The proposed hand-offs, ordered by arm and time.
        identifications: Those of the recording, each of which takes a tenth of a second to compute.
        bases: Those of the recording, which are computed with them.
        about_json: The result of `about_recording` as JSON, so that it passes between processes unchanged.
    """

    recording: Recording
    proposed: tuple[Segment, ...]
    identifications: tuple[ArmIdentification, ...]
    bases: tuple[BaseFrame, ...]
    about_json: str

    def __post_init__(self) -> None:
        packing.canonical([as_json(one) for one in (*self.identifications, *self.bases)])  # raises for NaN
        # The recording's own properties have them now, so that a cut in another process does not compute them again.
        vars(self.recording).update(identifications=self.identifications, bases=self.bases)

    @property
    def about(self) -> dict[str, Any]:
        """The description of the recording for clients."""
        about: dict[str, Any] = json.loads(self.about_json)
        return about


def read_told(file: BinaryIO, **how: Any) -> Told:
    """Read a recording and compute its description; arguments and errors are those of `read_recording`."""
    return tell(read_recording(file, **how))


def tell(recording: Recording) -> Told:
    """Compute the description of a recording."""
    proposed = propose_by_arm(recording)
    about_json = json.dumps(about_recording(recording, proposed), allow_nan=False)
    return Told(recording, proposed, recording.identifications, recording.bases, about_json)


def about_recording(recording: Recording, proposed: Sequence[Segment]) -> dict[str, Any]:
    """Return the description of a recording for clients: its contents, its quality and the proposed hand-offs.

    Each list that the recording could make arbitrarily long is limited to `MOST` entries.
    """
    return {
        "duration_s": recording.duration_s,
        "notes": dict(recording.notes),
        "topics": [as_json(topic) for topic in recording.topics],
        "motions": [
            asdict(described.Motion(m.arm, m.topic, m.frame, len(m.stamps_ns), m.duplicate_stamps))
            for m in recording.motions
        ],
        "quality": [_quality(motion) for motion in recording.motions],
        "segments": [as_json(segment) for segment in proposed[:MOST]],
        "counts": asdict(described.RecordingCounts(len(proposed), len(recording.labels))),
        "labels": [asdict(_label(recording, label)) for label in recording.labels[:MOST]],
        "tools": dict(recording.tools),
        "joints": [
            asdict(described.JointStates(one.arm, one.topic, one.positions.shape[1])) for one in recording.joints[:MOST]
        ],
        "masters": [asdict(described.Master(one.arm, one.topic)) for one in recording.masters[:MOST]],
        "pedals": [asdict(_pedal(recording, name, pedal)) for name, pedal in recording.pedals[:MOST]],
        "following": [asdict(_following(recording, name, signal)) for name, signal in recording.following[:MOST]],
        "scales": [
            asdict(described.Scale(name, float(signal.values.min()), float(signal.values.max())))
            for name, signal in recording.scales[:MOST]
            if len(signal.values)
        ],
        "left_out": [asdict(described.LeftOut(topic, why)) for topic, why in recording.left_out[:MOST]],
        "dropped": [asdict(one) for one in _dropped(recording)[:MOST]],
        "setpoints": [asdict(one) for one in _setpoints(recording)[:MOST]],
        "base_frames": [as_json(base) for base in base_frames(recording)],
        "identifications": [as_json(one) for one in recording.identifications],
    }


def _setpoints(recording: Recording) -> list[described.Setpoints]:
    tips = [described.Setpoints(one.arm, one.topic, one.frame, len(one.stamps_ns)) for one in recording.setpoints]
    jaws = recording.jaw_setpoints
    return tips + [described.Setpoints(arm, one.topic, None, len(one.stamps_ns)) for arm, one in jaws]


def _dropped(recording: Recording) -> list[described.Dropped]:
    signals = [signal for _, signal in (*recording.jaws, *recording.grippers, *recording.jaw_setpoints)]
    streams: list[Motion | Joints | Signal]
    streams = [*recording.motions, *recording.joints, *recording.masters, *recording.setpoints, *signals]
    return [described.Dropped(one.topic, one.backward_stamps) for one in streams if one.backward_stamps]


def _quality(motion: Motion) -> dict[str, Any]:
    steps_ns = np.diff(motion.stamps_ns)
    quality = described.Quality(
        arm=motion.arm,
        topic=motion.topic,
        duration_s=float(np.ptp(motion.stamps_ns)) / 1e9,
        rate_hz=1e9 / float(np.median(steps_ns)) if len(steps_ns) else None,
        longest_gap_s=float(steps_ns.max(initial=0)) / 1e9,
        extent_mm=np.ptp(motion.tip_mm, axis=0).tolist(),
        equal_samples=equal_samples(motion.tip_mm, motion.rotation_xyzw),
    )
    return asdict(quality)


def _label(recording: Recording, label: Label) -> described.Label:
    start_s, end_s = ((stamp_ns - recording.origin_ns) / 1e9 for stamp_ns in (label.start_ns, label.end_ns))
    return described.Label(label.name, label.kind, start_s, end_s)


def _pedal(recording: Recording, topic: str, pedal: Signal) -> described.Pedal:
    """Return the number of presses of a pedal and their total duration.

    A press without release lasts to the end of the recording.
    """
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    presses = press_times(pedal)
    pressed_ns = sum(max(0, (last_ns if up is None else up) - down) for down, up in presses)
    return described.Pedal(topic, len(presses), pressed_ns / 1e9)


def _following(recording: Recording, name: str, signal: Signal) -> described.Following:
    """Return for how long a teleoperation drove its arm.

    The last value is valid to the end of the recording.
    """
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    held_ns = np.diff(np.append(signal.stamps_ns, max(last_ns, int(signal.stamps_ns[-1])))) if len(signal.values) else 0
    return described.Following(name, float((held_ns * (signal.values == 1)).sum()) / 1e9)


PARSE, TELL, READY = f"{__name__}:parse", f"{__name__}:parse_and_tell", f"{__name__}:get_ready"
WAITING = 24  # of the 40 threads that handle requests; the others stay available
WAITING_OF_ONE = 16  # of these, per key
SMALL_FILE_CPU_S = 4  # 100,000 poses in any format take less than 1 s
BYTES_PER_CPU_S = 1 << 20  # a .db3 bag, the slowest format, is read at 2 MB/s
MAX_MESSAGE = 5000

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", Recording, Told)

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
    *(Told, Segment, BaseFrame, ArmIdentification, Identification, Refusal),
)


class ConfinedReader:
    """`read_recording` in a fork for each call, with a limit on concurrent calls; thread-safe.

    Use it as a context manager: the fork server runs for the duration of the block.
    """

    def __init__(self, limits: ProcessLimits, *, at_once: int, target: str = PARSE) -> None:
        self.limits = limits
        self.server = ForkServer(READY)
        self._target = target
        self._turns = Turns(at_once, waiting=WAITING, waiting_of_one=WAITING_OF_ONE)

    def __enter__(self) -> Self:
        """Start the fork server."""
        self.server.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the fork server and all running readers."""
        self.server.close()

    def __call__(self, file: BinaryIO, *, key: str = "", target: str | None = None, **how: Any) -> Recording:
        """Read a recording as `read_recording` does.

        Args:
            file: A real file, not one that is only in memory; left open.
            key: Identifies the client; readers are shared fairly between keys.
            target: Another reader, as `module:function`, with the signature of `parse`.
            how: Further arguments of `read_recording`.

        Raises:
            BadRecording: As `read_recording`, or its process hung, crashed, ran out of memory or returned invalid data:
                `numbers["cause"]` has the cause.
            Busy: Too many callers are waiting already, or no process is available.
        """
        return self._answer(Recording, target or self._target, file, key, how)

    def tell(self, file: BinaryIO, *, key: str = "", **how: Any) -> Told:
        """Read a recording and compute its description as `read_told` does, both in a fork under its limits.

        Arguments and errors are those of `__call__`.
        """
        return self._answer(Told, TELL if self._target == PARSE else self._target, file, key, how)

    def _answer(self, kind: type[Answer], target: str, file: BinaryIO, key: str, how: dict[str, Any]) -> Answer:
        """Run a reader in a fork, and return its result, a value of the given class."""
        with self._turns.turn(key):
            limits = replace(self.limits, cpu_s=min(self.limits.cpu_s, allowed_cpu_s(file)))
            try:
                value = self.server.call(
                    target, file, returns=(kind, Refusal), classes=KNOWN, limits=limits, arguments=how
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
    for folder in cache_folders():
        check_cache_folder(folder)
    stamps_ns, tip_mm = np.array([0, 1]), np.zeros((2, 3))
    motion = Motion("PSM1", "/PSM1/measured_cp", "ECM", stamps_ns, tip_mm, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    data = write_mcap(Recording("mcap", "full", (motion,)))
    make_ready(lambda: read_told(BytesIO(data)))


def parse(file: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    """Read a recording, and write it or its refusal."""
    answered(read_recording, file, answer, **how)


def parse_and_tell(file: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    """Read a recording, and write it with its description, or its refusal."""
    answered(read_told, file, answer, **how)


def answered(read: Callable[..., Recording | Told], file: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    """Call one of our readers, and write its result or refusal."""
    try:
        value: Recording | Told | Refusal = read(file, **how)
    except SkillsError as error:
        value = Refusal.of(error)
    except MemoryError:  # `skills.sandbox.perform` reports it by its exit code
        raise
    except PermissionError as error:  # as well; the message names a file
        raise PermissionError(error.errno, "refused").with_traceback(error.__traceback__) from None
    except Exception as error:  # a bug: its message may quote the file, and must not be logged
        raise RuntimeError(type(error).__name__).with_traceback(error.__traceback__) from None
    packing.write(answer, value, KNOWN)
