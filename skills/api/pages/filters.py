"""Filters of the templates: numbers, times and states as text, and the thumbnail of a style."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from math import degrees
from typing import Any

from skills.arrays import Floats
from skills.db.models import Surgeon, SutureType
from skills.db.service_tables import Job
from skills.fields import percent
from skills.library.operation.styles import StyleState
from skills.library.plans.headline import describe_error
from skills.schemas.people import SurgeonIn, SutureTypeIn
from skills.schemas.playbacks import PlaybackIn
from skills.schemas.training import RetrainingIn, TrainingIn
from skills.schemas.tries import TryIn

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
    """Return a number with its unit, rounded, and without a fraction if that is 0."""
    if value is None:
        return MISSING
    text = f"{value:z,.{digits}f}" if isinstance(value, float) else f"{value:,}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return f"{text} {unit}".strip()


def triple(values: Sequence[float] | None, unit: str = "mm", digits: int = 2) -> str:
    """Return the coordinates x, y and z with their unit."""
    if values is None:
        return MISSING
    return ", ".join(f"{value:z.{digits}f}" for value in values) + f" {unit}"


def moment(value: datetime | str | None) -> str:
    """Return a time in UTC, to the second."""
    if value is None:
        return MISSING
    seen = datetime.fromisoformat(value) if isinstance(value, str) else value
    return seen.replace(tzinfo=seen.tzinfo or UTC).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def short(digest: str) -> str:
    """Return the first 12 characters of a digest, enough to distinguish it from the others on a page."""
    return digest[:12]


def size(count: int) -> str:
    """Return a number of bytes with a unit."""
    for unit, scale in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if count >= scale:
            return f"{count / scale:.1f} {unit}"
    return f"{count} bytes"


def share(value: float | None, digits: int = 1) -> str:
    """Return a fraction as percent."""
    return MISSING if value is None else f"{percent(value, digits)} %"


def outline(style: StyleState) -> dict[str, object] | None:
    """Return the drawing of a style as a thumbnail: its path in the box of its grid, in a square of 100 by 100 units.

    The view is orthographic, from above one corner. None if there is nothing to draw.
    """
    if style.shown is None:
        return None
    nx, ny, nz = style.shown.grid_shape
    seen, box = _box(nx, ny, nz)
    path = [seen(at // (ny * nz), at // nz % ny, at % nz) for at in style.shown.waypoints]
    return {**box, "path": _line(path), "start": path[0], "goal": path[-1]}


Seen = tuple[float, float]  # a point in the square


@lru_cache(maxsize=1000)
def _box(nx: int, ny: int, nz: int) -> tuple[Callable[[int, int, int], Seen], dict[str, str]]:
    """Return where a cell of a grid of this shape is seen, and the lines of the grid's box; many styles share them."""
    x, y, z = ends = nx - 1, ny - 1, nz - 1
    across = [(0.94, -0.34, 0.0), (0.14, 0.40, 0.91)]  # screen axes: turned by 20 degrees, seen from 25 degrees above
    low = [sum(min(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    high = [sum(max(0, part * end) for part, end in zip(axis, ends, strict=True)) for axis in across]
    scale = 92 / max(high[0] - low[0], high[1] - low[1], 1)
    (ux, uy, uz), (vx, vy, vz) = across
    middle_u, middle_v = ((below + above) / 2 for below, above in zip(low, high, strict=True))

    def seen(i: int, j: int, k: int) -> Seen:
        u, v = ux * i + uy * j + uz * k, vx * i + vy * j + vz * k
        return round(50 + scale * (u - middle_u), 1), round(50 - scale * (v - middle_v), 1)

    lines = {
        "floor": [(0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0), (0, 0, 0)],
        "back": [(0, y, 0), (0, y, z), (x, y, z), (x, 0, z), (x, 0, 0)],
        "spine": [(x, y, 0), (x, y, z)],
    }
    return seen, {name: _line([seen(*cell) for cell in cells]) for name, cells in lines.items()}


def _line(points: Sequence[Seen]) -> str:
    return " ".join(f"{u},{v}" for u, v in points)


def px(value: float) -> str:
    """Return a length in a drawing, rounded to 0.01."""
    return f"{round(value, 2):g}"


def points(way: Floats) -> str:
    """Return the points of a polyline, shape (T, 2)."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in way.tolist())


def as_request(row: Surgeon | SutureType) -> dict[str, object]:
    """Return the fields of the request that would make a row as it is, as JSON, and its slug."""
    model = SurgeonIn if isinstance(row, Surgeon) else SutureTypeIn
    return {"slug": row.slug, **model.model_validate(row, from_attributes=True).model_dump(mode="json")}


AGAIN: Any = {"training": TrainingIn, "retraining": RetrainingIn, "playback": PlaybackIn, "try": TryIn}


def again(job: Job) -> tuple[str, dict[str, object]] | None:
    """Return the call that requests a job again, and its body; None for an export, whose filters are not stored."""
    if job.kind == "pictures":
        return f"POST /playbacks/{job.request['playback']}/pictures", {}
    if job.kind not in AGAIN:
        return None
    scene = job.request.get("surroundings", {})
    stored = {**job.request, "scene": scene.get("scene"), "scene_costs": scene.get("costs")}
    # What the request left open: the learners of a batch's styles, the errors of the arms.
    left_open = "learner" if "joins" in stored else "errors" if stored.get("stated_by") == "installation" else ""
    named = [name for name in AGAIN[job.kind].model_fields if name != left_open and stored.get(name) is not None]
    return f"POST /{'tries' if job.kind == 'try' else f'{job.kind}s'}", {name: stored[name] for name in named}


FILTERS = {
    "again": again,
    "as_request": as_request,
    "px": px,
    "points": points,
    "number": number,
    "triple": triple,
    "moment": moment,
    "short": short,
    "size": size,
    "share": share,
    "degrees": degrees,
    "outline": outline,
    "state_mark": STATE_MARKS.__getitem__,
    "describe_error": describe_error,
    "state_words": STATE_WORDS.__getitem__,
    "job_mark": JOB_MARKS.__getitem__,
}
