"""Verification of a fetched policy: it is reassembled and compared with its digest before anything follows it."""

import copy
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import skills
from skills.client.blocking.client import Client
from skills.errors import BadInput, Corrupt
from skills.schemas import policy_document
from tests.api.service import KESTREL, POLICY
from tests.client.peers import rebuilt
from tests.library import cases

Fetched = tuple[dict[str, Any], bytes, dict[str, Any]]


@pytest.fixture(scope="module")
def client(still) -> Client:
    return Client(still.http)


@pytest.fixture(scope="module")
def fetched(client: Client) -> Fetched:
    about = client.get_json(POLICY)
    return about, client.policy_arrays(about["sha256"]), client.get_json(f"/demos/{about['demos'][0]}")


def test_it_can_be_followed_here_and_goes_where_the_service_goes(client: Client):
    policy = client.learnt(**KESTREL)
    for start in ((-30.0, 25.0, -140.0), (20.0, 75.0, -90.0), tuple(client.policy(**KESTREL).start_mm)):
        followed = client.rollout(**KESTREL, start_mm=start)
        assert skills.rollout(policy, start).states.tolist() == followed.states


def leaves(of: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every single number, string and boolean of a document."""
    if isinstance(of, dict | list):
        for key, value in of.items() if isinstance(of, dict) else enumerate(of):
            yield from leaves(value, (*path, key))
    else:
        yield path


def changed(document: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
    other = copy.deepcopy(document)
    *way, last = path
    place: Any = other
    for key in way:
        place = place[key]
    place[last] = {bool: lambda v: not v, int: lambda v: v + 1, float: lambda v: v + 2.0**-20}.get(
        type(place[last]), lambda v: f"{v}!"
    )(place[last])
    return other


FREE = {
    "version",
    "created_at",
    "released_at",
    "released_by",
    "arrays",
}  # they describe its history, not its content


@pytest.mark.parametrize("of", [4, pytest.param(1, marks=pytest.mark.nightly)])
def test_nothing_that_is_said_of_it_can_be_changed(fetched: Fetched, of: int):
    about, arrays, demo = fetched
    rebuilt(about, arrays, demo)
    said = [path for path in leaves(about) if path[0] not in FREE]
    actions = [path for path in said if path[0] == "actions"]
    rng = np.random.default_rng(0)
    tried = [path for path in said if path[0] != "actions"] + [actions[i] for i in rng.choice(len(actions), 20)]
    assert len(tried) > 80
    for path in tried[::of]:
        with pytest.raises(Corrupt):
            rebuilt(changed(about, path), arrays, demo)


def test_no_live_action_of_a_large_policy_can_be_changed(fetched: Fetched, monkeypatch: pytest.MonkeyPatch):
    about, arrays, demo = fetched
    policy = rebuilt(about, arrays, demo)
    monkeypatch.setattr(policy_document, "MAX_JSON_ACTIONS", 0)
    live = [box.model_dump() for box in policy_document.live_actions_of(policy) or ()]
    large = about | {"actions": None, "live_actions": live}
    rebuilt(large, arrays, demo)
    for path in (("live_actions", 1, "low", 0), ("live_actions", 1, "size", 2), ("live_actions", 2, "actions", 7)):
        with pytest.raises(Corrupt):
            rebuilt(changed(large, path), arrays, demo)
    for none in ({"live_actions": live[:-1]}, {"live_actions": None}):
        with pytest.raises(Corrupt):
            rebuilt(large | none, arrays, demo)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(row=st.integers(0, 2**31), action=st.integers(0, 26), by=st.sampled_from([1e-9, -1.0, float("nan")]))
def test_no_q_value_can_be_changed(fetched: Fetched, row: int, action: int, by: float):
    about, arrays, demo = fetched
    with np.load(io.BytesIO(arrays)) as sent:
        parts = dict(sent)
    parts["q"] = parts["q"].copy()
    parts["q"][row % len(parts["q"]), action] += by
    out = io.BytesIO()
    np.savez(out, **parts)
    with pytest.raises(Corrupt):
        rebuilt(about, out.getvalue(), demo)


@pytest.mark.parametrize("arrays", [b"", b"PK\3\4 no archive", b"\x93NUMPY"])
def test_arrays_that_are_none_are_refused_and_never_unpickled(fetched: Fetched, arrays: bytes):
    with pytest.raises(Corrupt):
        rebuilt(fetched[0], arrays, fetched[2])
    out = io.BytesIO()
    np.savez(out, q=np.array([{"an": "object"}], dtype=object), allow_pickle=True)
    with pytest.raises(Corrupt):
        rebuilt(fetched[0], out.getvalue(), fetched[2])


def test_fitted_grids_with_hysteresis_and_other_learners_are_rebuilt_too(trained):
    from skills.seeds.recordings import sample_recordings

    plover = next(sample for sample in sample_recordings() if sample.surgeon == "plover")
    start_s, end_s = plover.segments[0]
    part = {"start_s": start_s, "end_s": end_s}
    trained.client.add_demo(plover.data, **KESTREL, **part, grid="fit", cell_mm=4.0, hysteresis=0.25)
    trained.train(seed=3, release=True)
    trained.train(learner={"kind": "cell-q-learning"})
    client = Client(trained.http)
    for version in client.versions(**KESTREL):
        assert client.learnt(**KESTREL, version=version.version).seed == version.seed


def test_it_is_written_to_a_file_as_it_was_checked(client: Client, fetched: Fetched, tmp_path: Path):
    as_json = client.save_policy(**KESTREL, to=tmp_path / "policy.json")
    arrays = client.save_policy(**KESTREL, to=tmp_path / "policy.npz", version=1)
    assert json.loads(as_json.read_bytes()) == fetched[0]
    assert arrays.read_bytes() == fetched[1]
    with pytest.raises(BadInput, match=r"\.json nor \.npz"):
        client.save_policy(**KESTREL, to=tmp_path / "policy.pkl")
    assert cases.SUTURE in as_json.read_text()
