"""Damaged, inflated or misassembled files: refused with a message, or read as exactly their content.

Parts of the sweeps run always, the complete sweeps with `make nightly`. `tests/api` tests that a server responds to
others meanwhile.
"""

import io
import time
from collections import Counter
from collections.abc import Iterable
from functools import cache

import pytest

from skills.demonstration.recording import Recording
from skills.errors import SkillsError
from skills.formats import write_mcap
from skills.formats.mcap import read_mcap
from tests.formats import bags, hostile, large
from tests.formats.weigh import weigh

MEMORY_MIB = 512.0
SECONDS = 5.0
MAKE = {
    "one topic in 6 chunks": lambda: bags.pose_bag(bags.straight(60)),
    "every signal in one chunk": lambda: write_mcap(bags.recording(60)),
    "no chunks": lambda: bags.unchunked(bags.straight(60), checksum=True),
}
QUICK, WHOLE = 100, 2000


@cache
def file(name: str) -> bytes:
    return MAKE[name]()


def read(data: bytes) -> Recording:
    return read_mcap(io.BytesIO(data))


def swept(files: Iterable[bytes]) -> tuple[Counter[str], list[Recording]]:
    """Read every file; return the counts of refusals, and the other recordings. All other exceptions are errors."""
    counts: Counter[str] = Counter()
    accepted = []
    for data in files:
        try:
            accepted.append(read(data))
        except SkillsError as error:
            counts[type(error).__name__] += 1
    return counts, accepted


@pytest.mark.parametrize("name", MAKE)
def test_a_file_cut_at_any_record_or_beside_it_is_refused(name):
    _, accepted = swept(hostile.boundary_cuts(file(name)))
    assert not accepted


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("count", [QUICK, pytest.param(1000, marks=pytest.mark.nightly)])
def test_a_file_cut_anywhere_is_refused(name, count):
    counts, accepted = swept(hostile.truncations(file(name), count, seed=count))
    assert not accepted
    assert counts == {"UnreadableRecording": count}


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("count", [QUICK, pytest.param(WHOLE, marks=pytest.mark.nightly)])
def test_a_flipped_bit_is_refused_or_changes_nothing(name, count):
    whole = read(file(name))
    _, accepted = swept(hostile.flips(file(name), count, seed=count))
    for other in accepted:
        bags.assert_same(other, whole)
    assert len(accepted) < 0.4 * count


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("count", [QUICK, pytest.param(WHOLE, marks=pytest.mark.nightly)])
def test_misassembled_records_are_refused_or_form_another_complete_file(name, count):
    counts, _ = swept(hostile.mutations(file(name), count, seed=count))
    assert counts["UnreadableRecording"] > 0.6 * count


def test_the_mutations_of_a_seed_are_always_the_same():
    data = file("one topic in 6 chunks")
    assert list(hostile.mutations(data, 50, 3)) == list(hostile.mutations(data, 50, 3))
    assert list(hostile.mutations(data, 50, 3)) != list(hostile.mutations(data, 50, 4))


@pytest.mark.parametrize("name", hostile.BOMBS)
def test_a_small_bomb_is_refused_at_once(name):
    bomb = hostile.BOMBS[name]()
    assert len(bomb) < 2 << 20
    began = time.process_time()
    with pytest.raises(SkillsError):
        read(bomb)
    assert time.process_time() - began < SECONDS


@pytest.mark.nightly
@pytest.mark.parametrize("name", [*hostile.BOMBS, *hostile.LARGE_BOMBS])
def test_a_bomb_costs_little_time_and_memory(name, tmp_path):
    bomb = tmp_path / "bomb.mcap"
    bomb.write_bytes((hostile.BOMBS | hostile.LARGE_BOMBS)[name]())
    weight = weigh(bomb)
    print(f"{name}: {weight.seconds:.2f} s, {weight.peak_mib:.0f} MiB, {weight.outcome}")
    assert weight.outcome in ("UnreadableRecording", "NoUsableTopic")
    assert weight.seconds < SECONDS
    assert weight.peak_mib < MEMORY_MIB


@pytest.mark.nightly
def test_a_million_samples_are_read_cut_and_discretised_in_10_s_and_1_gib(tmp_path):
    file = tmp_path / "long.mcap"
    file.write_bytes(large.one_arm(1_000_000))
    weight = weigh(file)
    print(f"{weight.seconds:.2f} s, then {weight.discretised_s:.2f} s, {weight.peak_mib:.0f} MiB")
    assert weight.outcome == "read"
    assert weight.seconds + weight.discretised_s < 10.0
    assert weight.peak_mib < 1024.0


@pytest.mark.nightly
def test_what_is_not_used_costs_no_memory_however_long_the_file(tmp_path):
    peaks = []
    for chunks in (10, 100):
        file = tmp_path / f"{chunks}.mcap"
        file.write_bytes(large.with_unused(chunks))
        peaks.append(weigh(file).peak_mib)
    print(peaks)
    assert peaks[1] - peaks[0] < 16.0
