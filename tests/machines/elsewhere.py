"""Work of a second machine on a database that the first one has filled: play, learn again, verify, export.

python -m tests.machines.elsewhere URL KEY PLAN      prints the verdict, what is wrong, and the bag's digest
"""

import json
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from skills.db.session import Database
from skills.formats.parsed import parse_recording
from skills.library.operation.inspection import inspect_installation, inspect_policies
from skills.library.plans.playbacks import request_playback
from skills.library.plans.replay import replay_bag
from skills.library.plans.replay_gate import ReplayConditions
from skills.packing import sha256
from skills.settings import Settings
from skills.verification.arm_errors import UNCALIBRATED
from tests.library import cases


def play(database: Database, plan: str) -> dict[str, object]:
    with database.writing() as session:
        job = request_playback(session, plan, "test", Settings(), UNCALIBRATED)[0]
    ended = cases.work(database, job)
    assert ended.state == "succeeded", ended.error
    return ended.result or {}


def export(database: Database, plan: str) -> bytes:
    return replay_bag(database, plan, ReplayConditions(UNCALIBRATED, 0.0, handoff="none"))


def wrong(database: Database) -> Iterator[str]:
    """Yield what is wrong in a database, and which policies could not be learnt again."""
    for part in {id(one): one for one in inspect_installation(database)}.values():
        yield from (f"{part.what}: {name}: {why}" for name, why in part.wrong)
    for part in {id(one): one for one in inspect_policies(database, parse_recording, Settings())}.values():
        yield from (f"{part.what}: {name}: {why}" for name, why in (*part.wrong, *part.left_out))
        assert part.count == (part.of or 0)


if __name__ == "__main__":
    url, key, plan = sys.argv[1:]
    with closing(Database(url, signing_key=Path(key))) as database:
        print(json.dumps([play(database, plan), list(wrong(database)), sha256(export(database, plan))]))
