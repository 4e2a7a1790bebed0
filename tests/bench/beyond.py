"""The deep learners compared with the tabular ones and with plain replay: their results and their cost.

    python -m tests.bench learners                       # small budgets: a minute each
    python -m tests.bench.beyond dqn steps=800000 seed=0 # one of them alone, as JSON

Each learns in a separate interpreter, so that the peak memory is its own: that of the process, libraries included. The
learnt policy is packed, unpacked, compared bit by bit and rolled out again before it is measured.
"""

import json
import subprocess
import sys
import time
from dataclasses import asdict
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from skills import packing
from skills.db import models  # noqa: F401 - declares what is stored
from skills.db.packed import pack, unpack_as
from skills.deep import KNOWN, NEEDED, NetworkLesson
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning import policy as table_policy
from skills.learning.certificate import certify
from skills.learning.evaluation import check_in_space, measure
from skills.learning.networks import DDPG, DQN, TRPO, network_q
from skills.learning.policy import LEARNERS, Learner, Policy, rollout_from
from skills.learning.slip_runs import replay
from skills.report.numbers import paper_source, sample_source
from skills.settings import Settings
from tests.demonstration.synthetic import winding_path
from tests.measured import TWO_CELLS, measured, peak_mib

SMALL = {"dqn": 60_000, "ddpg": 40_000, "trpo": 150_000}  # about a minute on one core each
SIZES = ((11, 40), (21, 100), (51, 400), (101, 400))  # cells per side, waypoints


def learners(table: Table) -> None:
    """Compare all learners on one demonstration, and the table in larger grids."""
    for kind in LEARNERS:
        if kind in SMALL and any(find_spec(name) is None for name in NEEDED):
            table.add_row(kind, "THE EXTRA 'deep' IS NOT INSTALLED", "")
            continue
        found = apart(kind, **({"steps": SMALL[kind]} if kind in SMALL else {}))
        table.add_row(kind, f"{found['wall_s']:.2f} s", in_words(found))
    source = paper_source(Settings().paper_data) or sample_source()
    again = [measure(replay(source.path, state)).dtw_total_mm for state in (source.path.start,)]
    table.add_row("replay of the demonstration", "", f"{source.path.grid.n_states} starts, DTW {again[0]:g} mm")
    for side, waypoints in SIZES:
        cost = measured(side, waypoints)
        about = f"peak {cost.certificate_mib:.0f} MiB with its certificate"
        table.add_row(f"table, {side} cells a side", f"{cost.learning_s + cost.certificate_s:.2f} s", about)


def in_words(found: dict[str, Any]) -> str:
    """Format one line of measurements."""
    space = found["space"]
    wandered = f"; in the space {space['reached']} of {space['starts']}" if space else ""
    return (
        f"{found['starts_reaching']} of {found['starts']} starts, {found['exact_states']} exact, DTW "
        f"{found['dtw_total_mm']:g} mm{wandered}; {found['training']['steps']} moves, peak {found['peak_mib']:.0f} MiB"
    )


def apart(kind: str, **settings: float) -> dict[str, Any]:
    """Learn with one learner in a separate interpreter."""
    asked = [f"{name}={value}" for name, value in settings.items()]
    command = [sys.executable, "-m", "tests.bench.beyond", kind, *asked]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, check=True)
    return dict(json.loads(done.stdout))


def one(kind: str, seed: int = 0, side: int = 0, waypoints: int = 0, **settings: Any) -> dict[str, Any]:
    """Learn with one learner in this process and measure the result; `side` is the cells per side of a cube."""
    learner = LEARNERS[kind](**settings)
    reward = sparse_reward(demonstration(side, waypoints))
    table_policy.learn_tabular(sparse_reward(TWO_CELLS), LEARNERS["phase-q-learning"]())  # compiles
    if isinstance(learner, DQN | DDPG | TRPO):
        import skills.deep.trainer  # noqa: F401 - torch is loaded before the clock starts
    wall, processor = time.perf_counter(), time.process_time()
    policy = learnt(reward, learner, seed)
    wall_s, cpu_s, peak = time.perf_counter() - wall, time.process_time() - processor, peak_mib()
    back = unpack_as(Policy, pack(policy))
    start = policy.path.start
    assert back.network == policy.network and back.q.tobytes() == policy.q.tobytes()
    assert np.array_equal(rollout_from(back, start).states, policy.replay.states)
    space = check_in_space(back)
    assert space == check_in_space(policy)
    certificate, _ = certify(back)
    told = measure(back.replay)
    return {
        "kind": kind,
        "seed": seed,
        "settings": asdict(learner),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "peak_mib": peak,
        "training": asdict(policy.training),
        "starts": certificate.starts,
        "starts_reaching": certificate.starts_reaching,
        "suboptimal": certificate.suboptimal,
        "checked": certificate.checked,
        "finished": back.replay.finished,
        "exact_states": told.exact_states,
        "path_states": told.path_states,
        "dtw_total_mm": told.dtw_total_mm,
        "network_bytes": 0 if policy.network is None else len(policy.network.tensors),
        "q_bytes": policy.q.nbytes,
        "space": None if space is None else asdict(space),
        "reloads_bit_equal": True,
    }


def demonstration(side: int, waypoints: int) -> GridPath:
    """Return the paper's demonstration, or a sample's if that is absent, or a winding one in a cube."""
    if side:
        return winding_path(0, GridWorld((0.0, 0.0, 0.0), 5.0, (side, side, side)), waypoints)
    return (paper_source(Settings().paper_data) or sample_source()).path


def learnt(reward: RewardMap, learner: Learner, seed: int) -> Policy:
    """Learn in this process, as the service's learning process does."""
    if not isinstance(learner, DQN | DDPG | TRPO):
        return table_policy.learn_tabular(reward, learner, seed)
    from skills.deep import trainer

    request, answer = BytesIO(), BytesIO()
    packing.write(request, NetworkLesson(reward, learner, seed), KNOWN)
    trainer.train(request, answer)
    found = packing.read(answer, KNOWN)
    q = network_q(reward, learner, found.network)
    return Policy(reward.path, reward.levels, learner, seed, found.training, q, found.network)


if __name__ == "__main__":
    given = dict(setting.split("=") for setting in sys.argv[2:])
    print(json.dumps(one(sys.argv[1], **{name: json.loads(value) for name, value in given.items()})))
