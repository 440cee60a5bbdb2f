"""The frozen backbone of the embedded stack as a torch module: EfficientNet-Lite0.

It defines the graphs that ONNX Runtime computes (`vap_core.perception.embedded.networks` names its
weights), and is what training reads. Features are taken at
named taps (taps.py). A pass stops at the deepest tap needed: a tracker that reads `b4` pays for a
third of the network.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from vap_core.base.files import write_atomic
from vap_core.base.types import Rgb
from vap_core.perception.embedded.networks import GREY, MANIFEST, folded_weights, read_manifest

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
            name, norm = f"{within}_depthwise_conv", f"{within}_bn1"
            depthwise = Convolution(name, norm, wide, wide, kernel, stride, groups=wide)
            project = Convolution(f"{within}_project_conv", f"{within}_bn2", wide, outputs)
            convolutions = [depthwise, project]
            if expansion > 1:
                expand = Convolution(f"{within}_expand_conv", f"{within}_bn0", given, wide)
                convolutions.insert(0, expand)
            yield Block(tuple(convolutions), residual=stride == 1 and given == outputs)
            index += 1


BLOCKS = tuple(_blocks())


class _Residual(nn.Module):
    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class Backbone(nn.Module):
    """EfficientNet-Lite0 without its classifier, frozen.

    Batch norms are folded into the convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        first = nn.Sequential(_convolution(STEM), nn.ReLU6(), _inverted_residual(BLOCKS[0]))
        stages: list[nn.Module] = [first]
        self.names = ["b0"]
        for index, block in enumerate(BLOCKS[1:], start=1):
            stages.append(_inverted_residual(block))
            self.names.append(f"b{index}")
        stages.append(nn.Sequential(_convolution(HEAD), nn.ReLU6()))
        self.names.append("head")
        self.stages = nn.ModuleList(stages)
        weights = {name: torch.from_numpy(array) for name, array in folded_weights().items()}
        self.load_state_dict(weights)
        self.requires_grad_(False).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, x: Float[Tensor, "n 3 h w"], taps: Iterable[str]) -> dict[str, Tensor]:
        """Features by tap of normalised pixels.

        h and w are multiples of the deepest tap's stride.
        """
        wanted = set(taps)
        maps: dict[str, Tensor] = {}
        for name, stage in zip(self.names, self.stages, strict=True):
            x = stage(x)
            if name in wanted:
                maps[name] = x
                if len(maps) == len(wanted):
                    break
        return maps


class Trunk(nn.Module):
    """The shared backbone up to the deepest of some taps, and nothing that it does not need."""

    def __init__(self, taps: Sequence[str]) -> None:
        super().__init__()
        backbone = load_backbone()
        depth = 1 + max(map(backbone.names.index, taps))
        self.taps = frozenset(taps)
        self.names = backbone.names[:depth]
        self.stages = backbone.stages[:depth]

    def forward(self, x: Float[Tensor, "n 3 h w"]) -> dict[str, Tensor]:
        """As `Backbone.forward`."""
        maps: dict[str, Tensor] = {}
        for name, stage in zip(self.names, self.stages, strict=True):
            x = stage(x)
            if name in self.taps:
                maps[name] = x
        return maps


def normalise(rgb: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n 3 h w"]:
    """Pixels as the backbone was trained on them: (x - 127) / 128, channels last in memory."""
    return rgb.permute(0, 3, 1, 2).float().sub_(float(GREY)).div_(128.0)


@cache
def load_backbone() -> Backbone:
    """The backbone that the whole process shares."""
    return Backbone()


@torch.inference_mode()
def features(images: Sequence[Rgb], taps: Sequence[str]) -> Mapping[str, Tensor]:
    """Taps of same-sized images.

    Images pass one at a time, so that a batch gives the same bits as its parts.
    """
    net = load_backbone()
    per_image: dict[str, list[Tensor]] = {tap: [] for tap in taps}
    for image in images:
        pixels = normalise(torch.from_numpy(np.ascontiguousarray(image))[None])
        for tap, found in net(pixels, taps).items():
            per_image[tap].append(found)
    return {tap: torch.cat(parts) for tap, parts in per_image.items()}


def _convolution(given: Convolution) -> nn.Sequential:
    """A convolution with bias, keeping TensorFlow's asymmetric padding."""
    near, far = given.padding
    layers: list[nn.Module] = []
    if near != far:
        layers.append(nn.ZeroPad2d((near, far, near, far)))
        near = 0
    layers.append(
        nn.Conv2d(
            given.inputs,
            given.outputs,
            given.kernel,
            given.stride,
            padding=near,
            groups=given.groups,
        )
    )
    return nn.Sequential(*layers)


def _inverted_residual(block: Block) -> nn.Module:
    """An inverted residual block: ReLU6 after every convolution but the last."""
    layers: list[nn.Module] = []
    for convolution in block.convolutions[:-1]:
        layers += [_convolution(convolution), nn.ReLU6()]
    body = nn.Sequential(*layers, _convolution(block.convolutions[-1]))
    if block.residual:
        return _Residual(body)
    return body


class TorchNetwork:
    """A module as a network of arrays, computed by torch where the module's weights are."""

    def __init__(self, module: nn.Module) -> None:
        self.module = module.requires_grad_(False).eval()
        self.device = next(module.parameters()).device

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        with torch.inference_mode():
            inputs = [torch.from_numpy(array).to(self.device) for array in arrays]
            outputs = self.module(*inputs)
        return tuple(output.cpu().numpy() for output in outputs)


def save_weights(
    name: str, tensors: Mapping[str, Tensor], about: Mapping[str, Any], folder: Path
) -> Path:
    """Write half-precision weights and their manifest entry; the other entries stay as they are."""
    from safetensors.torch import save

    halves = {key: tensor.detach().cpu().half().contiguous() for key, tensor in tensors.items()}
    return write_entry(name, save(halves), about, folder)


def write_entry(name: str, data: bytes, about: Mapping[str, Any], folder: Path) -> Path:
    """Write a file and its manifest entry; the other entries stay as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = read_manifest(folder)
    entries[name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), **about}
    write_atomic(folder / name, data)
    text = json.dumps(entries, indent=1, sort_keys=True) + "\n"
    write_atomic(folder / MANIFEST, text.encode())
    return folder / name
