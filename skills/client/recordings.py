"""Recordings, and the demonstrations that are cut out of them."""

from pathlib import Path
from typing import Literal

from skills.api.schemas.given import Demonstration, DemoPath, Recording, RewardMap
from skills.client.calls import at, call
from skills.client.connection import Connection, given
from skills.client.files import Progress

GridMode = Literal["auto", "paper", "fit"]


class Recordings(Connection):
    """The calls."""

    @call
    async def add_recording(
        self,
        recording: Path | bytes,
        media_type: str | None = None,
        *,
        rate_hz: float | None = None,
        frame: str | None = None,
        progress: Progress | None = None,
    ) -> Recording:
        """Store a recording: its digest, its topics and the hand-offs proposed in it.

        Args:
            recording: A file, which is never held in memory, or bytes. They are sent with their digest.
            media_type: What they are; left out, it is told by the content.
            rate_hz: Samples per second, of a table without times.
            frame: The frame of a table's positions.
            progress: Is told how many bytes went out, of how many; where it begins anew, the line had broken.
        """
        query = {"rate_hz": rate_hz, "frame": frame}
        return await self._upload(Recording, at("recordings"), recording, media_type, progress, query)

    @call
    async def recording(self, recording: str) -> Recording:
        """Look a recording up, by its digest."""
        return await self._get(Recording, at("recordings", recording))

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
        grid: GridMode | None = None,
        cell_mm: float | None = None,
        hysteresis: float | None = None,
        session: str | None = None,
        media_type: str | None = None,
        rate_hz: float | None = None,
        frame: str | None = None,
        progress: Progress | None = None,
    ) -> Demonstration:
        """Store a recording and one demonstration of it; see `add_recording` and `cut_demo`."""
        query = {
            **{"surgeon": surgeon, "suture": suture, "arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
            **{"grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis, "session": session},
            **{"rate_hz": rate_hz, "frame": frame},
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
        grid: GridMode | None = None,
        cell_mm: float | None = None,
        hysteresis: float | None = None,
        session: str | None = None,
    ) -> Demonstration:
        """Cut a demonstration out of a stored recording, named by its digest.

        Args:
            recording: The digest.
            surgeon: Whose hand-off it is.
            suture: Its suture type.
            arm: Needed where several arms moved.
            topic: Needed where an arm was recorded on several.
            start_s: Where it begins in the recording; left out, the hand-off is found.
            end_s: Where it ends.
            grid: "auto" takes the paper's where the path lies in it, and otherwise fits one.
            cell_mm: The edge of a cell of a fitted grid.
            hysteresis: Cells by which a sample must be beyond its cell to leave it, 0 to 0.5; 0.25 against tremor.
            session: A name for what was recorded together.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "arm": arm, "topic": topic, "start_s": start_s, "end_s": end_s},
            **{"grid": grid, "cell_mm": cell_mm, "hysteresis": hysteresis, "session": session},
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
    ) -> list[Demonstration]:
        """List demonstrations, the newest first; `active` true leaves out what was withdrawn, false all else."""
        asked = {"surgeon": surgeon, "suture": suture, "recording": recording, "active": active}
        return await self._all(Demonstration, at("demos"), **asked)

    @call
    async def demo(self, demo: str) -> Demonstration:
        """Look a demonstration up."""
        return await self._get(Demonstration, at("demos", demo))

    @call
    async def demo_report(self, demo: str) -> Demonstration:
        """Get a demonstration with its report, measured anew."""
        return await self._get(Demonstration, at("demos", demo, "report"))

    @call
    async def demo_report_page(self, demo: str) -> bytes:
        """Get a demonstration's report as a page, which needs nothing from outside."""
        answer = await self._send("GET", at("demos", demo, "report"), headers={"Accept": "text/html"})
        return answer.content

    @call
    async def demo_path(self, demo: str) -> DemoPath:
        """Get a demonstration's states, and its motion as it was recorded."""
        return await self._get(DemoPath, at("demos", demo, "path"))

    @call
    async def reward_map(self, demo: str) -> RewardMap:
        """Get the rewards of Algorithm 1 along a demonstration."""
        return await self._get(RewardMap, at("demos", demo, "reward-map"))

    @call
    async def demo_recording(self, demo: str) -> bytes:
        """Get the recording's bytes back; `save_recording` keeps a large one out of memory."""
        return await self._bytes(at("demos", demo, "recording"))

    @call
    async def save_recording(self, demo: str, to: Path, progress: Progress | None = None) -> Path:
        """Fetch a demonstration's recording into a file, which is there only if it is whole and has its digest.

        Raises:
            Corrupt: What came is not the recording; nothing was kept.
        """
        about = await self._get(Demonstration, at("demos", demo))
        return await self._save(at("demos", demo, "recording"), to, progress, sha256=about.recording)

    @call
    async def withdraw_demo(self, demo: str, *, erase: bool = False) -> None:
        """Withdraw a demonstration, or erase it and all that was derived from it."""
        await self._send("DELETE", at("demos", demo), params={"erase": erase})
