"""Stand-ins for the client's environment: a scripted service, and a clock that advances only on sleep."""

import asyncio
import json
from collections.abc import Callable, Sequence
from typing import Any

import httpx2 as httpx

from skills.client.blocking.client import Client
from skills.client.client import AsyncClient
from skills.client.retrying import Retrying
from skills.client.verifying import rebuild_policy
from skills.learning.policy import Policy

ADDRESS = "http://127.0.0.1:9"
SURGEON = {
    **{"surgeon": "kestrel", "skill_level": "expert", "handedness": None, "protocol": None, "consent": None},
    "created_at": "2026-01-02T03:04:05Z",
}


def rebuilt(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> Policy:
    """Return a policy as the client rebuilds and verifies it, from the JSON of the service."""
    return rebuild_policy(json.dumps(about).encode(), arrays, json.dumps(demo).encode())


Outcome = httpx.Response | Exception


class Script(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """A service with scripted responses, the last of which repeats for ever; it records its requests."""

    def __init__(self, *outcomes: Outcome) -> None:
        self.outcomes = list(outcomes)
        self.asked: list[httpx.Request] = []
        self.bodies: list[bytes] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.bodies.append(request.read())
        return self._next(request)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.bodies.append(await request.aread())
        return self._next(request)

    def _next(self, request: httpx.Request) -> httpx.Response:
        self.asked.append(request)
        outcome = self.outcomes.pop(0) if len(self.outcomes) > 1 else self.outcomes[0]
        if isinstance(outcome, Exception):
            raise outcome
        return httpx.Response(outcome.status_code, headers=outcome.headers, content=outcome.content)


class Time:
    """A clock that advances only when the client sleeps or a script lets time pass."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.slept: list[float] = []

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_s += seconds

    async def sleep_later(self, seconds: float) -> None:
        self.sleep(seconds)


Asked = Callable[..., Any]


def at_once(script: Script, time: Time, **how: Any) -> Asked:
    """Return a function that calls a `Client` of a script: the name of a method and its arguments."""

    def ask(name: str, /, *args: Any, **kwargs: Any) -> Any:
        with Client(httpx.Client(base_url=ADDRESS, transport=script), clock=time.clock, sleep=time.sleep, **how) as one:
            return getattr(one, name)(*args, **kwargs)

    return ask


def awaited(script: Script, time: Time, **how: Any) -> Asked:
    """Return a function that calls an `AsyncClient` in the same way."""

    async def ask(name: str, /, *args: Any, **kwargs: Any) -> Any:
        http = httpx.AsyncClient(base_url=ADDRESS, transport=script)
        async with AsyncClient(http, clock=time.clock, sleep=time.sleep_later, **how) as one:
            return await getattr(one, name)(*args, **kwargs)

    return lambda *args, **kwargs: asyncio.run(ask(*args, **kwargs))


BOTH = [at_once, awaited]


def answer(body: Any = SURGEON, status: int = 200, **headers: str) -> httpx.Response:
    return httpx.Response(status, json=body, headers=headers)


def refusal(status: int, **headers: str) -> httpx.Response:
    body = {"type": "urn:suture-skills:busy", "title": "Busy", "status": status, "detail": "Try again in a moment."}
    return httpx.Response(status, json=body, headers={"content-type": "application/problem+json"} | headers)


def asked(script: Script) -> Sequence[str]:
    return [f"{one.method} {one.url.raw_path.decode()}" for one in script.asked]


PATIENT = Retrying()
