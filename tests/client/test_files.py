"""Downloads: complete and matching their digest, or not stored. Uploads: connections that break."""

import hashlib
import os
import threading
from pathlib import Path

import httpx2 as httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.client import Problem
from skills.client.files import CHUNK_BYTES
from skills.client.problems import NotReached
from skills.errors import Corrupt
from tests.client.peers import BOTH, Script, Time, answer, refusal

both = pytest.mark.parametrize("made", BOTH)
BAG = os.urandom(3 * CHUNK_BYTES + 17)
CUT = httpx.RemoteProtocolError("peer closed connection without sending complete message body")


def named(content: bytes, sent: bytes | None = None, weak: bool = False) -> httpx.Response:
    etag = f'{"W/" * weak}"{hashlib.sha256(content).hexdigest()}"'
    return httpx.Response(200, content=content if sent is None else sent, headers={"etag": etag})


@both
@pytest.mark.parametrize("weak", [False, True])
def test_a_download_reports_progress_and_matches_the_digest_in_its_etag(made, weak, tmp_path: Path):
    told: list[tuple[int, int]] = []
    to = tmp_path / "bag.zip"
    got = made(Script(named(BAG, weak=weak)), Time())(
        "save_replay_bag", "p" * 64, to, progress=lambda *n: told.append(n)
    )
    assert (got, to.read_bytes()) == (to, BAG)
    assert told[-1] == (len(BAG), len(BAG)) and len(told) >= 4
    assert [went for went, _ in told] == sorted(went for went, _ in told)
    assert os.listdir(tmp_path) == ["bag.zip"]


@both
def test_what_is_not_what_was_named_leaves_nothing_and_spoils_nothing(made, tmp_path: Path):
    to = tmp_path / "bag.zip"
    to.write_bytes(b"an older one")
    for wrong in (
        named(BAG, BAG[:-1]),
        named(BAG, BAG + b"!"),
        named(BAG, b""),
        httpx.Response(200, content=BAG),
        httpx.Response(200, content=BAG, headers={"etag": '"abc"'}),
    ):
        with pytest.raises(Corrupt):
            made(Script(wrong), Time())("save_replay_bag", "p" * 64, to)
        with pytest.raises(Corrupt):
            made(Script(wrong), Time())("picture", "p" * 64)
    assert (to.read_bytes(), os.listdir(tmp_path)) == (b"an older one", ["bag.zip"])


@both
def test_a_line_that_breaks_on_the_way_is_no_loss(made, tmp_path: Path):
    to = tmp_path / "bag.zip"
    assert made(Script(CUT, refusal(429), named(BAG)), Time())("save_replay_bag", "p" * 64, to).read_bytes() == BAG
    for never in (Script(CUT), Script(refusal(409))):
        with pytest.raises((NotReached, Problem)):
            made(never, Time())("save_replay_bag", "p" * 64, tmp_path / "never.zip")
    assert os.listdir(tmp_path) == ["bag.zip"]


@given(data=st.binary(min_size=1, max_size=300), bit=st.integers(0))
def test_no_flipped_bit_is_kept(data: bytes, bit: int):
    flipped = bytearray(data)
    flipped[bit // 8 % len(data)] ^= 1 << bit % 8
    with pytest.raises(Corrupt):
        BOTH[0](Script(named(data, bytes(flipped))), Time())("picture", "p" * 64)
    assert BOTH[0](Script(named(data)), Time())("picture", "p" * 64) == data


@both
def test_an_upload_whose_line_breaks_is_sent_again_from_its_beginning(made, tmp_path: Path):
    data = b"t_s,x_m,y_m,z_m\n" + b"0,0,0,0\n" * 300_000
    file = tmp_path / "table.csv"
    file.write_bytes(data)
    script, told = Script(CUT, refusal(503, **{"retry-after": "1"}), refusal(413)), []
    with pytest.raises(Problem) as refused:
        made(script, Time())("add_recording", file, progress=lambda *n: told.append(n))
    assert refused.value.status == 413
    assert script.bodies == [data] * 3
    assert {one.headers["content-digest"] for one in script.asked} == {script.asked[0].headers["content-digest"]}
    once = [(went, len(data)) for went in (CHUNK_BYTES, 2 * CHUNK_BYTES, len(data))]
    assert told == once * 3


@both
def test_a_file_that_is_not_there_is_told_before_anything_is_sent(made, tmp_path: Path):
    script = Script(answer())
    with pytest.raises(FileNotFoundError):
        made(script, Time())("add_recording", tmp_path / "nothing.mcap")
    assert script.asked == []


def test_an_async_upload_reports_progress_in_the_calling_thread(tmp_path: Path):
    file, where = tmp_path / "table.csv", set()
    file.write_bytes(b"t_s,x_m,y_m,z_m\n" + b"0,0,0,0\n" * 300_000)
    for made in BOTH:
        with pytest.raises(Problem):
            made(Script(refusal(413)), Time())(
                "add_recording", file, progress=lambda *_: where.add(threading.get_ident())
            )
    assert where == {threading.get_ident()}


@both
def test_a_download_has_the_modes_of_the_umask_and_never_changes_it(made, tmp_path: Path, monkeypatch):
    """Before, the umask was 0 for a moment: files that other threads made meanwhile could be written by everyone."""
    monkeypatch.setattr("os.umask", lambda _: pytest.fail("the umask is of all threads"))
    plain = tmp_path / "plain"
    plain.touch()
    to = made(Script(named(BAG)), Time())("save_replay_bag", "p" * 64, tmp_path / "bag.zip")
    assert to.stat().st_mode == plain.stat().st_mode
