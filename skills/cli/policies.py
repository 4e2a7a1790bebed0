"""Commands of training and of policies."""

import hashlib
import json
import re
import time
from dataclasses import fields, replace
from math import degrees, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.commands import Key, Surgeon, Suture, command, read_json, read_key, triple
from skills.cli.connecting import MANY, finished, service
from skills.cli.output import Answer, cell, err, outcome, say, show_table, table, text, written
from skills.errors import BadInput, BadSignature, Conflict
from skills.keywords import RetrainingKeywords, TrainingKeywords

if TYPE_CHECKING:
    from skills.client.blocking.client import Client
    from skills.schemas.policies import Coverage
    from skills.schemas.training import RetrainedStyle, Retraining

WATCH_S = 0.3
WORD = re.compile(r"(?!(true|false|null)$)[a-z][a-z-]*")

commands = typer.Typer()
policies = typer.Typer(no_args_is_help=True, help="Learnt policies.")
commands.add_typer(policies, name="policy")

Learner = Annotated[str | None, typer.Option(help="Kind of the learner, such as value-iteration or dqn.")]
Setting = Annotated[list[str] | None, typer.Option(help="A setting of the learner, such as steps=100000; repeatable.")]
Join = Annotated[
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


@command(commands)
def train(
    surgeon: Surgeon,
    suture: Suture,
    options: TrainingKeywords,
    combine: Literal["medoid", "barycentre", "corridor"] | None = None,
    scene: SceneFile = None,
    scene_cost: list[str] | None = None,
    learner: Learner = None,
    setting: Setting = None,
    join: Join = None,
) -> Answer:
    """Learn a style from its newest demonstration, or from the given ones, and wait until it is learnt.

    With --release, the exit code is 1 if the style does not serve the version afterwards.

    Args:
        combine: Way to combine several demonstrations into one path; a corridor by default.
        scene_cost: Cost of the scene, as name=number; repeatable. Example: touch=100.
    """
    from skills.schemas.training import TrainingResult

    if (chosen := _learner(learner, setting or [], join)) is not None:
        options["learner"] = chosen
    if scene is not None:
        options["scene"] = read_scene(scene)
    if scene_cost:
        options["scene_costs"] = _settings("--scene-cost", scene_cost)
    with service(workers=1) as client:
        job = finished(client, client.train(surgeon, suture, combine=combine, **options))
    result = TrainingResult.of(job)
    answer = table(job, ("policy_version", "sha256", "releasable", "released"), rows=result)
    if not options.get("release") or result.released:
        return answer
    because = str(result.not_released_because)
    return replace(answer, refused=Conflict(because, *([result.remedy] if result.remedy else [])))


@command(commands)
def retrain(options: RetrainingKeywords, learner: Learner = None, setting: Setting = None, join: Join = None) -> Answer:
    """Learn many styles again, and wait for them; exit code 1 if one failed, or with --release was not released."""
    if (chosen := _learner(learner, setting or [], join)) is not None:
        options["learner"] = chosen
    with service(workers=MANY) as client:
        job = client.retrain(**options)
        ended = _watched(client, job.id)
        styles = client.retrained(job.id)

    def show() -> None:
        say(", ".join(f"{number} {state}" for state, number in ended.styles if number) or "no styles")
        if unfinished := [style for style in styles if style.state != "done"]:
            show_table(unfinished, ("surgeon", "suture", "state", "reason"))

    refused = [because for style in styles if (because := _refusal(style))] if options.get("release") else []
    return Answer(
        ended.model_copy(update={"items": styles, "next": None}),
        show,
        exit_code=0 if ended.state == "succeeded" else 1,
        refused=Conflict("\n".join(refused)) if refused else None,
    )


def _refusal(style: "RetrainedStyle") -> str | None:
    """Return why a version trained by a batch is not released, with the remedy; None if it is, or was not trained."""
    compared = style.comparison
    if compared is None or compared.now_released:
        return None
    return f"{style.surgeon}, {style.suture}: {compared.not_released_because} {compared.remedy}"


def _learner(kind: str | None, settings: list[str], join: str | None) -> dict[str, object] | None:
    """Return the learner as JSON for the service; None for the default one."""
    if kind is None and settings:
        raise BadInput("--setting needs --learner.", "Example: --learner dqn --setting steps=100000")
    if kind is None and join is None:
        return None
    learner: dict[str, object] = {"kind": kind or DEFAULT_LEARNER}
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


def _settings(option: str, settings: list[str]) -> dict[str, object]:
    """Return the settings of an option by name."""
    found = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        try:
            # as JSON, so that numbers, lists and booleans have their type; a word needs no quotation marks
            found[name] = value if WORD.fullmatch(value) else json.loads(value)
        except ValueError:
            example = "steps=100000" if option == "--setting" else "touch=100"
            raise BadInput(f"{setting!r} is not a setting.", f"Write it as name=value, such as {example}") from None
    return found


def read_scene(path: Path) -> Any:
    """Return the JSON of a scene's file.

    Raises:
        BadInput: It cannot be read, or is not JSON.
    """
    return read_json(path, "scene", "Write it with `Scene.as_json` (docs/scenes.md).")


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


# ---- policies --------------------------------------------------------------------------------------------------------

FIGURES = ("metrics.dtw_total_mm", "metrics.exact_states", "metrics.path_states", "coverage.mean_share")


@command(policies, "list")
def policy_list() -> Answer:
    """List the released policies, one for each style."""
    with service() as client:
        served = sorted(client.policies(), key=lambda one: (one.surgeon, one.suture))
        return table(served, ("surgeon", "suture", "version", "released_at", "released_by", *FIGURES))


@command(policies, "versions")
def policy_versions(surgeon: Surgeon, suture: Suture) -> Answer:
    """List the versions of a style, the newest first."""
    with service() as client:
        return table(client.versions(surgeon, suture), ("version", "learner", "seed", "releasable", *FIGURES))


@command(policies, "show")
def policy_show(surgeon: Surgeon, suture: Suture, version: OneVersion = None) -> Answer:
    """Show the released policy of a style, or one of its versions."""
    with service() as client:
        policy = client.policy(surgeon, suture, version)
    metrics, coverage = policy.metrics, policy.coverage
    return text(
        policy,
        f"{surgeon} {suture} version {policy.version}  {policy.sha256}",
        f"path    {metrics.exact_states} of {metrics.path_states} states, DTW {metrics.dtw_total_mm:g} mm",
        f"share   {_share(coverage)}",
        f"starts  {coverage.starts_reaching_goal} of {coverage.n_states} reach the goal",
        f"release {cell(policy.released_at) or 'not released'}",
    )


@command(policies, "pose-style")
def policy_pose_style(surgeon: Surgeon, suture: Suture) -> Answer:
    """Show the pose style of the released policy, and the tube that is proven around it."""
    with service() as client:
        style = client.pose_style(surgeon, suture)
    tube, limits = style.tube, style.tube.limits
    turn = degrees(limits.step_rad)
    sentences = [
        f"{surgeon} {suture} version {style.version}  {style.sha256}",
        f"motion  {len(style.position_mm)} poses of {style.arm} in {style.frame}, {style.elapsed_s[-1]:.2f} s",
        f"tube    {tube.radius_mm:.1f} mm and {tube.radius_deg:.1f} degrees, at the end after {tube.ticks} ticks",
        f"step    {limits.step_mm:g} mm and {turn:.1f} degrees a tick of {1000 * style.tick_s:.0f} ms",
        f"assumes {limits.disturbance_mm:g} mm and {degrees(limits.disturbance_rad):.1f} degrees of disturbance",
    ]
    if (near := style.scene) is not None:
        touching = f"after phase {near.phase}, the tube touches nothing"
        sentences.append(f"scene   {near.least_mm:.1f} mm from {near.part} {touching}")
    if (other := style.partner_motion) is not None:
        sentences.append(f"beside  {other.arm} as demonstrated, without a tube; check the distance between the arms")
    return text(style, *sentences)


def _share(coverage: "Coverage") -> str:
    """Describe how much of the demonstration a version follows from its starts."""
    from skills.fields import percent

    return (
        f"{percent(coverage.mean_share)}% of the demonstration from a start on average, median "
        f"{percent(coverage.median_share)}%; "
        f"{coverage.starts_goal_alone} of {coverage.n_states} starts see the goal alone"
    )


@command(policies, "release")
def policy_release(surgeon: Surgeon, suture: Suture, version: TheVersion) -> Answer:
    """Release a version if it passes the gate; an older version may be released again."""
    with service() as client:
        released = client.release(surgeon, suture, version)
    return text(released, f"Version {released.version} of {surgeon} {suture} is served now.")


@command(policies, "withdraw")
def policy_withdraw(surgeon: Surgeon, suture: Suture) -> Answer:
    """Withdraw the released policy of a style."""
    with service() as client:
        client.withdraw(surgeon, suture)
    withdrawn = f"No policy of {surgeon} {suture} is served until a version is released again."
    return outcome(withdrawn, surgeon=surgeon, suture=suture, released=None)


@command(policies, "export")
def policy_export(
    surgeon: Surgeon, suture: Suture, to: Annotated[Path, typer.Argument(dir_okay=False)], version: OneVersion = None
) -> Answer:
    """Write the released policy, or a version, to a file, after verifying every number of it against its digest.

    Args:
        to: A file that ends in .json, or in .npz for the Q values.
    """
    with service() as client:
        client.save_policy(surgeon, suture, to, version)
    return written(to, f"{to}: verified against its digest. Research use only.")


@command(policies, "card")
def policy_card(
    surgeon: Surgeon, suture: Suture, version: TheVersion, to: Annotated[Path, typer.Argument(dir_okay=False)]
) -> Answer:
    """Write the card of a version: its data, learner, figures, limits, and everything that it rests on.

    Args:
        to: A file that ends in .html, or in .json.
    """
    with service() as client:
        client.save_policy_card(surgeon, suture, version, to)
    return written(to, f"{to}: {to.stat().st_size / 1e6:.1f} MB. Research use only.")


@command(policies, "signature")
def policy_signature(
    surgeon: Surgeon,
    suture: Suture,
    to: Annotated[Path, typer.Argument(dir_okay=False)],
    card_of: Annotated[int | None, typer.Option("--card")] = None,
) -> Answer:
    """Write the service's signature of the released policy: of its JSON, its arrays and its pose style.

    Args:
        to: The file to write, such as policy.dsse.
        card_of: Sign the card of this version instead.
    """
    with service() as client:
        client.save_signature(surgeon, suture, to, card_of)
    return written(to, f"{to}: check a file with `skills policy verify FILE {to.name} --key KEY`.")


@command(policies, "verify")
def policy_verify(
    file: Annotated[Path, typer.Argument(dir_okay=False)],
    signature: Annotated[Path, typer.Argument(dir_okay=False)],
    key: Key,
) -> Answer:
    """Check offline that the service with this key signed exactly this file, and print what it said of it.

    Args:
        file: A policy, its arrays, its pose style or a card.
        signature: The service's signature of it.
    """
    from skills.transparency.statements import read_envelope

    content, envelope = file.read_bytes(), read_envelope(signature.read_bytes())
    statement = envelope.statement_by(read_key(key))
    digest = hashlib.sha256(content).hexdigest()
    name = next((name for name, covered in statement.subjects.items() if covered == digest), None)
    if name is None:
        raise BadSignature(
            f"{file.name} is none of the files that were signed: it was changed, or is of another version.",
            "Get the file and its signature again from the service.",
        )
    facts = ", ".join(f"{fact} {value}" for fact, value in statement.facts.items() if fact != "checkpoint")
    return outcome(f"{file}: signed as {name} ({facts}).", file=file, signed_as=name, **statement.facts)


@command(commands)
def rollout(
    surgeon: Surgeon, suture: Suture, start: Annotated[str, typer.Option()], version: OneVersion = None
) -> Answer:
    """Follow the released policy from a position to the goal.

    Args:
        start: The start, as x,y,z in mm in the policy's frame.
    """
    with service() as client:
        followed = client.rollout(surgeon, suture, triple(start), version)
    end = "reaches the goal" if followed.finished else "stops before the goal"
    states, total_mm = len(followed.states), followed.dtw_total_mm
    return text(followed, f"It {end} after {states} states, DTW {total_mm:g} mm to the demonstration.")
