"""The release gate's check of the arm: the demonstrated pass must be drivable within the joint limits.

With the jaw straight down and the tip in the plane x = 0 the arm's pitch is worked by hand: the wrist is 9.1 mm above
the tip, so |pitch| = atan2(y, -(z + 9.1)), and its limit is 53 degrees.
"""

import io
from dataclasses import replace
from itertools import pairwise
from math import atan2, radians
from types import SimpleNamespace

import numpy as np
import pytest

from skills.demonstration.recording import Joints, Motion, Recording
from skills.errors import BadPlan, Conflict, NotFound
from skills.formats import read_recording, write_mcap
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.kinematics import POINTING_DOWN, inverse, matrix_of, quaternion_of
from skills.learning.certificate import NearLimits, certify, near_starts
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.library.policies import gate, learning, requests
from skills.schemas.people import Consent
from skills.schemas.policies import GateRefusal
from tests.formats.bags import sample_folder
from tests.gridworld.paths import learnt
from tests.library import cases
from tests.library.styles import ask_retraining, styles_of

LIMIT_RAD = radians(53)
STAY = 13  # the action
Z_MM = -112.4  # at the lower edge of the cells whose centres are at -110 mm


def pitch_rad(place_mm: tuple[float, float, float]) -> float:
    _, y, z = place_mm
    return atan2(y, -(z + 9.1))


def reaching(y_mm: float) -> bytes:
    """Record a walk out to y and then down, in the plane x = 0, at 10 mm/s."""
    corners = np.array([[0, 100, Z_MM], [0, y_mm, Z_MM], [0, y_mm, -140]], dtype=float)
    legs = [np.linspace(a, b, round(np.linalg.norm(b - a) / 10 * cases.RATE_HZ)) for a, b in pairwise(corners)]
    return cases.bag(tip=np.concatenate(legs))


def trained(database, data: bytes, **how):
    upload = cases.upload(data, "application/vnd.mcap", **how)
    cases.store(database, upload)
    return cases.train(database)


def test_a_real_bag_whose_samples_are_all_within_the_limits_is_released(database):
    data = (sample_folder() / "rosbag2" / "rosbag2.mcap").read_bytes()
    version = trained(database, data, vouched=True)
    assert version.manifest.grid_certificate.refused_because == ()
    driven = version.manifest.grid_certificate.driven
    assert (driven.path, driven.frame, driven.beyond) == ("fitted", "PSM2_base", 0)
    assert driven.cell_centres_beyond == 1  # reported, because a rollout names them; no arm follows them in a plan
    cases.release(database, version)


def test_a_pass_within_limits_is_accepted_despite_cell_centres_beyond_them(database):
    assert pitch_rad((0, 135, Z_MM)) < LIMIT_RAD < pitch_rad((0, 135, -110))
    version = trained(database, reaching(135))
    certificate = version.manifest.grid_certificate
    assert certificate.refused_because == ()
    assert certificate.driven.cell_centres_beyond > 0
    nearest = certificate.driven.nearest_limit
    assert (nearest.joint, nearest.unit, nearest.limit) == ("pitch", "rad", pytest.approx(-LIMIT_RAD))
    assert nearest.margin == pytest.approx(LIMIT_RAD - pitch_rad(nearest.tip_mm), abs=1e-9)
    assert nearest.margin == pytest.approx(LIMIT_RAD - pitch_rad((0, 135, Z_MM)), abs=radians(0.3))


def test_a_pass_beyond_a_limit_is_refused_with_place_joint_and_amount(database):
    version = trained(database, reaching(138.5))
    certificate = version.manifest.grid_certificate
    nearest = certificate.driven.nearest_limit
    np.testing.assert_allclose(nearest.tip_mm, (0, 138.5, Z_MM), atol=1.0)  # mm
    beyond = pitch_rad(nearest.tip_mm) - LIMIT_RAD
    assert nearest.margin == pytest.approx(-beyond, abs=1e-9)
    assert 0.001 < beyond < 0.006  # by hand: 53.28 degrees at the corner
    (reason,) = texts(certificate.refused_because)
    x, y, z = nearest.tip_mm
    assert f"({x:.1f}, {y:.1f}, {z:.1f}) mm in PSM2_base" in reason
    assert f"pitch -{LIMIT_RAD + beyond:.4f} rad, {beyond:.4f} rad beyond" in reason
    assert "fitted path" in reason
    assert not version.releasable
    with pytest.raises(Conflict, match="pitch"):
        cases.release(database, version)


def test_a_batch_of_stale_styles_takes_what_an_older_gate_refused(database, monkeypatch):
    trained(database, reaching(138.5))
    assert styles_of(database, ask_retraining(database, only_stale=True)) == []
    monkeypatch.setattr(requests, "GATE_VERSION", requests.GATE_VERSION + 1)
    (style,) = styles_of(database, ask_retraining(database, only_stale=True))
    assert style.stale == ["refused by an older gate"]


def test_a_release_refused_by_an_older_gate_is_learnt_again_on_request(database, monkeypatch):
    """A training under today's gate has another job identity, so that the old refusal is not returned for it."""
    monkeypatch.setattr(requests, "GATE_VERSION", requests.GATE_VERSION - 1)
    old = trained(database, reaching(135))
    monkeypatch.undo()
    assert cases.train(database).version == old.version + 1


@pytest.mark.parametrize("instrument", ["400006", "400006-Si"])
def test_poses_in_a_cameras_frame_are_released_if_joints_show_the_base(database, instrument):
    turn = matrix_of([[0.3, -0.2, 0.1, 0.9]])[0]
    tip_mm = cases.points_mm()
    stamps_ns = cases.START_NS + np.arange(len(tip_mm)) * (10**9 // cases.RATE_HZ)
    joints = Joints("PSM2", "/PSM2/measured_js", stamps_ns, inverse(tip_mm, POINTING_DOWN, instrument))
    rotation = quaternion_of(np.broadcast_to(turn @ POINTING_DOWN, (len(tip_mm), 3, 3)))
    seen = Motion("PSM2", "/PSM2/measured_cp", "ECM", stamps_ns, tip_mm @ turn.T + [50.0, 0.0, 120.0], rotation)
    data = write_mcap(Recording("mcap", "full", (seen,), joints=(joints,)))
    version = trained(database, data)
    assert (version.manifest.frame, version.manifest.instrument) == ("PSM2_base", instrument)
    assert version.manifest.grid_certificate.refused_because == ()
    np.testing.assert_allclose(version.manifest.start_mm, (-10.0, 55.0, -135.0), atol=1e-3)
    cases.release(database, version)


def test_an_instrument_without_constants_is_named_and_not_released(database):
    (motion,) = read_recording(io.BytesIO(cases.bag())).motions
    named = Recording("mcap", "full", (motion,), tools=(("PSM2", "MEGA_NEEDLE_DRIVER:400194"),))
    version = trained(database, write_mcap(named))
    assert version.manifest.instrument == "400194"
    (reason,) = texts(version.manifest.grid_certificate.refused_because)
    assert "'400194' is unknown" in reason
    assert not version.releasable


def texts(refusals) -> list[str]:
    return [one.text for one in refusals]


def reasons(policy: Policy) -> list[GateRefusal]:
    """Return the reasons on the grid against a release of a policy."""
    certificate, covered = certify(policy)
    assert covered.share is not None
    return gate.refusals(policy, certificate, near_starts(policy, covered.share, NearLimits(least_share=0.0)))


@pytest.mark.parametrize(
    "learner",
    [PhaseQLearning(), ValueIteration(), pytest.param(ValueIteration(slip=0.3), marks=pytest.mark.nightly)],
    ids=str,
)
def test_values_too_small_to_be_learnt_are_refused_with_a_gamma_that_does(learner):
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (450, 3, 3))
    reward = sparse_reward(GridPath(grid, grid.states_of([[448, 1, 1], [449, 1, 1]])))
    policy = replace(learn_tabular(reward, learner), ties=None)  # the rule among ties would lead the nearest way here
    certificate, _ = certify(policy)
    refusal = reasons(policy)[1]
    reason = refusal.text
    assert reason.startswith(f"{certificate.faint} of them are so far from the path that their values, with gamma 0.1,")
    assert "larger cells" in gate.remedy([refusal])
    better = learn_tabular(reward, replace(learner, gamma=float(reason.rpartition(" gamma of ")[2])))
    assert reasons(better) == []


def test_too_small_values_are_no_reason_if_every_action_is_optimal():
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (450, 3, 3))
    policy = learn_tabular(sparse_reward(GridPath(grid, grid.states_of([[448, 1, 1], [449, 1, 1]]))), PhaseQLearning())
    certificate, _ = certify(policy)
    assert certificate.faint > 0 and certificate.every_action_optimal
    assert reasons(policy) == []


def test_a_rollout_that_is_not_the_demonstration_is_a_reason_of_its_own():
    policy = learnt("an angle")
    q = policy.q.copy()
    q[policy.row(1, policy.path.start), STAY] = 100
    still = replace(policy, q=q)
    assert "the rollout from the demonstrated start is not the demonstration" in texts(reasons(still))
    certificate, covered = certify(policy)
    near = near_starts(policy, covered.share, NearLimits())
    assert gate.refusals(policy, certificate, near) == []
    unlike = replace(certificate, demonstration_reproduced=False)
    assert len(gate.refusals(policy, unlike, near)) == 1
    assert gate.refusals(learnt("an angle", phased=False), unlike, replace(near, share=0.0)) == []


@pytest.mark.parametrize(
    ("value", "margin", "words"),
    [
        (None, None, "no joints put the tip there"),
        (None, -0.1, "no joints put the tip there"),
        (-0.9, None, "no joints put the tip there"),
        (-0.9, -0.1, "the arm needs pitch -0.9000 rad, 0.1000 rad beyond the limit -0.8000"),
    ],
)
@pytest.mark.parametrize(("path", "way"), [("fitted", "the fitted path"), ("centres", "the centres of its cells")])
def test_a_place_beyond_the_limits_is_told_with_its_joint_or_without(value, margin, words, path, way, monkeypatch):
    nearest = SimpleNamespace(tip_mm=(1, 2, 3), joint="pitch", unit="rad", limit=-0.8, value=value, margin=margin)
    driven = SimpleNamespace(beyond=2, samples=9, path=path, nearest_limit=nearest)
    monkeypatch.setattr(gate, "driven_pass", lambda _policy, _demo: driven)
    demo = SimpleNamespace(frame="PSM2_base", instrument="400006")
    found, refused = gate.driven_or_refused(learnt("an angle"), demo)
    (reason,) = texts(refused)
    assert found is driven
    assert f"at (1.0, 2.0, 3.0) mm in PSM2_base {words}" in reason
    assert way in reason and "of 2 of 9 places" in reason


def test_a_pass_that_cannot_be_checked_is_refused(monkeypatch):
    policy, demo = learnt("an angle"), SimpleNamespace(frame="PSM2_base", instrument="400006")
    found, (refused,) = gate.driven_or_refused(policy, SimpleNamespace(frame="ECM"))
    assert found is None and "'ECM' is not the arm's base" in refused.text
    within = SimpleNamespace(beyond=0)
    monkeypatch.setattr(gate, "driven_pass", lambda _policy, _demo: within)
    assert gate.driven_or_refused(policy, demo) == (within, [])

    def refusing(_policy: object, _demo: object) -> None:
        raise BadPlan("It is too short.")

    monkeypatch.setattr(gate, "driven_pass", refusing)
    found, (refused,) = gate.driven_or_refused(policy, demo)
    assert found is None and refused.text.endswith("not checked: It is too short")


@pytest.mark.parametrize(
    ("demo", "others", "why"),
    [
        (None, [], "was erased while"),
        (None, [{}], "was erased while"),
        ({}, [None], "was erased while"),
        ({"withdrawn_at": 1}, [], "was withdrawn while"),
        ({"withdrawn_at": 1}, [{}], "was withdrawn while"),
        ({}, [{}, {"withdrawn_at": 1}], "was withdrawn while"),
        ({"outcome": "failure"}, [{"outcome": "success"}], "was marked failure while"),
        ({}, [{"outcome": "recovery"}], "was marked recovery while"),
        ({"consent": Consent(uses=[])}, [{}], "does not cover training"),
        ({"outcome": "success"}, [{}, {}], None),
    ],
)
@pytest.mark.parametrize("outcomes", ["success", "any"])
def test_what_changed_during_a_training_forbids_storing_it(demo, others, why, outcomes):
    sound = {"withdrawn_at": None, "outcome": None, "slug": "kestrel", "consent": None}
    first, *rest = (None if one is None else SimpleNamespace(**sound | one) for one in (demo, *others))
    session = SimpleNamespace(get=lambda _kind, row: rest[row])
    manifest = SimpleNamespace(outcomes=None if outcomes == "success" else [None])
    finished = SimpleNamespace(lesson=SimpleNamespace(others=range(len(rest))), manifest=manifest)
    refused = learning._refusal(session, finished, first)
    if why is None or ("marked" in why and outcomes == "any"):
        assert refused is None
    else:
        assert why in str(refused)
        assert isinstance(refused, NotFound if "erased" in why else Conflict)


@pytest.mark.nightly  # rarely breaks
def test_where_slips_leave_no_gamma_to_name_the_reason_names_none():
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (450, 3, 3))
    path = GridPath(grid, grid.states_of([[448, 1, 1], [449, 1, 1]]))
    policy = replace(learn_tabular(sparse_reward(path), ValueIteration(slip=0.9)), ties=None)
    reason = reasons(policy)[1]
    assert reason.endswith("too small to be learnt; train with larger cells, or with a gamma nearer to 1")
