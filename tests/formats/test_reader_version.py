"""The version of the readers, by which cached contents of recordings are recognised as outdated."""

import io
from dataclasses import fields
from typing import Any

import numpy as np

from skills import packing
from skills.formats.parsed import parse_recording
from skills.formats.reader_process import KNOWN, READER_VERSION
from skills.seeds.recordings import sample_recordings
from tests.formats import bags, lerobots, trials
from tests.library import cases

DIGESTS = {1: "0ebfeddca3dab596cef8dcd7b6ede89b9ba43028dadcd215d174f384d21e3eb2"}
FILES: list[tuple[bytes, dict[str, Any]]] = [
    (sample_recordings()[0].data, {}),
    (bags.pose_bag(bags.straight(40)), {}),
    (cases.hand_off(), {}),
    (trials.text(trials.kinematics()), {}),
    (lerobots.packed(lerobots.episode(count=200)).getvalue(), {"frame": "base"}),
]


def test_equal_bytes_are_read_alike_as_long_as_the_version_stays():
    """If this fails, raise READER_VERSION, because cached contents differ from what is read now; then list its digest.

    Numbers are compared to a nanometre and a microsecond, because builds of numpy round differently.
    """
    parts: list[Any] = [[name, [field.name for field in fields(kind)]] for name, kind in sorted(KNOWN.items())]
    for data, how in FILES:
        told, arrays = parse_recording(io.BytesIO(data), **how), []
        tree = [packing.flatten(part, arrays, KNOWN) for part in (told.recording, told.proposed)]
        parts.append([rounded(tree), [rounded(array.tolist()) for array in arrays]])
    assert DIGESTS[READER_VERSION] == packing.sha256(packing.canonical(parts))


def rounded(part: Any) -> Any:
    """Return plain JSON with floating-point numbers rounded to six digits."""
    if isinstance(part, float):
        return float(np.round(part, 6)) + 0.0  # without a negative zero
    if isinstance(part, dict):
        return {name: rounded(value) for name, value in part.items()}
    return [rounded(value) for value in part] if isinstance(part, list | tuple) else part
