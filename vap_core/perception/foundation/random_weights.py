"""Networks of the published sizes with random weights: as fast, and as large, as trained ones."""

from typing import Any

import torch

from vap_core.perception.foundation.architectures import network_class, quiet_transformers
from vap_core.perception.foundation.edgetam import REPVIT, backbone_without_hub

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
        case "GroundingDinoForObjectDetection":
            return hf.GroundingDinoConfig(backbone_config=_swin(model))
        case "MMGroundingDinoForObjectDetection":
            return hf.MMGroundingDinoConfig(backbone_config=_swin(model))
        case "Sam3Model":
            return hf.Sam3Config()
        case "Dinov2Model":
            return hf.Dinov2Config(**VIT_SIZES[model], image_size=518)
        case "DINOv3ViTModel":
            return hf.DINOv3ViTConfig(num_register_tokens=4)
        case "SiglipVisionModel":
            return hf.SiglipVisionConfig()
        case "Sam2VideoModel":
            hiera = hf.Sam2HieraDetConfig(**HIERA_SIZES[model])
            channels = hiera.embed_dim_per_stage[::-1]
            vision = hf.Sam2VisionConfig(backbone_config=hiera, backbone_channel_list=channels)
            return hf.Sam2VideoConfig(vision_config=vision)
        case "Sam3TrackerVideoModel":
            return hf.Sam3TrackerVideoConfig()
        case "EdgeTamVideoModel":
            repvit = hf.TimmWrapperConfig(architecture="repvit_m1", model_args=REPVIT)
            return hf.EdgeTamVideoConfig(
                vision_config=hf.EdgeTamVisionConfig(backbone_config=repvit),
                enable_temporal_pos_encoding_for_object_pointers=False,
                enable_occlusion_spatial_embedding=False,
            )
    raise KeyError(name)


def _swin(model: str) -> Any:
    """The backbone of the detectors whose names end in their size."""
    import transformers

    hf: Any = transformers
    size = SWIN_BASE if model.endswith("-base") else SWIN_TINY
    return hf.SwinConfig(**size, out_indices=[2, 3, 4])


def letter_tokenizer() -> Any:
    """A BERT tokenizer of letters, with the special tokens where bert-base-uncased has them.

    It says nothing that a network was trained to read.
    """
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
