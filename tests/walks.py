"""Three walks through the code, as lists of functions with their files, taken from a trace of real calls.

    python -m tests.walks        bytes to demonstration, request to served policy, suture point to replay bag

A station is a public function that is called from another room, at its first call. Methods, private modules such as
`_kernels`, the client, the start of the service, its periodic work and the modules that every room uses (`COMMON`) are
left out of the list. The line above it counts everything: the functions of the package that were called, their files,
and how often a call is in another room than the call before it (`TOOLS` are no rooms). `ONCE` are functions of which a
request needs one call.
"""

import io
import re
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import skills
from skills.compiled import LOOPS
from skills.formats.parsed import parse_recording
from tests import backends
from tests.api.service import CSV, GOAL_MM, KESTREL, MCAP, POLICY, serving
from tests.library import cases

PACKAGE = str(Path(skills.__file__).parent)
COMMON = ("errors", "remedies", "settings", "logs", "arrays", "fields", "packing", "compiled", "kinematics")
COMMON += (
    "db/",
    "client/",
    "api/app",
    "jobs/__init__",
    "library/people/surgeons.py",
    "library/people/suture_types.py",
    "library/people/keys.py",
    "library/operation/locks.py",
)
COMMON += ("library/operation/history.py", "transparency/")  # what is written is logged, whoever writes it
ONCE = ("find_plan", "time_parametrise", "stack", "plan_identity")
PERIODIC = ("forget_erased", "forget_gone", "_sweep", "is_last_signed")  # part of no request, and a slow walk has them
STARTING = ("confined_reader", "stated_errors", "migrate", "seed_catalogue", "create_app")  # called once by the service
# Numbers, bytes and words: a reader knows them after the first page, and stays in the room that calls them.
TOOLS = ("arrays.py", "arithmetic.py", "quaternions.py", "kinematics.py", "compiled.py", "packing.py", "fields.py")
TOOLS += ("errors.py", "remedies.py", "settings.py", "logs.py", "transparency")


def room(file: str) -> str:
    """Return the folder, or the module, directly inside the package."""
    return file.removeprefix(f"{PACKAGE}/").partition("/")[0]


def in_background(frame: FrameType | None) -> bool:
    """Return whether a call is part of the service's start or of its periodic work, and of no request."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGE) and frame.f_code.co_name in (*PERIODIC, *STARTING):
            return True
        frame = frame.f_back
    return False


class Trace:
    """A record of the calls between rooms of the package, in their order."""

    def __init__(self) -> None:
        self.stations: dict[CodeType, str] = {}
        self.calls: Counter[CodeType] = Counter()
        self.here = ""
        self.changes = 0  # of room, from one call to the next

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Record a call; a profile function of `sys.setprofile`."""
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(PACKAGE) or code.co_name.startswith("<"):
            return
        self.calls[code] += 1
        here = room(code.co_filename)
        if here not in TOOLS and not in_background(frame):
            self.changes += here != self.here
            self.here = here
        if code in self.stations:
            return
        file = code.co_filename.removeprefix(f"{PACKAGE}/")
        if (
            "." in code.co_qualname
            or code.co_name.startswith(("_", "<", *PERIODIC, *STARTING))
            or file.startswith(COMMON)
            or re.search(r"/_[a-z]", file)
            or any(loop.plain.__code__ is code for loop in LOOPS)
        ):
            return
        caller = frame.f_back
        while caller is not None and not caller.f_code.co_filename.startswith(PACKAGE):
            caller = caller.f_back
        if caller is not None and caller.f_code.co_name in PERIODIC:
            return
        if caller is None or room(caller.f_code.co_filename) != room(code.co_filename):
            self.stations[code] = f"{code.co_qualname}  {file}"


@contextmanager
def tracing(title: str) -> Iterator[None]:
    """Print the stations of the calls that are made inside, in this thread and in those that it starts."""
    trace = Trace()
    threading.setprofile(trace)
    sys.setprofile(trace)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    files = {code.co_filename for code in trace.calls}
    print(f"\n{title}: {len(trace.calls)} functions, {len(files)} files, {trace.changes} changes of room")
    print(", ".join(f"{name} {sum(n for c, n in trace.calls.items() if c.co_name == name)}" for name in ONCE))
    for number, station in enumerate(trace.stations.values(), start=1):
        print(f"{number:4} {station}")


def main() -> None:
    """Take the three walks on a new SQLite database, as HTTP calls and the jobs that they start."""
    with tempfile.TemporaryDirectory() as folder:
        url = backends.fresh("sqlite", Path(folder))
        with serving(url) as service:  # what is loaded and compiled at a first call is loaded and compiled here
            service.client.put_surgeon("kestrel")
            service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
            service.train()
        data = cases.bag()
        with tracing("bytes to demonstration"):
            parse_recording(io.BytesIO(data))  # in the service in a process of its own, where no trace reaches
            with serving(url) as service:
                service.client.add_demo(data, media_type=MCAP, **KESTREL)
        with tracing("request to served policy"), serving(url) as service:
            service.train(release=True)
            service.http.get(POLICY)
        with tracing("suture point to replay bag"), serving(url, replay_lower_bound=0.0) as service:
            plan = service.client.plan(**KESTREL, suture_points=[GOAL_MM], handoff="none", tissue_mm=-170.0)
            service.client.play(plan["id"])
            service.work()
            service.http.get(f"/plans/{plan['id']}/trajectory?handoff=none", headers={"Accept": "application/zip"})


if __name__ == "__main__":
    main()
