"""The list of proposed hand-offs: which are accepted, which are rejected, and where the decisions end."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import func, select, text

from skills.db.models import ProposalMark
from skills.db.row_visibility import Only
from skills.db.session import Database
from skills.demonstration.segments import Segment
from skills.errors import Conflict, NotFound
from skills.formats.parsed import parse_recording
from skills.library.people.erasure import delete_recording, erase_surgeon
from skills.library.recordings import proposals
from skills.library.recordings.demos import withdraw_demo
from skills.library.recordings.proposals import Proposal, decide, list_proposals, paths_of
from skills.library.recordings.recordings import store_recording
from skills.seeds.recordings import sample_recordings
from tests import backends
from tests.library import cases
from tests.library.cases import fetch

FIVE = next(one for one in sample_recordings() if len(one.segments) == 5)
MCAP = "application/vnd.mcap"


@pytest.fixture(params=backends.BACKENDS)
def five(request: pytest.FixtureRequest, tmp_path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Database]:
    """Yield a database with a recording of five proposals, sent for kestrel, and one of a single proposal of nobody."""
    with backends.opened(backends.fresh(request.param, tmp_path)) as database:
        for surgeon in ("kestrel", "heron"):
            cases.add_surgeon(database, surgeon)
        store_recording(database, cases.upload(FIVE.data, MCAP), "anna", surgeon="kestrel")
        store_recording(database, cases.upload(cases.bag("PSM1", "PSM2"), MCAP), "bert")
        yield database


def listed(database: Database, limit: int = 200, **asked: str) -> list[Proposal]:
    """Return all proposals, page by page."""
    found: list[Proposal] = []
    after = None
    for _ in range(100):
        page, after = fetch(database, list_proposals, limit, after, **asked)
        found += page
        if after is None:
            return found
    raise AssertionError("the pages do not end")


def numbered(found: list[Proposal]) -> list[tuple[str, int]]:
    return [(one.recording.sha256[:4], one.number) for one in found]


def mark(database: Database, recording: str, number: int, state: str, note: str | None = None) -> Proposal:
    return cases.committed(database, decide, recording, number, state, note, "anna")


def cut(database: Database, one: Proposal, surgeon: str = "kestrel", late_s: float = 0.0) -> str:
    part = {"arm": one.segment.arm, "start_s": one.segment.start_s + late_s, "end_s": one.segment.end_s}
    return cases.store(database, cases.upload(FIVE.data, MCAP), surgeon, **part).sha256


def states(database: Database, recording: str) -> list[str]:
    return [one.state for one in listed(database, recording=recording)]


def test_pages_of_any_length_list_the_same_proposals(five: Database, monkeypatch: pytest.MonkeyPatch):
    everything = numbered(listed(five))
    assert len(everything) == 7 and everything[2:] == [(everything[2][0], number) for number in range(1, 6)]
    for at_once, looked_at, limit in ((50, 500, 1), (50, 500, 3), (1, 1, 2), (1, 2, 7), (2, 2, 2)):
        monkeypatch.setattr(proposals, "AT_ONCE", at_once)
        monkeypatch.setattr(proposals, "LOOKED_AT", looked_at)
        assert numbered(listed(five, limit)) == everything


def test_a_cut_accepts_its_proposal_and_a_rejection_stays(five: Database):
    first, *_ = found = listed(five, surgeon="kestrel")
    recording = first.recording.sha256
    assert [one.surgeon for one in found] == ["kestrel"] * 5
    demo = cut(five, first, "heron", late_s=0.2)
    mark(five, recording, 2, "rejected", "only regrasped")
    mark(five, recording, 2, "rejected", "only regrasped")
    assert states(five, recording) == ["accepted", "rejected", "open", "open", "open"]
    (accepted,) = listed(five, state="accepted", suture=cases.SUTURE)
    assert (accepted.surgeon, accepted.demo.sha256) == ("heron", demo)
    (rejected,) = listed(five, state="rejected")
    assert rejected.mark is not None and rejected.mark.note == "only regrasped"
    assert [one.number for one in listed(five, surgeon="kestrel", state="open")] == [3, 4, 5]
    with five.reading() as session:
        assert session.scalar(select(func.count()).select_from(ProposalMark)) == 1
    with pytest.raises(Conflict, match="was accepted"):
        mark(five, recording, 1, "rejected")
    assert mark(five, recording, 2, "open").state == "open"
    cases.committed(five, withdraw_demo, demo, "anna")
    assert states(five, recording)[0] == "accepted"  # a withdrawn cut cannot be made again
    for number in (0, 6):
        with pytest.raises(NotFound, match="it has 5"):
            mark(five, recording, number, "rejected")


def test_a_cut_of_the_whole_recording_accepts_none_of_several(five: Database):
    first = listed(five, surgeon="kestrel")[0]
    cases.store(five, cases.upload(FIVE.data, MCAP), segment="whole")
    assert set(states(five, first.recording.sha256)) == {"open"}


def test_decisions_are_deleted_with_their_recording(five: Database):
    (first, *_, other) = listed(five)[2:3] + listed(five)[:1]
    for one in (first, other):
        mark(five, one.recording.sha256, 1, "rejected", "by a name")
    cases.committed(five, erase_surgeon, "kestrel", "anna")
    with five.writing() as session:
        assert session.scalars(select(ProposalMark.recording_row)).all() == [other.recording.row]
        delete_recording(session, other.recording.sha256, "bert", as_admin=False)
    with five.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM proposal_marks")) == 0


def test_who_sees_one_surgeon_sees_their_recordings_and_their_own_uploads(five: Database):
    recording = listed(five, surgeon="kestrel")[0].recording.sha256
    mark(five, recording, 3, "rejected")
    demo = cut(five, listed(five, surgeon="kestrel")[0], "heron")
    with five.reading() as session:
        heron = session.scalar(text("SELECT row FROM surgeons WHERE slug = 'heron'"))
    seen = five.seen_by(Only("heron's", frozenset({heron})))
    found = listed(seen)
    assert [one.state for one in found] == ["accepted", "open", "rejected", "open", "open"]
    assert found[0].demo.sha256 == demo
    assert {one.surgeon for one in found[1:]} == {None}, "the recording was uploaded for a surgeon who is hidden"
    assert listed(five.seen_by(Only("nobody", frozenset()))) == []


def test_a_small_path_begins_and_ends_where_the_tip_does(five: Database):
    told = parse_recording(cases.upload(FIVE.data, MCAP).file)
    motion, (first, *_) = told.recording.motion_of(), told.proposed
    drawn = paths_of(five, listed(five, surgeon="kestrel")[0].recording.sha256, parse_recording)
    assert len(drawn) == 5 and all(len(one) <= proposals.POINTS for one in drawn)
    seconds = told.recording.seconds(motion.stamps_ns)
    inside = motion.tip_mm[(seconds >= first.start_s) & (seconds < first.end_s)]
    assert drawn[0][0] == pytest.approx(inside[0], abs=0.01)
    assert drawn[0][-1] == pytest.approx(inside[-1], abs=0.01)


@given(st.tuples(*[st.integers(0, 40)] * 4).map(lambda at: (*sorted(at[:2]), *sorted(at[2:]))))
def test_the_same_hand_off_is_half_of_the_longer_of_two(at: tuple[int, int, int, int]):
    """A second way to decide: count the unit steps of both."""
    start, end, begins, ends = at
    one, other = set(range(start, end)), set(range(begins, ends))

    class Cut:
        start_s, end_s = begins, ends

    if one and other:
        expected = 2 * len(one & other) >= max(len(one), len(other))
        assert proposals._same(Segment("PSM2", start, end, end, "motion", ()), Cut()) == expected
