"""The report on a demonstration: its measurements, those of its path in the grid, and advice to the surgeon."""

from dataclasses import asdict

from skills.db.models import Demonstration
from skills.demonstration.demonstration import Demo
from skills.demonstration.quality import describe
from skills.demonstration.recording import equal_samples
from skills.fields import percent
from skills.gridworld.grid import PAPER_GRID, GridPath, describe_path
from skills.schemas.demos import DemoReport
from skills.schemas.grids import ChosenGrid

EQUAL_SHARE = 0.1  # ours: an arm that rests on exact encoder values for a tenth of the time is no reason for advice


def report_on(demo: Demo, path: GridPath, duplicate_stamps: int, backward_stamps: int) -> DemoReport:
    """Measure a demonstration and its path.

    Args:
        demo: The demonstration.
        path: Its path in the grid.
        duplicate_stamps: Samples of the entire recorded motion that carried the stamp of the sample before.
        backward_stamps: Samples of the entire recorded motion that were dropped because their stamp went back.
    """
    of_motion, of_path = describe(demo), describe_path(demo, path)
    equal = equal_samples(demo.tip_mm, demo.rotation_xyzw)
    advice = (
        *of_motion.advice,
        *_about_stamps(duplicate_stamps, "repeated the previous stamp and were dropped"),
        *_about_stamps(backward_stamps, "had a stamp that went back and were dropped"),
        *_about_equal(equal, len(demo.tip_mm)),
        *of_path.advice,
    )
    measured = vars(of_motion) | vars(of_path) | {"advice": advice}
    return DemoReport(
        duplicate_stamps=duplicate_stamps,
        backward_stamps=backward_stamps,
        equal_samples=equal,
        grid=ChosenGrid(**asdict(path.grid), chosen="paper" if path.grid == PAPER_GRID else "fit"),
        partner=demo.partner,
        **measured,
    )


def full_report(demonstration: Demonstration) -> DemoReport:
    """Measure a stored demonstration again, because no digest covers its stored report."""
    about, topic = demonstration.recording.about, demonstration.topic
    duplicates = next((one.duplicate_stamps for one in about.motions if one.topic == topic), 0)
    backward = next((one.backward_stamps for one in about.dropped if one.topic == topic), 0)
    return report_on(demonstration.demo, demonstration.path, duplicates, backward)


def _about_stamps(count: int, what: str) -> list[str]:
    samples = "1 sample" if count == 1 else f"{count} samples"
    return [f"{samples} {what}: check the recorder's clock."] if count else []


def _about_equal(count: int, samples: int) -> list[str]:
    if count <= EQUAL_SHARE * samples:
        return []
    return [
        f"{count} of {samples} samples ({percent(count / samples)}%) repeat the pose of the sample before: the "
        "recorder was "
        "faster than its source, so speeds are less certain than the rate suggests."
    ]
