"""Demonstrations combined, and moved to another place."""

import warnings
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skills.comparison import combining
from skills.comparison.combining import moved
from skills.comparison.distances import distances, medoid, placed
from skills.errors import BadInput, BadPath
from skills.gridworld.grid import discretize, fit_grid
from skills.kinematics import matrix_of
from skills.learning.evaluation import dtw
from skills.planning.path_fit import trace
from tests.bench import geometry
from tests.bench.combining import METHODS as METHODS_MEASURED
from tests.bench.combining import NEWEST, cohorts, leave_one_out
from tests.bench.geometry import measured
from tests.comparison.cohort import cohort, demo_of

METHODS = pytest.mark.parametrize("how", combining.COMBININGS)
SEEDS = st.integers(0, 2**32 - 1)


def ways_of(seed, count=5, states=30):
    """Return random walks around a common one, (count, states, 3)."""
    rng = np.random.default_rng(seed)
    common = np.cumsum(rng.normal(1.0, 1.0, (states, 3)), axis=0)
    return common + np.cumsum(rng.normal(0.0, 0.3, (count, states, 3)), axis=1)


def in_one_place(seed=0, count=5):
    """Return one surgeon's demonstrations, which start and end at one place."""
    rng = np.random.default_rng(seed)
    humps = rng.normal(0.0, 5.0, (3, 2))
    return [demo_of(humps + rng.normal(0.0, 1.0, (3, 2)), 0.3, np.zeros(3), rng.uniform(2, 4)) for _ in range(count)]


def shifted(path_mm, *by_mm):
    return path_mm + np.array(by_mm)


def total(ways_mm, way_mm):
    return sum(dtw(one, way_mm).total_mm for one in ways_mm)


# ---- by hand -----------------------------------------------------------------------------------------------------


def test_the_barycentre_of_three_parallel_lines_is_the_middle_not_the_mean():
    line = np.stack([np.arange(0.0, 50.0, 10.0), np.zeros(5), np.zeros(5)], axis=1)
    ways = np.stack([line, shifted(line, 0.0, 1.0, 0.0), shifted(line, 0.0, 5.0, 0.0)])
    np.testing.assert_allclose(combining.barycentre(ways, ways[0]), ways[1])
    assert total(ways, ways[1]) == 5 * (1 + 0 + 4)


def test_the_corridor_ignores_a_path_only_where_it_strays():
    line = np.stack([np.arange(0.0, 90.0, 10.0), np.zeros(9), np.zeros(9)], axis=1)
    straying = shifted(line, 0.0, 3.0, 0.0)
    straying[4, 2] = 60.0
    ways = np.stack([line, shifted(line, 0.0, 1.5, 0.0), shifted(line, 0.0, 3.0, 0.0), straying, line])
    middle = combining.corridor(ways, ways[1])
    np.testing.assert_allclose(middle[[0, 1, 7, 8], 1], 1.5)  # of all five: 0, 1.5, 3, 3, 0
    np.testing.assert_allclose(middle[4], [40.0, 1.125, 0.0])  # of the other four
    np.testing.assert_allclose(middle[:, 2], 0.0)


def test_the_width_is_the_distance_within_which_the_majority_passes():
    line = np.stack([np.arange(0.0, 50.0, 10.0), np.zeros(5), np.zeros(5)], axis=1)
    ways = np.stack([line, shifted(line, 0.0, 0.0, 1.0), shifted(line, 0.0, 3.0, 0.0), shifted(line, 0.0, 0.0, 4.0)])
    np.testing.assert_allclose(combining.widths(ways, line), 3.0)  # 3 of 4; all would be within 4 mm
    np.testing.assert_allclose(combining.widths(ways[:1], line), 0.0)


def test_of_two_demos_the_medoid_is_the_newest_and_the_corridor_is_halfway():
    one, other = in_one_place(count=2)
    assert combining.combine([one, other], "medoid").medoid == 1
    assert combining.combine([other, one], "medoid").medoid == 1
    middle = combining.combine([one, other], "corridor")
    ways_mm, _ = combining.side_by_side([one, other])
    assert middle.width_mm.max() < np.linalg.norm(ways_mm[0] - ways_mm[1], axis=1).max()


# ---- laws --------------------------------------------------------------------------------------------------------


@METHODS
def test_one_demonstration_alone_gives_itself(how):
    (demo,) = in_one_place(count=1)
    alone = combining.combine([demo], how)
    ways_mm, moved = combining.side_by_side([demo])
    np.testing.assert_allclose(alone.tip_mm, ways_mm[0], atol=1e-6)
    assert not alone.width_mm.any()
    assert (alone.medoid, alone.moved, moved) == (0, False, False)


@METHODS
@pytest.mark.parametrize("apart", [False, True])
def test_the_order_of_the_older_ones_does_not_matter(how, apart):
    demos = list(cohort(3, surgeons=1, sessions=5).demos) if apart else in_one_place(3)
    *older, newest = demos
    one, other = combining.combine(demos, how), combining.combine([*older[::-1], newest], how)
    assert one.moved is other.moved is apart
    np.testing.assert_allclose(one.tip_mm, other.tip_mm, atol=3e-6)
    np.testing.assert_allclose(one.width_mm, other.width_mm, atol=3e-6)
    assert demos[one.medoid] is [*older[::-1], newest][other.medoid]


@METHODS
def test_moving_all_moves_the_result(how):
    demos, by = in_one_place(4), np.array([11.0, -7.0, 3.0])
    there = [replace(demo, tip_mm=demo.tip_mm + by) for demo in demos]
    np.testing.assert_allclose(
        combining.combine(there, how).tip_mm, combining.combine(demos, how).tip_mm + by, atol=3e-6
    )


@METHODS
def test_turning_and_moving_the_older_demos_does_not_change_the_result(how):
    *older, newest = cohort(5, surgeons=1, sessions=4).demos
    rng = np.random.default_rng(5)
    elsewhere = [
        replace(
            demo, tip_mm=Rotation.from_euler("z", rng.uniform(-3, 3)).apply(demo.tip_mm.copy()) + rng.normal(0, 20, 3)
        )
        for demo in older
    ]
    one, other = combining.combine([*older, newest], how), combining.combine([*elsewhere, newest], how)
    assert one.moved and other.moved
    assert one.medoid == other.medoid
    np.testing.assert_allclose(placed(one.tip_mm), placed(other.tip_mm), atol=3e-6)
    if how != "medoid":  # a medoid stays at the place where it was performed
        np.testing.assert_allclose(one.tip_mm, other.tip_mm, atol=3e-6)


@given(SEEDS)
def test_the_medoid_is_the_most_central_demo_and_the_barycentre_no_worse(seed):
    ways = ways_of(seed)
    middle = ways[medoid(distances(ways, ways), np.arange(len(ways)))]
    assert total(ways, combining.barycentre(ways, middle)) <= total(ways, middle) + 1e-9
    assert total(ways, middle) == pytest.approx(min(total(ways, one) for one in ways))


@given(SEEDS)
def test_no_state_of_the_barycentre_can_be_moved_to_be_nearer_to_all(seed):
    ways, rng = ways_of(seed, count=3, states=12), np.random.default_rng(seed)
    found = combining.barycentre(ways, ways[0])
    least = total(ways, found)
    for _ in range(20):
        nudged = found.copy()
        nudged[rng.integers(len(found)), rng.integers(3)] += rng.choice([-1e-6, 1e-6])
        assert total(ways, nudged) >= least - 1e-9


@given(SEEDS)
def test_one_far_outlier_moves_the_corridor_by_less_than_the_others_spread(seed):
    ways = ways_of(seed)
    far = np.concatenate([ways, shifted(ways[:1], 0.0, 0.0, 1000.0)])
    apart = np.linalg.norm(ways[:, None] - ways[None], axis=-1).max()
    assert np.abs(combining.corridor(far, ways[0]) - combining.corridor(ways, ways[0])).max() < apart
    assert np.abs(combining.corridor(far, ways[0])[:, 2]).max() < np.abs(ways[..., 2]).max() + apart


# ---- a second method ---------------------------------------------------------------------------------------------


@pytest.mark.nightly  # its library compiles for 12 s
@pytest.mark.parametrize("seed", range(5))
def test_the_barycentre_is_near_to_the_one_of_tslearn_and_nearer_to_all(seed):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it lacks an optional package
        from tslearn.barycenters import dtw_barycenter_averaging
    demos = in_one_place(seed)
    ways_mm, _ = combining.side_by_side(demos)
    found = combining.combine(demos, "barycentre")
    others = dtw_barycenter_averaging(ways_mm, init_barycenter=ways_mm[found.medoid], max_iter=50)
    assert total(ways_mm, found.tip_mm) < total(ways_mm, others)  # its means minimise squares
    apart = dtw(found.tip_mm, others)
    assert apart.differences_mm.sum(axis=1).mean() < 1.0  # mm at a state, of paths that are 2 to 4 mm apart


# ---- the place of the combination --------------------------------------------------------------------------------


def test_demos_that_begin_and_end_together_are_combined_as_recorded():
    ways_mm, moved = combining.side_by_side(in_one_place())
    assert not moved
    np.testing.assert_allclose(ways_mm[:, 0], 0.0, atol=0.5)


def test_demos_from_different_places_are_moved_to_the_newest_one():
    *older, newest = in_one_place()
    away = replace(older[0], tip_mm=shifted(older[0].tip_mm, combining.TOGETHER_MM + 0.1, 0.0, 0.0))
    ways_mm, moved = combining.side_by_side([away, *older[1:], newest])
    (alone,), _ = combining.side_by_side([newest])
    assert moved
    np.testing.assert_allclose(ways_mm[:, [0, -1]], np.broadcast_to(alone[[0, -1]], (5, 2, 3)), atol=3e-6)
    np.testing.assert_allclose(ways_mm[-1], alone, atol=3e-6)


@pytest.mark.parametrize("other", [{"arm": "PSM1"}, {"frame": "PSM1_base"}, {"instrument": "420006"}])
def test_demonstrations_of_another_arm_frame_or_instrument_are_refused(other):
    one, two = in_one_place(count=2)
    with pytest.raises(BadInput, match="one arm"):
        combining.combine([one, replace(two, **other)], "medoid")


def test_none_are_refused():
    with pytest.raises(BadInput):
        combining.combine([], "corridor")


# ---- as a demonstration ------------------------------------------------------------------------------------------


@METHODS
@pytest.mark.parametrize("apart", [False, True])
def test_what_is_followed_is_a_demonstration_that_a_plan_can_be_fitted_to(how, apart):
    demos = list(cohort(3, surgeons=1, sessions=5).demos) if apart else in_one_place()
    found = combining.followed(demos, [discretize(demo.tip_mm, fit_grid(demo.tip_mm)) for demo in demos], how)
    fitted, whose = trace(found.demo, found.path), demos[found.combined.at]
    assert fitted.path is found.path
    assert (found.demo.arm, found.demo.frame, found.demo.end_s) == (whose.arm, whose.frame, whose.end_s)
    assert np.abs(found.demo.tip_mm[-1] - whose.tip_mm[-1]).max() < 5.0
    assert len(found.width_mm) == len(found.path.states)
    assert 0 < found.width_mm.min() <= found.width_mm.max() <= found.combined.width_mm.max()


def test_the_medoid_followed_is_one_of_the_demonstrations_and_its_path():
    demos = in_one_place()
    paths = [discretize(demo.tip_mm, fit_grid(demo.tip_mm)) for demo in demos]
    found = combining.followed(demos, paths, "medoid")
    assert found.demo is demos[found.combined.medoid]
    assert found.path is paths[found.combined.medoid]


def test_a_way_that_leaves_the_newest_grid_gets_one_of_the_same_cells():
    demos = in_one_place()
    paths = [discretize(demo.tip_mm, fit_grid(demo.tip_mm, 2.0), 0.25) for demo in demos]
    away = replace(demos[-1], tip_mm=demos[-1].tip_mm * [1.0, 1.0, 0.1])
    flat = discretize(away.tip_mm, fit_grid(away.tip_mm, 2.0, margin_cells=0), 0.25)
    found = combining.followed([*demos[:-1], away], [*paths[:-1], flat], "corridor")
    assert found.path.grid != flat.grid
    assert (found.path.grid.cell_mm, found.path.hysteresis) == (2.0, 0.25)


# ---- the best method ---------------------------------------------------------------------------------------------


@pytest.mark.nightly  # rarely breaks
def test_with_an_outlier_the_corridor_is_nearest_to_a_left_out_demo():
    errors = leave_one_out(cohorts(1.0, surgeons=4, each=5), outlier=True)
    means = {method: errors.of(method)[0].mean() for method in METHODS_MEASURED}
    assert min(means, key=means.get) == "corridor"
    assert means["corridor"] < means["medoid"] < means[NEWEST]


HUMPS_MM = np.array([[3.0, 8.0], [-2.0, 1.0], [1.0, 1.0]])
PLACES = st.tuples(*[st.floats(-80, 80)] * 3).map(np.array)


def demo():
    one = demo_of(HUMPS_MM, 0.4, np.array([5.0, 40.0, -120.0]), 3.0)
    turning = Rotation.from_euler("xyz", np.outer(one.stamps_s + 1.0, [0.1, 0.2, 0.3]))
    return replace(one, rotation_xyzw=turning.as_quat())


def test_a_path_of_40_mm_along_x_is_turned_and_doubled_onto_80_mm_along_y():
    along_x = np.array([[0.0, 0.0, 0.0], [20.0, 3.0, 5.0], [40.0, 0.0, 0.0]])
    one = replace(demo(), stamps_s=np.arange(3.0), tip_mm=along_x, rotation_xyzw=None)
    there = moved(one, [1.0, 2.0, 3.0], [1.0, 82.0, 3.0])
    np.testing.assert_allclose(there.tip_mm, [[1.0, 2.0, 3.0], [-5.0, 42.0, 13.0], [1.0, 82.0, 3.0]], atol=1e-12)


@given(PLACES, PLACES)
def test_it_begins_and_ends_where_it_should_and_its_shape_stays(start, goal):
    one = demo()
    scale = np.linalg.norm(goal - start) / np.linalg.norm(one.tip_mm[-1] - one.tip_mm[0])
    if not 0.25 <= scale <= 4.0:
        with pytest.raises(BadPath):
            moved(one, start, goal)
        return
    there = moved(one, start, goal)
    np.testing.assert_allclose(there.tip_mm[[0, -1]], [start, goal], atol=1e-9)
    np.testing.assert_allclose(placed(there.tip_mm, scaled=True), placed(one.tip_mm, scaled=True), atol=1e-9)


@given(PLACES, PLACES)
def test_the_tool_turns_with_the_way(start, goal):
    one = demo()
    try:
        there = moved(one, start, goal)
    except BadPath:
        return
    before, after = (combining.axes(d.tip_mm[0], d.tip_mm[-1]) @ matrix_of(d.rotation_xyzw) for d in (one, there))
    np.testing.assert_allclose(before, after, atol=1e-9)


def test_moved_to_where_it_is_it_stays_and_there_and_back_is_where_it_was():
    one = demo()
    start, goal = one.tip_mm[0], one.tip_mm[-1]
    np.testing.assert_allclose(moved(one, start, goal).tip_mm, one.tip_mm, atol=1e-9)
    there = moved(one, [0.0, 0.0, -100.0], [30.0, -20.0, -90.0])
    np.testing.assert_allclose(moved(there, start, goal).tip_mm, one.tip_mm, atol=1e-9)


@given(PLACES, PLACES)
def test_axes_are_a_right_handed_frame_along_the_way_with_its_upside_up(start, goal):
    if np.linalg.norm(goal - start) < 1.0:
        return
    x, y, z = combining.axes(start, goal)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    np.testing.assert_allclose(x, (goal - start) / np.linalg.norm(goal - start), atol=1e-12)
    assert z[2] >= 0 or abs(x[2]) >= 0.99


@pytest.mark.parametrize("goal", [[0.0, 0.0, 0.5], [5.0, 0.0, 0.0], [300.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
def test_a_way_of_no_length_or_of_quite_another_is_refused(goal):
    with pytest.raises(BadInput, match=r"times as long|NaN"):
        moved(demo(), np.zeros(3), goal)


def test_where_the_other_arm_would_be_is_not_made_up():
    assert moved(demo(), np.zeros(3), [30.0, 0.0, 0.0]).partner is None


def test_at_other_lines_ours_keeps_the_shape_and_a_primitive_loses_it():
    kept, lost = (
        [shape for shape, *_ in islice(measured(geometry.METHODS[name], 1), 2)]
        for name in ("ours", "dynamic primitive")
    )
    assert max(kept) < 1e-9
    assert lost[0] < 1.0 < lost[1]  # mm at a state: at its own line, and at another
