"""Films of a plan: its complete trajectory in the simulator's scene, as MP4 (H.264) and as GIF.

Each frame is an image of both arms, the pad and the needle, with the path of the tip: strong where it has passed, pale
where it is still to come. Everything is done in a separate process (`film`). The encoder is a program (ffmpeg) that
this process starts under the same limits: single-threaded and configured to leave out its name and the date, so that
the same trajectory gives the same bytes if the versions are the same.

The needle's pose comes from `skills.verification.clearance`. Passes count from 0, as in reports; M1 and M2 between them
are done by hand and not shown.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from skills import packing
from skills.arrays import Ints
from skills.errors import BadInput
from skills.kinematics import JAW_TIP_MM, quaternion_of
from skills.planning.handoff import OtherArm
from skills.planning.motion_laws import PHASES, Poses
from skills.planning.trajectory import A1, A2, TRANSFER, Trajectory
from skills.sandbox import ProcessLimits
from skills.simulation import pictures, simulator
from skills.simulation.player import simulated
from skills.verification.clearance import needle_poses

FRAMES = 60  # over a plan of a few passes
FRAMES_PER_PASS, MOST_FRAMES = 12, 300
FRAMES_PER_S = 10
HELD_FRAMES = 10  # repetitions of the last frame
FILM_TIMEOUT_S = 600.0  # generous, because nobody waits for a film and jobs that people wait for have priority
FILM_MAKER = "skills.simulation.film:film"

# Pixels; H.264 wants whole blocks of 16.
WIDTH, HEIGHT = 480, 368
_HEAD, _FOOT = 32, 16
_SCALE = 1.5
_NICENESS = 5  # on top of the worker's
_POINTS = 120  # of the path in each pass and phase
_NEAR = 4  # passes before and after the present one whose path is drawn: with more they could not be told apart
_TRANSFER_COLOUR: pictures.Colour = (110, 110, 110)
_INK, _FAINT = (20, 20, 20), (120, 120, 120)
_ARMS = (("PSM_A", (64, 69, 77)), ("PSM_M", (66, 104, 66)))
_SAID = {
    TRANSFER: "transfer: to the start of the pass",
    A1: "A1: along the path of the policy",
    A2: "A2: the jaw turns for the hand-off",
}


@dataclass(frozen=True)
class Film:
    """A film in both formats."""

    mp4: bytes
    gif: bytes

    def __post_init__(self) -> None:
        if self.mp4[4:8] != b"ftyp" or self.gif[:6] != b"GIF89a":
            raise BadInput("This is no film.")


@dataclass(frozen=True, eq=False)
class FilmRequest:
    """A trajectory, the height of the pad in mm, and the samples to show, shape (F,)."""

    trajectory: Trajectory
    pad_top_mm: float
    samples: Ints

    @cached_property
    def drawn(self) -> Ints:
        """The samples through which the tip's path is drawn: at most `_POINTS` of each transfer and each A1."""
        phase, group = self.trajectory.phase, self.groups
        parts = np.split(np.arange(len(group)), np.flatnonzero(np.diff(group)) + 1)
        moving = [part for part in parts if phase[part[0]] != A2]
        thinned = [part[np.linspace(0, len(part) - 1, min(len(part), _POINTS)).round().astype(int)] for part in moving]
        return np.concatenate([*thinned, np.empty(0, np.int64)]).astype(np.int64)

    @cached_property
    def groups(self) -> Ints:
        """For each sample of the trajectory, three times its pass and its phase."""
        return self.trajectory.pass_index * len(PHASES) + self.trajectory.phase


CLASSES = packing.known(FilmRequest, Trajectory, OtherArm, Poses, Film)


# ---- outside the process ---------------------------------------------------------------------------------------


def make_film(
    trajectory: Trajectory,
    *,
    pad_top_mm: float,
    samples: ArrayLike | None = None,
    memory_bytes: int = 1 << 30,
    target: str = FILM_MAKER,
) -> Film:
    """Film a trajectory in a separate process.

    Args:
        trajectory: The trajectory to film.
        pad_top_mm: Height of the suture pad's top in the PSM base frame.
        samples: The sample that each frame shows, in order; by default `frames_of` chooses.
        memory_bytes: Memory limit of the process, and the same again for the encoder.
        target: The function that makes the film, as `module:function`.

    Raises:
        SimulationFailed: PyBullet is missing, or it crashed, hung, ran out of memory or returned no film.
    """
    if target == FILM_MAKER:
        simulator.require_pybullet()
    at = frames_of(trajectory) if samples is None else np.asarray(samples, np.int64)
    limits = ProcessLimits(memory_bytes, FILM_TIMEOUT_S, program=_encoder())
    return simulated(target, FilmRequest(trajectory, pad_top_mm, at), Film, CLASSES, limits)


def _encoder() -> str:
    """Return the path of the encoder, the program in the package."""
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())


def frames_of(trajectory: Trajectory) -> Ints:
    """Choose the samples to show: evenly, and the last of every pass, where the needle is handed over."""
    # Minus the passes, because the last sample of each is added below.
    count = min(MOST_FRAMES, max(FRAMES, FRAMES_PER_PASS * trajectory.passes)) - trajectory.passes
    evenly = np.linspace(0, len(trajectory) - 1, min(len(trajectory), count)).round().astype(np.int64)
    return np.unique(np.concatenate([evenly, trajectory.last_samples]))


# ---- inside the process ----------------------------------------------------------------------------------------


def film(given: BinaryIO, answer: BinaryIO) -> None:
    """Make the film that `make_film` requests."""
    os.nice(_NICENESS)
    asked = packing.read(given, CLASSES)
    assert isinstance(asked, FilmRequest)
    with simulator.opened(asked.trajectory.instrument) as scene:
        made = Film(*encode(_frames(scene, asked)))
    packing.write(answer, made, CLASSES)


def encode(frames: Iterable[bytes]) -> tuple[bytes, bytes]:
    """Encode frames, each the bytes of an RGB image: an MP4 that a browser can play while it loads, and a GIF."""
    exact = ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-threads", "1"]
    h264 = ["-c:v", "libx264", "-preset", "medium", "-crf", "21", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    # No dithering: the scene has few colours, and flickering dots would make the file three times as large.
    palette = "split[a][b];[a]palettegen=max_colors=128[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
    # By name, because a contained process has no /proc/self, through which the encoder could open a file without one.
    with tempfile.NamedTemporaryFile() as mp4, tempfile.NamedTemporaryFile() as gif:
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(FRAMES_PER_S)]
        command = [_encoder(), "-loglevel", "error", "-y", *raw, "-i", "pipe:0"]
        command += [*h264, *exact, "-f", "mp4", mp4.name]
        command += ["-filter_threads", "1", "-vf", palette, *exact, "-f", "gif", gif.name]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as encoder:  # noqa: S603
            assert encoder.stdin is not None
            for frame in frames:
                encoder.stdin.write(frame)
        if encoder.returncode:
            raise RuntimeError(f"the encoder stopped with code {encoder.returncode}")
        return mp4.read(), gif.read()


def _frames(scene: simulator.Simulator, asked: FilmRequest) -> Iterator[bytes]:
    """Pose the scene for one frame after the other; the last one is repeated."""
    motion = asked.trajectory
    scene.set_up(motion, asked.pad_top_mm)
    camera = _camera(asked)
    place_mm, rotation = needle_poses(motion, asked.samples)
    turns = quaternion_of(rotation)
    frame = b""
    for k, sample in enumerate(asked.samples.tolist()):
        scene.show(motion, sample)
        sheet = pictures.Sheet(scene.photograph(camera, (place_mm[k], turns[k])), camera)
        _draw_path(sheet, asked, sample)
        frame = _framed(sheet.finished(), motion, sample).tobytes()
        yield frame
    yield from [frame] * (HELD_FRAMES - 1)


def _camera(asked: FilmRequest) -> pictures.Camera:
    """Return a camera on the side opposite to PSM_M that also shows the finger tips, which are below the path."""
    path_mm, m = asked.trajectory.tip_mm[asked.drawn], asked.trajectory.psm_m
    facing = pictures.facing(np.concatenate([path_mm, path_mm - [0.0, 0.0, JAW_TIP_MM]]) * simulator.MM)
    if m is not None and m.base_mm[0] > path_mm[:, 0].mean():
        facing = replace(facing, yaw_deg=-facing.yaw_deg)
    height = HEIGHT - _HEAD - _FOOT
    return replace(facing, width=int(WIDTH * _SCALE), height=int(height * _SCALE), scale=_SCALE)


def _draw_path(sheet: pictures.Sheet, asked: FilmRequest, now: int) -> None:
    """Draw the tip's path of the present pass and those near it: pale where it is still to come."""
    motion, drawn = asked.trajectory, asked.drawn
    near = np.abs(motion.pass_index[drawn] - motion.pass_index[now]) <= _NEAR
    for group in np.unique(asked.groups[drawn[near]]).tolist():
        samples = drawn[asked.groups[drawn] == group]
        number, phase = divmod(group, len(PHASES))
        place, along = motion.tip_mm[samples] * simulator.MM, phase == A1
        colour = pictures.colour_of(number) if along else _TRANSFER_COLOUR
        done = int(np.searchsorted(samples, now, side="right"))
        sheet.line(place[max(0, done - 1) :], colour, 1.2, strength=0.45)
        sheet.line(place[:done], colour, 2.4 if along else 1.2, strength=0.95)
        if along:
            sheet.label(place[-1], pictures.GOAL_COLOUR, str(number), 7.0)


def _framed(view: Image.Image, motion: Trajectory, now: int) -> Image.Image:
    """Return the frame: the view, with a title and time line above it and a legend below."""
    frame = Image.new("RGB", (WIDTH, HEIGHT), pictures.WHITE)
    frame.paste(view, (0, _HEAD))
    pen = ImageDraw.Draw(frame)
    large, small = ImageFont.load_default(size=15), ImageFont.load_default(size=11)
    number, phase = int(motion.pass_index[now]), int(motion.phase[now])
    seconds = motion.stamps_s[now] - motion.stamps_s[0]
    pen.text((8, _HEAD // 2 - 2), f"Pass {number}   {_SAID[phase]}", fill=_INK, font=large, anchor="lm")
    pen.text((WIDTH - 8, _HEAD // 2 - 2), f"{seconds:.1f} s", fill=_INK, font=large, anchor="rm")
    _draw_progress(pen, motion, now)
    x, y = 8.0, HEIGHT - _FOOT / 2
    for name, colour in _ARMS[: 1 if motion.psm_m is None else 2]:
        pen.rectangle((x, y - 4, x + 8, y + 4), fill=colour)
        pen.text((x + 13, y), name, fill=_INK, font=small, anchor="lm")
        x += 26 + pen.textlength(name, font=small)
    pen.text((WIDTH - 8, y), "research use only", fill=_FAINT, font=small, anchor="rm")
    return frame


def _draw_progress(pen: ImageDraw.ImageDraw, motion: Trajectory, now: int) -> None:
    """Draw a bar above the view, one part for each pass, filled up to the present sample."""
    total, top = len(motion), _HEAD - 4
    ends = (motion.last_samples + 1).tolist()
    for number, (begin, end) in enumerate(pairwise([0, *ends])):
        left, right = WIDTH * begin / total, WIDTH * end / total - 1
        colour = pictures.colour_of(number)
        pale: pictures.Colour = tuple(round(255 - (255 - part) * 0.3) for part in colour)  # type: ignore[assignment]
        pen.rectangle((left, top, right, top + 3), fill=pale)
        if now >= begin:
            pen.rectangle((left, top, min(right, WIDTH * (now + 1) / total), top + 3), fill=colour)
