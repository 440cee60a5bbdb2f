"""EdgeTAM on a stream: SAM 2's tracker with a smaller memory.

A resampler turns each identity's map of a frame into a few hundred tokens: some summarise the whole
map, the others a window each.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vap_core.perception.foundation.tracker import SamTracker


class EdgeTamTracker(SamTracker):
    """EdgeTAM's tracker."""

    def _stored(self, maps: Float[Tensor, "n m h w"]) -> Float[Tensor, "p n m"]:
        """The resampler takes one identity at a time; its tokens stay in single precision."""
        kept: list[Tensor] = []
        with self.sam.runtime.inference():
            for one in maps:
                tokens, _ = self.sam.model.spatial_perceiver(one[None], self.map_positions)
                kept.append(tokens.float())
        return torch.cat(kept).transpose(0, 1)

    def _cell_positions(self) -> Float[Tensor, "p 1 m"]:
        """Tokens of windows have one, those of whole maps none; they depend on no image."""
        nothing = torch.zeros_like(self.map_positions)
        _, positions = self.sam.model.spatial_perceiver(nothing, self.map_positions)
        return positions.float().transpose(0, 1)

    def _attention_options(self, maps: int) -> dict[str, int]:
        return {"num_spatial_memory_tokens": maps}


REPVIT: dict[str, Any] = {"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3]}
"""How EdgeTAM takes timm's network of that name."""


@contextmanager
def backbone_without_hub() -> Iterator[None]:
    """EdgeTAM's configurations are made without a question to the hub.

    transformers (5.5) compares a configuration with the default one whenever it describes it, also
    while it reads one from a folder, and takes the default's backbone from the hub.
    """
    import transformers
    from transformers.models.edgetam import configuration_edgetam

    hf: Any = transformers
    module: Any = configuration_edgetam

    class Local:
        @staticmethod
        def from_pretrained(name: str, model_args: dict[str, Any]) -> Any:
            architecture = name.rpartition("/")[2].partition(".")[0]
            return hf.TimmWrapperConfig(architecture=architecture, model_args=model_args)

    hub = module.AutoConfig
    module.AutoConfig = Local
    try:
        yield
    finally:
        module.AutoConfig = hub
