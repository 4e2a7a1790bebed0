"""Everything that this package refuses, as one tree.

    SkillsError
    ├── BadInput                what was given is wrong, and nothing was kept
    │   ├── BadRecording        the file: unreadable, no usable topic, mixed frames, not metres ...
    │   ├── BadPath             the demonstration in its grid: outside it, never leaving the goal ...
    │   ├── BadSettings         a learner, grid or request that cannot be meant
    │   ├── BadPlan             a plan or trajectory that the arm cannot follow
    │   └── BadBag              a bag for replay that is not what its plan and its verdict say
    ├── WrongHost               the request was meant for another name than those of this service
    ├── NotSignedIn             who asks showed no key, or none that counts
    ├── NotAllowed              who asks may not do this
    ├── TooMany                 over a rate or an allowance of the key
    ├── NotFound                no such thing here (and what there is instead)
    │   └── NotDrawnYet         a picture that is being drawn, or that nobody asked for
    ├── Erased                  it was here and was erased for good
    ├── Conflict                it cannot be done in the present state
    │   └── LearnerNotInstalled a learner that needs what is not installed here
    ├── PreconditionFailed      it changed since the caller last looked
    ├── UnknownFormat           the content is of no format that is read here
    ├── TooLarge                over a limit of the settings
    ├── TooSlow                 the body of a request did not come in time
    ├── Corrupt                 what was stored is no longer what was stored
    ├── Busy                    the database or the queue cannot take it now
    │   └── NotReady            a part of the installation cannot be used; the message says which
    ├── SimulationFailed        the simulator crashed, hung or answered nonsense
    ├── LearningFailed          the process that learns crashed, hung or took too much
    └── Unanswered              a process of ours gave no answer; whoever asked it says so in words of its own

An error is named after what is wrong, carries the offending numbers as attributes of `numbers`, and its message says
what to do next. Only `skills.api.problems` knows which status code each one becomes.
"""


class SkillsError(Exception):
    """The root; `numbers` holds the offending values, safe to show to the caller."""

    def __init__(self, message: str, **numbers: object) -> None:
        super().__init__(message)
        self.numbers = numbers


class BadInput(SkillsError):
    """What was given is wrong; nothing was kept."""


class WrongHost(SkillsError):
    """The request was meant for another name than those of this service."""


class NotSignedIn(SkillsError):
    """Who asks showed no key, or none that counts."""


class NotAllowed(SkillsError):
    """Who asks may not do this."""


class TooMany(SkillsError):
    """Over a rate or an allowance of the key; it may go on after `wait_s`."""

    def __init__(self, message: str, wait_s: float) -> None:
        super().__init__(message, wait_s=round(wait_s, 1))
        self.wait_s = wait_s


class NotFound(SkillsError):
    """No such thing here."""


class NotDrawnYet(NotFound):
    """A picture that is being drawn, or that nobody asked for; the message says which."""


class Erased(SkillsError):
    """It was here and was erased for good."""


class Conflict(SkillsError):
    """It cannot be done in the present state."""


class PreconditionFailed(SkillsError):
    """It changed since the caller last looked."""


class UnknownFormat(SkillsError):
    """The content is of no format that is read here."""


class TooLarge(SkillsError):
    """Over a limit of the settings."""


class TooSlow(SkillsError):
    """The body of a request did not come in time."""


class Corrupt(SkillsError):
    """What was stored is no longer what was stored."""


class Busy(SkillsError):
    """The database or the queue cannot take it now."""


class NotReady(Busy):
    """A part of the installation cannot be used: its database, its queue, its workers."""


class SimulationFailed(SkillsError):
    """The simulator crashed, hung or answered nonsense: the check did not happen."""


class Unanswered(SkillsError):
    """A process of ours gave no answer: the `cause` in a word or three, and what it `did`, as a sentence goes on."""

    def __init__(self, cause: str, did: str) -> None:
        super().__init__(f"A process of ours {did}.", cause=cause)
        self.cause = cause
        self.did = did


# ---- recordings ------------------------------------------------------------------------------------------------


class BadRecording(BadInput):
    """The file cannot be used as a recording."""


class UnreadableRecording(BadRecording):
    """Empty, truncated or corrupt."""


class NoUsableTopic(BadRecording):
    """No topic or column with the pose of an arm."""


class MixedFrames(BadRecording):
    """Poses of one topic are given in more than one frame."""


class BackwardStamps(BadRecording):
    """Time runs backwards."""


class RepeatedStamps(BadRecording):
    """More than half of the samples carry the stamp of the sample before: the clock stood still."""


class NotFinite(BadRecording):
    """NaN or infinity among the numbers."""


class NotMetres(BadRecording):
    """A magnitude that cannot be metres of a PSM; never rescaled by guess."""


class NotAQuaternion(BadRecording):
    """A quaternion whose length is not one."""


class BadColumns(BadRecording):
    """The header of a table is unknown, doubled, incomplete or ambiguous."""


class BadSegment(BadRecording):
    """The part asked for is not in the recording."""


# ---- the path in its grid ---------------------------------------------------------------------------------------


class BadPath(BadInput):
    """The demonstration does not make a path that can be learnt."""


class EmptyPath(BadPath):
    """A path without points."""


class OutsideGrid(BadPath):
    """Points outside the grid world."""


class NeverLeavesGoal(BadPath):
    """All of the path lies in its goal's cell."""


# ---- learning ---------------------------------------------------------------------------------------------------


class BadSettings(BadInput):
    """Settings that cannot be meant."""


class LearnerNotInstalled(Conflict):
    """A learner that needs what is not installed here; the same request can be met once it is."""


class LearningFailed(SkillsError):
    """The process that learns crashed, hung, or needed more than it may have: nothing was learnt."""


# ---- plans and motion -------------------------------------------------------------------------------------------


class BadPlan(BadInput):
    """A plan that cannot be made."""


class Unreachable(BadPlan):
    """A pose that the arm cannot take."""


class UnknownInstrument(BadPlan):
    """An instrument whose constants are not known here."""


class ImproperRotation(BadPlan):
    """A matrix or quaternion that is no rotation."""


class NoApproach(BadPlan):
    """The direction in which PSM_M approaches is missing or has no length."""


class BadSpeed(BadPlan):
    """A speed or rate that no motion can have."""


class NoMotion(BadPlan):
    """A pass in which nothing moves."""


# ---- replay -----------------------------------------------------------------------------------------------------


class BadBag(BadInput):
    """A bag for replay that is not whole, or not what its plan and its verdict say: no arm should follow it."""
