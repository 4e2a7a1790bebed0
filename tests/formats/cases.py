"""`python -m tests.formats.cases FOLDER`: what becomes of inputs made after public bug reports, as a table.

FOLDER has a folder for each input, and a README.md whose table has the columns folder, input, before and right.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.quality import describe
from skills.errors import BadColumns, SkillsError
from skills.formats.lerobot.cut import choose_episodes, cut_episode, find_dataset
from skills.formats.parsed import ParsedContent, parse_recording
from skills.formats.upload import find_bag, prepare_upload
from skills.gridworld.grid import choose_grid, discretize

_ROW = re.compile(r"^\| ([0-9][\w-]+) \| (.*?) \| (.*?) \| (.*?) \|$", re.MULTILINE)


def listed(folder: Path) -> dict[str, tuple[str, str, str]]:
    """Return the input, what became of it before, and what is right, by the names of the folders."""
    return {
        name: (made, before, right) for name, made, before, right in _ROW.findall((folder / "README.md").read_text())
    }


def outcome(case: Path) -> str:
    """Send an input as a user does, cut all of its first arm and put it in a grid; return what became of it."""
    try:
        (path,) = case.iterdir()
        with find_dataset(path) as dataset:
            if dataset is None:
                return _outcome_of_bag(path)
            outcomes = []
            for episode in choose_episodes(dataset, "all"):
                with TemporaryFile() as out:
                    cut_episode(dataset, episode, out)
                    outcomes.append(_outcome(out))
            return "; ".join(outcomes)
    except SkillsError as refused:
        return f"refused: {refused}"


def _outcome_of_bag(path: Path) -> str:
    with _sent(path) as file:
        return _outcome(file)


@contextmanager
def _sent(path: Path) -> Iterator[BinaryIO]:
    with prepare_upload(find_bag(path)) as ready, ready.open("rb") as file:
        yield file


def _outcome(file: BinaryIO) -> str:
    parsed = _parsed(file)
    recording, about = parsed.recording, parsed.about
    motion = recording.motions[0]
    rate = about.quality[0].rate_hz or 0.0
    told = [f"{len(motion.stamps_ns)} poses in {recording.duration_s:.2f} s, {rate:.3g} Hz, {recording.integrity}"]
    told += [f"jaws {len(recording.jaws)}"] * bool(recording.jaws)
    told += [f"{one.topic}: {one.backward_stamps} dropped" for one in about.dropped]
    told += [f"left out: {topic}" for topic, _ in recording.left_out]
    told += [f"{name}: {value[:60]}" for name, value in recording.notes if name == "stamps"]
    try:
        demo = cut_demo(recording, arm=motion.arm)
        discretize(demo.tip_mm, choose_grid(demo.tip_mm, "auto", 5.0))
        return "; ".join([*told, f"at most {describe(demo).speed_peak_mm_s:.0f} mm/s"])
    except SkillsError as refused:
        return f"{'; '.join(told)}; refused when cut: {refused}"


def _parsed(file: BinaryIO) -> ParsedContent:
    try:
        return parse_recording(file)
    except BadColumns as asked:
        if "in which frame" not in asked.message:
            raise
        return parse_recording(file, frame="base")


if __name__ == "__main__":
    cases = Path(sys.argv[1])
    print("| folder | input | before | right | now |\n|---|---|---|---|---|")
    for name, row in listed(cases).items():
        print(f"| {' | '.join([name, *row, outcome(cases / name)])} |")
