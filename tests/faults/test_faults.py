"""The faults of `make faults`, each at night; by day `tests/api/test_full_disk.py` has the answers to them."""

from pathlib import Path

import pytest

from tests.faults.__main__ import failed, written
from tests.faults.rows import FAULTS, Fault, run


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
