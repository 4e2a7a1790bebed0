"""The errors of this package, as one tree.

    SkillsError
    ├── BadInput                the input is wrong; nothing was stored
    │   ├── BadRecording        the file: unreadable, no usable topic, mixed frames, not metres ...
    │   ├── BadPath             the demonstration in its grid: outside it, never leaving the goal ...
    │   ├── BadSettings         a learner, grid or request with impossible settings
    │   ├── BadPlan             a plan or trajectory that the arm cannot follow
    │   ├── AmbiguousDigest     a digest prefix that several objects share
    │   ├── BadSignature        a signature by another key, or of other bytes
    │   └── BadBag              a replay bag that does not match its plan and its verdict
    ├── WrongHost               the request was sent to a name that is not one of this service
    ├── NotSignedIn             the request has no valid credentials
    ├── NotAllowed              the caller may not do this
    ├── TooMany                 over a rate limit or an allowance of the key
    ├── NotFound                no such object (with the existing ones)
    │   └── NotDrawnYet         a picture that is being drawn, or was not requested
    ├── Erased                  the object was erased permanently
    ├── Conflict                not possible in the present state
    │   └── NotInstalled        an optional dependency is not installed here
    ├── PreconditionFailed      the object changed since the caller last read it
    ├── UnknownFormat           the content has no format that is read here
    ├── TooLarge                over a size limit of the settings
    ├── TooSlow                 the body of a request did not arrive in time
    ├── Corrupt                 stored data no longer matches its digest
    ├── Busy                    the database or the queue cannot be used now
    │   ├── DatabaseBusy        the database: locked, overloaded or away; a job waits for it
    │   │   └── DatabaseUnusable    and why, of which it is a NotReady too: logged, and never sent over HTTP
    │   ├── StorageFull         a disk is full: of the database, or of temporary files
    │   └── NotReady            a part of the installation cannot be used; the message says which
    ├── SimulationFailed        the simulator crashed, hung or returned nonsense
    ├── LearningFailed          the learning process crashed, hung or exceeded its limits
    └── Unanswered              a subprocess returned no result; its caller raises an error in words of its own

An error is named after the fault and has the offending numbers in its attribute `numbers`. Its message is "fault;
remedy" if the remedy reads the same for every interface; otherwise the remedy is a `Remedy`, which HTTP, the command
line and Python each word in their own terms (`skills.remedies`). Only `skills.api.problems` knows the status codes.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import TypeVar

from skills.remedies import Door, Remedy


class SkillsError(Exception):
    """Base class of all errors.

    Attributes:
        kind: The stable name of the kind of error, such as "outside-grid".
        message: The fault, in words that fit every interface.
        remedies: Remedies: an action, or a sentence that fits every interface.
        numbers: The offending values, safe to show to the caller.
    """

    kind = "skills-error"

    def __init_subclass__(cls) -> None:
        """Name the kind after the class: OutsideGrid is outside-grid."""
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()

    def __init__(self, message: str, /, *remedies: Remedy | str, **numbers: object) -> None:
        super().__init__(message)
        self.message = message
        self.remedies = remedies
        self.numbers = numbers

    def __str__(self) -> str:
        """Return the fault and the remedies in the words of Python."""
        return self.words(Door.PYTHON)

    def words(self, door: Door | None = None) -> str:
        """Return fault and remedies in the words of an interface; without one, as jobs store it, only what fits all."""
        return " ".join([self.message, *self.advice(door)])

    def advice(self, door: Door | None) -> list[str]:
        """Return a sentence for each remedy."""
        plain = (one if isinstance(one, str) else None if door is None else one.words(door) for one in self.remedies)
        return [one for one in plain if one is not None]


E = TypeVar("E", bound=SkillsError)


class BadInput(SkillsError):
    """The input is wrong; nothing was stored."""


def refuse_not_finite(value: object, name: Callable[[Sequence[str]], str] = ".".join, path: Sequence[str] = ()) -> None:
    """Refuse nan and inf, which JSON does not have, in the values of mappings and sequences.

    Args:
        value: A number, or a mapping or sequence with others in it; anything else passes.
        name: Names a value in the message by its path.
        path: The keys and indices that lead to the value.

    Raises:
        BadInput: There is one; the message names it.
    """
    if isinstance(value, float) and not isfinite(value):
        raise BadInput(f"{name(path)} is {value}; every number must be finite.")
    named = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    for key, part in named:
        refuse_not_finite(part, name, (*path, str(key)))


class AmbiguousDigest(BadInput):
    """Several objects share the prefix of a digest; `numbers["candidates"]` has their digests."""


class WrongHost(SkillsError):
    """The request was sent to a host name that is not one of this service."""


class NotSignedIn(SkillsError):
    """The request has no credentials, or invalid ones."""


class NotAllowed(SkillsError):
    """The caller may not do this."""


class TooMany(SkillsError):
    """A rate limit or an allowance of the key is exceeded; it allows more after `wait_s` seconds."""

    def __init__(self, message: str, wait_s: float) -> None:
        super().__init__(message, wait_s=round(wait_s, 1))
        self.wait_s = wait_s


class NotFound(SkillsError):
    """There is no such object."""


class NotDrawnYet(NotFound):
    """A picture is being drawn, or was not requested; the message says which."""


class Erased(SkillsError):
    """The object was erased permanently."""


class Conflict(SkillsError):
    """The request is not possible in the present state."""


class PreconditionFailed(SkillsError):
    """The object changed since the caller last read it."""


class UnknownFormat(SkillsError):
    """The content has no format that is read here."""


class TooLarge(SkillsError):
    """A size limit of the settings is exceeded."""


class TooSlow(SkillsError):
    """The body of a request did not arrive in time."""


class Corrupt(SkillsError):
    """Stored data no longer matches its digest."""


class Busy(SkillsError):
    """The database or the queue cannot be used now."""


class DatabaseBusy(Busy):
    """The database is locked, overloaded or away: a job waits for it, at no cost of its attempts."""


DatabaseBusy.kind = Busy.kind  # over HTTP there is no difference


class StorageFull(Busy):
    """A disk is full, of the database or of temporary files: a retry does not help, free space does."""


class NotReady(Busy):
    """A part of the installation cannot be used: its database, its queue, its workers."""


class DatabaseUnusable(NotReady, DatabaseBusy):
    """The database cannot be used; the message names its file or server, so it is logged and never sent over HTTP."""


class SimulationFailed(SkillsError):
    """The simulator crashed, hung or returned nonsense: there is no verdict."""


class Unanswered(SkillsError):
    """A subprocess returned no result: `cause` in one to three words, and `did` as the predicate of a sentence."""

    def __init__(self, cause: str, did: str) -> None:
        super().__init__(f"A subprocess {did}.", cause=cause)
        self.cause = cause
        self.did = did

    def translated(self, kind: type[E], subject: str, advice: Mapping[str, str]) -> E:
        """Return it as an error in the words of the caller, with the same cause and notes.

        Args:
            kind: The class of the error.
            subject: The subject of its message, such as "The simulator".
            advice: The remedy for each cause.
        """
        error = kind(f"{subject} {self.did}; {advice[self.cause]}.", cause=self.cause)
        for words in getattr(self, "__notes__", ()):
            error.add_note(words)
        return error


# ---- recordings ------------------------------------------------------------------------------------------------


class BadRecording(BadInput):
    """The file cannot be used as a recording."""


class UnreadableRecording(BadRecording):
    """The file is empty, truncated or corrupt."""


class NoUsableTopic(BadRecording):
    """The file has no topic or column with the pose of an arm."""


class MixedFrames(BadRecording):
    """The poses of one topic are in more than one frame."""


class MixedSources(BadRecording):
    """Two publishers write to one topic at the same time."""


class BackwardStamps(BadRecording):
    """Time stamps decrease, more often or by more than can be dropped."""


class RepeatedStamps(BadRecording):
    """Too many samples have the time stamp of the sample before: the clock stood still."""


class NotFinite(BadRecording):
    """A number is NaN or infinite."""


class NotMetres(BadRecording):
    """A magnitude cannot be metres of a PSM; it is never rescaled by guess."""


class ImplausibleMotion(BadRecording):
    """No PSM moves so, or no recorder samples so: times or lengths are in another unit, or the tip jumps."""


class NotAQuaternion(BadRecording):
    """A quaternion does not have length one."""


class JointsDisagree(BadRecording):
    """The joints of an arm contradict its poses, or the instrument or frame that the recording states."""


class BadColumns(BadRecording):
    """The header of a table is unknown, duplicated, incomplete or ambiguous."""


class BadSegment(BadRecording):
    """The requested part is not in the recording."""


class SegmentNotNamed(BadSegment):
    """Several hand-offs are proposed in a recording, and the request names none of them."""


# ---- the path in its grid ---------------------------------------------------------------------------------------


class BadPath(BadInput):
    """The demonstration does not make a path that can be learnt."""


class EmptyPath(BadPath):
    """The path has no points."""


class OutsideGrid(BadPath):
    """Points are outside the grid world."""


class NeverLeavesGoal(BadPath):
    """The complete path lies in the cell of its goal."""


# ---- learning ---------------------------------------------------------------------------------------------------


class BadSettings(BadInput):
    """A setting has an impossible value."""


class NotInstalled(Conflict):
    """Optional dependencies are not installed here; the same request can succeed once they are."""


class LearningFailed(SkillsError):
    """The learning process crashed, hung, or exceeded its limits: nothing was learnt."""


# ---- plans and motion -------------------------------------------------------------------------------------------


class BadPlan(BadInput):
    """The plan cannot be made."""


class Unreachable(BadPlan):
    """The arm cannot take a pose."""


class UnknownInstrument(BadPlan):
    """The constants of an instrument are not known here."""


class ImproperRotation(BadPlan):
    """A matrix or quaternion is not a rotation."""


class NoApproach(BadPlan):
    """The approach direction of PSM_M is missing or has length zero."""


class NoHandOff(BadPlan):
    """The plan would hand nothing over, and was not requested as such."""


class BadSpeed(BadPlan):
    """The speed or rate is impossible for a motion."""


class NoMotion(BadPlan):
    """Nothing moves in a pass."""


# ---- replay -----------------------------------------------------------------------------------------------------


class BadSignature(BadInput):
    """A signature is of another key, or of other bytes: what it should cover must not be trusted."""


class BadBag(BadInput):
    """A replay bag is incomplete or does not match its plan and its verdict: no arm should follow it."""
