"""Policies: what is served, its history, and what it does from a place."""

from pathlib import Path
from typing import Annotated

import typer

from skills.cli.shell import AsJson, Surgeon, Suture, cell, out, print_json, refusing, service, show, triple

commands = typer.Typer()
policies = typer.Typer(no_args_is_help=True, help="Learnt policies.")
commands.add_typer(policies, name="policy")

FIGURES = ("metrics.dtw_total_mm", "metrics.exact_states", "metrics.path_states", "coverage.starts_reaching_goal")


@policies.command("list")
@refusing
def policy_list(as_json: AsJson = False) -> None:
    """List what is served, one policy for each style."""
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
def policy_show(surgeon: Surgeon, suture: Suture, version: int | None = None, as_json: AsJson = False) -> None:
    """Show the released policy of a style, or one of its versions."""
    with service() as client:
        policy = client.policy(surgeon, suture, version)
    if as_json:
        print_json(policy)
        return
    metrics, coverage = policy.metrics, policy.coverage
    out.print(f"{surgeon} {suture} version {policy.version}  {policy.sha256}", soft_wrap=True)
    out.print(f"path    {metrics.exact_states} of {metrics.path_states} states, DTW {metrics.dtw_total_mm:g} mm")
    out.print(f"starts  {coverage.starts_reaching_goal} of {coverage.n_states} reach the goal")
    out.print(f"release {cell(policy.released_at) or 'not released'}")


@policies.command("release")
@refusing
def policy_release(surgeon: Surgeon, suture: Suture, version: int, as_json: AsJson = False) -> None:
    """Release a version, if it passes the gate; an older one too."""
    with service() as client:
        released = client.release(surgeon, suture, version)
    if as_json:
        print_json(released)
    else:
        out.print(f"Version {released.version} of {surgeon} {suture} is what is served now.")


@policies.command("withdraw")
@refusing
def policy_withdraw(surgeon: Surgeon, suture: Suture, as_json: AsJson = False) -> None:
    """Withdraw what is released of a style."""
    with service() as client:
        client.withdraw(surgeon, suture)
    if as_json:
        print_json({"surgeon": surgeon, "suture": suture, "released": None})
    else:
        out.print(f"Nothing of {surgeon} {suture} is served until somebody releases again.")


@policies.command("export")
@refusing
def policy_export(
    surgeon: Surgeon,
    suture: Suture,
    to: Annotated[Path, typer.Argument(help="A file that ends in .json, or in .npz for the Q values.", dir_okay=False)],
    version: int | None = None,
    as_json: AsJson = False,
) -> None:
    """Write the released policy, or a version, to a file, once every number of it is checked against its digest."""
    with service() as client:
        client.save_policy(surgeon, suture, to, version)
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: it is what its digest names. Research use only.", soft_wrap=True)


@policies.command("card")
@refusing
def policy_card(
    surgeon: Surgeon,
    suture: Suture,
    version: int,
    to: Annotated[Path, typer.Argument(help="A file that ends in .html, or in .json.", dir_okay=False)],
    as_json: AsJson = False,
) -> None:
    """Write the card of a version: its data, learner, figures, limits, and what it rests on."""
    with service() as client:
        client.save_policy_card(surgeon, suture, version, to)
    if as_json:
        print_json({"file": to, "size_bytes": to.stat().st_size})
    else:
        out.print(f"{to}: {to.stat().st_size / 1e6:.1f} MB. Research use only.", soft_wrap=True)


@commands.command()
@refusing
def rollout(
    surgeon: Surgeon,
    suture: Suture,
    start: Annotated[str, typer.Option(help="Where it starts, as x,y,z in mm of the policy's frame.")],
    version: Annotated[int | None, typer.Option(help="Of this version, released or not.")] = None,
    as_json: AsJson = False,
) -> None:
    """Follow the released policy from a place to the goal."""
    with service() as client:
        followed = client.rollout(surgeon, suture, triple(start), version)
    if as_json:
        print_json(followed)
        return
    told = "reaches the goal" if followed.finished else "stops on the way"
    out.print(f"It {told} after {len(followed.states)} states, DTW {followed.dtw_total_mm:g} mm to the demonstration.")
