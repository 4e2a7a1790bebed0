"""The surgeon's hand in a plan: tempo, place and orientation of a planned pass beside the recording, and as before.

The recordings are the sample surgeons', and the real ones of `SKILLS_PAPER_DATA`, `SKILLS_SAMPLE_RECORDINGS` and
`SKILLS_TEST_JIGSAWS` where these are set; every hand-off that is proposed in them, at most six of a trial. Each is
planned where it was shown, along its own path in the grid. As before: at an even speed, with the orientation held.

* RMSE: as in `tests/planning/test_path_fit.py`, ends included, in steps of 0.1 mm on paths of up to 400 mm and of a
  four thousandth of longer ones: of the fitted path, of the planned motion, and of the recording averaged by a Hann
  window of 0.25 s.
* Profile: the correlation of the tip's speeds of plan and recording over normalised time and over normalised length, at
  401 places; the recording is averaged by the same window and rests for half of it before and after.
* Turn: the greatest angle from the first orientation. Hand-off: the distance of the needle's free end from its recorded
  place, at the last sample.
"""

import os
import tarfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.table import Table

from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.movement import smoothed_tip
from skills.demonstration.segments import propose_by_arm
from skills.formats import read_recording
from skills.gridworld.grid import choose_grid, discretize
from skills.kinematics import matrix_of
from skills.learning.evaluation import dtw
from skills.learning.slip_runs import replay
from skills.planning.handoff import needle_tips_mm
from skills.planning.motion_laws import followed
from skills.planning.path_fit import TREMOR_S, fit_to_demo, hand_along, trace
from skills.planning.plan import departure_of
from skills.seeds.recordings import sample_recordings
from tests.planning.test_path_fit import walked, without_rests

RATE_HZ, SPEED_MM_S = 200.0, 20.0
BAGS = ("rosbag2/rosbag2.mcap", "old_transform_stamped.mcap", "calibration/pitch_exp_traj_02_test_cropped.bag")
TRIALS = (
    "needle_passing/Needle_Passing_B001.txt",
    "needle_passing/Needle_Passing_C004.txt",
    "knot_tying/Knot_Tying_C001.txt",
    "knot_tying/Knot_Tying_F004.txt",
)
OF_A_TRIAL = 6


def hands(table: Table) -> None:
    """Add a row for each hand-off."""
    table.add_row(
        "[bold]recording", "RMSE mm: fitted, planned, averaged", "profile: time, length (before); turn, hand-off"
    )
    for name, demo in hand_offs():
        path = discretize(demo.tip_mm, choose_grid(demo.tip_mm))
        fit = fit_to_demo(replay(path, path.start), trace(demo, path))
        hand = hand_along(demo, fit, turning=True)
        planned = hand.at(int(hand.duration_s * RATE_HZ) + 2)[0]
        even, _ = followed(fit.tip_mm, SPEED_MM_S / RATE_HZ)
        averaged = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1]
        rmse = [rmse_mm(tip, demo.tip_mm) for tip in (fit.tip_mm, planned, averaged)]
        (now, at_length), (then, then_at_length) = profile(planned, demo), profile(even, demo)
        away = departure_of(demo)
        turn = "no orientation"
        if away is not None and hand.rotation_xyzw is not None and demo.rotation_xyzw is not None:
            ends = [
                tip[-1] + needle_tips_mm() @ matrix_of(turned[-1:])[0].T
                for tip, turned in ((hand.tip_mm, hand.rotation_xyzw), (demo.tip_mm, demo.rotation_xyzw))
            ]
            off_mm = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
            turn = f"{away.deg:.0f} degrees, {off_mm:.3f} mm ({away.handoff_needle_tip_mm:.1f})"
        table.add_row(
            name,
            ", ".join(f"{one:.2f}" for one in rmse),
            f"{now:.2f}, {at_length:.2f} ({then:.2f}, {then_at_length:.2f}); {turn}",
        )


def hand_offs() -> Iterator[tuple[str, Demo]]:
    """Yield every hand-off with a name."""
    for sample in sample_recordings():
        with TemporaryDirectory() as folder:
            file = Path(folder) / "sample.mcap"
            file.write_bytes(sample.data)
            yield from _of(file, sample.name, 1)
    if "SKILLS_PAPER_DATA" in os.environ:
        file = Path(os.environ["SKILLS_PAPER_DATA"]) / "psm_poses_500hz.csv"
        yield from _of(file, "paper's raw recording", OF_A_TRIAL, rate_hz=500.0)
    if "SKILLS_SAMPLE_RECORDINGS" in os.environ:
        for name in BAGS:
            yield from _of(Path(os.environ["SKILLS_SAMPLE_RECORDINGS"]) / name, Path(name).name, OF_A_TRIAL)
    if "SKILLS_TEST_JIGSAWS" in os.environ:
        (archive,) = Path(os.environ["SKILLS_TEST_JIGSAWS"]).glob("*.tar.xz")
        with TemporaryDirectory() as folder, tarfile.open(archive) as packed:
            for name in TRIALS:
                packed.extract(name, folder, filter="data")
                yield from _of(Path(folder) / name, Path(name).stem, OF_A_TRIAL)


def _of(path: Path, name: str, most: int, **given: float) -> Iterator[tuple[str, Demo]]:
    with path.open("rb") as file:
        recording = read_recording(file, **given)
    for part in propose_by_arm(recording)[:most]:
        demo = cut_demo(recording, arm=part.arm, start_s=part.start_s, end_s=part.end_s)
        yield f"{name} {part.arm} {part.start_s:.0f}-{part.end_s:.0f} s", demo


def rmse_mm(path_mm: np.ndarray, recorded_mm: np.ndarray) -> float:
    calm = without_rests(recorded_mm)
    step_mm = max(0.1, np.linalg.norm(np.diff(calm, axis=0), axis=1).sum() / 4000)
    apart = dtw(walked(path_mm, step_mm), walked(calm, step_mm)).differences_mm
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def profile(tip_mm: np.ndarray, demo: Demo) -> list[float]:
    """Return the correlation of the speeds of a motion, sampled evenly, with the recorded ones: over time, length."""
    half_s, stamps = TREMOR_S / 2, demo.stamps_s
    rested = np.concatenate((demo.tip_mm[:1], demo.tip_mm, demo.tip_mm[-1:]))
    recorded = smoothed_tip(np.concatenate(([-half_s], stamps, [stamps[-1] + half_s])), rested, TREMOR_S)[1]
    return [float(np.corrcoef(one, other)[0, 1]) for one, other in zip(_speeds(tip_mm), _speeds(recorded), strict=True)]


def _speeds(tip_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    speed, even = np.linalg.norm(np.gradient(tip_mm, axis=0), axis=1), np.linspace(0, 1, 401)
    length = np.append(0, np.cumsum(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)))
    return np.interp(even, np.linspace(0, 1, len(speed)), speed), np.interp(even, length / length[-1], speed)
