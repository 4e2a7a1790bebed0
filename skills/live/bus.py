"""A bus: what the live rooms need of DDS, or of ROS 1. Nothing here knows which it is."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from skills.live.interface import BusTopic


class Seen(NamedTuple):
    """A message as it came: when, by this machine's monotonic clock in s; its CDR bytes; and who wrote it."""

    received_s: float
    data: bytes
    writer: str


class Writer(NamedTuple):
    """Somebody who writes to a topic.

    Attributes:
        topic: Name of the topic in ROS.
        type: Type in ROS 2.
        writer: The identity of the writer; `Seen.writer` has the same.
        keeps: Whether its last message is kept for those who come later.
        is_ours: Whether it is of this bus object.
    """

    topic: str
    type: str
    writer: str
    keeps: bool
    is_ours: bool


class Bus(Protocol):
    """A bus that was joined; every method may be called from one thread only."""

    def listen(self, topic: BusTopic) -> Callable[[], Sequence[Seen]]:
        """Listen to a topic, whatever its writers keep; each call of the answer returns what came since the last."""

    def speak(self, topic: BusTopic) -> Callable[[bytes], None]:
        """Announce a topic, and return what writes a message's CDR bytes to it."""

    def writers(self) -> Sequence[Writer]:
        """Return all writers that are known now; the first ones take some tenths of a second to be found."""

    def close(self) -> None:
        """Leave the bus."""
