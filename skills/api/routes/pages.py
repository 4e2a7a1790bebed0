"""Routes of the web pages and of the files that they load. Pages only read; changes go through the public calls."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from sqlalchemy.orm import Session

from skills import errors
from skills.api.authorisation import Asking, Caller, needs, open_to_all
from skills.api.dependencies import Configured, Db, Digest, JobId, Limit, Parse, RowCursor, Slug, SlugCursor, Version
from skills.api.pages import drawings, render
from skills.api.pages.assets import assets, build
from skills.api.responses import JSON, say
from skills.db.session import Database
from skills.fields import Point
from skills.formats import MEDIA_TYPES, SUFFIXES
from skills.kinematics import INSTRUMENTS
from skills.library.comparison import scores
from skills.library.operation import jobs, overview, styles, views
from skills.library.people.surgeons import list_surgeons
from skills.library.plans.description import describe_motion
from skills.library.plans.plans import find_plan, followed_plan
from skills.library.plans.playbacks import headline_of
from skills.library.plans.replay_gate import refusal_of_bag
from skills.library.policies import releases, retraining, versions
from skills.library.policies.outcomes import describe_job
from skills.library.recordings.demos import find_demo, shown_demo
from skills.library.recordings.recordings import find_recording
from skills.planning.handoff import Enters
from skills.remedies import Door
from skills.schemas.requests import DIGEST
from skills.schemas.scores import ScoreIn
from skills.settings import MEBIBYTE

# Statuses of errors that are shown as a page; all others are 404.
STATUS: dict[type[Exception], int] = {errors.Erased: 410, errors.Conflict: 409, errors.BadPath: 422}
LOST: tuple[type[Exception], ...] = (errors.NotFound, RequestValidationError, *STATUS)
PSM_M_FROM_GOAL_MM = (155.0, -35.0, 145.0)  # ours, assumed: the base of the samples' PSM_M relative to their goal
PSM_M_TURN = "0, 0, 0.382683, 0.92388"  # 45 degrees about z: the arms stand away from each other, and do not collide
NOT_STORED = {"Cache-Control": "no-store"}
FOR_GOOD = "public, max-age=31536000, immutable"

Words = Annotated[str, Query(max_length=200)]
Picked = Annotated[str | None, Query(max_length=64)]


class PageRoute(APIRoute):
    """A route for browsers: errors about missing things are rendered as a page."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return a handler that renders the errors in `LOST` as a page."""
        answer = super().get_route_handler()

        async def answer_or_tell(request: Request) -> Response:
            try:
                return await answer(request)
            except LOST as lost:
                if request.headers.get("accept") == JSON:  # a script of a page, which shows the reason itself
                    raise
                status = next((code for kind, code in STATUS.items() if isinstance(lost, kind)), 404)
                said = lost.words() if isinstance(lost, errors.SkillsError) else "There is no page at this address."
                return render(
                    request,
                    "lost.html",
                    request.scope.get("caller"),
                    status=status,
                    said=said,
                    there=status in (409, 422),
                )

        return answer_or_tell


@dataclass(frozen=True)
class Asked:
    """The request for a page, its caller, and the database restricted to the rows that the caller may see."""

    request: Request
    caller: Caller
    db: Database

    def show(self, template: str, **context: Any) -> Response:
        """Render a template."""
        return render(self.request, template, self.caller, **context)


async def _asked(request: Request, caller: Asking, db: Db) -> Asked:
    return Asked(request, caller, db)


WebPage = Annotated[Asked, Depends(_asked)]


# The router of all pages; the modules of nouns add theirs.
router = APIRouter(route_class=PageRoute, include_in_schema=False, max_body_size=MEBIBYTE)


@router.get("/static/{version}/{name}", dependencies=[open_to_all()])
def get_static(version: str, name: str, request: Request) -> Response:
    """Return a file that a page loads; under the URL of this build a browser may cache it permanently."""
    asset = assets().get(name)
    if asset is None:
        raise errors.NotFound("There is no such file.")
    headers = {"Cache-Control": FOR_GOOD if version == build() else "no-cache", "Vary": "Accept-Encoding"}
    if "gzip" in request.headers.get("accept-encoding", ""):
        headers["Content-Encoding"] = "gzip"
        return Response(asset.packed, headers=headers, media_type=asset.media_type)
    return Response(asset.content, headers=headers, media_type=asset.media_type)


@router.get("/", dependencies=[needs("reader")])
def show_catalogue(
    page: WebPage,
    q: Words = "",
    state: Literal["", "released", "trained", "stored", "empty"] = "",
    skill: Literal["", "novice", "intermediate", "expert"] = "",
    cursor: SlugCursor = None,
) -> Response:
    """Show the styles: surgeons and suture types, with their stored, trained and released state, and jobs."""
    with page.db.reading() as session:
        found = styles.matrix(session, q, state or None, skill or None, cursor)
        asked = {"q": q, "state": state, "skill": skill}
        lists = {"sutures": overview.all_suture_types(session), "jobs": overview.unsettled_jobs(session)}
        return page.show("catalogue.html", found=found, asked=asked, most_counted=styles.MOST_COUNTED, **lists)


@router.get("/pages/styles/{surgeon}/{suture}", dependencies=[needs("reader")])
def show_style(
    surgeon: Slug,
    suture: Slug,
    page: WebPage,
    version: Annotated[int | None, Query(ge=1)] = None,
    beside: Annotated[int | None, Query(ge=1)] = None,
) -> Response:
    """Show a style in 3-D, with its figures, versions and demonstrations; `beside` is a version to compare with."""
    with page.db.reading() as session:
        whole = styles.whole_style(session, surgeon, suture)
        shown = _chosen(session, whole, version)
        other = None if beside is None else versions.find_version(session, surgeon, suture, beside)
        most = overview.MOST_LISTED
        return page.show("style.html", whole=whole, shown=shown, other=other, most=most)


def _chosen(session: Session, whole: styles.WholeStyle, version: int | None) -> Any:
    """Return the version to show: the requested one, else the served one, else the newest."""
    if version is not None:
        return versions.find_version(session, whole.surgeon.slug, whole.suture.slug, version)
    if whole.served is not None:
        return whole.served.policy
    return whole.versions[0] if whole.versions else None


@router.get("/pages/styles/{surgeon}/{suture}/versions/{version}/view", dependencies=[needs("reader")])
def view_version(surgeon: Slug, suture: Slug, version: Version, caller: Asking, db: Db) -> Response:
    """Return the data of a version's 3-D view."""
    with db.reading() as session:
        return say(views.view_of_version(versions.choose(session, surgeon, suture, version)), headers=NOT_STORED)


@router.get("/pages/demos/{demo}/view", dependencies=[needs("reader")])
def view_demo(demo: Digest, caller: Asking, db: Db) -> Response:
    """Return the data of a demonstration's 3-D view."""
    with db.reading() as session:
        return say(views.view_of_demo(session, shown_demo(session, demo)), headers=NOT_STORED)


@router.get("/pages/demos/{demo}/score", dependencies=[needs("reader")])
def show_score(
    demo: Digest,
    page: WebPage,
    tell: Parse,
    surgeon: Annotated[str, Query(max_length=64)] = "",
    task: Annotated[str, Query(max_length=64, pattern="^[A-Za-z_]*$")] = "",
) -> Response:
    """Show the score of a demonstration against a surgeon's style; by default that of an expert, if there is one."""
    with page.db.reading() as session:
        found = find_demo(session, demo)
        surgeons = scores.references(session, found.suture)
        tasks = scores.rated_tasks(session)
    others = [one.slug for one in surgeons if one.row != found.surgeon_row]
    against = surgeon or next(iter(others), found.surgeon.slug)
    score = scores.score(
        page.db, ScoreIn(surgeon=against, suture=found.suture, demo=found.sha256, task=task or None), tell
    )
    return page.show(
        "score.html",
        demo=found,
        score=score,
        views=drawings.deviation_views(score.deviation),
        along=drawings.deviation_along(score.deviation),
        curve=drawings.score_curve(score.curve, found.sha256) if len(score.curve) > 1 else None,
        key=drawings.score_key(),
        surgeons=surgeons,
        tasks=tasks,
        asked_task=task,
    )


@router.get("/pages/recordings", dependencies=[needs("reader")])
def show_recordings(page: WebPage, cursor: RowCursor = None) -> Response:
    """Show the newest recordings."""
    with page.db.reading() as session:
        found = overview.newest_recordings(session, cursor)
        return page.show("recordings.html", found=found, most=overview.MOST)


@router.get("/pages/recordings/new", dependencies=[needs("reader")])
def show_upload(page: WebPage, surgeon: Picked = None, suture: Picked = None) -> Response:
    """Show the form that uploads a recording."""
    with page.db.reading() as session:
        return page.show(
            "upload.html",
            kinds=MEDIA_TYPES,
            suffixes=SUFFIXES,
            instruments=list(INSTRUMENTS),
            surgeons=overview.surgeons_to_choose(session),
            surgeon=surgeon,
            suture=suture,
        )


@router.get("/pages/recordings/{recording}", dependencies=[needs("reader")])
def show_recording(recording: Digest, page: WebPage, surgeon: Picked = None, suture: Picked = None) -> Response:
    """Show a recording: its quality, its proposed hand-offs, and the demonstrations cut out of it."""
    with page.db.reading() as session:
        found = find_recording(session, recording)
        demos = overview.demos_of_recording(session, found)
        return page.show(
            "recording.html",
            found=found,
            demos=demos,
            taken=[[demo.start_s, demo.end_s] for demo in demos if demo.withdrawn_at is None],
            surgeons=overview.surgeons_to_choose(session),
            sutures=overview.all_suture_types(session),
            surgeon=surgeon,
            suture=suture,
        )


@router.get("/pages/recordings/{recording}/traces", dependencies=[needs("reader")])
def trace_recording(recording: Digest, caller: Asking, db: Db, tell: Parse) -> Response:
    """Return the data of a recording's timeline."""
    return say(views.traces_of(db, recording, tell), headers=NOT_STORED)


@router.get("/pages/plans", dependencies=[needs("reader")])
def show_plans(page: WebPage, settings: Configured, cursor: RowCursor = None) -> Response:
    """Show the newest plans with their verdicts."""
    with page.db.reading() as session:
        found = [
            (plan, describe_motion(plan.about), None if played is None else headline_of(played, settings))
            for plan, played in overview.newest_plans(session, cursor)
        ]
        return page.show("plans.html", found=found, most=overview.MOST)


@router.get("/pages/plans/new", dependencies=[needs("reader")])
def show_plan_editor(
    page: WebPage,
    surgeon: Picked = None,
    suture: Picked = None,
    version: Annotated[int | None, Query(ge=1)] = None,
    like: Annotated[str | None, Query(pattern=DIGEST)] = None,
) -> Response:
    """Show the plan editor, filled from a style or from an existing plan."""
    with page.db.reading() as session:
        before = None if like is None else find_plan(session, like)
        if before is not None:
            surgeon, suture = before.policy.surgeon.slug, before.policy.suture
            version = before.policy.version
        released = styles.released_styles(session)
        policy = None
        if surgeon is not None and suture is not None:
            policy = versions.choose(session, surgeon, suture, version)
        elif released:
            policy = versions.choose(session, released[0].surgeon, released[0].suture, released[0].version)
        return page.show(
            "plan_editor.html",
            released=released,
            most=overview.MOST_LISTED,
            is_served=policy is not None and releases.serves(session, policy),
            policy=policy,
            partner=None if policy is None else policy.demonstration.demo.partner,
            before=before,
            instruments=sorted(INSTRUMENTS),
            enters=get_args(Enters),
            assumed=None if policy is None else _assumed_psm_m(policy.manifest.goal_mm),
        )


def _assumed_psm_m(goal_mm: Point) -> dict[str, str]:
    """Return a plausible PSM_M for a demonstration without one: placed relative to the goal as in the samples."""
    base_mm = [round(at + off, 1) for at, off in zip(goal_mm, PSM_M_FROM_GOAL_MM, strict=True)]
    return {"approach": "-0.94, 0.1, -0.33", "base_mm": ", ".join(f"{x:g}" for x in base_mm), "base_xyzw": PSM_M_TURN}


@router.get("/pages/plans/{plan}", dependencies=[needs("reader")])
def show_plan(plan: Digest, page: WebPage, settings: Configured) -> Response:
    """Show a plan with its playbacks."""
    with page.db.reading() as session:
        found = followed_plan(session, plan)
        refusal = refusal_of_bag(session, found, settings)
        return page.show(
            "plan.html",
            plan=found,
            played=[(one, headline_of(one.playback, settings)) for one in overview.playbacks_of(session, found)],
            description=describe_motion(found.about),
            hands_over=found.about.psm_m is not None,
            no_bag=None if refusal is None else refusal.words(Door.HTTP),
            job=overview.newest_job(session, "playback", plan=found.sha256),
        )


@router.get("/pages/jobs", dependencies=[needs("reader")])
def show_jobs(
    page: WebPage,
    state: Literal["", "queued", "running", "succeeded", "failed", "cancelled"] = "",
    cursor: RowCursor = None,
) -> Response:
    """Show jobs, the newest first, and the form that starts a batch."""
    with page.db.reading() as session:
        return page.show(
            "jobs.html",
            found=jobs.list_jobs(session, overview.MOST, cursor, state or None),
            state=state,
            most=overview.MOST,
            surgeons=overview.surgeons_to_choose(session),
            sutures=overview.all_suture_types(session),
        )


@router.get("/pages/jobs/{job}", dependencies=[needs("reader")])
def show_job(job: JobId, page: WebPage, limit: Limit = overview.MOST, cursor: RowCursor = None) -> Response:
    """Show a job as it runs, and the styles of a batch."""
    with page.db.reading() as session:
        found = jobs.find_job(session, job)
        batch = found.kind == jobs.BATCH
        return page.show(
            "job.html",
            job=found,
            described=describe_job(session, found),
            counts=jobs.count(session, found.row) if batch else None,
            styles=retraining.list_styles(session, found, limit, cursor, None) if batch else [],
            limit=limit,
        )


@router.get("/pages/catalogue", dependencies=[needs("reader")])
def show_people(page: WebPage, q: Words = "", cursor: SlugCursor = None) -> Response:
    """Show surgeons and suture types, with forms that add and change them."""
    with page.db.reading() as session:
        return page.show(
            "people.html",
            q=q,
            surgeons=list_surgeons(session, overview.MOST, cursor, q or None),
            most=overview.MOST,
            sutures=overview.all_suture_types(session),
        )
