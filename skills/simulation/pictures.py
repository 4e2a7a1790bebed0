"""The still image of a playback: the simulator's image with the passes drawn into it, in metres.

No simulator is used here. Parts behind a surface of the image are drawn pale. Everything is drawn at a larger scale and
then shrunk, which smooths the edges of the simulator's renderer. `skills.simulation.film` draws its frames with the
same `Sheet`.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import radians, tan

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from skills.arrays import Flags, Floats

WIDTH, HEIGHT = 640, 480
_SCALE = 2.0
_DOT_EVERY_M = 0.005  # the paper's cell
_BEHIND_M = 0.001
# Distinguishable for the colour-blind too (Okabe and Ito).
Colour = tuple[int, int, int]
PASS_COLOURS: tuple[Colour, ...] = (
    (213, 94, 0),
    (0, 114, 178),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
    (0, 0, 0),
)
GOAL_COLOUR: Colour = (0, 158, 115)
WHITE: Colour = (255, 255, 255)


@dataclass(frozen=True)
class Camera:
    """A camera around and above a target, z up; its image is `scale` times as large as the finished picture."""

    target_m: tuple[float, float, float]
    distance_m: float
    yaw_deg: float = 40.0
    pitch_deg: float = -20.0
    field_deg: float = 45.0
    near_m: float = 0.01
    far_m: float = 2.0
    width: int = int(WIDTH * _SCALE)
    height: int = int(HEIGHT * _SCALE)
    scale: float = _SCALE


@dataclass(frozen=True, eq=False)
class Photograph:
    """The camera's image: colours (H, W, 3), depth buffer (H, W) of 0 to 1, and the two matrices (4, 4)."""

    rgb: NDArray[np.uint8]
    depth: Floats
    view: Floats
    projection: Floats


class Sheet:
    """An image to draw into. Positions are metres in the camera's world, sizes pixels of the finished picture."""

    def __init__(self, taken: Photograph, camera: Camera) -> None:
        self._taken = taken
        self._camera = camera
        self._image = Image.fromarray(taken.rgb)
        self._pen = ImageDraw.Draw(self._image, "RGBA")

    def line(self, path: Floats, colour: Colour, width: float = 1.5, strength: float = 0.9) -> None:
        """Draw a line along a path, shape (K, 3), pale behind surfaces."""
        pixels, hidden = self._project(path)
        where = [tuple(pixel) for pixel in pixels.tolist()]
        for begin, end in _runs(hidden[:-1]):
            alpha = strength * (0.3 if hidden[begin] else 1.0)
            fill = (*colour, round(255 * alpha))
            self._pen.line(where[begin : end + 1], fill=fill, width=round(width * self._camera.scale), joint="curve")

    def dots(self, places: Floats, colour: Colour, radius: float = 2.6, strength: float = 1.0) -> None:
        """Draw dots, pale behind surfaces."""
        pixels, hidden = self._project(places)
        for pixel, pale in zip(pixels, hidden.tolist(), strict=True):
            self._dot(pixel, radius, (*colour, round(255 * strength * (0.35 if pale else 1.0))))

    def label(self, place: Floats, colour: Colour, text: str, size: float = 10.0) -> None:
        """Draw a short text on a disc with a white rim, in front of everything."""
        pixels, _ = self._project(place[None])
        self._dot(pixels[0], size * 0.8, (*WHITE, 255))
        self._dot(pixels[0], size * 0.7, (*colour, 255))
        font = ImageFont.load_default(size=size * self._camera.scale)
        self._pen.text(tuple(pixels[0].tolist()), text, fill=(*WHITE, 255), font=font, anchor="mm")

    def finished(self) -> Image.Image:
        """Return the drawing, shrunk to the size of the finished picture."""
        size = round(self._camera.width / self._camera.scale), round(self._camera.height / self._camera.scale)
        return self._image.resize(size, Image.Resampling.LANCZOS)

    def _dot(self, centre: Floats, radius: float, fill: tuple[int, int, int, int]) -> None:
        x, y, r = float(centre[0]), float(centre[1]), radius * self._camera.scale
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)

    def _project(self, points: Floats) -> tuple[Floats, Flags]:
        """Return the pixels of points, shape (K, 2), and whether they are behind the visible surface, shape (K,)."""
        taken, camera = self._taken, self._camera
        ahead = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ taken.view.T
        clip = ahead @ taken.projection.T
        ndc = clip[:, :3] / clip[:, 3:]
        height, width = taken.depth.shape
        pixels = np.stack([(ndc[:, 0] + 1) / 2 * width, (1 - ndc[:, 1]) / 2 * height], axis=1)
        column = np.clip(pixels[:, 0].astype(int), 0, width - 1)
        row = np.clip(pixels[:, 1].astype(int), 0, height - 1)
        near, far = camera.near_m, camera.far_m
        surface = far * near / (far - (far - near) * taken.depth[row, column])
        return pixels, -ahead[:, 2] - surface >= _BEHIND_M


def draw(photograph: Callable[[Camera], Photograph], paths: Sequence[Floats]) -> bytes:
    """Return a PNG of 640 x 480 that shows all passes, numbered from 0.

    Args:
        photograph: Callback that returns the image of a camera.
        paths: The tip's path in each pass, metres in the camera's world, each of shape (K, 3).
    """
    camera = facing(np.concatenate(paths))
    sheet = Sheet(photograph(camera), camera)
    for number, path in enumerate(paths):
        colour = colour_of(number)
        sheet.line(thinned(path), colour)
        sheet.dots(stepping_stones(path), colour)
    for number, path in enumerate(paths):
        sheet.label(path[-1], GOAL_COLOUR, str(number))
    out = io.BytesIO()
    sheet.finished().save(out, "PNG", optimize=True)
    return out.getvalue()


def facing(points: Floats) -> Camera:
    """Return a camera so far away that all points are in the middle two thirds of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.015)
    distance = radius / tan(radians(45.0) / 2) * 1.35
    return Camera(target_m=(x, y, z), distance_m=distance)


def colour_of(number: int) -> Colour:
    """Return the colour of a pass."""
    return PASS_COLOURS[number % len(PASS_COLOURS)]


def thinned(path: Floats, most: int = 400) -> Floats:
    """Return at most so many points of a path, its ends among them."""
    kept = np.unique(np.linspace(0, len(path) - 1, min(len(path), most)).round().astype(int))
    return np.asarray(path[kept])


def stepping_stones(path: Floats) -> Floats:
    """Return a point of a path every 5 mm of its length."""
    walked = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.searchsorted(walked, np.arange(0.0, walked[-1] + 1e-9, _DOT_EVERY_M))
    return np.asarray(path[np.unique(np.minimum(at, len(path) - 1))])


def _runs(marks: Flags) -> list[tuple[int, int]]:
    """Split marks into runs of equal ones, as (begin, end)."""
    cuts = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), len(marks)]
    return [(begin, end) for begin, end in pairwise(cuts) if end > begin]
