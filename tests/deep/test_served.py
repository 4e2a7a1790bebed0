"""A policy with a network is stored, certified, released, served, planned, played and checked like any other.

The networks here are written by hand. So the tests show that torch is needed neither here nor after training.
"""

import io
from dataclasses import asdict

import numpy as np
import pytest

from skills.client import Client
from skills.db.models import PolicyVersion
from skills.db.packed import unpack_as
from skills.demonstration.demonstration import Demo
from skills.errors import Conflict
from skills.gridworld.domain import Domain
from skills.gridworld.reward import RewardMap
from skills.learning.certificate import NearLimits
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.evaluation import SpaceRollouts
from skills.learning.networks import DDPG, DQN, Deep, Network, network_q
from skills.learning.policy import Policy, rollout
from skills.learning.q_learning import Training
from skills.library.operation.inspection import inspect_installation
from skills.library.operation.integrity import learnt
from skills.library.policies import releases
from skills.library.policies.learning import certified, lessons, store_style
from skills.library.policies.requests import TrainingRequest
from skills.library.recordings.demos import find_demo
from tests.api.conftest import service  # noqa: F401 - a fixture
from tests.api.service import CSV, GOAL_MM, KESTREL, POLICY, Service
from tests.deep.networks import always, table_as_network
from tests.library import cases

DEEP_RUNS = Training(1000, 250, 20, 15, 5, 0, settled=False)


def exact_network(reward: RewardMap) -> Network:
    """Return the network that DQN would learn in the limit."""
    mdp = Mdp(Domain(reward.path, phased=False), reward, DQN().gamma)
    return table_as_network(reward.path.grid, exact_q(mdp))


def store(service: Service, learner: Deep, network: Network | None = None) -> PolicyVersion:  # noqa: F811
    """Store a possible result of a learner, as a training does."""
    demo = service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    request = TrainingRequest(**KESTREL, demos=[demo["sha256"]], learner=learner, near=NearLimits())
    with service.database.reading() as session:
        (lesson,) = lessons(session, [find_demo(session, demo["sha256"]).row])
    reward = unpack_as(RewardMap, lesson.reward)
    network = network or exact_network(reward)
    q = network_q(reward, learner, network)
    policy = Policy(reward.path, reward.levels, learner, 0, DEEP_RUNS, q, network)
    kept = certified(lesson, request, unpack_as(Demo, lesson.demo), policy)
    with service.database.writing() as session:
        return session.get_one(PolicyVersion, store_style(session, kept).row)


@pytest.fixture
def served(service: Service) -> Service:  # noqa: F811
    service.client.put_surgeon("kestrel")
    version = store(service, DQN(steps=1000))
    with service.database.writing() as session:
        releases.release(session, session.get_one(PolicyVersion, version.row), "test")
    return service


def test_it_passes_the_same_gate_is_released_and_is_served(served: Service):
    policy = served.client.policy(**KESTREL)
    assert (policy["learner"], policy["phases"]) == ("dqn", 1)
    assert policy["settings"] == asdict(DQN(steps=1000))
    assert policy["training"]["updates"] == 250
    assert policy["grid_certificate"]["suboptimal_actions"] == 0
    assert policy["coverage"]["starts_reaching_goal"] == policy["coverage"]["n_states"] == 1331
    assert policy["rollouts"] is None  # it was learnt on the grid
    followed = served.client.rollout(**KESTREL, start_mm=[20.0, 75.0, -90.0])
    assert followed["finished"]
    assert served.client.next(**KESTREL, position_mm=[20.0, 75.0, -90.0], phase=0)["action"] is not None
    assert served.client.policy_card(**KESTREL, version=1)["learner"]["kind"] == "dqn"
    assert served.client.versions(**KESTREL)[0]["learner"] == "dqn"


def test_its_network_is_among_the_arrays_and_whoever_fetches_it_can_run_it(served: Service):
    client = Client(served.http)
    fetched = client.learnt(**KESTREL)
    with served.database.reading() as session:
        kept = learnt(session.query(PolicyVersion).one())
    assert fetched.network == kept.network and fetched.q.tobytes() == kept.q.tobytes()
    with np.load(io.BytesIO(client.policy_arrays(client.policy(**KESTREL).sha256)), allow_pickle=False) as arrays:
        network = Network(arrays["network"].tobytes())
    one_hot = np.concatenate([np.eye(11)[0]] * 3)
    assert network.answer(one_hot[None])[0].tolist() == fetched.q[0].tolist()
    start_mm = (-30.0, 25.0, -140.0)
    assert rollout(fetched, start_mm).states.tolist() == client.rollout(**KESTREL, start_mm=start_mm).states


def test_inspection_accepts_the_installation_and_finds_a_changed_network(served: Service):
    assert [wrong for checked in inspect_installation(served.database) for wrong in checked.wrong] == []
    served.tamper("UPDATE policy_versions SET learnt = (SELECT map FROM reward_maps LIMIT 1)")
    assert [wrong for checked in inspect_installation(served.database) for wrong in checked.wrong]


@pytest.mark.nightly  # a plan does not know by which learner its policy was learnt
@pytest.mark.needs("simulator")
def test_its_plan_is_played_in_the_simulator(served: Service):
    plan = served.client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")
    asked = served.client.play(plan["id"])
    served.work()
    played = served.client.job(asked["id"])
    assert played["state"] == "succeeded", played
    assert served.client.playback(played["result"]["playback"])["feasible"]


def test_a_continuous_policy_reports_its_rollouts_and_is_not_released(service: Service):  # noqa: F811
    service.client.put_surgeon("kestrel")
    version = store(service, DDPG(), always((0.0, 0.0, 0.0)))
    told = service.http.get(f"{POLICY}/versions/1").json()
    assert SpaceRollouts(**told["rollouts"]).reached < 20
    assert told["rollouts"]["starts"] == 1000 and not told["rollouts"]["demonstrated_start_reached"]
    assert "greedy actions are not optimal" in told["grid_certificate"]["refused_because"][0]["text"]
    with service.database.writing() as session, pytest.raises(Conflict, match="not optimal"):
        releases.release(session, session.get_one(PolicyVersion, version.row), "test")
    assert Client(service.http).learnt(**KESTREL, version=1).network == always((0.0, 0.0, 0.0))


@pytest.mark.nightly  # a page; by day tests/api/test_pages.py
def test_the_page_sets_learners_beside_each_other(served: Service):
    store(served, DDPG(), always((0.0, 0.0, 0.0)))
    page = served.http.get(f"/pages/styles/kestrel/{KESTREL['suture']}?version=1&beside=2").text
    for said in ("dqn", "ddpg", "Moves made to learn it", "Starts that reach the goal without a grid", "discount"):
        assert said in page, said
