"""Calls of demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from skills import schemas
from skills.client.connection import Connection
from skills.client.files import Progress
from skills.keywords import DemoKeywords, DemoUploadKeywords
from skills.schemas import DemoOutcome, OutcomeAsked

if TYPE_CHECKING:
    from skills.schemas.demos import Demonstration, DemoPath, RewardMap


class Demos(Connection):
    """Calls of demonstrations."""

    async def add_demo(
        self,
        recording: Path | bytes,
        *,
        media_type: str | None = None,
        progress: Progress | None = None,
        **options: Unpack[DemoUploadKeywords],
    ) -> Demonstration:
        """Store a recording and one demonstration of it; see `add_recording` and `cut_demo`."""
        return await self._upload(schemas.demos.Demonstration, "/demos", recording, media_type, progress, **options)

    async def cut_demo(self, recording: str, **options: Unpack[DemoKeywords]) -> Demonstration:
        """Cut a demonstration out of a stored recording.

        Args:
            recording: Digest of the recording.
            **options: The surgeon, the suture type, the part of the recording, and the grid.

        Raises:
            Problem: Of kind "segment-not-named" if several hand-offs are proposed and none was named; its `numbers`
                list them, as `skills.schemas.results.ProposedSegments` reads them.
        """
        return await self._ask(
            schemas.demos.Demonstration, "POST", "/recordings/{recording}/demos", options, recording=recording
        )

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
        return await self._all(
            schemas.demos.Demonstration,
            "/demos",
            surgeon=surgeon,
            suture=suture,
            recording=recording,
            active=active,
            outcome=outcome,
        )

    async def demo(self, demo: str) -> Demonstration:
        """Return a demonstration."""
        return await self._get(schemas.demos.Demonstration, "/demos/{demo}", demo=demo)

    async def demo_report(self, demo: str) -> Demonstration:
        """Return a demonstration with its report, measured anew."""
        return await self._get(schemas.demos.Demonstration, "/demos/{demo}/report", demo=demo)

    async def demo_report_page(self, demo: str) -> bytes:
        """Return a demonstration's report as a standalone HTML page."""
        return (await self._request("GET", "/demos/{demo}/report", {"demo": demo}, accept="text/html")).content

    async def demo_path(self, demo: str) -> DemoPath:
        """Return a demonstration's states, and its motion as recorded."""
        return await self._get(schemas.demos.DemoPath, "/demos/{demo}/path", demo=demo)

    async def reward_map(self, demo: str) -> RewardMap:
        """Return the rewards of Algorithm 1 along a demonstration."""
        return await self._get(schemas.demos.RewardMap, "/demos/{demo}/reward-map", demo=demo)

    async def demo_recording(self, demo: str) -> bytes:
        """Return the recording's bytes; use `save_recording` for a large one, which is not held in memory."""
        return await self._bytes("/demos/{demo}/recording", demo=demo)

    async def save_recording(self, demo: str, to: Path, progress: Progress | None = None) -> Path:
        """Download a demonstration's recording to a file, which appears only when it is complete and has its digest.

        Raises:
            Corrupt: The download is not the recording; no file is written.
        """
        about = await self._get(schemas.demos.Demonstration, "/demos/{demo}", demo=demo)
        return await self._save("/demos/{demo}/recording", to, progress, sha256=about.recording, demo=demo)

    async def mark_demo(self, demo: str, outcome: DemoOutcome, *, reason: str | None = None) -> Demonstration:
        """Mark a demonstration as success, recovery or failure; the newest mark counts.

        Nothing is learnt from a recovery or a failure unless a training has `outcomes="any"`, and releases that rest on
        it are withdrawn, except of versions that were trained so. The request is not retried after a lost connection,
        because somebody may have marked it otherwise meanwhile.
        """
        body = {"outcome": outcome, "reason": reason}
        return await self._ask(
            schemas.demos.Demonstration, "PUT", "/demos/{demo}/outcome", body, idempotent=False, demo=demo
        )

    async def withdraw_demo(self, demo: str, *, erase: bool = False) -> None:
        """Withdraw a demonstration and the releases that rest on it, or erase it and everything derived from it."""
        await self._request("DELETE", "/demos/{demo}", {"demo": demo, "erase": erase})
