"""Records of a client: everything that was asked of a service, what was acknowledged, and everything that was read.

Times are seconds of this process's monotonic clock, which no fault touches.
"""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Ask:
    """One thing that was asked for, once or repeatedly, until it was acknowledged.

    Attributes:
        kind: "upload", "recording", "training", "release", "withdrawal" or "backup".
        what: What identifies it to the client, such as the SHA-256 of the bytes.
        sent_s: When it was first sent.
        acked_s: When it was acknowledged; None if it never was.
        ids: The ids in the acknowledgements, one unless something is wrong.
        about: What the auditor needs besides.
    """

    kind: str
    what: str
    sent_s: float
    acked_s: float | None = None
    ids: set[str] = field(default_factory=set)
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Write:
    """A change of the policy that a style serves, by its only writer: a version's SHA-256, or None for a withdrawal.

    `acked_s` is None if it is not known to have happened; `over_s` is when it cannot happen any more.
    """

    value: str | None
    sent_s: float
    acked_s: float | None
    over_s: float


@dataclass(frozen=True)
class Read:
    """An answer to GET /policies/{surgeon}/{suture}: the digest of its body, None for "nothing is released"."""

    surgeon: str
    began_s: float
    ended_s: float
    body: str | None
    etag: str | None


class Ledger:
    """What all clients of a run have asked, been told and read; thread-safe."""

    def __init__(self) -> None:
        self.asks: list[Ask] = []
        self.writes: dict[str, list[Write]] = {}
        self.reads: list[Read] = []
        self.bodies: dict[str, bytes] = {}  # of policies, by SHA-256
        self.refused: list[tuple[float, str]] = []  # moment and answer of every request that did not succeed
        self._lock = threading.Lock()

    def ask(self, kind: str, what: str, **about: Any) -> Ask:
        """Note that something is going to be asked."""
        asked = Ask(kind, what, time.monotonic(), about=about)
        with self._lock:
            self.asks.append(asked)
        return asked

    def acknowledge(self, asked: Ask, name: str) -> None:
        """Note an acknowledgement, with the id in it."""
        asked.ids.add(name)
        asked.acked_s = asked.acked_s or time.monotonic()

    @contextmanager
    def writing(self, surgeon: str, value: str | None, sent_s: float | None = None) -> Iterator[list[bool]]:
        """Note a change of the served policy; it is acknowledged where the block has put True into the list."""
        began_s, happened = time.monotonic() if sent_s is None else sent_s, []
        try:
            yield happened
        finally:
            ended_s = time.monotonic()
            write = Write(value, began_s, ended_s if any(happened) else None, ended_s)
            with self._lock:
                self.writes.setdefault(surgeon, []).append(write)

    def read(self, read: Read, body: bytes | None) -> None:
        """Note an answer with a policy, or that there is none."""
        with self._lock:
            self.reads.append(read)
            if body is not None and read.body is not None:
                self.bodies.setdefault(read.body, body)

    def refuse(self, answer: str) -> None:
        """Note a request that did not succeed."""
        with self._lock:
            self.refused.append((time.monotonic(), answer))

    def acknowledged(self) -> Counter[str]:
        """Count the acknowledged things by kind."""
        return Counter(one.kind for one in self.asks if one.acked_s is not None)

    def first_after(self, kind: str, moment_s: float) -> float | None:
        """Return when the first thing of a kind was acknowledged that was sent after a moment."""
        done = [one.acked_s for one in self.asks if one.kind == kind and one.sent_s > moment_s and one.acked_s]
        return min(done, default=None)
