"""What the image patches and the layers contribute to the actions of a policy: causal measures.

Attention says what is mixed, not what it is mixed for. `gradient_maps` is the gradient of the
actions times the activation of every patch, `masking_maps` the change of the actions when a patch
is painted over. Both take the same sampling noise as the episode. `layer_effects` sets each layer's
queries to zero in turn.
"""

import inspect
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float32

from vap_core.base.errors import BadPolicy
from vap_core.policies.lerobot.adapter import IMAGE, STATE, LeRobot, LeRobotState, load_policy
from vap_core.policies.lerobot.hooks import layout, overriding_tokens
from vap_core.policies.protocol import Chunk, PolicyInput, observe_attention

if TYPE_CHECKING:
    import pandas as pd

Map = Float32[np.ndarray, "rows columns"]


def gradient_maps(
    policy: LeRobot, state: LeRobotState, policy_input: PolicyInput
) -> dict[str, Map]:
    """Size of the gradient times activation of every patch, by camera.

    The scalar is half the squared length of the normalised actions that are executed. Activations
    are the patches' embeddings, as the vision-language model reads them.

    Raises: BadPolicy when the inputs do not fit.
    """
    batch, noise = policy.prepare([state], [policy_input])
    activations: list[torch.Tensor] = []

    def keep(module: Any, args: Any, output: torch.Tensor) -> torch.Tensor:
        activations.append(output.detach().requires_grad_(True))
        return activations[-1]

    model = policy.policy.model
    hook = projector(model).register_forward_hook(keep)
    try:
        with _gradients(model), overriding_tokens(policy.policy, policy.learned):
            predict = inspect.unwrap(type(policy.policy).predict_action_chunk)
            planned = predict(policy.policy, batch, noise=noise)[:, : policy.execute]
            (0.5 * planned.square().sum()).backward()
    finally:
        hook.remove()
    camera, *_ = policy.cameras()
    side = layout(policy.policy, [camera], policy_input.images[camera].shape[1]).side
    maps = {}
    for camera, activation in zip(policy.cameras(), activations, strict=False):
        assert activation.grad is not None
        relevance = (activation.grad * activation).sum(-1).abs().detach()
        maps[camera] = relevance.reshape(side, side).cpu().numpy()
    return maps


def projector(model: Any) -> torch.nn.Module:
    """The module that gives the patches' embeddings."""
    if hasattr(model, "vlm_with_expert"):
        return model.vlm_with_expert.get_vlm_model().connector
    return model.paligemma_with_expert.paligemma.model.multi_modal_projector


@torch.inference_mode()
def masking_maps(policy: LeRobot, state: LeRobotState, policy_input: PolicyInput) -> dict[str, Map]:
    """Change of the normalised actions that are executed when a patch is masked, by camera.

    A patch is painted with the mean colour of its view.

    Raises: BadPolicy when the inputs do not fit.
    """
    camera, *_ = policy.cameras()
    side = layout(policy.policy, [camera], policy_input.images[camera].shape[1]).side
    plain = _planned(policy, state, [policy_input])
    maps = {}
    for camera in policy.cameras():
        rgb = policy_input.images[camera]
        mean = rgb.mean((0, 1)).round().astype(np.uint8)
        rows = np.linspace(0, rgb.shape[0], side + 1).round().astype(int)
        columns = np.linspace(0, rgb.shape[1], side + 1).round().astype(int)
        masked = []
        for i in range(side):
            for j in range(side):
                painted = rgb.copy()
                painted[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = mean
                images = {**policy_input.images, camera: painted}
                masked.append(replace(policy_input, images=images))
        change = _planned(policy, state, masked) - plain
        maps[camera] = change.flatten(1).norm(dim=1).reshape(side, side).cpu().numpy()
    return maps


def _planned(
    policy: LeRobot, state: LeRobotState, inputs: list[PolicyInput]
) -> Float32[torch.Tensor, "b execute action"]:
    """The normalised actions that are executed."""
    batch, noise = policy.prepare([state] * len(inputs), inputs)
    with overriding_tokens(policy.policy, policy.learned):
        planned = policy.policy.predict_action_chunk(batch, noise=noise)
    return planned[:, : policy.execute]


@contextmanager
def _gradients(model: Any) -> Iterator[None]:
    """Inside, sampling keeps gradients, which lerobot switches off by a decorator."""
    with ExitStack() as patches:
        for kind in type(model).__mro__:
            sample = vars(kind).get("sample_actions")
            if sample is not None and hasattr(sample, "__wrapped__"):
                patches.enter_context(patch.object(kind, "sample_actions", sample.__wrapped__))
        patches.enter_context(torch.enable_grad())
        yield


def layer_effects(folder: Path) -> "pd.DataFrame":
    """Largest change of an action of the policy in a folder when a layer attends evenly.

    It is a pi0, pi0.5 or mini-pi0. Two rows: the vision-language model, whose queries are patches
    and words, and the action expert. The input is noise under a real instruction.

    Raises: BadPolicy, as `load_policy`, or for another kind of policy.
    """
    import pandas as pd

    policy = load_policy(folder)
    towers = getattr(getattr(policy.policy, "model", None), "paligemma_with_expert", None)
    if towers is None:
        raise BadPolicy(
            f"layer_effects: {policy.label} is no pi0, whose layers are known here; give the "
            "folder of a pi0, pi0.5 or mini-pi0."
        )
    look = noise_input(policy, np.random.default_rng(0), 112)

    def chunk() -> Chunk:
        with observe_attention():  # eager
            return policy.plan([policy.start(np.random.default_rng(0))], [look])[1][0]

    plain = chunk()
    rows: dict[str, dict[int, float]] = {}
    for name, decoder in (
        ("vision-language model", towers.paligemma.model.language_model),
        ("action expert", towers.gemma_expert.model),
    ):
        rows[name] = {}
        for i, layer in enumerate(decoder.layers):
            weight = layer.self_attn.q_proj.weight
            kept = weight.clone()
            try:
                weight.zero_()
                rows[name][i + 1] = float(np.abs(chunk() - plain).max())
            finally:
                weight.copy_(kept)
    return pd.DataFrame(rows).T.rename_axis("layer", axis=1)


def noise_input(policy: LeRobot, rng: np.random.Generator, side: int) -> PolicyInput:
    """Noise as pictures (`side` px) and state, under a real instruction."""
    images = {
        key.removeprefix(IMAGE): rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
        for key in policy.wanted
        if key != STATE
    }
    state = rng.normal(size=policy.wanted[STATE]).astype(np.float32)
    return PolicyInput(images, "pick up the red cup", state)
