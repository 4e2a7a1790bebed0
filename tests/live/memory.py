"""A bus in memory, on which a stand-in is stepped, without waiting: what is heard of it is the same each time."""

from collections import defaultdict

from skills.live.bus import Seen, Writer
from skills.live.check import Heard, value_from
from skills.live.interface import TELEOPERATION, BusTopic, measured
from skills.live.stand_in import StandIn

BEGAN_NS = 1_760_000_000_000_000_000


class MemoryBus:
    """Everybody in one process; `now_s` is the time at which messages are received."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.said: dict[str, list[Seen]] = defaultdict(list)
        self.announced: list[Writer] = []

    def listen(self, topic: BusTopic):
        read = 0

        def take():
            nonlocal read
            found = self.said[topic.name][read:]
            read += len(found)
            return found

        return take

    def speak(self, topic: BusTopic):
        writer = f"writer {len(self.announced)}"
        self.announced.append(Writer(topic.name, topic.type, writer, topic.event, False))
        return lambda data: self.said[topic.name].append(Seen(self.now_s, data, writer))

    def writers(self):
        return list(self.announced)

    def close(self) -> None:
        return


def stepped(bus: MemoryBus, stand_in: StandIn, seconds: float, late_s: float = 0.002, clock_ns: int = 0) -> None:
    """Step a stand-in; messages come `late_s` after their stamp, on a machine whose clock is `clock_ns` ahead."""
    for number in range(round(seconds / stand_in.period_s)):
        bus.now_s = number * stand_in.period_s + late_s
        now_ns = BEGAN_NS + round(1e9 * number * stand_in.period_s) - clock_ns
        for arm in stand_in.arms.values():
            arm.tick(stand_in.period_s, number, stand_in.camera, now_ns)


def heard_of(bus: MemoryBus, arm: str, seconds: float) -> Heard:
    """Return what was heard, as `listen_to` does."""
    said = {
        name: [
            (one.received_s, BEGAN_NS + round(1e9 * one.received_s), value_from(topic, one.data))
            for one in bus.said[topic.name]
        ]
        for name, topic in measured(arm).items()
    }
    told = [value_from(TELEOPERATION, one.data) for one in bus.said[TELEOPERATION.name]]
    return Heard(arm, seconds, said, told[-1] if told else None, bus.writers())
