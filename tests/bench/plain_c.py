"""Q-learning in straightforward C, as a reference for speed: a scan of the 27 actions for every maximum."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from skills.gridworld.reward import RewardMap

SOURCE = r"""
#include <stdint.h>
void learn(double *q, const double *rewards, const int64_t *shape, const int64_t *starts, int64_t episodes,
           int64_t goal, double off_grid, double alpha, double gamma, int64_t max_steps, uint64_t random) {
  const int nx = shape[0], ny = shape[1], nz = shape[2];
  for (int64_t e = 0; e < episodes; e++) {
    int s = starts[e], x = s / (ny * nz), y = s / nz % ny, z = s % nz;
    for (int64_t step = 0; step < max_steps; step++) {
      random ^= random << 13; random ^= random >> 7; random ^= random << 17;
      const int a = (int)(((random & 0xffffffffULL) * 27) >> 32);
      int tx = x + a / 9 - 1, ty = y + a / 3 % 3 - 1, tz = z + a % 3 - 1, to = s, done = 0;
      double target = off_grid;
      if (tx >= 0 && ty >= 0 && tz >= 0 && tx < nx && ty < ny && tz < nz) {
        to = (tx * ny + ty) * nz + tz; x = tx; y = ty; z = tz;
        target = rewards[to]; done = to == goal;
      }
      if (!done) {
        const double *next = q + 27 * to;
        double most = next[0];
        for (int b = 1; b < 27; b++) if (next[b] > most) most = next[b];
        target += gamma * most;
      }
      q[27 * s + a] += alpha * (target - q[27 * s + a]);
      s = to;
      if (done) break;
    }
  }
}
"""
EPISODES, MAX_STEPS = 5000, 100


def plain_c() -> Callable[[RewardMap], object] | None:
    """Compile it: a function that learns the paper's budget once, or None without a C compiler."""
    if shutil.which("cc") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "learn.c", Path(folder) / "learn.so"
        source.write_text(SOURCE)
        subprocess.run(["cc", "-O3", "-march=native", "-shared", "-fPIC", "-o", library, source], check=True)
        learn = ctypes.CDLL(str(library)).learn

    def run(reward: RewardMap) -> object:
        grid = reward.path.grid
        q, shape = np.zeros((grid.n_states, 27)), np.array(grid.shape)
        starts = np.random.default_rng(0).integers(grid.n_states, size=EPISODES)
        at = [ctypes.c_void_p(array.ctypes.data) for array in (q, reward.rewards, shape, starts)]
        number, real = ctypes.c_int64, ctypes.c_double
        learn(
            *at,
            number(EPISODES),
            number(reward.path.goal),
            real(-1),
            real(1),
            real(0.1),
            number(MAX_STEPS),
            ctypes.c_uint64(88172645463325252),
        )
        return q

    return run
