"""From folders of weights, or from networks with random ones, to the parts of a stack."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from vap_core.base.errors import MissingWeights
from vap_core.perception.foundation.models import (
    CENTRED,
    DINO,
    DINOV3,
    IMAGENET,
    SIGLIP,
    CropEncoder,
    GroundingDino,
    Normalisation,
    Runtime,
    Sam,
    Sam3Detector,
    SamSegmenter,
)
from vap_core.perception.foundation.tracker import (
    REPVIT,
    EdgeTamTracker,
    SamTracker,
    backbone_without_hub,
)
from vap_core.perception.foundation.weights import VerifiedWeights

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
ENCODERS = {"Dinov2Model": DINO, "DINOv3ViTModel": DINOV3, "SiglipVisionModel": SIGLIP}
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
    cls = getattr(transformers, network_class(role, model))
    with quiet_transformers(), backbone_without_hub():
        try:
            network, info = cls.from_pretrained(
                weights.folder,
                local_files_only=True,
                use_safetensors=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
        except (OSError, ValueError, RuntimeError, KeyError) as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0][:160]
            raise MissingWeights(
                f"foundation: {weights.folder} cannot be read as {cls.__name__} ({reason}); "
                "pull it again."
            ) from error
        missing = sorted(info["missing_keys"])
        if missing:
            raise MissingWeights(
                f"foundation: {weights.folder} lacks {len(missing)} tensors of {cls.__name__}, "
                f"such as {missing[0]}; pull it again."
            )
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
        detector = (
            Sam3Detector(network, tokenizer, runtime)
            if kind == "Sam3Model"
            else GroundingDino(network, tokenizer, runtime)
        )
        return {"detector": detector, "by_category": None}
    if role == "encoder":
        encoder = CropEncoder(network, ENCODERS[kind], name, runtime)
        return {"encoder": encoder, "unfamiliar_encoder": None}
    tracker, normalisation = TRACKERS[kind]
    sam = Sam(network, runtime, normalisation)
    return {"segmenter": SamSegmenter(sam), "tracker": tracker(sam)}


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


SWIN_BASE: dict[str, Any] = {
    "embed_dim": 128,
    "depths": [2, 2, 18, 2],
    "num_heads": [4, 8, 16, 32],
    "window_size": 12,
    "image_size": 384,
}
SWIN_TINY: dict[str, Any] = {
    "embed_dim": 96,
    "depths": [2, 2, 6, 2],
    "num_heads": [3, 6, 12, 24],
    "window_size": 7,
    "image_size": 224,
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


def random_network(role: str, model: str) -> Any:
    """transformers' network of a model of `sources.PARTS` in a role, on the CPU."""
    import transformers

    name = network_class(role, model)
    with quiet_transformers(), backbone_without_hub(), torch.random.fork_rng():
        torch.manual_seed(0)
        return getattr(transformers, name)(published_config(name, model))


def published_config(name: str, model: str) -> Any:
    """The configuration of a model, for transformers' class of that name. Raises: KeyError."""
    import transformers

    hf: Any = transformers  # its configurations take more than they declare
    match name:
        case "GroundingDinoForObjectDetection" | "MMGroundingDinoForObjectDetection":
            size = SWIN_BASE if model.endswith("-base") else SWIN_TINY
            config = getattr(hf, name.replace("ForObjectDetection", "Config"))
            return config(backbone_config=hf.SwinConfig(**size, out_indices=[2, 3, 4]))
        case "Dinov2Model":
            return hf.Dinov2Config(**VIT_SIZES[model], image_size=518)
        case "DINOv3ViTModel":
            return hf.DINOv3ViTConfig(num_register_tokens=4)
        case "Sam2VideoModel":
            hiera = hf.Sam2HieraDetConfig(**HIERA_SIZES[model])
            channels = hiera.embed_dim_per_stage[::-1]
            vision = hf.Sam2VisionConfig(backbone_config=hiera, backbone_channel_list=channels)
            return hf.Sam2VideoConfig(vision_config=vision)
        case "EdgeTamVideoModel":
            repvit = hf.TimmWrapperConfig(architecture="repvit_m1", model_args=REPVIT)
            return hf.EdgeTamVideoConfig(
                vision_config=hf.EdgeTamVisionConfig(backbone_config=repvit),
                enable_temporal_pos_encoding_for_object_pointers=False,
                enable_occlusion_spatial_embedding=False,
            )
        case "Sam3Model" | "SiglipVisionModel" | "Sam3TrackerVideoModel":
            return getattr(hf, name.replace("Model", "Config"))()
    raise KeyError(name)


def letter_tokenizer() -> Any:
    """A BERT tokenizer of letters, with the special tokens where bert-base-uncased has them.

    It says nothing that a network was trained to read.
    """
    from transformers import BertTokenizer

    tokens = [f"[unused{i}]" for i in range(1030)]
    special = {
        0: "[PAD]",
        100: "[UNK]",
        101: "[CLS]",
        102: "[SEP]",
        103: "[MASK]",
        1012: ".",
        1029: "?",
    }
    for i, token in special.items():
        tokens[i] = token
    for i, letter in enumerate("abcdefghijklmnopqrstuvwxyz"):
        tokens[200 + 2 * i] = letter
        tokens[201 + 2 * i] = f"##{letter}"
    return BertTokenizer(vocab={token: i for i, token in enumerate(tokens)})
