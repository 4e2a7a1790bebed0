"""The command that measures the errors of a laboratory's own arm."""

from pathlib import Path
from typing import Annotated

import typer

from skills.cli.shell import AsJson, cell, out, print_json, refusing
from skills.errors import BadInput

commands = typer.Typer()


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
    to: Annotated[
        Path | None, typer.Option(help="Write the errors to this JSON file, for `play --errors` and SKILLS_ARM_ERRORS.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure an arm's own errors: setpoints compared with measured poses, and with a tracker's if there is one."""
    from rich.table import Table

    from skills.fields import as_json as plain
    from skills.library.arm_errors import read_measured
    from skills.packing import canonical
    from skills.verification.arm_errors import calibrate_arm

    try:
        found = calibrate_arm(read_measured(bag, arm=arm, instrument=instrument, rate_hz=rate_hz), name=name)
        if to is not None:
            to.write_bytes(canonical(plain(found.errors)) + b"\n")
    except OSError as error:
        raise BadInput(f"{error.filename}: {error.strerror}.", "Give a file that can be read, or written.") from None
    if as_json:
        print_json(plain(found))
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
    out.print(found.in_words, markup=False, soft_wrap=True)
    out.print(f"{found.errors.name}: {found.errors.in_words}", markup=False, soft_wrap=True)
