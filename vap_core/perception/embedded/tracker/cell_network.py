"""The tracker's network as a torch module; its graph is exported from here."""

from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.perception.embedded.backbone import Trunk, normalise
from vap_core.perception.embedded.taps import CHANNELS
from vap_core.perception.embedded.tracker.cells import TAP


class CellNetwork(nn.Module):
    """The shallow backbone: an image in, unit-length features of every cell out, row by row."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Trunk([TAP])

    def forward(self, rgb: UInt8[Tensor, "1 h w 3"]) -> tuple[Float[Tensor, "p c"]]:
        maps = self.trunk(normalise(rgb))[TAP][0]
        keys = maps.reshape(CHANNELS[TAP], -1).T
        return (F.normalize(keys, dim=1).contiguous(),)
