"""EfficientNet-Lite0 as it was published: its convolutions, and their weights with the batch norms
folded in.

The weights come from a pip package, in a file of torch's first format. It is read here without
torch, which an installation that only computes need not have; nothing in it is executed.
"""

import pickle
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from vap_core.perception.embedded.weights import Weights, lite0_file

EPSILON = 1e-3
"""Of the batch norms."""
GROUPS_OF_BLOCKS = (
    (1, 3, 1, 1, 32, 16),
    (2, 3, 2, 6, 16, 24),
    (2, 5, 2, 6, 24, 40),
    (3, 3, 2, 6, 40, 80),
    (3, 5, 1, 6, 80, 112),
    (4, 5, 2, 6, 112, 192),
    (1, 3, 1, 6, 192, 320),
)
"""Blocks, kernel, stride of the first block, expansion, and channels in and out."""


@dataclass(frozen=True)
class Convolution:
    """One convolution; `name` and `norm` are those of its weights and batch norm in the file."""

    name: str
    norm: str
    inputs: int
    outputs: int
    kernel: int = 1
    stride: int = 1
    groups: int = 1

    @property
    def padding(self) -> tuple[int, int]:
        """Before and after each axis: TensorFlow's "same" padding of an even number of pixels."""
        total = self.kernel - self.stride
        return total // 2, total - total // 2


@dataclass(frozen=True)
class Block:
    """An inverted residual block, whose input is added to its output if `residual`."""

    convolutions: tuple[Convolution, ...]
    residual: bool


STEM = Convolution("_conv_stem", "_bn0", inputs=3, outputs=32, kernel=3, stride=2)
HEAD = Convolution("_conv_head", "_bn1", inputs=320, outputs=1280)


def _blocks() -> Iterator[Block]:
    index = 0
    for count, kernel, first_stride, expansion, inputs, outputs in GROUPS_OF_BLOCKS:
        for i in range(count):
            within = f"_blocks.{index}."
            given = inputs if i == 0 else outputs
            stride = first_stride if i == 0 else 1
            wide = given * expansion
            depthwise = Convolution(
                name=f"{within}_depthwise_conv",
                norm=f"{within}_bn1",
                inputs=wide,
                outputs=wide,
                kernel=kernel,
                stride=stride,
                groups=wide,
            )
            project = Convolution(f"{within}_project_conv", f"{within}_bn2", wide, outputs)
            convolutions = [depthwise, project]
            if expansion > 1:
                expand = Convolution(f"{within}_expand_conv", f"{within}_bn0", given, wide)
                convolutions.insert(0, expand)
            yield Block(tuple(convolutions), residual=stride == 1 and given == outputs)
            index += 1


BLOCKS = tuple(_blocks())
STAGES = tuple([*(f"b{i}" for i in range(len(BLOCKS))), "head"])
"""The taps, one after each stage; the first stage is the stem and a block."""


def trunk_weights(taps: Sequence[str]) -> Weights:
    """The weights of a `backbone.Trunk` up to the deepest of some taps, by name."""
    depth = 1 + max(map(STAGES.index, taps))
    chosen: Weights = {}
    for name, array in folded_weights().items():
        if int(name.split(".")[1]) < depth:
            chosen[f"trunk.{name}"] = array
    return chosen


@cache
def folded_weights() -> Weights:
    """The weights of `backbone.Backbone` by name.

    Raises: MissingWeights: the pip package is not installed.
    """
    published = read_tensors(lite0_file())
    weights: Weights = {}
    for place, convolution in _places():
        gain = published[f"{convolution.norm}.weight"] / np.sqrt(
            published[f"{convolution.norm}.running_var"] + np.float32(EPSILON)
        )
        kernel = published[f"{convolution.name}.weight"] * gain[:, None, None, None]
        mean = published[f"{convolution.norm}.running_mean"]
        weights[f"{place}.weight"] = kernel
        weights[f"{place}.bias"] = published[f"{convolution.norm}.bias"] - mean * gain
    return weights


def _places() -> Iterator[tuple[str, Convolution]]:
    """Every convolution and its name in the backbone's module."""
    yield _place("stages.0.0", STEM)
    for index, block in enumerate(BLOCKS):
        within = f"stages.{index}"
        if index == 0:
            within += ".2"
        if block.residual:
            within += ".body"
        for i, convolution in enumerate(block.convolutions):
            yield _place(f"{within}.{2 * i}", convolution)
    yield _place(f"stages.{len(BLOCKS)}.0", HEAD)


def _place(within: str, convolution: Convolution) -> tuple[str, Convolution]:
    near, far = convolution.padding
    after_padding = int(near != far)
    return f"{within}.{after_padding}", convolution


class _Tensor(NamedTuple):
    """What the file says of a tensor: its storage, and how it lies in it."""

    storage: tuple[str, type, str, str, int, Any]
    """"storage", the type of its numbers, its key, a device, the count of numbers, and None."""
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    requires_grad: bool
    hooks: Any


class _Unpickler(pickle.Unpickler):
    """Knows the few names that a file of tensors needs; every other is refused."""

    NAMES: dict[tuple[str, str], Any] = {  # noqa: RUF012
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
        ("torch", "FloatStorage"): np.float32,
        ("torch", "LongStorage"): np.int64,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.NAMES:
            raise pickle.UnpicklingError(f"{module}.{name} does not belong into a file of weights")
        return self.NAMES[module, name]

    def persistent_load(self, pid: Any) -> Any:
        return pid


def read_tensors(path: Path) -> Weights:
    """The tensors of a file of torch's first format: three headers, the tensors, then storages."""
    with path.open("rb") as file:
        for _ in range(3):  # a magic number, a version, and sizes of types
            _Unpickler(file).load()
        tensors: dict[str, _Tensor] = _Unpickler(file).load()
        keys: list[str] = _Unpickler(file).load()
        kinds = {tensor.storage[2]: tensor.storage[1] for tensor in tensors.values()}
        storages = {key: _read_storage(file, kinds[key]) for key in keys}
    arrays: Weights = {}
    for name, tensor in tensors.items():
        flat = storages[tensor.storage[2]][tensor.offset :]
        steps = [step * flat.itemsize for step in tensor.strides]
        view = np.lib.stride_tricks.as_strided(flat, tensor.shape, steps, writeable=False)
        arrays[name] = np.array(view, order="C")
    return arrays


def _read_storage(file: BinaryIO, kind: type) -> np.ndarray:
    """The numbers of one storage, whose count stands before them."""
    count = int.from_bytes(file.read(8), "little")
    return np.frombuffer(file.read(count * np.dtype(kind).itemsize), kind)
