"""A small neural network as a frozen value: what a learner beyond the table leaves behind.

A multilayer perceptron: each layer but the last is a weighted sum and a bias, cut off below zero; the last one is not
cut off. The weights are kept as the bytes of a safetensors file, numbers and names and nothing that runs, so a network
that is read back is the one that was learnt to the last bit, and what it answers needs numpy alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from skills.errors import BadInput
from skills.style._arrays import Floats

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]  # weights (outputs, inputs) and biases (outputs,)
DECIMALS = 6  # ours: a float32 carries seven digits, and sums of it agree that far whatever order they are taken in


@dataclass(frozen=True)
class Network:
    """The weights of a network, as the bytes of a safetensors file with `0.weight`, `0.bias`, `1.weight` ..."""

    tensors: bytes

    def __post_init__(self) -> None:
        layers = self.layers
        widths = all(below[1].size == above[0].shape[1] for below, above in pairwise(layers))
        if not (layers and widths):
            raise BadInput("The layers of a network must fit onto each other, and there must be one.")

    @classmethod
    def of(cls, layers: Sequence[tuple[ArrayLike, ArrayLike]]) -> "Network":
        """Put a network together from the weights, (outputs, inputs), and biases, (outputs,), of its layers."""
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
            raise BadInput("These bytes are no safetensors file.") from error
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
            raise BadInput("A network's file holds its layers and nothing else.")
        return tuple(layers)

    @property
    def inputs(self) -> int:
        """How many numbers it takes."""
        return int(self.layers[0][0].shape[1])

    @property
    def outputs(self) -> int:
        """How many numbers it answers with."""
        return int(self.layers[-1][1].size)

    def answer(self, inputs: ArrayLike) -> Floats:
        """Answer inputs, (N, inputs), with (N, outputs), rounded to `DECIMALS`."""
        at = np.asarray(inputs, np.float64)
        for number, (weight, bias) in enumerate(self.layers):
            at = at @ weight.T.astype(np.float64) + bias
            if number < len(self.layers) - 1:
                at = np.maximum(at, 0.0)
        return np.asarray(at.round(DECIMALS) + 0.0)  # no -0.0
