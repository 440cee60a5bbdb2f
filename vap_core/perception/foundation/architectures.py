"""From folders of weights, or from published sizes with random ones, to the four models."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from vap_core.base.errors import MissingWeights
from vap_core.perception.foundation.detector import GroundingDino
from vap_core.perception.foundation.encoder import (
    DINO,
    DINOV3,
    SIGLIP,
    CropEncoder,
    CropRecipe,
    PooledEncoder,
)
from vap_core.perception.foundation.runtime import Runtime
from vap_core.perception.foundation.segmenter import Sam, SamSegmenter
from vap_core.perception.foundation.sources import KINDS
from vap_core.perception.foundation.store import VerifiedWeights
from vap_core.perception.foundation.tracker import SamTracker
from vap_core.perception.protocols import Stack

SWIN_SIZES: dict[str, dict[str, Any]] = {
    "grounding-dino-base": {
        "embed_dim": 128,
        "depths": [2, 2, 18, 2],
        "num_heads": [4, 8, 16, 32],
        "window_size": 12,
        "image_size": 384,
    },
    "grounding-dino-tiny": {
        "embed_dim": 96,
        "depths": [2, 2, 6, 2],
        "num_heads": [3, 6, 12, 24],
        "window_size": 7,
        "image_size": 224,
    },
}
VIT_SIZES: dict[str, dict[str, Any]] = {
    "dinov2-base": {"hidden_size": 768, "num_attention_heads": 12},
    "dinov2-small": {"hidden_size": 384, "num_attention_heads": 6},
}
HIERA_SIZES: dict[str, dict[str, Any]] = {
    "sam2.1-hiera-large": {
        "hidden_size": 144,
        "num_attention_heads": 2,
        "blocks_per_stage": [2, 6, 36, 4],
        "embed_dim_per_stage": [144, 288, 576, 1152],
        "num_attention_heads_per_stage": [2, 4, 8, 16],
        "window_size_per_stage": [8, 4, 16, 8],
        "global_attention_blocks": [23, 33, 43],
    },
    "sam2.1-hiera-tiny": {},
}


CLASSES = {
    "grounding-dino-": "GroundingDinoForObjectDetection",
    "llmdet-": "MMGroundingDinoForObjectDetection",
    "mm-grounding-dino-": "MMGroundingDinoForObjectDetection",
    "dinov2-": "Dinov2Model",
    "dinov3-": "DINOv3ViTModel",
    "siglip2-": "SiglipVisionModel",
    "sam2.1-": "Sam2VideoModel",
}
"""transformers' class of the models whose names begin so."""
ENCODERS: dict[str, tuple[type[CropEncoder], CropRecipe]] = {
    "Dinov2Model": (CropEncoder, DINO),
    "DINOv3ViTModel": (CropEncoder, DINOV3),
    "SiglipVisionModel": (PooledEncoder, SIGLIP),
}


@dataclass(frozen=True)
class Networks:
    """transformers' models of one stack, on the CPU; `encoder_name` is stored with every memory."""

    detector: Any
    tokenizer: Any
    encoder: Any
    encoder_name: str
    sam: Any


def assemble(kind: str, networks: Networks, runtime: Runtime) -> Stack:
    """Put the adapters around the networks, with the pre-processing that they were trained with."""
    sam = Sam(networks.sam, runtime)
    return Stack(
        name=kind,
        detector=_detector(networks.detector, networks.tokenizer, runtime),
        encoder=CropEncoder(
            model=networks.encoder, recipe=DINO, name=networks.encoder_name, runtime=runtime
        ),
        segmenter=SamSegmenter(sam),
        tracker=SamTracker(sam),
    )


def _detector(network: Any, tokenizer: Any, runtime: Runtime) -> GroundingDino:
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
        GroundingDinoImageProcessorPil,
    )

    return GroundingDino(
        model=network,
        tokenizer=tokenizer,
        processor=GroundingDinoImageProcessorPil(),
        runtime=runtime,
    )


def network_class(model: str) -> str:
    """transformers' class of a model of `sources.PARTS`."""
    for beginning, name in CLASSES.items():
        if model.startswith(beginning):
            return name
    raise KeyError(model)


def read_part(role: str, model: str, weights: VerifiedWeights, runtime: Runtime) -> dict[str, Any]:
    """The fields of a `Stack` that one model fills, and those that it makes empty.

    Raises: MissingWeights: a file that transformers cannot read as the network it should be.
    """
    import transformers

    with quiet_transformers():
        network = _read_network(getattr(transformers, network_class(model)), weights)
        if role == "detector":
            tokenizer = transformers.AutoTokenizer.from_pretrained(
                weights.folder, local_files_only=True
            )
            detector = _detector(network, tokenizer, runtime)
            return {"detector": detector, "by_category": None}
    if role == "encoder":
        encoder, recipe = ENCODERS[network_class(model)]
        filled = encoder(model=network, recipe=recipe, name=weights.identity, runtime=runtime)
        return {"encoder": filled, "unfamiliar_encoder": None}
    sam = Sam(network, runtime)
    return {"segmenter": SamSegmenter(sam), "tracker": SamTracker(sam)}


def read_networks(
    detector: VerifiedWeights, encoder: VerifiedWeights, sam: VerifiedWeights
) -> Networks:
    """Networks from verified folders; safetensors and JSON only, and no code from them.

    Raises: MissingWeights: a file that transformers cannot read as the network it should be.
    """
    from transformers import (
        AutoTokenizer,
        Dinov2Model,
        GroundingDinoForObjectDetection,
        Sam2VideoModel,
    )

    with quiet_transformers():
        tokenizer = AutoTokenizer.from_pretrained(detector.folder, local_files_only=True)
        return Networks(
            detector=_read_network(GroundingDinoForObjectDetection, detector),
            tokenizer=tokenizer,
            encoder=_read_network(Dinov2Model, encoder),
            encoder_name=encoder.identity,
            sam=_read_network(Sam2VideoModel, sam),
        )


def random_networks(kind: str, seed: int = 0) -> Networks:
    """Random networks of the published sizes; the tokenizer knows single letters only."""
    import transformers

    hf: Any = transformers  # its configurations take more than they declare
    detector, encoder, sam = KINDS[kind]
    hiera = hf.Sam2HieraDetConfig(**HIERA_SIZES[sam])
    vision = hf.Sam2VisionConfig(
        backbone_config=hiera, backbone_channel_list=hiera.embed_dim_per_stage[::-1]
    )
    swin = hf.SwinConfig(**SWIN_SIZES[detector], out_indices=[2, 3, 4])
    grounding = hf.GroundingDinoConfig(backbone_config=swin)
    dino = hf.Dinov2Config(**VIT_SIZES[encoder], image_size=518)
    with quiet_transformers(), torch.random.fork_rng():
        torch.manual_seed(seed)
        return Networks(
            detector=hf.GroundingDinoForObjectDetection(grounding),
            tokenizer=letter_tokenizer(),
            encoder=hf.Dinov2Model(dino),
            encoder_name=f"{encoder}-random",
            sam=hf.Sam2VideoModel(hf.Sam2VideoConfig(vision_config=vision)),
        )


def letter_tokenizer() -> Any:
    """A BERT tokenizer of letters, with the special tokens where bert-base-uncased has them."""
    from transformers import BertTokenizer

    tokens = [f"[unused{i}]" for i in range(1030)]
    tokens[0] = "[PAD]"
    tokens[100] = "[UNK]"
    tokens[101] = "[CLS]"
    tokens[102] = "[SEP]"
    tokens[103] = "[MASK]"
    tokens[1012] = "."
    tokens[1029] = "?"
    for i, letter in enumerate("abcdefghijklmnopqrstuvwxyz"):
        tokens[200 + 2 * i] = letter
        tokens[201 + 2 * i] = f"##{letter}"
    return BertTokenizer(vocab={token: i for i, token in enumerate(tokens)})


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
