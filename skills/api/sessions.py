"""Sessions of pose styles: a WebSocket on which each message is a pose, and each answer the next pose.

    client: opens WS /policies/{surgeon}/{suture}/session with the credentials of any other call
    service: what it is pinned to, and the limits      client: {"position_mm": ..., "rotation_xyzw": ...}
    service: the next pose                             ...

A session is pinned to the version that is released when it opens; answers name a newer one, and do not change. It is
closed when its release is withdrawn, the surgeon's consent ends, the style is erased, or the key is revoked: two tasks
watch for all sessions together, as `Watching` does for the streams of jobs. A message that is no pose is answered with
`error`; one that is no JSON object closes the session. The codes 44xx are statuses of HTTP plus 4000.

While the database cannot be read, so that a withdrawal would not be seen, messages are answered with `error`; if that
lasts, the sessions are closed. Sessions are admitted as long as the processor has time for each at the full rate
(`Capacity`); a late answer says how late it is, and where answers stay late, the youngest sessions are closed.

The serving task of a session is the only one that sends. A watcher ends a session by cancelling that task, which then
sends the reason: a client that does not read cannot hold up a watcher.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from time import monotonic, thread_time
from typing import Any

import orjson
from anyio import to_thread
from pydantic import ValidationError
from sqlalchemy import String, bindparam, func, select, type_coerce
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import aliased
from starlette.types import Scope
from starlette.websockets import WebSocket, WebSocketDisconnect

from skills.api.authorisation import Caller
from skills.api.places import Places
from skills.api.rate_limits import Bucket
from skills.api.responses import json_of
from skills.api.strict_json import strictly_read
from skills.db.changes import Changes, Unasked
from skills.db.models import PolicyVersion, Release, Surgeon
from skills.db.session import Database
from skills.errors import Busy, SkillsError, TooMany
from skills.fields import as_json
from skills.learning.pose_step import next_pose
from skills.learning.tube import CertifiedPoses
from skills.library.people import consent
from skills.library.policies import releases
from skills.library.policies.pose_styles import describe_step, poses_of
from skills.library.policies.versions import served_release
from skills.schemas.pose_styles import PoseIn
from skills.settings import Settings

log = logging.getLogger("skills.api")

RATE_HZ = 100.0  # nominal; the bucket is refilled faster, so that a clock that runs fast by a quarter is not refused
BURST, REFILL_HZ = 50.0, 125.0
MESSAGE_BYTES = 4096  # a pose has about 200
MOST = 400  # sessions of this process; 50 at 100 Hz take about a core
WATCH_S = 0.2  # between two looks for changes of releases
CALLER_S = 0.5  # for one check of each caller; a look-up of a key is cached for a second
UNKNOWN_S = 1.5  # without an answer of the database for so long, a release may have been withdrawn
UNREAD_S = 10.0  # and for so long, sessions are closed and not only held up
LATE_S = 1 / RATE_HZ  # an answer that took longer is late
STAYS_LATE_S = 2.0  # answers that are late for so long close sessions, the youngest first
SHED = 4  # of the late sessions, one in so many is closed at once, so that the others are in time again
LOOK_S = 0.02  # between two looks at the delay of the event loop
WINDOW_S, WINDOWS = 1.0, 5  # in which the processor time of the event loop is measured, and new sessions are counted
MESSAGE_S = 200e-6  # of processor time for a message, before any was measured
SHARE = 0.35  # of a core, for sessions; beyond that, answers wait for each other
CLOSE_S = 1.0  # for a client that does not read to take the reason
AGAIN_S = 10.0
WITHDRAWN, ERASED, FORBIDDEN, SIGNED_OUT, IDLE, FLOODED, BUSY = 4404, 4410, 4403, 4401, 4408, 4429, 4503
NO_JSON, NO_TEXT = 1007, 1003  # of RFC 6455
UNWATCHED = "The service cannot see a withdrawal; open the session again."
LATE = f"Answers were later than {1000 * LATE_S:g} ms for {STAYS_LATE_S:g} s; open the session again in {AGAIN_S:g} s."
UNREAD = "The database cannot be read now, so a withdrawal would not be seen: stop until there is a pose again."
UNREADABLE = "The database cannot be read, so a withdrawal would not be seen; open the session again."


# The columns by which `_look` judges a release, and the newest release of its style that stands.
_NEWER = aliased(Release)
JUDGED = (
    select(
        type_coerce(Release.released_at, String).label("released_at"),
        type_coerce(Release.withdrawn_at, String).label("withdrawn_at"),
        PolicyVersion.sha256,
        consent.AS_TEXT.label("consent"),
        select(func.max(_NEWER.row))
        .where(_NEWER.surgeon_row == Release.surgeon_row, _NEWER.suture == Release.suture)
        .where(_NEWER.withdrawn_at.is_(None))
        .scalar_subquery(),
    )
    .join(Surgeon, Surgeon.row == Release.surgeon_row)
    .join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    .where(Release.row == bindparam("release"))
)


@dataclass(frozen=True, eq=False)
class Pinned:
    """What a session follows: a release with its pose style, and the last day of the surgeon's consent."""

    release: int
    released_at: Any
    version: int
    sha256: str
    last_day: date | None
    poses: CertifiedPoses


@dataclass(eq=False)
class Follower:
    """One open session: what it follows, the phase of the hand, and the reason for which it ends."""

    pinned: Pinned
    ask_again: Callable[[], Awaitable[Caller]]
    credentials: Any  # of equal ones the caller is the same
    task: "asyncio.Task[Any]"
    opened_s: float = field(default_factory=monotonic)
    heard_s: float = field(default_factory=monotonic)
    known_s: float = field(default_factory=monotonic)  # when the last check of its caller began that was answered
    bucket: Bucket = field(default_factory=lambda: Bucket(BURST, REFILL_HZ))
    phase: int | None = None
    newer_version: int | None = None
    ended: tuple[int, str] | None = None
    late_since_s: float | None = None  # the first of the late answers without one in time after it

    def end(self, code: int, reason: str) -> None:
        """Let its task send the reason and return."""
        if self.ended is None:
            self.ended = code, reason
            self.task.cancel()

    async def refused(self) -> tuple[int, str] | None:
        """Return why its caller may not use it any more, or None.

        Raises:
            Busy: The database cannot be read.
        """
        try:
            caller = await self.ask_again()
            caller.must_be("reader")
        except Busy:
            raise
        except SkillsError:
            return SIGNED_OUT, "The key is revoked or expired."
        return None

    def answer(self, text: str, arrived_s: float) -> bytes:
        """Return the answer to a message.

        Args:
            text: The message.
            arrived_s: When it arrived at the latest, of the monotonic clock.

        Raises:
            ValueError: It is not a JSON object, or repeats a name.
        """
        said = strictly_read(text)
        if not isinstance(said, dict):
            raise ValueError("not an object")
        try:
            pose = PoseIn.model_validate(said)
            phase = self.phase if pose.phase is None else pose.phase
            poses = self.pinned.poses
            step = next_pose(poses.path, pose.position_mm, pose.rotation_xyzw, phase, poses.tube.limits)
        except ValidationError as wrong:
            (first, *_) = wrong.errors(include_url=False, include_input=False, include_context=False)
            where = ".".join(map(str, first["loc"]))
            return orjson.dumps({"error": f"{where}: {first['msg']}." if where else f"{first['msg']}."})
        except SkillsError as wrong:
            return orjson.dumps({"error": wrong.words()})
        self.phase = step.phase
        late_s = (at_s := monotonic()) - arrived_s
        is_late = not late_s <= LATE_S
        self.late_since_s = (self.late_since_s or at_s) if is_late else None
        more = {"newer_version": self.newer_version, "late_ms": 1000 * late_s if is_late else None}
        return orjson.dumps(describe_step(poses, step) | more)


class Capacity:
    """The processor time that the event loop has left for sessions, measured on its thread while there are some."""

    def __init__(self) -> None:
        self.lag_s = 0.0  # of the event loop: what has arrived may have waited for so long before it was read
        self.messages = 0
        self._message_s = MESSAGE_S
        self._begin()

    def _begin(self) -> None:
        # What was admitted lately has hardly sent yet, and is no part of the load.
        self._load, self._admitted = 0.0, deque([0] * WINDOWS, WINDOWS)

    def admit(self) -> None:
        """Count a new session, which may send at the full rate.

        Raises:
            TooMany: The processor has no time for it.
        """
        if not self._load + (sum(self._admitted) + 1) * RATE_HZ * self._message_s <= SHARE:
            raise TooMany("The processor has no time for another session now; request single poses.", AGAIN_S)
        self._admitted[-1] += 1

    async def measure(self) -> None:
        """Measure the delay of the event loop, and the processor time of its thread, until cancelled."""
        began_s, before_s, before = monotonic(), _used_s(), self.messages
        try:
            while True:
                due_s = monotonic() + LOOK_S
                await asyncio.sleep(LOOK_S)
                at_s = monotonic()
                self.lag_s = max(at_s - due_s, 0.0)
                if at_s - began_s > WINDOW_S:
                    used_s, sent = _used_s() - before_s, self.messages - before
                    self._load = used_s / (at_s - began_s)
                    if sent > RATE_HZ:  # of fewer, other work would be counted as theirs
                        self._message_s += 0.3 * (used_s / sent - self._message_s)
                    self._admitted.append(0)
                    began_s, before_s, before = at_s, _used_s(), self.messages
        finally:
            self._begin()


class Sessions:
    """The open sessions of this process, on one event loop."""

    def __init__(self, database: Database, changes: Changes, settings: Settings) -> None:
        self._database, self._changes = database, changes
        self._idle_s = settings.session_idle_s
        full = TooMany("Too many sessions are open; close one, or request single poses.", AGAIN_S)
        self.places = Places(settings.key_sessions, full, MOST)
        self._open: set[Follower] = set()
        self._watching: list[asyncio.Task[None]] = []
        self._version: int | None = None  # of the database at the last look
        self._rows_seen: dict[Pinned, tuple[Any, ...] | None] | None = None  # and the rows that it judged
        self._known_s = 0.0  # when the last look began that was answered
        self._capacity = Capacity()

    async def serve(self, socket: WebSocket, surgeon: str, suture: str) -> None:
        """Serve one session until it ends.

        Raises:
            SkillsError: It is refused before it is opened: too many are open, the processor has no time for it, or
                nothing is served.
        """
        caller: Caller = socket.scope["caller"]
        with self.places.place(caller.key):
            self._capacity.admit()
            began_s = monotonic()
            pinned = await to_thread.run_sync(_pin, self._database.seen_by(caller.only), surgeon, suture)
            task = asyncio.current_task()
            assert task is not None
            ask_again = partial(socket.scope["ask_again"], socket.scope)
            follower = Follower(pinned, ask_again, _credentials(socket.scope), task)
            with self._watched(follower, began_s):
                await self._hold(socket, follower)

    async def _hold(self, socket: WebSocket, follower: Follower) -> None:
        """Accept a session and answer its messages until it ends."""
        try:
            await socket.accept()
            await socket.send_text(self._opening(follower.pinned))
            while True:
                await self._next(socket, follower)
        except WebSocketDisconnect:
            return
        except asyncio.CancelledError:
            if follower.ended is None:
                raise
            follower.task.uncancel()
        code, reason = follower.ended
        with suppress(TimeoutError, WebSocketDisconnect, RuntimeError):  # it may have left, or not read
            async with asyncio.timeout(CLOSE_S):
                await socket.close(code, reason)

    async def _next(self, socket: WebSocket, follower: Follower) -> None:
        """Answer one message, or end the session for it."""
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1005))
        follower.heard_s = monotonic()
        text = message.get("text")
        if text is None:
            follower.end(NO_TEXT, "Send poses as JSON text.")
        elif follower.bucket.take(1.0) > 0:
            follower.end(FLOODED, f"At most {RATE_HZ:g} messages a second, and {BURST:g} at once.")
        else:
            self._capacity.messages += 1
            try:
                if self._unknown_s(follower) > UNKNOWN_S:
                    answer = orjson.dumps({"error": UNREAD})
                else:
                    answer = follower.answer(text, message.get("arrived_s", monotonic()) - self._capacity.lag_s)
            except (ValueError, RecursionError):
                follower.end(NO_JSON, "A message is one JSON object, without repeated names or NaN.")
            else:
                await socket.send_text(answer.decode())
                return
        await asyncio.sleep(0)  # the cancellation arrives here

    def _unknown_s(self, follower: Follower) -> float:
        """Return for how long the end of a release or a key may have gone unseen, in seconds."""
        return monotonic() - min(self._known_s, follower.known_s)

    def _opening(self, pinned: Pinned) -> str:
        poses = pinned.poses
        limits = {"rate_hz": RATE_HZ, "burst": BURST, "message_bytes": MESSAGE_BYTES, "idle_s": self._idle_s}
        limits |= {"late_ms": 1000 * LATE_S, "stays_late_s": STAYS_LATE_S}
        said = {
            **{"version": pinned.version, "sha256": pinned.sha256, "arm": poses.arm, "frame": poses.frame},
            **{"phases": len(poses.path.tip_mm), "tick_s": poses.tick_s, "tube": as_json(poses.tube)},
            **{"scene": None if poses.scene is None else as_json(poses.scene), "limits": limits},
        }
        return json_of(said).decode()

    @contextmanager
    def _watched(self, follower: Follower, began_s: float) -> Iterator[None]:
        """Watch a session while it is open; the watchers run while there is one."""
        self._version = None  # a commit may have come in between: look again
        self._open.add(follower)
        if not self._watching:
            self._known_s = began_s
            tasks = (self._watch_releases(), self._watch_callers(), self._capacity.measure())
            self._watching = [asyncio.create_task(one) for one in tasks]
            for one in self._watching:
                one.add_done_callback(self._watched_no_more)
        try:
            yield
        finally:
            self._open.discard(follower)
            if not self._open:
                for one in self._watching:
                    one.cancel()
                self._watching = []

    def _watched_no_more(self, watcher: "asyncio.Task[None]") -> None:
        """End all sessions if a watcher failed: a withdrawal would not be seen."""
        if watcher.cancelled() or watcher.exception() is None:
            return
        log.error("a watcher of sessions failed", exc_info=watcher.exception())
        for one in self._open:
            one.end(BUSY, UNWATCHED)

    async def _watch_releases(self) -> None:
        """End sessions whose release must not be followed any more, and those that nobody uses."""
        while True:
            await asyncio.sleep(WATCH_S)
            began_s = monotonic()
            # Read before the tables, so that a commit in between is not missed.
            version = self._changes.version()
            looking = set(self._open)
            pinned = {one.pinned for one in looking}
            rows = None if version is None or version == self._version else await self._rows(pinned)
            if version is not None and (version == self._version or (rows is not None and rows == self._rows_seen)):
                self._version, self._known_s = version, began_s
            else:
                with suppress(SkillsError, SQLAlchemyError, TimeoutError):
                    async with asyncio.timeout(UNKNOWN_S):
                        found = await to_thread.run_sync(_look, self._database, pinned, abandon_on_cancel=True)
                    self._version, self._known_s, self._rows_seen = version, began_s, rows
                    _apply(looking, found)
            for one in looking:
                if self._unknown_s(one) > UNREAD_S or self._database.history.refused is not None:
                    one.end(BUSY, UNREADABLE)
                elif one.pinned.last_day is not None and not consent.today() <= one.pinned.last_day:
                    one.end(FORBIDDEN, "The surgeon's consent has ended.")
                elif monotonic() - one.heard_s > self._idle_s:
                    one.end(IDLE, f"No message for {self._idle_s:g} s.")
            self._shed(monotonic())

    def _shed(self, at_s: float) -> None:
        """Close the youngest of the sessions whose answers stay late, so that those of the others are in time again."""
        late = [one for one in self._open if one.late_since_s is not None and at_s - one.late_since_s > STAYS_LATE_S]
        late.sort(key=lambda one: one.opened_s, reverse=True)
        for one in late[: -(-len(late) // SHED)]:
            one.end(BUSY, LATE)
        for one in late:
            one.late_since_s = at_s

    async def _rows(self, pinned: set[Pinned]) -> dict[Pinned, tuple[Any, ...] | None] | None:
        """Return all of which `_look` judges, read on the event loop; None where that takes longer than microseconds.

        On SQLite every commit changes the version, also a worker's heartbeat, and a thread at each of them would hold
        up the answers.
        """
        rows = {}
        try:
            for one in pinned:
                rows[one] = self._changes.first(JUDGED, {"release": one.release})
                await asyncio.sleep(0)  # the answers that are due meanwhile
        except Unasked:
            return None
        return rows

    async def _watch_callers(self) -> None:
        """End the sessions of callers who may not use them any more."""
        while True:
            callers: dict[Any, list[Follower]] = {}
            for one in self._open:
                callers.setdefault(one.credentials, []).append(one)
            if not callers:
                await asyncio.sleep(CALLER_S)
            # One after the other: all at once would hold up the answers of every session.
            for same in callers.values():
                await asyncio.sleep(CALLER_S / len(callers))
                began_s = monotonic()
                with suppress(Busy):
                    why = await same[0].refused()
                    for one in same:
                        one.known_s = began_s
                        if why is not None:
                            one.end(*why)


def _used_s() -> float:
    """Return the time that this thread has run, and on Linux also that it has waited for a processor, in seconds.

    With the second, a message costs more where other programs use the processors too.
    """
    try:
        ran_ns, waited_ns, _ = Path("/proc/thread-self/schedstat").read_text().split()
    except OSError:
        return thread_time()
    return (int(ran_ns) + int(waited_ns)) / 1e9


def _credentials(scope: Scope) -> tuple[Any, ...]:
    """Return all that a caller is recognised by: the address, and every header but those of the WebSocket itself."""
    sent = (header for header in scope["headers"] if not header[0].startswith(b"sec-websocket-"))
    return (scope["client"] or ("",))[0], *sorted(sent)


def _pin(database: Database, surgeon: str, suture: str) -> Pinned:
    with database.reading() as session:
        release = served_release(session, surgeon, suture)
        policy = release.policy
        last_day = consent.last_day(policy.surgeon.consent)
        return Pinned(release.row, release.released_at, policy.version, policy.sha256, last_day, poses_of(policy))


Found = tuple[tuple[int, str] | None, int | None]  # why a release must not be followed, and a newer version


def _look(database: Database, pinned: set[Pinned]) -> dict[Pinned, Found]:
    with database.reading() as session:
        found: dict[Pinned, Found] = {}
        for one in pinned:
            release = session.get(Release, one.release)
            # Row numbers are used again after an erasure.
            if release is None or (release.policy.sha256, release.released_at) != (one.sha256, one.released_at):
                found[one] = (ERASED, "The style was erased."), None
            elif release.withdrawn_at is not None:
                found[one] = (WITHDRAWN, "The release was withdrawn."), None
            elif not consent.may(release.policy.surgeon, "training"):
                found[one] = (FORBIDDEN, "The surgeon's consent has ended."), None
            else:
                served = releases.served(session, release.policy.surgeon, release.suture)
                newer = served is not None and served.row != release.row
                found[one] = None, served.policy.version if served is not None and newer else None
        return found


def _apply(looking: set[Follower], found: dict[Pinned, Found]) -> None:
    """End the sessions whose release must not be followed any more, and note newer versions for the others."""
    for one in looking:
        why, one.newer_version = found[one.pinned]
        if why is not None:
            one.end(*why)
