"""Carrying a job out, whoever works on it and however often it is tried."""

from collections.abc import Callable
from typing import Any

from sqlalchemy import update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Job
from skills.db.session import Database
from skills.library.batch_work import retrain_part
from skills.library.batches import PART
from skills.library.events import record
from skills.library.pictures import draw_pictures
from skills.library.playbacks import check_playback
from skills.library.training import train_style
from skills.settings import Settings

Store = Callable[[Session, str], dict[str, Any]]  # in a transaction, for whoever asked
MAKERS: dict[str, Callable[[Database, dict[str, Any], Settings], Store]] = {
    "training": train_style,
    PART: retrain_part,
    "playback": check_playback,
    "pictures": draw_pictures,
}


def perform_job(database: Database, row: int, attempt: int, settings: Settings) -> None:
    """Carry a running job out; its result and the state `succeeded` are written in one transaction.

    Safe to call twice: what it makes is known by its digest, and the state changes once.

    Raises:
        SkillsError: The request cannot be met; trying again would not help.
    """
    with database.reading() as session:
        job = session.get(Job, row)
        if job is None or job.state != "running" or job.attempt != attempt:
            return  # erased, cancelled, or another attempt has it
        kind, request = job.kind, job.request
    store = MAKERS[kind](database, request, settings)
    with database.writing() as session:
        ended = {"state": "succeeded", "progress": 1.0, "ended_at": now()}
        mine = (Job.row == row, Job.state == "running", Job.attempt == attempt)
        if session.execute(update(Job).where(*mine).values(**ended).returning(Job.row)).first() is None:
            return  # cancelled meanwhile, or another attempt was first
        job = session.get_one(Job, row)
        job.result = store(session, job.asked_by)
        record(session, "worker", "finish", f"job-{kind}", job.id)
