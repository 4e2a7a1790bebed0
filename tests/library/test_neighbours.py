"""Nearest neighbours on both back ends: exact, and following every withdrawal, erasure and consent at once."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from skills.comparison import nearest
from skills.comparison.distances import STATES, distances, in_lengths, shape_of
from skills.db.models import Demonstration, Surgeon
from skills.db.row_visibility import Only
from skills.db.session import Database
from skills.errors import BadPath, Conflict, NotFound
from skills.library.comparison import neighbours
from skills.library.comparison.neighbours import forget_gone, nearest_to
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.recordings.demos import withdraw_demo
from tests import backends
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    with backends.opened(backends.fresh(request.param, tmp_path)) as database:
        yield database


@pytest.fixture
def names(database: Database) -> list[str]:
    """Store three surgeons in two sessions each, and return the digests."""
    return cohorts.add_cohort(database, cohort(1, surgeons=3, sessions=2))


def found(database: Database, demo: str, count: int = 10, **how: bool) -> list[str]:
    return [one.demo for one in nearest_to(database, demo, count, **how).nearest]


def held(database: Database) -> int:
    return sum(len(one.index) for one in neighbours._indices[database.engine].values())


@pytest.mark.parametrize("scaled", [False, True])
def test_they_are_those_of_all_pairs(database: Database, names: list[str], scaled: bool):
    with database.reading() as session:
        shapes = np.array(
            [shape_of(one.demo) for one in session.scalars(select(Demonstration).order_by(Demonstration.row))]
        )
    compared = np.array([in_lengths(shape) for shape in shapes]) if scaled else shapes
    far = distances(compared, compared) / STATES
    for one, name in enumerate(names):
        answer = nearest_to(database, name, 3, scaled=scaled)
        order = [other for other in np.argsort(far[one], kind="stable").tolist() if other != one][:3]
        assert [other.demo for other in answer.nearest] == [names[other] for other in order]
        np.testing.assert_allclose([other.distance for other in answer.nearest], far[one][order], atol=1e-4)
        assert answer.searched == 5 and answer.nearest[0].arm == "PSM"


def test_a_new_one_is_found_and_a_withdrawn_one_is_not(database: Database, names: list[str]):
    assert {*found(database, names[0])} == {*names[1:]}
    new = cases.add_demo(database, cohorts.hand_off(cohort(2), 0), cohorts.name(0), grid="fit").sha256
    assert {*found(database, names[0])} == {*names[1:], new}
    cases.committed(database, withdraw_demo, names[1], "test")
    assert {*found(database, names[0])} == {*names[2:], new} and held(database) == 6
    with pytest.raises(Conflict, match="withdrawn"):
        nearest_to(database, names[1], 3)
    with pytest.raises(NotFound):
        nearest_to(database, "0" * 64, 3)


def test_a_consent_acts_at_once_in_both_directions(database: Database, names: list[str]):
    found(database, names[0])

    def agree(uses: list[str]) -> None:
        cases.committed(database, cases.agree, {"uses": uses, "until": None}, cohorts.name(1))

    agree(["training"])
    assert {*found(database, names[0])} == {names[1], *names[4:]} and held(database) == 4
    with pytest.raises(Conflict, match="does not cover atlas"):
        nearest_to(database, names[2], 3)
    agree(["atlas"])
    assert {*found(database, names[0])} == {*names[1:]}


@pytest.mark.parametrize("whole", [True, False], ids=["a surgeon", "a demonstration"])
def test_erasure_leaves_nothing_in_memory(database: Database, names: list[str], whole: bool):
    found(database, names[0])
    with database.writing() as session:
        if whole:
            erase_surgeon(session, cohorts.name(1), "test")
        else:
            erase_demo(session, names[2], "test")
    forget_gone(database)  # as the service does every other second
    left = [one for one in names if one not in (names[2:4] if whole else names[2:3])]
    assert held(database) == len(left)
    assert {*found(database, names[0])} == {*left[1:]}


def test_what_is_erased_during_the_search_is_not_returned(
    database: Database, names: list[str], monkeypatch: pytest.MonkeyPatch
):
    really = nearest.ShapeIndex.nearest

    def erase_first(self, *given, **how):
        with database.writing() as session:
            if session.scalar(select(Surgeon).where(Surgeon.slug == cohorts.name(1))):
                erase_surgeon(session, cohorts.name(1), "test")
        return really(self, *given, **how)

    monkeypatch.setattr(nearest.ShapeIndex, "nearest", erase_first)
    assert {*found(database, names[0])} == {names[1], *names[4:]}


def test_a_key_finds_its_surgeons_alone_and_leaves_the_index_to_others(database: Database, names: list[str]):
    with database.reading() as session:
        mine = frozenset(session.scalars(select(Surgeon.row).where(Surgeon.slug != cohorts.name(1))))
    narrowed = database.seen_by(Only("anna", mine))
    for _ in range(2):
        answer = nearest_to(narrowed, names[0], 10)
        assert {one.demo for one in answer.nearest} == {names[1], *names[4:]} and answer.searched == 3
        assert cohorts.name(1) not in repr(answer)
        assert {*found(database, names[0])} == {*names[1:]}
    with pytest.raises(NotFound):
        nearest_to(narrowed, names[2], 3)


def test_cuts_of_one_motion_count_once(database: Database, names: list[str]):
    cases.add_surgeon(database)
    first, newest, after = (
        cases.add_demo(database, start_s=start_s, end_s=end_s, grid="fit").sha256
        for start_s, end_s in ((0.0, 0.6), (0.1, 0.7), (0.6, 1.0))
    )
    assert {*found(database, names[0])} == {*names[1:], newest, after}
    assert {*found(database, newest)} == {*names, after} == {*found(database, first)}
    assert len(found(database, newest, 7)) == 7


def test_one_without_a_direction_has_no_neighbours(database: Database, names: list[str]):
    corners = np.array([[-10, 55, -135], [-20, 60, -130], [-10.2, 55, -135]], dtype=float)
    around = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(corners)])
    lost = cases.add_demo(database, cases.table(around), cohorts.name(0)).sha256
    with pytest.raises(BadPath, match="no direction"):
        nearest_to(database, lost, 3)
    assert {*found(database, names[0])} == {*names[1:]} and held(database) == 6


def test_more_than_an_index_holds_are_refused(database: Database, names: list[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nearest, "MOST", 5)
    with pytest.raises(Conflict, match="an index holds 5"):
        nearest_to(database, names[0], 3)


def test_the_rows_are_listed_again_only_after_a_change(
    database: Database, names: list[str], monkeypatch: pytest.MonkeyPatch
):
    listed: list[bool] = []
    real = neighbours._Listed.rows

    def counted(self: neighbours._Listed, *given, **how) -> np.ndarray:
        listed.append(True)
        return real(self, *given, **how)

    monkeypatch.setattr(neighbours._Listed, "rows", counted)
    before = found(database, names[0])
    assert listed
    listed.clear()
    assert found(database, names[0]) == before and not listed
    cases.committed(database, withdraw_demo, before[0], "test")
    cases.add_demo(database, cohorts.hand_off(cohort(2), 0), cohorts.name(0), grid="fit")  # as many as before
    assert before[0] not in found(database, names[0]) and listed
