"""The contact referee: it can fail, it follows laws of friction, and what it says of the closed form."""

from dataclasses import replace
from math import tan

import numpy as np
import pytest

from skills.errors import BadInput, BadSettings, SimulationFailed
from skills.kinematics import matrix_of, quaternion_of
from skills.planning.handoff import HELD_MM, JAW_CLOSED_RAD, JAW_S, OPEN_RAD, TAKEN_MM
from skills.simulation import referee as refereeing
from skills.simulation.referee import Physics, Refereed, referee
from skills.verification.clearance import RADIUS_MM, needle_poses, psm_m_poses
from skills.verification.error_draws import draw, rotation_of
from skills.verification.probabilities import EstimateSettings
from tests.arms import ARMS, EXACT
from tests.needs import need
from tests.simulation.hand_overs import TESTED, Compared, compare
from tests.verification.test_monte_carlo import ALONE, BESIDE, PSM_M, motion, only, some_plan

ONE = motion(1, PSM_M)
NO_DOUBT = EstimateSettings(variations=1, suture_point_mm=0.0, needle_rad=0.0)


def exactly(trajectory=ONE, **given) -> Refereed:
    """Referee one trial in which everything is as the trajectory says."""
    need("mujoco")
    return referee(trajectory, errors=EXACT, trials=1, settings=NO_DOUBT, **given)


def requested(trajectory, number, drawn, errors=EXACT):
    """Return the request for the trials of a pass in drawn worlds."""
    watched = refereeing._watched(trajectory, number)
    displaced = drawn.under(errors, trajectory.stamps_s[watched])
    return refereeing._request(trajectory, number, watched, drawn, displaced, (), ())


def strokes(trajectory):
    """Return the request for one trial of the first pass, for its jaws."""
    watched = refereeing._watched(trajectory, 0)
    return requested(trajectory, 0, draw(0, 0, 1, len(watched), suture_point_mm=0.0, needle_rad=0.0))


def elsewhere(by_mm=(0.0, 0.0, 0.0), axis: int = 0, angle_deg: float = 0.0):
    """Return the plan with PSM_M's whole arm moved along [n o a] of its jaws, or turned about one of them."""
    psm_m = ONE.psm_m
    (hinge,), (jaw,) = psm_m_poses(ONE, ONE.last_samples)
    turn = rotation_of(np.radians(angle_deg) * jaw[None, :, axis])[0]
    base_mm = hinge + turn @ (psm_m.base_mm - hinge) + jaw @ np.array(by_mm)
    base = turn @ matrix_of(psm_m.base_xyzw[None])[0]
    return replace(ONE, psm_m=replace(psm_m, base_mm=base_mm, base_xyzw=quaternion_of(base[None])[0]))


def test_a_needle_handed_over_as_planned_is_held_and_hardly_slips():
    found = exactly()
    assert (found.held.count, found.straight.count, found.closed_form.count, found.agree) == (1, 1, 1, 1)
    assert found.slipped_mm[1] < 0.01 and found.turned_deg[1] < 0.1
    assert found.lost == {"before": 0, "missed": 0, "dropped": 0}
    assert found.engine.startswith("MuJoCo ")


@pytest.mark.parametrize(
    "trajectory",
    [
        elsewhere((0, 0, -5)),  # 5 mm short: the needle is beyond the tips
        elsewhere((0, 7, 0)),  # beside the open finger
        pytest.param(elsewhere((9, 0, 0)), marks=pytest.mark.nightly),  # where the needle does not pass the fingers
        pytest.param(elsewhere(axis=0, angle_deg=90), marks=pytest.mark.nightly),
        elsewhere(axis=2, angle_deg=90),  # the needle lies from finger to finger
    ],
    ids=["short", "aside", "along", "turned about the hinge", "turned about the approach"],
)
def test_jaws_that_are_elsewhere_do_not_get_the_needle(trajectory):
    found = exactly(trajectory)
    assert (found.held.count, found.closed_form.count, found.lost["before"]) == (0, 0, 0)


def test_jaws_hold_where_friction_exceeds_the_wedge_between_them():
    # Hinged fingers that hold a wire of radius r at depth h are a wedge of half angle asin(r / h): friction has to
    # exceed its tangent, or the wire is pressed out, however firm the grip. At PSM_A's 9 mm that is 0.037, at PSM_M's
    # 7 mm 0.047.
    wedges = [tan(np.arcsin(RADIUS_MM / depth)) for depth in (HELD_MM, TAKEN_MM)]
    assert exactly(physics=Physics(friction=0.0)).lost["before"] == 1
    assert exactly(physics=Physics(friction=0.8 * wedges[0])).lost["before"] == 1
    assert exactly(physics=Physics(friction=1.25 * wedges[1])).held.count == 1


@pytest.mark.nightly  # of the referee, which is no gate
def test_a_seed_gives_the_same_trials_and_half_the_step_the_same_outcomes():
    need("mujoco")
    trajectory, errors, _ = some_plan(4)
    once, again = (referee(trajectory, errors=errors, trials=2, seed=7) for _ in range(2))
    assert once == again
    finer = referee(trajectory, errors=errors, trials=2, seed=7, physics=Physics(step_s=0.00025))
    assert (finer.held, finer.lost, finer.agree) == (once.held, once.lost, once.agree)


def test_the_worlds_of_the_trials_are_those_of_the_closed_form():
    trajectory, count = BESIDE, 5
    watched = refereeing._watched(trajectory, 1)
    drawn = draw(3, 1, count, len(watched), suture_point_mm=5.0, needle_rad=0.2)
    world = requested(trajectory, 1, drawn)
    hinge, jaw = psm_m_poses(trajectory, watched)
    np.testing.assert_allclose(world.tip_mm[:, 1], hinge + drawn.shift_mm[:, None], atol=1e-9)
    np.testing.assert_allclose(world.jaw[2, 1], jaw, atol=1e-12)
    grip, needle = needle_poses(trajectory, watched)
    np.testing.assert_allclose(world.needle_mm, grip[0] + drawn.shift_mm, atol=1e-9)
    # As PSM_A turns, the needle's error goes with its jaws, and at the hand-off it is the one that was drawn.
    along = world.jaw[:, 0, -1] @ np.swapaxes(world.jaw[:, 0, 0], 1, 2) @ world.needle
    np.testing.assert_allclose(along, drawn.turned @ needle[-1], atol=1e-9)

    base = requested(trajectory, 1, drawn, only(registration_mm=2.0))
    np.testing.assert_allclose(base.tip_mm[:, 1] - world.tip_mm[:, 1], 2 * drawn.registration[:, None] + 0 * hinge)
    np.testing.assert_array_equal(base.tip_mm[:, 0], world.tip_mm[:, 0])


def test_the_trial_begins_where_no_finger_can_have_touched_the_needle():
    watched = refereeing._watched(ONE, 0)
    assert 1.0 < ONE.stamps_s[watched[-1]] - ONE.stamps_s[watched[0]] < 2.0
    hinge, _ = psm_m_poses(ONE, watched[:1])
    assert np.linalg.norm(needle_poses(ONE, watched[:1])[0] - hinge) > 16


def test_arms_are_followed_until_they_stand_and_jaws_then_move_as_planned():
    end, last = refereeing._watched(ONE, 0)[-1], ONE.last_samples[0]
    for planned in (ONE.joints, ONE.psm_m.joints):
        np.testing.assert_allclose(planned[end : last + 1] - planned[last], 0, atol=1e-9)
    # PSM_A holds and PSM_M is open; then PSM_M closes, and PSM_A opens only when it has: the order of a trial.
    theirs, mine = ONE.psm_m.jaw_rad[end : last + 1], ONE.jaw_rad[end : last + 1]
    assert (mine[0], theirs[0]) == (JAW_CLOSED_RAD, 2 * OPEN_RAD)
    assert (mine[-1], theirs[-1]) == (2 * OPEN_RAD, JAW_CLOSED_RAD)
    assert theirs[1] < theirs[0] and (theirs[mine > mine[0]] == JAW_CLOSED_RAD).all()
    # The trial commands these angles at the plan's own times, and then goes back no faster than the plan.
    asked = strokes(ONE)
    np.testing.assert_array_equal(asked.jaws_rad, [mine, theirs])
    np.testing.assert_allclose(asked.jaws_s, ONE.stamps_s[end : last + 1] - ONE.stamps_s[end])
    assert asked.jaws_s[-1] == pytest.approx(2 * JAW_S, abs=0.011)
    assert asked.back_s == pytest.approx(1.875 * 18 / ONE.speed_mm_s)


def test_a_jaw_that_holds_less_than_closed_grips_with_all_its_torque():
    held = np.where(ONE.jaw_rad == JAW_CLOSED_RAD, 0.1, ONE.jaw_rad)
    end = int(refereeing._watched(ONE, 0)[-1])
    mine, _ = strokes(replace(ONE, jaw_rad=held)).jaws_rad
    np.testing.assert_array_equal(mine, ONE.jaw_rad[end : ONE.last_samples[0] + 1])


def test_a_motion_whose_jaws_were_not_planned_is_not_refereed():
    with pytest.raises(BadInput, match="angles of both jaws"):
        exactly(replace(ONE, psm_m=replace(ONE.psm_m, jaw_rad=None)))


def test_fingers_that_come_never_near_are_watched_for_one_sample():
    away = elsewhere((0, 0, -60))
    assert refereeing._watched(away, 0).tolist() == refereeing._watched(ONE, 0)[-1:].tolist()


@pytest.mark.nightly  # of the referee, which is no gate
def test_each_quantity_of_the_physics_is_halved_and_doubled():
    need("mujoco")
    found = referee(ONE, errors=ARMS, trials=1, varied=1, settings=replace(NO_DOUBT, variations=2))
    factors = [(one.quantity, one.factor) for one in found.sensitivity]
    assert factors == [(name, by) for name in ("friction", "grip", "arm", "contact") for by in (0.5, 2.0)]
    assert [one.held.of for one in found.sensitivity] == [1] * 8
    doubled = Physics().times("arm", 2.0)
    assert (doubled.arm_n_mm, doubled.wrist_nmm_rad, doubled.friction) == (2.0, 2000.0, 0.3)
    assert Physics().times("contact", 0.25).contact_s == 0.004


@pytest.mark.parametrize("fault", ["unknown_end", "nan_motion", "too_few_ends", "nameless"])
def test_an_answer_of_the_referee_is_checked(fault):
    with pytest.raises(SimulationFailed) as caught:
        referee(ONE, errors=EXACT, trials=2, target=f"tests.simulation.faults:{fault}")
    assert caught.value.numbers["cause"] == "nonsense"


def test_requests_that_make_no_sense_are_refused():
    with pytest.raises(BadInput, match="PSM_M's base"):
        referee(ALONE, errors=EXACT)
    with pytest.raises(BadInput, match="A2"):
        referee(ONE, errors=EXACT, number=1)
    for given in ({"trials": 0}, {"trials": 2, "varied": 3}, {"seed": -1}):
        with pytest.raises(BadSettings):
            referee(ONE, errors=EXACT, **given)
    for numbers in (
        {"friction": -0.1},
        {"grip_nmm": 0.0},
        {"arm_n_mm": np.nan},
        {"step_s": 0.001},
        {"contact_s": 0.001},
    ):
        with pytest.raises(BadSettings) as refused:
            Physics(**numbers)
        assert ("must be at least 0" in refused.value.message) == ("friction" in numbers)


def test_without_mujoco_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(refereeing.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulationFailed, match="pip install 'mujoco"):
        referee(ONE, errors=EXACT)


# ---- the closed form beside the referee ------------------------------------------------------------------------


BANDS = (0.2, 0.4, 0.6, 0.8, 0.99)  # of the closed form's probability that the needle is caught


def refereed(plans: tuple[int, ...], trials: int, varied: int = 0) -> list[Refereed]:
    """Referee the first plans of each band, in the order of their seeds; each tenth also with other physics."""
    need("mujoco")
    found: list[Refereed] = []
    left, seed, settings = list(plans), 0, EstimateSettings(variations=4000)
    while any(left):
        trajectory, errors, _ = some_plan(seed)
        band = int(np.searchsorted(BANDS, caught_at(trajectory, errors, settings), side="right")) - 1
        if 0 <= band < len(left) and left[band]:
            left[band] -= 1
            others = varied if len(found) % 10 == 0 else 0
            asked = {"trials": trials, "varied": others, "seed": seed, "settings": settings}  # draws of its own
            found.append(referee(trajectory, errors=errors, **asked))
        seed += 1
    return found


def caught_at(trajectory, errors, settings: EstimateSettings) -> float:
    drawn = draw(0, 0, settings.variations, 1, suture_point_mm=5.0, needle_rad=settings.needle_rad)
    displaced = drawn.under(errors, trajectory.stamps_s[trajectory.last_samples])
    return float(refereeing._closed_form(trajectory, 0, drawn, displaced, settings).mean())


def test_a_plan_is_not_called_likelier_than_the_referee_finds_it():
    (found,) = refereed(plans=(0, 0, 1, 0), trials=4)
    assert not found.too_hopeful and found.only_closed_form == 0


@pytest.mark.nightly
def test_45_of_50_plans_are_called_no_likelier_than_the_referee_finds_them():
    found = refereed(plans=(12, 12, 13, 13), trials=100, varied=12)
    closed = [one.closed_form.probability for one in found]
    print(f"{sum(not one.too_hopeful for one in found)} of 50 plans, {min(closed):.2f} to {max(closed):.2f}")
    gaps = [one.gap for one in found]
    print(f"gap {np.mean(gaps):.3f} on average, {min(gaps):.2f} to {max(gaps):.2f}")
    straight = [one.straight for one in found]
    print(f"of those held straight {sum(p <= one.upper for p, one in zip(closed, straight, strict=True))} of 50 plans")
    print(f"agree {sum(one.agree for one in found)}, closed form alone {sum(one.only_closed_form for one in found)}")
    for k, name in enumerate((one.quantity, one.factor) for one in found[0].sensitivity):
        cases = [one.sensitivity[k] for one in found if one.sensitivity]
        print(name, sum(one.held.count for one in cases), "of", sum(one.held.of for one in cases))
    assert sum(not one.too_hopeful for one in found) >= 45
    assert min(closed) < 0.35 and max(closed) > 0.95


@pytest.mark.nightly
def test_half_the_time_step_hardly_changes_an_outcome():
    need("mujoco")
    changed = 0
    for seed in (2, 4, 9):
        trajectory, errors, _ = some_plan(seed)
        whole, half = (
            referee(trajectory, errors=errors, trials=30, seed=3, physics=Physics(step_s=step_s))
            for step_s in (0.0005, 0.00025)
        )
        changed += abs(whole.held.count - half.held.count)
    assert changed <= 2


@pytest.mark.nightly  # half an hour
def test_both_numbers_of_a_hand_over_are_calibrated_on_200_other_plans():
    need("mujoco")
    for name, one in compare(TESTED, 200).items():
        assert one.calibration_error() <= 0.05, name
        assert one.brier_gain()[0] > 0, name


def test_calibration_is_worked_by_hand():
    said = np.repeat([0.2, 0.8], 50)
    right, wrong = Compared(said, said), Compared(said, 1 - said)
    assert (right.calibration_error(), wrong.calibration_error()) == (0.0, pytest.approx(0.6))
    low, high = right.brier_gain()  # 0.25 of the constant 0.5, less 0.16
    assert low == pytest.approx(0.09) == high
    assert wrong.brier_gain()[1] < 0
    assert [count for count, *_ in Compared(np.linspace(0, 1, 25), np.zeros(25)).bins()] == [3] * 5 + [2] * 5
