"""A rollout by the rules in the OpenAPI document's description of `Policy` alone, compared with the library's."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from skills.client import Client
from skills.seeds.recordings import sample_recordings


def rolled_out(policy: dict[str, Any], start: int) -> tuple[list[int], bool]:
    """Follow the policy from a state, with nothing but the JSON and the rules in the description of `Policy`."""
    nx, ny, nz = policy["grid"]["shape"]
    waypoints, actions = policy["waypoints"], policy["actions"]
    last, phased = len(waypoints) - 1, policy["phases"] > 1
    state, phase, states = start, 0, [start]
    if phased and state in waypoints:
        phase = waypoints.index(state) + 1
        if phase == last + 1:
            return states, True
    while len(states) < 10_000:
        action = actions[phase][state]
        if action == -1:
            return states, True
        if action == -2:
            return states, False
        a, b, c = action // 9, action // 3 % 3, action % 3
        x, y, z = state // (ny * nz) + a - 1, state // nz % ny + b - 1, state % nz + c - 1
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            state = (x * ny + y) * nz + z
            if phase == 0 and state == waypoints[-1]:
                return [*states, state], True
            if phased and phase == 0 and state in waypoints:
                phase = waypoints.index(state) + 1
            elif phase > 0 and state == waypoints[phase]:
                if phase == last:
                    return [*states, state], True
                phase += 1
        states.append(state)
    return states, False


@pytest.mark.nightly  # every start, by a client that shares no code with ours
@pytest.mark.parametrize("learner", ["phase-q-learning", "cell-q-learning"])
def test_a_client_of_the_interface_alone_rolls_out_like_the_library(client: Client, learner: str) -> None:
    sample = next(s for s in sample_recordings() if s.surgeon == "wren")  # its path crosses itself
    client.put_surgeon(sample.surgeon)
    client.add_demo(sample.data, surgeon=sample.surgeon, suture=sample.suture)
    result = client.wait(client.train(sample.surgeon, sample.suture, learner={"kind": learner})).result
    assert result is not None
    policy = client.get_json(f"/policies/{sample.surgeon}/{sample.suture}/versions/{result['policy_version']}")
    origin, cell = np.array(policy["grid"]["origin_mm"]), policy["grid"]["cell_mm"]
    assert len(policy["waypoints"]) > len(set(policy["waypoints"]))
    for state, ijk in enumerate(product(*map(range, policy["grid"]["shape"]))):
        states, finished = rolled_out(policy, state)
        start_mm = (origin + cell * np.array(ijk)).tolist()
        answer = client.rollout(sample.surgeon, sample.suture, start_mm, version=policy["version"])
        assert (answer.states, answer.finished) == (states, finished), state
        assert finished
    if policy["phases"] > 1:
        assert rolled_out(policy, policy["waypoints"][0]) == (policy["waypoints"], True)
