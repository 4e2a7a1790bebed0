"""Packed values: unpacking returns exactly the stored value, or refuses it."""

import hashlib
import io
import json
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as some
from isal import isal_zlib
from safetensors.numpy import load, save

from skills import packing
from skills.comparison.distances import STATES, Measured
from skills.comparison.recognition import NUMBERS
from skills.db import packed  # the tables declare the types that may be stored
from skills.db.packed import FORMAT, Packed, digest, pack, seal, unpack_as
from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.movement import Pause
from skills.demonstration.partner import Partner, PartnerMotion
from skills.errors import Corrupt
from skills.formats import read_recording
from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld, discretize
from skills.gridworld.hazards import Surroundings
from skills.gridworld.reward import RewardLevels, RewardMap, sparse_reward
from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.max_ent_irl import MaxEntIRL
from skills.learning.networks import DDPG, DQN, TRPO
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.learning.ties import ShortestApproach
from skills.learning.tube import certified_poses
from skills.planning.handoff import OtherArm, PsmM
from skills.planning.motion_laws import Poses
from skills.planning.plan import Departure, SuturePoint, stack
from skills.planning.trajectory import Trajectory
from skills.verification.playback import Pictures, Playback
from tests.deep.networks import always
from tests.library.cases import bag, hand_off

unpack = partial(unpack_as, object)
DEMO = cut_demo(read_recording(io.BytesIO(bag())))
PATH = discretize(DEMO.tip_mm, PAPER_GRID)
REWARD = sparse_reward(PATH)
POLICY = learn_tabular(REWARD, CellQLearning(episodes=10), seed=3)
PHASED = learn_tabular(REWARD, PhaseQLearning(), seed=0)
SIGNED = replace(PHASED, q=np.where(PHASED.q == 0, -0.0, PHASED.q))
VARIED = replace(PHASED, q=np.random.default_rng(0).random(PHASED.q.shape))  # too many numbers for a palette
PLAN = stack(
    PHASED,
    [SuturePoint((5.0, 55.0, -125.0)), SuturePoint((8.0, 55.0, -125.0), (0.0, 0.0, 0.1, 0.99498743710662))],
    arm="PSM2",
    frame="PSM2_base",
    instrument="400006",
    rotation=None,
    psm_m=PsmM((-0.94, 0.10, -0.33)),
)
HANDED = stack(
    PHASED,
    [SuturePoint((5.0, 55.0, -125.0))],
    demo=DEMO,
    psm_m=PsmM((-0.94, 0.10, -0.33), taken_mm=(15.0, 55.0, -125.0), taken_xyzw=(0.0, 0.0, 0.0, 1.0)),
)
HANDED = replace(HANDED, departure=Departure(60.0, 15.5, 59.0, 15.0))
MOTION = Trajectory(
    rate_hz=240.0,
    instrument="400006",
    stamps_s=np.array([0.0, 1 / 240]),
    tip_mm=np.zeros((2, 3)),
    rotation_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
    joints=np.full((2, 6), 0.1),
    pass_index=np.zeros(2, np.int64),
    phase=np.array([0, 2], np.int8),
    speed_mm_s=20.0,
    turn_rad_s=0.1 + 0.2,
    speed_ratio=0.5,
    acceleration_ratio=0.5,
    deviation_mm=0.0,
    psm_m=OtherArm(np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]), "420006", np.zeros((2, 6))),
    taking=Poses(np.ones((1, 3)), np.eye(3)[None]),
)
PLAYBACK = Playback(
    trajectory=MOTION,
    tip_mm=np.array([[1.0, np.nan, np.inf], [-0.0, 5e-324, 1e308]]),
    rotation_xyzw=np.zeros((2, 4)),
    joints=np.asfortranarray(np.arange(12.0).reshape(2, 6)),
    tracking_mm=np.zeros(2),
    efforts=np.full((2, 6), np.nan),
    contact_n=None,
    windows=None,
    looked_at=np.array([0, 1]),
    clearances_mm=np.zeros((2, 4)),
    shaft_off_mm=np.zeros(2),
    psm_m_tip_mm=None,
    pad_mm=np.array([0.0, 55.5, -150.5]),
    picture_png=bytes(range(256)),
    engine="none \u00e9 \u2603",
    files={"psm.urdf": "0" * 64},
)
SCENE = Scene(
    "base",
    (Box((0.0, 0.1, -1e300), (0.3, 0.2, 5e-324)),),
    (Capsule((0.0, 0.0, 0.1), (1.0, 0.0, 0.0), 0.1),),
    Tissue((0.0, 0.0, -5.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 2.5, ((0.0, -0.0), (0.1, 0.2))),
    0.5,
)
VALUES = [
    DEMO,
    replace(DEMO, rotation_xyzw=None),
    replace(DEMO, pauses=(Pause(0.1, 0.2, "clutch"),)),
    replace(DEMO, partner=Partner("PSM1", 0.4, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))),
    PATH,
    replace(PATH, hysteresis=0.25),
    REWARD,
    POLICY,
    PHASED,
    SIGNED,
    VARIED,
    ValueIteration(),
    MaxEntIRL(),
    DQN(),
    DDPG(),
    TRPO(),
    replace(PHASED, ties=None),
    replace(PHASED, ties=ShortestApproach(depth_along=(0.0, 0.1, -1.0))),
    replace(PHASED, ties=None, surroundings=Surroundings(SCENE)),
    replace(POLICY, network=always((0.5, -0.25, 1e-30))),
    replace(PLAN, psm_m=None),
    PLAN,
    HANDED,
    replace(PLAN, psm_m=PsmM((1.0, 0.0, 0.0), (160.0, 20.0, 20.0), (0.0, 0.0, 0.0, 1.0), "420006", "start", "a", "b")),
    certify(POLICY)[1],
    certified_poses([DEMO]),
    certified_poses([DEMO], partners=[PartnerMotion("PSM1", DEMO.tip_mm + 9.0, DEMO.rotation_xyzw)]),
    PLAYBACK,
    Pictures(b"mp4", b"gif", b"joints", b"clearance"),
    Measured(None, np.array([], np.int64), np.array([]), np.array([]), np.full(NUMBERS, np.nan)),
    Measured(np.ones((STATES, 3)), np.array([2, 1]), np.array([0.1, 5e-324]), np.array([0.2, 0.3]), np.ones(NUMBERS)),
]
ARRAYS = some.arrays(
    st.sampled_from([np.float64, np.int64, np.int8, np.bool_, np.float32]),
    some.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=5),
)


def assert_same(one: object, other: object) -> None:
    """Assert that two values are equal in every part: types, names, and every bit of every number."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif is_dataclass(one):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, tuple):
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    else:
        assert repr(one) == repr(other)


def names_in(value: object) -> Iterator[str]:
    if is_dataclass(value):
        yield type(value).__name__
        for field in fields(value):
            yield from names_in(getattr(value, field.name))
    elif isinstance(value, tuple):
        for part in value:
            yield from names_in(part)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_every_stored_value_comes_back_bit_by_bit(value: object):
    back = unpack(pack(value))
    assert_same(back, value)
    assert digest(back) == digest(value)


def test_no_class_that_is_stored_was_left_out_above():
    assert {name for value in VALUES for name in names_in(value)} == set(packed._VALUES)


def test_a_field_that_was_added_later_changes_no_digest_at_its_default(monkeypatch: pytest.MonkeyPatch):
    """A policy's digest covers its path: if that changed, the policy would be refused as damaged."""
    monkeypatch.setattr(packing, "_ADDED", set())
    whole = digest(PATH)
    packing.added_later(GridPath, "hysteresis")
    older = {"grid": tree_of(PATH.grid), "states": {"array": 0}, "bridged": 0}
    assert_same(unpack(forged({"value": "GridPath", "of": older}, a0=PATH.states)), PATH)
    assert parts_of(PATH)[0]["of"].keys() == older.keys()
    assert digest(PATH) != whole
    other = replace(PATH, hysteresis=0.25)
    assert_same(unpack(pack(other)), other)
    assert digest(other) != digest(PATH)


def test_a_policy_without_a_rule_among_ties_is_read_back():
    tree, arrays = parts_of(replace(PHASED, ties=None))
    assert tree["of"]["ties"] is None
    assert unpack(forged(tree, **arrays)).ties is None
    assert digest(PHASED) != digest(replace(PHASED, ties=None))


def tree_of(grid: GridWorld) -> dict:
    of = {"origin_mm": {"tuple": grid.origin_mm}, "cell_mm": grid.cell_mm, "shape": {"tuple": grid.shape}}
    return {"value": "GridWorld", "of": of}


def test_arrays_come_back_read_only():
    with pytest.raises(ValueError, match="read-only"):
        unpack(pack(REWARD)).rewards[0] = 1.0


@given(ARRAYS)
def test_every_array_comes_back_as_it_was(array: np.ndarray):
    assert_same(unpack(pack((array,))), (array,))


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_a_sealed_value_is_the_packed_one_with_its_digest(value: object):
    assert seal(value) == (pack(value), digest(value))


def parts_of(value: object) -> tuple[Any, dict[str, np.ndarray]]:
    """Split a packed value into its tree and its arrays."""
    arrays = load(isal_zlib.decompress(pack(value)[40:]))
    return json.loads(arrays.pop("tree").tobytes()), arrays


def test_q_values_are_stored_as_a_palette_if_they_fit_into_one():
    tree, arrays = parts_of(PHASED)
    at = tree["of"]["q"]["palette"]
    assert (arrays[f"a{at + 1}"].dtype, arrays[f"a{at + 1}"].shape) == (np.uint8, PHASED.q.shape)
    assert len(arrays[f"a{at}"]) == len(np.unique(PHASED.q)) < 256
    assert "array" in parts_of(VARIED)[0]["of"]["q"]
    assert digest(SIGNED) == digest(PHASED), "-0 is 0"


def test_q_values_read_from_a_palette_or_in_full_give_the_same_policy():
    tree, arrays = parts_of(PHASED)
    at = tree["of"]["q"]["palette"]
    tree["of"]["q"] = {"array": at}
    full = unpack(forged(tree, **{**arrays, f"a{at}": PHASED.q}))
    assert_same(full, PHASED)
    assert digest(full) == digest(PHASED)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda colours, places: (colours[:-1], places),
        lambda colours, places: (colours, places.astype(np.int16) - 300),
        lambda colours, places: (colours, places[:-1]),
        lambda colours, places: (colours, places.ravel()),
        lambda colours, places: (colours.astype(np.float32), places),
        lambda colours, places: (np.append(colours[:-1], np.nan), places),
        lambda colours, places: (colours[:, None], places),
        lambda colours, places: (places, colours),
    ],
    ids=["a number short", "other bytes", "a row short", "flat", "single", "NaN", "column", "turned round"],
)
def test_a_palette_that_is_none_is_refused_though_its_checksum_agrees(wrong):
    tree, arrays = parts_of(PHASED)
    at = tree["of"]["q"]["palette"]
    arrays[f"a{at}"], arrays[f"a{at + 1}"] = wrong(arrays[f"a{at}"], arrays[f"a{at + 1}"])
    with pytest.raises(Corrupt):
        unpack(forged(tree, **arrays))


@pytest.mark.parametrize("at", [99, -1, "0", None])
def test_a_palette_that_is_not_there_is_refused(at: object):
    tree, arrays = parts_of(PHASED)
    tree["of"]["q"] = {"palette": at}
    with pytest.raises(Corrupt):
        unpack(forged(tree, **arrays))


@given(ARRAYS)
def test_a_digest_does_not_depend_on_how_an_array_lies_in_memory(array: np.ndarray):
    roomy = np.repeat(array, 2, axis=0)[::2]
    backwards = np.ascontiguousarray(array[::-1])[::-1]
    for other in (np.asfortranarray(array), roomy, backwards):
        assert digest(other) == digest(array)
        assert unpack(pack(other)).tobytes() == array.tobytes()


@given(ARRAYS, st.data())
def test_a_digest_knows_every_bit_the_shape_and_the_type(array: np.ndarray, data: st.DataObject):
    assert digest(array) != digest(array.astype(np.complex128))
    assert digest(array) != digest(array[None])
    if array.size:
        raw = bytearray(array.tobytes())
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= 1
        assert digest(np.frombuffer(bytes(raw), array.dtype).reshape(array.shape)) != digest(array)


def test_a_digest_is_of_the_value_and_not_of_its_compression(monkeypatch: pytest.MonkeyPatch):
    before = digest(POLICY)
    small = pack(POLICY)
    monkeypatch.setattr(packed, "LEVEL", 0)
    large = pack(POLICY)
    assert len(large) > len(small)
    assert digest(POLICY) == digest(unpack(large)) == digest(unpack(small)) == before


def test_a_digest_tells_classes_and_fields_of_equal_numbers_apart():
    levels = RewardLevels()
    assert digest(levels) != digest(tuple(getattr(levels, field.name) for field in fields(levels)))
    assert digest(SuturePoint((1.0, 2.0, 3.0))) != digest(SuturePoint((3.0, 2.0, 1.0)))


@pytest.mark.parametrize("seed", range(3))
def test_each_of_300_flipped_bits_of_a_packed_policy_is_refused(seed: int):
    data, rng = pack(POLICY), np.random.default_rng(seed)
    for bit in rng.integers(0, 8 * len(data), 100).tolist():
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(Corrupt):
            unpack(bytes(damaged))


def test_every_cut_of_a_packed_value_is_refused():
    data = pack(RewardLevels())
    for length in range(len(data)):
        with pytest.raises(Corrupt):
            unpack(data[:length])
    with pytest.raises(Corrupt):
        unpack(data + b"\0")


def forged(tree: object, **arrays: np.ndarray) -> bytes:
    """Pack a tree that no value has, with a correct checksum."""
    body = save({"tree": np.frombuffer(json.dumps(tree).encode(), np.uint8), **arrays})
    return with_checksum(isal_zlib.compress(body))


def with_checksum(body: bytes) -> bytes:
    return FORMAT + hashlib.sha256(body).digest() + body


@pytest.mark.parametrize(
    "tree",
    [
        {"value": "Popen", "of": {"args": "true"}},
        {"value": "GridWorld", "of": {"args": "true"}},
        {"value": "GridWorld", "of": {"origin_mm": [0, 0, 0], "cell_mm": -1.0, "shape": {"tuple": [1, 1, 1]}}},
        {"value": "RewardMap", "of": {"path": None, "levels": None, "rewards": {"array": 7}}},
        {"array": 0},
        {"neither": "nor"},
        {"dict": [1]},
    ],
)
def test_what_was_never_a_value_is_refused_though_its_checksum_agrees(tree: object):
    with pytest.raises(Corrupt):
        unpack(forged(tree))


def test_a_pickle_inside_is_never_read():
    out = io.BytesIO()
    np.savez(out, tree=np.frombuffer(b'{"array": 0}', np.uint8), a0=np.array([{}], dtype=object))
    for body in (out.getvalue(), isal_zlib.compress(out.getvalue()), b"", b"x" * 100):
        with pytest.raises(Corrupt):
            unpack(with_checksum(body))


def test_a_column_refuses_a_value_of_another_class():
    with pytest.raises(Corrupt, match="RewardLevels where a RewardMap"):
        Packed(RewardMap).process_result_value(pack(RewardLevels()), None)
    with pytest.raises(AssertionError):
        Packed(RewardMap).process_bind_param(RewardLevels(), None)


def test_a_class_that_was_not_declared_is_not_stored():
    recording = read_recording(io.BytesIO(hand_off()))
    with pytest.raises(AssertionError, match="not declared"):
        pack(recording)


def test_pauses_and_a_partner_make_another_digest_of_a_demo():
    seconds = np.arange(5) / 10
    demo = Demo("PSM2", "/t", "f", 0.0, 0.4, seconds, np.stack([10 * seconds, 0 * seconds, 0 * seconds], axis=1))
    paused = replace(demo, pauses=(Pause(0.1, 0.2, "clutch"),))
    partner = replace(demo, partner=Partner("PSM1", 0.4, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))
    assert len({digest(demo), digest(paused), digest(partner)}) == 3


def test_a_partner_with_a_base_makes_another_digest_and_is_read_back():
    seconds = np.arange(5) / 10
    partner = Partner("PSM1", 0.4, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    tip_mm = np.stack([10 * seconds, 0 * seconds, 0 * seconds], axis=1)
    demo = Demo("PSM2", "/t", "f", 0.0, 0.4, seconds, tip_mm, partner=partner)
    known = replace(partner, base_mm=(1.0, 2.0, 3.0), base_xyzw=(0.0, 0.0, 0.0, 1.0), instrument="400006")
    assert unpack(pack(known)) == known
    assert digest(replace(demo, partner=known)) != digest(demo)


def test_a_plans_digest_is_over_its_departure_too():
    assert HANDED.passes[0].taking is not None
    assert digest(HANDED) != digest(replace(HANDED, departure=None))


def test_a_plan_from_before_psm_m_moved_is_refused_as_a_whole():
    kept = ("arm", "frame", "instrument", "speed_mm_s", "orientation", "path")
    before = {name: getattr(PLAN, name) for name in kept} | {"approach_m": None, "passes": {"tuple": []}}
    with pytest.raises(Corrupt, match="a format that this version does not know"):
        unpack(forged({"value": "SuturePlan", "of": before}))


@pytest.mark.parametrize(
    "other",
    [
        {"rate_hz": 100.0},
        {"tip_offset_mm": 10.2},
        {"psm_m": None},
        {"psm_m": replace(PLAN.psm_m, enters="start")},
        {"psm_m": replace(PLAN.psm_m, instrument="420006")},
        {"psm_m": replace(PLAN.psm_m, base_mm=(1.0, 2.0, 3.0), base_xyzw=(0.0, 0.0, 0.0, 1.0))},
        {"psm_m": replace(PLAN.psm_m, approach_from="elsewhere")},
    ],
)
def test_a_plans_digest_is_over_all_that_it_knows_of_psm_m_and_of_time(other):
    assert digest(replace(PLAN, **other)) != digest(PLAN)
