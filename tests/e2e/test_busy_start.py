"""A start with samples on a busy machine: every style is learnt, or shown failed with a way on."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skills.client import Client
from skills.seeds.recordings import sample_recordings
from tests.e2e.conftest import Service
from tests.waiting import until

BUSY = 6  # processes, on two cores
STARTS = 10
STYLES = {(one.surgeon, one.suture) for one in sample_recordings()}
ENDED = {"succeeded", "failed", "cancelled"}


@contextmanager
def busy_processes() -> Iterator[None]:
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(BUSY)]
    try:
        yield
    finally:
        for one in spinning:
            one.kill()
            one.wait()


@pytest.mark.nightly  # two to six minutes each
@pytest.mark.parametrize("_start", range(STARTS))
def test_every_style_of_the_samples_is_released_or_shown_failed(tmp_path: Path, _start: int) -> None:
    service = Service(tmp_path, workers=2)
    service.command.append("--samples")
    printed = tmp_path / "printed.txt"
    with busy_processes(), printed.open("wb") as service.stdout:
        try:
            service.start()
            until(lambda: "samples are" in printed.read_text(), by=[service.process] if service.process else [])
            with Client(service.url) as client:
                until(lambda: {one.state for one in client.jobs()} <= ENDED)
                jobs = client.jobs(kind="training")
                page = client.http.get("/", headers={"Accept": "text/html"}).text
                released = {one for one in STYLES if client.http.get(f"/policies/{one[0]}/{one[1]}").is_success}
        finally:
            service.stop()
    failed = [one for one in jobs if one.state == "failed"]
    said = printed.read_text()
    assert "The samples are loaded." in said, said  # all are stored and their trainings requested
    assert page.count("Try again") >= len(failed)
    unreleased = {f"{surgeon}, {suture}" for surgeon, suture in STYLES - released}
    assert len(unreleased) <= len(failed), unreleased
