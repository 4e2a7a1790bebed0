"""Reading in a confined process: the same recording or refusal as in this process, and all failures are refusals."""

import errno
import io
import json
import logging
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from typing import IO, Any, BinaryIO

import numpy as np
import pytest

from skills.demonstration import motion, recording
from skills.demonstration import recording as values
from skills.demonstration.identification import ArmIdentification, Identification
from skills.demonstration.segments import Segment
from skills.errors import BadColumns, BadInput, Busy, SkillsError, UnreadableRecording
from skills.formats import read_recording, reader_process, write_mcap
from skills.formats.mcap import _kernels
from skills.formats.parsed import ParsedContent, parse_recording
from skills.formats.reader_process import KNOWN, ConfinedReader, Refusal
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import ForkServer
from tests.formats import bags
from tests.formats.confined import on, read

LIMITS = ProcessLimits(
    memory_bytes=512 << 20, wall_s=20.0, cpu_s=20, file_bytes=64 << 20, answer_bytes=32 << 20, threads=False
)
HANG = "tests.sandbox.faults:hang"
BAG = bags.pose_bag(bags.straight(40))
TABLE = b"t_s,x_mm,y_mm,z_mm,jaw_rad\n" + b"".join(b"%f,1,2,-100.5,0.25\n" % (k / 50) for k in range(40))


@pytest.fixture(scope="module")
def reader(reading_server: ForkServer) -> ConfinedReader:
    reading_server.start()
    return on(reading_server, LIMITS, at_once=4)


def same(one: Any, other: Any) -> bool:
    """Return whether two values are equal to the last bit, types included, and the second one's arrays read-only."""
    if is_dataclass(one):
        return type(one) is type(other) and all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.tobytes() == other.tobytes() and not other.flags.writeable
    return bool(one == other)


@pytest.mark.parametrize(
    ("data", "how"), [(BAG, {}), (TABLE, {}), (TABLE, {"frame": "ECM"})], ids=["bag", "csv", "ECM"]
)
def test_the_recording_is_the_same_to_the_last_bit(reader, data, how):
    assert same(read_recording(io.BytesIO(data), **how), read(reader, data, **how))


def test_every_value_of_a_recording_may_come_back():
    rooms = {one.__name__: vars(one) for one in (values, motion, recording)}
    assert {v for name, here in rooms.items() for v in here.values() if is_dataclass(v) and v.__module__ == name} == {
        *KNOWN.values()
    } - {Refusal, ParsedContent, Segment, ArmIdentification, Identification}


@pytest.mark.parametrize(("data", "how"), [(BAG, {}), (TABLE, {"frame": "ECM"})], ids=["bag", "csv"])
def test_what_is_told_is_the_same_to_the_last_bit(reader, data, how):
    with tempfile.TemporaryFile() as file:
        file.write(data)
        told = reader.parse(file, **how)
    assert same(parse_recording(io.BytesIO(data), **how), told)
    assert told.about.segments == list(told.proposed)


@pytest.mark.parametrize(
    ("data", "how"),
    [
        *((b"", {}), (b"PK\x03\x04", {}), (BAG[:500], {}), (b"t_s,x_m\n0,1\n", {})),
        *((BAG, {"frame": "camera"}), (BAG, {"rate_hz": 9})),
    ],
    ids=["empty", "zip", "cut", "columns", "frame", "rate"],
)  # fmt: skip
def test_a_refusal_is_the_same(reader, data, how):
    with pytest.raises(SkillsError) as apart:
        read(reader, data, **how)
    with pytest.raises(SkillsError) as here:
        read_recording(io.BytesIO(data), **how)
    one, other = apart.value, here.value
    assert (type(one), str(one), one.numbers) == (type(other), str(other), other.numbers)


def test_numbers_that_are_no_json_come_back_as_they_would_be_shown():
    refused = BadColumns("No.", share=float("inf"), stamp=np.int64(3), names=["a", None])
    numbers = Refusal.of(refused).read().numbers
    assert numbers == {"share": float("inf"), "stamp": "3", "names": ["a", None]}


# ---- compiled loops


def signatures() -> list[int]:
    return [len(loop.machine.signatures) for loop in (_kernels.follow_compiled, _kernels.take_compiled)]


def tell_signatures(given: BinaryIO, answer: BinaryIO) -> None:
    """Write the number of compiled signatures before reading and after it."""
    before = signatures()
    read_recording(given)
    answer.write(json.dumps([before, signatures()]).encode())


@pytest.mark.parametrize(
    "data", [BAG, bags.unchunked(bags.straight(40), checksum=True), write_mcap(bags.recording(20))]
)
def test_a_fork_finds_every_loop_loaded_and_needs_no_other(reader, data):
    with tempfile.TemporaryFile() as file:
        file.write(data)
        with reader.server.run(f"{__name__}:tell_signatures", file, {}, LIMITS) as answer:
            assert json.load(answer) == [[1, 1], [1, 1]]


def test_machine_code_is_not_loaded_from_where_others_write(tmp_path, monkeypatch, capfd):
    tmp_path.chmod(0o777)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with ConfinedReader(LIMITS, at_once=1) as unsafe, pytest.raises(Busy):
        read(unsafe, BAG)
    assert "other users can write" in capfd.readouterr().err


@pytest.mark.nightly  # slow if it fails, not wrong
def test_an_empty_machine_code_cache_is_filled_before_any_file_is_read(tmp_path, monkeypatch):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with ConfinedReader(LIMITS, at_once=1) as first:
        assert same(read_recording(io.BytesIO(BAG)), read(first, BAG))
    assert len(list(tmp_path.rglob("_kernels.*.nbc"))) == 2


# ---- invalid responses

NONSENSE = [
    *("garbage", "nothing", "with_pickles", "unfolding", "another_value", "a_class_that_is_not_named"),
    *("an_empty_recording", "our_mistake", "no_error_at_all"),
]


@pytest.mark.parametrize("fault", NONSENSE)
def test_nonsense_is_a_refusal(reader, fault, caplog, monkeypatch):
    monkeypatch.setattr(reader_process.log, "disabled", False)  # import-linter, in another test, disables all loggers
    with pytest.raises(UnreadableRecording) as caught:
        read(on(reader.server, target=f"tests.sandbox.faults:{fault}"), BAG)
    assert caught.value.numbers == {"cause": "nonsense"}
    assert "unreadable data" in caplog.text


@pytest.mark.parametrize(
    ("fault", "cause", "advice"),
    [
        ("crash", "crashed", "SIGSEGV; the file may be damaged"),
        ("leave", "failed", "mcap doctor"),
        ("eat_memory", "out of memory", "512 MiB; cut the recording"),
        ("answer_without_end", "too much", "64 MiB; cut the recording"),
        ("spin", "hung", "1 s of processor time; cut the recording"),
    ],
)
def test_what_becomes_of_a_reader_is_a_refusal_that_says_what_to_do(reader, fault, cause, advice):
    limits = ProcessLimits(**vars(LIMITS) | {"cpu_s": 1})
    with pytest.raises(UnreadableRecording, match=advice) as caught:
        read(on(reader.server, limits, target=f"tests.sandbox.faults:{fault}"), BAG)
    assert isinstance(caught.value, BadInput)
    assert caught.value.numbers == {"cause": cause}


def test_a_fault_of_ours_is_logged_without_the_file_in_it(monkeypatch):
    def broken(_file: IO[bytes]) -> None:
        raise KeyError("Zaphod")

    monkeypatch.setattr(reader_process, "read_recording", broken)
    with pytest.raises(RuntimeError, match=r"^KeyError$") as caught:
        reader_process.read(io.BytesIO(), io.BytesIO())
    assert caught.value.__suppress_context__
    assert caught.traceback[-1].name == "broken"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES])
def test_an_error_of_the_system_keeps_its_number_and_loses_its_file(monkeypatch, number):
    def broken(_file: IO[bytes]) -> None:
        raise OSError(number, "no", "Zaphod.db3")

    monkeypatch.setattr(reader_process, "read_recording", broken)
    with pytest.raises(OSError, match="refused") as caught:
        reader_process.read(io.BytesIO(), io.BytesIO())
    assert (caught.value.errno, "Zaphod" in str(caught.value)) == (number, False)


def test_too_many_at_once_are_told_to_come_back(reader, caplog):
    caplog.set_level(logging.CRITICAL)
    limits = ProcessLimits(**vars(LIMITS) | {"wall_s": 0.5})
    slow = on(reader.server, limits, at_once=12, target=HANG)
    with ThreadPoolExecutor(40) as threads:
        refused = list(threads.map(lambda k: refusal(slow, f"key {k % 2}"), range(40)))
    assert set(refused) == {UnreadableRecording, Busy}
    assert refused.count(UnreadableRecording) == reader_process.WAITING


def test_one_key_does_not_hold_all_readers(reader):
    three = on(reader.server, ProcessLimits(**vars(LIMITS) | {"wall_s": 0.7}), at_once=3)
    with ThreadPoolExecutor(8) as threads, tempfile.TemporaryFile() as file:
        file.write(BAG)
        assert three(file, key="other").motions  # the fork server has started
        held = [threads.submit(read, three, BAG, key="greedy", target=HANG) for _ in range(8)]
        for _ in range(3):
            assert three(file, key="other").motions
        assert sum(one.done() for one in held) <= 2  # eight requests in two readers take four times 0.7 s
        assert {type(one.exception()) for one in held} == {UnreadableRecording}


def test_a_small_file_may_not_use_the_processor_time_of_a_large_one(reader, monkeypatch):
    monkeypatch.setattr(reader_process, "SMALL_FILE_CPU_S", 1)
    with pytest.raises(UnreadableRecording, match="used up its 1 s of processor time"):
        read(on(reader.server, target="tests.sandbox.faults:spin"), BAG)


def refusal(reader: ConfinedReader, key: str) -> type[SkillsError]:
    with pytest.raises(SkillsError) as caught:
        read(reader, BAG, key=key)
    return type(caught.value)
