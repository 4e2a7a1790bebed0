"""How smooth a movement is, from the spectrum of its speed: the spectral arc length.

    SPARC = - integral from 0 to w_c of sqrt( (1 / w_c)^2 + (dV/dw)^2 ) dw,   V(w) = |FFT(v)| / |FFT(v)(0)|

after Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet, "On the analysis of movement smoothness", Journal of
NeuroEngineering and Rehabilitation 12:112 (2015); the code is ours, the three parameters are theirs. A movement that
starts and stops has more ripples in its spectrum, so a longer arc and a lower value. One minimum-jerk stroke has -1.41.
It has no unit and depends neither on how far nor on how fast the hand went, nor, other than jerk, much on noise.
"""

import numpy as np
from numpy.typing import ArrayLike

CUT_OFF_HZ = 10.0  # the highest frequency that is looked at
LEAST_AMPLITUDE = 0.05  # w_c is where the spectrum last has this much of its value at rest
PADDING = 4  # the profile is lengthened with zeros to 2^4 times its length, so that the arc is drawn finely


def spectral_arc_length(speed: ArrayLike, step_s: float) -> float | None:
    """Measure how smooth a speed profile is: below 0, the nearer to 0 the smoother.

    Args:
        speed: The speed at even times, in any unit, shape (N,).
        step_s: The time between two of them.

    Returns:
        The spectral arc length; None where nothing moved or the profile is too short to have a spectrum.
    """
    profile = np.asarray(speed, float)
    if len(profile) < 2 or not step_s > 0 or not profile.sum() > 0:
        return None
    padded = 2 ** (int(np.ceil(np.log2(len(profile)))) + PADDING)
    amplitude = np.abs(np.fft.rfft(profile, padded))
    hertz = np.fft.rfftfreq(padded, step_s)
    seen = hertz <= CUT_OFF_HZ
    shape, hertz = amplitude[seen] / amplitude[0], hertz[seen]
    last = int(np.flatnonzero(shape >= LEAST_AMPLITUDE)[-1])
    if last == 0:
        return None
    along = np.diff(hertz[: last + 1]) / hertz[last]
    return float(-np.hypot(along, np.diff(shape[: last + 1])).sum())
