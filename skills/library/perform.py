"""The use cases, between the database and its callers, and `perform_job`, which carries out any job.

A function that takes a `session` joins its caller's transaction. One that takes a `database` is slow: it reads in a
transaction, closes it, computes, and writes in a short transaction at the end.

`perform_job` runs a job of any kind. It is safe to retry: several workers, or several attempts of one, store the result
once.
"""

from collections.abc import Callable
from typing import Any

from skills.db import now
from skills.db.service_tables import Job, record_event
from skills.db.session import Database
from skills.library.operation.jobs import JobRequest, PartRequest, Store, names_of, while_running
from skills.library.plans.playback_pictures import PicturesRequest, draw_pictures
from skills.library.plans.playbacks import PlaybackRequest, check_playback
from skills.library.plans.tries import TryRequest, perform_try
from skills.library.policies.batches import retrain_part
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.training import train_style
from skills.library.recordings.datasets import DatasetRequest, export_dataset
from skills.settings import Settings

__all__ = ["perform_job"]

PERFORMERS: dict[type[JobRequest], Callable[[Database, Any, Settings], Store[Any]]] = {
    TrainingRequest: train_style,
    PartRequest: retrain_part,
    PlaybackRequest: check_playback,
    PicturesRequest: draw_pictures,
    DatasetRequest: export_dataset,
    TryRequest: perform_try,
}
REQUESTS = {request.kind: request for request in PERFORMERS}


def perform_job(database: Database, row: int, attempt: int, settings: Settings) -> None:
    """Carry out a running job; write its result and the state `succeeded` in one transaction.

    Safe to call twice: the result is identified by its digest, and the state changes once.

    Args:
        database: The database with the job.
        row: The job's row.
        attempt: The attempt that the worker was given; a job that is at another attempt by now is left alone.
        settings: Limits of time and memory for the computation.

    Raises:
        SkillsError: The request cannot be met, or what it uses was erased; a retry would not help.
    """
    with database.reading() as session:
        job = session.get(Job, row)
        if job is None or job.state != "running" or job.attempt != attempt:
            return  # erased, cancelled, or taken by another attempt
        request, names = REQUESTS[job.kind].model_validate(job.request), names_of(session, row)
    running = while_running(database, row, attempt)
    store = PERFORMERS[type(request)](running, request, settings)
    with running.writing(names) as session:  # the first finished attempt is the only one that stores a result
        job = session.get_one(Job, row)
        job.state, job.progress, job.ended_at = "succeeded", 1.0, now()
        session.flush()
        job.result = store(session, job.requested_by).model_dump(mode="json")
        record_event(session, "worker", "finish", f"job-{job.kind}", job.id)
