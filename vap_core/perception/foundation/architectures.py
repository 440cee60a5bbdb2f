"""From folders of weights, or from networks with random ones, to the parts of a stack."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from vap_core.base.errors import MissingWeights
from vap_core.perception.foundation.detector import GroundingDino, PhraseDetector
from vap_core.perception.foundation.edgetam import EdgeTamTracker, backbone_without_hub
from vap_core.perception.foundation.encoder import (
    DINO,
    DINOV3,
    SIGLIP,
    CropEncoder,
    CropRecipe,
    PooledEncoder,
)
from vap_core.perception.foundation.pixels import CENTRED, IMAGENET, Normalisation
from vap_core.perception.foundation.runtime import Runtime
from vap_core.perception.foundation.sam3 import Sam3Detector
from vap_core.perception.foundation.segmenter import Sam, SamSegmenter
from vap_core.perception.foundation.store import VerifiedWeights
from vap_core.perception.foundation.tracker import SamTracker

CLASSES = {
    "detector": {
        "grounding-dino-": "GroundingDinoForObjectDetection",
        "llmdet-": "MMGroundingDinoForObjectDetection",
        "mm-grounding-dino-": "MMGroundingDinoForObjectDetection",
        "sam3": "Sam3Model",
    },
    "encoder": {
        "dinov2-": "Dinov2Model",
        "dinov3-": "DINOv3ViTModel",
        "siglip2-": "SiglipVisionModel",
    },
    "tracker": {
        "sam2.1-": "Sam2VideoModel",
        "sam3": "Sam3TrackerVideoModel",
        "edgetam": "EdgeTamVideoModel",
    },
}
"""transformers' class by role, of the models whose names begin so."""
ENCODERS: dict[str, tuple[type[CropEncoder], CropRecipe]] = {
    "Dinov2Model": (CropEncoder, DINO),
    "DINOv3ViTModel": (CropEncoder, DINOV3),
    "SiglipVisionModel": (PooledEncoder, SIGLIP),
}
TRACKERS: dict[str, tuple[type[SamTracker], Normalisation]] = {
    "Sam2VideoModel": (SamTracker, IMAGENET),
    "Sam3TrackerVideoModel": (SamTracker, CENTRED),
    "EdgeTamVideoModel": (EdgeTamTracker, IMAGENET),
}


def network_class(role: str, model: str) -> str:
    """transformers' class of a model of `sources.PARTS` in a role. Raises: KeyError."""
    for beginning, name in CLASSES[role].items():
        if model.startswith(beginning):
            return name
    raise KeyError(model)


def read_part(role: str, model: str, weights: VerifiedWeights, runtime: Runtime) -> dict[str, Any]:
    """The fields of a `Stack` that one model fills, and those that it makes empty.

    Safetensors and JSON are read, and no code.

    Raises: MissingWeights: a file that transformers cannot read as the network it should be.
    """
    import transformers

    tokenizer = None
    with quiet_transformers(), backbone_without_hub():
        network = _read_network(getattr(transformers, network_class(role, model)), weights)
        if role == "detector":
            tokenizer = transformers.AutoTokenizer.from_pretrained(
                weights.folder, local_files_only=True
            )
    return fill_part(role, network, tokenizer, weights.identity, runtime)


def fill_part(
    role: str, network: Any, tokenizer: Any, name: str, runtime: Runtime
) -> dict[str, Any]:
    """As `read_part`, from a network in memory; put the adapter around it, with the pre-processing
    that it was trained with. A detector has a tokenizer; an encoder's `name` is stored with every
    memory.
    """
    kind = type(network).__name__
    if role == "detector":
        return {"detector": _detector(kind, network, tokenizer, runtime), "by_category": None}
    if role == "encoder":
        encoder, recipe = ENCODERS[kind]
        filled = encoder(model=network, recipe=recipe, name=name, runtime=runtime)
        return {"encoder": filled, "unfamiliar_encoder": None}
    tracker, normalisation = TRACKERS[kind]
    sam = Sam(network, runtime, normalisation)
    return {"segmenter": SamSegmenter(sam), "tracker": tracker(sam)}


def _detector(kind: str, network: Any, tokenizer: Any, runtime: Runtime) -> PhraseDetector:
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
        GroundingDinoImageProcessorPil,
    )

    if kind == "Sam3Model":
        return Sam3Detector(network, tokenizer, runtime)
    return GroundingDino(
        model=network,
        tokenizer=tokenizer,
        processor=GroundingDinoImageProcessorPil(),
        runtime=runtime,
    )


@contextmanager
def quiet_transformers() -> Iterator[None]:
    """Without transformers' progress bars and notes."""
    from transformers.utils import logging

    level = logging.get_verbosity()
    bars = logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def _read_network(cls: Any, weights: VerifiedWeights) -> Any:
    try:
        network, info = cls.from_pretrained(
            weights.folder,
            local_files_only=True,
            use_safetensors=True,
            dtype=torch.float32,
            output_loading_info=True,
        )
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise MissingWeights(
            f"foundation: {weights.folder} cannot be read as {cls.__name__} "
            f"({_first_line(error)}); pull it again."
        ) from error
    missing = sorted(info["missing_keys"])
    if missing:
        raise MissingWeights(
            f"foundation: {weights.folder} lacks {len(missing)} tensors of {cls.__name__}, "
            f"such as {missing[0]}; pull it again."
        )
    return network


def _first_line(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0][:160]
