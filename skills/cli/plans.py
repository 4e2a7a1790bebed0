"""Commands of plans: where one is possible, its verdict, and the bag that a robot replays."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skills.cli.commands import Surgeon, Suture, command, numbers, triple
from skills.cli.connecting import finished, service
from skills.cli.output import Answer, bar, table, text, written
from skills.cli.policies import read_scene
from skills.errors import BadInput, BadSettings
from skills.keywords import PlanKeywords, ReachKeywords

if TYPE_CHECKING:
    from skills.schemas.reach import Reach

commands = typer.Typer()

PlanId = Annotated[str, typer.Argument(help="The plan's digest.")]
Obstacles = Annotated[
    Path | None,
    typer.Option(help="JSON file of tissue and obstacles for the verdict, as --scene of train; else the policy's."),
]
Approach = Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")]
Base = Annotated[str | None, typer.Option(help="PSM_M's base in the arm's frame, as x,y,z in mm and qx,qy,qz,qw.")]
NoHandoff = Annotated[
    bool, typer.Option("--no-handoff", help="Plan the tip's path alone, without a hand-off: no PSM_M, no A2.")
]


@command(commands, without=("starts_mm",))
def plan(
    surgeon: Surgeon,
    suture: Suture,
    options: PlanKeywords,
    point: list[str] | None = None,
    scene: Path | None = None,
    obstacles: Obstacles = None,
    approach: Approach = None,
    base: Base = None,
    handoff: NoHandoff = False,
) -> Answer:
    """Stack the released policy at suture points.

    Args:
        point: A suture point, as x,y,z in mm; repeatable, one for each pass.
        scene: Take the suture points from a simulator's MCAP file: the exit points of the needle.
    """
    from skills.schemas.plans import SuturePointIn

    if point and scene is not None:
        raise BadInput("Use --point or --scene, not both.", "A scene's file contains the suture points itself.")
    if not point and scene is None:
        raise BadInput(
            "A plan needs suture points, from --point or from --scene.",
            "For each pass: --point X,Y,Z in mm; or --scene with a simulator's file that contains them.",
        )
    _set_hand_off(options, obstacles, approach, base, handoff)
    with service() as client:
        points: list[Any] = [triple(one) for one in point or ()]
        if scene is not None:
            goals = [mark for mark in client.suture_points(scene).points if mark.is_goal]
            points = [SuturePointIn(position_mm=one.position_mm, rotation_xyzw=one.turn_xyzw) for one in goals]
        made = client.plan(surgeon, suture, points, **options)
    return table(made, ("id", "arm", "frame", "orientation", "trajectory.duration_s"), made.description)


def _set_hand_off(
    options: PlanKeywords | ReachKeywords, obstacles: Path | None, approach: str | None, base: str | None, alone: bool
) -> None:
    """Add the scene and the arm that takes the needle to the options of a plan or of a map.

    Raises:
        BadInput: PSM_M is given, and no hand-off is asked for.
    """
    if obstacles is not None:
        options["scene"] = read_scene(obstacles)
    if (psm_m := psm_m_of(approach, base)) is not None:
        if alone:
            raise BadInput("--no-handoff plans without PSM_M.", "Leave it out, or --approach and --base.")
        options["psm_m"] = psm_m
    if alone:
        options["handoff"] = "none"


def psm_m_of(approach: str | None, base: str | None) -> dict[str, object] | None:
    """Return PSM_M as a request states it; None: as demonstrated, or none.

    Raises:
        BadInput: An option is not numbers.
    """
    psm_m: dict[str, object] = {} if approach is None else {"approach": triple(approach)}
    if base is not None:
        x, y, z, *turned = numbers(base, 7)  # position, then quaternion
        psm_m["base"] = {"position_mm": (x, y, z), "rotation_xyzw": turned}
    return psm_m or None


@command(commands)
def reach(
    surgeon: Surgeon,
    suture: Suture,
    options: ReachKeywords,
    obstacles: Obstacles = None,
    approach: Approach = None,
    base: Base = None,
    handoff: NoHandoff = False,
) -> Answer:
    """Map where the released policy can be planned: reach and clearance over positions and rotations."""
    _set_hand_off(options, obstacles, approach, base, handoff)
    with service() as client:
        found = client.reach(surgeon, suture, **options)
    return text(found, *_drawn(found), found.description)


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


@command(commands)
def plans(plan_id: Annotated[str | None, typer.Argument(metavar="PLAN")] = None) -> Answer:
    """List plans, the newest first, or show one.

    Args:
        plan_id: Show this plan; without it the plans are listed.
    """
    with service() as client:
        if plan_id is None:
            about = ("id", "surgeon", "suture", "policy.version", "passes", "hands_over", "feasible", "created_at")
            return table(client.plans(), about)
        shown = client.plan_of(plan_id)
    columns = ("id", "surgeon", "suture", "policy.version", "trajectory.duration_s", "created_at")
    return table(shown, columns, shown.description)


@command(commands)
def play(
    plan_id: PlanId,
    errors: str | None = None,
    servo: Path | None = None,
    picture: Path | None = None,
    pictures: Path | None = None,
) -> Answer:
    """Play a plan in the simulator, and print the verdict; exit code 1 if it is not feasible.

    Args:
        errors: Errors of the arms: calibrated, uncalibrated, or a JSON file with your own (docs/errors.md).
        servo: A JSON file that says how PSM_A is driven (docs/execution.md).
        picture: Write a picture here.
        pictures: Write the picture, a film and two plots to this folder.
    """
    from skills.schemas.results import PlaybackResult

    with service(workers=1) as client:
        job = finished(client, client.play(plan_id, arm_errors_of(errors), servo_of(servo)))
        playback = client.playback(PlaybackResult.of(job).playback)
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
    assert playback.headline is not None, playback
    return text(playback, playback.headline.text, *playback.headline.under, exit_code=0 if playback.feasible else 1)


def arm_errors_of(errors: str | None) -> Any:
    """Return the errors of the arms as a request states them: a name, or the JSON of a file; raises as `_stated`."""
    from skills.library.plans.arm_errors import stated_errors

    if errors is None or errors in ("calibrated", "uncalibrated"):
        return errors
    remedy = "Write calibrated, uncalibrated, or a file of `skills calibrate-arm` (docs/errors.md)."
    return _stated("errors", Path(errors), stated_errors, remedy)


def servo_of(servo: Path | None) -> Any:
    """Return how an arm is driven as a request states it, the JSON of a file; raises as `_stated`."""
    from skills.library.plans.arm_errors import stated_servo

    return None if servo is None else _stated("servo", servo, stated_servo, "docs/execution.md has an example.")


def _stated(option: str, file: Path, check: Callable[[str], object], remedy: str) -> Any:
    """Return the JSON of a file.

    Raises:
        BadInput: The file cannot be read, or does not have what the option is for.
    """
    try:
        text = file.read_text()
        check(text)
        return json.loads(text)
    except (OSError, ValueError, BadSettings) as error:
        why = error.message if isinstance(error, BadSettings) else f"It cannot be read: {error}."
        raise BadInput(f"--{option} {file}: {why}", remedy) from None


@command(commands)
def export(
    plan_id: PlanId,
    to: Annotated[Path, typer.Argument(dir_okay=False)],
    no_handoff: bool = False,
    force: bool = False,
) -> Answer:
    """Write the bag of a plan that a robot or a simulator replays; read docs/replay.md first.

    Args:
        to: The zip to write.
        no_handoff: Needed for a plan without a hand-off: no PSM_M, no A2.
        force: Replace the file if it exists.
    """
    if to.exists() and not force:
        raise BadInput(f"{to} exists already, and may be the bag of another plan.", "Replace it: --force")
    with service() as client, bar("fetching") as progress:
        client.save_replay_bag(plan_id, to, progress, handoff="none" if no_handoff else None)
    megabytes = to.stat().st_size / 1e6
    check = f"Check it with `skills verify {to}` before it is used. Research use only."
    return written(to, f"{to}: {megabytes:.1f} MB. {check}")
