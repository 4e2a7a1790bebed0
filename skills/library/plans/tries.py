"""Tries: from a stored recording to a verdict in one job, by the use cases that the single calls have.

    TryIn --request_try--> Job
    Job's request --try_recording--> TryStep, TryStep, ... --perform_try--> the job's result, written at each step

Cell size and hysteresis are chosen by the measured loss: the coarsest cells of at most the paper's 5 mm that lose at
most the stated amount, with hysteresis where the path trembles without it. The service cannot know the hand-off that is
meant, the height of the tissue, the errors of the arms, and whether to release; it asks for what the request leaves
open, and the job ends there. Nothing is released unless the request says so and the plan is feasible.

Each step is stored by its use case before the next one begins, so a try that is sent again, with an answer or after a
failure, finds what it stored before.
"""

import secrets
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from math import ceil
from typing import ClassVar

from pydantic import JsonValue
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.segments import Segment
from skills.errors import BadSettings, Conflict, DatabaseBusy, SkillsError
from skills.fields import percent
from skills.formats.parsed import ParsedContent
from skills.gridworld import paper
from skills.gridworld.grid import PathReport, choose_grid, describe_path, discretize
from skills.learning.ties import OPTIMAL
from skills.library.operation import jobs, locks
from skills.library.operation.jobs import JobRequest, RequestedJob, Store
from skills.library.people.consent import require
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.plans.plans import hand_of, plan_sutures
from skills.library.plans.playbacks import (
    check_playback,
    find_playback,
    headline_of,
    playback_request,
)
from skills.library.policies import releases
from skills.library.policies.gate import GateLimits, join_reasons, remedy
from skills.library.policies.training import train_style, training_request
from skills.library.policies.versions import find_by_digest
from skills.library.recordings.demos import add_demo
from skills.library.recordings.parts import choose_part
from skills.library.recordings.recordings import Parser, confined_reader, find_recording, stored_recording
from skills.remedies import Remedy
from skills.schemas.demos import DemoIn
from skills.schemas.plans import PlanIn, SuturePointIn
from skills.schemas.results import TryResult
from skills.schemas.training import TrainingIn
from skills.schemas.tries import Choice, StepName, TryIn, TryStep
from skills.settings import Settings
from skills.verification.gates import SCENE

TRY = "try"
CELLS_MM = (paper.CELL_MM, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0)  # ours, from the paper's to what a recording can resolve
MOST_CHOICES = 20
STEPS = 10  # of a try that is not stopped, for its progress


class TryRequest(JobRequest, TryIn):
    """The request of a try's job; `again` is unique to a try that is repeated after its end."""

    kind: ClassVar[str] = TRY

    again: str | None = None


def request_try(session: Session, asked: TryIn, actor: str) -> RequestedJob:
    """Queue a try; an equal one that has not ended is returned as it is.

    Raises:
        NotFound: The recording, the surgeon or the suture type is unknown.
        Conflict: The surgeon's consent does not cover training.
    """
    surgeon = find_surgeon(session, asked.surgeon)
    require(surgeon, "training")
    recording = find_recording(session, asked.recording).sha256  # in full: the argument may be a prefix
    find_suture_type(session, asked.suture)
    request = TryRequest(**dict(asked) | {"recording": recording})
    known = jobs.find_live(session, request)
    if known is not None and known.state == "succeeded":
        # What it reported may have been withdrawn or erased since, so it is tried again, not looked up.
        request = request.model_copy(update={"again": secrets.token_hex(8)})
    return jobs.ask(session, request, surgeon, actor)


def perform_try(database: Database, request: TryRequest, settings: Settings) -> Store[TryResult]:
    """Carry out a try, and write each of its steps into the running job's result.

    Raises:
        SkillsError: A step was refused; the job's result has the steps up to it.
    """
    mine = Job.identity == request.identity, Job.state == "running"
    with database.reading() as session:
        actor = session.scalar(select(Job.requested_by).where(*mine)) or ""
    so_far = TryResult()
    reader = confined_reader(settings)
    with closing(reader.server):  # it starts only if the recording is not cached
        for step in try_recording(database, request, actor, settings, reader.parse):
            so_far = TryResult(steps=(*so_far.steps, step))
            progress = min(len(so_far.steps) / STEPS, 0.95)
            with database.writing(()) as session:
                session.execute(
                    update(Job).where(*mine).values(result=so_far.model_dump(mode="json"), progress=progress)
                )

    def store(_session: Session, _actor: str) -> TryResult:
        return so_far

    return store


def try_recording(database: Database, asked: TryIn, actor: str, settings: Settings, read: Parser) -> Iterator[TryStep]:
    """Cut, learn, certify, release if wanted, plan, play and judge a recording; yield each step when it is done.

    The steps end with a question that the request does not answer, with a refusal, or with the verdict.

    Args:
        database: The database; no transaction is open while something is computed.
        asked: The request.
        actor: The owner of the caller's key.
        settings: Limits, the release gate and the verdict's errors.
        read: The reader of recordings.

    Raises:
        SkillsError: A step was refused; the last step that was yielded has the same reason.
    """
    at: StepName = "read"
    others: list[Choice] = []
    try:
        told = stored_recording(database, asked.recording, read)
        yield _done("read", _describe_recording(told))
        at = "propose"
        others = _other_parts(told.proposed, asked.segment)
        if asked.segment is None and len(told.proposed) > 1:
            yield TryStep(name="propose", state="asks", text=_describe_proposed(told.proposed), choices=tuple(others))
            return
        cut = DemoIn(surgeon=asked.surgeon, suture=asked.suture, segment=asked.segment)
        part, which, because = choose_part(told, cut)
        yield _done("propose", f"{_describe_proposed(told.proposed)} Taken: {which}; {because}.")
        at = "cut"
        demo = cut_demo(told.recording, arm=part.arm, topic=part.topic, start_s=part.start_s, end_s=part.end_s)
        chosen, measured = choose_cells(demo, asked)
        others = [*_finer(chosen, measured), *others]
        cut = cut.model_copy(update={"cell_mm": chosen.cell_mm, "hysteresis": chosen.hysteresis})
        added = add_demo(database, asked.recording, cut, actor, read).row
        yield _done("cut", chosen.because, added.sha256)
        yield _done("report", " ".join(added.report.advice) or "Nothing to improve in the recording.")
        at = "train"
        version, trained = _learn(database, asked, added.sha256, actor, settings)
        yield trained
        at = "certify"
        certified = _certified(version, others)
        yield certified
        passes = certified.state == "done"
        if questions := _questions(asked, passes):
            yield from questions
            return
        at = "plan"
        plan, words = _plan(database, asked, version, actor)
        yield _done("plan", words, plan)
        at = "play"
        feasible = yield from _play(database, asked, plan, actor, settings, others)
        yield _release(
            database, version, actor, settings, wanted=asked.release is True, passes=passes, feasible=feasible
        )
    except DatabaseBusy:  # refuses nothing: the job waits and begins again
        raise
    except SkillsError as refused:
        if isinstance(least_mm := refused.numbers.get("least_mm"), float):
            reached_mm = ceil(10 * least_mm) / 10
            others.insert(0, Choice(words=f"accept a loss of {reached_mm:g} mm", change={"loss_mm": reached_mm}))
        yield _refused(at, refused, others)
        raise


# ---- the choice of cells -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cells:
    """Cells for a demonstration, their loss, and in words why they were chosen.

    Attributes:
        cell_mm: Length of an edge.
        hysteresis: In cells.
        report: What the path through them loses.
        because: The choice and its reason; empty for cells that were not chosen.
    """

    cell_mm: float
    hysteresis: float
    report: PathReport
    because: str = ""

    @property
    def loss_mm(self) -> float:
        """The RMSE between samples and the centres of their cells, 3-D."""
        assert self.report.discretisation_rmse_3d_mm is not None, "a new report has it"
        return self.report.discretisation_rmse_3d_mm

    @property
    def named(self) -> str:
        """The cells in words."""
        return f"{self.cell_mm:g} mm cells" + (f" with hysteresis {self.hysteresis:g}" if self.hysteresis else "")


def choose_cells(demo: Demo, asked: TryIn) -> tuple[Cells, list[Cells]]:
    """Return the chosen cells of a demonstration, with the reason, and all that were measured, the coarsest first.

    The coarsest cells of `CELLS_MM` are chosen whose loss is at most `loss_mm`; each size has the hysteresis that
    `describe_path` advises against a tremor, unless the request states one. A stated size is not compared
    with the loss.

    Raises:
        BadSettings: No size loses so little.
        BadPath: The motion has no path in any of the grids.
    """
    measured: list[Cells] = []
    without_path: SkillsError | None = None
    for cell_mm in CELLS_MM if asked.cell_mm is None else (asked.cell_mm,):
        try:
            measured.append(_measure(demo, cell_mm, asked.hysteresis))
        except SkillsError as refused:  # such as a motion within one cell: finer ones may show it
            without_path = without_path or refused
    if not measured:
        assert without_path is not None
        raise without_path
    if asked.cell_mm is not None:
        best, rule = measured[0], "as stated"
    else:
        fitting = [one for one in measured if one.loss_mm <= asked.loss_mm]
        if not fitting:
            raise BadSettings(
                f"No cells of {CELLS_MM[-1]:g} to {CELLS_MM[0]:g} mm lose at most {asked.loss_mm:g} mm; the finest "
                f"lose {measured[-1].loss_mm:.2f} mm (RMSE, 3-D).",
                loss_mm=asked.loss_mm,
                least_mm=measured[-1].loss_mm,
            )
        best, rule = fitting[0], f"the coarsest that lose at most {asked.loss_mm:g} mm"
    coarser = measured[max(measured.index(best) - 1, 0)]
    beside = "" if coarser is best else f"; {coarser.named} lose {coarser.loss_mm:.2f} mm"
    because = (
        f"{best.named}, {rule}: {best.loss_mm:.2f} mm (RMSE, 3-D){beside}. The path has {best.report.path_states} "
        f"states and {best.report.revisits} crossing{'' if best.report.revisits == 1 else 's'}."
    )
    return Cells(best.cell_mm, best.hysteresis, best.report, because), measured


def _measure(demo: Demo, cell_mm: float, hysteresis: float | None) -> Cells:
    grid = choose_grid(demo.tip_mm, "auto", cell_mm)
    report = describe_path(demo, discretize(demo.tip_mm, grid, hysteresis or 0.0))
    if hysteresis is not None or report.advised_hysteresis is None:
        return Cells(cell_mm, hysteresis or 0.0, report)
    calmed = discretize(demo.tip_mm, grid, report.advised_hysteresis)
    return Cells(cell_mm, report.advised_hysteresis, describe_path(demo, calmed))


# ---- the steps -----------------------------------------------------------------------------------------------------


def _done(name: StepName, text: str, digest: str | None = None) -> TryStep:
    return TryStep(name=name, state="done", text=text, id=digest)


def _refused(name: StepName, refused: SkillsError, others: Sequence[Choice]) -> TryStep:
    remedies = tuple(one.as_json() if isinstance(one, Remedy) else one for one in refused.remedies)
    return TryStep(name=name, state="refused", text=refused.message, choices=tuple(others), remedies=remedies)


def _describe_recording(parsed: ParsedContent) -> str:
    about = parsed.about
    motions = "; ".join(
        f"{one.arm} in {one.frame}, {one.samples} samples"
        + ("" if quality.rate_hz is None else f" at {quality.rate_hz:.0f} Hz")
        for one, quality in zip(about.motions, about.quality, strict=True)
    )
    return f"A recording of {about.duration_s:.1f} s ({parsed.recording.format}): {motions}."


def _describe_proposed(proposed: Sequence[Segment]) -> str:
    if not proposed:
        return "No hand-off is proposed."
    return "1 hand-off is proposed." if len(proposed) == 1 else f"{len(proposed)} hand-offs are proposed."


def _other_parts(proposed: Sequence[Segment], taken: int | str | None) -> list[Choice]:
    """Return the proposals that are not taken, and the whole recording."""
    found = [
        Choice(
            words=f"take proposal {number}: {one.arm}, {one.start_s:.2f} to {one.end_s:.2f} s",
            change={"segment": number},
        )
        for number, one in enumerate(proposed[:MOST_CHOICES], 1)
        if number != (1 if taken is None and len(proposed) == 1 else taken)
    ]
    whole = Choice(words="take the whole recording", change={"segment": "whole"})
    return found if taken == "whole" or not proposed else [*found, whole]


def _finer(chosen: Cells, measured: Sequence[Cells]) -> list[Choice]:
    """Return the next finer cells, and the hysteresis where there is none, as choices after a refusal."""
    after = [one for one in measured if one.cell_mm < chosen.cell_mm][:2]
    found = [
        Choice(
            words=f"use {one.named} (they lose {one.loss_mm:.2f} mm)",
            change={"cell_mm": one.cell_mm, "hysteresis": one.hysteresis},
        )
        for one in after
    ]
    if not chosen.hysteresis:
        found.append(Choice(words="use hysteresis 0.25", change={"hysteresis": 0.25}))
    return found


def _learn(
    database: Database, asked: TryIn, demo: str, actor: str, settings: Settings
) -> tuple[PolicyVersion, TryStep]:
    """Learn and certify a style from a demonstration and store it; return its version, and the step."""
    training = TrainingIn(surgeon=asked.surgeon, suture=asked.suture, demos=[demo])
    with database.reading() as session:
        request, _ = training_request(session, training, GateLimits.of(settings))
    store = train_style(database, request, settings)
    with database.writing([locks.surgeon(asked.surgeon)]) as session:
        version = find_by_digest(session, store(session, actor).sha256)
        assert version.surgeon.slug == asked.surgeon  # loaded here, for the time after the session
    metrics = version.manifest.metrics
    text = (
        f"Version {version.version} by {version.manifest.learner}: it reproduces {metrics.exact_states} of "
        f"{metrics.path_states} states of the demonstration, DTW {metrics.dtw_total_mm:g} mm."
    )
    return version, _done("train", text, version.sha256)


def _certified(version: PolicyVersion, others: Sequence[Choice]) -> TryStep:
    """Return the step of the certificate; one that forbids the release does not end the try."""
    certificate, coverage = version.manifest.grid_certificate, version.manifest.coverage
    near = certificate.near
    optimal = certificate.states_checked - certificate.suboptimal_actions
    text = (
        f"{optimal} of {certificate.states_checked} actions are {OPTIMAL}, {coverage.starts_reaching_goal} of "
        f"{coverage.n_states} starts reach the goal, and each within {near.radius_mm:g} mm of the demonstrated "
        f"one follows at least {percent(near.share)}% of the demonstration (limit {percent(near.least_share)}%)."
    )
    reasons = certificate.refused_because
    if not reasons:
        return _done("certify", f"{text} It passes the gate of a release.", version.sha256)
    remedies = tuple(dict.fromkeys(remedy([one]) for one in reasons))
    return TryStep(
        name="certify",
        state="refused",
        text=f"{text} It cannot be released: {join_reasons(reasons)}.",
        choices=tuple(others),
        remedies=remedies,
        id=version.sha256,
    )


def _asks(name: StepName, text: str, *choices: tuple[str, dict[str, JsonValue]]) -> TryStep:
    chosen = tuple(Choice(words=words, change=change) for words, change in choices)
    return TryStep(name=name, state="asks", text=text, choices=chosen)


QUESTIONS = (
    _asks(
        "tissue",
        "How high is the tissue, along z of the arm's frame, in mm?",
        ("plan without tissue; the motion is then not exported", {"tissue_mm": "none"}),
    ),
    _asks(
        "errors",
        "With which errors of the arms is it judged?",
        ("errors of a calibrated arm (docs/errors.md)", {"errors": "calibrated"}),
        ("errors of an arm as it is delivered", {"errors": "uncalibrated"}),
    ),
    _asks(
        "release",
        "Release this version, so that it is served? Research use only.",
        ("release it", {"release": True}),
        ("do not", {"release": False}),
    ),
)


def _questions(asked: TryIn, passes: bool) -> list[TryStep]:
    """Return a step for each question that the request leaves open after the certificate."""
    given = {"tissue": asked.tissue_mm, "errors": asked.errors, "release": asked.release if passes else False}
    return [one for one in QUESTIONS if given[one.name] is None]


def _release(
    database: Database,
    version: PolicyVersion,
    actor: str,
    settings: Settings,
    *,
    wanted: bool,
    passes: bool,
    feasible: bool,
) -> TryStep:
    """Release a version if that is wanted, it passes the gate, and its plan is feasible; a refusal ends no try."""
    with database.reading() as session:
        served = releases.served(session, version.surgeon, version.suture)
        now = "" if served is None else f" Version {served.policy.version} is served."
    if not (wanted and passes and feasible):
        plan = "its plan is not feasible; release it by its number if it is to be served all the same"
        why = "it does not pass the gate" if not passes else "that was not requested" if not wanted else plan
        return _done("release", f"Version {version.version} is not released by this: {why}.{now}")
    try:
        with database.writing([locks.surgeon(version.surgeon.slug)]) as session:
            stored = session.get_one(PolicyVersion, version.row)
            releases.release(session, stored, actor, constant_turn_deg=settings.constant_turn_deg)
    except Conflict as refused:
        return _refused("release", refused, ()).model_copy(update={"text": refused.message + now})
    return _done("release", f"Version {version.version} is served now.", version.sha256)


def _plan(database: Database, asked: TryIn, version: PolicyVersion, actor: str) -> tuple[str, str]:
    """Plan one pass at the demonstrated place; return the plan's digest, and the step in words."""
    goal_mm = version.manifest.goal_mm
    with database.reading() as session:
        demo = hand_of(session.get_one(PolicyVersion, version.row))
    alone = asked.psm_m is None and demo.partner is None
    request = PlanIn(
        surgeon=asked.surgeon,
        suture=asked.suture,
        version=version.version,
        suture_points=[SuturePointIn(position_mm=goal_mm)],
        psm_m=asked.psm_m,
        handoff="none" if alone else None,
        tissue_mm=None if isinstance(asked.tissue_mm, str) else asked.tissue_mm,
    )
    row, _ = plan_sutures(database, request, actor)
    where = ", ".join(f"{one:.1f}" for one in goal_mm)
    why = " Neither the recording nor the request has PSM_M, so nothing is handed over." if alone else ""
    return row.sha256, (
        f"One pass of {row.about.trajectory.duration_s:.1f} s to ({where}) mm, where it was demonstrated.{why}"
    )


def _play(
    database: Database, asked: TryIn, plan: str, actor: str, settings: Settings, others: Sequence[Choice]
) -> Generator[TryStep, None, bool]:
    """Play a plan in the simulator; yield the step of the playback, and that of the verdict; return if feasible."""
    store = check_playback(database, playback_request(plan, settings, asked.arm_errors), settings)
    with database.writing([locks.surgeon(asked.surgeon)]) as session:
        playback = store(session, actor).playback
    with database.reading() as session:
        row = find_playback(session, playback)
        line, report = headline_of(row, settings), row.report
        lowest_mm = min(z for one in row.plan.about.passes for _, _, z in one.path_mm)
    yield _done("play", f"{report.samples} samples in the simulator.", playback)
    verdict = _done("verdict", line.text, playback)
    if line.level == "bad" and report.failure is None and asked.errors == "uncalibrated":
        words = "judge it with the errors of a calibrated arm, if yours is one"
        others = [Choice(words=words, change={"errors": "calibrated"})]
    elif report.failure is None:
        others = ()
    elif report.failure.quantity == SCENE:
        measure = (
            f"Measure the tissue again: it is stated at {asked.tissue_mm} mm, and the tip goes down to {lowest_mm:.1f} "
            "mm. Or record the hand-off further above it."
        )
        others, verdict = (), verdict.model_copy(update={"remedies": (measure,)})
    yield verdict.model_copy(update={"choices": tuple(others)})
    return report.feasible
