"""Calls of datasets: demonstrations exported in the format of LeRobot."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from skills.client.connection import Connection, at, call, given
from skills.client.transport import Progress
from skills.schemas.given import DatasetEpisodes, Job


class Datasets(Connection):
    """Calls of datasets."""

    @call
    async def export_dataset(
        self,
        *,
        demos: Sequence[str] | None = None,
        surgeons: Sequence[str] | None = None,
        sutures: Sequence[str] | None = None,
        outcomes: Literal["success", "any"] = "success",
        whole: bool = False,
        version: Literal["v2.1", "v3.0"] = "v2.1",
        fps: int = 30,
        split: Literal["surgeon", "session"] = "surgeon",
        arms: Sequence[str] | None = None,
        name: str | None = None,
        licence: str | None = None,
        description: str | None = None,
        procedure: str | None = None,
    ) -> Job:
        """Request the export of demonstrations; the job's result has the digest of the `dataset`.

            job = client.wait(client.export_dataset(surgeons=["kestrel"], licence="CC-BY-4.0"))
            client.save_dataset(job.result["dataset"], Path("dataset"))

        Args:
            demos: Digests of the demonstrations; default: all that fit the filters.
            surgeons: Only of these surgeons; not together with `demos`.
            sutures: Only of these suture types; not together with `demos`.
            outcomes: "any" also exports demonstrations that are marked recovery or failure, in splits of these names.
            whole: Export whole recordings, where all surgeons in them consent; else the interval of each hand-off.
            version: The version of the format.
            fps: Frames per second, at most the rate of the recordings.
            split: What is in one split only: all of a surgeon, or all of a session, which is a recording.
            arms: The arms of every episode; default: those that all of the recordings have.
            name: The dataset's title.
            licence: Its licence.
            description: What it contains, for its README.
            procedure: How it was collected, for its README.

        Raises:
            Problem: Of status 409 if a consent does not cover the export.
        """
        body = {
            **{"demos": demos, "surgeons": surgeons, "sutures": sutures, "outcomes": outcomes, "whole": whole},
            **{"version": version, "fps": fps, "split": split, "arms": arms, "name": name, "licence": licence},
            **{"description": description, "procedure": procedure},
        }
        return await self._ask(Job, "POST", at("datasets"), given(body))

    @call
    async def save_dataset(self, dataset: str, to: Path, progress: Progress | None = None) -> Path:
        """Download a dataset to a .zip file, or unpack it into a new folder, after verifying every file of it.

        Raises:
            BadInput: There is something at this path.
            Corrupt: A file does not match the manifest; nothing is written.
            Problem: Of status 409 if a consent does not cover the export any more.
        """
        from skills.formats.lerobot.manifest import check_dataset, refuse_existing, unpack_dataset  # slow to import

        refuse_existing(to)
        with tempfile.TemporaryDirectory(prefix=".dataset-", dir=to.parent) as folder:
            part = Path(folder) / "dataset.zip"
            await self._save(at("datasets", dataset), part, progress)

            def finish() -> None:
                with part.open("rb") as file:
                    if to.suffix == ".zip":
                        check_dataset(file)
                    else:
                        unpack_dataset(file, to)
                if to.suffix == ".zip":
                    refuse_existing(to)
                    part.rename(to)

            await self._transport.aside(finish)
        return to

    @call
    async def dataset_episodes(self, dataset: str) -> DatasetEpisodes:
        """Return the recording and the demonstrations of each episode of a dataset, which does not name them itself."""
        return await self._get(DatasetEpisodes, at("datasets", dataset, "episodes"))

    @call
    async def delete_dataset(self, dataset: str) -> None:
        """Delete a dataset and the job that made it; its demonstrations stay."""
        await self._send("DELETE", at("datasets", dataset))
