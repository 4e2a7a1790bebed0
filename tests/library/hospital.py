"""A large hospital, quickly: any number of surgeons, with a learnt, released and retrained style of each suture type.

One style is really demonstrated, learnt and released; all others are rows with its numbers and different names. Their
digests are those that such styles would have, so everything that is read back is verified as usual.
"""

import secrets
from collections.abc import Iterable
from itertools import islice
from typing import Any, cast

from sqlalchemy import LargeBinary, Table, insert, select, type_coerce
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.models import (
    Demonstration,
    PolicyVersion,
    RecordingChunk,
    Release,
    StoredRecording,
    StoredRewardMap,
    Surgeon,
    SutureType,
)
from skills.db.packed import Packed, digest
from skills.db.service_tables import Event, Job, StyleToRetrain
from skills.db.session import Database
from skills.library.operation.integrity import demo_identity
from skills.library.operation.jobs import BATCH, PART, identity_of
from skills.library.people.suture_types import put_suture_type
from skills.library.policies.retraining import MOST_IN_A_PART
from skills.packing import canonical, sha256
from skills.schemas.people import SutureTypeIn
from tests.library import cases

FIRST = "kestrel"
SUTURES = 12  # the catalogue's eleven, and one of the hospital's own
WAITING = 30  # unfinished jobs, in a hospital of any size
ROWS_AT_ONCE = 1000

Row = dict[str, Any]
Style = tuple[str, str]


def fill(database: Database, surgeons: int) -> list[Style]:
    """Fill a migrated database with a number of surgeons; return their styles, surgeon by surgeon."""
    cases.add_surgeon(database, FIRST)
    cases.add_demo(database)
    cases.train(database, release=True)
    with database.writing() as session:
        about = {"name": "Barbed running", "also_called": [], "family": "running", "description": "Without a knot."}
        put_suture_type(session, "barbed-running", SutureTypeIn.model_validate(about), "test")
    with database.reading() as session:
        sutures = session.scalars(select(SutureType.slug).order_by(SutureType.slug)).all()
    assert len(sutures) == SUTURES
    others = [f"surgeon-{number:04}" for number in range(1, surgeons)]
    styles = [(surgeon, suture) for surgeon in (FIRST, *others) for suture in sutures]
    new = [style for style in styles if style != (FIRST, cases.SUTURE)]
    with database.writing() as session:
        _add_surgeons(session, others)
        _add_styles(session, new)
        _add_jobs(session, styles)
        _add_events(session, 3 * len(styles))
    return styles


def _add_surgeons(session: Session, slugs: list[str]) -> None:
    """Add surgeons, each with a recording: the bytes of the first one's, followed by the surgeon's name."""
    one, recording, chunk = (_first(session, model) for model in (Surgeon, StoredRecording, RecordingChunk))
    _add(session, Surgeon, (one | {"slug": slug, "subject": secrets.token_hex(16)} for slug in slugs))
    files = {sha256(data): data for data in (chunk["data"] + slug.encode() for slug in slugs)}
    sizes = {digest: {"sha256": digest, "size_bytes": len(data)} for digest, data in files.items()}
    _add(session, StoredRecording, (recording | size for size in sizes.values()))
    rows = _rows(session, StoredRecording, "sha256")
    _add(session, RecordingChunk, (chunk | {"recording": rows[(digest,)], "data": files[digest]} for digest in files))


def _add_styles(session: Session, styles: list[Style]) -> None:
    """Add a demonstration, its reward map, a policy version and its release for each style."""
    real, version = session.scalars(select(Demonstration)).one(), session.scalars(select(PolicyVersion)).one()
    first, reward, policy, released = (
        _first(session, model) for model in (Demonstration, StoredRewardMap, PolicyVersion, Release)
    )
    demo, path, learnt = real.demo, real.path, digest(version.learnt)
    surgeons, recordings = _rows(session, Surgeon, "slug"), _rows(session, StoredRecording, "sha256")
    data = _first(session, RecordingChunk)["data"]
    demos, versions = [], []
    for surgeon, suture in styles:
        mine = {"surgeon_row": surgeons[(surgeon,)], "suture": suture}
        recording = sha256(data + surgeon.encode()) if surgeon != FIRST else real.recording.sha256
        name = demo_identity(recording, surgeon, suture, demo, path)
        demos.append(first | mine | {"sha256": name, "recording_row": recordings[(recording,)]})
        manifest = policy["manifest"].model_copy(update={"surgeon": surgeon, "suture": suture, "demos": [name]})
        training = sha256(canonical([policy["training"], name]))
        about = {"manifest": manifest, "training": training, "sha256": manifest.identity(learnt)}
        versions.append(policy | mine | about)
    _add(session, Demonstration, demos)
    rows = _rows(session, Demonstration, "sha256")
    _add(session, StoredRewardMap, (reward | {"demonstration_row": rows[(demo["sha256"],)]} for demo in demos))
    rests = ({"demonstration_row": rows[tuple(version["manifest"].demos)]} for version in versions)
    _add(session, PolicyVersion, (version | on for version, on in zip(versions, rests, strict=True)))
    rows = _rows(session, PolicyVersion, "sha256")
    style = ("surgeon_row", "suture")
    news = (
        {"policy_row": rows[(version["sha256"],)], **{name: version[name] for name in style}} for version in versions
    )
    _add(session, Release, (released | new for new in news))


def _add_jobs(session: Session, styles: list[Style]) -> None:
    """Add the training of each style, some waiting jobs, and last a finished batch of all styles."""
    training = _first(session, Job)

    def job(kind: str, request: Row, **state: object) -> Row:
        return (
            training
            | {"id": secrets.token_hex(8), "kind": kind, "identity": identity_of(kind, request)}
            | {"request": request, **state}
        )

    def asked(surgeon: str, suture: str) -> Row:
        return training["request"] | {"surgeon": surgeon, "suture": suture}

    new = [style for style in styles if style != (FIRST, cases.SUTURE)]
    _add(session, Job, (job("training", asked(*style)) for style in new))
    waits: Row = {"state": "queued", "progress": 0.0, "result": None, "started_at": None, "ended_at": None}
    waiting = (training["request"] | {"seed": seed} for seed in range(1, WAITING + 1))
    _add(session, Job, (job("training", request, **waits) for request in waiting))
    batch = job(BATCH, {"styles": len(styles)})
    parts = [job(PART, {"first": first}) for first in range(0, len(styles), MOST_IN_A_PART)]
    _add(session, Job, [batch, *parts])
    jobs, demos = _rows(session, Job, "id"), _rows(session, Demonstration, "surgeon_row", "suture")
    policies, surgeons = _rows(session, PolicyVersion, "surgeon_row", "suture"), _rows(session, Surgeon, "slug")
    rows = []
    for number, (surgeon, suture) in enumerate(styles):
        style = (surgeons[(surgeon,)], suture)
        rows.append(
            {
                "job_row": jobs[(batch["id"],)],
                "part_row": jobs[(parts[number // MOST_IN_A_PART]["id"],)],
                "demonstration_row": demos[style],
                "policy_row": policies[style],
                "stale": [],
                "state": "done",
                "tries": 1,
                "ended_at": now(),
            }
        )
    _add(session, StyleToRetrain, rows)


def add_trainings(database: Database, styles: list[Style], each: int) -> None:
    """Add more finished trainings of each style, with an event for each, in transactions of some thousands."""
    with database.reading() as session:
        training, event, surgeons = _first(session, Job), _first(session, Event), _rows(session, Surgeon, "slug")
    asked = (
        training["request"] | {"surgeon": surgeon, "suture": suture, "seed": seed}
        for seed in range(WAITING + 1, WAITING + 1 + each)
        for surgeon, suture in styles
    )
    while some := list(islice(asked, 5 * ROWS_AT_ONCE)):
        jobs = [
            training
            | {"id": secrets.token_hex(8), "request": request, "identity": identity_of("training", request)}
            | {"surgeon_row": surgeons[(request["surgeon"],)]}
            for request in some
        ]
        events = [event | {"object_id": job["id"], "sha256": sha256(job["id"].encode())} for job in jobs]
        with database.writing() as session:
            _add(session, Job, jobs)
            _add(session, Event, events)


def _add_events(session: Session, count: int) -> None:
    first = _first(session, Event)
    _add(session, Event, (first | {"sha256": sha256(str(number).encode())} for number in range(count)))


def _table(model: type) -> Table:
    return cast(Table, model.__table__)  # type: ignore[attr-defined]


def _first(session: Session, model: type) -> Row:
    """Read the first row of a table without its number, with packed values as stored."""
    table = _table(model)
    columns = [column for column in table.columns if column.name != "row"]
    as_stored = (type_coerce(c, LargeBinary).label(c.name) if isinstance(c.type, Packed) else c for c in columns)
    order = list(table.primary_key)
    return dict(session.execute(select(*as_stored).order_by(*order).limit(1)).mappings().one())


def _rows(session: Session, model: type, *key: str) -> dict[tuple[Any, ...], int]:
    """Find the numbers of all rows by some of their columns."""
    table = _table(model)
    return {tuple(found): row for row, *found in session.execute(select(table.c.row, *(table.c[name] for name in key)))}


def _add(session: Session, model: type, rows: Iterable[Row]) -> None:
    waiting = iter(rows)
    while some := list(islice(waiting, ROWS_AT_ONCE)):
        session.execute(insert(_table(model)), some)
