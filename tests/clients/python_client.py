"""A program with the client that openapi-python-client generates: `python_client.py URL TABLE SUTURE`."""

import sys
import time
from pathlib import Path

from made import Client
from made.api.catalogue import put_surgeon
from made.api.demonstrations import add_recording, get_demo_recording, upload_demo
from made.api.jobs import get_job, train
from made.api.plans import get_picture, make_plan, play
from made.api.policies import get_policy
from made.models import (
    Demonstration,
    Job,
    Plan,
    PlanIn,
    PlaybackIn,
    Policy,
    Recording,
    SurgeonIn,
    SuturePointIn,
    TrainingIn,
)
from made.types import File

url, table = sys.argv[1], Path(sys.argv[2])
style = {"surgeon": "wren", "suture": sys.argv[3]}
client = Client(base_url=url, timeout=60.0)


def done(job: Job) -> dict:
    """Wait for a job, and return its result."""
    until = time.monotonic() + 300
    while job.state not in ("succeeded", "failed", "cancelled"):
        assert time.monotonic() < until, job
        time.sleep(0.2)
        job = get_job.sync(job.id, client=client)
        assert isinstance(job, Job), job
    assert job.state == "succeeded", job.error
    return job.result.to_dict()


def upload() -> File:
    return File(payload=table.open("rb"), file_name=table.name, mime_type="text/csv")


put_surgeon.sync("wren", client=client, body=SurgeonIn(skill_level=None))
recording = add_recording.sync(client=client, body=upload())
assert isinstance(recording, Recording), recording
assert recording.left_out == []
demo = upload_demo.sync(client=client, body=upload(), **style)
assert isinstance(demo, Demonstration), demo
assert demo.recording == recording.sha256
asked = train.sync(client=client, body=TrainingIn(**style, release=True))
assert isinstance(asked, Job), asked
assert done(asked)["released"]
policy = get_policy.sync(**style, client=client)
assert isinstance(policy, Policy), policy
arrays = client.get_httpx_client().get(f"/policies/wren/{style['suture']}", headers={"Accept": "application/x-npz"})
assert arrays.status_code == 200 and arrays.content.startswith(b"PK"), arrays
back = get_demo_recording.sync(demo.id, client=client)
assert isinstance(back, File) and back.payload.read() == table.read_bytes(), back
plan = make_plan.sync(
    client=client,
    body=PlanIn(**style, suture_points=[SuturePointIn(position_mm=list(map(float, policy.goal_mm)))], handoff="none"),
)
assert isinstance(plan, Plan), plan
played = play.sync(client=client, body=PlaybackIn(plan=plan.sha256))
assert isinstance(played, Job), played
picture = get_picture.sync(done(played)["playback"], client=client)
assert isinstance(picture, File) and picture.payload.read().startswith(b"\x89PNG"), picture
print("version", policy.version, "phases", policy.phases, "demonstration", policy.demos[0])
