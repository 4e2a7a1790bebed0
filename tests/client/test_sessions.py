"""Sessions of both clients: with the real application on a real socket, and with a peer that misbehaves."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from socket import SHUT_RDWR
from typing import Any

import httpx2 as httpx
import numpy as np
import pytest
import uvicorn
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from examples import crtk_session
from examples.crtk_session import Measured
from skills.api.sessions import WITHDRAWN
from skills.client import AsyncClient, Client, NotReached, NotUnderstood, Problem, Retrying, SessionClosed
from skills.client.sessions import LOST
from skills.errors import BadInput, BadSettings
from skills.learning.tube_certificate import TubeCertificate, TubeLimits
from skills.library.people.keys import create_key
from skills.schemas.pose_styles import NextPose, SessionLimits, SessionOpening, SessionPose
from tests import backends
from tests.api import service as services
from tests.api.service import KESTREL, MCAP
from tests.client.test_crtk import StandInBus
from tests.library.test_pose_styles import turning
from tests.waiting import END_S, until

ONCE = Retrying(attempts=1)
START = ([-10.0, 55.0, -135.0], [0.5**0.5, 0.5**0.5, 0.0, 0.0])
TUBE = TubeCertificate(TubeLimits(), 1.0, 0.1, 1.0, 0.1, ticks=9, checked=1, faults=())
LIMITS = SessionLimits(rate_hz=100.0, burst=50.0, message_bytes=4096, idle_s=30.0, late_ms=10.0, stays_late_s=2.0)
OPENING = SessionOpening(
    version=1, sha256="0" * 64, arm="PSM2", frame="PSM2_base", phases=101, tick_s=0.05, tube=TUBE, limits=LIMITS
)
Follow = Callable[..., Any]


@contextmanager
def at_once(url: str, style: dict[str, str] = KESTREL, timeout_s: float = END_S, **how: Any) -> Iterator[Any]:
    """Yield a session of a `Client`, with `opening` and `next`."""
    with Client(url, retrying=ONCE, **how) as client, client.session(**style, timeout_s=timeout_s) as session:
        yield session


class Awaited:
    """A session of an `AsyncClient`, called as one of a `Client`."""

    def __init__(self, run: Callable[[Any], Any], session: Any) -> None:
        self.opening, self._run, self._session = session.opening, run, session

    def next(self, *args: Any, **kwargs: Any) -> SessionPose:
        found: SessionPose = self._run(self._session.next(*args, **kwargs))
        return found


@contextmanager
def awaited(url: str, style: dict[str, str] = KESTREL, timeout_s: float = END_S, **how: Any) -> Iterator[Any]:
    """Yield a session of an `AsyncClient`."""
    with asyncio.Runner() as loop:
        client = AsyncClient(url, retrying=ONCE, **how)
        session = client.session(**style, timeout_s=timeout_s)
        try:
            loop.run(session.__aenter__())
            try:
                yield Awaited(loop.run, session)
            finally:
                loop.run(session.__aexit__(None, None, None))
        finally:
            loop.run(client.aclose())


both = pytest.mark.parametrize("follow", [at_once, awaited])


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[services.Service, str]]:
    """Yield a service that serves a pose style on loopback, and its address."""
    url = backends.fresh("sqlite", tmp_path_factory.mktemp("sessions"))
    with services.serving(url) as trained:
        trained.client.put_surgeon("kestrel")
        trained.client.add_demo(turning(), media_type=MCAP, **KESTREL)
        assert trained.train(release=True)["result"]["released"]
    service = services.Service(url)
    server = uvicorn.Server(uvicorn.Config(service.app, port=0, log_level="critical", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run)
    thread.start()
    until(lambda: server.started)
    yield service, f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()
    backends.drop(url)


@both
def test_a_session_answers_as_the_call_for_one_pose(posed: tuple[services.Service, str], follow: Follow) -> None:
    _, url = posed
    pose, phase = START, None
    with Client(url) as client, follow(url) as session:
        style = client.pose_style(**KESTREL)
        opening = session.opening
        assert (opening.version, opening.sha256, opening.frame) == (style.version, style.sha256, style.frame)
        assert (opening.phases, opening.tick_s, opening.tube) == (len(style.position_mm), style.tick_s, style.tube)
        assert opening.limits.rate_hz == 100.0
        for _ in range(5):
            step = session.next(*pose)
            asked = client.next_pose(**KESTREL, position_mm=pose[0], rotation_xyzw=pose[1], phase=phase)
            assert step.newer_version is None
            same = set(SessionPose.model_fields) & set(NextPose.model_fields)
            assert {name: getattr(step, name) for name in same} == {name: getattr(asked, name) for name in same}
            pose, phase = (step.position_mm, step.rotation_xyzw), step.phase
        assert session.next(*pose, phase=50).phase == 50


@both
def test_a_pose_that_is_none_is_refused_and_the_session_stays(
    posed: tuple[services.Service, str], follow: Follow
) -> None:
    with follow(posed[1]) as session:
        for tip_mm, rotation_xyzw, said in (
            (START[0][:2], START[1], "position_mm"),
            (START[0], [0.0, 0.0, 0.0, 2.0], "unit quaternion"),
            ([0.0, 0.0, float("nan")], START[1], "finite"),
            ("abc", START[1], "finite"),
        ):
            with pytest.raises(BadInput, match=said):
                session.next(tip_mm, rotation_xyzw)
        assert session.next(*START).phase == 1


@both
def test_what_is_not_served_is_refused_with_its_problem(posed: tuple[services.Service, str], follow: Follow) -> None:
    _, url = posed
    with (
        pytest.raises(Problem, match="figure-of-eight") as refused,
        follow(url, KESTREL | {"suture": "figure-of-eight"}),
    ):
        pass
    assert (refused.value.status, refused.value.kind) == (404, "not-found")
    with pytest.raises(NotReached), follow("http://127.0.0.1:9"):
        pass
    with (
        pytest.raises(BadSettings, match="own connection"),
        Client(httpx.Client(base_url=url, timeout=END_S)) as client,
    ):
        client.session(**KESTREL).__enter__()


def test_the_crtk_example_follows_a_session_to_its_end(posed: tuple[services.Service, str]) -> None:
    with Client(posed[1]) as client:
        style = client.pose_style(**KESTREL)
        bus = StandInBus(Measured(style.position_mm[0], style.rotation_xyzw[0], style.frame, 0.0), tick_s=0.012)
        with client.session(**KESTREL) as session:  # which allows 100 poses a second
            assert crtk_session.follow(bus, session) == "finished"
    assert np.linalg.norm(np.subtract(bus.here.position_mm, style.position_mm[-1])) < 1.0
    assert len(bus.said) >= len(style.position_mm) - 1


@both
def test_a_withdrawal_closes_the_session_with_its_cause(posed: tuple[services.Service, str], follow: Follow) -> None:
    service, url = posed
    with service.database.writing() as session:
        _, key = create_key(session, "lab", "admin", "test")
    with Client(url, api_key=key) as client, follow(url, api_key=key) as session:
        session.next(*START)
        client.withdraw(**KESTREL)
        with pytest.raises(SessionClosed, match=r"The release was withdrawn\. Stop the arm") as closed:
            until(lambda: session.next(*START) is None)
        assert closed.value.code == WITHDRAWN
        with pytest.raises(SessionClosed, match="withdrawn"):  # and for ever
            session.next(*START)
        client.release(**KESTREL, version=1)


# ---- a peer that misbehaves ------------------------------------------------------------------------------------------


@contextmanager
def peer(answer: Callable[[ServerConnection], None], redirected: bool = False) -> Iterator[str]:
    """Yield the address of a WebSocket server that opens sessions, and answers by a function."""

    def handle(socket: ServerConnection) -> None:
        socket.send(OPENING.model_dump_json())
        answer(socket)

    def answered(_: ServerConnection, request: Request) -> Response | None:
        if not redirected or request.path == "/elsewhere":
            return None
        return Response(HTTPStatus.TEMPORARY_REDIRECT, "Moved", Headers({"Location": "/elsewhere"}), b"")

    server: Server = serve(handle, "127.0.0.1", 0, process_request=answered)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join()


def never(socket: ServerConnection) -> None:
    """Read poses until the client closes the session."""
    for _ in socket:
        pass


def garbage(socket: ServerConnection) -> None:
    """Answer with something else."""
    for _ in socket:
        socket.send("[1, 2]")


def cut(socket: ServerConnection) -> None:
    """End the connection at the first pose, without taking leave."""
    socket.recv()
    socket.socket.shutdown(SHUT_RDWR)


@both
def test_without_an_answer_in_time_the_session_closes_itself(follow: Follow) -> None:
    with peer(never) as url, follow(url, timeout_s=0.1) as session:
        with pytest.raises(SessionClosed, match=r"No answer within 0\.1 s.*Stop the arm"):
            session.next(*START)
        with pytest.raises(SessionClosed, match="not open"):
            session.next(*START)


@both
def test_a_lost_connection_and_a_strange_answer_are_named(follow: Follow) -> None:
    with peer(cut) as url, follow(url) as session, pytest.raises(SessionClosed, match="lost") as closed:
        session.next(*START)
    assert closed.value.code == LOST
    with peer(garbage) as url, follow(url) as session, pytest.raises(NotUnderstood, match="no JSON object"):
        session.next(*START)


@both
def test_a_redirect_is_not_followed(follow: Follow) -> None:
    with peer(never, redirected=True) as url, pytest.raises(Problem) as refused, follow(url, api_key="skills_a_b"):
        pass
    assert refused.value.status == 307


def test_after_a_cancelled_call_no_answer_is_taken_for_the_next_pose() -> None:
    async def cancelled(url: str) -> None:
        async with AsyncClient(url) as client, client.session(**KESTREL, timeout_s=END_S) as session:
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.05):
                    await session.next(*START)
            with pytest.raises(SessionClosed, match="was not read"):
                await session.next(*START)

    with peer(never) as url:
        asyncio.run(cancelled(url))
