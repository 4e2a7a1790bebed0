"""Fixed arithmetic beside numpy's and scipy's own, which round otherwise but mean the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from skills import arithmetic, kinematics, quaternions
from skills.arithmetic import wilson
from skills.quaternions import INVERSE

DRAWN = np.random.default_rng(0)
ANGLES = np.concatenate([DRAWN.uniform(-20, 20, 20_000), np.arange(-8, 9) * (np.pi / 4), [0.0, 1e5, 1e-300]])
EDGES = np.array(np.meshgrid(*[[0.0, -0.0, 1.0, -1.0]] * 2)).reshape(2, 16)
ONE, OTHER = (Rotation.random(500, rng=seed) for seed in (1, 2))
X, Y = ONE.as_quat(), OTHER.as_quat()


def apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max())


def test_sines_and_cosines_are_those_of_numpy_within_rounding():
    assert apart(arithmetic.sin(ANGLES), np.sin(ANGLES)) < 3e-16
    assert apart(arithmetic.cos(ANGLES), np.cos(ANGLES)) < 3e-16
    assert np.isnan(arithmetic.sin(np.array([np.nan, 1.0]))).tolist() == [True, False]


def test_inverse_functions_are_those_of_numpy_within_rounding():
    y, x = DRAWN.normal(size=(2, 20_000)) * 10.0 ** DRAWN.integers(-8, 8, (2, 20_000))
    assert apart(arithmetic.arctan2(y, x), np.arctan2(y, x)) < 1e-15
    part = np.concatenate([DRAWN.uniform(-1, 1, 20_000), [-1.0, 0.0, 1.0]])
    assert apart(arithmetic.arcsin(part), np.arcsin(part)) < 1e-15
    assert apart(arithmetic.arccos(part), np.arccos(part)) < 1e-15


def test_those_of_single_numbers_in_kinematics_have_the_same_bits():
    for plain, ahead, array in ((kinematics._wave, 0, arithmetic.sin), (kinematics._wave, 1, arithmetic.cos)):
        assert np.array([plain(one, ahead) for one in ANGLES.tolist()]).tobytes() == array(ANGLES).tobytes()
    y, x = (np.concatenate([DRAWN.normal(size=5_000), on]) for on in EDGES)
    found = [kinematics._angle(*one) for one in zip(y.tolist(), x.tolist(), strict=True)]
    assert np.array(found).tobytes() == arithmetic.arctan2(y, x).tobytes()


@pytest.mark.parametrize("y", [0.0, -0.0, 1.0, -1.0])
@pytest.mark.parametrize("x", [0.0, -0.0, 1.0, -1.0])
def test_angles_on_the_axes_have_the_sign_of_the_standard(y: float, x: float):
    found, meant = float(arithmetic.arctan2(y, x)), float(np.arctan2(y, x))
    assert np.signbit(found) == np.signbit(meant)
    assert abs(found - meant) < 1e-15


def test_exponentials_do_not_overflow():
    exponents = np.concatenate([DRAWN.uniform(-700, 700, 20_000), [0.0]])
    factor, twos = arithmetic.exp(exponents)
    assert np.abs(np.ldexp(factor, twos) / np.exp(exponents) - 1).max() < 1e-15
    assert ((factor > 0.7) & (factor < 1.5)).all()
    assert arithmetic.exp([5000.0])[1].tolist() == [7213]  # 5000 / ln 2


@pytest.mark.parametrize(
    ("one", "other"),
    [((5, 3, 3), (3, 3)), ((3, 3), (5, 3, 3)), ((5, 3, 3), (3,)), ((3,), (3, 3)), ((7, 3), (3, 3)), ((4,), (4,))],
)
def test_products_are_those_of_matmul(one: tuple[int, ...], other: tuple[int, ...]):
    left, right = DRAWN.normal(size=one), DRAWN.normal(size=other)
    found = arithmetic.product(left, right)
    assert found.shape == (left @ right).shape
    assert apart(found, left @ right) < 1e-14


def test_quaternions_turn_as_those_of_scipy():
    points = DRAWN.normal(size=(500, 3))
    assert apart(quaternions.multiplied(X, Y), (ONE * OTHER).as_quat(canonical=False)) < 1e-15
    assert apart(quaternions.turned(X, points), ONE.apply(points)) < 1e-14
    assert apart(quaternions.angle_of(X), ONE.magnitude()) < 1e-14
    assert apart(quaternions.vector_of(X), ONE.as_rotvec()) < 1e-14
    assert apart(quaternions.vector_of(-X), ONE.as_rotvec()) < 1e-14
    assert apart(quaternions.of_vector(ONE.as_rotvec()), ONE.as_quat(canonical=True)) < 1e-14
    assert quaternions.of_vector(np.zeros((1, 3))).tolist() == [[0.0, 0.0, 0.0, 1.0]]
    assert quaternions.vector_of(np.array([[0.0, 0.0, 0.0, 1.0]])).tolist() == [[0.0, 0.0, 0.0]]


def test_orientations_between_two_are_those_of_scipy():
    shares = DRAWN.uniform(0, 1, 500)
    for number in range(0, 500, 50):
        meant = Slerp([0.0, 1.0], Rotation.from_quat([X[number], Y[number]]))(shares[number])
        found = Rotation.from_quat(quaternions.between(X[number], Y[number], shares[number]))
        assert (found.inv() * meant).magnitude() < 1e-14


def test_the_dominant_eigenvector_is_that_of_lapack():
    matrices = np.einsum("kpi,kpj->pij", np.stack([X, Y]), np.stack([X, Y])) + 0.3 * np.eye(4)
    meant = np.linalg.eigh(matrices)[1][..., -1]
    assert np.abs(np.abs((quaternions.dominant(matrices) * meant).sum(axis=1)) - 1).max() < 1e-12


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_best_turn_is_that_of_scipy(noise: float):
    points = DRAWN.normal(size=(40, 3))
    for turn in ONE[:20]:
        others = turn.apply(points) + noise * DRAWN.normal(size=points.shape)
        found = quaternions.best_turn(np.einsum("ni,nj->ij", others, points))
        meant = Rotation.align_vectors(others, points)[0].as_quat()
        assert quaternions.angle_of(quaternions.multiplied(meant * INVERSE, found)) < 1e-7


def test_points_in_one_place_turn_by_nothing():
    assert quaternions.best_turn(np.zeros((3, 3))).tolist() == [0.0, 0.0, 0.0, 1.0]


def test_flat_points_have_a_turn_and_no_reflection():
    flat = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-1.0, -1.0, 0.0]])
    found = quaternions.best_turn(np.einsum("ni,nj->ij", flat * [1.0, -1.0, 1.0], flat))
    assert found.tolist() == pytest.approx([1.0, 0.0, 0.0, 0.0])  # half a turn about x


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 0.2775), (5, 0.2366, 0.7634), (8, 0.4902, 0.9433), (10, 0.7225, 1.0)]
)
def test_the_wilson_interval_is_the_one_in_tables(count, low, high):
    assert wilson(count, 10) == pytest.approx((low, high), abs=5e-5)
