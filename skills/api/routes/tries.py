"""Route of tries: from a stored recording to a verdict in one job."""

from fastapi import Response

from skills.api.authorisation import Asking, refuse_release
from skills.api.dependencies import Actor, Db, Jobs
from skills.api.openapi import router_of, starts_job
from skills.api.responses import start_job
from skills.library.operation import locks
from skills.library.plans.tries import request_try
from skills.schemas.tries import TryIn

router = router_of("jobs")


@router.post("/tries", **starts_job(404, 409, 410))
def try_recording(body: TryIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Take a stored recording to a verdict: cut, learn, certify, release if wanted, plan at its own place, play.

    The job's `result.steps` has each step as it is done. What the request leaves open is asked: the job then ends with
    the choices, and the request is sent again with one of them. Nothing is released without `release` true.
    """
    refuse_release(caller, body.release is True)
    return start_job(db, jobs, [locks.surgeon(body.surgeon)], lambda session: request_try(session, body, actor))
