"""Videos for tests, encoded with ffmpeg, whose frames show their numbers; and datasets of LeRobot with them.

The grey of the left half of frame k is k modulo `BASE`, and that of the right half k divided by it, in steps of 10.
"""

import json
import struct
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.formats import lerobots
from tests.formats.lerobots import COUNTS, FPS, info_of

CAMERAS = ("observation.images.endoscope.left", "observation.images.wrist")
WIDTH, HEIGHT = 64, 48
DARKEST, STEP, BASE = 40, 10, 15  # a dataset has 150 frames


@cache
def encoded(first: int, count: int, *more: str, fps: int = FPS, width: int = WIDTH) -> bytes:
    """Return an MP4 file of frames `first` ... of the session, without audio; `more` are arguments of ffmpeg."""
    grey = bytes([128]) * (HEIGHT * width // 2)
    frames = b"".join(
        (b"".join(bytes([DARKEST + STEP * one]) * (width // 2) for one in (k % BASE, k // BASE)) * HEIGHT) + grey
        for k in range(first, first + count)
    )
    raw = ("-f", "rawvideo", "-pix_fmt", "yuv420p", "-s", f"{width}x{HEIGHT}", "-r", str(fps), "-i", "pipe:0")
    how = more or ("-c:v", "libx264", "-bf", "2", "-g", "12", "-crf", "2")
    return _ffmpeg(frames, *raw, *how, "-pix_fmt", "yuv420p", "-f", "mp4", "-movflags", "+faststart")


def again(data: bytes, *arguments: str) -> bytes:
    """Return a video written again with some arguments of ffmpeg."""
    return _ffmpeg(data, "-i", "pipe:0", *arguments, "-f", "mp4")


def shown(path: Path) -> list[int]:
    """Return the numbers of the frames that a video shows, in order."""
    command = ["-i", str(path), "-f", "rawvideo", "-pix_fmt", "yuv420p", "-fps_mode", "passthrough", "pipe:1"]
    run = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *command], capture_output=True, check=True, timeout=60
    )
    frames = np.frombuffer(run.stdout, np.uint8).reshape(-1, HEIGHT * WIDTH * 3 // 2)
    return [number_of(one[: HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)) for one in frames]


def number_of(luma: Any) -> int:
    """Return the number that a frame shows, from its luma, shape (HEIGHT, WIDTH)."""
    halves = luma[:, : WIDTH // 2], luma[:, WIDTH // 2 :]
    low, high = (round((float(np.median(one)) - DARKEST) / STEP) for one in halves)
    return low + BASE * high


def _ffmpeg(data: bytes, *arguments: str) -> bytes:
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        out = Path(folder) / "out.mp4"
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *arguments, str(out)]
        subprocess.run(command, input=data, check=True, timeout=60)
        return out.read_bytes()


def video_feature(**info: Any) -> dict[str, Any]:
    said = {"video.fps": FPS, "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False} | info
    return {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"], "info": said}


def stats_of(number: int) -> dict[str, Any]:
    """Return invented statistics of the pictures of an episode, in LeRobot's shape."""
    level = {"min": 0.0, "max": 1.0, "mean": 0.1 * number + 0.2, "std": 0.05}
    return {name: [[[one]], [[one + 0.01]], [[one + 0.02]]] for name, one in level.items()} | {"count": [20 + number]}


def dataset(version: str, *, cameras: Sequence[str] = CAMERAS, stats: bool = True) -> dict[str, bytes]:
    """Return the files of a dataset of three episodes with videos; the frames of all episodes are numbered through."""
    files = lerobots.dataset(version)
    info = json.loads(files["meta/info.json"])
    info["features"] |= {camera: video_feature() for camera in cameras}
    first = [sum(COUNTS[:k]) for k in range(3)]
    if version == "v2.1":
        for number, count in enumerate(COUNTS):
            for camera in cameras:
                name = f"videos/chunk-000/{camera}/episode_{number:06d}.mp4"
                files[name] = encoded(first[number], count)
        lines = [{"episode_index": k, "stats": dict.fromkeys(cameras, stats_of(k))} for k in range(3)]
        if stats:
            files["meta/episodes_stats.jsonl"] = b"\n".join(json.dumps(one).encode() for one in lines)
    else:
        table = "meta/episodes/chunk-000/file-000.parquet"
        rows = pq.read_table(pa.BufferReader(files[table])).to_pylist()
        for number, row in enumerate(rows):  # the first two episodes share a file
            start = first[number] if number < 2 else 0
            for camera in cameras:
                place = {"chunk_index": 0, "file_index": int(number == 2), "from_timestamp": start / FPS}
                place["to_timestamp"] = (start + COUNTS[number]) / FPS
                row |= {f"videos/{camera}/{name}": one for name, one in place.items()}
                row |= {f"stats/{camera}/{name}": one for name, one in stats_of(number).items()} if stats else {}
        files[table] = lerobots.parquet(pa.Table.from_pylist(rows))
        for camera in cameras:
            files[f"videos/{camera}/chunk-000/file-000.mp4"] = encoded(0, first[2])
            files[f"videos/{camera}/chunk-000/file-001.mp4"] = encoded(first[2], COUNTS[2])
    return files | {"meta/info.json": info_of(info["features"], 3, sum(COUNTS), version)}


# ---- headers by hand -------------------------------------------------------------------------------------------------


def box(kind: bytes, *contents: bytes) -> bytes:
    """Return a box of an MP4 file."""
    content = b"".join(contents)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def header(parts: Mapping[str, bytes] | None = None, *, tracks: int = 1) -> bytes:
    """Return an MP4 file of five frames at 25 Hz without the frames themselves; `parts` replace some of its boxes."""
    boxes = {
        "stsd": box(b"stsd", bytes(4), struct.pack(">I", 1), box(b"avc1", bytes(24), struct.pack(">HH", 64, 48))),
        "stts": box(b"stts", bytes(4), struct.pack(">III", 1, 5, 4)),
        "ctts": b"",
        "stsz": box(b"stsz", bytes(4), struct.pack(">II", 100, 5)),
        "edts": b"",
        "hdlr": box(b"hdlr", bytes(8), b"vide", bytes(12)),
    } | dict(parts or {})
    table = box(b"stbl", boxes["stsd"], boxes["stts"], boxes["ctts"], boxes["stsz"])
    scale = box(b"mdhd", bytes(12), struct.pack(">II", 100, 20))
    track = box(b"trak", boxes["edts"], box(b"mdia", scale, boxes["hdlr"], box(b"minf", table)))
    moov = box(b"moov", box(b"mvhd", bytes(12), struct.pack(">II", 1000, 200)), *[track] * tracks)
    return box(b"ftyp", b"isom", bytes(4)) + moov + box(b"mdat", bytes(500))


def edit(length: int, first: int, *, count: int = 1, rate: int = 1 << 16) -> bytes:
    """Return an edit list."""
    return box(b"edts", box(b"elst", bytes(4), struct.pack(">I", count), struct.pack(">IiI", length, first, rate)))
