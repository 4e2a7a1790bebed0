"""Reading of uploads in a separate process, and the messages for exceeded limits."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import numpy as np
import pytest

from skills.errors import Busy
from skills.library.recordings.recordings import check_digest
from tests import backends
from tests.api.service import CSV, KESTREL, MCAP, assert_problem, serving
from tests.library import cases
from tests.waiting import END_S, alive, until

BAG = cases.bag()
AT_ONCE = 50
ALL = range(AT_ONCE)


@pytest.mark.parametrize(
    ("settings", "cause", "words"),
    [
        ({"reading_answer_bytes": 1000}, "too much", "cut the recording into parts"),
        ({"reading_file_bytes": 1000}, "too much", "cut the recording into parts"),
        ({"reading_memory_bytes": 1 << 20}, "out of memory", "needed more than its"),
        ({"reading_wall_s": 0.001}, "hung", "did not finish within 0.001 s"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_a_recording_over_a_limit_of_the_settings_is_refused_in_words(tmp_path, settings, cause, words):
    with serving(backends.fresh("sqlite", tmp_path), **settings) as service:
        before = service.counts()
        # Memory that the imports have left free is enough for a short recording.
        sent = cases.bag(tip=np.resize(cases.points_mm(), (50_000, 3))) if cause == "out of memory" else BAG
        answer = service.http.post("/recordings", content=sent, headers={"Content-Type": MCAP})
        problem = assert_problem(answer, 422, "unreadable-recording")
        assert problem["numbers"] == {"cause": cause}
        assert words in problem["detail"]
        assert service.counts() == before


@pytest.mark.nightly  # four servers; by day tests/e2e kills one
def test_files_are_read_in_another_process_and_a_killed_one_is_replaced(own_fork_server, tmp_path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.client.put_surgeon("kestrel")
        server = service.app.state.reader.server
        pids = [server.pid]
        for ask in (
            lambda: service.client.add_recording(BAG),
            lambda: service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL),
            lambda: service.client.cut_demo(service.client.add_recording(BAG)["id"], **KESTREL),
        ):
            os.kill(pids[-1], signal.SIGKILL)
            assert ask()["id"]
            pids.append(server.pid)
        assert len(set(pids)) == 4
    assert not any(map(alive, pids))


def test_what_is_told_of_a_recording_is_found_out_where_it_is_read(tmp_path, monkeypatch):
    """Neither an upload nor a cut searches for hand-offs in the process that answers requests."""
    looked: list[str] = []

    def look(*_: object) -> None:
        looked.append(threading.current_thread().name)
        raise AssertionError

    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.client.put_surgeon("kestrel")
        monkeypatch.setattr("skills.demonstration.segments.movement_of", look)
        recording = service.client.add_recording(BAG)
        assert recording["segments"]
        assert service.client.cut_demo(recording["id"], **KESTREL)["segment"]["taken"] == "proposal 1 of 1"
        service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    assert looked == []


def test_a_service_that_stops_is_busy(own_fork_server, tmp_path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.app.state.reader.server.close()
        answer = service.http.post("/recordings", content=BAG, headers={"Content-Type": MCAP})
        assert_problem(answer, 503, "busy")
        assert answer.headers["retry-after"]


@pytest.mark.parametrize("sent", [BAG, BAG[:-9]], ids=["sound", "damaged"])
@pytest.mark.parametrize("path", ["/recordings", "/recordings/preview"])
def test_equal_bytes_that_arrive_at_once_wait_for_one_reading(tmp_path, monkeypatch, path, sent):
    arrived, read = [], []

    def arrives(header: str | None, of_bytes: str) -> bool:
        arrived.append(of_bytes)
        return check_digest(header, of_bytes)

    monkeypatch.setattr("skills.api.uploads.check_digest", arrives)
    with serving(backends.fresh("sqlite", tmp_path)) as service, ThreadPoolExecutor(AT_ONCE) as clients:
        server = service.app.state.reader.server

        def call(*asked: Any, **how: Any) -> Any:
            read.append(asked)
            until(lambda: len(arrived) >= AT_ONCE)
            return shared(*asked, **how)

        shared = server.call
        monkeypatch.setattr(server, "call", call)
        asked = [clients.submit(service.http.post, path, content=sent, headers={"Content-Type": MCAP}) for _ in ALL]
        answers = [one.result() for one in asked]
        assert len(read) == 1
        if sent == BAG:
            assert sorted({one.status_code for one in answers}) == ([200] if "preview" in path else [200, 201])
            assert len({one.json()["sha256"] for one in answers}) == 1
        else:
            assert {one.status_code for one in answers} == {422}
            assert len({one.json()["detail"] for one in answers}) == 1
        # Nothing is shared with later uploads: the answer is not kept.
        service.http.post(path, content=sent, headers={"Content-Type": MCAP})
        assert len(read) == 2


def test_the_next_of_equal_uploads_reads_where_the_first_was_not_read(tmp_path, monkeypatch):
    arrived, refused = Event(), []
    with serving(backends.fresh("sqlite", tmp_path)) as service, ThreadPoolExecutor(2) as clients:
        server = service.app.state.reader.server

        def call(*asked: Any, **how: Any) -> Any:
            if not refused:
                refused.append(asked)
                arrived.wait(END_S)
                raise Busy("No process is available.")
            return shared(*asked, **how)

        def arrives(header: str | None, of_bytes: str) -> bool:
            if refused:
                arrived.set()
            return check_digest(header, of_bytes)

        shared = server.call
        monkeypatch.setattr(server, "call", call)
        monkeypatch.setattr("skills.api.uploads.check_digest", arrives)
        first = clients.submit(service.http.post, "/recordings", content=BAG, headers={"Content-Type": MCAP})
        until(lambda: refused)
        second = clients.submit(service.http.post, "/recordings", content=BAG, headers={"Content-Type": MCAP})
        assert_problem(first.result(), 503, "busy")
        assert second.result().status_code == 201
