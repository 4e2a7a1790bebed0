"""What the figures are drawn from: a shipped sample, and the paper's data where it is.

The paper's data has no licence, so it is not in this package: `SKILLS_PAPER_DATA` names its folder. It holds the user's
path through the grid, the greedy actions of three published policies, and a raw recording of the study that belongs
to another path; the user's own recording was not published.
"""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from skills.errors import BadInput, BadPath
from skills.recordings import read_recording
from skills.seeds.recordings import sample_recordings
from skills.style import paper
from skills.style._arrays import Floats, Ints
from skills.style.demo import cut_demo
from skills.style.grid import PAPER_GRID, GridPath, discretize, fit_grid
from skills.style.segments import propose_segments

SAMPLE = "wren-simple-running"  # it crosses its own path, as the paper's user does
USER_PATH = "user_path_grid11.csv"
RAW = "psm_poses_500hz.csv"
POLICIES = tuple(f"published_policy_{number}.npy" for number in range(1, paper.N_POLICIES + 1))
ABSENT = (
    "THE PAPER'S DATA IS NOT HERE: all is drawn from the shipped sample alone. "
    "Set SKILLS_PAPER_DATA to the data's folder to see the paper's user and the published policies beside it."
)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A motion as it was recorded, (T, 3) mm, and its path through a grid."""

    tip_mm: Floats
    path: GridPath


@dataclass(frozen=True, eq=False)
class Source:
    """One demonstration.

    Attributes:
        name: Part of file names.
        title: Who demonstrated, for people.
        path: Through the paper's grid.
        recorded: What Fig. 6 shows as raw; of the paper's data another motion than `path`.
        published: Published policies: the action of each state, (n_states,) each; empty for a sample.
    """

    name: str
    title: str
    path: GridPath
    recorded: Recorded
    published: tuple[Ints, ...] = ()

    @property
    def recorded_elsewhere(self) -> bool:
        """Whether `recorded` is another motion than `path`."""
        return self.recorded.path is not self.path


def sample_source() -> Source:
    """Take wren's hand-off, as the service would propose it."""
    sample = next(one for one in sample_recordings() if one.name == SAMPLE)
    recording = read_recording(BytesIO(sample.data))
    segment = propose_segments(recording)[0]
    demo = cut_demo(recording, start_s=segment.start_s, end_s=segment.end_s)
    path = discretize(demo.tip_mm, PAPER_GRID)
    return Source("sample", "wren, a synthetic surgeon", path, Recorded(demo.tip_mm, path))


def paper_source(folder: Path | None) -> Source | None:
    """Take the paper's user and the published policies; None where no folder is named.

    Raises:
        BadInput: The folder is named and does not hold the data.
    """
    if folder is None or folder == Path():  # SKILLS_PAPER_DATA= is as good as unset
        return None
    missing = [name for name in (USER_PATH, RAW, *POLICIES) if not (folder / name).is_file()]
    if missing:
        raise BadInput(f"SKILLS_PAPER_DATA={folder} has no {', '.join(missing)}; correct it or unset it.")
    try:
        path = discretize(1000 * _table(folder / USER_PATH)[:, :3], PAPER_GRID)
        raw_mm = 1000 * _table(folder / RAW, header_rows=1)[:, 3:6]
        recorded = Recorded(raw_mm, discretize(raw_mm, fit_grid(raw_mm)))
        published = tuple(_actions(folder / name) for name in POLICIES)
    except (ValueError, BadPath) as error:
        raise BadInput(f"SKILLS_PAPER_DATA={folder} does not hold the paper's data: {error}") from error
    return Source("paper", "the paper's user", path, recorded, published)


def _table(file: Path, header_rows: int = 0) -> Floats:
    table = np.loadtxt(file, delimiter=",", skiprows=header_rows, ndmin=2)
    if table.shape[1] != 6:
        raise ValueError(f"{file.name} should have 6 columns.")
    return table


def _actions(file: Path) -> Ints:
    actions = np.load(file)
    if actions.shape != (PAPER_GRID.n_states,) or not np.isin(actions, range(paper.N_ACTIONS)).all():
        raise ValueError(f"{file.name} should hold an action from 0 to 26 for each of {PAPER_GRID.n_states} states.")
    return np.asarray(actions, np.int64)
