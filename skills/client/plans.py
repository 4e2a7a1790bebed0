"""Calls of plans, their playback in the simulator, the bag that a robot replays, and timelines of motions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

from skills import schemas
from skills.client.connection import Connection
from skills.client.files import Progress
from skills.client.policies import Position
from skills.errors import BadInput
from skills.keywords import PlanKeywords, ReachKeywords
from skills.remedies import did_you_mean

if TYPE_CHECKING:
    from skills.dynamics import Servo
    from skills.schemas.operation import Job
    from skills.schemas.plans import Plan, PlanSummary, SegmentIndex, SuturePointIn, Trajectory
    from skills.schemas.playbacks import ArmErrorsIn, Comparison, Playback
    from skills.schemas.reach import Reach
    from skills.schemas.timelines import MotionTimeline

BAG, MCAP = "application/zip", "application/vnd.mcap"
TRAJECTORY = "/plans/{plan}/trajectory"
Source = Literal["recordings", "demos", "policy-versions", "plans"]


class Plans(Connection):
    """Calls of plans and playbacks."""

    async def plan(
        self,
        surgeon: str,
        suture: str,
        suture_points: Sequence[SuturePointIn | Mapping[str, Any] | Position],
        **options: Unpack[PlanKeywords],
    ) -> Plan:
        """Stack a style at suture points.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            suture_points: For each pass the position of its goal as (x, y, z) in mm; or, if the grid is rotated there,
                with `position_mm` and `rotation_xyzw`.
            **options: The version, the motion, the arm that takes the needle, and the scene.

        Raises:
            Problem: Of kind "no-hand-off" if neither `psm_m` nor the demonstration gives the pose of PSM_M, and
                `handoff` is not "none".
        """
        points = [_point(point) for point in suture_points]
        return await self._ask(
            schemas.plans.Plan,
            "POST",
            "/plans",
            {"surgeon": surgeon, "suture": suture, "suture_points": points, **options},
        )

    async def reach(self, surgeon: str, suture: str, **options: Unpack[ReachKeywords]) -> Reach:
        """Map where a style can be planned: reach, joint margins and clearances at each place of a box."""
        return await self._ask(schemas.reach.Reach, "POST", "/reach", {"surgeon": surgeon, "suture": suture, **options})

    async def plans(self) -> list[PlanSummary]:
        """List plans, the newest first, each with its newest playback."""
        return await self._all(schemas.plans.PlanSummary, "/plans")

    async def plan_of(self, plan: str) -> Plan:
        """Return a plan."""
        return await self._get(schemas.plans.Plan, "/plans/{plan}", plan=plan)

    async def timeline(self, source: Source, sha256: str) -> MotionTimeline:
        """Return a recording, a demonstration, a policy version's learnt path or a plan as columns on one clock.

        Args:
            source: The kind of resource, as in its address.
            sha256: Its digest.
        """
        return await self._get(
            schemas.timelines.MotionTimeline, "/timelines/{source}/{sha256}", source=source, sha256=sha256
        )

    async def timeline_mcap(self, source: Source, sha256: str) -> bytes:
        """Return the same as an MCAP file for viewers such as Foxglove; it is not for execution."""
        return await self._bytes("/timelines/{source}/{sha256}", MCAP, source=source, sha256=sha256)

    async def trajectory(self, plan: str, pass_index: int | None = None) -> Trajectory:
        """Return a plan's sampled motion, or that of one pass, counted from 0."""
        # `pass` is a keyword of Python, so it cannot be a keyword argument
        return await self._get(schemas.plans.Trajectory, TRAJECTORY, plan=plan, **{"pass": pass_index})

    async def segments(self, plan: str) -> SegmentIndex:
        """Return the automatic segments of a plan, and what must be true before each."""
        return await self._get(schemas.plans.SegmentIndex, "/plans/{plan}/segments", plan=plan)

    async def replay_bag(self, plan: str, *, handoff: Literal["none"] | None = None) -> bytes:
        """Return the bag that a robot replays, a zip with a folder for each automatic segment.

        The bag of a plan that hands nothing over needs `handoff="none"`.

        Raises:
            Problem: Of status 409 while the plan may not be replayed, with the reason.
        """
        return await self._bytes(TRAJECTORY, BAG, plan=plan, handoff=handoff)

    async def save_replay_bag(
        self,
        plan: str,
        to: Path,
        progress: Progress | None = None,
        *,
        handoff: Literal["none"] | None = None,
    ) -> Path:
        """Download the bag of `replay_bag` to a file, which appears only when it is complete.

        Raises:
            Problem: Of status 409 while the plan may not be replayed, with the reason.
        """
        return await self._save(TRAJECTORY, to, progress, accept=BAG, plan=plan, handoff=handoff)

    async def compare(self, plan: str, demo: str, pass_index: int = 0) -> Comparison:
        """Compare a pass of a plan, counted from 0, with a demonstration cut from the recording of its replay."""
        return await self._get(
            schemas.playbacks.Comparison, "/plans/{plan}/comparison", plan=plan, demo=demo, **{"pass": pass_index}
        )

    async def play(
        self,
        plan: str,
        errors: Literal["calibrated", "uncalibrated"] | ArmErrorsIn | Mapping[str, Any] | None = None,
        servo: Servo | Mapping[str, Any] | None = None,
    ) -> Job:
        """Request the playback of a plan in the simulator; the job's result is a `PlaybackResult`.

        Args:
            plan: The plan's digest.
            errors: The errors of the arms that are to play it: a default, or the laboratory's own as
                `skills calibrate-arm` writes them; default: those that the installation states.
            servo: How PSM_A is driven (docs/execution.md); default: as the installation states.
        """
        asked = {"plan": plan, "errors": errors, "servo": servo}
        return await self._ask(schemas.operation.Job, "POST", "/playbacks", asked)

    async def playback(self, playback: str) -> Playback:
        """Return the simulator's verdict."""
        return await self._get(schemas.playbacks.Playback, "/playbacks/{playback}", playback=playback)

    async def picture(self, playback: str) -> bytes:
        """Return the picture of a playback, a PNG."""
        return await self._bytes("/playbacks/{playback}/picture.png", playback=playback)

    async def draw(self, playback: str) -> Job:
        """Request the film and plots of a playback; returns the job, which each new playback starts itself."""
        return await self._ask(schemas.operation.Job, "POST", "/playbacks/{playback}/pictures", playback=playback)

    async def animation(self, playback: str, kind: Literal["mp4", "gif"] = "mp4") -> bytes:
        """Return the film of a playback, once it is drawn."""
        file = f"animation.{_one_of('kind', kind, 'mp4', 'gif')}"
        return await self._bytes("/playbacks/{playback}/{file}", playback=playback, file=file)

    async def plot(self, playback: str, of: Literal["joints", "clearance"]) -> bytes:
        """Return a plot of a playback over time, a PNG, once it is drawn."""
        file = f"{_one_of('of', of, 'joints', 'clearance')}.png"
        return await self._bytes("/playbacks/{playback}/{file}", playback=playback, file=file)


def _one_of(name: str, value: str, *known: str) -> str:
    """Return an argument that is a part of a path.

    Raises:
        BadInput: It is none of the known ones.
    """
    if value not in known:
        raise BadInput(f"{name} must be one of {', '.join(known)}.", *did_you_mean(value, known))
    return value


def _point(point: Any) -> Any:
    """Return a suture point in the form of the request: a position becomes one without a rotation.

    Raises:
        BadInput: It is neither a suture point nor a position.
    """
    if isinstance(point, str | float | int):
        raise BadInput("Suture points are a list of positions in mm; for one point give [(0, 55, -125)].")
    return {"position_mm": [float(number) for number in point]} if _is_position(point) else point


def _is_position(point: object) -> bool:
    from pydantic import BaseModel

    return isinstance(point, Iterable) and not isinstance(point, Mapping | BaseModel)
