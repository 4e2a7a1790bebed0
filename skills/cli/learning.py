"""Training, and the policies that come of it."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skills.cli.shell import AsJson, Surgeon, Suture, err, finished, out, refusing, service, show, triple
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.client import Client

WATCH_S = 0.3

commands = typer.Typer()
policies = typer.Typer(no_args_is_help=True, help="Learnt policies.")
commands.add_typer(policies, name="policy")


@commands.command()
@refusing
def train(
    surgeon: Surgeon,
    suture: Suture,
    release: Annotated[bool, typer.Option(help="Release the version if it passes the gate.")] = False,
    seed: int = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a style from its newest demonstration, and wait for it."""
    with service(works=True) as client:
        job = finished(client, client.train(surgeon, suture, seed=seed, release=release))
    show(job if as_json else job["result"], as_json, ("policy_version", "sha256", "releasable", "released"))


@commands.command()
@refusing
def retrain(
    surgeon: Annotated[str | None, typer.Option(help="This surgeon's styles only.")] = None,
    suture: Annotated[str | None, typer.Option(help="Styles of this suture type only.")] = None,
    only_stale: Annotated[bool, typer.Option("--only-stale", help="Only what has newer input or settings.")] = False,
    release: Annotated[bool, typer.Option(help="Release what passes the gate and is not worse.")] = False,
    as_json: AsJson = False,
) -> None:
    """Learn many styles again, and wait for them; exit code 1 where one of them failed."""
    with service(works=True) as client:
        job = client.retrain(surgeon=surgeon, suture=suture, only_stale=only_stale, release=release)
        ended = _watched(client, job["id"])
        styles = client.retrained(job["id"])
    if as_json:
        out.print_json(json.dumps(ended | {"items": styles, "next": None}))
    else:
        out.print(", ".join(f"{number} {state}" for state, number in ended["styles"].items() if number) or "no styles")
        if wanting := [style for style in styles if style["state"] != "done"]:
            show(wanting, False, ("surgeon", "suture", "state", "reason"))
    if ended["state"] != "succeeded":
        raise typer.Exit(1)


def _watched(client: "Client", job: str) -> dict[str, Any]:
    """Wait for a batch to end, with a bar that moves by styles; nothing but its end ends the wait."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("styles"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err) as progress:
        batch = client.retraining(job)
        bar = progress.add_task("styles", total=sum(batch["styles"].values()))
        while batch["state"] in ("queued", "running"):
            time.sleep(WATCH_S)
            batch = client.retraining(job)
            progress.update(bar, completed=sum(batch["styles"].values()) - batch["styles"]["queued"])
    return batch


@policies.command("show")
@refusing
def policy_show(surgeon: Surgeon, suture: Suture, version: int | None = None, as_json: AsJson = False) -> None:
    """Show the released policy of a style, or one of its versions."""
    with service() as client:
        policy = client.policy(surgeon, suture, version)
    if as_json:
        out.print_json(json.dumps(policy))
        return
    metrics, coverage = policy["metrics"], policy["coverage"]
    out.print(f"{surgeon} {suture} version {policy['version']}  {policy['sha256']}", soft_wrap=True)
    out.print(
        f"path    {metrics['exact_states']} of {metrics['path_states']} states, DTW {metrics['dtw_total_mm']:g} mm"
    )
    out.print(f"starts  {coverage['starts_reaching_goal']} of {coverage['n_states']} reach the goal")
    out.print(f"release {policy['released_at'] or 'not released'}")


@policies.command("release")
@refusing
def policy_release(surgeon: Surgeon, suture: Suture, version: int) -> None:
    """Release a version, if it passes the gate."""
    with service() as client:
        answer = client.release(surgeon, suture, version)
    out.print(f"Version {answer['version']} is released since {answer['released_at']}.")


@policies.command("withdraw")
@refusing
def policy_withdraw(surgeon: Surgeon, suture: Suture) -> None:
    """Withdraw what is released of a style."""
    with service() as client:
        client.withdraw(surgeon, suture)


@policies.command("export")
@refusing
def policy_export(surgeon: Surgeon, suture: Suture, to: Path) -> None:
    """Write the released policy to a file: .json, or .npz with its Q values."""
    if to.suffix not in (".json", ".npz"):
        raise BadInput("A policy is exported to a file that ends in .json or .npz.")
    with service() as client:
        policy = client.policy(surgeon, suture)
        data = json.dumps(policy).encode() if to.suffix == ".json" else client.policy_arrays(policy["sha256"])
    to.write_bytes(data)


@commands.command()
@refusing
def rollout(
    surgeon: Surgeon,
    suture: Suture,
    start: Annotated[str, typer.Option(help="Where it starts, as x,y,z in mm of the policy's frame.")],
    as_json: AsJson = False,
) -> None:
    """Follow the released policy from a place to the goal."""
    with service() as client:
        answer = client.rollout(surgeon, suture, triple(start))
    answer["states_visited"] = len(answer["states"])
    show(answer, as_json, ("finished", "states_visited", "dtw_total_mm"))
