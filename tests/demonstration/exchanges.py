"""Sessions of two arms whose needle transfers are known by construction, among much that looks like one.

One arm holds the needle. Again and again something happens, chosen at random: it gives the needle to the other arm; the
other arm grasps next to it and lets go; the needle is dropped while both reach for it, and picked up again; the holder
opens for a new grip, alone or while the other arm steadies tissue; the other arm opens and closes while it moves; the
needle is parked in tissue, both arms wander, and one takes it again. The script shares no threshold with the code.
"""

from dataclasses import dataclass

import numpy as np

from skills.demonstration.recording import Recording, Signal
from tests.demonstration import sessions

OFFSET_MM = {
    sessions.A: np.array([14.0, -6.0, -4.0]),
    sessions.M: np.array([-14.0, 6.0, 4.0]),
}  # of the taker's tip from the giver's
HAPPENINGS = ("give", "miss", "drop", "regrip", "regrip beside tissue", "play", "park")
CHANCES = (0.4, 0.12, 0.08, 0.1, 0.1, 0.12, 0.08)


@dataclass(frozen=True)
class Given:
    """A true transfer: who gave the needle, and when its jaw began to open."""

    giver: str
    at_s: float


def exchanges(kind: sessions.Kind, happenings: int = 14) -> tuple[Recording, list[Given]]:
    """Return a recording of both arms with their jaws, and the transfers in it."""
    rng = np.random.default_rng([kind.seed, 21])
    arms = {sessions.A: sessions.Arm(), sessions.M: sessions.Arm()}
    arms[sessions.A].place_mm.append(np.array([-15, 45, -110]))
    arms[sessions.M].place_mm.append(np.array([-45, 50, -112]))
    holder, given = sessions.A, []
    now = rng.uniform(2, 5)
    _rest(arms, now)
    arms[sessions.A].go(now := now + 0.3, jaw=sessions.SHUT)
    for happening in rng.choice(HAPPENINGS, happenings, p=CHANCES):
        now = _carry(arms, holder, now, rng)
        other = sessions.M if holder == sessions.A else sessions.A
        if happening == "give":
            now = _give(arms, holder, other, now, given, rng)
            holder = other
        else:
            now = ELSE[happening](arms, holder, other, now, rng)
        _rest(arms, now := now + rng.uniform(0.2, 2.0))
    _rest(arms, now + 3.0)
    return _recorded(arms, kind, rng), given


def _rest(arms: dict[str, sessions.Arm], until_s: float) -> None:
    for arm in arms.values():
        if arm.at_s[-1] < until_s:
            arm.wait(until_s)


def _carry(arms: dict[str, sessions.Arm], holder: str, now: float, rng: np.random.Generator) -> float:
    """The holder carries the needle somewhere, the other arm waits or follows."""
    _rest(arms, now)
    one = arms[holder]
    step = rng.normal(0, 12, 3).clip(-25, 25)
    place = np.clip(one.place_mm[-1] + step, [-60, 20, -135], [30, 80, -90])
    until = now + max(0.8, np.linalg.norm(place - one.place_mm[-1]) / rng.uniform(9, 25))
    one.go(until, place=place, turn=one.turn_rad[-1] + rng.normal(0, 0.2, 3))
    return until


def _reach(arms, holder, other, now, rng, beside_mm=0.0) -> float:
    """The other arm's tip comes to the place where it would take the needle, or beside it."""
    _rest(arms, now)
    error = rng.normal(0, 2.0, 3)
    if beside_mm:
        error += beside_mm * _unit(rng)
    until = now + rng.uniform(0.8, 2.0)
    arms[other].go(until, place=arms[holder].place_mm[-1] + OFFSET_MM[other] + error)
    arms[holder].wait(until)
    return until + rng.uniform(0.05, 0.4)


def _unit(rng) -> np.ndarray:
    vector = rng.normal(0, 1, 3)
    return vector / np.linalg.norm(vector)


def _jaw(arms, name, now, jaw, rng) -> float:
    arms[name].wait(now)
    arms[name].go(until := now + rng.uniform(0.15, 0.35), jaw=jaw)
    return until


def _away(arms, name, now, rng, jaw=None) -> float:
    arm = arms[name]
    if arm.at_s[-1] < now:
        arm.wait(now)
    arm.go(now + rng.uniform(0.7, 1.5), place=arm.place_mm[-1] + rng.uniform(8, 30) * _unit(rng), jaw=jaw)
    return arm.at_s[-1]


def _give(arms, holder, other, now, given, rng) -> float:
    now = _reach(arms, holder, other, now, rng)
    closed = _jaw(arms, other, now, sessions.SHUT, rng)
    opens = closed + rng.uniform(0.05, 1.5)
    if rng.random() < 0.3:  # both move the needle together a little
        together = 4.0 * _unit(rng)
        for name in (holder, other):
            arms[name].wait(closed) if arms[name].at_s[-1] < closed else None
            arms[name].go(opens, place=arms[name].place_mm[-1] + together)
    given.append(Given(holder, opens))
    now = _jaw(arms, holder, opens, sessions.OPEN, rng)
    return _away(arms, holder, now + rng.uniform(0.05, 0.5), rng)


def _miss(arms, holder, other, now, rng) -> float:
    now = _reach(arms, holder, other, now, rng, beside_mm=rng.uniform(3, 9))
    now = _jaw(arms, other, now, sessions.SHUT, rng)
    arms[other].go(now + 0.6, place=arms[other].place_mm[-1] + rng.uniform(1, 5) * _unit(rng))
    now = _jaw(arms, other, now + 0.7, sessions.OPEN, rng)
    return _away(arms, other, now, rng)


def _drop(arms, holder, other, now, rng) -> float:
    """The other arm closes next to the needle and moves off, and the holder opens meanwhile: nobody holds it then."""
    now = _reach(arms, holder, other, now, rng, beside_mm=rng.uniform(4, 9))
    now = _jaw(arms, other, now, sessions.SHUT, rng)
    off = _away(arms, other, now, rng)
    opened = _jaw(arms, holder, now + rng.uniform(0.3, 0.7), sessions.OPEN, rng)
    now = max(off, opened)
    _rest(arms, now)
    now = _jaw(arms, other, now + rng.uniform(0.1, 1.5), sessions.OPEN, rng)
    return _jaw(arms, holder, now, sessions.SHUT, rng)


def _regrip(arms, holder, other, now, rng) -> float:
    now = _jaw(arms, holder, now, sessions.OPEN, rng)
    return _jaw(arms, holder, now + rng.uniform(0.0, 0.8), sessions.SHUT, rng)


def _regrip_beside_tissue(arms, holder, other, now, rng) -> float:
    """The other arm holds tissue, which moves, while the holder takes a new grip."""
    _rest(arms, now)
    far = arms[holder].place_mm[-1] + rng.uniform(25, 60) * _unit(rng)
    arms[other].go(now := now + rng.uniform(1.0, 2.0), place=far)
    now = _jaw(arms, other, now, sessions.SHUT, rng)
    pulled = far + rng.uniform(0, 5) * _unit(rng)
    arms[other].go(now + rng.uniform(0.5, 2.0), place=pulled)
    now = _jaw(arms, holder, now + rng.uniform(0.2, 1.5), sessions.OPEN, rng)
    now = _jaw(arms, holder, now + rng.uniform(0.1, 1.0), sessions.SHUT, rng)
    now = max(now, arms[other].at_s[-1])
    return _jaw(arms, other, now + rng.uniform(0.1, 1.0), sessions.OPEN, rng)


def _play(arms, holder, other, now, rng) -> float:
    """The other arm opens and closes its jaw while it moves."""
    for jaw in (sessions.SHUT, sessions.OPEN, sessions.SHUT, sessions.OPEN)[: 2 * rng.integers(1, 3)]:
        now = _away(arms, other, now, rng, jaw=jaw)
    return now


def _park(arms, holder, other, now, rng) -> float:
    """The needle stays in tissue; both wander, and the holder takes it again."""
    here = arms[holder].place_mm[-1]
    now = _jaw(arms, holder, now, sessions.OPEN, rng)
    for name in (holder, other, other):
        now = max(now, _away(arms, name, now, rng))
    _rest(arms, now)
    arms[holder].go(now := now + 1.2, place=here)
    return _jaw(arms, holder, now, sessions.SHUT, rng)


ELSE = dict(zip(HAPPENINGS[1:], (_miss, _drop, _regrip, _regrip_beside_tissue, _play, _park), strict=True))


def _recorded(arms: dict[str, sessions.Arm], kind: sessions.Kind, rng: np.random.Generator) -> Recording:
    seconds = sessions.stamps_of(arms[sessions.A].at_s[-1], kind.rate_hz, rng)
    stamps_ns = sessions.EPOCH_NS + np.rint(seconds * 1e9).astype(np.int64)
    motions, jaws = [], []
    for name, script in arms.items():
        tip, turn, jaw = script.play(seconds)
        tip = tip + sessions.unsteady(seconds, kind, rng)
        rotation = sessions.turned(turn + rng.normal(0, 0.001, turn.shape))
        motions += [sessions.local(name, stamps_ns, tip, rotation), sessions.in_camera(name, stamps_ns, tip, rotation)]
        jaws.append((name, Signal(stamps_ns, jaw + rng.normal(0, 0.01, len(jaw)))))
    return Recording("mcap", "full", tuple(motions), jaws=tuple(jaws))
