"""What crosses HTTP. Lengths are mm, angles rad; unknown fields, NaN and infinity are refused."""

from dataclasses import fields
from datetime import date
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt, create_model

from skills.api.deps import DIGEST, SLUG
from skills.db import models as rows
from skills.db.base import rfc3339 as at
from skills.library.plans import Beside, PlanRequest
from skills.library.training import learner_of
from skills.style.grid import MAX_HYSTERESIS, GridMode
from skills.style.handoff import Enters
from skills.style.kinematics import INSTRUMENTS, JAW_TIP_MM
from skills.style.learning.irl import MaxEntIRL
from skills.style.learning.learners import MAX_SEED, Learner
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning
from skills.style.learning.value_iteration import ValueIteration
from skills.style.plan import MAX_OUTSIDE_MM, MAX_PASSES, MAX_TIP_OFFSET_MM, RATE_HZ, SuturePoint


class Schema(BaseModel):
    """What all have in common."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


SlugField = Annotated[str, Field(pattern=SLUG)]
DigestField = Annotated[str, Field(pattern=DIGEST)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Text = Annotated[str, Field(max_length=2000, pattern=r"^[^\x00-\x08\x0b-\x1f\x7f]*$")]
Whole = Annotated[StrictInt, Field(ge=0, le=2**31)]
Number = Annotated[float, Field(strict=True)]  # true is no length
Coordinate = Annotated[Number, Field(ge=-10_000, le=10_000)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Hysteresis = Annotated[
    float,
    Field(
        ge=0,
        le=MAX_HYSTERESIS,
        description="Cells by which a sample must be beyond a face of its cell to leave it; 0.25 keeps a tremor from "
        "crossing a face again and again, and the report says what is lost in mm.",
    ),
]
Component = Annotated[Number, Field(ge=-1e6, le=1e6)]


class Consent(Schema):
    """What a surgeon agreed to, and until when."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class SurgeonIn(Schema):
    """A surgeon, by pseudonym; never a name."""

    skill_level: Literal["novice", "intermediate", "expert"] | None = None
    handedness: Literal["right", "left", "ambidextrous"] | None = None
    protocol: Name | None = None
    consent: Consent | None = None


class SutureTypeIn(Schema):
    """A suture type of the catalogue."""

    name: Name
    also_called: list[Name] = Field(default_factory=list, max_length=20)
    family: Name
    description: Text = ""


class DemoIn(Schema):
    """Which part of a recording is a demonstration, whose, and in which grid."""

    surgeon: SlugField
    suture: SlugField
    arm: Name | None = None
    topic: Name | None = None
    start_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    end_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    grid: GridMode = "auto"
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = None
    hysteresis: Hysteresis = 0.0
    session: SlugField | None = None


def _learner(learner: type[Learner]) -> Any:
    """Make the schema of a learner from its settings; the learner itself checks their values."""
    settings: dict[str, Any] = {f.name: (Whole if f.type is int else Number, f.default) for f in fields(learner)}
    settings["kind"] = (Literal[learner.kind], ...)
    return create_model(learner.__name__, __base__=Schema, __doc__=learner.__doc__, **settings)


LearnerIn: Any = Annotated[
    _learner(PhaseQLearning) | _learner(CellQLearning) | _learner(ValueIteration) | _learner(MaxEntIRL),
    Field(discriminator="kind"),
]


class TrainingIn(Schema):
    """What is to be learnt. Left out: the newest active demonstration, the phase learner, seed 0, no release."""

    surgeon: SlugField
    suture: SlugField
    demos: list[DigestField] | None = None
    learner: LearnerIn | None = None
    seed: Annotated[StrictInt, Field(ge=0, le=MAX_SEED)] = 0
    release: StrictBool = False

    @property
    def chosen(self) -> Learner | None:
        """The learner as the core knows it."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


class RetrainingIn(Schema):
    """Which styles are to be learnt again. Left out: all of them, with the phase learner, without a release."""

    surgeon: SlugField | None = None
    suture: SlugField | None = None
    only_stale: StrictBool = Field(
        default=False,
        description="Leaves out every style whose newest version is what this would make of it: learnt from its newest "
        "demonstration, with these settings, by this version of the learner.",
    )
    learner: LearnerIn | None = None
    release: StrictBool = Field(
        default=False, description="Releases a version that passes the gate and is not worse than the released one."
    )

    @property
    def chosen(self) -> Learner | None:
        """The learner as the core knows it."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


class RolloutIn(Schema):
    """Where a rollout starts, in mm of the policy's frame; left out, `version` is the released one."""

    start_mm: Point
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None


class NextIn(Schema):
    """A position in mm of the policy's frame, and the phase it was reached in; none: it is the start of a pass."""

    position_mm: Point
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class SuturePointIn(Schema):
    """Where a pass's goal is put, and how its grid world is turned about that place."""

    position_mm: Point
    rotation_xyzw: tuple[Component, Component, Component, Component] = (0.0, 0.0, 0.0, 1.0)


class BaseIn(Schema):
    """Where PSM_M's base, its remote centre, is in the base of the arm that was demonstrated, and how it is turned."""

    position_mm: Point
    rotation_xyzw: tuple[Component, Component, Component, Component]


class PsmMIn(Schema):
    """The arm that takes the needle, in the frame of the arm that was demonstrated."""

    approach: tuple[Component, Component, Component] | None = Field(
        default=None, description="Its direction towards the needle; left out, the demonstrated one."
    )
    base: BaseIn | None = Field(
        default=None,
        description="Left out, the demonstrated one; where that is not known, PSM_M is in no scene or bag.",
    )
    instrument: Annotated[str, Field(pattern=f"^({'|'.join(INSTRUMENTS)})$")] | None = None
    enters: Enters = "after_A1"
    source: Name | None = Field(default=None, description="Where these numbers come from; the plan repeats it.")


class PlanIn(Schema):
    """Grid worlds to stack."""

    surgeon: SlugField
    suture: SlugField
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None
    suture_points: Annotated[list[SuturePointIn], Field(min_length=1, max_length=MAX_PASSES)]
    starts_mm: Annotated[list[Point | None], Field(max_length=MAX_PASSES)] | None = Field(
        default=None,
        description=f"Up to {MAX_OUTSIDE_MM:g} mm outside a pass's grid world a transfer leads into it.",
    )
    arm: Name | None = None
    frame: Name | None = None
    instrument: Name | None = None
    speed_mm_s: Annotated[Number, Field(gt=0, le=1000)] = 20.0
    rate_hz: Annotated[Number, Field(ge=RATE_HZ[0], le=RATE_HZ[1])] = 200.0
    tip_offset_mm: Annotated[Number, Field(ge=0, le=MAX_TIP_OFFSET_MM)] = Field(
        default=0.0,
        description=f"How far down the jaw's approach from its hinge suture points and starts are meant; "
        f"{JAW_TIP_MM:g} for the finger tips.",
    )
    psm_m: PsmMIn | None = Field(
        default=None, description="Left out, it is taken from the demonstration where that has PSM_M's pose."
    )
    realignment: StrictBool = Field(default=True, description="false plans A1 alone, without A2's turn.")

    @property
    def request(self) -> PlanRequest:
        """The request as the library knows it."""
        same = ("surgeon", "suture", "version", "starts_mm", "arm", "frame", "instrument", "speed_mm_s", "rate_hz")
        points = [SuturePoint(p.position_mm, p.rotation_xyzw) for p in self.suture_points]
        return PlanRequest(
            suture_points=points,
            tip_offset_mm=self.tip_offset_mm,
            psm_m=None if self.psm_m is None else _beside(self.psm_m),
            realignment=self.realignment,
            **{name: getattr(self, name) for name in same},
        )


def _beside(asked: PsmMIn) -> Beside:
    base = asked.base
    return Beside(
        approach=asked.approach,
        base_mm=None if base is None else base.position_mm,
        base_xyzw=None if base is None else base.rotation_xyzw,
        instrument=asked.instrument,
        enters=asked.enters,
        source="the request" if asked.source is None else f"the request: {asked.source}",
    )


class PlaybackIn(Schema):
    """Which plan to play."""

    plan: DigestField


def surgeon_out(row: rows.Surgeon) -> dict[str, Any]:
    """Write a surgeon."""
    return {
        "surgeon": row.slug,
        "skill_level": row.skill_level,
        "handedness": row.handedness,
        "protocol": row.protocol,
        "consent": row.consent,
        "created_at": at(row.created_at),
    }


def suture_out(row: rows.SutureType) -> dict[str, Any]:
    """Write a suture type."""
    return {
        "suture": row.slug,
        "name": row.name,
        "also_called": row.also_called,
        "family": row.family,
        "description": row.description,
    }


def recording_out(row: rows.StoredRecording) -> dict[str, Any]:
    """Write a recording."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "size_bytes": row.size_bytes,
        "media_type": row.media_type,
        "format": row.format,
        "integrity": row.integrity,
        **row.about,
        "created_at": at(row.created_at),
    }


def demo_out(row: rows.Demonstration) -> dict[str, Any]:
    """Write a demonstration."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "recording": row.recording.sha256,
        "surgeon": row.surgeon.slug,
        "suture": row.suture,
        "arm": row.arm,
        "topic": row.topic,
        "frame": row.frame,
        "instrument": row.instrument,
        "start_s": row.start_s,
        "end_s": row.end_s,
        "session": row.session,
        "hysteresis": row.hysteresis,
        "state": "active" if row.withdrawn_at is None else "withdrawn",
        "report": row.report,
        "created_at": at(row.created_at),
        "withdrawn_at": at(row.withdrawn_at),
    }


def job_out(row: rows.Job) -> dict[str, Any]:
    """Write a job."""
    return {
        "id": row.id,
        "kind": row.kind,
        "state": row.state,
        "progress": row.progress,
        "request": row.request,
        "result": row.result,
        "error": row.error,
        "created_at": at(row.created_at),
        "started_at": at(row.started_at),
        "ended_at": at(row.ended_at),
    }


def retrained_out(row: rows.StyleToRetrain) -> dict[str, Any]:
    """Write what became of one style of a batch."""
    return {
        "surgeon": row.demonstration.surgeon.slug,
        "suture": row.demonstration.suture,
        "demo": row.demonstration.sha256,
        "stale_because": row.stale,
        "state": row.state,
        "reason": row.reason,
        "policy_version": row.policy and row.policy.version,
        "sha256": row.policy and row.policy.sha256,
        "comparison": row.comparison,
        "ended_at": at(row.ended_at),
    }


def plan_out(row: rows.Plan) -> dict[str, Any]:
    """Write a plan."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "surgeon": row.policy.surgeon.slug,
        "suture": row.policy.suture,
        "policy": {"version": row.policy.version, "sha256": row.policy.sha256},
        **row.about,
        "created_at": at(row.created_at),
    }


def playback_out(row: rows.StoredPlayback) -> dict[str, Any]:
    """Write a playback; all of its pictures but the first are drawn after the verdict."""
    here = f"/playbacks/{row.sha256}"
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "plan": row.plan.sha256,
        "feasible": row.feasible,
        "report": row.report,
        "picture": f"{here}/picture.png",
        "pictures": {
            "picture": f"{here}/picture.png",
            "animation_mp4": f"{here}/animation.mp4",
            "animation_gif": f"{here}/animation.gif",
            "joints": f"{here}/joints.png",
            "clearance": f"{here}/clearance.png",
        },
        "created_at": at(row.created_at),
    }


def version_out(row: rows.PolicyVersion) -> dict[str, Any]:
    """Write a line of a style's history."""
    return {
        "version": row.version,
        "sha256": row.sha256,
        "learner": row.manifest["learner"],
        "demos": row.manifest["demos"],
        "seed": row.manifest["seed"],
        "metrics": row.manifest["metrics"],
        "coverage": row.manifest["coverage"],
        "releasable": row.releasable,
        "created_at": at(row.created_at),
    }
