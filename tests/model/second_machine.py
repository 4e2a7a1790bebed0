"""A second machine: a process with the environment of another processor, which learns again and exports.

python -m tests.model.second_machine     answers each line of JSON, a request, with one
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import date
from hashlib import sha256
from typing import Any, ClassVar

import numpy as np
from sqlalchemy import select

import skills.db
from skills.db.models import Plan, PolicyVersion
from skills.db.session import Database
from skills.errors import SkillsError
from skills.formats.parsed import parse_recording
from skills.library.plans.replay import replay_bag
from skills.library.plans.replay_gate import ReplayConditions
from skills.library.policies.relearning import StoredRecordings, learn_again
from skills.settings import Settings
from skills.verification.arm_errors import UNCALIBRATED
from tests.model.replaced import Clock

LEAST = 0.9  # the probability that a bag requires


def environment() -> dict[str, str]:
    """Return the variables that differ on a machine without this processor's optional instructions."""
    core = np._core._multiarray_umath  # type: ignore[attr-defined]
    optional = [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name]]
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(optional),
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "OPENBLAS_CORETYPE": "Nehalem",
        "OPENBLAS_NUM_THREADS": "1",
    }


def seen(url: str) -> dict[str, Any]:
    """Return what differs in each version that is learnt again, and each plan's bag, or why there is none."""
    with closing(Database(url)) as database:
        with database.reading() as session:
            versions = session.execute(select(PolicyVersion.sha256, PolicyVersion.row)).all()
            plans = session.scalars(select(Plan.sha256)).all()
        recordings = StoredRecordings(database, parse_recording)
        again = {name: learn_again(database, row, recordings, Settings(database_url=url)) for name, row in versions}
        return {
            "differing": {name: list(one.differing) for name, one in again.items()},
            "left_out": {name: one.left_out for name, one in again.items()},
            "bags": {plan: _bag(database, plan) for plan in plans},
        }


def _bag(database: Database, plan: str) -> str:
    try:
        bag = replay_bag(database, plan, ReplayConditions(UNCALIBRATED, LEAST, handoff="none"))
    except SkillsError as refused:
        return refused.words()
    return sha256(bag).hexdigest()


class SecondMachine:
    """The process, started at its first use in a test."""

    process: ClassVar["subprocess.Popen[str] | None"] = None

    @classmethod
    def seen(cls, url: str) -> Any:
        """Return what `seen` returns there."""
        if cls.process is None:
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            command = [sys.executable, "-m", __name__]
            cls.process = subprocess.Popen(command, env=os.environ | environment(), **pipes)  # type: ignore[call-overload]
        assert cls.process is not None and cls.process.stdin and cls.process.stdout
        cls.process.stdin.write(json.dumps([url, Clock.day.isoformat()]) + "\n")
        cls.process.stdin.flush()
        return json.loads(cls.process.stdout.readline() or '"it has ended; see its errors"')


@contextmanager
def within_reach() -> Iterator[None]:
    """End the process at the end of the block."""
    try:
        yield
    finally:
        if SecondMachine.process is not None:
            SecondMachine.process.communicate()
            SecondMachine.process = None


def main() -> None:
    """Answer requests until there are no more."""
    skills.db.datetime = Clock  # type: ignore[attr-defined]
    for line in sys.stdin:
        url, day = json.loads(line)
        Clock.day = date.fromisoformat(day)
        print(json.dumps(seen(url)), flush=True)


if __name__ == "__main__":
    main()
