"""Checkpoints of lerobot's real policy classes with random weights, a megabyte or two each, saved as a user's own would be."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies import ACTConfig, make_pre_post_processors
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy
from transformers import (
    SmolVLMConfig,
    SmolVLMImageProcessor,
    SmolVLMProcessor,
    SmolVLMVideoProcessor,
)

from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, tokenizer

TOY = Toy(image=64, patch=16, width=32, layers=1, expert=32, chunk=2, denoise=2)
STATE, ACTION = 13, 7
"""What simpler-bridge's WidowX shows and takes: six joints."""
MEAN, STD = 0.002, 0.004


def pi0(folder: Path, cameras: tuple[str, ...] = ("front",)) -> Path:
    return save_toy(folder, cameras, STATE, ACTION, TOY)


def pi05(folder: Path) -> Path:
    return save_toy(folder, ("front",), STATE, ACTION, TOY, "pi05")


def smolvla(folder: Path) -> Path:
    """Its backbone, which a real checkpoint names by its hub id, lies beside it."""
    config = SmolVLAConfig(
        **_features(64), device="cpu", chunk_size=3, n_action_steps=2, resize_imgs_with_padding=(64, 64), tokenizer_max_length=16, num_steps=2,
        num_vlm_layers=2, vlm_model_name=str(_smolvlm(folder.with_name(f"{folder.name}-backbone"))),
    )  # fmt: skip
    return _saved(folder, config, SmolVLAPolicy)


def _smolvlm(folder: Path) -> Path:
    """SmolVLM's configuration, and a processor whose tokenizer knows few words."""
    special = {
        "image_token": "<image>",
        "fake_image_token": "<fake>",
        "global_image_token": "<global>",
        "end_of_utterance_token": "<end>",
    }
    words = tokenizer(
        folder,
        "<s>",
        "</s>",
        *special.values(),
        bos_token="<s>",
        eos_token="</s>",
        extra_special_tokens=special,
    )
    SmolVLMProcessor(
        SmolVLMImageProcessor(), words, SmolVLMVideoProcessor(), image_seq_len=4
    ).save_pretrained(folder)
    numbers = {
        "pad_token_id": words.pad_token_id,
        "bos_token_id": words.bos_token_id,
        "eos_token_id": words.eos_token_id,
        "vocab_size": len(words),
    }
    heads = {"num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16}
    text = {
        "model_type": "llama",
        "hidden_size": 64,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        **heads,
        **numbers,
    }
    seen = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 64,
        "patch_size": 16,
    }
    config = SmolVLMConfig(
        text_config=text,
        vision_config=seen,
        scale_factor=2,
        image_token_id=words.image_token_id,
        pad_token_id=words.pad_token_id,
    )
    config.save_pretrained(folder)
    return folder


def act(folder: Path, side: int = 64, **how: Any) -> Path:
    """One image, no language; actions are un-normalised by a known mean and deviation."""
    config = ACTConfig(
        **_features(side), device="cpu", pretrained_backbone_weights=None, dim_model=32, n_heads=4, dim_feedforward=32, n_encoder_layers=1,
        n_vae_encoder_layers=1, **{"chunk_size": 3, "n_action_steps": 3, **how},
    )  # fmt: skip
    return _saved(folder, config, ACTPolicy)


def act_without_state(folder: Path) -> Path:
    """It reads the image alone."""
    features = _features(64)
    del features["input_features"]["observation.state"]
    config = ACTConfig(
        **features, device="cpu", pretrained_backbone_weights=None, dim_model=32, n_heads=4, dim_feedforward=32,
        n_encoder_layers=1, n_vae_encoder_layers=1, chunk_size=3, n_action_steps=3,
    )  # fmt: skip
    return _saved(folder, config, ACTPolicy)


def vqbet(folder: Path) -> Path:
    """It looks back: queues hold its last three observations, and what is left of a chunk."""
    kept = dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.MEAN_STD)
    config = VQBeTConfig(
        **_features(64), device="cpu", pretrained_backbone_weights=None, crop_shape=None, n_obs_steps=3, n_action_pred_token=2, action_chunk_size=2,
        normalization_mapping=kept, vqvae_embedding_dim=16, vqvae_enc_hidden_dim=16, gpt_input_dim=32, gpt_output_dim=32, gpt_n_layer=1,
        gpt_n_head=2, gpt_hidden_dim=32, gpt_block_size=16, spatial_softmax_num_keypoints=4,
    )  # fmt: skip
    return _saved(folder, config, _vqbet_past_its_first_phase)


def _vqbet_past_its_first_phase(config: VQBeTConfig) -> VQBeTPolicy:
    """As after the training of its codes, without which it warns at every call."""
    policy = VQBeTPolicy(config)
    policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    return policy


def act_of(folder: Path, cameras: tuple[str, ...], side: int, state: int, action: int) -> Path:
    """`act` for any cameras and any sizes of state and action."""
    config = ACTConfig(
        **_features(side, cameras, state, action), device="cpu", pretrained_backbone_weights=None, dim_model=32, n_heads=4,
        dim_feedforward=32, n_encoder_layers=1, n_vae_encoder_layers=1, chunk_size=3, n_action_steps=3,
    )  # fmt: skip
    return _saved(folder, config, ACTPolicy, cameras, state, action)


def _features(
    side: int, cameras: tuple[str, ...] = ("front",), state: int = STATE, action: int = ACTION
) -> dict[str, Any]:
    seen = {}
    for camera in cameras:
        seen[f"observation.images.{camera}"] = PolicyFeature(FeatureType.VISUAL, (3, side, side))
    seen["observation.state"] = PolicyFeature(FeatureType.STATE, (state,))
    return {
        "input_features": seen,
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (action,))},
    }


def _saved(
    folder: Path,
    config: Any,
    kind: Any,
    cameras: tuple[str, ...] = ("front",),
    state: int = STATE,
    action: int = ACTION,
) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        kind(config).save_pretrained(folder)
    stats = {
        "observation.state": {"mean": torch.zeros(state), "std": torch.ones(state)},
        "action": {"mean": torch.full((action,), MEAN), "std": torch.full((action,), STD)},
    }
    for camera in cameras:
        key = f"observation.images.{camera}"
        stats[key] = {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder
