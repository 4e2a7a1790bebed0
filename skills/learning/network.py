"""A small neural network as a frozen value: the result of a network learner.

A multilayer perceptron: each layer but the last is a weighted sum with a bias, followed by a ReLU; the last has no
ReLU. The weights are stored as the bytes of a safetensors file, which contains names and numbers and no code, so a
network that is read back equals the learnt one to the last bit, and evaluating it needs only numpy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from skills.arrays import Floats
from skills.errors import BadInput

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]  # weights, (outputs, inputs), and biases, (outputs,)
DECIMALS = 6  # ours: a float32 has seven digits, and sums agree to six whatever the order of summation


@dataclass(frozen=True)
class Network:
    """The weights of a network, as the bytes of a safetensors file with `0.weight`, `0.bias`, `1.weight` ..."""

    tensors: bytes

    def __post_init__(self) -> None:
        layers = self.layers
        widths = all(below[1].size == above[0].shape[1] for below, above in pairwise(layers))
        if not (layers and widths):
            raise BadInput("A network needs at least one layer, and the sizes of adjacent layers must match.")

    @classmethod
    def of(cls, layers: Sequence[tuple[ArrayLike, ArrayLike]]) -> "Network":
        """Construct a network from the weights, (outputs, inputs), and biases, (outputs,), of its layers."""
        named = {}
        for number, (weight, bias) in enumerate(layers):
            named[f"{number}.weight"] = np.array(weight, np.float32, order="C")
            named[f"{number}.bias"] = np.array(bias, np.float32, order="C")
        return cls(save(named))

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """The layers, read-only.

        Raises:
            BadInput: The bytes are not those of a network, or a number in them is not finite.
        """
        try:
            named = load(self.tensors)
        except SafetensorError as error:
            raise BadInput("The bytes are not a safetensors file.") from error
        layers = []
        for number in range(len(named) // 2):
            weight, bias = named.pop(f"{number}.weight", None), named.pop(f"{number}.bias", None)
            if weight is None or bias is None:
                raise BadInput("A network has a weight and a bias for each of its layers, numbered from 0.")
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or {weight.dtype, bias.dtype} != {np.dtype("f4")}:
                raise BadInput("The weights of a layer are (outputs, inputs), its biases (outputs,), all float32.")
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise BadInput("A weight of the network is NaN or infinite.")
            weight.setflags(write=False)
            bias.setflags(write=False)
            layers.append((weight, bias))
        if named:
            raise BadInput("The file of a network must contain only its layers.")
        return tuple(layers)

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return int(self.layers[0][0].shape[1])

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return int(self.layers[-1][1].size)

    def answer(self, inputs: ArrayLike) -> Floats:
        """Evaluate the network for inputs, (N, inputs); returns (N, outputs), rounded to `DECIMALS`."""
        at = np.asarray(inputs, np.float64)
        for number, (weight, bias) in enumerate(self.layers):
            at = at @ weight.T.astype(np.float64) + bias  # in float64, so that rounding hides the order of summation
            if number < len(self.layers) - 1:
                at = np.maximum(at, 0.0)
        return np.asarray(at.round(DECIMALS) + 0.0)  # + 0.0 turns -0.0 into 0.0
