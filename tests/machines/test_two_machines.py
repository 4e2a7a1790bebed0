"""Two machines with different processors on one database: trained here, played there, exported and verified on both."""

import json
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from skills.db.session import Database
from skills.learning.dynamic_programming import ValueIteration
from skills.packing import sha256
from skills.settings import settings
from tests import backends
from tests.library import cases
from tests.library.test_pose_styles import add_both
from tests.machines.elsewhere import export, play, wrong
from tests.machines.test_machines import OLDEST, PACKAGE


@pytest.mark.nightly  # by day the values are compared one by one
@pytest.mark.needs("simulator")
@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_a_plan_played_there_is_exported_here_and_nothing_is_wrong(backend: str, tmp_path: Path):
    url, key = backends.fresh(backend, tmp_path), str(settings().signing_key)
    with closing(Database(url)) as database:
        cases.add_surgeon(database)
        first = cases.add_demo(database)
        both = [add_both(database, shift_mm) for shift_mm in (0.0, 1.5)]
        cases.train(database, demos=[one.sha256 for one in both])
        cases.train(database, demos=[first.sha256], learner=ValueIteration(), release=True)
        plan = cases.add_plan(database)
        command = [sys.executable, "-W", "ignore", "-m", "tests.machines.elsewhere", url, key, plan.sha256]
        done = subprocess.run(command, env=os.environ | OLDEST, cwd=PACKAGE.parent, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        played, found, bag = json.loads(done.stdout)
        assert played["feasible"] is True
        assert found == list(wrong(database)) == []
        assert play(database, plan.sha256) == played, "an equal job succeeded there"
        assert sha256(export(database, plan.sha256)) == bag
    backends.drop(url)
