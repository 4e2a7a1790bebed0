"""Uploads are read in a process of their own: what it may not have, the caller is told in words."""

import os
import signal

import pytest

from tests import backends
from tests.api.service import CSV, KESTREL, MCAP, assert_problem, serving
from tests.library import cases
from tests.sim.test_confined import alive

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
        answer = service.http.post("/recordings", content=BAG, headers={"Content-Type": MCAP})
        problem = assert_problem(answer, 422, "unreadable-recording")
        assert problem["numbers"] == {"cause": cause}
        assert words in problem["detail"]
        assert service.counts() == before


def test_both_doors_and_stored_recordings_are_read_apart_and_a_killed_server_is_replaced(tmp_path):
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


def test_a_service_that_stops_is_busy(tmp_path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.app.state.reader.server.close()
        answer = service.http.post("/recordings", content=BAG, headers={"Content-Type": MCAP})
        assert_problem(answer, 503, "busy")
        assert answer.headers["retry-after"]
