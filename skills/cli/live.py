"""Commands for an arm on a bus: a stand-in for one, and a check that only listens."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated

import typer

from skills.cli.commands import command
from skills.cli.output import Answer, err, say, show_cells

if TYPE_CHECKING:
    from skills.live.bus import Bus

commands = typer.Typer()
arm_commands = typer.Typer(no_args_is_help=True, help="An arm on a bus: a stand-in for one, and a check.")
commands.add_typer(arm_commands, name="arm")
Domain = Annotated[int, typer.Option(min=0, max=232)]


@contextmanager
def joined(domain: int, interface: str | None) -> "Iterator[Bus]":
    """Join the bus, and leave it at the end.

    Raises:
        BadSettings: The extra `live` is not installed, or the domain or interface is none.
    """
    from importlib.util import find_spec

    from skills.errors import BadSettings

    if find_spec("cyclonedds") is None:
        raise BadSettings("The bus needs the extra `live`: pip install 'suture-skills[live]'.")
    from skills.live.dds import DdsBus

    bus = DdsBus(domain, interface)
    try:
        yield bus
    finally:
        bus.close()


@command(arm_commands, "check")
def check_arm(
    arm: str,
    instrument: str = "400006",
    seconds: Annotated[float, typer.Option(min=1.0, max=600.0)] = 3.0,
    domain: Domain = 0,
    interface: str | None = None,
) -> Answer:
    """Listen to an arm on the bus and say what is wrong with its interface; exit code 1 if anything is.

    Args:
        arm: Name of the arm, such as PSM1.
        instrument: Number of its instrument.
        seconds: How long to listen.
        domain: ROS_DOMAIN_ID of the arm.
        interface: Network interface, such as eth0; without it only this machine is listened to.
    """
    from skills.fields import as_json as plain
    from skills.live.check import check, listen_to

    with joined(domain, interface) as bus:
        report = check(listen_to(bus, arm, seconds), instrument)
    rows = [(one.topic, one.messages, one.rate_hz, one.gap_s, one.age_s) for one in report.streams]
    said = [str(one) for one in report.findings] or [f"{arm} may be followed: its poses are in {report.frame}."]

    def show() -> None:
        show_cells(("topic", "messages", "per second", "longest gap s", "age s"), rows)
        say(*said)

    return Answer(plain(report), show, exit_code=1 if report.findings else 0)


@command(arm_commands, "simulate")
def simulate(
    arm: Annotated[list[str], typer.Argument()],
    seconds: Annotated[float | None, typer.Option(min=0.1)] = None,
    rate_hz: Annotated[float, typer.Option(min=1.0, max=1000.0)] = 200.0,
    camera: bool = True,
    fault: list[str] | None = None,
    domain: Domain = 0,
    interface: str | None = None,
) -> Answer:
    """Stand in for arms of a dVRK on the bus, until Ctrl-C. It is no robot.

    Args:
        arm: Names of the arms, such as PSM1.
        seconds: End after so many seconds.
        rate_hz: Messages a second.
        camera: Whether a camera is configured, so that measured_cp is in its frame.
        fault: A fault of the interface, by name; again for another. An unknown name lists all.
        domain: ROS_DOMAIN_ID.
        interface: Network interface; without it only this machine hears the arms.
    """
    from math import inf

    from skills.live.stand_in import StandIn

    with joined(domain, interface) as bus:
        stand_in = StandIn(bus, arm, rate_hz=rate_hz, camera=camera, faults=fault or ())
        err.print(f"{', '.join(arm)} on domain {domain}: Ctrl-C ends it.")
        late = 0
        with suppress(KeyboardInterrupt):
            late = stand_in.run(inf if seconds is None else seconds)
    return Answer({"arms": arm, "late": late}, lambda: say(f"Ended; {late} ticks were late."))
