"""Routes of datasets: demonstrations in the format of LeRobot, as a zip file."""

from functools import partial

from fastapi import Request, Response

from skills.api.authorisation import needs
from skills.api.dependencies import Accept, Actor, Db, Digest, Jobs, room_for_a_job
from skills.api.openapi import ends, gives, gives_file, router_of, starts_job
from skills.api.responses import Condition, Giving, accepted
from skills.api.streams import stored_file
from skills.api.strict_json import Strict
from skills.db.service_tables import StoredDataset
from skills.formats import BYTES
from skills.library.recordings import datasets
from skills.schemas.datasets import DatasetEpisodes, DatasetIn
from skills.settings import MEBIBYTE

router = router_of(route_class=Strict, tags=["datasets"], max_body_size=MEBIBYTE)


@router.post("/datasets", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def export_dataset(body: DatasetIn, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Request the export of demonstrations as a LeRobot dataset; `result.dataset` of the job is its digest.

    409 if the consent of a surgeon in it does not cover an export.
    """
    with db.writing() as session:
        job, new, did = datasets.request_dataset(session, body, actor)
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@router.get(
    "/datasets/{dataset}", dependencies=[needs("reader")], **gives_file((BYTES, StoredDataset.media_type), 404, 409)
)
def get_dataset(
    dataset: Digest, db: Db, request: Request, if_none_match: Condition = None, accept: Accept = "*/*"
) -> Response:
    """Return a dataset as a zip; all of it is verified before the first byte is sent.

    409 if a consent in it does not cover an export any more; consents are checked again for each chunk.
    """
    return stored_file(
        request,
        db,
        partial(datasets.served_dataset, dataset_sha256=dataset),
        partial(datasets.dataset_chunk, db, dataset),
        accept=accept,
        if_none_match=if_none_match,
        attachment="dataset-{}.zip",
    )


@router.get("/datasets/{dataset}/episodes", dependencies=[needs("reader")], **gives(DatasetEpisodes, 404))
def get_dataset_episodes(dataset: Digest, db: Db, give: Giving) -> Response:
    """Return the recording and the demonstrations of each episode of a dataset, which does not name them itself."""
    with db.reading() as session:
        return give(datasets.episodes_of_dataset(session, dataset))


@router.delete("/datasets/{dataset}", dependencies=[needs("trainer")], **ends(404))
def delete_dataset(dataset: Digest, db: Db, actor: Actor) -> None:
    """Delete a dataset and the job that made it; its demonstrations stay."""
    with db.writing() as session:
        datasets.delete_dataset(session, dataset, actor)
