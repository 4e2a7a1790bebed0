"""Recordings with next to nothing in them: one row, no turn, no jaw, no motion; each ends in words, at every door."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from skills.db.session import Database
from skills.library.recordings.recordings import store_recording
from tests.library import cases
from tests.library.test_tries import MCAP, named, tried

TABLE = "text/csv"
TURN, JAW = ("qx", "qy", "qz", "qw"), ("jaw_rad",)
VALUES = {"qx": 0.7071, "qy": 0.7071, "qz": 0.0, "qw": 0.0, "jaw_rad": 0.3}


def rows(count: int, more: Sequence[str] = (), *, still: bool = False) -> bytes:
    """Return a table of so many samples at 50 Hz, with further columns of constant values."""
    tip = cases.points_mm()[: 1 if still else count]
    lines = [[k / 50, *tip[k % len(tip)], *(VALUES[name] for name in more)] for k in range(count)]
    header = ",".join(["t_s", "x_mm", "y_mm", "z_mm", *more])
    return "\n".join([header, *(",".join(f"{one:.4f}" for one in line) for line in lines), ""]).encode()


def poses(count: int) -> bytes:
    return cases.bag(tip=cases.points_mm()[:count])


SMALL = {
    "one row": (rows(1), TABLE, "one sample"),
    "one row with its turn": (rows(1, TURN), TABLE, "one sample"),
    "one row with its jaw": (rows(1, JAW), TABLE, "one sample"),
    "two rows": (rows(2), TABLE, "0.5263 mm wide"),
    "a tip that stands still": (rows(40, still=True), TABLE, "0 mm wide"),
    "a bag of one pose": (poses(1), MCAP, "one sample"),
    "a bag of two poses": (poses(2), MCAP, "0.526316 mm wide"),
}
small = pytest.mark.parametrize(("data", "media_type", "fault"), SMALL.values(), ids=list(SMALL))


@small
def test_a_try_of_a_small_recording_ends_in_words(data: bytes, media_type: str, fault: str, database: Database) -> None:
    cases.add_surgeon(database)
    recording = store_recording(database, cases.upload(data, media_type), "test", surgeon="kestrel")[0].sha256
    job = tried(database, recording, segment="whole", tissue_mm=-170.0, errors="calibrated", release=True)
    assert (job.state, fault in str(job.error)) == ("failed", True), job.error
    assert named(job, "done") == ["read", "propose"]


@small
def test_commands_on_a_small_recording_end_in_words(data: bytes, media_type: str, fault: str, skills, tmp_path) -> None:
    file = str(tmp_path / ("hand-off.csv" if media_type == TABLE else "hand-off.mcap"))
    Path(file).write_bytes(data)
    skills.does("migrate")
    skills.does("surgeon", "put", "kestrel")
    skills.does("suture", "list")
    skills.does("recording", "preview", file)
    skills.does("recording", "add", file)
    skills.refuses(
        "demo", "add", file, "--surgeon", "kestrel", "--suture", cases.SUTURE, "--segment", "whole", says=fault
    )
