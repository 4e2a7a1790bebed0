"""The share of the demonstration that starts follow, by joining rule: the paper's user, real bags, the samples."""

from collections.abc import Iterator
from io import BytesIO

from rich.table import Table

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import propose_segments
from skills.formats import read_recording
from skills.gridworld.grid import GridPath, choose_grid, discretize
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import NearLimits, certify, near_starts
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.report.numbers import paper_source
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings

RULES = (0.0, 0.5, 0.8, 1.0)
REAL = ("rosbag2/rosbag2.mcap", "old_transform_stamped.mcap", "calibration/pitch_exp_traj_02_test_cropped.bag")
RADII_MM = (NearLimits().radius_mm, 5.0, 7.5)


def joining(table: Table) -> None:
    """Learn each path by each rule; print shares, starts that see the goal alone, and shares near the start."""
    for name, path in paths():
        for rule in RULES:
            policy = learn_tabular(sparse_reward(path), PhaseQLearning(join_share=rule))
            certificate, covered = certify(policy)
            assert covered.share is not None
            assert certificate.every_action_optimal and certificate.starts_reaching == certificate.starts
            near = [near_starts(policy, covered.share, NearLimits(radius_mm)).share for radius_mm in RADII_MM]
            table.add_row(
                f"{name}, {len(path.states)} states, join {rule:g}",
                f"mean {certificate.mean_share:.1%}, median {certificate.median_share:.1%}",
                f"goal alone {certificate.starts_goal_alone} of {certificate.starts}; near "
                + ", ".join(f"{share:.0%}" for share in near),
            )


def paths() -> Iterator[tuple[str, GridPath]]:
    """Yield the paths by name; the paper's user and the real recordings only where the settings name their folders."""
    theirs = paper_source(Settings().paper_data)
    if theirs is not None:
        yield "the paper's user", theirs.path
    folder = Settings().sample_recordings
    for file in REAL if folder is not None else ():
        recording = read_recording(BytesIO((folder / file).read_bytes()))
        part = propose_segments(recording)[0]
        demo = cut_demo(recording, start_s=part.start_s, end_s=part.end_s)
        yield file, discretize(demo.tip_mm, choose_grid(demo.tip_mm))
    for sample in sample_recordings():
        start_s, end_s = sample.segments[0]
        demo = cut_demo(read_recording(BytesIO(sample.data)), start_s=start_s, end_s=end_s)
        yield f"sample of {sample.surgeon}", discretize(demo.tip_mm, choose_grid(demo.tip_mm))
