"""The training process: Stable-Baselines3 in our environments, from a serialised request to a serialised response.

It runs in one thread, because the networks are small, so that two threads would wait for each other, and because sums
are then computed in the same order each time. Every random number comes from the seed.
"""

import sys
from collections.abc import Callable
from typing import Any, BinaryIO

import gymnasium
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium.wrappers import RescaleObservation
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from skills import packing
from skills.deep import KNOWN, LearntNetwork, NetworkLesson
from skills.deep.environments import GRID, SPACE
from skills.learning.networks import DDPG, DQN, TRPO, Deep, Network
from skills.learning.q_learning import Training

REMEMBERED = 400_000  # the latest moves: 100 MB, and each cell of the paper's grid three hundred times
FIRST = 2000  # moves before the first update, so that the first batches do not repeat the same few moves
SLOWEST = 0.02  # DQN's last learning rate, as a share of the first
SPREAD = -0.5  # log of the standard deviation, in cells, with which TRPO starts to explore
TOLD = 200  # number of progress reports


def train(given: BinaryIO, answer: BinaryIO) -> None:
    """Read a `NetworkLesson`, train its network, and write a `LearntNetwork`."""
    lesson = packing.read(given, KNOWN)
    assert isinstance(lesson, NetworkLesson)
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)  # the same settings and seed give the same bytes
    packing.write(answer, learn(lesson), KNOWN)


def learn(lesson: NetworkLesson) -> LearntNetwork:
    """Train a network, and count the steps, updates and episodes."""
    learner = lesson.learner
    # The libraries accept seeds of 32 bits only.
    seed = int(np.random.SeedSequence(lesson.seed).generate_state(1)[0] >> 1)
    worlds = DummyVecEnv([_world(lesson)] * learner.worlds)
    model = _MODELS[type(learner)](learner, worlds, seed)
    counted = _Counted(learner.steps)
    model.learn(learner.steps, callback=counted)
    training = Training(
        steps=model.num_timesteps,
        updates=model._n_updates,
        episodes=counted.finished + counted.out_of_steps,
        finished=counted.finished,
        out_of_steps=counted.out_of_steps,
        out_of_time=0,
        settled=False,
    )
    return LearntNetwork(_network(learner, model), training)


def _world(lesson: NetworkLesson) -> Callable[[], Any]:
    learner = lesson.learner
    if isinstance(learner, DQN):
        return lambda: gymnasium.make(GRID, reward=lesson.reward, disable_env_checker=True)
    space = {"reward": lesson.reward, "gamma": learner.discount, "disable_env_checker": True}
    return lambda: RescaleObservation(gymnasium.make(SPACE, **space), np.float32(-1), np.float32(1))


class _Counted(BaseCallback):
    """Callback that counts episodes by how they ended, and reports the progress on stderr."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps, self.told = steps, 0
        self.finished = self.out_of_steps = 0

    def _on_step(self) -> bool:
        ended = np.flatnonzero(self.locals["dones"])
        cut = sum(bool(self.locals["infos"][one].get("TimeLimit.truncated")) for one in ended)
        self.finished += len(ended) - cut
        self.out_of_steps += cut
        done = self.num_timesteps / self.steps
        if done * TOLD >= self.told:
            self.told += 1
            print(f"progress {min(done, 1.0):.4f}", file=sys.stderr, flush=True)
        return True


def _common(learner: Deep, seed: int) -> dict[str, Any]:
    hidden = {"net_arch": [learner.width] * 2, "activation_fn": torch.nn.ReLU}
    return {"batch_size": learner.batch, "policy_kwargs": hidden, "seed": seed, "device": "cpu"}


def _dqn(learner: DQN, worlds: DummyVecEnv, seed: int) -> Any:
    return stable_baselines3.DQN(
        "MlpPolicy",
        worlds,
        learning_rate=lambda left: learner.learning_rate * max(left, SLOWEST),
        gamma=learner.gamma,
        target_update_interval=learner.target_every,
        exploration_initial_eps=1.0,
        exploration_final_eps=1.0,
        **_replay(learner),
        **_common(learner, seed),
    )


def _ddpg(learner: DDPG, worlds: DummyVecEnv, seed: int) -> Any:
    return stable_baselines3.DDPG(
        "MlpPolicy",
        worlds,
        learning_rate=learner.learning_rate,
        gamma=learner.discount,
        action_noise=NormalActionNoise(np.zeros(3), np.full(3, learner.noise)),
        **_replay(learner),
        **_common(learner, seed),
    )


def _replay(learner: DQN | DDPG) -> dict[str, Any]:
    """Return the settings of the replay memory, and the frequency of updates in steps of all environments together."""
    moves, updates = (
        max(1, learner.steps_per_update // learner.worlds),
        max(1, learner.worlds // learner.steps_per_update),
    )
    return {
        "buffer_size": max(learner.worlds, min(REMEMBERED, learner.steps)),
        "learning_starts": min(FIRST, learner.steps // 10),
        "train_freq": moves,
        "gradient_steps": updates,
    }


def _trpo(learner: TRPO, worlds: DummyVecEnv, seed: int) -> Any:
    common = _common(learner, seed)
    common["policy_kwargs"]["log_std_init"] = SPREAD
    return sb3_contrib.TRPO(
        "MlpPolicy",
        worlds,
        learning_rate=learner.learning_rate,
        gamma=learner.discount,
        n_steps=max(2, learner.steps_per_update // learner.worlds),
        target_kl=learner.trust,
        **common,
    )


_MODELS: dict[type[Deep], Callable[..., Any]] = {DQN: _dqn, DDPG: _ddpg, TRPO: _trpo}


def _network(learner: Deep, model: Any) -> Network:
    """Return the network that acts, without the critic."""
    if isinstance(learner, DQN):
        acting = [model.q_net.q_net]
    elif isinstance(learner, DDPG):
        acting = [model.actor.mu]
    else:
        acting = [model.policy.mlp_extractor.policy_net, model.policy.action_net]
    layers = [one for part in acting for one in part.modules() if isinstance(one, torch.nn.Linear)]
    return Network.of([(one.weight.detach().numpy(), one.bias.detach().numpy()) for one in layers])
