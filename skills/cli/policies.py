"""Commands of training, jobs and policies."""

import hashlib
import json
import time
from dataclasses import fields
from math import degrees, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.shell import (
    KEY,
    AsJson,
    OfSurgeon,
    OfSuture,
    Surgeon,
    Suture,
    cell,
    err,
    files,
    finished,
    out,
    print_json,
    read_key,
    refusing,
    result_of,
    service,
    show,
    triple,
)
from skills.errors import BadInput, BadSignature, Conflict

if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.policies import Coverage
    from skills.schemas.training import RetrainedStyle, Retraining

WATCH_S = 0.3
MANY = 64  # workers for a batch: as many as the settings say, which allow no more
ABOUT = ("id", "kind", "state", "progress", "created_at", "error")

learning_commands = typer.Typer()
jobs = typer.Typer(no_args_is_help=True, help="Trainings, playbacks and other long work.")
learning_commands.add_typer(jobs, name="job")

JobId = Annotated[str, typer.Argument(help="The job's id.")]
Kind = Annotated[str | None, typer.Option("--learner", help="Kind of the learner, such as value-iteration or dqn.")]
Chosen = Annotated[
    list[str] | None, typer.Option("--setting", help="A setting of the learner, such as steps=100000; repeatable.")
]
Rule = Annotated[
    str | None,
    typer.Option(
        help="Where a start joins the demonstration: nearest; start; or a share such as 0.5, so much of it is followed."
    ),
]
SceneFile = Annotated[
    Path | None, typer.Option("--scene", help="JSON file of what must not be touched, as `Scene.as_json` writes it.")
]
OneVersion = Annotated[
    int | None, typer.Option("--version", help="The version, released or not; else the released one.")
]
TheVersion = Annotated[int, typer.Argument(help="The number of the version.")]
JOINING = {"nearest": 0.0, "start": 1.0}
DEFAULT_LEARNER = "phase-q-learning"


@learning_commands.command()
@refusing
def train(
    surgeon: Surgeon,
    suture: Suture,
    demo: Annotated[list[str] | None, typer.Option(help="Learn from this demonstration; repeatable.")] = None,
    combine: Annotated[
        Literal["medoid", "barycentre", "corridor"] | None,
        typer.Option(help="Way to combine several demonstrations into one path; a corridor by default."),
    ] = None,
    outcomes: Annotated[
        Literal["success", "any"],
        typer.Option(help="any learns also from demonstrations that are marked recovery or failure."),
    ] = "success",
    depth_along: Annotated[
        str | None,
        typer.Option(help="Direction in which depth increases, as X,Y,Z, in a frame other than the base of the arm."),
    ] = None,
    scene: SceneFile = None,
    scene_cost: Annotated[
        list[str] | None, typer.Option(help="Cost of the scene, as name=number; repeatable. Example: touch=100.")
    ] = None,
    release: Annotated[bool, typer.Option(help="Release the version if it passes the gate.")] = False,
    seed: Annotated[
        int, typer.Option(help="Seed of the random numbers; the phase learner's result is independent of it.")
    ] = 0,
    learner: Kind = None,
    setting: Chosen = None,
    join: Rule = None,
    as_json: AsJson = False,
) -> None:
    """Learn a style from its newest demonstration, or from the given ones, and wait until it is learnt.

    With --release, the exit code is 1 if the style does not serve the version afterwards.
    """
    chosen = _learner(learner, setting or [], join)
    with service(workers=1) as client:
        asked = client.train(
            surgeon,
            suture,
            demos=demo or None,
            combine=combine,
            learner=chosen,
            seed=seed,
            release=release,
            outcomes=outcomes,
            depth_along=None if depth_along is None else triple(depth_along),
            scene=None if scene is None else read_scene(scene),
            scene_costs=_settings("--scene-cost", scene_cost) if scene_cost else None,
        )
        job = finished(client, asked)
    result = result_of(job)
    show(job if as_json else result, as_json, ("policy_version", "sha256", "releasable", "released"))
    if release and not result["released"]:
        raise Conflict(_not_released(result["policy_version"], result["not_released_because"]), result["remedy"])


@learning_commands.command()
@refusing
def retrain(
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    only_stale: Annotated[bool, typer.Option("--only-stale", help="Only styles with newer input or settings.")] = False,
    release: Annotated[bool, typer.Option(help="Release versions that pass the gate and are not worse.")] = False,
    learner: Kind = None,
    setting: Chosen = None,
    join: Rule = None,
    as_json: AsJson = False,
) -> None:
    """Learn many styles again, and wait for them; exit code 1 if one failed, or with --release was not released."""
    chosen = _learner(learner, setting or [], join)
    with service(workers=MANY) as client:
        job = client.retrain(surgeon=surgeon, suture=suture, only_stale=only_stale, learner=chosen, release=release)
        ended = _watched(client, job.id)
        styles = client.retrained(job.id)
    if as_json:
        print_json(ended.model_copy(update={"items": styles, "next": None}))
    else:
        out.print(", ".join(f"{number} {state}" for state, number in ended.styles if number) or "no styles")
        if wanting := [style for style in styles if style.state != "done"]:
            show(wanting, False, ("surgeon", "suture", "state", "reason"))
    kept_back = [_kept_back(one) for one in styles if release and one.comparison and not one.comparison.now_released]
    if kept_back:
        raise Conflict("\n".join(kept_back))
    if ended.state != "succeeded":
        raise typer.Exit(1)


def _kept_back(style: "RetrainedStyle") -> str:
    """Return why a version trained by a batch is not released, with the remedy."""
    assert style.comparison is not None, "it was trained"
    because, remedy = style.comparison.not_released_because, style.comparison.remedy
    return f"{style.surgeon}, {style.suture}: {_not_released(style.policy_version, str(because))} {remedy}"


def _not_released(version: int | None, because: str) -> str:
    """Return that a version is not released, and why; the gate's reason names the version itself."""
    return because if because.startswith("Version ") else f"Version {version} is not released: {because}"


def _learner(kind: str | None, settings: list[str], join: str | None) -> dict[str, Any] | None:
    """Return the learner as JSON for the service; None for the default one."""
    if kind is None and settings:
        raise BadInput("--setting needs --learner.", "Example: --learner dqn --setting steps=100000")
    if kind is None and join is None:
        return None
    learner: dict[str, Any] = {"kind": kind or DEFAULT_LEARNER}
    if join is not None:
        joining = _joining()
        if learner["kind"] not in joining:
            raise BadInput(f"The learner {kind} has no joining rule.", f"Name one of {', '.join(joining)}.")
        learner["join_share"] = _join_share(join)
    return learner | _settings("--setting", settings)


def _joining() -> list[str]:
    """Return the kinds of the learners that have a joining rule."""
    from skills.learning.policy import LEARNERS  # at first use: the other commands start without the learning core

    return [kind for kind, learner in LEARNERS.items() if any(one.name == "join_share" for one in fields(learner))]


def _settings(option: str, settings: list[str]) -> dict[str, Any]:
    """Return the settings of an option by name."""
    found = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        try:
            # as JSON, so that numbers, lists and booleans have their type
            found[name] = json.loads(value)
        except ValueError:
            example = "steps=100000" if option == "--setting" else "touch=100"
            raise BadInput(f"{setting!r} is not a setting.", f"Write it as name=number, such as {example}") from None
    return found


def read_scene(path: Path) -> Any:
    """Return the JSON of a scene's file.

    Raises:
        BadInput: It cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        why = f"The scene {path} cannot be read as JSON: {error}."
        raise BadInput(why, "Write it with `Scene.as_json` (docs/scenes.md).") from None


def _join_share(join: str) -> float:
    """Return the least share of the demonstration that a joining rule leaves, as a learner's setting."""
    try:
        share = JOINING[join] if join in JOINING else float(join)
    except ValueError:
        share = nan
    if not 0 <= share <= 1:
        raise BadInput(f"--join {join} is no joining rule.", "Write nearest, start, or a share from 0 to 1 such as 0.5")
    return share


def _watched(client: "Client", job: str) -> "Retraining":
    """Wait until a batch has ended, with a progress bar of its styles; there is no timeout."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("styles"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        batch = client.retraining(job)
        total = sum(number for _, number in batch.styles)
        task = progress.add_task("styles", total=total)
        while batch.state in ("queued", "running"):
            time.sleep(WATCH_S)
            batch = client.retraining(job)
            progress.update(task, completed=total - batch.styles.queued)
    return batch


@jobs.command("list")
@refusing
def job_list(
    state: Annotated[
        Literal["queued", "running", "succeeded", "failed", "cancelled"] | None,
        typer.Option(help="Only jobs in this state."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, the newest first."""
    with service() as client:
        show(client.jobs(state), as_json, ABOUT)


@jobs.command("show")
@refusing
def job_show(job: JobId, as_json: AsJson = False) -> None:
    """Show a job."""
    with service() as client:
        show(client.job(job), as_json, ABOUT)


@jobs.command("wait")
@refusing
def job_wait(
    job: JobId,
    timeout_s: Annotated[float, typer.Option(help="Longest waiting time in seconds.")] = 600.0,
    as_json: AsJson = False,
) -> None:
    """Wait until a job has ended; exit code 1 if it did not succeed."""
    with service(workers=MANY) as client:
        show(finished(client, client.job(job), timeout_s), as_json, ABOUT)


@jobs.command("cancel")
@refusing
def job_cancel(job: JobId, as_json: AsJson = False) -> None:
    """Cancel a job that has not ended."""
    with service() as client:
        show(client.cancel(job), as_json, ABOUT)


commands = typer.Typer()
policies = typer.Typer(no_args_is_help=True, help="Learnt policies.")
commands.add_typer(policies, name="policy")

FIGURES = ("metrics.dtw_total_mm", "metrics.exact_states", "metrics.path_states", "coverage.mean_share")


@policies.command("list")
@refusing
def policy_list(as_json: AsJson = False) -> None:
    """List the released policies, one for each style."""
    with service() as client:
        served = sorted(client.policies(), key=lambda one: (one.surgeon, one.suture))
        show(served, as_json, ("surgeon", "suture", "version", "released_at", "released_by", *FIGURES))


@policies.command("versions")
@refusing
def policy_versions(surgeon: Surgeon, suture: Suture, as_json: AsJson = False) -> None:
    """List the versions of a style, the newest first."""
    with service() as client:
        show(client.versions(surgeon, suture), as_json, ("version", "learner", "seed", "releasable", *FIGURES))


@policies.command("show")
@refusing
def policy_show(surgeon: Surgeon, suture: Suture, version: OneVersion = None, as_json: AsJson = False) -> None:
    """Show the released policy of a style, or one of its versions."""
    with service() as client:
        policy = client.policy(surgeon, suture, version)
    if as_json:
        print_json(policy)
        return
    metrics, coverage = policy.metrics, policy.coverage
    out.print(f"{surgeon} {suture} version {policy.version}  {policy.sha256}", soft_wrap=True)
    out.print(f"path    {metrics.exact_states} of {metrics.path_states} states, DTW {metrics.dtw_total_mm:g} mm")
    out.print(f"share   {_share(coverage)}")
    out.print(f"starts  {coverage.starts_reaching_goal} of {coverage.n_states} reach the goal")
    out.print(f"release {cell(policy.released_at) or 'not released'}")


@policies.command("pose-style")
@refusing
def policy_pose_style(surgeon: Surgeon, suture: Suture, as_json: AsJson = False) -> None:
    """Show the pose style of the released policy, and the tube that is proven around it."""
    with service() as client:
        style = client.pose_style(surgeon, suture)
    if as_json:
        print_json(style)
        return
    tube, limits = style.tube, style.tube.limits
    turn = degrees(limits.step_rad)
    out.print(f"{surgeon} {suture} version {style.version}  {style.sha256}", soft_wrap=True)
    out.print(f"motion  {len(style.position_mm)} poses of {style.arm} in {style.frame}, {style.elapsed_s[-1]:.2f} s")
    out.print(f"tube    {tube.radius_mm:.1f} mm and {tube.radius_deg:.1f} degrees, at the end after {tube.ticks} ticks")
    out.print(f"step    {limits.step_mm:g} mm and {turn:.1f} degrees a tick of {1000 * style.tick_s:.0f} ms")
    out.print(f"assumes {limits.disturbance_mm:g} mm and {degrees(limits.disturbance_rad):.1f} degrees of disturbance")
    if (near := style.scene) is not None:
        out.print(f"scene   {near.least_mm:.1f} mm from {near.part} after phase {near.phase}, the tube touches nothing")
    if (other := style.partner_motion) is not None:
        out.print(f"beside  {other.arm} as demonstrated, without a tube; check the distance between the arms")


def _share(coverage: "Coverage") -> str:
    """Return how much of the demonstration a version follows from its starts, in words."""
    return (
        f"{coverage.mean_share:.0%} of the demonstration from a start on average, median {coverage.median_share:.0%}; "
        f"{coverage.starts_goal_alone} of {coverage.n_states} starts see the goal alone"
    )


@policies.command("release")
@refusing
def policy_release(surgeon: Surgeon, suture: Suture, version: TheVersion, as_json: AsJson = False) -> None:
    """Release a version if it passes the gate; an older version may be released again."""
    with service() as client:
        released = client.release(surgeon, suture, version)
    if as_json:
        print_json(released)
    else:
        out.print(f"Version {released.version} of {surgeon} {suture} is served now.")


@policies.command("withdraw")
@refusing
def policy_withdraw(surgeon: Surgeon, suture: Suture, as_json: AsJson = False) -> None:
    """Withdraw the released policy of a style."""
    with service() as client:
        client.withdraw(surgeon, suture)
    if as_json:
        print_json({"surgeon": surgeon, "suture": suture, "released": None})
    else:
        out.print(f"No policy of {surgeon} {suture} is served until a version is released again.")


@policies.command("export")
@refusing
def policy_export(
    surgeon: Surgeon,
    suture: Suture,
    to: Annotated[Path, typer.Argument(help="A file that ends in .json, or in .npz for the Q values.", dir_okay=False)],
    version: OneVersion = None,
    as_json: AsJson = False,
) -> None:
    """Write the released policy, or a version, to a file, after verifying every number of it against its digest."""
    with service() as client:
        client.save_policy(surgeon, suture, to, version)
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: verified against its digest. Research use only.", soft_wrap=True)


@policies.command("card")
@refusing
def policy_card(
    surgeon: Surgeon,
    suture: Suture,
    version: TheVersion,
    to: Annotated[Path, typer.Argument(help="A file that ends in .html, or in .json.", dir_okay=False)],
    as_json: AsJson = False,
) -> None:
    """Write the card of a version: its data, learner, figures, limits, and everything that it rests on."""
    with service() as client:
        client.save_policy_card(surgeon, suture, version, to)
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: {to.stat().st_size / 1e6:.1f} MB. Research use only.", soft_wrap=True)


@policies.command("signature")
@refusing
def policy_signature(
    surgeon: Surgeon,
    suture: Suture,
    to: Annotated[Path, typer.Argument(help="The file to write, such as policy.dsse.", dir_okay=False)],
    card_of: Annotated[int | None, typer.Option("--card", help="Sign the card of this version instead.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write the service's signature of the released policy: of its JSON, its arrays and its pose style."""
    with service() as client:
        client.save_signature(surgeon, suture, to, card_of)
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: check a file with `skills policy verify FILE {to.name} --key KEY`.", soft_wrap=True)


@policies.command("verify")
@refusing
def policy_verify(
    file: Annotated[Path, typer.Argument(help="A policy, its arrays, its pose style or a card.", dir_okay=False)],
    signature: Annotated[Path, typer.Argument(help="The service's signature of it.", dir_okay=False)],
    key: Annotated[str, typer.Option(help=KEY)],
    as_json: AsJson = False,
) -> None:
    """Check offline that the service with this key signed exactly this file, and print what it said of it."""
    from skills.transparency.statements import read_envelope

    with files():
        content, envelope = file.read_bytes(), read_envelope(signature.read_bytes())
    statement = envelope.statement_by(read_key(key))
    digest = hashlib.sha256(content).hexdigest()
    name = next((name for name, covered in statement.subjects.items() if covered == digest), None)
    if name is None:
        raise BadSignature(
            f"{file.name} is none of the files that were signed: it was changed, or is of another version.",
            "Get the file and its signature again from the service.",
        )
    if as_json:
        print_json({"file": file, "signed_as": name, **statement.facts})
        return
    said = ", ".join(f"{fact} {value}" for fact, value in statement.facts.items() if fact != "checkpoint")
    out.print(f"{file}: signed as {name} ({said}).", soft_wrap=True, markup=False)


@commands.command()
@refusing
def rollout(
    surgeon: Surgeon,
    suture: Suture,
    start: Annotated[str, typer.Option(help="The start, as x,y,z in mm in the policy's frame.")],
    version: OneVersion = None,
    as_json: AsJson = False,
) -> None:
    """Follow the released policy from a position to the goal."""
    with service() as client:
        followed = client.rollout(surgeon, suture, triple(start), version)
    if as_json:
        print_json(followed)
        return
    told = "reaches the goal" if followed.finished else "stops before the goal"
    out.print(f"It {told} after {len(followed.states)} states, DTW {followed.dtw_total_mm:g} mm to the demonstration.")
