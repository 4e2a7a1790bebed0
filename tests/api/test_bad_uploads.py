"""Uploads that cannot be a demonstration: both routes refuse them with a message and leave no row in any table."""

import base64
import gzip
import hashlib
import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field

import httpx2 as httpx
import numpy as np
import pytest

from skills.formats import topics
from tests import backends
from tests.api.service import CSV, KESTREL, MCAP, Service, assert_problem, serving
from tests.formats import bags, trials
from tests.library import cases

TIP = cases.points_mm()
BAG = cases.bag()
CANARY = "Zaphod-42"
LIMIT = 200_000


@dataclass
class Bad:
    """An upload that must be refused: its content, and the status and kind of the refusal."""

    data: bytes
    status: int
    kind: str
    media_type: str = CSV
    query: dict[str, object] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    demos_only: bool = False


def zipped(name: str = "bag/bag.mcap") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, BAG)
    return out.getvalue()


def spoilt(value: str) -> bytes:
    lines = cases.hand_off().decode().split("\n")
    lines[20] = ",".join([*lines[20].split(",")[:3], value])
    return "\n".join(lines).encode()


def backwards() -> bytes:
    stamps = np.arange(len(TIP)) / 50.0
    stamps[30:] -= 0.3
    return cases.table(TIP, stamps_s=stamps)


def digest_of(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


JOY = [
    (bags.START_NS, "/console/clutch", topics.JOY, {"header": bags.header(bags.START_NS), "axes": [], "buttons": [0]})
]
TURNED = [bags.pose(bags.START_NS + k * bags.STEP_NS, 0.001 * k, frame="camera") for k in range(10, 20)]
TWO_FRAMES = bags.pose_bag([*bags.straight(10), *TURNED])
JIGSAWS = trials.text(trials.kinematics(60))
STILL = cases.table(np.array([-10.0, 55, -135]) + np.linspace(-1, 1, 16)[:, None])
CASES = {
    "empty": Bad(b"", 422, "unreadable-recording", MCAP),
    "an empty table": Bad(b"", 422, "unreadable-recording"),
    "only a header": Bad(b"t_s,x_m,y_m,z_m\n", 422, "unreadable-recording"),
    "no content type": Bad(BAG, 415, "unknown-format", ""),
    "json": Bad(b"{}", 415, "unknown-format", "application/json"),
    "a zip archive with no bag": Bad(zipped("notes.md"), 415, "unknown-format", "application/zip"),
    "a zip archive with a bag that is none": Bad(zipped("a.bag"), 422, "unreadable-recording", "application/zip"),
    "half a zip archive": Bad(zipped()[:300], 422, "unreadable-recording", "application/zip"),
    "a ROS 1 bag that is none": Bad(b"#ROSBAG V2.0\n", 422, "unreadable-recording", "application/x-rosbag"),
    "a .db3 bag that is none": Bad(
        b"SQLite format 3\0" + bytes(4000), 422, "unreadable-recording", "application/vnd.sqlite3"
    ),
    "JIGSAWS kinematics with a word in them": Bad(
        JIGSAWS.replace(b"0.4", CANARY.encode(), 1), 422, "unreadable-recording", "text/plain"
    ),
    "JIGSAWS kinematics as a table": Bad(JIGSAWS, 415, "unknown-format", CSV),
    "a rate for JIGSAWS": Bad(JIGSAWS, 422, "bad-settings", "text/plain", {"rate_hz": 30}),
    "a zip labelled as MCAP": Bad(zipped(), 415, "unknown-format", MCAP),
    "json labelled as MCAP": Bad(b'{"a": 1, "b": 2}', 415, "unknown-format", MCAP),
    "html labelled as MCAP": Bad(b"<html><p>Not found, sorry</p></html>", 415, "unknown-format", MCAP),
    "gzip labelled as MCAP": Bad(gzip.compress(BAG, mtime=0), 415, "unknown-format", MCAP),
    "gzip as an encoding": Bad(
        gzip.compress(BAG, mtime=0), 415, "unknown-format", MCAP, headers={"Content-Encoding": "gzip"}
    ),
    "a table labelled as MCAP": Bad(cases.hand_off(), 415, "unknown-format", MCAP),
    "MCAP labelled as a table": Bad(BAG, 415, "unknown-format", CSV),
    "plain text": Bad(b"hello", 415, "unknown-format", "text/plain"),
    "no usable topic": Bad(bags.bag(JOY), 422, "no-usable-topic", MCAP),
    "a table without a position": Bad(b"t_s,jaw_rad\n0,1\n1,2\n", 422, "no-usable-topic"),
    "two frames in one topic": Bad(
        TWO_FRAMES,
        422, "mixed-frames", MCAP,
    ),
    "backward stamps in a table": Bad(backwards(), 422, "backward-stamps"),
    "backward stamps in a bag": Bad(bags.pose_bag(bags.straight(20)[::-1]), 422, "backward-stamps", MCAP),
    "NaN": Bad(spoilt("nan"), 422, "not-finite"),
    "infinity": Bad(spoilt("-inf"), 422, "not-finite"),
    "a word for a number": Bad(spoilt(CANARY), 422, "unreadable-recording"),
    "too few cells": Bad(cases.hand_off() + b"9.0,1,2\n", 422, "unreadable-recording"),
    "an unknown column": Bad(cases.hand_off().replace(b"x_mm", b"X", 1), 422, "bad-columns"),
    "millimetres declared as metres": Bad(cases.table(TIP, unit="m"), 422, "not-metres"),
    "inches declared as metres": Bad(cases.table(TIP / 25.4, unit="m"), 422, "not-metres"),
    "metres declared as millimetres": Bad(cases.table(TIP / 1000), 422, "not-metres", demos_only=True),
    "inches twice": Bad(cases.table(TIP * 25.4), 422, "not-metres"),
    "a path that never leaves its goal": Bad(
        STILL, 422, "never-leaves-goal", demos_only=True
    ),
    "points outside the demanded grid": Bad(
        cases.hand_off((40.0, 0.0, 0.0)), 422, "outside-grid", query={"grid": "paper"}, demos_only=True
    ),
    "an unknown surgeon": Bad(BAG, 404, "not-found", MCAP, {"surgeon": "nobody"}, demos_only=True),
    "an unknown suture": Bad(BAG, 404, "not-found", MCAP, {"suture": "nothing"}, demos_only=True),
    "two arms and none named": Bad(cases.bag("PSM1", "PSM2"), 422, "segment-not-named", MCAP, demos_only=True),
    "an arm that is not there": Bad(BAG, 422, "no-usable-topic", MCAP, {"arm": "PSM3"}, demos_only=True),
    "a segment outside": Bad(BAG, 422, "bad-segment", MCAP, {"start_s": 0.1, "end_s": 100}, demos_only=True),
    "a segment turned round": Bad(BAG, 422, "bad-segment", MCAP, {"start_s": 0.9, "end_s": 0.2}, demos_only=True),
    "a segment of nothing": Bad(BAG, 422, "bad-segment", MCAP, {"start_s": 0.501, "end_s": 0.502}, demos_only=True),
    "a segment from NaN": Bad(BAG, 422, "invalid-request", MCAP, {"start_s": "nan"}, demos_only=True),
    "a cell of ours": Bad(BAG, 422, "bad-settings", MCAP, {"grid": "paper", "cell_mm": 2}, demos_only=True),
    "an infinite cell": Bad(BAG, 422, "invalid-request", MCAP, {"cell_mm": "inf"}, demos_only=True),
    "a negative hysteresis": Bad(BAG, 422, "invalid-request", MCAP, {"hysteresis": -0.1}, demos_only=True),
    "more than half a cell": Bad(BAG, 422, "invalid-request", MCAP, {"hysteresis": 0.6}, demos_only=True),
    "a hysteresis that is NaN": Bad(BAG, 422, "invalid-request", MCAP, {"hysteresis": "nan"}, demos_only=True),
    "a grid that there is not": Bad(BAG, 422, "invalid-request", MCAP, {"grid": CANARY}, demos_only=True),
    "no surgeon": Bad(BAG, 422, "invalid-request", MCAP, {"surgeon": None}, demos_only=True),
    "a rate that is NaN": Bad(cases.hand_off(), 422, "invalid-request", query={"rate_hz": "nan"}),
    "a rate that is zero": Bad(cases.hand_off(), 422, "invalid-request", query={"rate_hz": 0}),
    "a rate beside stamps": Bad(cases.hand_off(), 422, "bad-columns", query={"rate_hz": 50}),
    "an unknown field": Bad(cases.hand_off(), 422, "invalid-request", query={"rate": 50}),
    "another frame than the bag's": Bad(BAG, 422, "mixed-frames", MCAP, {"frame": "camera"}),
    "a digest of other bytes": Bad(BAG, 422, "unreadable-recording", MCAP, headers={"Content-Digest": digest_of(b"")}),
    "a digest that is none": Bad(BAG, 422, "bad-input", MCAP, headers={"Content-Digest": CANARY}),
    "a digest of another kind": Bad(BAG, 422, "bad-input", MCAP, headers={"Content-Digest": "md5=:AAAA:"}),
    "a bag without checksums": Bad(bags.pose_bag(bags.straight(), crcs=False), 422, "unreadable-recording", MCAP),
    "too large": Bad(b"t_s,x_m,y_m,z_m\n" + b"0,0,0,0\n" * LIMIT, 413, "*"),
}  # fmt: skip


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    url = backends.fresh("sqlite", tmp_path_factory.mktemp("bad"))
    with serving(url, max_upload_bytes=LIMIT) as service:
        service.client.put_surgeon("kestrel")
        yield service


def send(service: Service, path: str, bad: Bad) -> httpx.Response:
    asked = {**(KESTREL if path == "/demos" else {}), **bad.query}
    params = {name: value for name, value in asked.items() if value is not None}
    headers = {"Content-Type": bad.media_type} if bad.media_type else {}
    return service.http.post(path, params=params, content=bad.data, headers=headers | bad.headers)


@pytest.fixture
def untouched(service: Service) -> Iterator[None]:
    before = service.counts()
    yield
    assert service.counts() == before


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("path", ["/demos", "/recordings"])
def test_it_is_refused_in_words_and_leaves_no_row(service: Service, untouched: None, path: str, name: str):
    bad = CASES[name]
    if bad.demos_only and path == "/recordings":
        return
    answer = send(service, path, bad)
    assert_problem(answer, bad.status, None if bad.kind == "*" else bad.kind)
    assert CANARY not in answer.text


def test_a_bag_cut_at_any_of_30_places_is_refused(service: Service, untouched: None):
    for length in np.linspace(1, len(BAG) - 1, 30).astype(int).tolist():
        answer = send(service, "/demos", Bad(BAG[:length], 0, "", MCAP))
        assert_problem(answer, 422, "unreadable-recording")


def flipped(data: bytes, bit: int) -> bytes:
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


BITS = np.random.default_rng(1).integers(0, 8 * len(BAG), 50).tolist()


def test_50_flipped_bits_are_refused_or_change_nothing(tmp_path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.client.put_surgeon("kestrel")
        whole = send(service, "/demos", Bad(BAG, 0, "", MCAP)).json()
        accepted = 0
        for bit in BITS:
            answer = send(service, "/demos", Bad(flipped(BAG, bit), 0, "", MCAP))
            if answer.status_code == 201:
                accepted += 1
                one, other = (service.client.demo_path(demo["id"]) for demo in (whole, answer.json()))
                assert one["recorded_mm"] == other["recorded_mm"], bit
                assert one["stamps_s"] == other["stamps_s"], bit
            else:
                assert_problem(answer, range(400, 500))
        assert service.counts()["recordings"] == 1 + accepted


def test_with_a_content_digest_every_flipped_bit_is_refused(service: Service, untouched: None):
    for bit in BITS:
        bad = Bad(flipped(BAG, bit), 0, "", MCAP, headers={"Content-Digest": digest_of(BAG)})
        assert_problem(send(service, "/demos", bad), 422, "unreadable-recording")


def test_a_body_without_a_declared_length_is_stopped_at_the_limit(service: Service, untouched: None):
    sent = 0

    def pieces() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(1000):
            sent += 1
            yield b"0" * 10_000

    for path in ("/demos", "/recordings"):
        answer = service.http.post(
            path, params=KESTREL if path == "/demos" else {}, content=pieces(), headers={"Content-Type": CSV}
        )
        assert_problem(answer, 413)


def test_a_bag_without_checksums_is_taken_with_a_digest(tmp_path):
    bare = bags.pose_bag(bags.straight(), crcs=False)
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        answer = send(service, "/recordings", Bad(bare, 0, "", MCAP, headers={"Content-Digest": digest_of(bare)}))
        assert (answer.status_code, answer.json()["integrity"]) == (201, "full")


def test_a_bad_part_of_a_good_recording_is_refused_and_leaves_no_row(tmp_path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.client.put_surgeon("kestrel")
        recording = service.client.add_recording(BAG)["id"]
        before = service.counts()
        for more, status in (
            ({"start_s": 0.9, "end_s": 0.2}, 422),
            ({"end_s": 99}, 422),
            ({"arm": "PSM9"}, 422),
            ({"topic": "/no"}, 422),
            ({"surgeon": "nobody"}, 404),
            ({"suture": "nothing"}, 404),
            ({"grid": "paper", "cell_mm": 1}, 422),
            ({"hysteresis": 0.6}, 422),
            ({"colour": "red"}, 422),
        ):
            body = KESTREL | more
            assert_problem(service.http.post(f"/recordings/{recording}/demos", json=body), status)
        assert_problem(service.http.post(f"/recordings/{'0' * 64}/demos", json=KESTREL), 404, "not-found")
        assert service.counts() == before
