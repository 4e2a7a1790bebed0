"""A network as a value: its output, its refusals, and an exact round trip through storage."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save

from skills.db import models  # noqa: F401 - declares what is stored
from skills.db.packed import digest, pack, unpack
from skills.errors import BadInput
from skills.learning.networks import Network

SMALL = Network.of([([[1.0, -1.0], [2.0, 0.5]], [0.0, -1.0]), ([[1.0, 3.0]], [0.25])])


def test_a_network_worked_by_hand():
    # (2, 1): hidden (1, 3.5), output 1 + 10.5 + 0.25; (0, 1): hidden (-1, -0.5), both cut off.
    assert SMALL.answer([[2.0, 1.0], [0.0, 1.0]]).tolist() == [[11.75], [0.25]]
    assert (SMALL.inputs, SMALL.outputs) == (2, 1)


@given(st.lists(st.integers(1, 5), min_size=2, max_size=4), st.integers(0, 2**32 - 1))
def test_a_network_comes_back_to_the_last_bit_and_answers_the_same(widths, seed):
    rng = np.random.default_rng(seed)
    layers = [(rng.normal(size=(m, n)), rng.normal(size=m)) for n, m in pairwise(widths)]
    network = Network.of(layers)
    back = unpack(pack(network))
    assert back == network and digest(back) == digest(network)
    inputs = rng.normal(size=(7, widths[0]))
    assert back.answer(inputs).tobytes() == network.answer(inputs).tobytes()
    for (weight, bias), (w, b) in zip(layers, back.layers, strict=True):
        assert (w == weight.astype(np.float32)).all() and (b == bias.astype(np.float32)).all()


def test_a_network_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        SMALL.layers[0][0][0, 0] = 7


def f4(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize(
    "tensors",
    [
        b"",
        b"not a network",
        SMALL.tensors[:-1],
        save({}),
        save({"0.weight": f4(2, 2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(3)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "2.weight": f4(2, 2), "2.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "1.weight": f4(2, 3), "1.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "more": f4(2)}),
        save({"0.weight": np.zeros((2, 2)), "0.bias": np.zeros(2)}),
        save({"0.weight": f4(2, 2) + np.float32(np.nan), "0.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2) + np.float32(np.inf)}),
    ],
    ids=["empty", "text", "cut", "none", "no bias", "bias", "gap", "widths", "more", "float64", "nan", "inf"],
)
def test_what_is_no_network_is_refused(tensors):
    with pytest.raises(BadInput):
        Network(tensors)


def test_a_network_is_a_safetensors_file_that_others_read():
    length = int.from_bytes(SMALL.tensors[:8], "little")
    named = json.loads(SMALL.tensors[8 : 8 + length])
    assert {name: about["shape"] for name, about in named.items()} == {
        "0.weight": [2, 2], "0.bias": [2], "1.weight": [1, 2], "1.bias": [1],
    }  # fmt: skip
