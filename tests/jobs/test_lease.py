"""Leases: the observer measures silence with its own clock, from observation to observation."""

from skills.jobs.watch import Leases


def leases(*looks: tuple[float, dict[str, object]]) -> Leases:
    """Return leases that observed these heartbeats at these moments (in seconds of the observer)."""
    clock = iter(at_s for at_s, _ in looks)
    onlooker = Leases(2.0, clock=lambda: next(clock))
    for _, beats in looks:
        onlooker.look(beats)
    return onlooker


def test_a_worker_is_dead_if_its_heartbeat_is_unchanged_beyond_the_lease():
    still = [(at_s, {"a": 1, "b": at_s}) for at_s in (0.0, 0.8, 1.6, 2.0)]
    assert leases(*still).dead() == set()
    assert leases(*still, (2.1, {"a": 1, "b": 2.1})).dead() == {"a"}


def test_a_beat_from_the_past_or_the_future_is_as_good_as_any():
    hour_s = 3600.0
    beats = [0.0, 1.0 + hour_s, 2.0 + hour_s, 3.0 - hour_s, 4.0 - hour_s]
    assert leases(*((float(i), {"a": beat}) for i, beat in enumerate(beats))).dead() == set()


def test_an_onlooker_that_slept_for_an_hour_takes_nobody_for_dead():
    assert leases((0.0, {"a": 1}), (0.5, {"a": 2}), (3600.0, {"a": 2})).dead() == set()


def test_a_worker_without_a_beat_has_a_lease_as_well():
    assert leases(*((float(at_s), {"a": None}) for at_s in range(3))).dead() == set()
    assert leases(*((float(at_s), {"a": None}) for at_s in range(4))).dead() == {"a"}


def test_a_worker_that_speaks_again_is_alive_at_once():
    still = [(float(at_s), {"a": 1}) for at_s in range(5)]
    assert leases(*still).dead() == {"a"}
    assert leases(*still, (5.0, {"a": 2})).dead() == set()
