"""Commands of plans: where one is possible, its verdict, the bag that a robot replays, and the robot's errors."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.policies import read_scene
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
from skills.errors import BadInput, BadSettings

if TYPE_CHECKING:
    from skills.schemas.reach import Reach
from skills.cli.shell import cell

commands = typer.Typer()

PlanId = Annotated[str, typer.Argument(help="The plan's digest.")]
Obstacles = Annotated[
    Path | None,
    typer.Option(help="JSON file of tissue and obstacles for the verdict, as --scene of train; else the policy's."),
]
Tissue = Annotated[
    float | None,
    typer.Option(help="Height of level tissue in the arm's frame, mm; without tissue nothing is exported."),
]
Approach = Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")]
Base = Annotated[str | None, typer.Option(help="PSM_M's base in the arm's frame, as x,y,z in mm and qx,qy,qz,qw.")]
NoHandoff = Annotated[
    bool, typer.Option("--no-handoff", help="Plan the tip's path alone, without a hand-off: no PSM_M, no A2.")
]


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
    speed_mm_s: Annotated[
        float, typer.Option(help="Greatest speed of the tip; the surgeon's tempo is slowed to it.")
    ] = 20.0,
    orientation: Annotated[
        Literal["recorded", "constant"] | None,
        typer.Option(help="The jaw: recorded, as the surgeon turned it, or constant. Recorded where it was."),
    ] = None,
    a2: Annotated[
        Literal["recorded", "paper"] | None,
        typer.Option(help="The end of A2: recorded, the demonstrated hand-off, or paper. Recorded where it was."),
    ] = None,
    obstacles: Obstacles = None,
    tissue: Tissue = None,
    rate_hz: Annotated[float, typer.Option(help="Samples per second, 100 to 200.")] = 200.0,
    approach: Approach = None,
    base: Base = None,
    no_handoff: NoHandoff = False,
    tip_offset_mm: Annotated[
        float,
        typer.Option(
            help="Distance of the finger tips from the hinge; with 10.2 the points are those of the finger tips."
        ),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Stack the released policy at suture points."""
    if point and scene is not None:
        raise BadInput("Use --point or --scene, not both.", "A scene's file contains the suture points itself.")
    if not point and scene is None:
        raise BadInput(
            "A plan needs suture points, from --point or from --scene.",
            "For each pass: --point X,Y,Z in mm; or --scene with a simulator's file that contains them.",
        )
    psm_m = psm_m_of(approach, base, no_handoff)
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
            psm_m=psm_m,
            handoff="none" if no_handoff else None,
            orientation=orientation,
            a2=a2,
            scene=None if obstacles is None else read_scene(obstacles),
            tissue_mm=tissue,
        )
    show(made, as_json, ("id", "arm", "frame", "orientation", "trajectory.duration_s"))
    if not as_json:
        out.print(made.in_words, markup=False, soft_wrap=True)


def psm_m_of(approach: str | None, base: str | None, no_handoff: bool = False) -> dict[str, Any] | None:
    """Return PSM_M as a request states it; None: as demonstrated, or none.

    Raises:
        BadInput: It is given, and no hand-off is asked for; or it is not numbers.
    """
    psm_m: dict[str, Any] = {} if approach is None else {"approach": triple(approach)}
    if base is not None:
        x, y, z, *turned = numbers(base, 7)  # position, then quaternion
        psm_m["base"] = {"position_mm": (x, y, z), "rotation_xyzw": turned}
    if no_handoff and psm_m:
        raise BadInput("--no-handoff plans without PSM_M.", "Leave it out, or --approach and --base.")
    return psm_m or None


@commands.command()
@refusing
def reach(
    surgeon: Surgeon,
    suture: Suture,
    centre: Annotated[
        str | None,
        typer.Option(help="Middle of the box, as x,y,z in mm; else the demonstrated goal."),
    ] = None,
    size: Annotated[str, typer.Option(help="Edges of the box, as x,y,z in mm.")] = "80,80,0",
    step: Annotated[float, typer.Option(help="Distance of the places, mm.")] = 8.0,
    turn: Annotated[
        list[str] | None,
        typer.Option(help="A rotation of the grid world about each place, as qx,qy,qz,qw; repeatable."),
    ] = None,
    approach: Approach = None,
    base: Base = None,
    no_handoff: NoHandoff = False,
    obstacles: Obstacles = None,
    tissue: Tissue = None,
    as_json: AsJson = False,
) -> None:
    """Map where the released policy can be planned: reach and clearance over positions and rotations."""
    psm_m = psm_m_of(approach, base, no_handoff)
    with service() as client:
        found = client.reach(
            surgeon,
            suture,
            centre_mm=None if centre is None else triple(centre),
            size_mm=triple(size),
            step_mm=step,
            rotations_xyzw=None if not turn else [numbers(one, 4) for one in turn],
            psm_m=psm_m,
            handoff="none" if no_handoff else None,
            scene=None if obstacles is None else read_scene(obstacles),
            tissue_mm=tissue,
        )
    if as_json:
        print_json(found)
        return
    for line in _drawn(found):
        out.print(line, markup=False, highlight=False)
    out.print(found.in_words, markup=False, soft_wrap=True)


MARKS = {"yes": "O", "no": ".", "in doubt": "?"}


def _drawn(found: "Reach") -> list[str]:
    """Return the map as text from above, a picture for each rotation and height: x to the right, y up."""
    x, y, z = found.counts
    lines = []
    for first in range(0, len(found.places), x * y * z):
        for level in range(z):
            layer = found.places[first + level : first + x * y * z : z]
            low, high = layer[0].position_mm, layer[-1].position_mm
            turned = ",".join(f"{one:g}" for one in layer[0].rotation_xyzw)
            lines.append(
                f"x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}, z {low[2]:g} mm, turned {turned}: "
                "O can be planned, ? in doubt, . not"
            )
            lines += [" ".join(MARKS[one.reach] for one in layer[row::y]) for row in reversed(range(y))]
    return lines


@commands.command()
@refusing
def plans(
    plan_id: Annotated[
        str | None, typer.Argument(metavar="PLAN", help="Show this plan; without it the plans are listed.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List plans, the newest first, or show one."""
    with service() as client:
        if plan_id is None:
            about = ("id", "surgeon", "suture", "policy.version", "passes", "hands_over", "feasible", "created_at")
            show(client.plans(), as_json, about)
            return
        shown = client.plan_of(plan_id)
    show(shown, as_json, ("id", "surgeon", "suture", "policy.version", "trajectory.duration_s", "created_at"))
    if not as_json:
        out.print(shown.in_words, markup=False, soft_wrap=True)


@commands.command()
@refusing
def play(
    plan_id: PlanId,
    errors: Annotated[
        str | None,
        typer.Option(
            help="Errors of the arms: calibrated, uncalibrated, or a JSON file with your own (docs/errors.md)."
        ),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a picture here.")] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Write the picture, a film and two plots to this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Play a plan in the simulator, and print the verdict; exit code 1 if it is not feasible."""
    with service(workers=1) as client:
        playback = client.playback(
            result_of(finished(client, client.play(plan_id, stated_errors_of(errors))))["playback"]
        )
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
            out.print(
                f"{under.errors.name}: {under.errors.describe()}; every pass succeeds with a probability of at least "
                f"{least:.3f} (95 %)",
                markup=False,
                soft_wrap=True,
            )
    if not playback.feasible:
        raise typer.Exit(1)


def stated_errors_of(errors: str | None) -> Any:
    """Return the errors of the arms as a request states them: a name, or the JSON of a file.

    Raises:
        BadInput: The file cannot be read, or does not have the errors of an arm.
    """
    from skills.library.plans.arm_errors import stated_errors

    if errors is None or errors in ("calibrated", "uncalibrated"):
        return errors
    try:
        text = Path(errors).read_text()
        stated_errors(text)
        return json.loads(text)
    except (OSError, ValueError, BadSettings) as error:
        why = error.message if isinstance(error, BadSettings) else f"It cannot be read: {error}."
        remedy = "Write calibrated, uncalibrated, or a file of `skills calibrate-arm` (docs/errors.md)."
        raise BadInput(f"--errors {errors}: {why}", remedy) from None


@commands.command()
@refusing
def export(
    plan_id: PlanId,
    to: Annotated[Path, typer.Argument(help="The zip to write.", dir_okay=False)],
    pass_index: Annotated[int | None, typer.Option("--pass", help="A single pass, counted from 0.")] = None,
    no_handoff: Annotated[
        bool, typer.Option("--no-handoff", help="Needed for a plan without a hand-off: no PSM_M, no A2.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write the bag of a plan that a robot or a simulator replays; read docs/replay.md first."""
    if to.exists() and not force:
        raise BadInput(f"{to} exists already, and may be the bag of another plan.", "Replace it: --force")
    with service() as client, bar("fetching") as progress:
        client.save_replay_bag(plan_id, to, pass_index, progress, handoff="none" if no_handoff else None)
    size = to.stat().st_size
    if as_json:
        print_json({"file": to, "size_bytes": size})
    else:
        out.print(
            f"{to}: {size / 1e6:.1f} MB. Check it with `skills verify {to}` before it is used. Research use only."
        )


@commands.command("calibrate-arm")
@refusing
def calibrate(
    bag: Annotated[
        Path, typer.Argument(help="Recording with setpoint_cp and measured_cp, or a table of joints (docs/errors.md).")
    ],
    name: Annotated[str, typer.Option(help="Name of the errors in verdicts.")] = "our arms",
    arm: Annotated[str | None, typer.Option(help="The arm of a recording with several.")] = None,
    instrument: Annotated[str, typer.Option(help="Number of the instrument, for a table.")] = "400006",
    rate_hz: Annotated[float | None, typer.Option(help="Samples per second of a table without times.")] = None,
    tracker: Annotated[
        str | None, typer.Option(help="The topic of a bag with a tracker's positions of a marker on the tool.")
    ] = None,
    cell_mm: Annotated[
        float | None, typer.Option("--cell", help="Also measure the slip on a grid with cells of this size, in mm.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option(help="Write the errors to this JSON file, for `play --errors` and SKILLS_ARM_ERRORS.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure an arm's own errors: setpoints compared with measured poses, and with a tracker's if there is one."""
    from rich.table import Table

    from skills.fields import as_json as plain
    from skills.library.plans.arm_errors import read_measured
    from skills.packing import canonical
    from skills.verification.arm_calibration import calibrate_arm
    from skills.verification.arm_slip import measure_slip

    try:
        measured = read_measured(bag, arm=arm, instrument=instrument, rate_hz=rate_hz, tracker=tracker)
        found = calibrate_arm(measured, name=name)
        slip = None if cell_mm is None else measure_slip(measured, cell_mm)
        if to is not None:
            to.write_bytes(canonical(plain(found.errors)) + b"\n")
    except OSError as error:
        raise BadInput(f"{error.filename}: {error.strerror}.", "Give a file that can be read, or written.") from None
    if as_json:
        print_json(plain(found) | ({} if slip is None else {"slip": plain(slip)}))
        return
    names = ("error", "mean", "deviation", "independent", "band 90 %", "held", "width", "assumed holds", "width")
    table = Table(*names, box=None)
    for kind, axes in (("tip", found.tip), ("wrist", found.wrist), ("tip, tracked", found.tracked or ())):
        for one in axes:
            table.add_row(
                f"{kind} {one.axis} {one.unit}",
                *(cell(round(value, 3)) for value in (one.mean, one.deviation)),
                cell(round(one.effective, 1)),
                f"{one.band[0]:.2f} to {one.band[1]:.2f}",
                f"{one.coverage:.1%}",
                cell(round(one.width, 3)),
                f"{one.assumed_coverage:.1%}",
                cell(round(one.assumed_width, 3)),
            )
    out.print(table)
    out.print(found.describe(), markup=False, soft_wrap=True)
    out.print(f"{found.errors.name}: {found.errors.describe()}", markup=False, soft_wrap=True)
    if slip is not None:
        out.print(slip.describe(), markup=False, soft_wrap=True)
