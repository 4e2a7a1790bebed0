"""Cost of learning and its certificate on a cube of cells, measured in a fresh interpreter: time and peak memory.

The peak is Linux's VmHWM: the peak of `getrusage` starts at that of the process that starts a child.
"""

import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from tests.demonstration.synthetic import winding_path

TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (1, 1, 2)), np.array([0, 1]))
MIB = 1024.0  # of the kB in /proc


@dataclass(frozen=True)
class Cost:
    """Seconds of processor time, without compiling; the process's peak in MiB after each step, imports included.

    `certified` is whether all values were exact, from all starts.
    """

    learning_s: float
    learning_mib: float
    certificate_s: float
    certificate_mib: float
    certified: bool


def measured(side: int, waypoints: int) -> Cost:
    """Learn and certify, once, a path of a number of waypoints in a cube with a number of cells per side."""
    command = [sys.executable, "-m", "tests.measured", str(side), str(waypoints)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, check=True)
    return Cost(**json.loads(done.stdout))


def measure(side: int, waypoints: int) -> Cost:
    """Do the same in this process."""
    certify(learn_tabular(sparse_reward(TWO_CELLS), PhaseQLearning()))  # compiles
    reward = sparse_reward(winding_path(0, GridWorld((0.0, 0.0, 0.0), 1.0, (side, side, side)), waypoints))
    began = time.process_time()
    policy = learn_tabular(reward, PhaseQLearning())
    learnt, learning_mib = time.process_time(), peak_mib()
    certificate, _ = certify(policy)
    exact = certificate.every_action_optimal and certificate.demonstration_reproduced
    return Cost(
        learning_s=learnt - began,
        learning_mib=learning_mib,
        certificate_s=time.process_time() - learnt,
        certificate_mib=peak_mib(),
        certified=exact and certificate.starts_joining_nearest == certificate.starts,
    )


def peak_mib(pid: int | str = "self") -> float:
    """Return the peak resident memory of a process so far, by default of this one, in MiB."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / MIB


if __name__ == "__main__":
    print(json.dumps(asdict(measure(*map(int, sys.argv[1:])))))
