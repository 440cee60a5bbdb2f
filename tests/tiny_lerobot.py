"""Checkpoints of lerobot's real policy classes with random weights, a megabyte or two each, saved as a user's own would be."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import ACTConfig, make_pre_post_processors
from lerobot.policies.act.modeling_act import ACTPolicy

from vap_core.policies.toy_pi0 import Toy, save_toy

TOY = Toy(image=64, patch=16, width=32, layers=1, expert=32, chunk=2, denoise=2)
STATE, ACTION = 13, 7
"""What simpler-bridge's WidowX shows and takes: six joints."""
MEAN, STD = 0.002, 0.004


def pi0(folder: Path, cameras: tuple[str, ...] = ("front",)) -> Path:
    return save_toy(folder, cameras, STATE, ACTION, TOY)


def pi05(folder: Path) -> Path:
    return save_toy(folder, ("front",), STATE, ACTION, TOY, "pi05")


def act(folder: Path, side: int = 64, **how: Any) -> Path:
    """One image, no language; actions are un-normalised by a known mean and deviation."""
    config = ACTConfig(
        input_features={
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, side, side)),
            "observation.state": PolicyFeature(FeatureType.STATE, (STATE,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
        device="cpu", pretrained_backbone_weights=None, dim_model=32, n_heads=4, dim_feedforward=32, n_encoder_layers=1, n_vae_encoder_layers=1,
        **{"chunk_size": 3, "n_action_steps": 3, **how},
    )  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(0)
        ACTPolicy(config).save_pretrained(folder)
    stats = {
        "observation.images.front": {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)},
        "observation.state": {"mean": torch.zeros(STATE), "std": torch.ones(STATE)},
        "action": {"mean": torch.full((ACTION,), MEAN), "std": torch.full((ACTION,), STD)},
    }
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder
