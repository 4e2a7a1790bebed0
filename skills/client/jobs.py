"""Trainings, and jobs of every kind: asked for, watched, waited for."""

import json
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing, suppress
from typing import Any, Literal

import httpx2 as httpx

from skills.api.schemas.given import Job, RetrainedStyle, Retraining
from skills.client.calls import at, call
from skills.client.connection import Connection, given
from skills.client.problems import JobFailed, JobTakesLonger, NotReached, NotUnderstood, Problem

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
Kind = Literal["training", "retraining", "playback", "pictures"]
Combining = Literal["medoid", "barycentre", "corridor"]
Watcher = Callable[[Job], None]

ENDED = ("succeeded", "failed", "cancelled")
PAUSES_S = (0.05, 0.5)  # between two looks at a job: the first, and the longest
EVENTS = "text/event-stream"


class Jobs(Connection):
    """The calls."""

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
        """Ask for a style to be trained; an equal request gives the same job.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            demos: What is learnt from; left out, the newest active demonstration.
            combine: How several become one way to follow; left out, as a corridor.
            learner: Its `kind` and settings; left out, Q-learning in the phase state.
            seed: Of the exploration.
            release: Release the version if it passes the gate.
        """
        asked = {"surgeon": surgeon, "suture": suture, "seed": seed, "release": release}
        how = None if combine is None else {"kind": combine}
        asked |= given({"demos": demos, "combine": how, "learner": learner})
        return await self._ask(Job, "POST", at("trainings"), asked)

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
        """Ask for styles to be trained again, as one job: all, or a surgeon's, or a suture type's."""
        asked = {"surgeon": surgeon, "suture": suture, "only_stale": only_stale, "learner": learner, "release": release}
        return await self._ask(Job, "POST", at("retrainings"), given(asked))

    @call
    async def retraining(self, job: str) -> Retraining:
        """Look a batch up: its job, and in `styles` how many are in which state."""
        return await self._get(Retraining, at("retrainings", job), limit=1)

    @call
    async def retrained(
        self, job: str, state: Literal["queued", "done", "failed", "cancelled"] | None = None
    ) -> list[RetrainedStyle]:
        """List the styles of a batch, all or those of one state."""
        return await self._all(RetrainedStyle, at("retrainings", job), state=state)

    @call
    async def job(self, job: str) -> Job:
        """Look a job up."""
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
        """Wait until a job has ended, and give it back.

        The service tells of each change as it happens; where its events do not come through, it is asked instead.

        Args:
            job: The job, or its id.
            timeout_s: For how long.
            progress: Is told of each change.

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
        """Look at a job, and again whenever it may have changed, until the time is up."""
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
                    pass  # nothing changed for long
                except (Problem, NotUnderstood, ValueError, httpx.TransportError):
                    streams = False
            await self._transport.sleep(min(pause_s, max(0.0, deadline_s - self._clock())))
            pause_s = min(PAUSES_S[1], pause_s * 1.3)
            with suppress(NotReached):  # it was there before: it is being started anew, and the job goes on
                yield await self._get(Job, at("jobs", job))

    async def _events(self, job: str, left_s: float) -> AsyncGenerator[Job, None]:
        """Follow the service's events of a job, for as long as they come and time is left."""
        over_s = self._clock() + left_s
        patience_s = min(self._timeout_s, left_s)
        async with self._opened("GET", at("jobs", job, "events"), timeout_s=patience_s) as answer:
            if not answer.headers.get("content-type", "").startswith(EVENTS):
                return
            async with aclosing(self._transport.lines(answer)) as lines:
                async for line in lines:
                    if line.startswith("data:"):  # each of the service's events has one such line
                        yield self._read(Job, json.loads(line.removeprefix("data:")))
                    if self._clock() >= over_s:  # the service may send signs of life for ever
                        return
