"""Plans, and their playback in the simulator."""

import json
from pathlib import Path
from typing import Annotated

import typer

from skills.cli.shell import AsJson, Surgeon, Suture, finished, out, refusing, service, show, triple

commands = typer.Typer()


@commands.command()
@refusing
def plan(
    surgeon: Surgeon,
    suture: Suture,
    point: Annotated[list[str], typer.Option(help="A suture point, as x,y,z in mm; once for each pass.")],
    speed_mm_s: float = 20.0,
    approach: Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")] = None,
    as_json: AsJson = False,
) -> None:
    """Stack the released policy at suture points."""
    points = [{"position_mm": triple(one)} for one in point]
    psm_m = None if approach is None else {"approach": triple(approach)}
    with service() as client:
        answer = client.plan(surgeon, suture, points, speed_mm_s=speed_mm_s, psm_m=psm_m)
    answer["duration_s"] = answer["trajectory"]["duration_s"]
    show(answer, as_json, ("id", "arm", "frame", "orientation", "duration_s"))


@commands.command()
@refusing
def play(
    plan_id: Annotated[str, typer.Argument(help="The plan's digest.")],
    picture: Annotated[Path | None, typer.Option(help="Write a picture here.")] = None,
    as_json: AsJson = False,
) -> None:
    """Play a plan in the simulator, and print its verdict; exit code 1 where it is not feasible."""
    with service(works=True) as client:
        result = finished(client, client.play(plan_id))["result"]
        playback = client.playback(result["playback"])
        if picture is not None:
            picture.write_bytes(client.picture(playback["id"]))
    if as_json:
        out.print_json(json.dumps(playback))
    else:
        out.print("feasible" if playback["feasible"] else playback["report"]["failure_in_words"])
    if not playback["feasible"]:
        raise typer.Exit(1)
