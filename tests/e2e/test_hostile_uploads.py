"""Hostile files sent to the real service: each is refused with a message or accepted, and nothing else suffers."""

import os
import signal
import sqlite3
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event
from typing import Any

import httpx2 as httpx
import numpy as np
import pytest

from skills.client import Client
from skills.formats import BYTES
from tests.api.service import KESTREL, MCAP, assert_problem
from tests.by_day import some
from tests.e2e.conftest import FORK_SERVER, Service, running
from tests.formats import hostile, lerobots
from tests.formats.test_tables_hostile import FILES, mutations
from tests.library import cases
from tests.measured import peak_mib
from tests.waiting import END_S, crowded

BAG = cases.bag()
EPISODE = lerobots.packed(lerobots.episode()).getvalue()
TABLE_BOMBS = {
    "a million rows of one value": b"x_mm,y_mm,z_mm\n" + 1_000_000 * b"0,50,-120\n",
    "a million empty lines": b"x_mm,y_mm,z_mm\n0,50,-120\n" + 1_000_000 * b"\n",
    "a line of 10 MB": b"x_mm,y_mm,z_mm\n" + 10_000_000 * b"1",
    "a million columns": b",".join([b"x_mm"] * 1_000_000) + b"\n",
    "a million brackets of numpy": b"x_mm,y_mm,z_mm\n" + 1_000_000 * b"np.float64(",
    "numbers of 5000 digits": b"x_mm,y_mm,z_mm\n" + 500 * b",".join(3 * [b"0." + 5000 * b"1"]) + b"\n",
    "exponents of 1000 digits": b"x_mm,y_mm,z_mm\n" + 1000 * (b",".join(3 * [b"1e-" + 1000 * b"9"]) + b"\n"),
}
BOMB_S = 5.0  # of processor time, so that other load does not matter
OTHERS_S = 0.25
GROWTH_MIB = 64
ALL_BOMBS = hostile.BOMBS | hostile.LARGE_BOMBS
QUICK_BOMBS = [
    "zstd of 1 GiB that claims 100 bytes",
    "lz4 of 256 MiB that claims 64 MiB",
    "64 MiB of empty records, zstd",
    "an array of 2^32 joints",
    "a definition of 2^40 fields",
]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with running(tmp_path_factory.mktemp("hostile"), workers=0) as service, Client(service.url) as client:
        client.put_surgeon("kestrel")
        yield service


@pytest.fixture(scope="module")
def http(service: Service) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=END_S) as http:
        yield http


def send(
    http: httpx.Client, data: bytes, path: str = "/recordings", table: dict[str, Any] | None = None
) -> httpx.Response:
    query: dict[str, Any] = dict(KESTREL) if path == "/demos" else {}
    if table is not None:
        return http.post(path, params=table, content=data, headers={"Content-Type": BYTES})
    if not data.startswith(b"PK"):
        return http.post(path, params=query, content=data, headers={"Content-Type": MCAP})
    query |= {"frame": "ECM"} | ({"arm": "PSM1", "segment": "whole"} if query else {})
    return http.post(path, params=query, content=data, headers={"Content-Type": "application/zip"})


def rows(service: Service) -> dict[str, int]:
    """Count the rows of every table except the workers' own."""
    connection = sqlite3.connect(service.database)
    tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    tables.remove("executors")
    counts = {name: connection.execute(f"SELECT count(*) FROM {name}").fetchone()[0] for name in tables}
    connection.close()
    return counts


def reading_s(service: Service) -> float:
    """Return the processor time of all forks so far."""
    fields = Path(f"/proc/{service.child(FORK_SERVER)}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[13:15])) / os.sysconf("SC_CLK_TCK")  # cutime and cstime of proc(5)


def recorded(http: httpx.Client, demo: dict[str, Any]) -> tuple[Any, Any]:
    path = http.get(f"/demos/{demo['id']}/path").json()
    return path["stamps_s"], path["recorded_mm"]


@contextmanager
def others_are_served(http: httpx.Client) -> Iterator[None]:
    """Request the catalogue continuously: 19 of 20 responses arrive in time, although other tests share the machine."""
    over, took = Event(), []

    def ask() -> None:
        while not over.is_set():
            began = time.monotonic()
            assert http.get("/suture-types").status_code == 200
            took.append(time.monotonic() - began)
            time.sleep(0.02)

    with ThreadPoolExecutor(1) as thread:
        asking = thread.submit(ask)
        try:
            yield
        finally:
            over.set()
            asking.result()
    assert float(np.quantile(took, 0.95)) < OTHERS_S * crowded()


def sweep(service: Service, http: httpx.Client, files: Iterable[bytes], table: dict[str, Any] | None = None) -> int:
    """Send files, and count the accepted ones: all others give 4xx and leave no row."""
    before, accepted = rows(service), set()
    for data in files:
        answer = send(http, data, table=table)
        if answer.status_code in (200, 201):
            accepted.add(answer.json()["id"])
        else:
            assert_problem(answer, range(400, 500))
    assert rows(service)["recordings"] - before["recordings"] <= len(accepted)
    assert rows(service)["demonstrations"] == before["demonstrations"]
    return len(accepted)


def same_or_refused(http: httpx.Client, files: Iterable[bytes], sound: bytes = BAG) -> None:
    whole = send(http, sound, "/demos").json()
    for data in files:
        answer = send(http, data, "/demos")
        if answer.status_code in (200, 201):
            assert recorded(http, answer.json()) == recorded(http, whole)
        else:
            assert_problem(answer, range(400, 500))


def defuse(service: Service, http: httpx.Client, names: Iterable[str]) -> list[float]:
    """Send bombs while others are served and memory is watched; return the seconds that each took."""
    assert send(http, BAG).status_code in (200, 201)
    processes = [service.process.pid, service.child(FORK_SERVER)]
    before, peaks, took = rows(service), [peak_mib(pid) for pid in processes], []
    with others_are_served(http):
        for name in names:
            began = reading_s(service)
            assert_problem(send(http, ALL_BOMBS[name]()), range(400, 500))
            took.append(reading_s(service) - began)
            assert took[-1] < BOMB_S, name
    assert rows(service) == before
    assert max(peak_mib(pid) - peak for pid, peak in zip(processes, peaks, strict=True)) < GROWTH_MIB
    return took


def test_what_is_cut_or_put_together_wrongly_is_refused(service, http):
    assert sweep(service, http, hostile.truncations(BAG, 10, seed=1)) == 0
    sweep(service, http, hostile.mutations(BAG, 20, seed=1))


def test_a_flipped_bit_is_refused_or_changes_nothing(http):
    same_or_refused(http, hostile.flips(BAG, 10, seed=1))


def test_bombs_are_refused_in_seconds_and_nobody_else_notices(service, http):
    defuse(service, http, QUICK_BOMBS)


@pytest.mark.nightly  # by day tests/formats/test_lerobot_hostile.py
def test_damaged_and_hostile_lerobot_episodes_are_refused(service, http):
    assert sweep(service, http, hostile.truncations(EPISODE, 10, seed=1)) == 0
    same_or_refused(http, hostile.flips(EPISODE, 10, seed=1), EPISODE)
    before = rows(service)
    for name, bomb in lerobots.BOMBS.items():
        began = reading_s(service)
        assert "errors" not in assert_problem(send(http, bomb()), range(400, 500)), name
        assert reading_s(service) - began < BOMB_S, name
    several = lerobots.packed(lerobots.dataset("v2.1")).getvalue()
    assert "has 3 episodes" in assert_problem(send(http, several), range(400, 500))["detail"]
    assert rows(service) == before


@pytest.mark.parametrize("count", [2, pytest.param(50, marks=pytest.mark.nightly)])
def test_damaged_and_misassembled_tables_are_refused_or_stored(service, http, count):
    """That an accepted one is read as its text says, is tested in `tests/formats/test_tables_hostile.py`."""
    for name, (text, how) in FILES.items():
        accepted = sweep(service, http, hostile.truncations(text.encode(), count, seed=count), how)
        assert accepted <= 0.1 * count or not name.startswith("ee_csv")
        sweep(service, http, hostile.flips(text.encode(), count, seed=count), how)
        sweep(service, http, mutations(text, count, seed=count), how)


@pytest.mark.parametrize("name", some(TABLE_BOMBS, 4))
def test_table_bombs_are_refused_or_read_within_the_limits(service, http, name):
    began = reading_s(service)
    answer = send(http, TABLE_BOMBS[name], table={"rate_hz": 100, "frame": "ECM"})
    assert answer.status_code == 201 or assert_problem(answer, range(400, 500))
    assert reading_s(service) - began < BOMB_S


@pytest.mark.nightly
def test_50_of_each_kind_and_all_bombs(service, http):
    assert sweep(service, http, hostile.truncations(BAG, 50)) == 0
    sweep(service, http, hostile.mutations(BAG, 50))
    same_or_refused(http, hostile.flips(BAG, 50))
    defuse(service, http, ALL_BOMBS)


def test_16_uploads_at_once_are_read_and_others_are_served(service, http):
    files = [cases.bag(tip=cases.points_mm((0.1 * k, 0.0, 0.1))) for k in range(16)]
    with others_are_served(http), ThreadPoolExecutor(16) as threads:
        answers = list(threads.map(lambda data: send(http, data), files))
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["id"] for answer in answers}) == 16


def test_an_upload_after_the_fork_server_was_killed_succeeds(service, http):
    killed = service.child(FORK_SERVER)
    os.kill(killed, signal.SIGKILL)
    assert send(http, cases.bag(tip=cases.points_mm((0.0, 0.2, 0.0)))).status_code == 201
    assert service.child(FORK_SERVER) != killed


def test_a_stored_recording_is_read_apart_too(service, http):
    recording = send(http, BAG).json()["id"]
    with closing(sqlite3.connect(service.database)) as database, database:
        database.execute("DELETE FROM parsed_chunks")
        database.execute("DELETE FROM parsed_recordings")
    os.kill(service.child(FORK_SERVER), signal.SIGKILL)
    answer = http.post(f"/recordings/{recording}/demos", json=KESTREL | {"grid": "fit", "cell_mm": 2.5})
    assert answer.status_code == 201
    assert peak_mib(service.child(FORK_SERVER)) > 0
