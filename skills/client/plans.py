"""Plans, their playback in the simulator, and the bag that a robot replays."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from skills.api.schemas.given import Comparison, Job, Plan, Playback, SuturePoints, Trajectory
from skills.client.calls import at, call
from skills.client.connection import Connection, given
from skills.client.files import Progress
from skills.client.policies import Position

BAG = "application/zip"


class Plans(Connection):
    """The calls."""

    @call
    async def plan(
        self,
        surgeon: str,
        suture: str,
        suture_points: Sequence[Mapping[str, Any]],
        *,
        version: int | None = None,
        starts_mm: Sequence[Position | None] | None = None,
        arm: str | None = None,
        frame: str | None = None,
        instrument: str | None = None,
        speed_mm_s: float | None = None,
        rate_hz: float | None = None,
        tip_offset_mm: float | None = None,
        psm_m: Mapping[str, Any] | None = None,
        realignment: bool | None = None,
    ) -> Plan:
        """Stack a style at suture points.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            suture_points: Of each pass the `position_mm` of its goal and, where it is turned, the `rotation_xyzw`.
            version: Left out, the released one.
            starts_mm: Where each pass begins; None is the demonstrated start, moved with the grid.
            arm: Refused where it is not the demonstrated one; so are `frame` and `instrument`.
            frame: Of the positions.
            instrument: Of the arm.
            speed_mm_s: At most, of the tip.
            rate_hz: Samples per second, 100 to 200.
            tip_offset_mm: How far down from the jaw's hinge positions are meant.
            psm_m: The arm that takes the needle: `approach`, `base`, `instrument`, `enters`, `source`.
            realignment: False plans A1 alone, without A2's turn.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "suture_points": [dict(point) for point in suture_points]},
            **{"version": version, "arm": arm, "frame": frame, "instrument": instrument, "psm_m": psm_m},
            **{"starts_mm": None if starts_mm is None else [None if s is None else list(s) for s in starts_mm]},
            **{"speed_mm_s": speed_mm_s, "rate_hz": rate_hz, "tip_offset_mm": tip_offset_mm},
            **{"realignment": realignment},
        }
        return await self._ask(Plan, "POST", at("plans"), given(body))

    @call
    async def suture_points(
        self, scene: Path | bytes, arm: str | None = None, frame: str | None = None
    ) -> SuturePoints:
        """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame."""
        return await self._upload(SuturePoints, at("suture-points"), scene, None, None, {"arm": arm, "frame": frame})

    @call
    async def plan_of(self, plan: str) -> Plan:
        """Look a plan up."""
        return await self._get(Plan, at("plans", plan))

    @call
    async def trajectory(self, plan: str, pass_index: int | None = None) -> Trajectory:
        """Get a plan's motion, sampled; or that of one pass, counted from 0."""
        return await self._get(Trajectory, at("plans", plan, "trajectory"), **{"pass": pass_index})

    @call
    async def replay_bag(self, plan: str, pass_index: int | None = None) -> bytes:
        """Get the bag that a robot replays, a zip; or that of one pass, counted from 0.

        Raises:
            Problem: It is 409 while the plan may not be replayed, and says why.
        """
        return await self._bytes(at("plans", plan, "trajectory"), BAG, **{"pass": pass_index})

    @call
    async def save_replay_bag(
        self, plan: str, to: Path, pass_index: int | None = None, progress: Progress | None = None
    ) -> Path:
        """Fetch the same into a file, which is there only if it is whole.

        Raises:
            Problem: It is 409 while the plan may not be replayed, and says why.
        """
        path = at("plans", plan, "trajectory")
        return await self._save(path, to, progress, accept=BAG, query={"pass": pass_index})

    @call
    async def compare(self, plan: str, demo: str, pass_index: int = 0) -> Comparison:
        """Compare a pass of a plan, counted from 0, with a demonstration that is the recording of its replay."""
        return await self._get(Comparison, at("plans", plan, "comparison"), demo=demo, **{"pass": pass_index})

    @call
    async def play(self, plan: str) -> Job:
        """Ask for a plan to be played in the simulator."""
        return await self._ask(Job, "POST", at("playbacks"), {"plan": plan})

    @call
    async def playback(self, playback: str) -> Playback:
        """Get the simulator's verdict."""
        return await self._get(Playback, at("playbacks", playback))

    @call
    async def picture(self, playback: str) -> bytes:
        """Get the picture of a playback, a PNG."""
        return await self._bytes(at("playbacks", playback, "picture.png"))

    @call
    async def draw(self, playback: str) -> Job:
        """Ask for the film and the plots of a playback: the job to wait for, which each new playback starts itself."""
        return await self._ask(Job, "POST", at("playbacks", playback, "pictures"))

    @call
    async def animation(self, playback: str, kind: Literal["mp4", "gif"] = "mp4") -> bytes:
        """Get the film of a playback, once it is drawn."""
        return await self._bytes(at("playbacks", playback, f"animation.{kind}"))

    @call
    async def plot(self, playback: str, of: Literal["joints", "clearance"]) -> bytes:
        """Get a plot of a playback over time, a PNG, once it is drawn."""
        return await self._bytes(at("playbacks", playback, f"{of}.png"))
