"""The still picture of a plan: the simulator's photograph with the passes drawn into it. Metres; no simulator here.

What lies behind a surface of the photograph is drawn pale. Everything is done at twice the size and then halved, which
smooths the edges that the simulator's renderer leaves.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians, tan

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from skills.style._arrays import Floats

WIDTH, HEIGHT = 640, 480
_SCALE = 2
_DOT_EVERY_M = 0.005  # the paper's cell
# Told apart by the colour-blind too (Okabe and Ito).
PASS_COLOURS = ((213, 94, 0), (0, 114, 178), (204, 121, 167), (230, 159, 0), (86, 180, 233), (0, 0, 0))
GOAL_COLOUR = (0, 158, 115)


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from: around and above a target, z up."""

    target_m: tuple[float, float, float]
    distance_m: float
    yaw_deg: float = 40.0
    pitch_deg: float = -20.0
    field_deg: float = 45.0
    near_m: float = 0.01
    far_m: float = 2.0
    width: int = WIDTH * _SCALE
    height: int = HEIGHT * _SCALE


@dataclass(frozen=True, eq=False)
class Photograph:
    """What the camera saw: colours (H, W, 3), depth buffer (H, W) of 0 to 1, and the two matrices (4, 4)."""

    rgb: NDArray[np.uint8]
    depth: Floats
    view: Floats
    projection: Floats


def draw(photograph: Callable[[Camera], Photograph], paths: Sequence[Floats]) -> bytes:
    """Take a photograph that shows all passes and draw them into it; a PNG of 640 x 480.

    Args:
        photograph: Takes it.
        paths: The tip's way in each pass, metres in the camera's world, each of shape (K, 3).
    """
    camera = _facing(np.concatenate(paths))
    taken = photograph(camera)
    image = Image.fromarray(taken.rgb)
    pen = ImageDraw.Draw(image, "RGBA")
    for number, path in enumerate(paths):
        _draw_path(pen, taken, camera, path, PASS_COLOURS[number % len(PASS_COLOURS)])
    for number, path in enumerate(paths):
        _draw_goal(pen, taken, camera, path[-1], str(number + 1))
    out = io.BytesIO()
    image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS).save(out, "PNG", optimize=True)
    return out.getvalue()


def _facing(points: Floats) -> Camera:
    """Stand so far away that all points are in the middle two thirds of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.015)
    distance = radius / tan(radians(45.0) / 2) * 1.35
    return Camera(target_m=(x, y, z), distance_m=distance)


def _project(points: Floats, taken: Photograph, camera: Camera) -> tuple[Floats, Floats]:
    """Find the pixels of points, shape (K, 2), and their distance behind the seen surface in metres, shape (K,)."""
    ahead = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ taken.view.T
    clip = ahead @ taken.projection.T
    ndc = clip[:, :3] / clip[:, 3:]
    height, width = taken.depth.shape
    pixels = np.stack([(ndc[:, 0] + 1) / 2 * width, (1 - ndc[:, 1]) / 2 * height], axis=1)
    column = np.clip(pixels[:, 0].astype(int), 0, width - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, height - 1)
    near, far = camera.near_m, camera.far_m
    surface = far * near / (far - (far - near) * taken.depth[row, column])
    return pixels, -ahead[:, 2] - surface


def _draw_path(
    pen: ImageDraw.ImageDraw, taken: Photograph, camera: Camera, path: Floats, colour: tuple[int, int, int]
) -> None:
    """Draw a line along the path and a dot every 5 mm, pale where something is in front."""
    pixels, behind = _project(path, taken, camera)
    step = max(1, len(path) // 400)
    for k in range(0, len(path) - step, step):
        seen = behind[k] < 0.001
        line = [tuple(pixels[k]), tuple(pixels[k + step])]
        pen.line(line, fill=(*colour, 230 if seen else 70), width=3)
    walked = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    for k in np.unique(np.searchsorted(walked, np.arange(0.0, walked[-1] + 1e-9, _DOT_EVERY_M))):
        _dot(pen, pixels[min(k, len(path) - 1)], 2.6, (*colour, 255 if behind[min(k, len(path) - 1)] < 0.001 else 90))


def _draw_goal(pen: ImageDraw.ImageDraw, taken: Photograph, camera: Camera, goal: Floats, label: str) -> None:
    """Mark where the needle is handed over, with the number of the pass."""
    pixels, _ = _project(goal[None], taken, camera)
    _dot(pen, pixels[0], 8.0, (255, 255, 255, 255))
    _dot(pen, pixels[0], 7.0, (*GOAL_COLOUR, 255))
    font = ImageFont.load_default(size=10 * _SCALE)
    pen.text((float(pixels[0, 0]), float(pixels[0, 1])), label, fill=(255, 255, 255, 255), font=font, anchor="mm")


def _dot(pen: ImageDraw.ImageDraw, centre: Floats, radius: float, fill: tuple[int, int, int, int]) -> None:
    x, y, r = float(centre[0]), float(centre[1]), radius * _SCALE
    pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)
