"""Recognition of surgeons in an atlas: validated for each arm, of one demonstration, and by votes of a recording.

    members, signatures --recognise_arms--> Recognised --> the answers of an atlas

A demonstration is compared with those of the same arm only, because the hands have different tasks. A recording's vote
is of its demonstrations of all arms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from skills.arrays import Floats, Ints
from skills.comparison.recognition import Validated, recognise, usable, validate, vote
from skills.comparison.traits import NUMBERS
from skills.errors import BadInput
from skills.learning.slip import wilson
from skills.library.members import Member, numbered, sessions_of
from skills.schemas.comparison import Calibrated, Likely, Recognition, Votes, Whose

BINS = 5  # of a calibration curve, with equally many demonstrations each


@dataclass(frozen=True, eq=False)
class _Arm:
    """The demonstrations of one arm, with the validation of their recognition."""

    members: Sequence[Member]
    signatures: Floats
    slugs: list[str]
    surgeons: Ints
    sessions: Ints
    recordings: Ints
    validated: Validated

    def voters(self, recording_row: int) -> list[Floats]:
        """Return the probabilities of the tested demonstrations of a recording, each of shape (S,)."""
        pairs = zip(self.validated.tested.tolist(), self.validated.probability, strict=True)
        return [found for one, found in pairs if self.members[one].recording_row == recording_row]


@dataclass(frozen=True, eq=False)
class Recognised:
    """The recognition of an atlas, by arm, and the reasons for the arms that have none."""

    arms: dict[str, _Arm]
    because: tuple[str, ...]


def recognise_arms(members: Sequence[Member], signatures: Floats) -> Recognised:
    """Validate the recognition of the surgeons of each arm's demonstrations.

    Args:
        members: The demonstrations.
        signatures: Their signatures, shape (N, NUMBERS).
    """
    sessions, recordings = sessions_of(members), numbered(one.recording_row for one in members)
    arms: dict[str, _Arm] = {}
    because = []
    for arm in sorted({one.arm for one in members}):
        these = np.array([at for at, one in enumerate(members) if one.arm == arm])
        mine = [members[at] for at in these.tolist()]
        slugs, surgeons = np.unique([one.surgeon for one in mine], return_inverse=True)
        numbers = signatures[these].reshape(-1, NUMBERS)
        given = numbers, surgeons, sessions[these], recordings[these]
        try:
            validated = validate(*given, usable(numbers, one_frame=len({one.frame for one in mine}) == 1))
        # Too few surgeons or sessions is no error of the request: the atlas is returned without recognition.
        except BadInput as error:
            because.append(f"{arm}: {error.words()}")
            continue
        arms[arm] = _Arm(mine, numbers, slugs.tolist(), *given[1:], validated)
    return Recognised(arms, tuple(because))


def recognitions(found: Recognised) -> list[Recognition]:
    """Return the quality of the recognition, for each arm."""
    return [_recognition(name, arm.validated) for name, arm in found.arms.items()]


def _recognition(arm: str, validated: Validated) -> Recognition:
    return Recognition(
        arm=arm,
        compared=list(validated.settings.families),
        surgeons=len(validated.surgeons),
        tested=len(validated.tested),
        right=validated.right,
        accuracy=validated.accuracy,
        interval=validated.interval,
        chance=validated.chance,
        log_loss=validated.log_loss,
        log_loss_of_guessing=log(len(validated.surgeons)),
        sureness=validated.sureness,
        curve=[Calibrated(demos=demos, said=said, right=right) for demos, said, right in validated.curve(BINS)],
        stranger_if_known=float(validated.stranger.mean()),
        stranger_if_left_out=float(validated.unknown.mean()),
    )


def votes(found: Recognised) -> Votes | None:
    """Return how many recordings' votes name their surgeon; None if there is no recognition."""
    if not found.arms:
        return None
    by_recording: dict[int, str] = {}
    for arm in found.arms.values():
        for one in arm.validated.tested.tolist():
            by_recording[arm.members[one].recording_row] = arm.members[one].surgeon
    right = sum(_voted(found, row)[0] == surgeon for row, surgeon in by_recording.items())
    return Votes(
        recordings=len(by_recording),
        right=right,
        accuracy=right / len(by_recording),
        interval=wilson(right, len(by_recording)),
        chance=1.0 / len({slug for arm in found.arms.values() for slug in arm.slugs}),
    )


def _voted(found: Recognised, recording_row: int) -> tuple[str | None, int]:
    """Return the surgeon for whom a recording's tested demonstrations vote, and their number."""
    slugs = sorted({slug for arm in found.arms.values() for slug in arm.slugs})
    ballots = []
    for arm in found.arms.values():
        for probability in arm.voters(recording_row):
            ballot = np.zeros(len(slugs))
            ballot[[slugs.index(slug) for slug in arm.slugs]] = probability
            ballots.append(ballot)
    return (slugs[int(vote(np.array(ballots)).argmax())], len(ballots)) if ballots else (None, 0)


def whose(found: Recognised, member: Member) -> Whose | None:
    """Recognise the surgeon of a demonstration; None if its arm has no recognition."""
    arm = found.arms.get(member.arm)
    if arm is None:
        return None
    one = arm.members.index(member)
    probability, stranger = recognise(arm.signatures, arm.surgeons, arm.sessions, arm.recordings, one, arm.validated)
    likely = sorted(zip(probability.tolist(), arm.slugs, strict=True), reverse=True)
    voted, voters = _voted(found, member.recording_row)
    return Whose(
        demo=member.sha256,
        arm=member.arm,
        surgeon=member.surgeon,
        likely=[Likely(surgeon=surgeon, probability=p) for p, surgeon in likely],
        none_of_these=stranger,
        voted=voted,
        voters=voters,
    )
