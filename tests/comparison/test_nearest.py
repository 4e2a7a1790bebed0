"""Exact nearest neighbours: equal to all pairs, by laws, and with shapes that come and go."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.comparison import nearest
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
    for parts in (COARSE, FINE):
        mine, theirs = boxes_of(one, parts).astype(float), boxes_of(other, parts).astype(float)
        bound = STATES / parts * nearest.boxes_apart(mine, theirs, np.empty(parts), np.empty(parts))
        assert bound <= total * nearest.SLACK
        held, bounds = np.array([boxes_of(other, parts)], np.float32).transpose(2, 1, 0), np.empty(1)
        room = np.empty(1), np.empty((parts, 1))
        nearest.bound_all(mine, STATES / parts, held, np.ones(1), 0, 1, *room, bounds)
        assert bounds[0] == pytest.approx(bound, rel=1e-12)
        apart, ahead, before = np.empty((parts, STATES)), np.empty((parts, STATES)), np.empty(STATES)
        nearby = nearest.points_apart(one.T, theirs, apart, before)
        assert nearby <= nearest.SLACK * nearest.ahead_within(apart, before, np.inf, ahead) <= total * nearest.SLACK
        assert nearest.ahead_within(apart, before, total * nearest.SLACK, ahead) == ahead[0, 0] < np.inf


@settings(deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 20.0), st.floats(0.5, 2.0))
def test_a_warping_is_exact_within_its_limit_and_infinite_beyond(seed: int, spread_mm: float, share: float):
    one, other = varied(2, seed, spread_mm)
    total, rows = distances([one], [other])[0, 0], np.empty((2, STATES + 1))
    apart, ahead, before = np.empty((FINE, STATES)), np.empty((FINE, STATES)), np.empty(STATES)
    nearest.points_apart(one.T, boxes_of(other, FINE).astype(float), apart, before)
    limit = share * total
    bound = nearest.ahead_within(apart, before, limit * nearest.SLACK, ahead)
    found = np.inf
    if bound < np.inf:
        found = nearest.warped_within(one, other, 1.0, ahead, limit * nearest.SLACK, *rows)
    if total <= limit:
        assert found == total
    assert found in (total, np.inf)
    if total > limit * nearest.SLACK**2:
        assert found == np.inf


def searched(shapes: np.ndarray, count: int, kernels: tuple) -> tuple[list, list, list, int]:
    """Return bounds, neighbours, totals and warpings of a search for the first shape."""
    size, (bound, search) = len(shapes), kernels
    fine = np.array([boxes_of(shape, FINE) for shape in shapes])
    mine, lengths = fine[0].astype(float), np.ones(size)
    bounds, rows, totals = np.empty(size), np.full(count, -1), np.full(count, np.inf)
    held = np.ascontiguousarray(fine.transpose(2, 1, 0))
    bound(mine, STATES / FINE, held, lengths, 0, size, np.empty(8), np.empty((FINE, 8)), bounds)
    order = np.argsort(bounds, kind="stable")
    room = np.empty((6, FINE)), np.empty((3, STATES + 1)), np.empty((2, FINE, STATES))
    axes = np.ascontiguousarray(shapes[0].T)
    warped = search(
        shapes[0], axes, mine, shapes, fine, lengths, order, bounds, nearest.SLACK, *room, rows, totals
    )  # fmt: skip
    return bounds.tolist(), rows.tolist(), totals.tolist(), warped


PLAIN = nearest.bound_all.plain, nearest.search_shapes.plain
COMPILED = nearest.bound_all, nearest.search_shapes


@pytest.mark.parametrize("count", [5, pytest.param(12, marks=pytest.mark.nightly)])
def test_compiled_and_plain_agree_to_the_last_bit(count):
    shapes = varied(count)
    assert searched(shapes, 3, PLAIN) == searched(shapes, 3, COMPILED)


def test_most_are_excluded_without_warping():
    assert 5 <= searched(varied(400), 5, COMPILED)[3] < 60


def test_shapes_come_and_go(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nearest, "FIRST_ROOM", 4)
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
