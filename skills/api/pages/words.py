"""Numbers, moments and digests as a page writes them: with their units, and rounded to what a person can use."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from skills.library.overview import Style

MISSING = "–"
STATE_MARKS = {"released": "●", "trained": "◐", "stored": "○", "empty": "·"}
JOB_MARKS = {"queued": "○", "running": "◐", "succeeded": "●", "failed": "✕", "cancelled": "–", "done": "●"}
STATE_WORDS = {
    "released": "served to clients",
    "trained": "learnt, not released",
    "stored": "demonstrated, not learnt",
    "empty": "nothing yet",
}


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """Write a number with its unit, rounded, without a fraction where it has none."""
    if value is None:
        return MISSING
    text = f"{value:,.{digits}f}" if isinstance(value, float) else f"{value:,}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return f"{text} {unit}".strip()


def triple(values: Sequence[float] | None, unit: str = "mm", digits: int = 2) -> str:
    """Write the numbers of x, y and z."""
    if values is None:
        return MISSING
    return ", ".join(f"{value:.{digits}f}" for value in values) + f" {unit}"


def moment(value: datetime | str | None) -> str:
    """Write a moment to the second."""
    if value is None:
        return MISSING
    seen = datetime.fromisoformat(value) if isinstance(value, str) else value
    return seen.replace(tzinfo=seen.tzinfo or UTC).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def short(digest: str) -> str:
    """Write the beginning of a digest: enough to tell it from the others of a page."""
    return digest[:12]


def size(count: int) -> str:
    """Write a number of bytes."""
    for unit, scale in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count >= scale:
            return f"{count / scale:.1f} {unit}"
    return f"{count} bytes"


def share(value: float | None, digits: int = 1) -> str:
    """Write a part as percent; what is not quite all is never rounded to all."""
    if value is None:
        return MISSING
    text = f"{100 * value:.{digits}f}"
    if value < 1 and float(text) >= 100:
        return f"> {100 - 10**-digits:.{digits}f} %"
    return f"{text} %"


def outline(style: Style) -> dict[str, Any] | None:
    """Draw a style small: its path in its grid's box, seen from above one corner, in a square of 100 by 100."""
    if style.shown is None:
        return None
    grid = style.shown["grid"]
    _, ny, nz = grid["shape"]
    cells = [(at // (ny * nz), at // nz % ny, at % nz) for at in style.shown["waypoints"]]
    ends = [n - 1 for n in grid["shape"]]
    across = [(0.94, -0.34, 0.0), (0.14, 0.40, 0.91)]  # turned by 20 degrees and seen from 25 degrees above
    low = [sum(min(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    high = [sum(max(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    scale = 92 / max(high[0] - low[0], high[1] - low[1], 1)

    def seen(*cell: int) -> tuple[float, float]:
        u, v = (sum(part * at for part, at in zip(axis, cell, strict=True)) for axis in across)
        return round(50 + scale * (u - (low[0] + high[0]) / 2), 1), round(50 - scale * (v - (low[1] + high[1]) / 2), 1)

    def line(points: Sequence[tuple[int, int, int]]) -> str:
        return " ".join(f"{u},{v}" for u, v in (seen(*point) for point in points))

    x, y, z = ends
    return {
        "floor": line([(0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0), (0, 0, 0)]),
        "back": line([(0, y, 0), (0, y, z), (x, y, z), (x, 0, z), (x, 0, 0)]),
        "spine": line([(x, y, 0), (x, y, z)]),
        "path": line(cells),
        "start": seen(*cells[0]),
        "goal": seen(*cells[-1]),
    }


FILTERS = {
    "number": number,
    "triple": triple,
    "moment": moment,
    "short": short,
    "size": size,
    "share": share,
    "outline": outline,
    "state_mark": STATE_MARKS.__getitem__,
    "state_words": STATE_WORDS.__getitem__,
    "job_mark": JOB_MARKS.__getitem__,
}
