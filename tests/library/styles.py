"""Many styles at little cost: one hand-off, demonstrated by many surgeons for many suture types."""

from itertools import count, islice

from sqlalchemy import func, select, text

from skills.db.models import Demonstration, PolicyVersion, SutureType
from skills.db.service_tables import Job, StyleToRetrain
from skills.db.session import Database
from skills.formats.parsed import parse_recording
from skills.learning.policy import describe_learner
from skills.library.operation.jobs import PART
from skills.library.people.surgeons import put_surgeon
from skills.library.people.suture_types import seed_suture_types
from skills.library.policies.releases import in_force
from skills.library.policies.retraining import request_retraining
from skills.library.recordings import demos
from skills.library.recordings.content_cache import entry_of
from skills.library.recordings.demos import Made, make_demo
from skills.library.recordings.recordings import find_recording, put_recording
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.training import RetrainingIn
from tests.library import cases

NO_CONSENT = {"consent": {"uses": ["atlas"], "until": None}}


def add_styles(database: Database, number: int) -> list[tuple[str, str]]:
    """Add a number of styles, twelve per surgeon; return their surgeons and suture types."""
    cases.committed(database, seed_suture_types)
    with database.reading() as session:
        sutures = session.scalars(select(SutureType.slug).order_by(SutureType.slug)).all()
    pairs = ((f"surgeon-{n}", suture) for n in count() for suture in sutures)
    styles = list(islice(pairs, number))
    made, sha256 = made_once(database)
    with database.writing() as session:
        for surgeon in sorted({surgeon for surgeon, _ in styles}):
            put_surgeon(session, surgeon, SurgeonIn(), "test")
        stored = find_recording(session, sha256)
        for surgeon, suture in styles:
            demos._store_demo(session, stored, made, DemoIn(surgeon=surgeon, suture=suture), "test")
    return styles


def made_once(database: Database) -> tuple[Made, str]:
    upload = cases.upload(cases.hand_off())
    told = parse_recording(upload.file)
    cases.committed(database, put_recording, upload, told, entry_of(upload, told), "test")
    return make_demo(told, DemoIn(surgeon="anybody", suture=cases.SUTURE)), upload.sha256


def ask_retraining(database: Database, **asked: object) -> Job:
    if "learner" in asked:
        asked["learner"] = describe_learner(asked["learner"])
    return request_retraining(database, RetrainingIn(**asked), "test")[0]


def parts_of(database: Database, job: Job) -> list[Job]:
    with database.reading() as session:
        mine = select(StyleToRetrain.part_row).where(StyleToRetrain.job_row == job.row)
        return list(session.scalars(select(Job).where(Job.row.in_(mine), Job.kind == PART).order_by(Job.row)))


def look(database: Database, job: Job) -> Job:
    with database.reading() as session:
        return session.get_one(Job, job.row)


def styles_of(database: Database, job: Job) -> list[StyleToRetrain]:
    with database.reading() as session:
        mine = select(StyleToRetrain).where(StyleToRetrain.job_row == job.row)
        return list(session.scalars(mine.order_by(StyleToRetrain.row)))


def states_of(database: Database, job: Job) -> list[str]:
    return [style.state for style in styles_of(database, job)]


def retrain(database: Database, **asked: object) -> Job:
    """Request a batch and carry out all of its parts, as a worker does."""
    return finish(database, ask_retraining(database, **asked))


def finish(database: Database, job: Job) -> Job:
    """Carry out all parts of a batch; return its job."""
    for part in parts_of(database, job):
        cases.work(database, part)
    return look(database, job)


def damage(database: Database, demonstration: int) -> None:
    """Change a byte of a stored reward map, as somebody with write access to the database would."""
    on_sqlite = database.engine.dialect.name == "sqlite"
    before = "DROP TRIGGER reward_maps_append_only" + ("" if on_sqlite else " ON reward_maps")
    broken = "CAST('broken' AS BLOB)" if on_sqlite else "'broken'::bytea"
    with database.writing() as session:
        session.execute(text(before))
        session.execute(
            text(f"UPDATE reward_maps SET map = {broken} WHERE demonstration_row = :row"), {"row": demonstration}
        )


def count_versions(database: Database) -> int:
    """Count the policy versions."""
    return counted(database, PolicyVersion)


def counted(database: Database, table: type) -> int:
    """Count the rows of a table."""
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(table))


def served(database: Database) -> list[int]:
    """Return the versions of the releases of the only surgeon that stand, the served one first."""
    with database.reading() as session:
        (surgeon,) = session.scalars(select(Demonstration.surgeon_row).distinct())
        return [one.policy.version for one in in_force(session, surgeon, cases.SUTURE)]
