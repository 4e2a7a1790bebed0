"""Commands of plans, their playback in the simulator, and the bag that a robot replays."""

from pathlib import Path
from typing import Annotated, Any

import typer

from skills.cli.shell import (
    AsJson,
    Surgeon,
    Suture,
    bar,
    finished,
    numbers,
    out,
    print_json,
    refusing,
    result_of,
    service,
    show,
    triple,
)
from skills.errors import BadInput

commands = typer.Typer()

PlanId = Annotated[str, typer.Argument(help="The plan's digest.")]


@commands.command()
@refusing
def plan(
    surgeon: Surgeon,
    suture: Suture,
    point: Annotated[
        list[str] | None, typer.Option(help="A suture point, as x,y,z in mm; repeatable, one for each pass.")
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(help="Take the suture points from a simulator's MCAP file: the exit points of the needle."),
    ] = None,
    speed_mm_s: float = 20.0,
    rate_hz: Annotated[float, typer.Option(help="Samples per second, 100 to 200.")] = 200.0,
    approach: Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")] = None,
    base: Annotated[
        str | None, typer.Option(help="PSM_M's base in the arm's frame, as x,y,z in mm and qx,qy,qz,qw.")
    ] = None,
    no_handoff: Annotated[
        bool, typer.Option("--no-handoff", help="Plan the tip's path alone, without a hand-off: no PSM_M, no A2.")
    ] = False,
    tip_offset_mm: Annotated[
        float,
        typer.Option(
            help="Distance of the finger tips from the hinge; with 10.2 the points are those of the finger tips."
        ),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Stack the released policy at suture points."""
    if bool(point) == (scene is not None):
        raise BadInput(
            "A plan needs suture points, from --point or from --scene.",
            "For each pass: --point X,Y,Z in mm; or --scene with a simulator's file that contains them.",
        )
    psm_m: dict[str, Any] = {} if approach is None else {"approach": triple(approach)}
    if base is not None:
        x, y, z, *turned = numbers(base, 7)  # position, then quaternion
        psm_m["base"] = {"position_mm": (x, y, z), "rotation_xyzw": turned}
    if no_handoff and psm_m:
        raise BadInput("--no-handoff plans without PSM_M.", "Leave it out, or --approach and --base.")
    with service() as client:
        points: list[dict[str, Any]] = [{"position_mm": triple(one)} for one in point or ()]
        if scene is not None:
            goals = [mark for mark in client.suture_points(scene).points if mark.is_goal]
            points = [{"position_mm": goal.position_mm, "rotation_xyzw": goal.turn_xyzw} for goal in goals]
        made = client.plan(
            surgeon,
            suture,
            points,
            speed_mm_s=speed_mm_s,
            rate_hz=rate_hz,
            tip_offset_mm=tip_offset_mm,
            psm_m=psm_m or None,
            handoff="none" if no_handoff else None,
        )
    show(made, as_json, ("id", "arm", "frame", "orientation", "trajectory.duration_s"))
    if not as_json:
        out.print(made.in_words, markup=False, soft_wrap=True)


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
    """Play a plan in the simulator, and print the verdict; exit code 1 if it is not feasible."""
    with service(works=True) as client:
        playback = client.playback(result_of(finished(client, client.play(plan_id)))["playback"])
        if picture is not None:
            picture.write_bytes(client.picture(playback.id))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            finished(client, client.draw(playback.id))
            (pictures / "playback.png").write_bytes(client.picture(playback.id))
            (pictures / "playback.mp4").write_bytes(client.animation(playback.id))
            (pictures / "playback.gif").write_bytes(client.animation(playback.id, "gif"))
            (pictures / "joints.png").write_bytes(client.plot(playback.id, "joints"))
            (pictures / "clearance.png").write_bytes(client.plot(playback.id, "clearance"))
    if as_json:
        print_json(playback)
    else:
        assert playback.headline is not None, playback
        out.print(playback.headline.text, markup=False, soft_wrap=True)
        for under in playback.report.doubt.under:
            least = min(one.succeeds.lower for one in under.passes)
            error = f"tips {under.tip_error_mm:g} mm off"
            out.print(f"{error}: every pass succeeds with a probability of at least {least:.3f} (95 %)")
    if not playback.feasible:
        raise typer.Exit(1)


@commands.command()
@refusing
def export(
    plan_id: PlanId,
    to: Annotated[Path, typer.Argument(help="The zip to write.", dir_okay=False)],
    pass_index: Annotated[int | None, typer.Option("--pass", help="A single pass, counted from 0.")] = None,
    no_handoff: Annotated[
        bool, typer.Option("--no-handoff", help="Needed for a plan without a hand-off: no PSM_M, no A2.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write the bag of a plan that a robot or a simulator replays; read docs/replay.md first."""
    with service() as client, bar("fetching") as progress:
        client.save_replay_bag(plan_id, to, pass_index, progress, handoff="none" if no_handoff else None)
    size = to.stat().st_size
    if as_json:
        print_json({"file": to, "size_bytes": size})
    else:
        out.print(
            f"{to}: {size / 1e6:.1f} MB. Check it with `skills verify {to}` before it is used. Research use only."
        )
