"""Both clients with the real service, which is killed and restarted while they wait."""

import asyncio
import hashlib
import threading
from pathlib import Path

import pytest

from skills.client import AsyncClient, Client, Retrying
from skills.seeds.recordings import sample_recordings
from tests.e2e.conftest import running

PATIENT = Retrying(attempts=100, longest_s=0.5, deadline_s=120)


@pytest.mark.nightly  # 20 s; by day tests/e2e and tests/jobs kill services
def test_from_a_file_to_a_checked_policy_while_the_service_is_killed(tmp_path: Path) -> None:
    sample = sample_recordings()[0]
    file, style = tmp_path / "sample.mcap", (sample.surgeon, sample.suture)
    file.write_bytes(sample.data)
    sent: list[tuple[int, int]] = []
    told: list[str] = []
    with running(tmp_path) as service, Client(service.url, retrying=PATIENT) as client:
        client.put_surgeon(sample.surgeon)
        demo = client.add_demo(file, surgeon=sample.surgeon, suture=sample.suture, progress=lambda *n: sent.append(n))
        assert sent[-1] == (len(sample.data), len(sample.data))
        service.kill()
        again = threading.Timer(1.0, service.start)
        again.start()
        job = client.wait(client.train(*style, release=True), 120, progress=lambda seen: told.append(seen.state))
        again.join()
        assert job.result is not None and job.result["released"]
        assert told[-1] == "succeeded" and len(set(told)) > 1
        policy = client.learnt(*style)
        assert policy.table().tolist() == client.policy(*style).actions
        back = client.save_recording(demo.id, tmp_path / "back.mcap")
        assert hashlib.sha256(back.read_bytes()).hexdigest() == demo.recording
        asyncio.run(the_same_awaited(service.url, style, demo.id, tmp_path))


async def the_same_awaited(url: str, style: tuple[str, str], demo: str, folder: Path) -> None:
    async with AsyncClient(url) as client:
        jobs = await asyncio.gather(*(client.train(*style, seed=seed) for seed in range(1, 4)))
        done = await asyncio.gather(*(client.wait(job, 120) for job in jobs))
        assert {job.state for job in done} == {"succeeded"}
        assert [one.version for one in await client.versions(*style)] == [4, 3, 2, 1]
        one, other = await asyncio.gather(client.learnt(*style), client.save_recording(demo, folder / "again.mcap"))
        assert one.seed == 0
        assert other.read_bytes() == (folder / "back.mcap").read_bytes()
        assert (await client.add_recording(other)).sha256 == (await client.demo(demo)).recording
