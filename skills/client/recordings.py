"""Calls of recordings, of the hand-offs proposed in them, and of datasets of their demonstrations."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from skills import schemas
from skills.client.connection import Connection
from skills.client.files import Progress
from skills.client.waiting import in_thread
from skills.keywords import DatasetKeywords, TableKeywords
from skills.schemas import ProposalDecision, ProposalState

if TYPE_CHECKING:
    from skills.schemas.datasets import DatasetEpisodes
    from skills.schemas.demos import Proposal
    from skills.schemas.operation import Job
    from skills.schemas.recordings import Recording, RecordingPreview, RecordingSummary, SuturePoints


class Recordings(Connection):
    """Calls of recordings, proposals and datasets."""

    async def add_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        *,
        surgeon: str | None = None,
        progress: Progress | None = None,
        **table: Unpack[TableKeywords],
    ) -> Recording:
        """Store a recording; returns its digest, its topics and the hand-offs proposed in it.

        Args:
            recording: A path, whose file is streamed and never held in memory, or bytes. The digest is sent along.
            media_type: The media type; default: determined by the content.
            surgeon: The recorded surgeon; erasing the surgeon then deletes the recording even if nothing was cut out of
                it.
            progress: Called with the bytes sent and the total; it starts again from 0 when a lost upload is retried.
            **table: Statements about a recording that it does not make itself.
        """
        return await self._upload(
            schemas.recordings.Recording, "/recordings", recording, media_type, progress, surgeon=surgeon, **table
        )

    async def preview_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        *,
        progress: Progress | None = None,
        **table: Unpack[TableKeywords],
    ) -> RecordingPreview:
        """Return what would be understood of a recording, a table's columns included; nothing is stored.

        Arguments are those of `add_recording`. A table without times is counted, and its durations and rates are None.
        """
        return await self._upload(
            schemas.recordings.RecordingPreview, "/recordings/preview", recording, media_type, progress, **table
        )

    async def recordings(self) -> list[RecordingSummary]:
        """List recordings, the newest first."""
        return await self._all(schemas.recordings.RecordingSummary, "/recordings")

    async def recording(self, recording: str) -> Recording:
        """Return a recording by its digest."""
        return await self._get(schemas.recordings.Recording, "/recordings/{recording}", recording=recording)

    async def delete_recording(self, recording: str) -> None:
        """Delete a recording without demonstrations, by its digest."""
        await self._request("DELETE", "/recordings/{recording}", {"recording": recording})

    async def proposals(
        self,
        state: ProposalState | None = None,
        *,
        recording: str | None = None,
        surgeon: str | None = None,
        suture: str | None = None,
    ) -> list[Proposal]:
        """List the hand-offs proposed in recordings, those of the newest recording first.

        Args:
            state: Only those in this state.
            recording: Only those of this recording, by its digest.
            surgeon: Only those of this surgeon's demonstrations and recordings.
            suture: Only accepted ones, whose demonstration is of this suture type.
        """
        return await self._all(
            schemas.demos.Proposal, "/proposals", state=state, recording=recording, surgeon=surgeon, suture=suture
        )

    async def decide_proposal(
        self, recording: str, number: int, state: ProposalDecision, *, note: str | None = None
    ) -> Proposal:
        """Reject a proposed hand-off, or open a rejected one again; `cut_demo` accepts it.

        Args:
            recording: Digest of the recording.
            number: The number of the proposal, counted from 1.
            state: "rejected" or "open".
            note: Why.
        """
        return await self._ask(
            schemas.demos.Proposal,
            "PUT",
            "/recordings/{recording}/proposals/{number}",
            {"state": state, "note": note},
            recording=recording,
            number=number,
        )

    async def suture_points(
        self, scene: Path | bytes, arm: str | None = None, frame: str | None = None
    ) -> SuturePoints:
        """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame."""
        return await self._upload(schemas.recordings.SuturePoints, "/suture-points", scene, arm=arm, frame=frame)

    async def export_dataset(self, **options: Unpack[DatasetKeywords]) -> Job:
        """Request the export of demonstrations; the job's result is a `DatasetResult` with the dataset's digest.

            job = client.wait(client.export_dataset(surgeons=["kestrel"], licence="CC-BY-4.0"))
            client.save_dataset(DatasetResult.of(job).dataset, Path("dataset"))

        Raises:
            Problem: Of status 409 if a consent does not cover the export.
        """
        return await self._ask(schemas.operation.Job, "POST", "/datasets", options)

    async def save_dataset(self, dataset: str, to: Path, progress: Progress | None = None) -> Path:
        """Download a dataset to a .zip file, or unpack it into a new folder, after verifying every file of it.

        Raises:
            BadInput: There is something at this path.
            Corrupt: A file does not match the manifest; nothing is written.
            Problem: Of status 409 if a consent does not cover the export any more.
        """
        from skills.formats.lerobot.manifest import refuse_existing  # slow to import

        refuse_existing(to)
        with tempfile.TemporaryDirectory(prefix=".dataset-", dir=to.parent) as folder:
            part = Path(folder) / "dataset.zip"
            await self._save("/datasets/{dataset}", part, progress, dataset=dataset)
            await in_thread(lambda: _finish_dataset(part, to))
        return to

    async def dataset_episodes(self, dataset: str) -> DatasetEpisodes:
        """Return the recording and the demonstrations of each episode of a dataset, which does not name them itself."""
        return await self._get(schemas.datasets.DatasetEpisodes, "/datasets/{dataset}/episodes", dataset=dataset)

    async def delete_dataset(self, dataset: str) -> None:
        """Delete a dataset and the job that made it; its demonstrations stay."""
        await self._request("DELETE", "/datasets/{dataset}", {"dataset": dataset})


def _finish_dataset(part: Path, to: Path) -> None:
    """Verify a downloaded dataset, and move or unpack it to its path."""
    from skills.formats.lerobot.manifest import check_dataset, refuse_existing, unpack_dataset

    with part.open("rb") as file:
        if to.suffix != ".zip":
            unpack_dataset(file, to)
            return
        check_dataset(file)
    refuse_existing(to)
    part.rename(to)
