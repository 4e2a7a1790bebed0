"""Statements about a recording that mean nothing for its format: each is refused by its name, and none is ignored."""

import io
from collections.abc import Mapping
from typing import Any, get_args

import pytest

from skills.demonstration.recording import Format
from skills.errors import BadRecording, BadSettings
from skills.formats import read_recording, write_mcap
from skills.formats.bag_writer import messages_of
from skills.schemas.recordings import TableIn
from tests.formats import bags, lerobots, others, trials, written
from tests.formats.test_extract import rows, table

STATEMENTS: Mapping[str, Any] = {
    "rate_hz": 50.0,
    "frame": "elsewhere",
    "column": ["x_m=PosX"],
    "unit": ["mm"],
    "decimal": "comma",
    "table_arm": "PSM9",
    "instrument": "420006",
}
WORDS = {"column": "column", "decimal": "decimal", "table_arm": "arm"}  # in the message, where it is not the name
# The statements that mean something, each of which is then read; a table's own time leaves no room for a rate.
MEANS: Mapping[str, tuple[str, ...]] = {
    "mcap": (),
    "bag folder": (),
    "ros 1 bag": (),
    "db3 bag": (),
    "jigsaws": (),
    "zipped jigsaws": (),
    "extract": (),
    "lerobot": ("frame",),
    "ee_csv": ("frame", "instrument"),
    "ee_csv of joints": ("instrument",),
    "table": ("frame", "table_arm", "instrument"),
    "table of joints": ("rate_hz", "table_arm", "instrument"),
}
NEEDS: Mapping[str, Mapping[str, Any]] = {
    "lerobot": {"frame": "base"},
    "ee_csv": {"frame": "base"},
    "ee_csv of joints": {"instrument": "400006"},
    "table of joints": {"instrument": "400006", "rate_hz": 30.0},
}


def of_joints() -> bytes:
    """Return an ee_csv with the joints of an arm and without its poses."""
    lines = [line.split(",") for line in written.ee_csv(rows=60, more=True).splitlines()]
    kept = [k for k, name in enumerate(lines[0]) if name == "timestamp" or name.startswith("psm2_js")]
    return ("\n".join(",".join(line[k] for k in kept) for line in lines) + "\n").encode()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("recordings")
    messages = list(messages_of(bags.recording()))
    two = others.db3(messages, folder / "two")
    kinematics = trials.text(trials.kinematics(30))
    motion = bags.recording().motions[0]
    return {
        "mcap": write_mcap(bags.recording()),
        "bag folder": others.zipped(others.folder_members(two)),
        "ros 1 bag": others.rosbag1(messages, folder / "one.bag").read_bytes(),
        "db3 bag": (two / "two.db3").read_bytes(),
        "jigsaws": kinematics,
        "zipped jigsaws": others.zipped({"Suturing_B001.txt": kinematics}),
        "extract": table(rows(motion)).encode(),
        "lerobot": lerobots.packed(lerobots.episode()).read(),
        "ee_csv": written.ee_csv(rows=60, more=True).encode(),
        "ee_csv of joints": of_joints(),
        "table": b"t_s,x_mm,y_mm,z_mm\n0,0,50,-120\n0.5,0,51,-120\n1,0,52,-120\n",
        "table of joints": written.joints().encode(),
    }


def test_every_statement_that_a_request_can_make_is_tried():
    assert set(TableIn.model_fields) == set(STATEMENTS)


def test_each_format_is_asked(recordings: dict[str, bytes]):
    read = {read_recording(io.BytesIO(recordings[kind]), **NEEDS.get(kind, {})).format for kind in MEANS}
    assert read == set(get_args(Format))


@pytest.mark.parametrize("kind", MEANS)
def test_a_statement_that_means_nothing_for_a_format_is_refused(recordings: dict[str, bytes], kind: str):
    needed = dict(NEEDS.get(kind, {}))
    assert read_recording(io.BytesIO(recordings[kind]), **needed).motions
    for name, said in STATEMENTS.items():
        how = {**needed, name: said}
        if name in MEANS[kind]:
            assert read_recording(io.BytesIO(recordings[kind]), **how).motions, name
            continue
        with pytest.raises((BadRecording, BadSettings)) as refused:
            read_recording(io.BytesIO(recordings[kind]), **how)
        assert WORDS.get(name, name) in str(refused.value)
