"""The command that measures the errors of a laboratory's own arm."""

from pathlib import Path
from typing import Annotated

import typer

from skills.cli.commands import command
from skills.cli.output import Answer, say, show_cells, table
from skills.errors import BadInput

SERVO = ("joint", "quantity", "fitted", "low", "high", "published", "left_out", "as_published", "no_error", "constant")
commands = typer.Typer()
COLUMNS = ("error", "mean", "deviation", "independent", "band 90 %", "held", "width", "assumed holds", "width")


@command(commands, "calibrate-arm")
def calibrate(
    bag: Path,
    name: str = "our arms",
    arm: str | None = None,
    instrument: str = "400006",
    rate_hz: float | None = None,
    tracker: str | None = None,
    cell_mm: Annotated[float | None, typer.Option("--cell")] = None,
    to: Path | None = None,
    servo: Path | None = None,
) -> Answer:
    """Measure an arm's own errors: setpoints compared with measured poses, and with a tracker's if there is one.

    Args:
        bag: Recording with setpoint_cp and measured_cp, or a table of joints (docs/errors.md).
        name: Name of the errors in verdicts.
        arm: The arm of a recording with several.
        instrument: Number of the instrument, for a table.
        rate_hz: Samples per second of a table without times.
        tracker: The topic of a bag with a tracker's positions of a marker on the tool.
        cell_mm: Also measure the slip on a grid with cells of this size, in mm.
        to: Write the errors to this JSON file, for `play --errors` and SKILLS_ARM_ERRORS.
        servo: Instead fit gains, friction and load to measured_js and setpoint_js, and write them to this JSON file.
    """
    from skills.fields import as_json as plain
    from skills.library.plans.arm_errors import read_measured, read_states
    from skills.packing import canonical
    from skills.verification.arm_calibration import calibrate_arm
    from skills.verification.arm_slip import measure_slip
    from skills.verification.servo_fit import fit_servo

    if servo is not None:
        if (to, tracker, cell_mm) != (None, None, None):
            raise BadInput("A servo is fitted alone; omit --to, --tracker and --cell.")
        numbers, fitted, notes = fit_servo(*read_states(bag, arm=arm, rate_hz=rate_hz))
        servo.write_bytes(canonical(plain(fitted)) + b"\n")
        document = {"quantities": [plain(one) for one in numbers], "servo": plain(fitted), "notes": notes}
        return table(document, SERVO, *notes, rows=numbers)
    measured = read_measured(bag, arm=arm, instrument=instrument, rate_hz=rate_hz, tracker=tracker)
    found = calibrate_arm(measured, name=name)
    slip = None if cell_mm is None else measure_slip(measured, cell_mm)
    if to is not None:
        to.write_bytes(canonical(plain(found.errors)) + b"\n")
    kinds = (("tip", found.tip), ("wrist", found.wrist), ("tip, tracked", found.tracked or ()))
    rows = [
        (
            *(f"{kind} {one.axis} {one.unit}", round(one.mean, 3), round(one.deviation, 3), round(one.effective, 1)),
            *(f"{one.band[0]:.2f} to {one.band[1]:.2f}", f"{one.coverage:.1%}", round(one.width, 3)),
            *(f"{one.assumed_coverage:.1%}", round(one.assumed_width, 3)),
        )
        for kind, axes in kinds
        for one in axes
    ]
    sentences = [found.describe(), f"{found.errors.name}: {found.errors.describe()}"]
    if slip is not None:
        sentences.append(slip.describe())

    def show() -> None:
        show_cells(COLUMNS, rows)
        say(*sentences)

    return Answer(plain(found) | ({} if slip is None else {"slip": plain(slip)}), show)
