"""Route of tries: from a stored recording to a verdict in one job."""

from fastapi import Response

from skills.api.authorisation import Asking, needs, refuse_release
from skills.api.dependencies import Actor, Db, Jobs, room_for_a_job
from skills.api.openapi import router_of, starts_job
from skills.api.responses import (
    accepted,
)
from skills.api.strict_json import Strict
from skills.library.operation import locks
from skills.library.plans.tries import request_try
from skills.schemas.tries import TryIn
from skills.settings import MEBIBYTE

router = router_of(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)


@router.post("/tries", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def try_recording(body: TryIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Take a stored recording to a verdict: cut, learn, certify, release if wanted, plan at its own place, play.

    The job's `result.steps` has each step as it is done. What the request leaves open is asked: the job then ends with
    the choices, and the request is sent again with one of them. Nothing is released without `release` true.
    """
    refuse_release(caller, body.release is True)
    with db.writing([locks.surgeon(body.surgeon)]) as session:
        job, new, did = request_try(session, body, actor)
        answer = accepted(session, job, did)
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer
