"""Two causal measures of a patch: gradient times activation, and masking."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.test_attention import CASES, look, plan, toys
from vap_core.policies.lerobot.adapter import LeRobot
from vap_core.policies.lerobot.attribution import gradient_maps, masking_maps, projector

__all__ = ["toys"]


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_is_that_of_a_slightly_larger_activation(
    toys: dict[str, LeRobot], name: str
) -> None:
    """Gradient times activation is the derivative by a factor on the patch: compared with finite differences."""
    cameras, side, *_ = CASES[name]
    policy = toys[name]
    one = look(0, cameras)
    state = policy.start(np.random.default_rng([7, 0]))
    before = plan(policy, [one])[0]
    maps = gradient_maps(policy, state, one)
    assert set(maps) == set(cameras)
    assert (plan(policy, [one])[0] == before).all(), "the policy is as it was"
    patch = int(maps[cameras[0]].argmax())
    # SmolVLA's actions hardly depend on one patch, and it computes in half precision.
    step, tolerance = (0.3, 0.15) if name == "smolvla" else (0.01, 0.05)
    by_hand = abs(
        _half_square(policy, state, one, patch, 1 + step)
        - _half_square(policy, state, one, patch, 1 - step)
    )
    assert maps[cameras[0]].shape == (side, side)
    assert maps[cameras[0]].flat[patch] == pytest.approx(by_hand / (2 * step), rel=tolerance)


def _half_square(policy: LeRobot, state: Any, one: Any, patch: int, factor: float) -> float:
    """Half the squared length of the actions when one patch of the first view is scaled."""
    calls: list[int] = []

    def scale(module: Any, args: Any, output: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        if len(calls) > 1:
            return output
        scaled = output.clone()
        scaled[:, patch] *= factor
        return scaled

    hook = projector(policy.policy.model).register_forward_hook(scale)
    try:
        batch, noise = policy.prepare([state], [one])
        planned = policy.policy.predict_action_chunk(batch, noise=noise)[:, : policy.execute]
    finally:
        hook.remove()
    return float(0.5 * planned.double().square().sum())


def test_masking_a_patch_that_has_the_views_colour_already_changes_nothing(
    toys: dict[str, LeRobot],
) -> None:
    policy = toys["mini-pi0"]
    one = look(0, ("front",))
    grey = np.full((112, 112, 3), 100, np.uint8)
    grey[32:48, 64:80] = [200, 100, 100]  # row 2, column 4
    one.images["front"][:] = 0
    state = policy.start(np.random.default_rng(0))
    images = {"front": grey}
    changes = masking_maps(policy, state, type(one)(images, one.text, one.state))["front"]
    assert changes.shape == (7, 7)
    assert changes.argmax() == 2 * 7 + 4
    assert np.median(changes) < 0.2 * changes.max()
