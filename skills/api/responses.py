"""HTTP responses: JSON with ETags, conditional requests, negotiation and paging; streams of files and of events.

The ETag of a response is the SHA-256 of its bytes. Conditions follow RFC 9110, section 13. Responses with a policy are
encoded once and cached under the digest of the policy and the identity of its release.

A stream waits for its client between two chunks, perhaps for long, and is abandoned there when the client disconnects.
Its generator therefore holds no session, file or lock across a `yield` (`tests/test_architecture.py` checks sessions).
A recording, or a dataset, is read in one transaction per chunk.

Job events are server-sent events. One polling task queries the database for all watchers, however many there are. On
SQLite it queries only when `PRAGMA data_version` shows a commit; on PostgreSQL, whose notifications cover other changes
only, five times a second while there are watchers.
"""

import asyncio
import hashlib
import re
from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import aclosing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from time import monotonic
from typing import Annotated, Any

import orjson
from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Header, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from sqlalchemy.orm import Session
from starlette.types import Send

from skills.db.changes import Changes, WeightedCache
from skills.db.history import History
from skills.db.models import PolicyVersion, Release
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import PreconditionFailed, SkillsError, TooMany, UnknownFormat
from skills.formats import BYTES
from skills.library.operation.jobs import ACTIVE, find_job, find_jobs
from skills.library.operation.proofs import sign_files
from skills.library.policies import answers
from skills.library.policies.outcomes import describe_job, describe_jobs
from skills.library.policies.pose_styles import describe_pose_style, has_poses, poses_of
from skills.library.policies.versions import Served
from skills.library.recordings.recordings import damaged
from skills.schemas import operation as schemas
from skills.settings import MEBIBYTE, Settings
from skills.transparency import Note

Condition = Annotated[str | None, Header(max_length=2000)]
PIECE_BYTES = 64 << 10  # written at once; at most two of them are buffered for a slow client
DOWNLOADS_READ = 4  # chunks read at once for all downloads: limits threads, and thereby database connections


def tag_of(content: bytes) -> str:
    """Return the ETag of some bytes: their SHA-256 in quotes."""
    return f'"{hashlib.sha256(content).hexdigest()}"'


def json_of(said: Any, *, indented: bool = False) -> bytes:
    """Encode plain values, dataclasses and models of `skills.schemas` as JSON; timestamps end in Z, NaN is null."""
    indent = orjson.OPT_INDENT_2 if indented else 0
    return orjson.dumps(said, default=_fields, option=orjson.OPT_UTC_Z | indent)


def _fields(said: Any) -> dict[str, Any]:
    if isinstance(said, BaseModel):
        return said.model_dump(mode="json", warnings=False)  # lists of arrays stand in place of tuples
    raise TypeError(f"{type(said)} is no JSON")


def names(header: str, tag: str) -> bool:
    """Return whether a list of ETags, or `*`, contains a tag; weak tags match, since a proxy may weaken ours."""
    return any(one.strip().removeprefix("W/") in (tag, "*") for one in header.split(","))


def refuse_changed(said: Any, if_match: str | None, if_none_match: str | None = None) -> None:
    """Check the conditions of a request that changes a resource.

    Args:
        said: The current JSON of the resource, as a GET returns it; None if it does not exist.
        if_match: Header of which one ETag must match.
        if_none_match: Header of which no ETag may match; `*` means that the resource must not exist.

    Raises:
        PreconditionFailed: A condition does not hold.
    """
    tag = None if said is None else tag_of(json_of(said))
    if if_match is not None and (tag is None or not names(if_match, tag)):
        raise PreconditionFailed(
            "The object no longer has the ETag in If-Match; read it again, then repeat the request."
        )
    if if_none_match is not None and tag is not None and names(if_none_match, tag):
        raise PreconditionFailed(
            "An object that matches If-None-Match exists already; read it, then repeat the request."
        )


JSON, NPZ = "application/json", "application/x-npz"
GIVEN_FOR = {NPZ: NPZ, JSON: JSON, "application/*": JSON, "*/*": JSON}
WEIGHT = re.compile(r";\s*q=(0(?:\.\d{0,3})?|1(?:\.0{0,3})?)\s*$")
KEPT_BYTES = 64 * MEBIBYTE  # capacity of the cache; a policy's JSON is about 50 kB, with a million actions 3 MB

RawHeaders = list[tuple[bytes, bytes]]


@dataclass(frozen=True)
class Body:
    """A response body with its media type and ETag, and a link to what belongs to it (RFC 8288)."""

    content: bytes
    media_type: str
    etag: str
    link: str | None = None

    @cached_property
    def validators(self) -> RawHeaders:
        """Return the headers that a 304 has as well."""
        link = [] if self.link is None else [(b"link", self.link.encode())]
        return [(b"etag", self.etag.encode()), (b"vary", b"Accept"), (b"cache-control", b"no-cache"), *link]

    @cached_property
    def headers(self) -> RawHeaders:
        """Return all headers."""
        length = b"content-length", str(len(self.content)).encode()
        return [length, (b"content-type", self.media_type.encode()), *self.validators]


class EncodedResponse(Response):
    """A response with headers that were encoded before, which saves Starlette's work for each response."""

    def __init__(self, status_code: int, headers: RawHeaders, content: bytes) -> None:
        self.status_code = status_code
        self.raw_headers = headers.copy()  # middleware adds further headers to this list
        self.body = content
        self.background = None


def answer(body: Body, if_none_match: str | None, if_match: str | None = None) -> EncodedResponse:
    """Return a response with a body, or 304 if the client has exactly these bytes.

    Raises:
        PreconditionFailed: If-Match names other bytes than these.
    """
    if if_match is not None and not {body.etag, "*"} & {tag.strip() for tag in if_match.split(",")}:
        raise PreconditionFailed("The object no longer has the ETag in If-Match; request it without If-Match.")
    if if_none_match is not None and (if_none_match == body.etag or names(if_none_match, body.etag)):
        return EncodedResponse(304, body.validators, b"")
    return EncodedResponse(200, body.headers, body.content)


@lru_cache(256)
def negotiate(accept: str) -> str:
    """Choose between JSON and arrays: the media type with the highest weight, and of equal weights the first.

    Raises:
        UnknownFormat: The client accepts neither.
    """
    chosen, most = None, 0.0
    for part in accept.lower().split(","):
        given = GIVEN_FOR.get(part.partition(";")[0].strip())
        weight = WEIGHT.search(part)
        weighs = float(weight[1]) if weight else 1.0
        if given is not None and weighs > most:
            chosen, most = given, weighs
    if chosen is None:
        raise UnknownFormat(f"A policy is available as {JSON} or {NPZ}; name one of them in Accept.")
    return chosen


class Encoded:
    """LRU cache of encoded policy responses, keyed by everything that their content depends on."""

    def __init__(self) -> None:
        self._kept: WeightedCache[tuple[object, ...], Body] = WeightedCache(KEPT_BYTES, lambda body: len(body.content))

    def policy(self, policy: PolicyVersion, release: Release | None, accept: str) -> Body:
        """Return the encoded response of a policy version and its release, from the cache if it is there."""
        media_type = negotiate(accept)
        # With their times, because row and version numbers are used again after an erasure.
        released = (release.row, release.released_at) if release else None
        poses = policy.poses.sha256 if policy.poses else None
        key = (policy.sha256, policy.version, policy.created_at, released, poses, media_type)
        body = self._kept.get(key)
        if body is None:
            body = _encode(policy, release, media_type)
            self._kept.put(key, body)
        return body

    def pose_style(self, policy: PolicyVersion) -> Body:
        """Return the encoded pose style of a policy version, from the cache if it is there."""
        key = (policy.sha256, policy.version, policy.created_at, policy.poses.sha256 if policy.poses else None)
        body = self._kept.get(key)
        if body is None:
            content = json_of(describe_pose_style(policy, poses_of(policy)))
            body = Body(content, JSON, tag_of(content))
            self._kept.put(key, body)
        return body

    def signature(self, served: Served, head: Note, history: History) -> Body:
        """Return the signature of the responses of a released policy, each as it is sent; they are encoded for it.

        Args:
            served: The policy and its release.
            head: A checkpoint of the history that covers both.
            history: The history, with the key.
        """
        policy, release = served.policy, served.release
        bodies = {
            "policy.json": self.policy(policy, release, JSON),
            "policy-version.json": self.policy(policy, None, JSON),
            "policy.npz": self.policy(policy, release, NPZ),
        }
        if has_poses(policy):
            bodies["pose-style.json"] = self.pose_style(policy)
        digests = {name: body.etag.strip('"') for name, body in bodies.items()}
        facts = {"surgeon": policy.surgeon.slug, "suture": policy.suture, "version": policy.version}
        content = sign_files(history, head, digests, kind="policy", policy=policy.sha256, **facts)
        return Body(content, JSON, tag_of(content))

    def policies(self) -> set[str]:
        """Return the digests of the policies with cached responses."""
        return {str(key[0]) for key, _ in self._kept.items()}

    def forget(self, policies: Collection[str]) -> None:
        """Remove the cached responses of these policies."""
        self._kept.forget([key for key, _ in self._kept.items() if key[0] in policies])


def _encode(policy: PolicyVersion, release: Release | None, media_type: str) -> Body:
    if media_type == NPZ:
        content = answers.arrays_of(policy)
    else:
        arrays = f"/policy-versions/{policy.sha256} with Accept: {NPZ}"
        content = json_of(answers.describe_policy(policy, release, arrays))
    # A header and no field, so that the bytes and the ETag stay those of the policy.
    linked = release is not None and policy.poses is not None
    link = f'<{policy.suture}/pose-style>; rel="related"; title="pose style"' if linked else None
    return Body(content, media_type, tag_of(content), link)


class Give:
    """Builder of the response to a GET: 304 if the client has exactly these bytes already."""

    def __init__(self, request: Request, have: str | None) -> None:
        self._request = request
        self._have = have

    def __call__(self, said: Any) -> Response:
        """Return one resource as JSON."""
        return self.bytes(json_of(said), JSON)

    def bytes(self, content: bytes, media_type: str) -> Response:
        """Return bytes with their media type."""
        tag = tag_of(content)
        headers = {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}
        if self._have is not None and names(self._have, tag):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type=media_type)

    def page(self, items: Sequence[Any], limit: int, cursor: Any, **more: Any) -> Response:
        """Return one page of a list, with the cursor of the next page in `next` and in a `Link` header (RFC 8288).

        A full page has a cursor even if no item follows it.
        """
        following = cursor if len(items) == limit else None
        answer = self({**more, "items": items, "next": following})
        if following is not None:
            query = self._request.url.include_query_params(cursor=following).query
            # a relative URL, because a proxy may serve this path under a prefix
            answer.headers["Link"] = f'<?{query}>; rel="next"'
        return answer


async def _give(request: Request, if_none_match: Condition = None) -> Give:
    return Give(request, if_none_match)


Giving = Annotated[Give, Depends(_give)]


def as_asked(accept: str, kind: str) -> str:
    """Return the media type of a file: its own, unless `Accept` names plain bytes first."""
    return BYTES if accept.partition(";")[0].strip().lower() == BYTES else kind


def stored(said: Any, new: bool, location: str | None = None) -> Response:
    """Return the response to a PUT or POST that stores a resource: 201 if it is new, else 200."""
    headers = {} if location is None else {"Location": location}
    return say(said, 201 if new else 200, headers)


def accepted(session: Session, job: Job, did: str) -> Response:
    """Return the response to a request for a job: 200 once it succeeded, else 202; `did` is the request's effect."""
    return say(
        describe_job(session, job, did), 200 if job.state == "succeeded" else 202, {"Location": f"/jobs/{job.id}"}
    )


def say(said: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """Return a response with JSON."""
    return Response(json_of(said), status, headers=headers, media_type=JSON)


# ---- streams -------------------------------------------------------------------------------------------------------


class Stream(StreamingResponse):
    """A streamed response that sends its status with the first chunk: an error before that becomes a problem document.

    A later error aborts the connection, so a response that ends regularly is complete. The generator is closed at the
    end in every case, and not when the garbage collector finds it.
    """

    def __init__(self, pieces: AsyncGenerator[bytes, None], media_type: str, headers: dict[str, str]) -> None:
        super().__init__(pieces, headers=headers, media_type=media_type)
        self._pieces = pieces

    async def stream_response(self, send: Send) -> None:
        """Send the status with the first chunk, then the rest."""
        try:
            piece = await anext(self._pieces, None)
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            while piece is not None:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                piece = await anext(self._pieces, None)
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            await self._pieces.aclose()


async def stored_pieces(
    read: Callable[[int], bytes | None], refuse: Callable[[], object], sha256: str, limiter: CapacityLimiter
) -> AsyncGenerator[bytes, None]:
    """Yield the bytes of a stored file, after all of them were compared with its digest.

    Every chunk is read in a transaction of its own, so the file is read twice: to check it before the first byte
    is sent, and to send it. The second pass is checked as well, and withholds its last chunk until the digest agrees.

    Args:
        read: Returns a chunk by its number, in a transaction of its own; None after the last one.
        refuse: Called if the digest differs; raises if the file was erased, or may not be passed on any more.
        sha256: The file's digest.
        limiter: Limit on reading threads, shared by the application; see `DOWNLOADS_READ`.

    Raises:
        Corrupt: The bytes do not match the digest.
        SkillsError: As `read` and `refuse`.
    """
    async for _ in _chunks(read, refuse, sha256, limiter):
        pass
    async with aclosing(_chunks(read, refuse, sha256, limiter)) as chunks:
        async for chunk in chunks:
            for at in range(0, len(chunk), PIECE_BYTES):
                yield chunk[at : at + PIECE_BYTES]


async def _chunks(
    read: Callable[[int], bytes | None], refuse: Callable[[], object], sha256: str, limiter: CapacityLimiter
) -> AsyncGenerator[bytes, None]:
    """Yield the chunks of a file; the last one only if all of them together match the digest."""
    seen, held, number = hashlib.sha256(), b"", 0

    def read_next() -> bytes | None:
        chunk = read(number)
        if isinstance(chunk, str):  # SQLite does not enforce the column's type
            raise damaged()
        if chunk is not None:
            seen.update(chunk)
        return chunk

    while (chunk := await to_thread.run_sync(read_next, limiter=limiter)) is not None:
        if held:
            yield held
        held, number = chunk, number + 1
    if seen.hexdigest() != sha256:
        await to_thread.run_sync(refuse)
        raise damaged()
    yield held


WATCH_S = 0.2
ASKED_AGAIN_S = 1.0  # interval of the authorisation check: a stream ends within this and `authentication.REMEMBERED_S`
AGAIN_S = 10.0


class Watcher:
    """One stream: the last state of its job, None if it was erased, and the event that wakes the stream at a change."""

    def __init__(self, job: str) -> None:
        self.job = job
        self.now: schemas.Job | None = None
        self.changed = asyncio.Event()


class Watching:
    """All event streams of this process, on one event loop."""

    def __init__(self, database: Database, changes: Changes, settings: Settings) -> None:
        self._database, self._changes = database, changes
        self._heartbeat_s, self._most = settings.heartbeat_s, settings.key_watchers
        self._watchers: set[Watcher] = set()
        self._of_key: Counter[str] = Counter()
        self._looking: asyncio.Task[None] | None = None
        self._version: int | None = None  # of the database at the last query

    async def events(
        self, database: Database, job: str, key: str | None, may_still: Callable[[], Awaitable[object]]
    ) -> AsyncGenerator[bytes, None]:
        """Yield the state of a job at every change until it has ended, with comments as a heartbeat in between.

        Args:
            database: The database, restricted to the rows that the caller may see.
            job: The job's id.
            key: The identity that concurrent streams are counted by; None: no limit.
            may_still: Authorises the caller again; the stream ends when it raises.

        Raises:
            TooMany: The key has as many streams open as it may.
            NotFound: There is no such job.
        """
        with self._place(job, key) as watcher:
            watcher.now = await to_thread.run_sync(_look, database, job)
            self._version = None  # a commit may have come in between: poll again
            told, told_s = None, monotonic()
            while watcher.now is not None:
                if watcher.now != told:
                    told, told_s = watcher.now, monotonic()
                    yield b"event: job\ndata: " + json_of(told) + b"\n\n"
                    if told.state not in ACTIVE:
                        return
                elif monotonic() - told_s >= self._heartbeat_s:
                    told_s = monotonic()
                    yield b": the job goes on\n\n"
                with suppress(TimeoutError):
                    await asyncio.wait_for(watcher.changed.wait(), min(ASKED_AGAIN_S, self._heartbeat_s))
                watcher.changed.clear()
                try:
                    await may_still()
                except SkillsError:
                    return

    @contextmanager
    def _place(self, job: str, key: str | None) -> Iterator[Watcher]:
        if key is not None and self._of_key[key] >= self._most:
            raise TooMany(
                f"This key watches {self._most} jobs already; close one of its streams, or poll the job.", AGAIN_S
            )
        watcher = Watcher(job)
        self._watchers.add(watcher)
        self._of_key.update([] if key is None else [key])
        if self._looking is None:
            self._looking = asyncio.create_task(self._look_on())
        try:
            yield watcher
        finally:
            self._watchers.discard(watcher)
            self._of_key.subtract([] if key is None else [key])
            if key is not None and not self._of_key[key]:
                del self._of_key[key]
            if not self._watchers and self._looking is not None:
                self._looking.cancel()
                self._looking = None

    async def _look_on(self) -> None:
        """Poll for changes while there are watchers, and wake those whose job changed."""
        while True:
            await asyncio.sleep(WATCH_S)
            # read before the tables, so that a commit in between is not missed
            version = self._changes.version() if self._changes.every_commit else None
            if version is not None and version == self._version:
                continue
            wanted = {watcher.job for watcher in self._watchers if watcher.now is not None}
            with suppress(SkillsError):  # the database may be readable again at the next poll
                found = await to_thread.run_sync(_look_at_all, self._database, wanted)
                self._version = version
                for watcher in self._watchers:
                    if watcher.job in wanted and watcher.now is not None and found.get(watcher.job) != watcher.now:
                        watcher.now = found.get(watcher.job)
                        watcher.changed.set()


def _look(database: Database, job: str) -> schemas.Job:
    with database.reading() as session:
        found = find_job(session, job)
        return describe_job(session, found)


def _look_at_all(database: Database, jobs: set[str]) -> dict[str, schemas.Job]:
    with database.reading() as session:
        found = find_jobs(session, jobs)
        return {job.id: job for job in describe_jobs(session, found)}
