"""Reading of uploads in a separate process, and the messages for exceeded limits."""

import os
import signal
import threading

import numpy as np
import pytest

from tests import backends
from tests.api.service import CSV, KESTREL, MCAP, assert_problem, serving
from tests.library import cases
from tests.waiting import alive

BAG = cases.bag()


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
