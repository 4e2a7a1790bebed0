"""Plans, their playback in the simulator, and the bag that a robot replays."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from skills.cli.shell import AsJson, Surgeon, Suture, finished, numbers, out, refusing, service, show, triple
from skills.errors import BadInput

commands = typer.Typer()

PlanId = Annotated[str, typer.Argument(help="The plan's digest.")]


@commands.command()
@refusing
def plan(
    surgeon: Surgeon,
    suture: Suture,
    point: Annotated[list[str] | None, typer.Option(help="A suture point, as x,y,z in mm; once for each pass.")] = None,
    scene: Annotated[
        Path | None,
        typer.Option(help="Take the suture points from a simulator's MCAP file: where the needle comes out."),
    ] = None,
    speed_mm_s: float = 20.0,
    rate_hz: Annotated[float, typer.Option(help="Samples per second, 100 to 200.")] = 200.0,
    approach: Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")] = None,
    base: Annotated[
        str | None, typer.Option(help="PSM_M's base in the arm's frame, as x,y,z in mm and qx,qy,qz,qw.")
    ] = None,
    tip_offset_mm: Annotated[
        float, typer.Option(help="10.2: points are where the finger tips go, not the hinge.")
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Stack the released policy at suture points."""
    if bool(point) == (scene is not None):
        raise BadInput("Give suture points, with --point for each, or the file of a scene that has them.")
    psm_m: dict[str, Any] = {} if approach is None else {"approach": triple(approach)}
    if base is not None:
        x, y, z, *turned = numbers(base, 7)
        psm_m["base"] = {"position_mm": (x, y, z), "rotation_xyzw": turned}
    with service() as client:
        points = [{"position_mm": triple(one)} for one in point or ()]
        if scene is not None:
            marks = client.suture_points(scene)["points"]
            points = [
                {"position_mm": one["position_mm"], "rotation_xyzw": one["turn_xyzw"]}
                for one in marks
                if one["is_goal"]
            ]
        asked = {"speed_mm_s": speed_mm_s, "rate_hz": rate_hz, "tip_offset_mm": tip_offset_mm, "psm_m": psm_m or None}
        answer = client.plan(surgeon, suture, points, **asked)
    answer["duration_s"] = answer["trajectory"]["duration_s"]
    show(answer, as_json, ("id", "arm", "frame", "orientation", "duration_s"))


@commands.command()
@refusing
def play(
    plan_id: PlanId,
    picture: Annotated[Path | None, typer.Option(help="Write a picture here.")] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Write the picture, a film and two plots to this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Play a plan in the simulator, and print its verdict; exit code 1 where it is not feasible."""
    with service(works=True) as client:
        playback = client.playback(finished(client, client.play(plan_id))["result"]["playback"])
        if picture is not None:
            picture.write_bytes(client.picture(playback["id"]))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            finished(client, client.draw(playback["id"]))
            (pictures / "playback.png").write_bytes(client.picture(playback["id"]))
            (pictures / "playback.mp4").write_bytes(client.animation(playback["id"]))
            (pictures / "playback.gif").write_bytes(client.animation(playback["id"], "gif"))
            (pictures / "joints.png").write_bytes(client.plot(playback["id"], "joints"))
            (pictures / "clearance.png").write_bytes(client.plot(playback["id"], "clearance"))
    if as_json:
        out.print_json(json.dumps(playback))
    else:
        out.print("feasible" if playback["feasible"] else playback["report"]["failure_in_words"])
        for under in playback["report"]["doubt"]["under"]:
            least = min(one["succeeds"]["lower"] for one in under["passes"])
            error = f"tips {under['tip_error_mm']:g} mm off"
            out.print(f"{error}: every pass succeeds with a probability of at least {least:.3f} (95 %)")
    if not playback["feasible"]:
        raise typer.Exit(1)


@commands.command()
@refusing
def export(
    plan_id: PlanId,
    to: Annotated[Path, typer.Argument(help="The zip to write.", dir_okay=False)],
    pass_index: Annotated[int | None, typer.Option("--pass", help="One pass alone, counted from 0.")] = None,
) -> None:
    """Write the bag of a plan that a robot or a simulator replays; first read docs/replay.md."""
    with service() as client:
        bag = client.replay_bag(plan_id, pass_index)
    to.write_bytes(bag)
    out.print(f"{to}: {len(bag) / 1e6:.1f} MB. Check it with `skills verify {to}` where it is used. Research use only.")
