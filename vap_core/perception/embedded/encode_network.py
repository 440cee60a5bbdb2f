"""The encoder's network as a torch module: the instance head on frozen features.

Its graph is exported from here, and training fits it.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.perception.embedded.backbone import Trunk, normalise
from vap_core.perception.embedded.encoder import HISTOGRAM_LENGTH, INSTANCE_TAPS, INSTANCE_WIDTH
from vap_core.perception.embedded.taps import CHANNELS


class InstanceHead(nn.Module):
    """Distinguishes look-alikes: a small network on frozen features and the pixels of a crop.

    Features of three depths and the pixels meet on a 14 x 14 grid; eight attention heads weight its
    cells, so the table can be left out. Trained on generic look-alikes only. The attributes' names
    are the tensors' names in the weight file.
    """

    GRID = 14
    HEADS = 8
    VALUE_WIDTH = 24
    WIDTH = 96
    DIM = INSTANCE_WIDTH

    def __init__(self) -> None:
        super().__init__()
        self.pixels = nn.Sequential(
            nn.Conv2d(3, 16, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(32, 48, 3, 2, 1),
        )
        self.lateral = nn.ModuleDict(
            {
                "b4": nn.Conv2d(CHANNELS["b4"], 32, 1),
                "b10": nn.Conv2d(CHANNELS["b10"], 48, 1),
                "b14": nn.Conv2d(CHANNELS["b14"], 48, 1),
            }
        )
        merged = 48 + 32 + 48 + 48
        self.merge = nn.Conv2d(merged, self.WIDTH, 3, 2, 1)
        self.norm = nn.ModuleList([nn.GroupNorm(8, merged), nn.GroupNorm(8, self.WIDTH)])
        self.place = nn.Parameter(torch.zeros(self.WIDTH, self.GRID // 2, self.GRID // 2))
        self.mix = nn.Conv2d(self.WIDTH, self.WIDTH, 3, padding=1)
        self.where = nn.Conv2d(self.WIDTH, self.HEADS, 1)
        self.what = nn.Conv2d(self.WIDTH, self.HEADS * self.VALUE_WIDTH, 1)
        self.colour = nn.Linear(HISTOGRAM_LENGTH, 64)
        self.out = nn.Sequential(
            nn.Linear(self.HEADS * self.VALUE_WIDTH + self.WIDTH + 64, 256),
            nn.ReLU(),
            nn.Linear(256, self.DIM),
        )

    def forward(
        self,
        taps: Mapping[str, Tensor],
        pixels: Float[Tensor, "n 3 s s"],
        colour: Float[Tensor, "n b"],
    ) -> Float[Tensor, "n d"]:
        """Rows of length 1.

        `taps` are maps of 14, 14 and 7 cells a side; `pixels` are 112 x 112 and normalised as for
        the backbone; `colour` is a normalised Lab histogram.
        """
        size = (self.GRID, self.GRID)
        maps = [self.pixels(pixels)]
        for tap in INSTANCE_TAPS:
            maps.append(F.interpolate(self.lateral[tap](taps[tap]), size, mode="nearest"))
        x = self.norm[1](self.merge(F.relu(self.norm[0](torch.cat(maps, 1))))) + self.place
        x = x + F.relu(self.mix(F.relu(x)))
        attention = self.where(x).flatten(2).softmax(-1)
        values = self.what(x).flatten(2).unflatten(1, (self.HEADS, self.VALUE_WIDTH))
        attended = torch.einsum("nhp,nhcp->nhc", attention, values).flatten(1)
        pooled = F.relu(x).pow(3).mean((2, 3)).clamp(min=1e-6).pow(1 / 3)
        joined = torch.cat([attended, pooled, F.relu(self.colour(colour))], 1)
        return F.normalize(self.out(joined), dim=1)


class EncodeNetwork(nn.Module):
    """Backbone and head: a crop in, its deepest features and the instance head's row out."""

    def __init__(self, head: InstanceHead | None) -> None:
        super().__init__()
        self.trunk = Trunk([*INSTANCE_TAPS, "head"])
        self.head = head

    def forward(
        self,
        rgb: UInt8[Tensor, "n _s _s 3"],
        small: UInt8[Tensor, "n _t _t 3"],
        colour: Float[Tensor, "n b"],
    ) -> tuple[Tensor, ...]:
        """`small` is the same crop, `INSTANCE_SIDE` pixels wide; without a head there is no row."""
        taps = self.trunk(normalise(rgb))
        if self.head is None:
            return (taps["head"],)
        return taps["head"], self.head(halve_b4(taps), normalise(small), colour)


def halve_b4(taps: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The taps that the instance head reads, b4 at half its resolution."""
    return {"b4": F.avg_pool2d(taps["b4"], 2), "b10": taps["b10"], "b14": taps["b14"]}
