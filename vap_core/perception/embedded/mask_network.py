"""The segmenter's network as a torch module: the mask head on frozen features.

Its graph is exported from here, and training fits it.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.perception.embedded.backbone import Trunk, normalise
from vap_core.perception.embedded.segmenter import TAPS
from vap_core.perception.embedded.taps import CHANNELS

WIDTHS = (16, 24, 32, 48)
"""Channels of the head at each tap."""
FINE_WIDTH = 12
"""Channels of the head at half the window's resolution."""


class MaskHead(nn.Module):
    """Four feature maps and the prompt in, one logit per pixel of the window out.

    The attributes' names are the tensors' names in the weight file.
    """

    def __init__(self) -> None:
        super().__init__()
        narrower = (FINE_WIDTH, *WIDTHS[:-1])
        self.lateral = nn.ModuleList()
        self.prompt = nn.ModuleList()
        self.mix = nn.ModuleList()
        for tap, width in zip(TAPS, WIDTHS, strict=True):
            self.lateral.append(nn.Conv2d(CHANNELS[tap], width, 1))
        for width in WIDTHS:
            self.prompt.append(nn.Conv2d(2, width, 3, padding=1))
        for width, narrow in zip(WIDTHS, narrower, strict=True):
            self.mix.append(nn.Conv2d(width, narrow, 3, padding=1))
        self.fine = nn.Sequential(
            nn.Conv2d(FINE_WIDTH + 3 + 2, FINE_WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(FINE_WIDTH, 1, 3, padding=1),
        )

    def forward(
        self,
        pixels: Float[Tensor, "n 3 h w"],
        taps: Mapping[str, Tensor],
        prompt: Float[Tensor, "n 2 h w"],
    ) -> Float[Tensor, "n h w"]:
        """Logits of the mask.

        `pixels` are normalised as for the backbone; `prompt` holds the box and the coarse mask,
        0..1 (all 0 when there is none).
        """
        x = self._level(len(TAPS) - 1, taps, prompt)
        x = F.relu(self.mix[-1](F.relu(x)))
        for level in reversed(range(len(TAPS) - 1)):
            larger = F.interpolate(x, scale_factor=2, mode="nearest")
            x = self._level(level, taps, prompt) + larger
            x = F.relu(self.mix[level](F.relu(x)))
        x = F.interpolate(x, scale_factor=2, mode="bilinear")
        return self.fine(torch.cat([x, pixels, prompt], 1))[:, 0]

    def _level(
        self, level: int, taps: Mapping[str, Tensor], prompt: Float[Tensor, "n 2 h w"]
    ) -> Float[Tensor, "n c y x"]:
        """Features and prompt at the resolution of tap `level`."""
        reduced = F.avg_pool2d(prompt, 2 ** (level + 1))
        return self.lateral[level](taps[TAPS[level]]) + self.prompt[level](reduced)


class MaskNetwork(nn.Module):
    """Backbone and head: a window and its prompt in, the probability of each of its pixels out."""

    def __init__(self, head: MaskHead) -> None:
        super().__init__()
        self.trunk = Trunk(TAPS)
        self.head = head

    def forward(
        self, rgb: UInt8[Tensor, "n s s 3"], planes: UInt8[Tensor, "n 2 s s"]
    ) -> tuple[Float[Tensor, "n s s"]]:
        """`planes` are those of the prompt, 0..255."""
        pixels = normalise(rgb)
        logits = self.head(pixels, self.trunk(pixels), planes.float() / 255)
        return (logits.sigmoid(),)
