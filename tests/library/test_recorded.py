"""Who is recorded in some seconds: everybody there allows an export, also who has no demonstration or was erased."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.orm import Session

from skills.db.session import Database
from skills.errors import Conflict
from skills.formats import write_mcap
from skills.formats.parsed import parse_recording
from skills.library.comparison.recognition import recognise_recording
from skills.library.comparison.scores import score
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import erasures_of
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.recordings.datasets import request_dataset
from skills.library.recordings.demos import exported_chunk, exported_recording, find_demo, shown_demo
from skills.library.recordings.proposals import find_proposal
from skills.library.recordings.recordings import store_recording
from skills.library.recordings.timelines import Source, check_export, timeline_of
from skills.schemas.datasets import DatasetIn
from skills.schemas.people import SurgeonIn
from skills.schemas.scores import ScoreIn
from tests import backends
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts
from tests.library.exports import PASS_S, add, session_of

SHIFT = (2.5, 0.0, 0.0)
NOTHING = {"uses": [], "until": None}
FIRST, SECOND = {"start_s": 0.0, "end_s": PASS_S - 0.02}, {"start_s": PASS_S, "end_s": 2 * PASS_S - 0.02}


def agree(database: Database, surgeon: str, to: Any) -> None:
    cases.committed(database, put_surgeon, surgeon, SurgeonIn.model_validate({"consent": to}), "anna")


def doors(database: Database, demo: str) -> dict[str, bool]:
    """Return whether each export lets the motion of a demonstration, or of its recording, out."""
    recording = recording_of(database, demo)

    def asked(whole: bool) -> Callable[[Session], object]:
        said = DatasetIn(name="d", licence="CC-BY-4.0", procedure="p", description="d", demos=[demo], whole=whole)
        return lambda session: request_dataset(session, said, "test")

    opens: dict[str, Callable[[Session], object]] = {
        "bytes": lambda session: exported_recording(session, demo),
        "a chunk": lambda _: exported_chunk(database, demo, 0),
        "timeline": lambda session: check_export(session, "demos", demo),
        "timeline of all": lambda session: check_export(session, "recordings", recording),
        "dataset": asked(whole=False),
        "dataset of all": asked(whole=True),
    }
    found = {}
    for name, let_out in opens.items():
        with database.writing() as session:
            try:
                let_out(session)
                found[name] = True
            except Conflict:
                found[name] = False
            session.rollback()
    return found


def recording_of(database: Database, demo: str) -> str:
    with database.reading() as session:
        return find_demo(session, demo).recording.sha256


OF_ALL = {"bytes", "a chunk", "timeline of all", "dataset of all"}
OF_ITS_SECONDS = {"timeline", "dataset"}


def shown(database: Database, demo: str) -> set[str]:
    """Return what a reader sees: a demonstration's own motion, its seconds with both arms, and its whole recording."""
    recording = recording_of(database, demo)
    found = set()
    resources: tuple[tuple[Source, str], ...] = (("demos", demo), ("recordings", recording))
    for source, sha256 in resources:
        try:
            timeline_of(database, source, sha256, parse_recording)
            found.add(source)
        except Conflict:
            continue
    with database.reading() as session:
        return {*found, *(["path"] if shown_demo(session, demo) else [])}


def shut(database: Database, demo: str) -> set[str]:
    return {name for name, opened in doors(database, demo).items() if not opened}


def name_wren(database: Database, demo: str) -> None:
    """Upload the recording of a demonstration once more, for wren."""
    cases.add_surgeon(database, "wren")
    sent = cases.upload(write_mcap(session_of()), "application/vnd.mcap")
    stored, _ = store_recording(database, sent, "test", surgeon="wren")
    assert recording_of(database, demo) == stored.sha256


def test_a_surgeon_named_at_the_upload_is_asked_at_every_door(database: Database) -> None:
    demo = add(database, session_of())
    name_wren(database, demo)
    assert shut(database, demo) == set()
    assert shown(database, demo) == {"path", "demos", "recordings"}
    agree(database, "wren", {"uses": ["atlas"], "until": None})
    assert shown(database, demo) == {"path", "demos", "recordings"}
    agree(database, "wren", NOTHING)
    assert shut(database, demo) == OF_ALL | OF_ITS_SECONDS
    assert shown(database, demo) == {"path"}


def test_a_surgeon_of_other_seconds_is_asked_for_the_whole(database: Database) -> None:
    cases.add_surgeon(database, "wren")
    both = session_of((0.0, 0.0, 0.0), SHIFT)
    demo = add(database, both, **FIRST)
    add(database, both, "wren", **SECOND)
    agree(database, "wren", NOTHING)
    assert shut(database, demo) == OF_ALL


@pytest.mark.parametrize("to", [None, NOTHING, {"uses": ["export", "atlas", "training"], "until": None}])
def test_erasing_a_named_surgeon_opens_nothing(database: Database, to: Any) -> None:
    demo = add(database, session_of())
    name_wren(database, demo)
    agree(database, "wren", to)
    cases.committed(database, erase_surgeon, "wren", "test")
    assert shut(database, demo) == OF_ALL | OF_ITS_SECONDS


@pytest.mark.parametrize("at_once", [False, True], ids=["one after another", "at the same time"])
def test_erasing_a_surgeon_leaves_their_seconds_for_no_use(database: Database, at_once: bool) -> None:
    cases.add_surgeon(database, "wren")
    both = session_of((0.0, 0.0, 0.0), SHIFT)
    demo = add(database, both, **FIRST)
    add(database, both, "wren", **(SECOND | {"start_s": PASS_S / 2} if at_once else SECOND))
    agree(database, "wren", NOTHING)
    cases.committed(database, erase_surgeon, "wren", "test")
    assert shown(database, demo) == ({"path"} if at_once else {"path", "demos"})
    assert shut(database, demo) == OF_ALL | (OF_ITS_SECONDS if at_once else set())


def test_a_surgeon_of_an_erased_demonstration_is_still_asked(database: Database) -> None:
    cases.add_surgeon(database, "wren")
    both = session_of((0.0, 0.0, 0.0), SHIFT)
    demo, other = add(database, both, **FIRST), add(database, both, "wren", **SECOND)
    cases.committed(database, erase_demo, other, "test")
    assert shut(database, demo) == set()
    agree(database, "wren", NOTHING)
    assert shut(database, demo) == OF_ALL
    cases.committed(database, erase_surgeon, "wren", "test")
    assert shut(database, demo) == OF_ALL


def test_a_recording_that_is_deleted_takes_its_intervals_along(database: Database) -> None:
    demo = add(database, session_of())
    name_wren(database, demo)
    cases.committed(database, erase_surgeon, "wren", "test")
    cases.committed(database, erase_demo, demo, "test")
    assert shut(database, add(database, session_of())) == set()


def test_a_restored_backup_with_the_list_of_erasures_opens_nothing(database: Database, tmp_path: Path) -> None:
    demo = add(database, session_of())
    name_wren(database, demo)
    agree(database, "wren", NOTHING)
    back_up(database, tmp_path / "before.zip")
    cases.committed(database, erase_surgeon, "wren", "test")
    back_up(database, tmp_path / "after.zip")
    for name in ("before", "after"):
        restored = Database(backends.blank("sqlite", tmp_path))
        restore(restored, tmp_path / f"{name}.zip", erasures_of(database))
        assert shut(restored, demo) == OF_ALL | OF_ITS_SECONDS
        restored.close()


def test_scores_ask_everybody_in_the_recording(database: Database) -> None:
    demo = add(database, session_of())
    name_wren(database, demo)
    recording = recording_of(database, demo)
    asked = ScoreIn(surgeon="kestrel", suture=cases.SUTURE, recording=recording, arm="PSM2")
    assert score(database, asked, parse_recording).figures
    agree(database, "wren", NOTHING)
    with pytest.raises(Conflict, match="does not cover comparisons"):
        score(database, asked, parse_recording)
    cases.committed(database, erase_surgeon, "wren", "test")
    with pytest.raises(Conflict, match="does not cover comparisons"):
        score(database, asked, parse_recording)


def test_a_recording_of_several_surgeons_is_recognised_as_nobodys(database: Database) -> None:
    drawn = cohort(3, surgeons=3, sessions=2)
    cohorts.add_cohort(database, drawn)
    sent = cohorts.hand_off(drawn, 0)
    recording = store_recording(database, cases.upload(sent), "test", surgeon="kestrel")[0].sha256
    with pytest.raises(Conflict, match="Several surgeons"):
        recognise_recording(database, recording, cases.SUTURE, parse_recording)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    with pytest.raises(Conflict, match="Several surgeons"):
        recognise_recording(database, recording, cases.SUTURE, parse_recording)


def test_a_proposal_is_not_the_others_after_one_of_two_was_erased(database: Database) -> None:
    cases.add_surgeon(database, "wren")
    for surgeon in ("kestrel", "wren"):
        recording = store_recording(database, cases.upload(cases.hand_off()), "test", surgeon=surgeon)[0].sha256
    with database.reading() as session:
        assert find_proposal(session, recording, 1).surgeon is None
    cases.committed(database, erase_surgeon, "wren", "test")
    with database.reading() as session:
        assert find_proposal(session, recording, 1).surgeon is None
