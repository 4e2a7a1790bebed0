"""A cohort of known truth, stored as recordings of surgeons in sessions."""

import numpy as np

from skills.db.session import Database
from tests.comparison.cohort import Cohort, cohort
from tests.library import cases

EVERY = 4  # every fourth sample: 25 Hz, which is quicker to store and shows the same


def name(surgeon: int) -> str:
    return f"surgeon-{surgeon}"


def hand_off(drawn: Cohort, one: int) -> bytes:
    """Write one of its demonstrations as a table."""
    demo = drawn.demos[one]
    return cases.table(demo.tip_mm[::EVERY], stamps_s=demo.stamps_s[::EVERY])


def add_cohort(
    database: Database, drawn: Cohort | None = None, whose: np.ndarray | None = None, sessions: bool = True
) -> list[str]:
    """Store a cohort of eight surgeons in five sessions, and return the digests of its demonstrations."""
    drawn = drawn or cohort(1)
    whose = drawn.surgeons if whose is None else whose
    for surgeon in np.unique(whose):
        cases.add_surgeon(database, name(surgeon))
    return [
        cases.add_demo(
            database,
            hand_off(drawn, one),
            name(surgeon),
            session=f"session-{drawn.sessions[one]}" if sessions else None,
            grid="fit",
        ).sha256
        for one, surgeon in enumerate(whose.tolist())
    ]
