"""Learning with networks: repeatable, in a separate process, cancelled at once, with progress reports."""

import numpy as np
import pytest

import skills
from skills import deep
from skills.db.models import PolicyVersion
from skills.deep import NetworkLesson
from skills.errors import Conflict, LearningFailed
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.networks import DDPG, DQN, TRPO
from skills.learning.policy import rollout
from skills.library.operation.integrity import learnt
from tests.api.conftest import service, trained  # noqa: F401 - fixtures
from tests.api.service import KESTREL, POLICY, Service

pytestmark = pytest.mark.usefixtures("extra")
SMALL = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3))
REWARD = sparse_reward(GridPath(SMALL, SMALL.states_of([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1], [2, 2, 2]])))
QUICK = (
    DQN(steps=1500, width=32, batch=32, worlds=4),
    DDPG(steps=800, width=32, batch=32),
    TRPO(steps=1024, width=32, steps_per_update=256),
)
EACH = pytest.mark.parametrize("learner", QUICK, ids=lambda one: one.kind)


@EACH
def test_the_seed_determines_the_learnt_bytes_and_the_training_is_counted(learner):
    first, second, other = (skills.learn_policy(REWARD, learner, seed) for seed in (5, 5, 6))
    assert first.network == second.network and first.q.tobytes() == second.q.tobytes()
    assert first.network != other.network
    training = first.training
    assert training == second.training
    assert learner.steps <= training.steps < learner.steps + 2048
    assert training.updates > 0
    assert training.episodes == training.finished + training.out_of_steps > 0
    assert not training.settled and training.out_of_time == 0


@EACH
def test_numpy_answers_what_torch_answered(learner):
    import torch

    from skills.deep import trainer

    found: list = []
    kept = trainer._network
    trainer._network = lambda one, model: found.append(model) or kept(one, model)
    try:
        network = trainer.learn(NetworkLesson(REWARD, learner, 1)).network
    finally:
        trainer._network = kept
    (model,) = found
    if isinstance(learner, DQN):
        cells = SMALL.cells_of(np.arange(27))
        inputs = np.concatenate([np.eye(3)[axis] for axis in cells.T], axis=1)
        with torch.no_grad():
            theirs = model.q_net(model.q_net.obs_to_tensor(cells)[0]).numpy()
        ours = network.answer(inputs)
    else:
        inputs = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
        theirs, _ = model.predict(inputs, deterministic=True)
        answer = network.answer(inputs)
        ours = np.tanh(answer) if isinstance(learner, DDPG) else np.clip(answer, -1, 1)
    assert ours == pytest.approx(theirs, abs=1e-5)


def test_deep_q_learning_learns_a_small_grid_and_passes_the_gate():
    policy = skills.learn_policy(REWARD, DQN(steps=20_000, width=64, batch=128, gamma=0.6))
    certificate, _ = certify(policy)
    assert certificate.starts_reaching == 27
    assert certificate.every_action_optimal


def test_how_far_it_is_is_told_and_whoever_raises_there_ends_it():
    told: list[float] = []

    def tell(share: float) -> None:
        told.append(share)
        if share > 0.0:
            raise Conflict("enough")

    with pytest.raises(Conflict, match="enough"):
        skills.learn_policy(REWARD, DQN(steps=10_000_000), progress=tell)
    assert 0 < told[-1] < 0.5


def test_a_learner_that_takes_too_long_or_too_much_is_ended_with_advice():
    with pytest.raises(LearningFailed, match=r"did not finish within 3 s; request fewer steps"):
        skills.learn_policy(REWARD, DQN(steps=10_000_000), timeout_s=3.0)
    with pytest.raises(LearningFailed) as failed:
        skills.learn_policy(REWARD, DQN(steps=1000), memory_bytes=512 << 20)
    assert failed.value.numbers["cause"] in ("out of memory", "crashed", "failed")


def test_nonsense_from_the_process_is_no_policy(monkeypatch):
    monkeypatch.setattr(deep, "TARGET", "builtins:bytes")
    with pytest.raises(LearningFailed):
        skills.learn_policy(REWARD, DQN(steps=1000))


@EACH
def test_a_worker_learns_certifies_and_stores_it_and_it_rolls_out_the_same(service: Service, learner):  # noqa: F811
    from tests.api.service import CSV
    from tests.library import cases

    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    settings = {name: getattr(learner, name) for name in ("steps", "width", "batch")}
    job = service.train(learner={"kind": learner.kind, **settings})
    assert job["state"] == "succeeded" and job["progress"] == 1.0
    version = service.http.get(f"{POLICY}/versions/1").json()
    assert version["learner"] == learner.kind and version["settings"]["steps"] == learner.steps
    assert ("rollouts" in version) == (learner.kind != "dqn")
    with service.database.reading() as session:
        kept = learnt(session.query(PolicyVersion).one())
    again = skills.learn_policy(sparse_reward(kept.path), kept.learner, kept.seed)
    assert again.network == kept.network and again.q.tobytes() == kept.q.tobytes()
    start = kept.path.grid.centres_mm(1330)
    assert rollout(again, start).states.tolist() == rollout(kept, start).states.tolist()


def test_a_training_that_is_cancelled_ends_and_keeps_nothing(service: Service):  # noqa: F811
    import threading

    from tests.api.service import CSV
    from tests.library import cases

    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    asked = service.client.train(**KESTREL, learner={"kind": "dqn", "steps": 1_000_000})
    worker = threading.Thread(target=service.work)
    worker.start()
    for _ in range(600):
        worker.join(0.1)
        if service.client.job(asked["id"])["progress"] > 0:
            break
    service.client.cancel(asked["id"])
    worker.join(30)
    assert not worker.is_alive()
    ended = service.client.job(asked["id"])
    assert ended["state"] == "cancelled" and 0 < ended["progress"] < 1 and ended["result"] is None
    assert service.counts()["policy_versions"] == 0
