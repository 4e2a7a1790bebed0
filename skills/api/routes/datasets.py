"""Routes of datasets: demonstrations in the format of LeRobot, as a zip file."""

from functools import partial

from fastapi import Response

from skills.api.dependencies import Accept, Actor, Db, Digest, Jobs
from skills.api.openapi import ends, gives, gives_file, router_of, starts_job
from skills.api.responses import Giving, start_job
from skills.api.streams import stored_file
from skills.db.service_tables import StoredDataset
from skills.formats import BYTES
from skills.library.recordings import datasets
from skills.schemas.datasets import DatasetEpisodes, DatasetIn

router = router_of("datasets")


@router.post("/datasets", **starts_job(404, 409, 410))
def export_dataset(body: DatasetIn, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Request the export of demonstrations as a LeRobot dataset; `result.dataset` of the job is its digest.

    409 if the consent of a surgeon in it does not cover an export.
    """
    return start_job(db, jobs, None, lambda session: datasets.request_dataset(session, body, actor))


@router.get("/datasets/{dataset}", **gives_file("reader", (BYTES, StoredDataset.media_type), 404, 409))
def get_dataset(dataset: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return a dataset as a zip; all of it is verified before the first byte is sent.

    409 if a consent in it does not cover an export any more; consents are checked again for each chunk.
    """
    read = partial(datasets.dataset_chunk, db, dataset)
    find = partial(datasets.served_dataset, dataset_sha256=dataset)
    return stored_file(give, db, find, read, accept, attachment="dataset-{}.zip")


@router.get("/datasets/{dataset}/episodes", **gives("reader", DatasetEpisodes, 404))
def get_dataset_episodes(dataset: Digest, db: Db, give: Giving) -> Response:
    """Return the recording and the demonstrations of each episode of a dataset, which does not name them itself."""
    with db.reading() as session:
        return give(datasets.episodes_of_dataset(session, dataset))


@router.delete("/datasets/{dataset}", **ends("trainer", 404))
def delete_dataset(dataset: Digest, db: Db, actor: Actor) -> None:
    """Delete a dataset and the job that made it; its demonstrations stay."""
    with db.ending() as session:
        datasets.delete_dataset(session, dataset, actor)
