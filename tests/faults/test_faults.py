"""The faults of `make faults`, each at night; by day a short one without a worker, which needs no second start."""

import errno
import os
import resource
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import httpx2 as httpx
import pytest

from skills.db.session import Database
from tests.api.service import copy_of_trained
from tests.faults.__main__ import failed, written
from tests.faults.audit import audit, stored
from tests.faults.crew import STYLES, UPLOADER, Crew
from tests.faults.installation import Installation
from tests.faults.rows import FAULTS, Fault, run
from tests.faults.shim import Shim, compiler
from tests.library import cases


@pytest.mark.nightly
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_no_fault_loses_doubles_or_serves_wrongly(fault: Fault, tmp_path: Path):
    if fault.lacks:
        pytest.skip(f"the fault {fault.name} is not here: {fault.lacks}")
    row = run(fault, tmp_path, seed=1)
    print(written(row))
    found = row.verdict
    assert (found.lost, found.doubled, found.wrong) == ([], [], [])
    assert not failed(row), row.bugs


def test_without_space_and_then_without_descriptors_nothing_is_lost(tmp_path: Path):
    """The rows `no-space` and `descriptors` in small: uploads, releases, withdrawals, reads and backups."""
    if compiler() is None:
        pytest.skip("the faults of the disk are not here: install a C compiler")
    (inside := tmp_path / "installation").mkdir()
    url = copy_of_trained(inside)
    service = Installation(inside, shim := Shim(inside, tmp_path / "control"), workers=0)
    (backups := inside / "backups").mkdir()
    try:
        service.start()
        with closing(Database(url)) as database, httpx.Client(base_url=service.url) as http:
            http.put(f"/surgeons/{UPLOADER}", json={}).raise_for_status()
            http.delete(f"/policies/{STYLES[0]}/{cases.SUTURE}/release").raise_for_status()
            before = stored(database)
            crew = Crew([service.url], backups, service.environment, seed=1, training=False)
            with crew.at_work():
                crew.wait(lambda: crew.ledger.acknowledged().keys() >= KINDS)
                with shim.during(write_error=errno.ENOSPC):
                    crew.wait(lambda: refused(crew) >= {"POST /demos 507 storage-full"})
                with few_descriptors(service):
                    crew.wait(lambda: refused(crew) >= {"POST /demos 503 busy"})
                over_s = time.monotonic()
                crew.wait(lambda: all(crew.ledger.first_after(kind, over_s) for kind in KINDS))
            found = audit(crew.ledger, http, database, backups, before)
        assert (found.lost, found.doubled, found.wrong) == ([], [], [])
        assert not [answer for answer in refused(crew) if " 500 " in answer], service.bugs()
        assert service.exits == []
        assert any("No space left on device" in said or "disk is full" in said for said in service.said())
    finally:
        if service.process is not None:
            service.stop()


KINDS = {"upload", "release", "withdrawal", "backup"}


def refused(crew: Crew) -> set[str]:
    return {said for _, said in crew.ledger.refused}


@contextmanager
def few_descriptors(service: Installation) -> Iterator[None]:
    """Leave a service one free descriptor for the connection of a request, and none for a file."""
    pid = service.process.pid
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (len(os.listdir(f"/proc/{pid}/fd")) + 1, before[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
