"""Fig. 6: what rounding a recorded motion to the grid keeps of it."""

from dataclasses import dataclass

from skills.report.sources import Recorded
from skills.style.evaluation import discretisation_rmse


@dataclass(frozen=True)
class Discretised:
    """A motion of so many samples as a path; the RMSE is of the samples against the centres of their cells."""

    samples: int
    states: int
    revisits: int
    bridged: int
    cell_mm: float
    rmse_mm: tuple[float, float, float]


def compare_path(recorded: Recorded) -> Discretised:
    """Compare a recorded motion with its path."""
    path = recorded.path
    return Discretised(
        samples=len(recorded.tip_mm),
        states=len(path.states),
        revisits=path.revisits,
        bridged=path.bridged,
        cell_mm=path.grid.cell_mm,
        rmse_mm=discretisation_rmse(recorded.tip_mm, path.grid),
    )
