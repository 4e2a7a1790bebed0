"""Calls of surgeons, suture types, recordings, the demonstrations cut out of recordings, and datasets of these."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from skills.client.connection import Connection, at, call, given
from skills.client.transport import Progress
from skills.schemas import DemoOutcome, Handedness, OutcomeAsked, ProposalDecision, ProposalState, SkillLevel
from skills.schemas.datasets import DatasetEpisodes
from skills.schemas.demos import Demonstration, DemoPath, Proposal, RewardMap
from skills.schemas.operation import Job
from skills.schemas.people import Surgeon, SutureType
from skills.schemas.recordings import Recording, RecordingPreview, RecordingSummary


class Catalogue(Connection):
    """Calls of surgeons and suture types."""

    @call
    async def put_surgeon(
        self,
        surgeon: str,
        *,
        skill_level: SkillLevel | None = None,
        handedness: Handedness | None = None,
        protocol: str | None = None,
        consent: Mapping[str, Any] | None = None,
    ) -> Surgeon:
        """Create or replace a surgeon under a pseudonym; `consent` has `uses` and `until`.

        Fields that are left out are cleared.
        """
        about = {"skill_level": skill_level, "handedness": handedness, "protocol": protocol, "consent": consent}
        return await self._ask(Surgeon, "PUT", at("surgeons", surgeon), about)

    @call
    async def surgeon(self, surgeon: str) -> Surgeon:
        """Return a surgeon."""
        return await self._get(Surgeon, at("surgeons", surgeon))

    @call
    async def surgeons(self, search: str | None = None, skill_level: SkillLevel | None = None) -> list[Surgeon]:
        """List the surgeons: all, or those whose pseudonym contains `search`."""
        return await self._all(Surgeon, at("surgeons"), search=search, skill_level=skill_level)

    @call
    async def erase_surgeon(self, surgeon: str) -> None:
        """Erase a surgeon and everything derived from their data, permanently."""
        await self._send("DELETE", at("surgeons", surgeon))

    @call
    async def put_suture_type(
        self, suture: str, *, name: str, family: str, also_called: list[str] | None = None, description: str = ""
    ) -> SutureType:
        """Create or replace a suture type."""
        about = {"name": name, "family": family, "also_called": also_called or [], "description": description}
        return await self._ask(SutureType, "PUT", at("suture-types", suture), about)

    @call
    async def suture_type(self, suture: str) -> SutureType:
        """Return a suture type."""
        return await self._get(SutureType, at("suture-types", suture))

    @call
    async def suture_types(self, search: str | None = None) -> list[SutureType]:
        """List the suture types: all, or those whose slug, name or family contains `search`."""
        return await self._all(SutureType, at("suture-types"), search=search)


GridMode = Literal["auto", "paper", "fit"]


class Recordings(Connection):
    """Calls of recordings and demonstrations."""

    @call
    async def add_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        *,
        rate_hz: float | None = None,
        frame: str | None = None,
        column: list[str] | None = None,
        unit: list[str] | None = None,
        decimal: Literal["point", "comma"] | None = None,
        table_arm: str | None = None,
        instrument: str | None = None,
        surgeon: str | None = None,
        progress: Progress | None = None,
    ) -> Recording:
        """Store a recording; returns its digest, its topics and the hand-offs proposed in it.

        Args:
            recording: A path, whose file is streamed and never held in memory, or bytes. The digest is sent along.
            media_type: The media type; default: determined by the content.
            rate_hz: Samples per second, of a table without times.
            frame: Frame of the poses in a table or a LeRobot episode; "base": the base of each arm.
            column: A table's columns under other names (docs/tables.md), each as "x_mm=PosX".
            unit: Units of the columns that name none, such as "mm".
            decimal: A table's decimal mark.
            table_arm: A table's arm; default: PSM.
            instrument: Number of the instrument with which a table's joints become poses.
            surgeon: The recorded surgeon; erasing the surgeon then deletes the recording even if nothing was cut out of
                it.
            progress: Called with the bytes sent and the total; it starts again from 0 when a lost upload is retried.
        """
        query = {
            **{"rate_hz": rate_hz, "frame": frame, "column": column, "unit": unit, "decimal": decimal},
            **{"table_arm": table_arm, "instrument": instrument, "surgeon": surgeon},
        }
        return await self._upload(Recording, at("recordings"), recording, media_type, progress, query)

    @call
    async def preview_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        *,
        rate_hz: float | None = None,
        frame: str | None = None,
        column: list[str] | None = None,
        unit: list[str] | None = None,
        decimal: Literal["point", "comma"] | None = None,
        table_arm: str | None = None,
        instrument: str | None = None,
        progress: Progress | None = None,
    ) -> RecordingPreview:
        """Return what would be understood of a recording, a table's columns included; nothing is stored.

        Arguments are those of `add_recording`. A table without times is counted, and its durations and rates are None.
        """
        query = {
            **{"rate_hz": rate_hz, "frame": frame, "column": column, "unit": unit, "decimal": decimal},
            **{"table_arm": table_arm, "instrument": instrument},
        }
        path = at("recordings", "preview")
        return await self._upload(RecordingPreview, path, recording, media_type, progress, query)

    @call
    async def recordings(self) -> list[RecordingSummary]:
        """List recordings, the newest first."""
        return await self._all(RecordingSummary, at("recordings"))

    @call
    async def recording(self, recording: str) -> Recording:
        """Return a recording by its digest."""
        return await self._get(Recording, at("recordings", recording))

    @call
    async def delete_recording(self, recording: str) -> None:
        """Delete a recording without demonstrations, by its digest."""
        await self._send("DELETE", at("recordings", recording))

    @call
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
        asked = {"state": state, "recording": recording, "surgeon": surgeon, "suture": suture}
        return await self._all(Proposal, at("proposals"), **asked)

    @call
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
        body = {"state": state, "note": note}
        return await self._ask(Proposal, "PUT", at("recordings", recording, "proposals", number), body)

    @call
    async def add_demo(
        self,
        recording: Path | bytes,
        *,
        surgeon: str,
        suture: str,
        arm: str | None = None,
        topic: str | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        segment: Literal["whole"] | int | None = None,
        grid: GridMode | None = None,
        cell_mm: float | None = None,
        hysteresis: float | None = None,
        session: str | None = None,
        outcome: DemoOutcome | None = None,
        outcome_reason: str | None = None,
        media_type: str | None = None,
        rate_hz: float | None = None,
        frame: str | None = None,
        column: list[str] | None = None,
        unit: list[str] | None = None,
        decimal: Literal["point", "comma"] | None = None,
        table_arm: str | None = None,
        instrument: str | None = None,
        progress: Progress | None = None,
    ) -> Demonstration:
        """Store a recording and one demonstration of it; see `add_recording` and `cut_demo`."""
        query = {
            **{"surgeon": surgeon, "suture": suture, "arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
            **{"segment": segment, "grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis, "session": session},
            **{"outcome": outcome, "outcome_reason": outcome_reason},
            **{"rate_hz": rate_hz, "frame": frame, "column": column, "unit": unit, "decimal": decimal},
            **{"table_arm": table_arm, "instrument": instrument},
        }
        return await self._upload(Demonstration, at("demos"), recording, media_type, progress, query)

    @call
    async def cut_demo(
        self,
        recording: str,
        *,
        surgeon: str,
        suture: str,
        arm: str | None = None,
        topic: str | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
        segment: Literal["whole"] | int | None = None,
        grid: GridMode | None = None,
        cell_mm: float | None = None,
        hysteresis: float | None = None,
        session: str | None = None,
        outcome: DemoOutcome | None = None,
        outcome_reason: str | None = None,
    ) -> Demonstration:
        """Cut a demonstration out of a stored recording.

        Args:
            recording: Digest of the recording.
            surgeon: Pseudonym of the surgeon who did the hand-off.
            suture: Its suture type.
            arm: Needed if several arms moved.
            topic: Needed if an arm was recorded on several topics.
            start_s: Start in the recording.
            end_s: End in the recording.
            segment: Instead of times: a proposed hand-off, counted from 1, or "whole". If neither is given, the only
                proposal
                is used, or the whole recording if there is none; `segment` of the response says which.
            grid: "auto" uses the paper's grid if the path lies in it, and fits one otherwise.
            cell_mm: Edge of a cell of a fitted grid.
            hysteresis: Distance beyond its cell, in cells, at which a sample leaves it: 0 to 0.5; 0.25 suppresses
                tremor.
            session: A name for recordings that were made together.
            outcome: What became of the hand-off, where it is known; see `mark_demo`.
            outcome_reason: Why; needed for a recovery or a failure.

        Raises:
            Problem: Of kind "segment-not-named" if several hand-offs are proposed and none was named;
                `body["numbers"]["segments"]` lists them.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
            **{"segment": segment, "grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis, "session": session},
            **{"outcome": outcome, "outcome_reason": outcome_reason},
        }
        return await self._ask(Demonstration, "POST", at("recordings", recording, "demos"), given(body))

    @call
    async def demos(
        self,
        surgeon: str | None = None,
        suture: str | None = None,
        *,
        recording: str | None = None,
        active: bool | None = None,
        outcome: OutcomeAsked | None = None,
    ) -> list[Demonstration]:
        """List demonstrations, the newest first.

        `active` true leaves out withdrawn ones, false all others; `outcome` all that are not marked so.
        """
        asked = {"surgeon": surgeon, "suture": suture, "recording": recording, "active": active, "outcome": outcome}
        return await self._all(Demonstration, at("demos"), **asked)

    @call
    async def demo(self, demo: str) -> Demonstration:
        """Return a demonstration."""
        return await self._get(Demonstration, at("demos", demo))

    @call
    async def demo_report(self, demo: str) -> Demonstration:
        """Return a demonstration with its report, measured anew."""
        return await self._get(Demonstration, at("demos", demo, "report"))

    @call
    async def demo_report_page(self, demo: str) -> bytes:
        """Return a demonstration's report as a standalone HTML page."""
        answer = await self._send("GET", at("demos", demo, "report"), headers={"Accept": "text/html"})
        return answer.content

    @call
    async def demo_path(self, demo: str) -> DemoPath:
        """Return a demonstration's states, and its motion as recorded."""
        return await self._get(DemoPath, at("demos", demo, "path"))

    @call
    async def reward_map(self, demo: str) -> RewardMap:
        """Return the rewards of Algorithm 1 along a demonstration."""
        return await self._get(RewardMap, at("demos", demo, "reward-map"))

    @call
    async def demo_recording(self, demo: str) -> bytes:
        """Return the recording's bytes; use `save_recording` for a large one, which is not held in memory."""
        return await self._bytes(at("demos", demo, "recording"))

    @call
    async def save_recording(self, demo: str, to: Path, progress: Progress | None = None) -> Path:
        """Download a demonstration's recording to a file, which appears only when it is complete and has its digest.

        Raises:
            Corrupt: The download is not the recording; no file is written.
        """
        about = await self._get(Demonstration, at("demos", demo))
        return await self._save(at("demos", demo, "recording"), to, progress, sha256=about.recording)

    @call
    async def mark_demo(self, demo: str, outcome: DemoOutcome, *, reason: str | None = None) -> Demonstration:
        """Mark a demonstration as success, recovery or failure; the newest mark counts.

        Nothing is learnt from a recovery or a failure unless a training has `outcomes="any"`, and releases that rest on
        it are withdrawn, except of versions that were trained so. The request is not retried after a lost connection,
        because somebody may have decided otherwise in between.

        Args:
            demo: Its digest.
            outcome: What became of the hand-off.
            reason: Why; needed for a recovery or a failure.
        """
        body = {"outcome": outcome, "reason": reason}
        return await self._ask(Demonstration, "PUT", at("demos", demo, "outcome"), body, harmless=False)

    @call
    async def withdraw_demo(self, demo: str, *, erase: bool = False) -> None:
        """Withdraw a demonstration, or erase it and everything derived from it."""
        await self._send("DELETE", at("demos", demo), params={"erase": erase})


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
