"""Cost of reading a file, measured in a fresh interpreter: seconds, peak memory, and the outcome."""

import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from skills.demonstration.demonstration import cut_demo
from skills.errors import SkillsError
from skills.formats.mcap import read_mcap
from skills.gridworld.grid import discretize, fit_grid
from tests.measured import peak_mib
from tests.waiting import END_S


@dataclass(frozen=True)
class Weight:
    """Seconds of processor time, the process's peak in MiB, imports included, and "read" or the error's name.

    `discretised_s` is the time for cutting and discretising the first arm, if the file was read.
    """

    outcome: str
    seconds: float
    peak_mib: float
    discretised_s: float = 0.0


def weigh(file: Path) -> Weight:
    """Read a file in a separate process."""
    command = [sys.executable, "-m", "tests.formats.weigh", str(file)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, check=True, timeout=END_S)
    return Weight(**json.loads(done.stdout))


def _weigh(path: str) -> Weight:
    began = time.process_time()
    try:
        with Path(path).open("rb") as file:
            recording = read_mcap(file)
    except SkillsError as error:
        return Weight(type(error).__name__, time.process_time() - began, peak_mib())
    read = time.process_time()
    tip_mm = cut_demo(recording, arm=recording.motions[0].arm).tip_mm
    discretize(tip_mm, fit_grid(tip_mm))
    return Weight("read", read - began, peak_mib(), time.process_time() - read)


if __name__ == "__main__":
    print(json.dumps(asdict(_weigh(sys.argv[1]))))
