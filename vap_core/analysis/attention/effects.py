"""Which layers' attention reaches the actions: each layer's queries are set to zero in turn."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadPolicy
from vap_core.policies.lerobot.adapter import IMAGE, STATE, LeRobot, load_policy
from vap_core.policies.protocol import Chunk, PolicyInput, observe_attention

if TYPE_CHECKING:
    import pandas as pd

SIDE = 112


def layer_effects(folder: Path) -> "pd.DataFrame":
    """Largest change of an action of the policy in a folder when a layer attends evenly.

    It is a pi0, pi0.5 or mini-pi0. Two rows: the vision-language model, whose queries are patches
    and words, and the action expert. The input is noise under a real instruction.

    Raises: BadPolicy, as `load_policy`, or for another kind of policy.
    """
    import pandas as pd

    policy = load_policy(folder)
    model: Any = getattr(policy.policy, "model", None)
    towers = getattr(model, "paligemma_with_expert", None)
    if towers is None:
        raise BadPolicy(
            f"layer_effects: {policy.label} is no pi0, whose layers are known here; give the "
            "folder of a pi0, pi0.5 or mini-pi0."
        )
    look = noise_input(policy, np.random.default_rng(0), SIDE)
    plain = _chunk(policy, look)
    rows: dict[str, dict[int, float]] = {}
    for name, decoder in (
        ("vision-language model", towers.paligemma.model.language_model),
        ("action expert", towers.gemma_expert.model),
    ):
        rows[name] = {}
        for i, layer in enumerate(decoder.layers):
            with _without_queries(layer):
                change = _chunk(policy, look) - plain
            rows[name][i + 1] = float(np.abs(change).max())
    assert np.array_equal(_chunk(policy, look), plain), "the weights are as they were"
    return pd.DataFrame(rows).T.rename_axis("layer", axis=1)


@contextmanager
def _without_queries(layer: Any) -> Iterator[None]:
    """Inside, a layer attends to everything alike."""
    weight = layer.self_attn.q_proj.weight
    kept = weight.clone()
    weight.zero_()
    try:
        yield
    finally:
        weight.copy_(kept)


def _chunk(policy: LeRobot, look: PolicyInput) -> Chunk:
    with observe_attention():  # eager
        return policy.plan([policy.start(np.random.default_rng(0))], [look])[1][0]


def noise_input(policy: LeRobot, rng: np.random.Generator, side: int) -> PolicyInput:
    """Noise as pictures (`side` px) and state, under a real instruction."""
    images = {}
    for key in policy.wanted:
        if key != STATE:
            rgb = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
            images[key.removeprefix(IMAGE)] = rgb
    state = rng.normal(size=policy.wanted[STATE]).astype(np.float32)
    return PolicyInput(images, "pick up the red cup", state)
