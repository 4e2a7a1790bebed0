"""Recognition of surgeons in an atlas: validated for each arm, of one demonstration, and by votes of a recording.

    members, signatures --recognise_arms--> Recognised --> the answers of an atlas

A demonstration is compared with those of the same arm only, because the hands have different tasks. A recording's vote
in an atlas is of its demonstrations of all arms.

    Database, recording --recognise_recording--> RecognisedRecording

A whole recording is recognised by all its movements (`skills.demonstration.segments.movements_by_arm`), whichever of
them were cut: by the movements of other recordings whose surgeons are known, as they have demonstrations in the atlas.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from sqlalchemy import select

from skills.arithmetic import wilson
from skills.arrays import Floats, Ints
from skills.comparison.distances import shape_of
from skills.comparison.recognition import NUMBERS, Validated, recognise, signature_of, usable, validate, vote
from skills.db.models import StoredRecording
from skills.db.session import Database
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import movements_by_arm
from skills.errors import BadInput, BadPath, BadRecording, Conflict, NotFound
from skills.library.comparison.members import Member, members_of, sessions_of
from skills.library.people.recorded import in_recording
from skills.library.people.suture_types import find_suture_type
from skills.library.recordings.recordings import Parser, find_recording, stored_recording
from skills.schemas.comparison import CalibrationBin, Likely, RecognisedDemo, RecognisedRecording, Recognition, Votes

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

    @property
    def slugs(self) -> list[str]:
        """The surgeons of all arms."""
        return sorted({slug for arm in self.arms.values() for slug in arm.slugs})


def recognise_arms(members: Sequence[Member], signatures: Floats) -> Recognised:
    """Validate the recognition of the surgeons of each arm's demonstrations.

    Args:
        members: The demonstrations.
        signatures: Their signatures, shape (N, NUMBERS).
    """
    sessions, recordings = sessions_of(members), np.array([one.recording_row for one in members])
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
        curve=[
            CalibrationBin(demos=demos, predicted=predicted, right=right)
            for demos, predicted, right in validated.curve(BINS)
        ],
        stranger_if_known=float(validated.stranger.mean()),
        stranger_if_left_out=float(validated.unknown.mean()),
    )


def votes(found: Recognised) -> Votes | None:
    """Return how many recordings' votes name their surgeon; None if there is no recognition."""
    if not found.arms:
        return None
    tested = [arm.members[one] for arm in found.arms.values() for one in arm.validated.tested.tolist()]
    by_recording = {one.recording_row: one.surgeon for one in tested}
    right = sum(_voted(found, row)[0] == surgeon for row, surgeon in by_recording.items())
    return Votes(
        recordings=len(by_recording),
        right=right,
        accuracy=right / len(by_recording),
        interval=wilson(right, len(by_recording)),
        chance=1.0 / len(found.slugs),
    )


def _voted(found: Recognised, recording_row: int) -> tuple[str | None, int]:
    """Return the surgeon for whom a recording's tested demonstrations vote, and their number."""
    slugs = found.slugs
    ballots = []
    for arm in found.arms.values():
        for probability in arm.voters(recording_row):
            ballot = np.zeros(len(slugs))
            ballot[[slugs.index(slug) for slug in arm.slugs]] = probability
            ballots.append(ballot)
    return (slugs[int(vote(np.array(ballots)).argmax())], len(ballots)) if ballots else (None, 0)


def recognise_demo(found: Recognised, member: Member) -> RecognisedDemo | None:
    """Recognise the surgeon of a demonstration; None if its arm has no recognition."""
    arm = found.arms.get(member.arm)
    if arm is None:
        return None
    one = arm.members.index(member)
    probability, stranger = recognise(arm.signatures, arm.surgeons, arm.sessions, arm.recordings, one, arm.validated)
    likely = sorted(zip(probability.tolist(), arm.slugs, strict=True), reverse=True)
    voted, voters = _voted(found, member.recording_row)
    return RecognisedDemo(
        demo=member.sha256,
        arm=member.arm,
        surgeon=member.surgeon,
        likely=[Likely(surgeon=surgeon, probability=p) for p, surgeon in likely],
        none_of_these=stranger,
        voted=voted,
        voters=voters,
    )


# ---- whole recordings ----------------------------------------------------------------------------------------------

MOST_RECORDINGS = 150  # read for one request: each takes up to a tenth of a second, and its movements as long again

MOVEMENTS = (
    "A recording is recognised by the votes of all its movements that resemble a hand-off, of all arms, cut or not."
)


def recognise_recording(database: Database, recording_sha256: str, suture: str, parse: Parser) -> RecognisedRecording:
    """Recognise the surgeon of a recording by all its movements.

    Args:
        database: The database, restricted to the rows that the caller may see.
        recording_sha256: Digest of the recording, with a demonstration in the atlas of the suture type.
        suture: The suture type.
        parse: The reader of recordings, possibly in another process.

    Raises:
        NotFound: There is no such recording or suture type, or it has no demonstration that may be compared.
        Conflict: Several surgeons have demonstrations in the recording.
        BadInput: There are not two surgeons with two sessions each, or no movement of the recording could be tested.
    """
    with database.reading() as session:
        recording_sha256 = find_recording(session, recording_sha256).sha256  # in full: the argument may be a prefix
    chosen = _known(database, recording_sha256, suture)
    moved = {sha256: _movements(database, sha256, one, parse) for sha256, one in chosen.items()}
    still = _known(database, recording_sha256, suture)  # consent may have ended while they were read
    pairs = [pair for sha256, some in moved.items() if sha256 in still for pair in some]
    found = recognise_arms([member for member, _ in pairs], np.array([signature for _, signature in pairs]))
    asked = still[recording_sha256]
    named, voters = _voted(found, asked.recording_row)
    counted = votes(found)
    if named is None or counted is None:
        raise BadInput(
            "No movement of the recording could be compared. "
            + (" ".join(found.because) or "Its surgeon has no other session, or it has no movement of a known arm.")
        )
    return RecognisedRecording(
        recording=recording_sha256,
        suture=suture,
        surgeon=asked.surgeon,
        voted=named,
        voters=voters,
        votes=counted,
        recognition=recognitions(found),
        no_recognition_because=" ".join(found.because) or None,
        notes=[MOVEMENTS],
    )


def _known(database: Database, recording_sha256: str, suture: str) -> dict[str, Member]:
    """Return a demonstration of each recording of one surgeon, who agreed, by digest: the requested and newest ones."""
    with database.reading() as session:
        asked = find_recording(session, recording_sha256)
        members, _ = members_of(session, find_suture_type(session, suture).slug)
        by_row = {one.recording_row: one for one in members}
        if asked.row not in by_row:
            raise NotFound(f"This recording has no demonstration of '{suture}' that may be compared; cut one.")
        rows = [asked.row, *sorted({*by_row} - {asked.row}, reverse=True)[:MOST_RECORDINGS]]
        # Of all surgeons, also those whom the caller may not see: a movement of a recording may be of any of them.
        found = select(StoredRecording).where(StoredRecording.row.in_(rows))
        single = {one.row for one in session.scalars(found) if in_recording(session, one).single}
        if asked.row not in single:
            raise Conflict("Several surgeons are in this recording, so it has no single one.")
        digests = select(StoredRecording.row, StoredRecording.sha256).where(StoredRecording.row.in_(single))
        return {sha256: by_row[row] for row, sha256 in session.execute(digests).all()}


def _movements(database: Database, sha256: str, known: Member, parse: Parser) -> list[tuple[Member, Floats]]:
    """Return the movements of a recording as members of its surgeon, with their signatures."""
    try:
        recording = stored_recording(database, sha256, parse).recording
    except BadRecording:  # this version does not read it; the others are compared
        return []
    found = []
    for part in movements_by_arm(recording):
        try:
            demo = cut_demo(recording, arm=part.arm, start_s=part.start_s, end_s=part.end_s)
            shape_of(demo)
        except (BadRecording, BadPath):  # too short, or without a direction
            continue
        member = replace(known, arm=demo.arm, frame=demo.frame, start_s=demo.start_s, end_s=demo.end_s)
        found.append((member, signature_of(demo)))
    return found
