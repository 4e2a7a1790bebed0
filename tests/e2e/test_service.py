"""The service as processes: killed and restarted, stopped, refused."""

import os
import secrets
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from skills.client import Client
from skills.seeds.recordings import sample_recordings
from tests.e2e.conftest import FORK_SERVER, WORKER, running
from tests.waiting import END_S, alive, until

SLOW_LEARNER = {"kind": "cell-q-learning", "episodes": 300_000}  # a few seconds of work


@pytest.mark.nightly  # 20 s; by day tests/jobs kill workers
def test_what_was_acknowledged_survives_a_kill_and_the_training_goes_on(tmp_path: Path) -> None:
    sample = sample_recordings()[0]
    style = (sample.surgeon, sample.suture)
    with running(tmp_path) as service, Client(service.url) as client:
        client.put_surgeon(sample.surgeon)
        demo = client.add_demo(sample.data, surgeon=sample.surgeon, suture=sample.suture)
        job = client.train(*style, learner=SLOW_LEARNER)
        until(lambda: client.job(job.id).state != "queued")
        assert client.job(job.id).state == "running"
        service.kill()
        service.start()
        assert client.demo(demo.id).state == "active"
        assert client.demo_recording(demo.id) == sample.data
        done = client.wait(client.job(job.id), timeout_s=END_S)
        assert done.state == "succeeded"
        assert [v.version for v in client.versions(*style)] == [1]
        assert client.train(*style, learner=SLOW_LEARNER).id == job.id


@pytest.mark.nightly  # by day tests/api, without a server
def test_a_recording_is_returned_exactly_and_two_segments_give_two_demos(tmp_path: Path) -> None:
    sample = next(s for s in sample_recordings() if len(s.segments) > 1)
    with running(tmp_path, workers=0) as service, Client(service.url) as client:
        client.put_surgeon(sample.surgeon)
        first, again = client.add_recording(sample.data), client.add_recording(sample.data)
        assert first.id == again.id
        parts = first.segments[:2]
        demos = [
            client.cut_demo(first.id, surgeon=sample.surgeon, suture=sample.suture, start_s=p.start_s, end_s=p.end_s)
            for p in parts
        ]
        assert len({d.id for d in demos}) == 2
        assert {d.recording for d in demos} == {first.id}
        assert all(client.demo_recording(d.id) == sample.data for d in demos)


def test_the_process_of_the_readers_has_no_secret_in_its_memory(tmp_path: Path) -> None:
    secret = secrets.token_hex(16)
    with running(tmp_path, workers=0, api_key=secret) as service:
        reader = service.child(FORK_SERVER)
        assert secret.encode() not in Path(f"/proc/{reader}/environ").read_bytes()
        try:
            held = [has_in_memory(pid, secret.encode()) for pid in (service.process.pid, reader)]
        except PermissionError:
            pytest.skip("NOT TESTED - only root may read the memory of a process that is not dumpable")
    assert held == [True, False]


def has_in_memory(pid: int, word: bytes) -> bool:
    """Return whether the writable memory of a process contains a word."""
    with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            place, rights, *_ = line.split()
            if rights.startswith("rw"):
                start, end = (int(part, 16) for part in place.split("-"))
                memory.seek(start)
                with suppress(OSError):  # of a device
                    if word in (memory.read(end - start) or b""):
                        return True
    return False


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_stopped_service_exits_with_0_and_takes_its_children_along(tmp_path: Path, workers: int) -> None:
    with running(tmp_path, workers=workers) as service:
        until(lambda: len(service.children(WORKER)) == workers)
        children = [*service.children(WORKER), service.child(FORK_SERVER)]
        assert service.stop() == 0
    until(lambda: not any(map(alive, children)))


@pytest.mark.nightly  # by day tests/jobs kill workers
def test_a_worker_that_dies_is_replaced_and_its_job_done(tmp_path: Path) -> None:
    sample = sample_recordings()[0]
    with running(tmp_path) as service, Client(service.url) as client:
        client.put_surgeon(sample.surgeon)
        client.add_demo(sample.data, surgeon=sample.surgeon, suture=sample.suture)
        os.kill(service.child(WORKER), signal.SIGKILL)
        done = client.wait(client.train(sample.surgeon, sample.suture, release=True), timeout_s=END_S)
        assert done.result["released"]


@pytest.mark.nightly  # by day tests/test_settings.py refuses them
@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7", "example.org"])
def test_an_address_that_others_can_reach_is_refused(tmp_path: Path, host: str) -> None:
    environment = os.environ | {"SKILLS_HOST": host, "SKILLS_DATABASE_URL": f"sqlite:///{tmp_path / 's.sqlite'}"}
    ended = subprocess.run([sys.executable, "-m", "skills", "serve"], env=environment, capture_output=True, text=True)
    assert ended.returncode == 1
    assert "SKILLS_HOST" in ended.stderr
    assert not list(tmp_path.iterdir())
