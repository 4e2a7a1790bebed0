"""The worker as a child of the service, so that Python work never stands in the way of an answer."""

import os
import subprocess
import sys

from skills.settings import Settings

PREFIX = "SKILLS_"


def start_worker_child(settings: Settings) -> subprocess.Popen[bytes]:
    """Start a worker in a fresh interpreter, at lower priority; it ends when this process does.

    End it with `terminate()` and `wait()`: it finishes what it has begun, within ten seconds. It is not started again
    by itself.
    """
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "skills.jobs.worker", str(os.getpid())],
        env=environment(settings),
        stdin=subprocess.DEVNULL,
    )


def environment(settings: Settings) -> dict[str, str]:
    """Write settings as the environment that reads back as just these."""
    others = {name: value for name, value in os.environ.items() if not name.upper().startswith(PREFIX)}
    ours = {PREFIX + name.upper(): str(value) for name, value in settings if value is not None}
    return others | ours
