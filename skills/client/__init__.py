"""The typed client: every call of the service as a method, made at once or awaited.

    with Client("http://127.0.0.1:8000") as client:
        client.add_demo(Path("hand-off.mcap"), surgeon="kestrel", suture="simple-running")
        client.wait(client.train("kestrel", "simple-running", release=True))
        policy = client.policy("kestrel", "simple-running")

Answers are the models of `skills.api.schemas.given`; a field that this version does not know is passed over, and
`client.get_json` gives an answer as it came. What the service refuses is raised as `Problem`.
"""

from skills.client.files import Progress
from skills.client.problems import JobFailed, JobTakesLonger, NotReached, NotUnderstood, Problem, UnprotectedKey
from skills.client.retrying import Retrying
from skills.client.service import AsyncClient, Client

__all__ = [
    "AsyncClient",
    "Client",
    "JobFailed",
    "JobTakesLonger",
    "NotReached",
    "NotUnderstood",
    "Problem",
    "Progress",
    "Retrying",
    "UnprotectedKey",
]
