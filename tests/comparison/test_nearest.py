"""Exact nearest neighbours: equal to all pairs, by laws, and with shapes that come and go."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.comparison import _kernels, nearest
from skills.comparison.distances import STATES, distances, in_lengths, shape_of
from skills.comparison.nearest import COARSE, FINE, ShapeIndex, boxes_of
from tests.comparison.cohort import cohort


def varied(count: int, seed: int = 0, spread_mm: float = 1.0) -> np.ndarray:
    """Return variations of a cohort's shapes, shape (count, STATES, 3)."""
    rng = np.random.default_rng(seed)
    of = np.array([shape_of(demo) for demo in cohort(1, surgeons=4, sessions=2).demos])
    humps = np.sin(np.pi * np.arange(1, 4)[:, None] * np.linspace(0, 1, STATES))
    sizes = rng.uniform(0.8, 1.2, (count, 1, 1))
    return of[rng.integers(len(of), size=count)] * sizes + np.einsum(
        "nha,hs->nsa", rng.normal(0, spread_mm, (count, 3, 3)), humps
    )


def index_of(shapes: np.ndarray) -> ShapeIndex:
    made = ShapeIndex()
    for row, shape in enumerate(shapes):
        made.add(row, shape)
    return made


@pytest.mark.parametrize("scaled", [False, True])
def test_they_are_those_of_all_pairs_to_the_last_bit(scaled: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nearest, "WORTH_A_THREAD", 100)  # two threads
    shapes = varied(400)
    shapes[7] = shapes[3]  # equally near
    found = index_of(shapes)
    compared = np.array([in_lengths(shape) for shape in shapes]) if scaled else shapes
    for one in (0, 3, 50):
        rows, totals = found.nearest(compared[one], 12, scaled=scaled)
        everything = distances(compared[[one]], compared)[0]
        first = np.argsort(everything, kind="stable")[:12]
        assert (rows == first).all() and (totals == everything[first]).all()


@settings(deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 20.0))
def test_bounds_never_exceed_the_distance(seed: int, spread_mm: float):
    one, other = varied(2, seed, spread_mm)
    total = distances([one], [other])[0, 0]
    row = np.empty(STATES + 1)
    for parts in (COARSE, FINE):
        mine, theirs = boxes_of(one, parts), boxes_of(other, parts).astype(float)
        assert STATES / parts * _kernels.boxes_apart(mine, theirs, row) <= total * nearest.SLACK
        assert _kernels.boxed_within(one, theirs, row, np.inf) <= total * nearest.SLACK


def test_an_abandoned_warping_is_infinite_and_a_finished_one_exact():
    one, other = varied(2, 5)
    total, row = distances([one], [other])[0, 0], np.empty(STATES + 1)
    assert _kernels.warped_within(one, other, row, total) == total
    assert _kernels.warped_within(one, other, row, total / 4) == np.inf


def test_compiled_and_plain_agree_to_the_last_bit():
    shapes = varied(12)
    fine = np.array([boxes_of(shape, FINE) for shape in shapes])
    found = []
    for bound, search in (
        (_kernels.bound_all, _kernels.search),
        (_kernels.bound_all_compiled, _kernels.search_compiled),
    ):
        bounds, rows, totals = np.empty(12), np.empty(3, np.int64), np.empty(3)
        corners, row, room = np.empty((FINE, 6)), np.empty(STATES + 1), np.empty((STATES, 3))
        bound(fine[0], STATES / FINE, fine, np.ones(12), corners, row, bounds)
        order = np.argsort(bounds, kind="stable")
        warped = search(
            shapes[0], fine[0], STATES / FINE, shapes, fine, np.ones(12), order, bounds, 1.0, corners, row, room, rows,
            totals,
        )  # fmt: skip
        found.append((bounds.tolist(), rows.tolist(), totals.tolist(), warped))
    assert found[0] == found[1]


def test_most_are_excluded_without_warping():
    shapes = varied(400)
    fine = np.array([boxes_of(shape, FINE) for shape in shapes])
    bounds, rows, totals = np.empty(400), np.empty(5, np.int64), np.empty(5)
    corners, row, room = np.empty((FINE, 6)), np.empty(STATES + 1), np.empty((STATES, 3))
    _kernels.bound_all_compiled(fine[0], STATES / FINE, fine, np.ones(400), corners, row, bounds)
    order = np.argsort(bounds, kind="stable")
    warped = _kernels.search_compiled(
        shapes[0],
        fine[0],
        STATES / FINE,
        shapes,
        fine,
        np.ones(400),
        order,
        bounds,
        1.0,
        corners,
        row,
        room,
        rows,
        totals,
    )
    print(warped)
    assert 5 <= warped < 100


def test_shapes_come_and_go(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nearest, "FIRST_ROOM", 4)
    monkeypatch.setattr(nearest, "LAST_GROWN", 16)
    monkeypatch.setattr(nearest, "MOST", 64)
    shapes, rng = varied(60), np.random.default_rng(3)
    found, there = ShapeIndex(), dict[int, np.ndarray]()
    for step in range(60):
        found.add(step, shapes[step])
        there[step] = shapes[step]
        if step % 3 == 2:
            gone = int(rng.choice(sorted(there)))
            found.remove([gone, 1000])
            del there[gone]
        assert len(found) == len(there) and {*found.rows.tolist()} == {*there}
    for row, shape in there.items():
        assert row in found and (found.shape_of(row) == shape).all()
    rows, totals = found.nearest(shapes[0], 100)
    everything = distances(shapes[[0]], np.array([there[row] for row in rows.tolist()]))[0]
    assert len(rows) == len(there) and (totals == everything).all() and (np.diff(totals) >= 0).all()


def test_what_is_removed_is_overwritten_and_only_what_is_allowed_is_found():
    shapes = varied(10)
    found = index_of(shapes)
    found.remove(range(5))
    assert (found._shapes[5:10] == 0).all() and (found._fine[5:10] == 0).all() and 3 not in found
    among = found.rows >= 8
    assert {*found.nearest(shapes[0], 9, among=among)[0].tolist()} == {8, 9}
    found.remove(range(10))
    assert [len(one) for one in found.nearest(shapes[0], 3)] == [0, 0]
