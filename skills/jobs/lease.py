"""Who has fallen silent, whatever the clocks say."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

LONGEST_LOOK_S = 1.0


@dataclass
class Leases:
    """How long every worker has been silent, as one onlooker has seen it.

    A beat is only asked whether it differs from the last one seen; its date is never compared with a clock. Time is
    this process's monotonic clock, and each look adds at most `LONGEST_LOOK_S`. So a wall clock that steps by an hour
    does no harm, on one machine or several; nor does a pause of the onlooker, of the machine, or of the database,
    after which everybody's beats are old. What it costs: a worker that has just started waits out a whole lease
    before it takes over from anybody.
    """

    lease_s: float
    clock: Callable[[], float] = time.monotonic
    _looked_s: float | None = None
    _seen: dict[str, object] = field(default_factory=dict)
    _silent_s: dict[str, float] = field(default_factory=dict)

    def look(self, beats: Mapping[str, object]) -> Mapping[str, float]:
        """Look at everybody's last beat; tell for how many seconds each has been silent.

        Args:
            beats: By executor; None for one that is known to have worked but has no beat.
        """
        now_s = self.clock()
        passed_s = 0.0 if self._looked_s is None else min(now_s - self._looked_s, LONGEST_LOOK_S)
        self._looked_s = now_s
        self._silent_s = {
            executor: self._silent_s[executor] + passed_s if self._unchanged(executor, beat) else 0.0
            for executor, beat in beats.items()
        }
        self._seen = dict(beats)
        return self._silent_s

    def dead(self) -> set[str]:
        """Name those whose lease has run out."""
        return {executor for executor, silent_s in self._silent_s.items() if silent_s > self.lease_s}

    def _unchanged(self, executor: str, beat: object) -> bool:
        return executor in self._seen and self._seen[executor] == beat
