"""Small hand-offs as tables and bags, and their way to a playback, with the library calls that the service makes."""

import io
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from itertools import pairwise
from threading import Event
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, Plan, PolicyVersion
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.demonstration.recording import Motion, Recording
from skills.formats import write_mcap
from skills.jobs.attempts import Work
from skills.learning.policy import describe_learner
from skills.learning.q_learning import CellQLearning
from skills.library.operation.inspection import inspect_installation
from skills.library.operation.jobs import BATCH
from skills.library.people.surgeons import put_surgeon
from skills.library.people.suture_types import seed_suture_types
from skills.library.perform import perform_job
from skills.library.plans.plans import plan_sutures
from skills.library.policies import releases
from skills.library.policies.training import request_training
from skills.library.policies.versions import find_by_digest
from skills.library.recordings.demos import upload_demo
from skills.library.recordings.recordings import Upload
from skills.packing import sha256
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.plans import PlanIn
from skills.schemas.training import TrainingIn
from skills.settings import Settings

T = TypeVar("T")

SUTURE = "simple-running"
PUBLISHED = CellQLearning.published()
RATE_HZ = 50
START_NS = 1_760_000_000_000_000_000
CORNERS_MM = np.array([[-10, 55, -135], [-20, 60, -130], [-10, 55, -120], [5, 55, -125]], dtype=float)


def points_mm(shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), samples: int = 20) -> np.ndarray:
    """Return a path around three corners inside the paper's grid, seven cells in all; shape (3 samples, 3)."""
    legs = [np.linspace(a, b, samples) for a, b in pairwise(CORNERS_MM)]
    return np.concatenate(legs) + np.asarray(shift_mm)


def table(tip: np.ndarray, *, unit: str = "mm", rate_hz: float = RATE_HZ, stamps_s: Any = None) -> bytes:
    """Write positions as a CSV file."""
    stamps = np.arange(len(tip)) / rate_hz if stamps_s is None else stamps_s
    rows = [f"{t!r},{x!r},{y!r},{z!r}" for t, (x, y, z) in zip(np.asarray(stamps).tolist(), tip.tolist(), strict=True)]
    return "\n".join([f"t_s,x_{unit},y_{unit},z_{unit}", *rows, ""]).encode()


def hand_off(shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
    """Return one hand-off as a table; another shift gives another recording and another path."""
    return table(points_mm(shift_mm))


def bag(*arms: str, tip: np.ndarray | None = None) -> bytes:
    """Write the hand-off as the MCAP file of a dVRK, by each of the arms."""
    tip = points_mm() if tip is None else tip
    stamps_ns = START_NS + np.arange(len(tip)) * (10**9 // RATE_HZ)
    down = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (len(tip), 1))
    motions = [Motion(a, f"/{a}/local/measured_cp", f"{a}_base", stamps_ns, tip, down) for a in arms or ("PSM2",)]
    return write_mcap(Recording(format="mcap", integrity="full", motions=tuple(motions)))


def upload(data: bytes, media_type: str = "text/csv", **how: Any) -> Upload:
    return Upload(io.BytesIO(data), sha256(data), len(data), media_type, **how)


def fetch(database: Database, function: Callable[..., T], *given: Any, **how: Any) -> T:
    """Call a function of the library in a reading transaction, and return its result."""
    with database.reading() as session:
        return function(session, *given, **how)


def add_surgeon(database: Database, slug: str = "kestrel", **about: Any) -> None:
    with database.writing() as session:
        seed_suture_types(session)
        put_surgeon(session, slug, SurgeonIn.model_validate(about), "test")


def committed(database: Database, change: Callable[..., T], *asked: Any, **how: Any) -> T:
    """Call a use case in a transaction of its own."""
    with database.writing() as session:
        return change(session, *asked, **how)


def agree(session: Session, consent: Any, surgeon: str = "kestrel") -> None:
    """Record a surgeon's consent, and nothing else of the surgeon."""
    put_surgeon(session, surgeon, SurgeonIn(consent=consent), "test")


def add_demo(database: Database, data: bytes | None = None, surgeon: str = "kestrel", **cut: Any) -> Demonstration:
    """Store one demonstration, and return its row."""
    return store(database, upload(data or hand_off()), surgeon, **cut)


def store(database: Database, sent: Upload, surgeon: str = "kestrel", **cut: Any) -> Demonstration:
    """Store one demonstration of an upload, and return its row."""
    return upload_demo(database, sent, DemoIn(surgeon=surgeon, suture=SUTURE, **cut), "test").row


def trained(database: Database, data: bytes | None = None, **asked: Any) -> PolicyVersion:
    """Store one demonstration and train from it; return the version."""
    add_demo(database, data)
    return train(database, **asked)


def release(database: Database, version: PolicyVersion, **how: Any) -> None:
    """Release a version."""
    with database.writing() as session:
        releases.release(session, find_by_digest(session, version.sha256), "test", **how)


def ask_training(database: Database, surgeon: str = "kestrel", **asked: Any) -> Job:
    with database.writing() as session:
        if "learner" in asked:
            asked["learner"] = describe_learner(asked["learner"])
        if asked.get("combine"):
            asked["combine"] = {"kind": asked["combine"]}
        return request_training(session, TrainingIn(surgeon=surgeon, suture=SUTURE, **asked), "test")[0]


def work(database: Database, job: Job) -> Job:
    """Carry out a job as a worker does: mark it running, perform it, or record why it failed."""
    settled = Work(database, Settings(database_url=database.url), perform_job).try_once(job.row, job.attempt, 0)
    assert settled, "the job failed inside the service"
    with database.reading() as session:
        return session.get_one(Job, job.row)


def wrong(database: Database, *left_out: str, **how: Any) -> list[tuple[str, str]]:
    """Inspect everything that is stored, as `skills verify` does, and return the faults, except those of some parts."""
    parts = {id(part): part for part in list(inspect_installation(database, **how))}.values()
    return [one for part in parts for one in part.wrong if part.what not in left_out]


@contextmanager
def working(settings: Settings) -> Iterator[None]:
    """Carry out all jobs in a thread, in the place of `skills.serving.working`: no process to start for each command.

    There is no engine, and a job of which an attempt fails is given up at once.
    """
    over = Event()

    def work_on() -> None:
        with closing(Database(settings.database_url, signing_key=settings.signing_key)) as database:
            carried_out = Work(database, settings, perform_job)
            while not over.wait(0.02):
                with database.reading() as session:
                    active = Job.state.in_(("queued", "running")), Job.kind != BATCH  # a batch ends with its last part
                    waiting = session.execute(select(Job.row, Job.attempt).where(*active)).all()
                for row, attempt in waiting:
                    if not (over.is_set() or carried_out.try_once(row, attempt, 0)):
                        carried_out.give_up(row, attempt)

    with ThreadPoolExecutor(1) as pool:
        worker = pool.submit(work_on)
        try:
            yield
        finally:
            over.set()
            worker.result()


def train(database: Database, surgeon: str = "kestrel", **asked: Any) -> PolicyVersion:
    """Train, and return the resulting version."""
    job = work(database, ask_training(database, surgeon, **asked))
    assert job.state == "succeeded", job.error
    with database.reading() as session:
        return session.query(PolicyVersion).filter_by(sha256=job.result["sha256"]).one()


def add_plan(database: Database, surgeon: str = "kestrel", **asked: Any) -> Plan:
    """Plan one pass above level tissue; unless PSM_M is given it has no hand-off."""
    asked = {"tissue_mm": -170.0} | asked
    if "psm_m" not in asked:
        asked = {"handoff": "none"} | asked
    return plan_sutures(
        database,
        PlanIn(surgeon=surgeon, suture=SUTURE, suture_points=[{"position_mm": (5.0, 55.0, -125.0)}], **asked),
        "test",
    )[0]
