"""`python -m tests.formats.gathered FOLDER`: gather the recordings of the table in docs/recordings.md in a folder.

samples/     this project's samples, also as tables and as LeRobot datasets
recordings/  from SKILLS_SAMPLE_RECORDINGS
paper/       from SKILLS_PAPER_DATA
jigsaws/     three trials from SKILLS_TEST_JIGSAWS, of which one is empty
"""

import os
import shutil
import sys
import tarfile
from pathlib import Path

from skills.seeds.recordings import sample_recordings
from tests.formats import lerobots, written
from tests.formats.others import zipped

TRIALS = (
    "knot_tying/Knot_Tying_B001.txt",
    "knot_tying/Knot_Tying_H002.txt",
    "needle_passing/Needle_Passing_B001.txt",
)


def gather_samples(folder: Path) -> None:
    """Write the part that needs no other data."""
    samples = folder / "samples"
    samples.mkdir(parents=True)
    for one in sample_recordings():
        (samples / f"{one.name}.mcap").write_bytes(one.data)
    (samples / "hand-off.csv").write_text(written.positions())
    (samples / "ee_csv.csv").write_text(written.ee_csv())
    (samples / "joints.csv").write_text(written.joints())
    (samples / "lerobot-v2.1.zip").write_bytes(zipped(lerobots.dataset("v2.1")))
    lerobots.write(lerobots.dataset("v3.0"), samples / "lerobot-v3.0")


def gather_others(folder: Path) -> None:
    """Copy the real recordings."""
    for name, setting in (("recordings", "SKILLS_SAMPLE_RECORDINGS"), ("paper", "SKILLS_PAPER_DATA")):
        shutil.copytree(os.environ[setting], folder / name, copy_function=shutil.copyfile)
    (archive,) = Path(os.environ["SKILLS_TEST_JIGSAWS"]).glob("*.tar.xz")
    with tarfile.open(archive) as packed:
        for name in TRIALS:
            packed.extract(name, folder / "jigsaws", filter="data")


if __name__ == "__main__":
    gather_samples(Path(sys.argv[1]))
    gather_others(Path(sys.argv[1]))
