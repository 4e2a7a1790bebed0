"""Recognition of whole recordings on a real database: with consent, of one surgeon, and without its own session."""

import pytest
from sqlalchemy import select

from skills.db.models import Demonstration
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound
from skills.formats.parsed import parse_recording
from skills.library.comparison.recognition import recognise_recording
from skills.schemas.comparison import RecognisedRecording
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts


def recognised(database: Database, recording: str) -> RecognisedRecording:
    return recognise_recording(database, recording, cases.SUTURE, parse_recording)


def test_only_recordings_of_one_surgeon_who_agreed_are_compared(database: Database) -> None:
    drawn = cohort(3, surgeons=3, sessions=2)
    cohorts.add_cohort(database, drawn)
    with database.reading() as session:
        of = {one.recording.sha256: one.surgeon.slug for one in session.scalars(select(Demonstration))}
    first, second = (next(one for one, name in of.items() if name == cohorts.name(k)) for k in (0, 1))
    assert recognised(database, first).votes.recordings == 6
    cases.add_demo(database, cohorts.hand_off(drawn, list(of).index(second)), cohorts.name(2), grid="fit")
    with pytest.raises(Conflict, match="Several surgeons"):
        recognised(database, second)
    assert recognised(database, first).votes.recordings == 4  # the other one of its surgeon has no other session
    cases.committed(database, cases.agree, {"uses": [], "until": None}, cohorts.name(2))
    with pytest.raises(BadInput, match="two surgeons with two sessions"):
        recognised(database, first)
    cases.committed(database, cases.agree, {"uses": [], "until": None}, cohorts.name(0))
    with pytest.raises(NotFound, match="no demonstration"):
        recognised(database, first)
