"""Images as the input of the networks that take a square, whatever the image's shape."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb


@dataclass(frozen=True)
class Normalisation:
    """Mean and standard deviation per channel, of levels from 0 to 1."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


IMAGENET = Normalisation(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
CENTRED = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
"""From -1 to 1."""


def to_model(
    image: Rgb, side: int, device: torch.device, normalisation: Normalisation = IMAGENET
) -> Float[Tensor, "1 3 s s"]:
    """The image as the model's input.

    It is stretched to a square with antialiased bilinear resampling in 8 bits, and normalised.
    """
    stretched = F.interpolate(
        torch.from_numpy(image.copy()).permute(2, 0, 1)[None],
        (side, side),
        mode="bilinear",
        antialias=True,
    )
    mean = torch.tensor(normalisation.mean, device=device)[:, None, None]
    std = torch.tensor(normalisation.std, device=device)[:, None, None]
    return (stretched.to(device).float() / 255 - mean) / std
