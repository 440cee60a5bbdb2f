"""The real classes of the foundation stack at toy size with random weights, saved as a user's own folder of weights would be."""

from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from vap_core.perception.foundation.architectures import letter_tokenizer, quiet_transformers
from vap_core.perception.foundation.weights import KINDS, MODELS, TENSORS, Source, pull

KIND = "foundation"


def networks() -> tuple[Any, Any, Any]:
    """Detector, encoder and SAM; drawn wide enough that answers differ from input to input."""
    from transformers import (
        BertConfig,
        Dinov2Config,
        Dinov2Model,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        Sam2HieraDetConfig,
        Sam2VideoConfig,
        Sam2VideoMaskDecoderConfig,
        Sam2VideoModel,
        Sam2VideoPromptEncoderConfig,
        Sam2VisionConfig,
        SwinConfig,
    )

    swin = SwinConfig(
        image_size=64,
        embed_dim=16,
        depths=[1, 1, 1, 1],
        num_heads=[1, 2, 4, 8],
        window_size=4,
        out_indices=[2, 3, 4],
    )
    bert = BertConfig(
        hidden_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=64,
        vocab_size=1030,
    )
    grounding = GroundingDinoConfig(
        backbone_config=swin, text_config=bert, d_model=32, num_queries=30, encoder_layers=1, decoder_layers=2,
        encoder_attention_heads=2, decoder_attention_heads=2, encoder_ffn_dim=64, decoder_ffn_dim=64,
    )  # fmt: skip
    dino = Dinov2Config(hidden_size=48, num_hidden_layers=2, num_attention_heads=4, image_size=224)
    hiera = Sam2HieraDetConfig(
        hidden_size=8, num_attention_heads=1, image_size=[128, 128], blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8], window_size_per_stage=[8, 4, 8, 4], global_attention_blocks=[3],
    )  # fmt: skip
    sizes = [[32, 32], [16, 16], [8, 8]]
    vision = Sam2VisionConfig(
        backbone_config=hiera,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=sizes,
        fpn_hidden_size=128,
    )
    sam = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config=Sam2VideoPromptEncoderConfig(hidden_size=128, image_size=128),
        mask_decoder_config=Sam2VideoMaskDecoderConfig(hidden_size=128, mlp_dim=64, num_attention_heads=4, iou_head_hidden_dim=32),
        image_size=128, memory_attention_hidden_size=128, memory_attention_num_layers=2, memory_attention_feed_forward_hidden_size=64,
        memory_attention_rope_feat_sizes=[8, 8], memory_encoder_hidden_size=128, mask_downsampler_embed_dim=128, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=128,
    )  # fmt: skip
    with quiet_transformers(), torch.random.fork_rng():
        torch.manual_seed(0)
        nets = GroundingDinoForObjectDetection(grounding), Dinov2Model(dino), Sam2VideoModel(sam)
        for net in nets:
            draw(net)
    return tuple(net.eval() for net in nets)


def draw(net: Any, presence: float = 50.5) -> None:
    """Weights so wide that answers differ from input to input; `presence` lets identities come and go."""
    for name, weight in net.named_parameters():
        if weight.ndim > 1 and weight.numel() and "norm" not in name:
            gain = (
                1.5
                if "memory_attention" in name
                else 4.0
                if "mask_decoder.pred_obj" in name
                else 0.9
            )
            torch.nn.init.normal_(weight, std=gain / weight[0].numel() ** 0.5)
    drawn = (
        "memory_temporal_positional_encoding",
        "no_memory_embedding",
        "no_object_pointer",
        "occlusion_spatial_embedding_parameter",
    )
    for name, weight in net.named_parameters():
        if name.rpartition(".")[2] in drawn:
            torch.nn.init.normal_(weight, std=1.0)
        elif name.endswith("pred_obj_score_head.proj_out.bias"):
            torch.nn.init.constant_(weight, presence)


def save(origin: Path) -> Path:
    """Folders owner/name below `origin`, as a hub download would leave them."""
    detector, encoder, sam = (origin / MODELS[name].repo for name in KINDS[KIND])
    for net, folder in zip(networks(), (detector, encoder, sam), strict=True):
        net.save_pretrained(folder)
    letter_tokenizer().save_pretrained(detector)
    return origin


def store(folder: Path) -> Path:
    """A store filled by the same route that a cluster without internet takes."""
    pull(
        KINDS[KIND],
        folder / "store",
        origin=save(folder / "origin"),
        unpinned=True,
        say=lambda line: None,
    )
    return folder / "store"


def placeholder(folder: Path, source: Source) -> None:
    """The files of a model, a few bytes each."""
    folder.mkdir(parents=True)
    for file in source.small_files:
        (folder / file).write_text(f'{{"of": "{source.repo}"}}')
    save_file({"weight": torch.arange(4.0)}, folder / TENSORS)
