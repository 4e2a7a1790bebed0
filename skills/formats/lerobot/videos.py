"""Videos of exported episodes, from the user's own datasets: the service stores no pictures, so they never leave there.

    folders --find_recorded--> Source of each recording's digest --choose_videos--> Videos --add_videos--> dataset

An exported episode is matched with one of a folder by the SHA-256 of its recording: the same one-episode zip is made
from the folder as for an upload. Videos are copied as they are, never encoded again, so an episode must be a whole
recording, at the folder's rate, and have its rows as frames. All is checked before a video is copied: every episode has
the same cameras, of one codec and size, and no file shows a frame of an episode that is not exported.

The dataset is complete and verified before videos are added: of v2.1 one file per episode and camera; of v3.0 the files
of the folder, with the episodes' times in them. Statistics of the pictures are those of the folder, where it has them.
"""

import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from skills.errors import BadInput, Corrupt
from skills.formats.archive import Archive, printable
from skills.formats.checksums import SUMS, digest_of, read_sums, write_sums
from skills.formats.lerobot import EPISODES, INFO, Dataset, Json
from skills.formats.lerobot.cut import cut_episode, episodes_of, find_dataset
from skills.formats.lerobot.episode import episode_stamps
from skills.formats.lerobot.parquet import open_parquet, read_rows
from skills.formats.lerobot.writer import CHUNK, NO_PICTURES, as_json, as_line, joined_stats
from skills.formats.mp4 import Mp4, read_mp4
from skills.packing import sha256

V21_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
V30_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
SAME_S = 1e-4  # LeRobot's own tolerance between a frame's time and that of its picture

_CAMERA = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*")
_CAMERA_LETTERS = 100
_PIXELS = re.compile(r"[a-z0-9]{1,20}")
_SHARED = re.compile(r"videos/([^/]+)/chunk-(\d{1,9})/file-(\d{1,9})\.mp4")
_SINGLE = re.compile(r"videos/chunk-\d{1,9}/([^/]+)/episode_(\d{1,9})\.mp4")
_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
_PLAIN = ("min", "max", "mean", "std")
_README = "meta/README.md"
_EPISODE_STATS, _WHOLE_STATS = "meta/episodes_stats.jsonl", "meta/stats.json"
_PLACES = "meta/episodes/chunk-000/file-000.parquet"

_Key = tuple[str, int, int]  # of a video: the camera, and either chunk and file, or -1 and the episode
Stats = dict[str, list[float]]  # by name, of each channel; and `count`


@dataclass(frozen=True)
class Clip:
    """The pictures of one camera in one episode: a file, and the episode's frames in it."""

    file: Path
    first: int
    frames: int


@dataclass(frozen=True)
class EpisodeSource:
    """An episode of a folder.

    Attributes:
        folder: The dataset's folder.
        number: The episode's number in it.
        frames: Its number of frames.
        drift: How far a frame's time is from its number divided by the rate, in frames.
        fps: The rate of the dataset.
    """

    folder: Path
    number: int
    frames: int
    drift: float
    fps: float

    def __str__(self) -> str:
        return f"episode {self.number} of {self.folder}"


@dataclass
class Videos:
    """The videos of all episodes of a dataset, checked.

    Attributes:
        fps: Their rate.
        clips: For each episode, its clip of each camera.
        headers: The header of each file.
        cameras: The features of the cameras, as in info.json.
        stats: For each camera the statistics of every episode; without those that a folder lacks.
    """

    fps: float
    clips: list[dict[str, Clip]]
    headers: dict[Path, Mp4] = field(default_factory=dict)
    cameras: dict[str, Json] = field(default_factory=dict)
    stats: dict[str, list[Stats]] = field(default_factory=dict)


# ---- episodes of the folders -----------------------------------------------------------------------------------------


def find_recorded(
    folders: Iterable[Path],
    fps: int,
    *,
    columns: Mapping[str, str] | None = None,
    tools: Mapping[str, str] | None = None,
) -> dict[str, EpisodeSource]:
    """Return the episodes of some datasets by the SHA-256 of the recordings that uploads of them make.

    Args:
        folders: The folders of the datasets.
        fps: The rate at which they are to be exported.
        columns: As they were stated for the uploads, see `cut_episode`.
        tools: The same.

    Raises:
        BadInput: A folder is no dataset, has no videos, or another rate.
        UnreadableRecording: A dataset is damaged.
    """
    found: dict[str, EpisodeSource] = {}
    for folder in folders:
        if not (folder / INFO).is_file():
            raise BadInput(f"{folder} is not the folder of a LeRobot dataset: it has no {INFO}.")
        with find_dataset(folder) as dataset:
            assert dataset is not None
            if dataset.fps != fps:
                raise BadInput(
                    f"{folder} has {dataset.fps:g} frames per second, and the export {fps}. Videos are not encoded "
                    f"again: export with --fps {dataset.fps:g}."
                )
            _cameras(folder, dataset)
            for episode in episodes_of(dataset).values():
                with TemporaryFile() as packed:
                    cut_episode(dataset, episode, packed, columns=columns, tools=tools)
                    packed.seek(0)
                    digest = digest_of(packed)
                    packed.seek(0)
                    stamps_ns = episode_stamps(Archive(packed), "")
                even_ns = np.arange(len(stamps_ns)) * (1e9 / fps)
                drift = float(np.abs(stamps_ns - stamps_ns[0] - even_ns).max()) * fps / 1e9
                found.setdefault(digest, EpisodeSource(folder, episode.number, len(stamps_ns), drift, fps))
    return found


def _cameras(folder: Path, dataset: Dataset) -> list[str]:
    """Return the names of a dataset's videos.

    Raises:
        BadInput: There are none, or one cannot be the name of a folder.
    """
    names = sorted(one.name for one in dataset.features if one.dtype == "video")
    if not names:
        raise BadInput(f"{folder} has no videos: {INFO} describes no feature of the dtype video.")
    for name in names:
        if not (_CAMERA.fullmatch(name) and len(name) <= _CAMERA_LETTERS):
            raise BadInput(
                f"{folder} has a camera called {printable(name)!r}; its name must have letters, digits, . _ -"
            )
    return names


# ---- the choice of videos --------------------------------------------------------------------------------------------


def choose_videos(recordings: Sequence[str], sources: Mapping[str, EpisodeSource], version: str) -> Videos:
    """Return the videos of the episodes of a dataset, after all checks that need no dataset.

    Args:
        recordings: The SHA-256 of the recording of each episode.
        sources: From `find_recorded`.
        version: The version of the dataset, "v2.1" or "v3.0".

    Raises:
        BadInput: An episode is in no folder, or a row is not at the time of its frame; cameras, codecs or sizes
            differ; a video is missing, not in its folder, or of another length; or a file shows other frames too.
        UnreadableRecording: A video is damaged, or has sound.
    """
    missing = [f"{number} (recording {one[:12]})" for number, one in enumerate(recordings) if one not in sources]
    if missing:
        raise BadInput(
            f"No folder of --videos has these {len(missing)} of {len(recordings)} episodes: {', '.join(missing[:20])}. "
            "Name their folders too, with --tool and --column as in the upload, or export the others alone with --demo."
        )
    chosen = [sources[one] for one in recordings]
    for source in chosen:
        if not source.drift < 0.5:
            raise BadInput(
                f"The recorder's clock is up to {source.drift:.2g} frames from the frames' numbers in {source}, so its "
                "video does not show the exported rows. Export it without videos."
            )
    found = {folder: _shown(folder, chosen) for folder in {source.folder: None for source in chosen}}
    videos = Videos(chosen[0].fps, [found[source.folder].clips[source.number] for source in chosen])
    for camera in videos.clips[0]:
        stats = [found[source.folder].stats.get((camera, source.number)) for source in chosen]
        if all(one is not None for one in stats):
            videos.stats[camera] = [one for one in stats if one is not None]
    _read_headers(videos)
    _describe(videos, [found[source.folder].said for source in chosen])
    _refuse_other_frames(videos, version)
    return videos


@dataclass(frozen=True)
class _Shown:
    """The videos of a folder: the clips of each chosen episode, what info.json says of each camera, and statistics."""

    clips: dict[int, dict[str, Clip]]
    said: dict[str, tuple[str | None, bool]]
    stats: dict[tuple[str, int], Stats]


def _shown(folder: Path, chosen: Iterable[EpisodeSource]) -> _Shown:
    """Return the videos of the chosen episodes of a folder, and what it says of them."""
    with find_dataset(folder) as dataset:
        assert dataset is not None
        cameras = _cameras(folder, dataset)
        places = _places(dataset, cameras)
        files = _files(folder)
        clips: dict[int, dict[str, Clip]] = {}
        for source in chosen:
            if source.folder == folder:
                clips[source.number] = {one: _clip(source, one, places, files) for one in cameras}
        said = {one: _said(dataset.info["features"][one]) for one in cameras}
        return _Shown(clips, said, _stats(dataset, places, cameras))


def _places(dataset: Dataset, cameras: Sequence[str]) -> dict[int, Json] | None:
    """Return what v3.0 has of each episode's place in videos, and statistics where they are; None for v2.1."""
    if dataset.version != "v3.0":
        return None
    wanted = [f"videos/{one}/{part}" for one in cameras for part in _PLACE]
    stats = [f"stats/{one}/{name}" for one in cameras for name in (*_PLAIN, "count")]
    rows: list[Json] = []
    for table in dataset.parquets("meta/episodes/"):
        with dataset.files.unpacked(table) as file:
            here = open_parquet(file).schema_arrow.names
            names = ["episode_index", "length", *wanted, *(one for one in stats if one in here)]
            rows += read_rows(file, names, most_rows=EPISODES)
    return {row["episode_index"]: row for row in rows}


def _files(folder: Path) -> dict[_Key, Path]:
    """Return the videos of a folder."""
    found: dict[_Key, Path] = {}
    for path in sorted((folder / "videos").rglob("*.mp4")):
        name = path.relative_to(folder).as_posix()
        if one := _SHARED.fullmatch(name):
            key = one[1], int(one[2]), int(one[3])
        elif one := _SINGLE.fullmatch(name):
            key = one[1], -1, int(one[2])
        else:
            continue
        if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
            raise BadInput(f"{path} is no file in its folder, but a link out of it. Copy the dataset with its files.")
        if found.setdefault(key, path) != path:
            raise BadInput(f"{path} and {found[key]} are of the same episode; keep one of them.")
    return found


def _clip(
    source: EpisodeSource, camera: str, places: Mapping[int, Json] | None, files: Mapping[tuple[str, int, int], Path]
) -> Clip:
    """Return the frames of one camera in one episode.

    Raises:
        BadInput: Its video is missing, or its times are not those of its frames.
    """
    first, key = 0, (camera, -1, source.number)
    if places is not None:
        chunk, file, start_s, end_s = (places[source.number][f"videos/{camera}/{part}"] for part in _PLACE)
        try:
            key, first = (camera, int(chunk), int(file)), round(start_s * source.fps)
            ends_s = first / source.fps, (first + source.frames) / source.fps
            whole = abs(ends_s[0] - start_s) <= SAME_S and abs(ends_s[1] - end_s) <= SAME_S
        except (TypeError, ValueError, OverflowError):  # missing, or no number
            whole = False
        if not whole:
            raise BadInput(f"The times of {camera} in {source} are not those of its {source.frames} frames.")
    if key not in files:
        raise BadInput(f"There is no video of {camera} for {source}. Export the episodes with videos alone, by --demo.")
    return Clip(files[key], first, source.frames)


def _said(feature: Json) -> tuple[str | None, bool]:
    """Return what info.json says of a camera, and the header of the file does not: pixel format, and if it is depth."""
    info = feature.get("info", feature.get("video_info"))
    info = info if isinstance(info, dict) else {}
    pixels = info.get("video.pix_fmt")
    known = pixels if isinstance(pixels, str) and _PIXELS.fullmatch(pixels) else None
    return known, info.get("video.is_depth_map") is True


def _stats(dataset: Dataset, places: Mapping[int, Json] | None, cameras: Sequence[str]) -> dict[tuple[str, int], Stats]:
    """Return the statistics of each camera in each episode, where the dataset has all of them."""
    said: list[tuple[Any, str, Any]] = []
    if places is not None:
        for number, row in places.items():
            here = {one: {name: row.get(f"stats/{one}/{name}") for name in (*_PLAIN, "count")} for one in cameras}
            said += [(number, camera, found) for camera, found in here.items()]
    elif (name := dataset.root + _EPISODE_STATS) in dataset.files.names:
        for line in dataset.lines(name):
            stats = line.get("stats")
            here = stats if isinstance(stats, dict) else {}
            said += [(line.get("episode_index"), camera, here.get(camera)) for camera in cameras]
    return {(camera, number): found for number, camera, one in said if (found := _usable(one)) is not None}


def _usable(said: Any) -> Stats | None:
    """Return statistics of pictures by channel; None if one is missing or not finite."""
    try:
        stats = {name: np.array(said[name], dtype=np.float64).ravel() for name in (*_PLAIN, "count")}
    except (KeyError, TypeError, ValueError):
        return None
    sizes = [stats[name].size for name in _PLAIN]
    whole = sizes[0] in (1, 3) and len(set(sizes)) == 1 and stats["count"].size == 1 and stats["count"][0] > 0
    if not whole or not all(np.isfinite(one).all() for one in stats.values()):
        return None
    return {name: one.tolist() for name, one in stats.items()}


def _read_headers(videos: Videos) -> None:
    """Read the header of each video, and refuse frames that are not at the rate."""
    for path in dict.fromkeys(clip.file for clips in videos.clips for clip in clips.values()):
        with path.open("rb") as file:
            header = read_mp4(file, str(path))
        off_s = np.abs(header.times_s - np.arange(header.frames) / videos.fps).max()
        if not off_s <= SAME_S:
            raise BadInput(f"{path} does not have {videos.fps:g} frames per second from 0 s: one is {off_s:.4f} s off.")
        videos.headers[path] = header


def _describe(videos: Videos, said: Sequence[Mapping[str, tuple[str | None, bool]]]) -> None:
    """Describe the cameras; refuse episodes that differ in them."""
    for number, (clips, here) in enumerate(zip(videos.clips, said, strict=True)):
        if clips.keys() != videos.clips[0].keys():
            raise BadInput(
                f"Episode {number} has the cameras {', '.join(clips)}, and episode 0 {', '.join(videos.clips[0])}; "
                "export those with the same cameras, by --demo."
            )
        for camera, clip in clips.items():
            header, (pixels, is_depth) = videos.headers[clip.file], here[camera]
            feature = _feature(header, pixels, is_depth, videos.fps)
            if videos.cameras.setdefault(camera, feature) != feature:
                raise BadInput(
                    f"{camera} is {_describe_camera(feature)} in {clip.file}, and "
                    f"{_describe_camera(videos.cameras[camera])} in the episodes before; export those that are equal, "
                    "by --demo."
                )


def _feature(header: Mp4, pixels: str | None, is_depth: bool, fps: float) -> Json:
    """Return a camera as a feature of info.json."""
    channels = 1 if pixels is not None and pixels.startswith("gray") else 3
    info = {
        "video.height": header.height,
        "video.width": header.width,
        "video.codec": header.codec,
        **({} if pixels is None else {"video.pix_fmt": pixels}),
        "video.is_depth_map": is_depth,
        "video.fps": int(fps),
        "video.channels": channels,
        "has_audio": False,
    }
    shape = [header.height, header.width, channels]
    return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}


def _describe_camera(feature: Json) -> str:
    info = feature["info"]
    kind = "depth" if info["video.is_depth_map"] else info.get("video.pix_fmt", "unknown pixels")
    return f"{info['video.codec']}, {info['video.width']} x {info['video.height']}, {kind}"


def _refuse_other_frames(videos: Videos, version: str) -> None:
    """Refuse a file with frames that are of no exported episode, or for v2.1 of several episodes."""
    for path, header in videos.headers.items():
        clips = sorted((c for one in videos.clips for c in one.values() if c.file == path), key=lambda clip: clip.first)
        at = 0
        for clip in clips:
            at = at + clip.frames if clip.first == at else -1
        if at != header.frames:
            raise BadInput(
                f"{path} has {header.frames} frames, and not all of them are of exported episodes, once each: the "
                "others would be passed on too. Export all episodes of this file, or write one file for each episode."
            )
        if version == "v2.1" and len(clips) > 1:
            raise BadInput(f"{path} has {len(clips)} episodes, and v2.1 a file for each; export with --version v3.0.")


# ---- the dataset -----------------------------------------------------------------------------------------------------


def add_videos(folder: Path, videos: Videos) -> None:
    """Add videos to a dataset that is unpacked and verified, and to its metadata, README and manifest.

    Args:
        folder: The dataset, which is incomplete if this raises.
        videos: From `choose_videos`, for the episodes of this dataset.

    Raises:
        BadInput: An episode has other frames than its video, or a camera is called like another feature.
        Corrupt: A video has changed since it was checked, or the dataset is not as this version writes it.
    """
    sums = read_sums((folder / SUMS).read_text())
    info = json.loads((folder / INFO).read_text())
    if taken := videos.cameras.keys() & info["features"].keys():
        raise BadInput(f"The camera {sorted(taken)[0]} is called like another feature of the dataset; rename it.")
    is_single = info["codebase_version"] == "v2.1"
    (_complete_single if is_single else _complete_shared)(folder, videos, sums)
    info["features"] |= videos.cameras
    info["video_path"] = V21_VIDEO if is_single else V30_VIDEO
    if is_single:
        info["total_videos"] = len(videos.clips) * len(videos.cameras)
    _write(folder, INFO, as_json(info), sums)
    readme = (folder / _README).read_text()
    if readme.count(NO_PICTURES) != 1:
        raise Corrupt("The README of the dataset has no sentence about pictures; update the command or the service.")
    _write(folder, _README, readme.replace(NO_PICTURES, _words(videos)).encode(), sums)
    (folder / SUMS).write_bytes(write_sums(sums))


def _words(videos: Videos) -> str:
    """Return the part of the README about the cameras."""
    cameras = "".join(f"- `{name}`: {_describe_camera(one)}\n" for name, one in videos.cameras.items())
    return f"""Cameras:

{cameras}
The videos are copies, not encoded again and without sound, from the exporter's own datasets, from which the episodes
were recorded; notes that their recorder wrote into the files are still there. The service that wrote the other files
stores no pictures, and the consent above is not about them. Who exported this dataset declared that everyone who can be
seen or identified in the videos has consented to passing them on."""


def _complete_single(folder: Path, videos: Videos, sums: dict[str, str]) -> None:
    """Copy the videos of v2.1, and add the statistics of the pictures."""
    lines = [json.loads(line) for line in (folder / "meta/episodes.jsonl").read_text().splitlines()]
    _check_lengths(videos, [one["length"] for one in lines])
    for number, clips in enumerate(videos.clips):
        for camera, clip in clips.items():
            place = {"episode_chunk": number // CHUNK, "video_key": camera, "episode_index": number}
            _copy(folder, V21_VIDEO.format(**place), clip.file, videos, sums)
    stats = [json.loads(line) for line in (folder / _EPISODE_STATS).read_text().splitlines()]
    for number, one in enumerate(stats):
        one["stats"] |= {camera: _nested(found[number]) for camera, found in videos.stats.items()}
    _write(folder, _EPISODE_STATS, b"".join(map(as_line, stats)), sums)


def _complete_shared(folder: Path, videos: Videos, sums: dict[str, str]) -> None:
    """Copy the videos of v3.0, and add the episodes' places in them and the statistics of the pictures."""
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(folder / _PLACES)
    _check_lengths(videos, table["length"].to_pylist())
    for camera in videos.cameras:
        clips = [one[camera] for one in videos.clips]
        numbers = {path: number for number, path in enumerate(dict.fromkeys(clip.file for clip in clips))}
        for path, number in numbers.items():
            place = {"video_key": camera, "chunk_index": number // CHUNK, "file_index": number % CHUNK}
            _copy(folder, V30_VIDEO.format(**place), path, videos, sums)
        columns: dict[str, list[Any]] = {
            "chunk_index": [numbers[clip.file] // CHUNK for clip in clips],
            "file_index": [numbers[clip.file] % CHUNK for clip in clips],
            "from_timestamp": [clip.first / videos.fps for clip in clips],
            "to_timestamp": [(clip.first + clip.frames) / videos.fps for clip in clips],
        }
        columns = {f"videos/{camera}/{name}": one for name, one in columns.items()}
        nested = [_nested(one) for one in videos.stats.get(camera, [])]
        columns |= {f"stats/{camera}/{name}": [one[name] for one in nested] for name in (nested[0] if nested else ())}
        for name, values in columns.items():
            table = table.append_column(name, pa.array(values))
    with io.BytesIO() as file:
        parquet.write_table(table, file)
        _write(folder, _PLACES, file.getvalue(), sums)
    whole = json.loads((folder / _WHOLE_STATS).read_text())
    whole |= {camera: _nested(reduce(joined_stats, stats)) for camera, stats in videos.stats.items()}
    _write(folder, _WHOLE_STATS, as_json(whole), sums)


def _check_lengths(videos: Videos, lengths: Sequence[int]) -> None:
    """Refuse episodes of another length than their videos; the recorder's clock may end one frame earlier.

    Raises:
        BadInput: It names the episode.
    """
    for number, (clips, length) in enumerate(zip(videos.clips, lengths, strict=True)):
        for camera, clip in clips.items():
            if clip.frames - length not in (0, 1):
                raise BadInput(
                    f"Episode {number} has {length} frames, and its video of {camera} {clip.frames}: not every row was "
                    "exported. Export it without videos."
                )


def _nested(stats: Stats) -> dict[str, list[Any]]:
    """Return statistics of pictures in LeRobot's shape, (channels, 1, 1), and the count as an integer."""
    nested = {name: [[[value]] for value in values] for name, values in stats.items() if name != "count"}
    return nested | {"count": [int(stats["count"][0])]}


def _copy(folder: Path, name: str, path: Path, videos: Videos, sums: dict[str, str]) -> None:
    """Copy a video, and compare its header with the one that was checked."""
    to = folder / name
    to.parent.mkdir(parents=True, exist_ok=True)
    with path.open("rb") as file, to.open("x+b") as out:
        sums[name] = digest_of(file, out.write)
        header, checked = read_mp4(out, str(path)), videos.headers[path]
    if not (np.array_equal(header.times_s, checked.times_s) and header.format == checked.format):
        raise Corrupt(f"{path} has changed while it was copied. Export again.")


def _write(folder: Path, name: str, data: bytes, sums: dict[str, str]) -> None:
    (folder / name).write_bytes(data)
    sums[name] = sha256(data)
