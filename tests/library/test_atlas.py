"""The atlas on both back ends: a cohort of known truth, its cache, and data that must not be cached."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from sqlalchemy import select, text

from skills.db.models import Demonstration, MeasuredShape, Surgeon
from skills.db.packed import digest
from skills.db.row_visibility import Only
from skills.db.session import Database
from skills.errors import BadInput, BadPath, Conflict, NotFound
from skills.learning.evaluation import dtw
from skills.library.comparison import atlas, measuring
from skills.library.comparison.atlas import atlas_of
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.policies.releases import withdraw
from skills.library.recordings.demos import withdraw_demo
from skills.schemas.comparison import Atlas
from skills.schemas.people import SurgeonIn
from tests import backends
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts

SUTURE = cases.SUTURE
AROUND_MM = np.array([[-10, 55, -135], [-20, 60, -130], [-10.2, 55, -135]], dtype=float)


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    with backends.opened(backends.fresh(request.param, tmp_path)) as database:
        yield database


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that records how many pairs each call measures."""
    counted: list[int] = []
    really = measuring.distances_of

    def count(shapes, pairs):
        counted.append(len(pairs))
        return really(shapes, pairs)

    monkeypatch.setattr(measuring, "distances_of", count)
    return counted


def small(database: Database, **how) -> list[str]:
    """Store two surgeons in two sessions each."""
    return cohorts.add_cohort(database, cohort(1, surgeons=2, sessions=2), **how)


def kept(database: Database) -> dict[int, str]:
    with database.reading() as session:
        return {row.demonstration_row: digest(row.measured) for row in session.scalars(select(MeasuredShape))}


def far(found: Atlas) -> np.ndarray:
    size = len(found.demos)
    whole = np.zeros((size, size))
    for at, row in enumerate(found.distances):
        whole[at, :at] = whole[:at, at] = row
    return whole


@pytest.mark.nightly  # by day tests/comparison/test_recognition.py
def test_eight_surgeons_in_five_sessions_are_recognised_and_told_apart(database: Database):
    names = cohorts.add_cohort(database)
    found = atlas_of(database, SUTURE)
    assert [one.id for one in found.demos] == names
    assert [(one.surgeon, one.demos, one.sessions) for one in found.surgeons] == [
        (cohorts.name(surgeon), 5, 5) for surgeon in range(8)
    ]
    (seen,) = found.recognition
    assert (seen.arm, seen.compared, found.no_recognition_because) == ("PSM", ["shape"], None)
    print(f"{seen.right} of {seen.tested}, {seen.interval}, log loss {seen.log_loss:.2f} nat, sure {seen.sureness:.2f}")
    assert (seen.tested, seen.chance) == (40, 0.125)
    assert seen.interval[0] > 0.6 > 4 * seen.chance
    assert seen.log_loss < 0.5 * seen.log_loss_of_guessing == pytest.approx(0.5 * np.log(8))
    assert [one.demos for one in seen.curve] == [8] * 5 and seen.stranger_if_known < seen.stranger_if_left_out
    assert found.votes is not None and (found.votes.recordings, found.votes.right) == (40, seen.right)
    whose = atlas_of(database, SUTURE, demo=names[12]).recognised
    assert whose is not None
    assert (whose.arm, whose.surgeon, whose.likely[0].surgeon) == ("PSM", cohorts.name(2), cohorts.name(2))
    assert sum(one.probability for one in whose.likely) == pytest.approx(1.0)
    assert (whose.voted, whose.voters) == (cohorts.name(2), 1) and whose.none_of_these < 0.5
    assert len(found.differences) == 28
    assert 6 <= len(found.clusters) <= 10 and found.silhouette is not None and found.silhouette > 0.25
    assert all(one.surgeons[0].demos >= one.demos / 2 for one in found.clusters)
    assert 0.3 < found.chart_shows <= 1.0
    assert any("Set-up and day" in note for note in found.notes)


@pytest.mark.nightly  # by day tests/comparison has it
def test_with_labels_shuffled_recognition_falls_to_chance(database: Database):
    drawn = cohort(1)
    cohorts.add_cohort(database, drawn, whose=np.random.default_rng(5).permutation(drawn.surgeons))
    (seen,) = atlas_of(database, SUTURE).recognition
    print(f"{seen.right} of {seen.tested}, {seen.interval}, log loss {seen.log_loss:.2f} nat")
    chance = 40 * 0.125
    assert abs(seen.right - chance) < 4 * np.sqrt(chance * (1 - 0.125))  # of one shuffle; for many see tests/comparison
    assert seen.log_loss > 0.9 * seen.log_loss_of_guessing  # and its confidence is not above chance


def test_the_atlas_uses_the_papers_measure_and_scaling_removes_size(database: Database):
    small(database)
    plain, scaled = atlas_of(database, SUTURE), atlas_of(database, SUTURE, scaled=True)
    rows = select(Demonstration).order_by(Demonstration.row)
    with database.reading() as session:
        shapes = [measuring.shape_of(one.demo) for one in session.scalars(rows)]
    np.testing.assert_allclose(far(plain)[0, 3], dtw(shapes[0], shapes[3]).total_mm / 100, atol=1e-4)
    one, other = (shape / shape[-1, 0] for shape in (shapes[0], shapes[3]))
    np.testing.assert_allclose(far(scaled)[0, 3], dtw(one, other).total_mm / 100, atol=1e-4)
    assert (plain.unit, scaled.unit) == ("mm", "lengths of start to goal")
    (apart_by,) = plain.differences
    assert apart_by.sentence.startswith(f"In the {apart_by.part}, the path of surgeon-0 is ")
    assert np.sum(apart_by.shares) == pytest.approx(1.0, abs=1e-3)


def test_the_dendrogram_and_the_clusters_are_one(database: Database):
    small(database)
    found = atlas_of(database, SUTURE, clusters=3)
    assert found.clusters_chosen == "as asked"
    assert [one.demos for one in found.merges][-1] == 4
    assert found.merges[0].distance == pytest.approx(far(found)[found.merges[0].one, found.merges[0].other])
    assert sorted(found.order) == [0, 1, 2, 3]
    assert sum(one.demos for one in found.clusters) == 4
    assert {one.cluster for one in found.demos} == {one.cluster for one in found.clusters} == {1, 2, 3}
    with pytest.raises(BadInput, match="1 to 4 clusters"):
        atlas_of(database, SUTURE, clusters=5)


@pytest.mark.nightly  # slow if it fails, not wrong
def test_a_new_demonstration_costs_one_row_of_distances(database: Database, measured: list[int]):
    small(database)
    first = atlas_of(database, SUTURE)
    assert measured == [6, 6]  # of all pairs, with and without size
    before = kept(database)
    assert len(before) == 4
    assert atlas_of(database, SUTURE) == first
    atlas_of(database, SUTURE, scaled=True)
    assert measured == [6, 6]
    cases.add_demo(database, cohorts.hand_off(cohort(2), 0), cohorts.name(0), grid="fit")
    assert len(atlas_of(database, SUTURE).demos) == 5
    assert measured == [6, 6, 4, 4]
    assert kept(database).items() > before.items() and len(kept(database)) == 5


def test_the_shape_cache_may_be_dropped_and_other_versions_are_ignored(
    database: Database, measured: list[int], monkeypatch: pytest.MonkeyPatch
):
    small(database)
    first = atlas_of(database, SUTURE)
    with database.writing() as session:
        session.execute(text("DELETE FROM measured_shapes"))
    assert atlas_of(database, SUTURE) == first
    monkeypatch.setattr(measuring, "VERSION", 0)
    assert atlas_of(database, SUTURE) == first
    assert measured == [6, 6] * 3
    with database.reading() as session:
        assert set(session.scalars(select(MeasuredShape.version))) == {0}


@pytest.mark.nightly  # slow if it fails, not wrong
def test_it_is_measured_in_blocks_and_kept_block_by_block(
    database: Database, measured: list[int], monkeypatch: pytest.MonkeyPatch
):
    cohorts.add_cohort(database, cohort(1, surgeons=3, sessions=3))
    whole = atlas_of(database, SUTURE)
    with database.writing() as session:
        session.execute(text("DELETE FROM measured_shapes"))
    measured.clear()
    monkeypatch.setattr(measuring, "PAIRS_AT_ONCE", 10)
    monkeypatch.setattr(measuring, "DEMOS_AT_ONCE", 2)
    assert atlas_of(database, SUTURE) == whole
    assert sum(measured) == 2 * 36 and len(measured) > 4


def test_two_that_ask_at_once_measure_once(database: Database, measured: list[int]):
    small(database)
    found: list[Atlas] = []
    threads = [Thread(target=lambda: found.append(atlas_of(database, SUTURE))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4 and found[0] == found[1] == found[2] == found[3]
    assert measured == [6, 6]


def test_consent_is_asked_and_who_is_left_out_is_counted_and_not_named(database: Database):
    names = small(database)
    with database.writing() as session:
        put_surgeon(
            session,
            cohorts.name(1),
            SurgeonIn.model_validate({"consent": {"uses": ["training"], "until": None}}),
            "test",
        )
    found = atlas_of(database, SUTURE)
    assert [one.id for one in found.demos] == names[:2]
    assert found.left_out.without_consent == 2
    assert "Left out: 2 demonstrations, because the surgeon's consent does not cover an atlas." in found.notes
    assert cohorts.name(1) not in repr(found)
    with pytest.raises(Conflict, match="does not cover atlas"):
        atlas_of(database, SUTURE, demo=names[2])
    with database.writing() as session:
        put_surgeon(
            session,
            cohorts.name(1),
            SurgeonIn.model_validate({"consent": {"uses": ["atlas"], "until": "2020-01-01"}}),
            "test",
        )
        put_surgeon(
            session,
            cohorts.name(0),
            SurgeonIn.model_validate({"consent": {"uses": ["training"], "until": None}}),
            "test",
        )
    with pytest.raises(NotFound, match="4 demonstrations, because the surgeon's consent"):
        atlas_of(database, SUTURE)


def test_who_comes_back_costs_only_the_pairs_that_are_missing(database: Database, measured: list[int]):
    names = small(database)
    cases.committed(database, cases.agree, {"uses": [], "until": None}, cohorts.name(0))
    atlas_of(database, SUTURE)
    assert measured == [1, 1]
    cases.committed(database, cases.agree, None, cohorts.name(0))
    assert [one.id for one in atlas_of(database, SUTURE).demos] == names
    assert measured == [1, 1, 5, 5]


def test_withdrawn_ones_are_not_in_it(database: Database):
    names = small(database)
    cases.committed(database, withdraw_demo, names[0], "test")
    found = atlas_of(database, SUTURE)
    assert [one.id for one in found.demos] == names[1:]
    assert (found.recognition, found.votes, found.recognised) == ([], None, None)
    assert found.no_recognition_because is not None and "two sessions each" in found.no_recognition_because
    with pytest.raises(Conflict, match="withdrawn"):
        atlas_of(database, SUTURE, demo=names[0])


def test_sessions_that_nobody_named_are_one_for_each_recording(database: Database):
    small(database, sessions=False)
    seen = atlas_of(database, SUTURE)
    assert [one.sessions for one in seen.surgeons] == [2, 2]
    assert [one.tested for one in seen.recognition] == [4]


def test_a_cut_is_not_recognised_by_another_cut_of_its_recording(database: Database):
    """This includes cuts with separate session names, and cuts of which only one has a name."""
    for surgeon, shift in (("kestrel", 0.0), ("plover", 2.5)):
        cases.add_surgeon(database, surgeon)
        for number, session in enumerate(("morning", "noon", None)):
            part = {"start_s": 0.35 * number, "end_s": 0.35 * (number + 1)}
            named = session and f"{surgeon}-{session}"
            cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0)), surgeon, session=named, grid="fit", **part)
    found = atlas_of(database, SUTURE)
    assert (len(found.demos), found.recordings) == (6, 2)
    assert [(one.demos, one.recordings, one.sessions) for one in found.surgeons] == [(3, 1, 1), (3, 1, 1)]
    assert found.recognition == [] and "two sessions each" in (found.no_recognition_because or "")
    drawn = cohort(1, surgeons=2, sessions=2)
    for number, session in enumerate(("kestrel-noon", "kestrel-evening", "plover-noon", "plover-evening")):
        surgeon = session.split("-")[0]
        cases.add_demo(database, cohorts.hand_off(drawn, number), surgeon, session=session, grid="fit")
    found = atlas_of(database, SUTURE)
    assert [(one.demos, one.recordings, one.sessions) for one in found.surgeons] == [(5, 3, 2), (5, 3, 2)]
    assert [one.tested for one in found.recognition] == [10]
    assert found.votes is not None and found.votes.recordings == 6


def test_overlapping_cuts_of_one_recording_count_once(database: Database):
    cases.add_surgeon(database)
    first, second, newest, after = (
        cases.add_demo(database, start_s=start_s, end_s=end_s, grid="fit").sha256
        for start_s, end_s in ((0.0, 0.6), (0.1, 0.5), (0.2, 0.7), (0.6, 1.0))
    )
    for _ in range(2):
        found = atlas_of(database, SUTURE)
        assert [one.id for one in found.demos] == [newest, after]
        assert found.left_out.overlapped == [first, second]
        assert "Left out: 2 demonstrations. A newer cut of the same motion counts" in found.left_out.because[0]
    with pytest.raises(Conflict, match="A newer cut of the same motion counts"):
        atlas_of(database, SUTURE, demo=first)
    cases.committed(database, withdraw_demo, newest, "test")
    assert [one.id for one in atlas_of(database, SUTURE).demos] == [second, after]


def test_a_surgeon_has_the_share_that_starts_of_the_served_policy_follow(database: Database):
    names = ["heron", "kestrel"]
    for number, surgeon in enumerate(names):
        cases.add_surgeon(database, surgeon)
        cases.add_demo(database, cases.hand_off((number, 0.0, 0.0)), surgeon)
    policy = cases.train(database, names[0], release=True)
    cases.train(database, names[1])  # not released

    def shares() -> list[float | None]:
        return [one.mean_share for one in atlas_of(database, SUTURE).surgeons]

    served = round(policy.manifest.coverage.mean_share, 4)
    assert 0.0 < served < 1.0
    assert shares() == [served, None]
    with database.writing() as session:
        withdraw(session, session.scalars(select(Surgeon).where(Surgeon.slug == names[0])).one(), SUTURE, "test")
    assert shares() == [None, None]


def test_of_too_many_a_sample_is_shown_and_the_rest_counted(database: Database, monkeypatch: pytest.MonkeyPatch):
    names = small(database)
    monkeypatch.setattr(atlas, "MOST", 3)
    for asked in [None, *names]:
        found = atlas_of(database, SUTURE, demo=asked)
        drawn = sorted({*sorted(name for name in names if name != asked)[: 2 if asked else 3], *filter(None, [asked])})
        assert sorted(one.id for one in found.demos) == drawn
        assert found.left_out.not_sampled == 1 and "1 demonstration. An atlas shows 3 at the most" in found.notes[-1]


def test_one_without_a_direction_is_left_out_by_name(database: Database, measured: list[int]):
    small(database)
    around = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(AROUND_MM)])
    lost = cases.add_demo(database, cases.table(around), cohorts.name(0)).sha256
    for _ in range(2):
        found = atlas_of(database, SUTURE)
        assert len(found.demos) == 4
        assert found.left_out.without_direction == [lost]
    assert measured == [6, 6]
    with pytest.raises(BadPath, match="no direction"):
        atlas_of(database, SUTURE, demo=lost)


@pytest.mark.parametrize("whole", [True, False], ids=["a surgeon", "a demonstration"])
def test_erasure_leaves_nothing(database: Database, whole: bool):
    names = small(database)
    atlas_of(database, SUTURE)
    assert len(kept(database)) == 4
    with database.writing() as session:
        if whole:
            erase_surgeon(session, cohorts.name(0), "test")
        else:
            erase_demo(session, names[0], "test")
    with database.reading() as session:  # a remaining row had a distance to the erased one
        assert all(len(one.measured.others) == 0 for one in session.scalars(select(MeasuredShape)))
    assert [one.id for one in atlas_of(database, SUTURE).demos] == names[2:] if whole else names[1:]


def test_what_is_erased_while_it_is_measured_is_not_kept(database: Database, monkeypatch: pytest.MonkeyPatch):
    names = small(database)
    really = measuring.distances_of

    def erase_first(shapes, pairs):
        with database.writing() as session:
            if session.scalar(select(Surgeon).where(Surgeon.slug == cohorts.name(0))):
                erase_surgeon(session, cohorts.name(0), "test")
        return really(shapes, pairs)

    monkeypatch.setattr(measuring, "distances_of", erase_first)
    assert [one.id for one in atlas_of(database, SUTURE).demos] == names[2:]
    with database.reading() as session:
        there = {*session.scalars(select(Demonstration.row))}
        measured = session.scalars(select(MeasuredShape)).all()
    assert {one.demonstration_row for one in measured} == there
    assert all({*one.measured.others.tolist()} <= there for one in measured)


def test_a_restricted_atlas_holds_permitted_surgeons_and_leaves_the_cache(database: Database, measured: list[int]):
    names = small(database)
    with database.reading() as session:
        mine = session.scalars(select(Surgeon.row).where(Surgeon.slug == cohorts.name(1))).one()
    narrowed = database.seen_by(Only("anna", frozenset({mine})))
    found = atlas_of(narrowed, SUTURE)
    assert [one.id for one in found.demos] == names[2:]
    assert cohorts.name(0) not in repr(found) and names[0] not in repr(found)
    whole = atlas_of(database, SUTURE)
    assert len(whole.demos) == 4
    assert measured == [1, 1, 5, 5]
    assert atlas_of(narrowed, SUTURE) == found
    assert measured == [1, 1, 5, 5]
    with pytest.raises(NotFound):
        atlas_of(narrowed, SUTURE, demo=names[0])


def test_one_alone_has_an_atlas_and_nothing_has_none(database: Database):
    cases.add_surgeon(database)
    with pytest.raises(NotFound, match="no demonstration of 'simple-running'"):
        atlas_of(database, SUTURE)
    with pytest.raises(NotFound, match="no suture type"):
        atlas_of(database, "nothing")
    demo = cases.add_demo(database)
    found = atlas_of(database, SUTURE)
    assert [(one.id, one.at) for one in found.demos] == [(demo.sha256, (0.0, 0.0))]
    assert (found.merges, found.distances, found.silhouette) == ([], [[]], None)
    assert [one.spread for one in found.surgeons] == [None]
    with pytest.raises(NotFound):
        atlas_of(database, SUTURE, demo="0" * 64)
    with pytest.raises(NotFound, match="request that atlas"):
        atlas_of(database, "simple-interrupted", demo=demo.sha256)


@pytest.mark.nightly
def test_with_labels_shuffled_many_times_it_stays_at_chance(database: Database):
    drawn, rng = cohort(1), np.random.default_rng(6)
    right = of = 0
    losses = []
    for _ in range(20):
        whose = rng.permutation(drawn.surgeons)
        names = cohorts.add_cohort(database, drawn, whose=whose)
        (seen,) = atlas_of(database, SUTURE).recognition
        right, of, losses = right + seen.right, of + seen.tested, [*losses, seen.log_loss]
        with database.writing() as session:
            for name in names:
                erase_demo(session, name, "test")
    print(f"{right} of {of}, log loss {np.mean(losses):.2f} nat")
    assert of == 20 * 40
    assert abs(right - of / 8) < 4 * np.sqrt(of * 7 / 64)
    assert np.mean(losses) > 0.95 * np.log(8)
