"""Matrix products, sines, cosines, their inverses, exponentials and intervals, with the same bits on every processor.

IEEE 754 fixes the result of +, -, *, / and square roots, and so of everything that is made of them in a fixed order.
It does not fix those of numpy's and the C library's other functions, nor the order in which BLAS adds: these choose by
the processor. What is digested and computed again, on another machine too, is made with the functions of this module;
`docs/decisions.md` lists it. They are as accurate as the others, within 1e-15 of the exact value.

Sines and cosines are Taylor series after the quarter turns are taken away, as by Cody and Waite (Software Manual for
the Elementary Functions, 1980); so are exponentials, with powers of two. The arc tangent is one of the quarter of the
angle: tan(a / 2) = t / (1 + sqrt(1 + t^2)) with t = tan(a).
"""

from collections.abc import Sequence
from math import factorial, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.arrays import Floats

# A quarter turn as a sum; the first two have few bits, so that their product with a million turns is exact.
QUARTER = (float.fromhex("0x1.921fb544p+0"), float.fromhex("0x1.0b4611a6p-34"), float.fromhex("0x1.3198a2e037073p-69"))
SINE = tuple((-1) ** k / factorial(2 * k + 1) for k in range(9))  # of an eighth of a turn the next term is below 1e-19
COSINE = tuple((-1) ** k / factorial(2 * k) for k in range(9))
ARC = tuple((-1) ** k / (2 * k + 1) for k in range(12))
_LOG_2 = (float.fromhex("0x1.62e42feep-1"), float.fromhex("0x1.a39ef35793c76p-33"))  # a sum: the first has few bits
_EXPONENTIAL = [1 / factorial(k) for k in range(14)]
NORMAL_95 = 1.959964  # 95 % of a normal distribution lie within so many standard deviations of its mean


def product(one: Floats, other: Floats) -> Floats:
    """Return the matrix product of two arrays, `one @ other`, added up in the order of their common axis.

    Args:
        one: Shape (..., N, K), or (K,) for a row.
        other: Shape (..., K, M), or (K,) for a column.

    Returns:
        Shape (..., N, M), without the axis of a row or a column.
    """
    left = one if one.ndim > 1 else one[None]
    right = other if other.ndim > 1 else other[:, None]
    total = np.asarray(sum(left[..., :, k, None] * right[..., None, k, :] for k in range(right.shape[-2])))
    total = total if one.ndim > 1 else total[..., 0, :]
    return total if other.ndim > 1 else total[..., 0]


def sin(angles_rad: ArrayLike) -> Floats:
    """Return the sines of angles of less than a million turns, of the same shape."""
    return _wave(angles_rad, 0)


def cos(angles_rad: ArrayLike) -> Floats:
    """Return the cosines of angles of less than a million turns, of the same shape."""
    return _wave(angles_rad, 1)


def _wave(angles_rad: ArrayLike, ahead: int) -> Floats:
    """Return the sines of angles that are some quarter turns ahead of the given ones."""
    angles = np.asarray(angles_rad, np.float64)
    turns = np.rint(angles * (2 / pi))
    rest = angles - turns * QUARTER[0] - turns * QUARTER[1] - turns * QUARTER[2]
    square, quarter = rest * rest, turns + ahead
    quarter = quarter - 4 * np.floor(quarter / 4)  # as floats, because NaN stays NaN
    upright = (quarter == 1) | (quarter == 3)
    value = np.where(upright, _series(COSINE, square), rest * _series(SINE, square))
    return np.asarray(np.where(quarter >= 2, -value, value))


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """Return the angles of points in a plane from the axis of x, -pi to pi, of the shape of `y` and `x`."""
    y, x = np.asarray(y, np.float64), np.asarray(x, np.float64)
    high, wide = np.abs(y), np.abs(x)
    longer = np.maximum(high, wide)
    tangent = np.minimum(high, wide) / np.where(longer == 0, 1.0, longer)
    for _ in range(2):
        tangent = tangent / (1 + np.sqrt(1 + tangent * tangent))
    angle = 4 * tangent * _series(ARC, tangent * tangent)
    angle = np.where(high > wide, pi / 2 - angle, angle)
    return np.asarray(np.copysign(np.where(np.signbit(x), pi - angle, angle), y))


def arcsin(sines: ArrayLike) -> Floats:
    """Return the angles, -pi / 2 to pi / 2, of sines, of the same shape."""
    sines = np.asarray(sines, np.float64)
    return arctan2(sines, np.sqrt((1 - sines) * (1 + sines)))


def arccos(cosines: ArrayLike) -> Floats:
    """Return the angles, 0 to pi, of cosines, of the same shape."""
    cosines = np.asarray(cosines, np.float64)
    return arctan2(np.sqrt((1 - cosines) * (1 + cosines)), cosines)


def exp(exponents: ArrayLike) -> tuple[Floats, NDArray[np.int32]]:
    """Return e to the power of numbers as factors, 0.7 to 1.5, and powers of two, which do not overflow."""
    exponents = np.asarray(exponents, np.float64)
    twos = np.rint(exponents * (1 / _LOG_2[0]))
    return _series(_EXPONENTIAL, exponents - twos * _LOG_2[0] - twos * _LOG_2[1]), twos.astype(np.int32)


def _series(coefficients: Sequence[float], x: Floats) -> Floats:
    """Return the value of a power series whose first coefficient is that of 1 (Horner)."""
    total = np.full_like(x, coefficients[-1])
    for one in coefficients[-2::-1]:
        total *= x
        total += one
    return total


def wilson(count: float, of: float) -> tuple[float, float]:
    """Return the score interval of a share at 95 % (Wilson, "Probable inference", JASA 1927).

    Args:
        count: Number of successes; no whole number, where trials count as fewer independent ones.
        of: Number of trials, at least 1.

    Returns:
        The lower and the upper bound, within 0 to 1.
    """
    share, z2 = count / of, NORMAL_95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = NORMAL_95 * sqrt(share * (1 - share) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    return max(0.0, middle - half), min(1.0, middle + half)
