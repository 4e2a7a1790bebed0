"""The command that measures the errors of a laboratory's own arm."""

from pathlib import Path
from typing import Annotated

import typer

from skills.cli.commands import command
from skills.cli.output import Answer, cell, out, say

commands = typer.Typer()
COLUMNS = ("error", "mean", "deviation", "independent", "band 90 %", "held", "width", "assumed holds", "width")


@command(commands, "calibrate-arm")
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
) -> Answer:
    """Measure an arm's own errors: setpoints compared with measured poses, and with a tracker's if there is one."""
    from rich.table import Table

    from skills.fields import as_json as plain
    from skills.library.plans.arm_errors import read_measured
    from skills.packing import canonical
    from skills.verification.arm_calibration import calibrate_arm
    from skills.verification.arm_slip import measure_slip

    measured = read_measured(bag, arm=arm, instrument=instrument, rate_hz=rate_hz, tracker=tracker)
    found = calibrate_arm(measured, name=name)
    slip = None if cell_mm is None else measure_slip(measured, cell_mm)
    if to is not None:
        to.write_bytes(canonical(plain(found.errors)) + b"\n")
    table = Table(*COLUMNS, box=None)
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
    sentences = [found.describe(), f"{found.errors.name}: {found.errors.describe()}"]
    if slip is not None:
        sentences.append(slip.describe())

    def show() -> None:
        out.print(table)
        say(*sentences)

    return Answer(plain(found) | ({} if slip is None else {"slip": plain(slip)}), show)
