"""The detector's network as a torch module: the head on frozen features.

Its graph is exported from here, and training fits it.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.perception.embedded.backbone import Trunk, normalise
from vap_core.perception.embedded.detector import TAPS
from vap_core.perception.embedded.taps import CHANNELS
from vap_core.perception.text_encoder import WIDTH as TEXT_WIDTH

COARSE_WIDTH = 96
FINE_WIDTH = 64
PHRASE_HIDDEN_WIDTH = 128
PHRASE_WIDTH = 96
"""Channels of the head: at stride 16, at stride 8, and of embedded phrases."""


class DetectHead(nn.Module):
    """Feature maps in; one score map per phrase and one box per cell out.

    Stride 16 decides what an object is, stride 8 where its edges are. The attributes' names are the
    tensors' names in the weight file.
    """

    known: Tensor
    """MiniLM embeddings of the trained phrases, those that name nothing too; kept so that loading
    does not compute them again."""

    def __init__(self, n_phrases: int) -> None:
        super().__init__()
        self.register_buffer("known", torch.zeros(n_phrases, TEXT_WIDTH))
        self.lateral = nn.ModuleDict(
            {
                "b4": nn.Conv2d(CHANNELS["b4"], FINE_WIDTH, 1),
                "b10": nn.Conv2d(CHANNELS["b10"], COARSE_WIDTH, 1),
                "b14": nn.Conv2d(CHANNELS["b14"], COARSE_WIDTH, 1),
            }
        )
        self.coarse = ResidualConvolutions(COARSE_WIDTH)
        self.fine = ResidualConvolutions(FINE_WIDTH)
        self.down = nn.Conv2d(COARSE_WIDTH, FINE_WIDTH, 1)
        self.see = nn.Conv2d(FINE_WIDTH, PHRASE_WIDTH, 1)
        self.edges = nn.Conv2d(FINE_WIDTH, 4, 1)
        self.read = nn.Sequential(
            nn.Linear(TEXT_WIDTH, PHRASE_HIDDEN_WIDTH),
            nn.ReLU(),
            nn.Linear(PHRASE_HIDDEN_WIDTH, PHRASE_WIDTH),
        )
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def forward(
        self, taps: Mapping[str, Tensor], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p h w"], Float[Tensor, "n 4 h w"]]:
        """Logits per phrase, and how far the edges are.

        Edges are distances, in cells, from the cell's centre to the left, top, right and bottom.
        """
        b4 = self.lateral["b4"](taps["b4"])
        b10 = self.lateral["b10"](taps["b10"])
        b14 = self.lateral["b14"](taps["b14"])
        x = self.down(self.coarse(b10 + F.interpolate(b14, b10.shape[-2:], mode="nearest")))
        x = self.fine(b4 + F.interpolate(x, b4.shape[-2:], mode="nearest"))
        product = torch.einsum("nchw,pc->nphw", self.see(x), self.read(text))
        logits = product / PHRASE_WIDTH**0.5 + self.bias
        return logits, 4 * F.softplus(self.edges(x))


class ResidualConvolutions(nn.Module):
    """Two residual 3 x 3 convolutions between group norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mix = nn.ModuleList()
        self.norm = nn.ModuleList([nn.GroupNorm(8, width)])
        for _ in range(2):
            self.mix.append(nn.Conv2d(width, width, 3, padding=1))
            self.norm.append(nn.GroupNorm(8, width))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        x = self.norm[0](x)
        for mix, norm in zip(self.mix, list(self.norm)[1:], strict=True):
            x = x + F.relu(norm(mix(F.relu(x))))
        return x


class DetectNetwork(nn.Module):
    """Backbone and head: a view and embedded phrases in, what `DetectHead` gives out."""

    def __init__(self, head: DetectHead) -> None:
        super().__init__()
        self.trunk = Trunk(TAPS)
        self.head = head

    def forward(
        self, rgb: UInt8[Tensor, "n h w 3"], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p y x"], Float[Tensor, "n 4 y x"]]:
        return self.head(self.trunk(normalise(rgb)), text)
