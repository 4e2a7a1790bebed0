"""Uploads of the client: in pieces, with length, digest and a content type detected from the content."""

import base64
import hashlib
import io
from pathlib import Path

import httpx2 as httpx
import pytest

from skills.client.blocking.client import Client
from skills.client.files import CHUNK_BYTES
from skills.errors import UnknownFormat, UnreadableRecording
from skills.formats import MEDIA_TYPES
from skills.formats.bag_writer import write_mcap
from tests.formats import bags, others, trials


class Heard(httpx.BaseTransport):
    """A service that accepts everything, and records the body and the sizes of its pieces."""

    def __init__(self) -> None:
        self.headers: dict[str, str] = {}
        self.pieces: list[int] = []
        self.body = b""

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        said = list(request.stream)
        self.headers, self.pieces, self.body = dict(request.headers), [len(piece) for piece in said], b"".join(said)
        return httpx.Response(201, json={})


class Incurious(Client):
    """A client that accepts any response."""

    def _read(self, kind, said):
        return said


@pytest.fixture
def heard():
    return Heard()


@pytest.fixture
def client(heard):
    return Incurious(httpx.Client(base_url="http://skills.local", transport=heard))


def test_a_large_file_is_sent_piece_by_piece_with_its_length_and_digest(client, heard, tmp_path: Path):
    data = b"t_s,x_m,y_m,z_m\n" + b"0,0,0,0\n" * 500_000
    path = tmp_path / "table.txt"
    path.write_bytes(data)
    told: list[tuple[int, int]] = []
    client.add_recording(path, progress=lambda *went: told.append(went))
    digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
    assert heard.headers["content-length"] == str(len(data))
    assert heard.headers["content-digest"] == f"sha-256=:{digest}:"
    assert "transfer-encoding" not in heard.headers
    assert heard.body == data
    assert max(heard.pieces) <= CHUNK_BYTES
    assert told == [(sum(heard.pieces[: n + 1]), len(data)) for n in range(len(heard.pieces))]


KINDS = {
    "application/vnd.mcap": write_mcap(bags.recording()),
    "application/zip": others.zipped({"bag.mcap": b""}),
    "text/csv": b"t_s,x_m,y_m,z_m\n0,0,0,0\n",
    "text/plain": trials.text(trials.kinematics(3)),
    "application/x-rosbag": b"#ROSBAG V2.0\n",
    "application/vnd.sqlite3": b"SQLite format 3\0",
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suffix", ["mcap", "csv", "txt", "anything"])
def test_the_content_says_what_it_is(client, heard, tmp_path: Path, kind: str, suffix: str):
    path = tmp_path / f"recording.{suffix}"
    path.write_bytes(KINDS[kind])
    for recording in (path, KINDS[kind]):
        client.add_demo(recording, surgeon="kestrel", suture="simple-running")
        assert heard.headers["content-type"] == kind
        assert heard.body == KINDS[kind]


def test_every_format_is_among_them():
    assert KINDS.keys() == MEDIA_TYPES.keys()


def test_what_is_no_recording_is_not_sent(client, heard):
    with pytest.raises(UnknownFormat):
        client.add_recording(b"hello")
    with pytest.raises(UnreadableRecording):
        client.add_recording(b"")
    assert heard.headers == {}


def test_a_media_type_that_is_given_is_believed(client, heard):
    client.add_recording(io.BytesIO(b"hello").getvalue(), media_type="text/csv")
    assert heard.headers["content-type"] == "text/csv"
