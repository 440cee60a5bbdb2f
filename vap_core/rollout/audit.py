"""Whether the prompt reaches the policy.

Every call is made twice, with the prompted and with the raw input, and what was consumed is
compared. The second call's chunks are discarded: an audited run ends as the same run without audit
does.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from vap_core.base.errors import BadPolicy
from vap_core.policies.hooks import TEXT, observe_inputs
from vap_core.policies.protocol import Policy, PolicyInput
from vap_core.rollout.policy_call import checked_plan
from vap_core.rollout.types import ConsumedInput

Digests = tuple[Mapping[str, str], Mapping[str, str]]
"""By camera or TEXT: digests of what was consumed of the prompted, and of the raw input."""


def plan(
    policy: Policy[Any],
    states: Sequence[Any],
    prompted: Sequence[PolicyInput],
    raw: Sequence[PolicyInput],
) -> tuple[list[Any], list[Any], list[Digests]]:
    """The policy's chunks for the prompted inputs, and what it consumed in each episode.

    Raises: BadPolicy when the policy reports nothing.
    """
    spare = copy.deepcopy(list(states))
    with observe_inputs() as of_prompted:
        returned = policy.plan(states, prompted)
        after, chunks = checked_plan(returned, policy.label, len(states))
    chunks = copy.deepcopy(chunks)  # the second call may write into the same arrays
    with observe_inputs() as of_raw:
        policy.plan(spare, raw)
    if len(of_prompted) != len(prompted):
        raise BadPolicy(
            f"audit: {policy.label} does not report what it consumes; call "
            "vap_core.policies.hooks.report_input where it uses its inputs."
        )
    digests: list[Digests] = []
    for i in range(len(prompted)):
        digests.append((of_prompted[i], of_raw[i]))
    return after, chunks, digests


def compare(
    step: int, prompted: PolicyInput, raw: PolicyInput, digests: Digests
) -> list[ConsumedInput]:
    """What one episode consumed in one call; views that the policy does not read are left out."""
    of_prompted, of_raw = digests
    found = []
    for name, digest in of_prompted.items():
        if name == TEXT:
            pixels = 0
            changed = prompted.text != raw.text
        else:
            differs = (prompted.images[name] != raw.images[name]).any(axis=2)
            pixels = int(differs.sum())
            changed = bool(differs.any())
        consumed = ConsumedInput(
            step=step,
            name=name,
            changed=changed,
            pixels=pixels,
            consumed=digest,
            raw=of_raw[name],
        )
        found.append(consumed)
    return found
