"""Calls of plans, their playback in the simulator, and the bag that a robot replays."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from skills.client.connection import Connection, at, call, given
from skills.client.policies import Position
from skills.client.transport import Progress
from skills.errors import BadInput
from skills.remedies import did_you_mean
from skills.schemas.operation import Job
from skills.schemas.plans import Plan, PlanSummary, Trajectory
from skills.schemas.playbacks import Comparison, Playback
from skills.schemas.reach import Reach
from skills.schemas.recordings import SuturePoints
from skills.schemas.timelines import MotionTimeline

BAG, MCAP = "application/zip", "application/vnd.mcap"
Source = Literal["recordings", "demos", "policy-versions", "plans"]


class Plans(Connection):
    """Calls of plans and playbacks."""

    @call
    async def plan(
        self,
        surgeon: str,
        suture: str,
        suture_points: Sequence[Mapping[str, Any] | Position],
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
        handoff: Literal["none"] | None = None,
        orientation: Literal["recorded", "constant"] | None = None,
        a2: Literal["recorded", "paper"] | None = None,
        scene: Mapping[str, Any] | None = None,
        tissue_mm: float | None = None,
    ) -> Plan:
        """Stack a style at suture points.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            suture_points: For each pass the position of its goal as (x, y, z) in mm; or, if the grid is rotated there,
                a
                mapping with `position_mm` and `rotation_xyzw`.
            version: The policy version; default: the released one.
            starts_mm: Start of each pass; None is the demonstrated start, moved with the grid.
            arm: Refused if it is not the demonstrated one; so are `frame` and `instrument`.
            frame: Frame of the positions.
            instrument: Instrument of the arm.
            speed_mm_s: Largest speed of the tip; the surgeon's tempo is slowed to it.
            rate_hz: Samples per second, 100 to 200.
            tip_offset_mm: Distance of the planned points from the jaw's hinge along its approach, towards the finger
                tips.
            psm_m: The arm that takes the needle: `approach`, `base`, `instrument`, `enters`, `source`.
            realignment: False plans A1 alone, without the rotation of A2; `handoff` replaces it.
            handoff: "none" plans A1 alone, which hands nothing over.
            orientation: "recorded" turns the jaw as the surgeon did, "constant" holds it as in the first sample.
            a2: "recorded" ends in the demonstrated hand-off, "paper" across PSM_M's approach.
            scene: Tissue and obstacles for the verdict, as `Scene.as_json` writes them; default: the policy's scene.
            tissue_mm: Height of level tissue in the arm's frame; a motion without tissue is not exported.

        Raises:
            Problem: Of kind "no-hand-off" if neither `psm_m` nor the demonstration gives the pose of PSM_M, and
                `handoff` is
                not "none".
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "suture_points": [_point(point) for point in suture_points]},
            **{"version": version, "arm": arm, "frame": frame, "instrument": instrument, "psm_m": psm_m},
            **{"starts_mm": None if starts_mm is None else [None if s is None else list(s) for s in starts_mm]},
            **{"speed_mm_s": speed_mm_s, "rate_hz": rate_hz, "tip_offset_mm": tip_offset_mm},
            **{"realignment": realignment, "handoff": handoff, "orientation": orientation, "a2": a2, "scene": scene},
            **{"tissue_mm": tissue_mm},
        }
        return await self._ask(Plan, "POST", at("plans"), given(body))

    @call
    async def reach(
        self,
        surgeon: str,
        suture: str,
        *,
        version: int | None = None,
        centre_mm: Position | None = None,
        size_mm: Position | None = None,
        step_mm: float | None = None,
        rotations_xyzw: Sequence[Sequence[float]] | None = None,
        tip_offset_mm: float | None = None,
        psm_m: Mapping[str, Any] | None = None,
        handoff: Literal["none"] | None = None,
        orientation: Literal["recorded", "constant"] | None = None,
        a2: Literal["recorded", "paper"] | None = None,
        scene: Mapping[str, Any] | None = None,
        tissue_mm: float | None = None,
    ) -> Reach:
        """Map where a style can be planned: reach, joint margins and clearances at each place of a box.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            version: The policy version; default: the released one.
            centre_mm: The middle of the box in the arm's frame; default: the demonstrated goal.
            size_mm: Its edges; default: 80, 80 and 0.
            step_mm: The distance of the places; default: 8.
            rotations_xyzw: Rotations of the grid world about each place; default: none.
            tip_offset_mm: As of `plan`, like all that follow.
            psm_m: The arm that takes the needle.
            handoff: "none" for A1 alone.
            orientation: "recorded" or "constant".
            a2: "recorded" or "paper".
            scene: Tissue and obstacles.
            tissue_mm: Height of level tissue.
        """
        body = {
            **{"surgeon": surgeon, "suture": suture, "version": version, "step_mm": step_mm, "psm_m": psm_m},
            **{"tip_offset_mm": tip_offset_mm, "handoff": handoff, "orientation": orientation, "a2": a2},
            **{"scene": scene, "tissue_mm": tissue_mm},
            **{"centre_mm": None if centre_mm is None else list(centre_mm)},
            **{"size_mm": None if size_mm is None else list(size_mm)},
            **{"rotations_xyzw": None if rotations_xyzw is None else [list(one) for one in rotations_xyzw]},
        }
        return await self._ask(Reach, "POST", at("reach"), given(body))

    @call
    async def suture_points(
        self, scene: Path | bytes, arm: str | None = None, frame: str | None = None
    ) -> SuturePoints:
        """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame."""
        return await self._upload(SuturePoints, at("suture-points"), scene, None, None, {"arm": arm, "frame": frame})

    @call
    async def plans(self) -> list[PlanSummary]:
        """List plans, the newest first, each with its newest playback."""
        return await self._all(PlanSummary, at("plans"))

    @call
    async def plan_of(self, plan: str) -> Plan:
        """Return a plan."""
        return await self._get(Plan, at("plans", plan))

    @call
    async def timeline(self, source: Source, sha256: str) -> MotionTimeline:
        """Return a recording, a demonstration, a policy version's learnt path or a plan as columns on one clock.

        Args:
            source: The kind of resource, as in its address.
            sha256: Its digest.
        """
        return await self._get(MotionTimeline, at("timelines", source, sha256))

    @call
    async def timeline_mcap(self, source: Source, sha256: str) -> bytes:
        """Return the same as an MCAP file for viewers such as Foxglove; it is not for execution."""
        return await self._bytes(at("timelines", source, sha256), MCAP)

    @call
    async def trajectory(self, plan: str, pass_index: int | None = None) -> Trajectory:
        """Return a plan's sampled motion, or that of one pass, counted from 0."""
        # `pass` is a keyword of Python, so it cannot be a keyword argument
        return await self._get(Trajectory, at("plans", plan, "trajectory"), **{"pass": pass_index})

    @call
    async def replay_bag(
        self, plan: str, pass_index: int | None = None, *, handoff: Literal["none"] | None = None
    ) -> bytes:
        """Return the bag that a robot replays, a zip, or that of one pass, counted from 0.

        The bag of a plan that hands nothing over needs `handoff="none"`.

        Raises:
            Problem: Of status 409 while the plan may not be replayed, with the reason.
        """
        return await self._bytes(at("plans", plan, "trajectory"), BAG, **{"pass": pass_index, "handoff": handoff})

    @call
    async def save_replay_bag(
        self,
        plan: str,
        to: Path,
        pass_index: int | None = None,
        progress: Progress | None = None,
        *,
        handoff: Literal["none"] | None = None,
    ) -> Path:
        """Download the bag of `replay_bag` to a file, which appears only when it is complete.

        Raises:
            Problem: Of status 409 while the plan may not be replayed, with the reason.
        """
        path = at("plans", plan, "trajectory")
        return await self._save(path, to, progress, accept=BAG, query={"pass": pass_index, "handoff": handoff})

    @call
    async def compare(self, plan: str, demo: str, pass_index: int = 0) -> Comparison:
        """Compare a pass of a plan, counted from 0, with a demonstration cut from the recording of its replay."""
        return await self._get(Comparison, at("plans", plan, "comparison"), demo=demo, **{"pass": pass_index})

    @call
    async def play(
        self, plan: str, errors: Literal["calibrated", "uncalibrated"] | Mapping[str, Any] | None = None
    ) -> Job:
        """Request the playback of a plan in the simulator.

        Args:
            plan: The plan's digest.
            errors: The errors of the arms that are to play it: a default, or the laboratory's own as
                `skills calibrate-arm` writes them; default: those that the installation states.
        """
        return await self._ask(Job, "POST", at("playbacks"), given({"plan": plan, "errors": errors}))

    @call
    async def playback(self, playback: str) -> Playback:
        """Return the simulator's verdict."""
        return await self._get(Playback, at("playbacks", playback))

    @call
    async def picture(self, playback: str) -> bytes:
        """Return the picture of a playback, a PNG."""
        return await self._bytes(at("playbacks", playback, "picture.png"))

    @call
    async def draw(self, playback: str) -> Job:
        """Request the film and plots of a playback; returns the job, which each new playback starts itself."""
        return await self._ask(Job, "POST", at("playbacks", playback, "pictures"))

    @call
    async def animation(self, playback: str, kind: Literal["mp4", "gif"] = "mp4") -> bytes:
        """Return the film of a playback, once it is drawn."""
        return await self._bytes(at("playbacks", playback, f"animation.{_one_of('kind', kind, 'mp4', 'gif')}"))

    @call
    async def plot(self, playback: str, of: Literal["joints", "clearance"]) -> bytes:
        """Return a plot of a playback over time, a PNG, once it is drawn."""
        return await self._bytes(at("playbacks", playback, f"{_one_of('of', of, 'joints', 'clearance')}.png"))


def _one_of(name: str, given: str, *known: str) -> str:
    """Return an argument that is a part of a path.

    Raises:
        BadInput: It is none of the known ones.
    """
    if given not in known:
        raise BadInput(f"{name} must be one of {', '.join(known)}.", *did_you_mean(given, known))
    return given


def _point(given: Any) -> dict[str, Any]:
    """Return a suture point in the form of the service's JSON.

    Raises:
        BadInput: It is neither a position nor a mapping.
    """
    if isinstance(given, Mapping):
        return dict(given)
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise BadInput("Suture points are a list of positions in mm; for one point give [(0, 55, -125)].")
    return {"position_mm": [float(number) for number in given]}
