"""Waiting for a job: by the service's events, by polling if events do not arrive, and never for ever."""

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx2 as httpx
import pytest

from skills.client import AsyncClient, Client, JobFailed, JobTakesLonger, NotReached, Problem, Retrying
from skills.schemas.operation import Job
from tests.client.peers import BOTH, Script, Time, answer, refusal
from tests.waiting import END_S, crowded

ID = "0123456789abcdef"
AGAIN = Retrying(attempts=2, first_s=0.01)


def job(state: str, progress: float = 0.0, **more: Any) -> dict[str, Any]:
    ended = {"result": {"released": True} if state == "succeeded" else None, "error": None}
    moments = {"created_at": "2026-01-02T03:04:05Z", "started_at": None, "ended_at": None}
    return {
        "id": ID,
        "kind": "training",
        "state": state,
        "progress": progress,
        "request": {},
        **ended,
        **moments,
    } | more


RUNNING, HALF, DONE = job("running"), job("running", 0.5), job("succeeded", 1.0)


def event(said: dict[str, Any]) -> bytes:
    return b"event: job\ndata: " + json.dumps(said).encode() + b"\n\n"


class Talker:
    """A real server on loopback with a scripted job and scripted events."""

    def __init__(self) -> None:
        self.now = RUNNING
        self.asked: list[str] = []
        self.tell: Callable[[Callable[[bytes], None]], None] = lambda say: None
        talker = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                talker.asked.append(self.path)
                events = self.path.endswith("/events")
                self.send_response(200)
                self.send_header("Content-Type", "text/event-stream" if events else "application/json")
                if events:
                    self.end_headers()
                    with suppress(OSError):  # the listener has gone
                        talker.tell(self.wfile.write)
                    return
                body = json.dumps(talker.now).encode()
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture
def talker() -> Iterator[Talker]:
    talker = Talker()
    thread = threading.Thread(target=talker.server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield talker
    talker.server.shutdown()
    thread.join()
    talker.server.server_close()


def wait_now(url: str, *args: Any, **kwargs: Any) -> Job:
    with Client(url, retrying=AGAIN) as client:
        return client.wait(ID, *args, **kwargs)


def wait_later(url: str, *args: Any, **kwargs: Any) -> Job:
    async def wait() -> Job:
        async with AsyncClient(url, retrying=AGAIN) as client:
            return await client.wait(ID, *args, **kwargs)

    return asyncio.run(wait())


either = pytest.mark.parametrize("wait", [wait_now, wait_later])


@either
def test_every_change_is_told_once_as_it_comes(talker: Talker, wait):
    told: list[float] = []
    half = threading.Event()

    def hear(seen: Job) -> None:
        told.append(seen.progress)
        if seen.progress == HALF["progress"]:
            half.set()

    def tell(say: Callable[[bytes], None]) -> None:
        say(event(RUNNING))
        say(b": a sign of life\n\n")
        say(event(HALF))
        assert half.wait(END_S), "the next is not sent before this was heard"
        say(event(DONE))

    talker.tell = tell
    done = wait(talker.url, progress=hear)
    assert (done.result, told) == ({"released": True}, [0.0, 0.5, 1.0])
    assert talker.asked == [f"/jobs/{ID}", f"/jobs/{ID}/events"]


@either
@pytest.mark.parametrize("strange", [b"<h1>Welcome</h1>", b"data: {]\n\n", event({"id": 1}), b""])
def test_where_events_do_not_come_through_it_asks(talker: Talker, wait, strange):
    def tell(say: Callable[[bytes], None]) -> None:
        talker.now = DONE
        say(strange)

    talker.tell = tell
    assert wait(talker.url).state == "succeeded"
    assert talker.asked == [f"/jobs/{ID}", f"/jobs/{ID}/events", f"/jobs/{ID}"]


@either
def test_signs_of_life_do_not_keep_it_beyond_its_time(talker: Talker, wait):
    def tell(say: Callable[[bytes], None]) -> None:
        while True:
            say(b": still here\n\n")
            time.sleep(0.02)

    talker.tell = tell
    began = time.monotonic()
    with pytest.raises(JobTakesLonger, match=r"still running after 0\.5 s; wait again") as late:
        wait(talker.url, timeout_s=0.5)
    assert late.value.job.state == "running"
    assert time.monotonic() - began < 30 * crowded()


@either
def test_a_silent_service_does_not_keep_it_either(talker: Talker, wait):
    over = threading.Event()
    talker.tell = lambda say: over.wait(60)
    with pytest.raises(JobTakesLonger):
        wait(talker.url, timeout_s=0.3)
    over.set()


@either
def test_what_ended_badly_is_raised_with_its_reason(talker: Talker, wait):
    talker.tell = lambda say: say(event(job("failed", error="It cannot be learnt.")))
    with pytest.raises(JobFailed, match="The training failed: It cannot be learnt") as failed:
        wait(talker.url)
    assert failed.value.job.error == "It cannot be learnt."


@pytest.mark.parametrize("made", BOTH)
def test_a_service_within_the_process_is_asked_at_growing_intervals(made):
    script, passing = Script(*[answer(RUNNING)] * 20, answer(DONE)), Time()
    assert made(script, passing)("wait", ID).state == "succeeded"
    assert {one.url.path for one in script.asked} == {f"/jobs/{ID}"}
    assert passing.slept == sorted(passing.slept) and passing.slept[-1] == 0.5
    with pytest.raises(JobTakesLonger):
        made(Script(answer(RUNNING)), passing := Time())("wait", ID, timeout_s=20)
    assert passing.now_s == pytest.approx(20)


@pytest.mark.parametrize("made", BOTH)
def test_a_service_that_is_started_anew_meanwhile_is_waited_for(made):
    gone = httpx.ConnectError("refused")
    script = Script(answer(RUNNING), *[gone] * 12, answer(HALF), refusal(503, **{"retry-after": "1"}), answer(DONE))
    assert made(script, Time())("wait", ID).state == "succeeded"


@pytest.mark.parametrize("made", BOTH)
def test_a_service_that_stays_away_is_not_said_to_work_on(made):
    script = Script(answer(RUNNING), *[httpx.ConnectError("refused")] * 2000)
    with pytest.raises(NotReached):
        made(script, Time())("wait", ID, timeout_s=5.0)


@pytest.mark.parametrize("made", BOTH)
def test_a_job_that_there_is_not_is_no_reason_to_wait(made):
    for refused, error in ((refusal(404), Problem), (httpx.ConnectError("refused"), NotReached)):
        with pytest.raises(error):
            made(Script(refused), Time())("wait", ID)
