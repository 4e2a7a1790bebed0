"""Speed of reading recordings, compared with decompressing their chunks and with libraries that decode each message."""

import struct
import time
import zipfile
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
import zstandard
from mcap.stream_reader import StreamReader
from mcap_ros2.reader import read_ros2_messages
from pyarrow import csv, parquet
from rich.table import Table

from skills.demonstration.demonstration import cut_demo
from skills.formats import read_recording
from skills.formats.mcap import read_mcap
from skills.gridworld.grid import discretize, fit_grid
from tests.bench.timing import best_s, in_turn
from tests.formats import bags, large, lerobots, others, records, written

ROUNDS = 9
LIBRARY_S = 3.0  # the libraries take a hundred times as long, so they read a shorter recording of the same kind


def reading(table: Table) -> None:
    """Read a session of four arms, a minute at 200 Hz, and a long recording of one arm."""
    session = large.four_arms()
    chunks = _chunks(session)
    size = sum(size for _, size in chunks)
    messages = sum(topic.messages for topic in read_mcap(BytesIO(session)).topics)
    unpacking, ours = in_turn(lambda: _unpack(chunks), lambda: read_mcap(BytesIO(session)), rounds=ROUNDS)
    table.add_row("reading four arms, 60 s at 200 Hz", f"{ours * 1e3:.0f} ms", f"{size / ours / 1e6:.0f} MB/s unpacked")
    table.add_row("  unpacking its chunks alone", f"{unpacking * 1e3:.0f} ms", f"{size / unpacking / 1e6:.0f} MB/s")
    after = ours - unpacking
    table.add_row("  ours, of that speed", f"{unpacking / ours:.2f}", f"{unpacking / after:.2f} without the unpacking")
    table.add_row("  a message", f"{ours / messages * 1e9:.0f} ns", f"{messages} messages")
    _libraries(ours / messages, table)
    _long(table)
    _tables(table)


def _libraries(ours_s: float, table: Table) -> None:
    session = large.four_arms(LIBRARY_S)
    messages = sum(topic.messages for topic in read_mcap(BytesIO(session)).topics)
    walking = best_s(lambda: sum(1 for _ in StreamReader(BytesIO(session), validate_crcs=True).records), 2) / messages
    decoding = best_s(lambda: sum(1 for _ in read_ros2_messages(BytesIO(session))), 2) / messages
    table.add_row("  mcap, records only", f"{walking * 1e9:.0f} ns a message", f"{walking / ours_s:.0f} x ours")
    table.add_row("  mcap-ros2-support", f"{decoding * 1e9:.0f} ns a message", f"{decoding / ours_s:.0f} x ours")


def _long(table: Table) -> None:
    data = large.one_arm(1_000_000)

    def work() -> None:
        tip_mm = cut_demo(read_mcap(BytesIO(data))).tip_mm
        discretize(tip_mm, fit_grid(tip_mm))

    table.add_row("10^6 poses: read, cut, discretised", f"{best_s(work, 3):.2f} s", "")


def _tables(table: Table) -> None:
    """Read tables and an episode, and the same files with pyarrow alone."""
    head, *rows = written.ee_csv().splitlines()
    stamps = (bags.START_NS + k * written.STEP_NS for k in range(30_000))
    lines = [f"{stamp},{rows[k % len(rows)].partition(',')[2]}" for k, stamp in enumerate(stamps)]
    _beside_arrow(table, "an ee_csv, 30,000 rows", "\n".join([head, *lines, ""]).encode(), _csv, frame="ECM")
    motion = written.sample("heron").motion_of()
    poses = [",".join(map(repr, row)) for row in np.column_stack([motion.tip_mm, motion.rotation_xyzw]).tolist()]
    lines = [f"{k // 200}.{k % 200 * 5:03d},{poses[k % len(poses)]}" for k in range(100_000)]
    narrow = "\n".join(["t_s,x_mm,y_mm,z_mm,qx,qy,qz,qw", *lines, ""]).encode()
    _beside_arrow(table, "a table of one arm's poses, 100,000 rows", narrow, _csv)
    files = lerobots.episode(lerobots.columns_of(300_000))
    data = files["data/chunk-000/episode_000000.parquet"]
    episode = others.zipped(files, zipfile.ZIP_STORED)
    _beside_arrow(table, "an episode of LeRobot, 300,000 frames", episode, lambda _: _parquet(data), frame="ECM")


def _beside_arrow(table: Table, name: str, data: bytes, bare: Callable[[bytes], object], **how: Any) -> None:
    works = lambda: read_recording(BytesIO(data), **how), lambda: bare(data)
    ours, theirs = in_turn(*works, rounds=5, clock=time.process_time)  # pyarrow works in threads of its own
    speed = len(data) / ours / 1e6
    table.add_row(name, f"{ours * 1e3:.0f} ms", f"{speed:.0f} MB/s, {1e3 / speed:.1f} s for 1 GB")
    table.add_row("  pyarrow alone", f"{theirs * 1e3:.0f} ms", f"{ours / theirs:.1f} x for ours")


def _csv(data: bytes) -> object:
    return csv.read_csv(BytesIO(data), csv.ReadOptions(use_threads=False))


def _parquet(data: bytes) -> object:
    return parquet.ParquetFile(BytesIO(data)).read(use_threads=False)


def _chunks(data: bytes) -> list[tuple[bytes, int]]:
    """Return the stored bytes and the size of every chunk, all of them zstd."""
    found = []
    for part in records.parts_of(data):
        if part.opcode == records.CHUNK:
            (size,) = struct.unpack_from("<Q", part.content, 16)
            found.append((part.content[28 + 4 + len("zstd") + 8 :], size))
    return found


def _unpack(chunks: list[tuple[bytes, int]]) -> None:
    for stored, size in chunks:
        zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
