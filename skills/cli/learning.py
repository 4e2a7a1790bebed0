"""Training, and the policies that come of it."""

import json
from pathlib import Path
from typing import Annotated

import typer

from skills.cli.shell import AsJson, Surgeon, Suture, finished, out, refusing, service, show, triple
from skills.errors import BadInput

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
