"""Hooks on the modules of a pi0 while it is called: learned tokens, and where it looks.

They are removed when the call ends.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch

from vap_core.policies.hooks import report_attention


@contextmanager
def overriding_tokens(policy: Any, learned: Mapping[int, torch.Tensor]) -> Iterator[None]:
    """Inside, the embeddings of learned words are the learned ones, by their tokens."""
    if not learned:
        yield
        return

    def replace_embeddings(module: Any, args: Any, embeddings: torch.Tensor) -> torch.Tensor:
        for token, embedding in learned.items():
            is_token = (args[0] == token)[..., None]
            embeddings = torch.where(is_token, embedding.to(embeddings), embeddings)
        return embeddings

    table = policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens
    hook = table.register_forward_hook(replace_embeddings)
    try:
        yield
    finally:
        hook.remove()


@contextmanager
def reporting_attention(policy: Any, cameras: Sequence[str]) -> Iterator[None]:
    """Inside, a pi0 reports its attention to the image patches of its cameras.

    It is that of the last layer of the action expert, in the mean over heads, actions and
    denoising steps.
    """
    chunk_size = policy.config.chunk_size
    weights: list[torch.Tensor] = []

    def keep_weights(module: Any, args: Any, output: Any) -> None:
        of_actions = output[1][:, :, -chunk_size:]
        weights.append(of_actions.mean(dim=(1, 2)))

    expert = policy.model.paligemma_with_expert.gemma_expert.model
    hook = expert.layers[-1].self_attn.register_forward_hook(keep_weights)
    try:
        yield
    finally:
        hook.remove()
    _report(policy, cameras, torch.stack(weights).mean(0))


def _report(policy: Any, cameras: Sequence[str], weights: torch.Tensor) -> None:
    """Report a map per camera of every episode; `weights` is episodes x attention keys."""
    vision = policy.model.paligemma_with_expert.paligemma.config.vision_config
    side = policy.config.image_resolution[0] // vision.patch_size
    n_cameras = len(cameras)  # lerobot puts empty cameras behind them
    patches = weights[:, : n_cameras * side**2]
    maps = patches.unflatten(1, (n_cameras, side, side)).float().cpu().numpy()
    for i, camera in enumerate(cameras):
        for episode, attention in enumerate(maps[:, i]):
            report_attention(episode, camera, attention)
