"""The typed client of the service, blocking (`Client`) and asynchronous (`AsyncClient`); every call is a method.

    with Client("http://127.0.0.1:8000") as client:
        client.add_demo(Path("hand-off.mcap"), surgeon="kestrel", suture="simple-running")
        client.wait(client.train("kestrel", "simple-running", release=True))
        policy = client.policy("kestrel", "simple-running")

Responses are the models of `skills.schemas`; unknown fields are ignored, and `client.get_json` returns a response as
plain JSON. An error that the service returns is raised as `Problem`.

The modules here are those of `AsyncClient`. `python -m tests.generated` generates `blocking/` from
them, except `waiting` and `socket`, and `skills.keywords` from the models of requests.
"""

from skills.client.blocking.client import Client
from skills.client.client import AsyncClient
from skills.client.files import Progress
from skills.client.problems import (
    JobFailed,
    JobTakesLonger,
    NotReached,
    NotUnderstood,
    Problem,
    SessionClosed,
    UnprotectedKey,
)
from skills.client.retrying import Retrying

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
    "SessionClosed",
    "UnprotectedKey",
]
