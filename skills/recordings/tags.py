"""Read the stages of a session from what the dVRK's recorders write beside a bag.

Two recorders are read: jhu-dvrk/data_collection and jhu-dvrk/dvrk_data. Both write JSON with a list `stages` of
`{name, start, end}`, in the tags of a session or of one video. A moment is one of

    {"cpu_ts": ns, ...}                        nanoseconds since 1970: taken as it is
    {"frame_absolute": k} or {"frame_idx": k}  a frame of the video, counted from 0: looked up in the video's sidecar
    k                                          the same, as older files have it; nanoseconds where too large for a frame

A sidecar is JSON too, with `timestamps_ns` or `frames` of `{"cpu_ts": ns}`; it belongs to the tags with the same
`video_file`, or to those whose name is its own with `_tags` added. Stages that never ended, and frames without a
sidecar, have no time here and are passed over; other JSON is no concern of this module.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any

from skills.errors import UnreadableRecording
from skills.style.recording import Label

LABELS = 10_000
_NAME_LENGTH = 200
_LATEST_FRAME = 10**12  # as nanoseconds, 17 minutes after midnight of the first of January 1970
_LATEST_NS = 2**62

Json = dict[str, Any]


def read_labels(texts: Mapping[str, str]) -> tuple[Label, ...]:
    """Return the stages that some JSON files name, in order of time; a stage named twice is one.

    Args:
        texts: What is in the files, by name.

    Raises:
        UnreadableRecording: A file is no JSON, has a stage that is none, or ends a stage before it starts.
    """
    documents = {name: document for name, text in texts.items() if isinstance(document := _parsed(name, text), dict)}
    frames = dict(_sidecars(documents))
    labels: set[Label] = set()
    for name, document in documents.items():
        stages = document.get("stages", [])
        if not isinstance(stages, list) or len(labels) + len(stages) > LABELS:
            raise UnreadableRecording(f"{_short(name)}: stages is no list of at most {LABELS} stages.")
        stamps = _stamps_for(name, document, frames)
        labels.update(label for stage in stages if (label := _label(name, stage, stamps)) is not None)
    return tuple(sorted(labels, key=lambda label: (label.start_ns, label.end_ns, label.name)))


def _parsed(name: str, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UnreadableRecording(f"{_short(name)} is no JSON ({type(error).__name__}); leave it out.") from error


def _sidecars(documents: Mapping[str, Json]) -> Iterator[tuple[str, list[Any]]]:
    """Give the frames' moments of each video, under the name of the video and of the sidecar without its ending."""
    for name, document in documents.items():
        stamps = document.get("timestamps_ns")
        if stamps is None and isinstance(document.get("frames"), list):
            stamps = [frame.get("cpu_ts") if isinstance(frame, dict) else None for frame in document["frames"]]
        if isinstance(stamps, list):
            yield PurePosixPath(name).stem, stamps
            yield str(document.get("video_file")), stamps


def _stamps_for(name: str, document: Json, frames: Mapping[str, list[Any]]) -> list[Any]:
    video = PurePosixPath(name).stem.removesuffix("_tags")
    return frames.get(str(document.get("video_file"))) or frames.get(video) or []


def _label(name: str, stage: Any, stamps: list[Any]) -> Label | None:
    if not isinstance(stage, dict) or not isinstance(stage.get("name"), str):
        raise UnreadableRecording(f"{_short(name)} has a stage without a name.")
    start, end = (_moment_ns(stage.get(edge), stamps) for edge in ("start", "end"))
    if start is None or end is None:
        return None
    if end < start:
        raise UnreadableRecording(f"{_short(name)} ends the stage {_printable(stage['name'])!r} before it starts.")
    return Label(_printable(stage["name"]), "stage", start, end)


def _moment_ns(moment: Any, stamps: list[Any]) -> int | None:
    """Return nanoseconds since 1970, None where the moment cannot be told."""
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


def _printable(name: str) -> str:
    """Return a stage's name without what cannot be shown, or not even be written: JSON may hold halves of letters."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:_NAME_LENGTH])


def _short(name: str) -> str:
    return PurePosixPath(name).name[:80]
