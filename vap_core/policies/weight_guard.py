"""The policy stays frozen: its weights are compared before and after the episodes.

The checksum of all its parameters is in every result.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

from vap_core.base.errors import BadPolicy

if TYPE_CHECKING:
    from torch import nn


@runtime_checkable
class Weighted(Protocol):
    """A policy that has parameters."""

    label: str

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        ...


_first_checksums: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
"""Of every policy in this process, the checksum that it had when its first episodes began."""


def checksum(policy: object) -> str:
    """The first 16 hex digits of a policy's checksum; "" of one that has no parameters."""
    if not isinstance(policy, Weighted):
        return ""
    return policy.sha256()[:16]


def state_sha256(module: "nn.Module") -> str:
    """Checksum of a module's parameters and buffers as they stand, in the order of their names."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(name.encode())
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


@contextmanager
def unchanged_weights(policy: object) -> Iterator[str]:
    """Inside, episodes run; gives the checksum that the policy had when the first ones began.

    The first ones are those of this process.

    Raises: BadPolicy, on leaving, when it has another one now.
    """
    if not isinstance(policy, Weighted):
        yield ""
        return
    parameters = getattr(policy, "policy", policy)  # several policies may share one set of them
    if parameters not in _first_checksums:
        _first_checksums[parameters] = checksum(policy)
    before = _first_checksums[parameters]
    yield before
    after = checksum(policy)
    if after != before:
        raise BadPolicy(
            f"unchanged_weights: the parameters of {policy.label} changed while episodes ran "
            f"({before} before, {after} now); these are no results. Find out what trains it or "
            "writes to it, and run the same command again."
        )
