"""Arms and instruments that a recording may be of: the lengths by which their poses differ, and their numbers.

The tip is (q3 - offset) s + wrist x5 (`kinematics.axes_of`), so an arm with an instrument is two lengths:

    offset   remote centre less shaft: 15.6 mm for an instrument on an arm of its own generation, 66.4 mm for a Classic
             instrument on a Si, -35.2 mm for a S/Si instrument on a Classic
    wrist    from its pitch axis to the hinge of the jaws: 9.1 to 11.2 mm

Instruments with equal lengths are one hypothesis, because no pose can tell them apart: a Classic with 400006 and a Si
with 420006 have the same kinematics.

Sources: jhu-dvrk/sawIntuitiveResearchKit @9e535e68, share/tool/*.json (numbers, lengths of shaft and wrist) and
share/kinematic/PSM.json and PSM_Si.json. The snake-like instruments and the stapler there have other wrists, which are
not computed.
"""

from dataclasses import dataclass
from typing import Literal

from skills.kinematics import CLASSIC, SI, ArmConstants

Generation = Literal["Classic", "Si"]

ARMS: dict[Generation, ArmConstants] = {"Classic": CLASSIC, "Si": SI}
_SHAFT_MM: dict[Generation, float] = {"Classic": 416.2, "Si": 467.0}
_PREFIX: dict[Generation, str] = {"Classic": "400", "Si": "420"}
# The last three digits of the instruments of each generation, by the length of the wrist in mm; the most usual first.
_NUMBERS: dict[Generation, dict[float, str]] = {
    "Classic": {
        9.1: "006 296 036 001 003 007 033 035 048 049 178 179 181",
        9.3: "183 184",
        10.0: "309",
        10.7: "093 127 172 189 205 207 208 230",
        11.2: "194",
    },
    "Si": {
        9.1: "006 296 036 001 007 033 048 049 178 179 181",
        9.3: "183 184",
        10.0: "309",
        10.7: "093 172 205 230 327",
        11.2: "194",
    },
}
OTHER_WRISTS = ("400117", "420117", "400143", "410298")  # two snake-like needle drivers, a dissector, a stapler


@dataclass(frozen=True)
class Hypothesis:
    """The lengths of an arm with an instrument, and the names of all that have them."""

    offset_mm: float
    wrist_mm: float
    names: tuple[str, ...]


def _hypotheses() -> tuple[Hypothesis, ...]:
    """Return the hypotheses, each with the names of all arms with instruments that have its lengths."""
    found: dict[tuple[float, float], list[str]] = {}
    for made_for, by_wrist in _NUMBERS.items():
        for wrist_mm, numbers in by_wrist.items():
            for generation, arm in ARMS.items():
                offset_mm = round(arm.remote_centre_mm - _SHAFT_MM[made_for], 6)
                on = "" if generation == made_for else f"-{generation}"
                names = [f"{_PREFIX[made_for]}{number}{on}" for number in numbers.split()]
                found.setdefault((offset_mm, wrist_mm), []).extend(names)
    return tuple(Hypothesis(offset, wrist, tuple(names)) for (offset, wrist), names in found.items())


HYPOTHESES = _hypotheses()
KNOWN = frozenset(name for one in HYPOTHESES for name in one.names)


def stated_instrument(name: str) -> str | None:
    """Return the number in the name of a tool, as the console or a user gives it.

    Args:
        name: Such as "LARGE_NEEDLE_DRIVER:420006[..11]", "420006" or "420006-Classic".

    Returns:
        The number, with the arm's generation if it is named; None if there is no number.
    """
    said = name.rpartition(":")[2].partition("[")[0]
    number, _, on = said.partition("-")
    is_number = len(number) == 6 and number.isascii() and number.isdigit()
    return said if is_number and (said == number or on in ARMS) else None


def generation_of(name: str) -> Generation:
    """Return the generation of the arm that an instrument is on.

    Args:
        name: Such as "420006", or "420006-Classic" on an arm of the other generation.
    """
    number, _, on = name.partition("-")
    if on:
        return "Classic" if on == "Classic" else "Si"
    return "Classic" if number.startswith(_PREFIX["Classic"]) else "Si"


def matching(names: list[str], stated: str) -> list[str]:
    """Return the names that a stated instrument may have: of a bare number also those on the other generation.

    Args:
        names: Instruments by their names.
        stated: The instrument that a recording states.
    """
    return [name for name in names if stated in (name, name.partition("-")[0])]
