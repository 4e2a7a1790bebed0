"""Calls of jobs, keys, the readiness check and the signed history."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing
from datetime import datetime
from typing import TYPE_CHECKING, Literal

import httpx2 as httpx

from skills import schemas
from skills.client.connection import Connection, parse_text
from skills.client.problems import JobFailed, JobTakesLonger, NotReached, NotUnderstood, Problem

if TYPE_CHECKING:
    from skills.schemas.operation import Job
    from skills.schemas.people import Key, NewKey
    from skills.schemas.responses import Ready, ServedAt, SignedCheckpoint

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Kind = Literal["training", "retraining", "playback", "pictures", "dataset", "try"]

ENDED = ("succeeded", "failed", "cancelled")
PAUSES_S = (0.05, 0.5)  # between two polls of a job: the first pause, and the longest
EVENTS = "text/event-stream"


class Operation(Connection):
    """Calls of jobs, keys and the history."""

    async def job(self, job: str) -> Job:
        """Return a job."""
        return await self._get(schemas.operation.Job, "/jobs/{job}", job=job)

    async def jobs(self, state: State | None = None, kind: Kind | None = None) -> list[Job]:
        """List jobs, the newest first."""
        return await self._all(schemas.operation.Job, "/jobs", state=state, kind=kind)

    async def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return await self._ask(schemas.operation.Job, "DELETE", "/jobs/{job}", job=job)

    async def wait(
        self,
        job: Job | str,
        timeout_s: float = 600.0,
        progress: Callable[[Job], None] | None = None,
    ) -> Job:
        """Wait until a job has ended, and return it.

        Changes are received as server-sent events; if the stream fails, the job is polled instead.

        Args:
            job: The job, or its id.
            timeout_s: Longest time to wait.
            progress: Called with the job at each change.

        Raises:
            JobTakesLonger: It has not ended in time.
            JobFailed: It failed or was cancelled.
            NotReached: At the end of that time the service did not answer.
        """
        deadline_s = self._clock() + timeout_s
        last: Job | None = None
        async with aclosing(self._states(job if isinstance(job, str) else job.id, deadline_s)) as states:
            async for seen in states:
                if progress is not None and seen != last:
                    progress(seen)
                last = seen
                if seen.state == "succeeded":
                    return seen
                if seen.state in ENDED:
                    raise JobFailed(seen)
        assert last is not None
        raise JobTakesLonger(last, timeout_s)

    async def _states(self, job: str, deadline_s: float) -> AsyncGenerator[Job, None]:
        """Yield the state of a job now, and again whenever it may have changed, until the deadline."""
        yield await self.job(job)
        streams, pause_s, down = self._streams, PAUSES_S[0], None
        while True:
            left_s = deadline_s - self._clock()
            if left_s <= 0:
                if down is not None:
                    raise down
                return
            if streams:
                try:
                    async with aclosing(self._events(job, left_s)) as events:
                        async for seen in events:
                            yield seen
                except httpx.ReadTimeout:
                    pass  # no event within the timeout
                except (Problem, NotUnderstood, ValueError, httpx.TransportError):
                    streams = False
            await self._sleep(min(pause_s, max(0.0, deadline_s - self._clock())))
            pause_s = min(PAUSES_S[1], pause_s * 1.3)
            try:
                seen, down = await self.job(job), None
            except NotReached as error:  # it answered before, so it is restarting, and the job goes on
                down = error
            else:
                yield seen

    async def _events(self, job: str, left_s: float) -> AsyncGenerator[Job, None]:
        """Yield the job of each server-sent event, until the stream or the time ends."""
        over_s = self._clock() + left_s
        patience_s = min(self._timeout_s, left_s)
        async with self._opened("GET", f"/jobs/{job}/events", timeout_s=patience_s) as answer:
            if not answer.headers.get("content-type", "").startswith(EVENTS):
                return
            async for line in answer.aiter_lines():
                if line.startswith("data:"):  # the service writes each event's data on one line
                    yield parse_text(schemas.operation.Job, line.removeprefix("data:"))
                if self._clock() >= over_s:  # heartbeats may continue for ever
                    return

    async def keys(self) -> list[Key]:
        """List all keys, including those that were revoked or have expired."""
        return await self._all(schemas.people.Key, "/keys")

    async def make_key(
        self,
        owner: str,
        role: Literal["reader", "uploader", "trainer", "releaser", "admin"] = "reader",
        *,
        expires_at: datetime | None = None,
        surgeons: Sequence[str] | None = None,
    ) -> NewKey:
        """Create a key; its `secret` is in this response only.

        The request is not retried after a lost connection, because that could create two keys.

        Args:
            owner: The owner's name.
            role: The role; each may do everything that those before it may.
            expires_at: When the key expires, with a time zone; default: never.
            surgeons: Pseudonyms of the surgeons to whose data the key is restricted; default: no restriction.
        """
        until = None if expires_at is None else expires_at.isoformat()
        body = {"owner": owner, "role": role, "expires_at": until, "surgeons": surgeons}
        return await self._ask(schemas.people.NewKey, "POST", "/keys", body, idempotent=False)

    async def revoke_key(self, key: str) -> Key:
        """Revoke a key permanently; `key` is its id, the eight characters after "skills_"."""
        return await self._ask(schemas.people.Key, "DELETE", "/keys/{key}", key=key)

    async def ready(self) -> Ready:
        """Check whether the service can work; while it starts, the request is retried as for every busy response."""
        return await self._get(schemas.responses.Ready, "/readyz")

    async def served_at(self, surgeon: str, suture: str, moment: datetime) -> ServedAt:
        """Return the version of a style that was served at a moment, with proofs that need no trust in the service.

        Args:
            surgeon: The surgeon.
            suture: The suture type.
            moment: The moment, with a time zone.
        """
        return await self._get(
            schemas.responses.ServedAt, "/history", surgeon=surgeon, suture=suture, at=moment.isoformat()
        )

    async def checkpoint(self) -> SignedCheckpoint:
        """Return the newest signed checkpoint of the history, to be kept elsewhere."""
        return await self._get(schemas.responses.SignedCheckpoint, "/history/checkpoint")
