"""What the numbers of a recording must be: finite, in order of time, of the size of an arm.

What fails is refused with the topic and the time; nothing is repaired.
"""

import numpy as np

from skills.errors import BackwardStamps, NotAQuaternion, NotFinite, NotMetres
from skills.style._arrays import Floats, Ints

COORDINATE_LIMIT_MM = 1000.0  # ours: a PSM reaches 0.3 m; ten times that is millimetres taken for metres
QUATERNION_TOLERANCE = 1e-3  # ours: three printed decimals pass, an unnormalised quaternion does not


def check_tips(topic: str, stamps_ns: Ints, tip_mm: Floats) -> None:
    """Refuse positions that cannot be an arm's tip.

    Args:
        topic: Named in the refusal.
        stamps_ns: Shape (T,), to name the time.
        tip_mm: Shape (T, 3).

    Raises:
        NotFinite: NaN or infinity.
        NotMetres: A coordinate beyond 1 m.
    """
    check_finite(topic, stamps_ns, tip_mm)
    if tip_mm.size and not max(tip_mm.max(), -tip_mm.min()) <= COORDINATE_LIMIT_MM:
        first = int(np.argmax((np.abs(tip_mm) > COORDINATE_LIMIT_MM).any(axis=1)))
        metres = float(np.abs(tip_mm[first]).max() / 1000.0)
        raise NotMetres(
            f"{topic}: a coordinate of {metres:g} m {_at(stamps_ns, first)}; a PSM's tip stays within 1 m. "
            "Give the positions in metres (or, in a table, name the columns x_mm, y_mm, z_mm).",
            topic=topic,
            sample=first,
            metres=metres,
        )


def check_rotations(topic: str, stamps_ns: Ints, rotation_xyzw: Floats) -> None:
    """Refuse quaternions, shape (T, 4), that are not finite or whose length is not one."""
    check_finite(topic, stamps_ns, rotation_xyzw)
    length = np.sqrt(np.einsum("ij,ij->i", rotation_xyzw, rotation_xyzw))
    off = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    if off.any():
        first = int(np.argmax(off))
        raise NotAQuaternion(
            f"{topic}: the quaternion {_at(stamps_ns, first)} has length {length[first]:g}; "
            "give unit quaternions x, y, z, w, or leave the orientation out.",
            topic=topic,
            sample=first,
            length=float(length[first]),
        )


def check_finite(topic: str, stamps_ns: Ints, values: Floats) -> None:
    """Refuse NaN and infinity in numbers of shape (T,) or (T, K)."""
    finite = np.isfinite(values)
    if not finite.all():
        first = int(np.argmin(finite.reshape(len(values), -1).all(axis=1)))
        raise NotFinite(
            f"{topic}: NaN or infinity {_at(stamps_ns, first)}; cut the recording before it or record again.",
            topic=topic,
            sample=first,
        )


def check_forwards(topic: str, stamps_ns: Ints) -> None:
    """Refuse a time that runs backwards, shape (T,)."""
    back = stamps_ns[1:] < stamps_ns[:-1]
    if back.any():
        first = int(np.argmax(back)) + 1
        step_s = float(stamps_ns[first - 1] - stamps_ns[first]) / 1e9
        raise BackwardStamps(
            f"{topic}: time runs backwards by {step_s:g} s {_at(stamps_ns, first - 1)} (sample {first}); "
            "the recorder's clock was set or two recordings were joined. Give each part on its own.",
            topic=topic,
            sample=first,
            step_s=step_s,
        )


def _at(stamps_ns: Ints, index: int) -> str:
    return f"at {(int(stamps_ns[index]) - int(stamps_ns[0])) / 1e9:.3f} s"
