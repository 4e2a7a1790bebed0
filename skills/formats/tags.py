"""The stages of a recording in the JSON files that recorders write beside a bag.

Two recorders write tags: jhu-dvrk/data_collection and jhu-dvrk/dvrk_data. Both write JSON with a list `stages` of
`{name, start, end}`, in the tags of a session or of one video. `start` and `end` are each one of

    {"cpu_ts": ns, ...}                        nanoseconds since 1970, used directly
    {"frame_absolute": k} or {"frame_idx": k}  a frame of the video, counted from 0: looked up in the video's sidecar
    k                                          a frame as above, in older files; nanoseconds if too large for a frame

A sidecar is JSON too, with `timestamps_ns` or `frames` of `{"cpu_ts": ns}`; it belongs to the tags with the same
`video_file`, or to those named like it with `_tags` appended. Stages without an end, and frames without a sidecar, have
no time and are skipped; other JSON files are ignored, and those that are damaged, have comments or stages of another
kind are named.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any

from skills.demonstration.recording import Label
from skills.errors import UnreadableRecording
from skills.formats.archive import printable

TAGS_BYTES = 32 << 20  # per JSON file: the frames of a day of video
LABELS = 10_000

_WORDS = ("timestamps_ns", "cpu_ts")  # of tags and sidecars alone; other JSON has frames and stages too
_NAME_LENGTH = 200
_LATEST_FRAME = 10**12  # larger numbers are nanoseconds; this one is 17 minutes after midnight of 1 January 1970
_LATEST_NS = 2**62  # in the year 2116; later stamps are taken for errors
Json = dict[str, Any]  # of any form: the recorders have changed theirs, and other JSON lies beside it


def read_labels(texts: Mapping[str, str]) -> tuple[tuple[Label, ...], dict[str, str]]:
    """Return the stages in some JSON files, in order of time and without duplicates, and the files left aside.

    Args:
        texts: Contents of the files, by file name.

    Returns:
        The stages; and files that are neither JSON nor tags, such as settings with comments, with the reason.

    Raises:
        UnreadableRecording: A file of tags is not JSON, has an invalid stage, or a stage that ends before it starts.
    """
    left_aside, documents = dict[str, str](), dict[str, Json]()
    for name, text in texts.items():
        document = _parsed(name, text)
        stages = document.get("stages", []) if isinstance(document, dict) else []
        is_tags = name.endswith("tags.json") or (isinstance(stages, list) and all(map(_is_named, stages)))
        if document is None or not is_tags:
            left_aside[_short(name)] = "left aside: it has no tags of a recorder"
        elif isinstance(document, dict):
            documents[name] = document
    frames = dict(_sidecars(documents))
    labels: set[Label] = set()
    for name, document in documents.items():
        stages = document.get("stages", [])
        if not isinstance(stages, list) or len(labels) + len(stages) > LABELS:
            raise UnreadableRecording(f"{_short(name)}: `stages` is not a list of at most {LABELS} stages.")
        stamps = _stamps_for(name, document, frames)
        labels.update(label for stage in stages if (label := _label(name, stage, stamps)) is not None)
    return in_time(labels), left_aside


def in_time(labels: Iterable[Label]) -> tuple[Label, ...]:
    """Return labels in order of time, without duplicates."""
    return tuple(sorted(set(labels), key=lambda label: (label.start_ns, label.end_ns, label.name)))


def _parsed(name: str, text: str) -> Any:
    """Return a JSON document; None for a file that is none and has nothing of a recorder's tags.

    Raises:
        UnreadableRecording: It is a recorder's, and damaged.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        if not name.endswith("tags.json") and not any(f'"{word}"' in text for word in _WORDS):
            return None
        raise UnreadableRecording(f"{_short(name)} is not valid JSON ({type(error).__name__}); mend it.") from error


def _sidecars(documents: Mapping[str, Json]) -> Iterator[tuple[str, list[Any]]]:
    """Yield the timestamps of each video's frames by name.

    Each list is yielded under two names: that of the video, and that of the sidecar without its suffix.
    """
    for name, document in documents.items():
        stamps = document.get("timestamps_ns")
        if stamps is None and isinstance(document.get("frames"), list):
            stamps = [frame.get("cpu_ts") if isinstance(frame, dict) else None for frame in document["frames"]]
        if isinstance(stamps, list):
            yield PurePosixPath(name).stem, stamps
            yield str(document.get("video_file")), stamps


def _stamps_for(name: str, document: Json, frames: Mapping[str, list[Any]]) -> list[Any]:
    """Return the times of the frames that tags count in; empty if there is no sidecar."""
    video = PurePosixPath(name).stem.removesuffix("_tags")
    return frames.get(str(document.get("video_file"))) or frames.get(video) or []


def _is_named(stage: Any) -> bool:
    """Return whether a stage has a name that is a text."""
    return isinstance(stage, dict) and isinstance(stage.get("name"), str)


def _label(name: str, stage: Any, stamps: list[Any]) -> Label | None:
    """Return a stage as a label; None where its start or its end has no time."""
    if not _is_named(stage):
        raise UnreadableRecording(f"{_short(name)} has a stage without a name.")
    start, end = (_moment_ns(stage.get(edge), stamps) for edge in ("start", "end"))
    if start is None or end is None:
        return None
    if end < start:
        raise UnreadableRecording(f"{_short(name)} ends the stage {printable(stage['name'])!r} before it starts.")
    return Label(printable(stage["name"], _NAME_LENGTH), "stage", start, end)


def _moment_ns(moment: Any, stamps: list[Any]) -> int | None:
    """Return nanoseconds since 1970; None where the time is unknown."""
    frame = moment
    if isinstance(moment, dict):
        if _is_stamp(moment.get("cpu_ts")):
            return int(moment["cpu_ts"])
        frame = next((moment[key] for key in ("frame_absolute", "frame_idx", "frame") if key in moment), None)
    elif _is_stamp(moment):
        return int(moment)
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < len(stamps):
        return None
    return int(stamps[frame]) if _is_stamp(stamps[frame]) else None


def _is_stamp(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and _LATEST_FRAME < value < _LATEST_NS


def _short(name: str) -> str:
    return PurePosixPath(name).name[:80]
