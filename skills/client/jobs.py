"""Calls of trainings, retrainings, and jobs of every kind."""

import json
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing, suppress
from typing import Any, Literal

import httpx2 as httpx

from skills.client.connection import Connection, at, call, given
from skills.client.problems import JobFailed, JobTakesLonger, NotReached, NotUnderstood, Problem
from skills.schemas.given import Job, RetrainedStyle, Retraining

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Kind = Literal["training", "retraining", "playback", "pictures"]
Combining = Literal["medoid", "barycentre", "corridor"]
Watcher = Callable[[Job], None]

ENDED = ("succeeded", "failed", "cancelled")
PAUSES_S = (0.05, 0.5)  # between two polls of a job: the first pause, and the longest
EVENTS = "text/event-stream"


class Jobs(Connection):
    """Calls of trainings and jobs."""

    @call
    async def train(
        self,
        surgeon: str,
        suture: str,
        *,
        demos: Sequence[str] | None = None,
        combine: Combining | None = None,
        learner: Mapping[str, Any] | None = None,
        seed: int = 0,
        release: bool = False,
    ) -> Job:
        """Request the training of a style; an equal request returns the same job.

        The job's `did` states the effect of the request. With `release`, the request is not retried after a lost
        connection, because somebody may have decided otherwise in between.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            demos: Digests of the demonstrations to learn from; default: the newest active one.
            combine: Method that combines several demonstrations into one path; default: a corridor.
            learner: Its `kind` and settings; default: Q-learning in the phase state.
            seed: Seed of the exploration.
            release: Release the version if it passes the gate; also if an equal training is done already and its
                version is
                not the one that the style serves now.
        """
        asked = {"surgeon": surgeon, "suture": suture, "seed": seed, "release": release}
        how = None if combine is None else {"kind": combine}
        asked |= given({"demos": demos, "combine": how, "learner": learner})
        return await self._ask(Job, "POST", at("trainings"), asked, harmless=not release)

    @call
    async def retrain(
        self,
        *,
        surgeon: str | None = None,
        suture: str | None = None,
        only_stale: bool = False,
        learner: Mapping[str, Any] | None = None,
        release: bool = False,
    ) -> Job:
        """Request the training of styles again, as one job: all, or those of a surgeon or of a suture type.

        With `release`, the request is not retried after a lost connection, as with `train`.
        """
        asked = {"surgeon": surgeon, "suture": suture, "only_stale": only_stale, "learner": learner, "release": release}
        return await self._ask(Job, "POST", at("retrainings"), given(asked), harmless=not release)

    @call
    async def retraining(self, job: str) -> Retraining:
        """Return a batch: its job, and in `styles` the number of styles in each state."""
        return await self._get(Retraining, at("retrainings", job), limit=1)

    @call
    async def retrained(
        self, job: str, state: Literal["queued", "done", "failed", "cancelled"] | None = None
    ) -> list[RetrainedStyle]:
        """List the styles of a batch, all or those of one state."""
        return await self._all(RetrainedStyle, at("retrainings", job), state=state)

    @call
    async def job(self, job: str) -> Job:
        """Return a job."""
        return await self._get(Job, at("jobs", job))

    @call
    async def jobs(self, state: State | None = None, kind: Kind | None = None) -> list[Job]:
        """List jobs, the newest first."""
        return await self._all(Job, at("jobs"), state=state, kind=kind)

    @call
    async def cancel(self, job: str) -> Job:
        """Cancel a job."""
        return await self._ask(Job, "DELETE", at("jobs", job))

    @call
    async def wait(self, job: Job | str, timeout_s: float = 600.0, progress: Watcher | None = None) -> Job:
        """Wait until a job has ended, and return it.

        Changes are received as server-sent events; if the stream fails, the job is polled instead.

        Args:
            job: The job, or its id.
            timeout_s: Longest time to wait.
            progress: Called with the job at each change.

        Raises:
            JobTakesLonger: It has not ended in time.
            JobFailed: It failed or was cancelled.
        """
        deadline_s = self._clock() + timeout_s
        told: Job | None = None
        async with aclosing(self._seen(job if isinstance(job, str) else job.id, deadline_s)) as looks:
            async for seen in looks:
                if progress is not None and seen != told:
                    progress(seen)
                told = seen
                if seen.state == "succeeded":
                    return seen
                if seen.state in ENDED:
                    raise JobFailed(seen)
        assert told is not None
        raise JobTakesLonger(told, timeout_s)

    async def _seen(self, job: str, deadline_s: float) -> AsyncGenerator[Job, None]:
        """Yield the state of a job now, and again whenever it may have changed, until the deadline."""
        yield await self._get(Job, at("jobs", job))
        streams, pause_s = self._streams, PAUSES_S[0]
        while True:
            left_s = deadline_s - self._clock()
            if left_s <= 0:
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
            await self._transport.sleep(min(pause_s, max(0.0, deadline_s - self._clock())))
            pause_s = min(PAUSES_S[1], pause_s * 1.3)
            with suppress(NotReached):  # the service answered before, so it is restarting, and the job goes on
                yield await self._get(Job, at("jobs", job))

    async def _events(self, job: str, left_s: float) -> AsyncGenerator[Job, None]:
        """Yield the job of each server-sent event, until the stream or the time ends."""
        over_s = self._clock() + left_s
        patience_s = min(self._timeout_s, left_s)
        async with self._opened("GET", at("jobs", job, "events"), timeout_s=patience_s) as answer:
            if not answer.headers.get("content-type", "").startswith(EVENTS):
                return
            async with aclosing(self._transport.lines(answer)) as lines:
                async for line in lines:
                    if line.startswith("data:"):  # the service writes each event's data on one line
                        yield self._read(Job, json.loads(line.removeprefix("data:")))
                    if self._clock() >= over_s:  # heartbeats may continue for ever
                        return
