"""The policy stays frozen: the checksum of all its parameters is in every result, and taken again when the episodes are over."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

from vap_core.base.errors import BadPolicy


@runtime_checkable
class Weighted(Protocol):
    """A policy that has parameters."""

    label: str

    def sha256(self) -> str:
        """Checksum of all parameters and buffers as they stand."""
        ...


_first: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
"""Of every policy in this process, the checksum that it had when its first episodes began."""


def checksum(policy: object) -> str:
    """The first 16 hex digits of a policy's checksum as it stands; "" of one that has no parameters."""
    return policy.sha256()[:16] if isinstance(policy, Weighted) else ""


@contextmanager
def frozen(policy: object) -> Iterator[str]:
    """Inside, episodes run; gives the checksum that the policy had when this process ran its first ones.

    Raises: BadPolicy, on leaving, when it has another one now.
    """
    if not isinstance(policy, Weighted):
        yield ""
        return
    inner = getattr(policy, "policy", policy)  # one set of parameters, however many speak for it
    if inner not in _first:
        _first[inner] = checksum(policy)
    before = _first[inner]
    yield before
    after = checksum(policy)
    if after != before:
        raise BadPolicy(
            f"frozen: the parameters of {policy.label} changed while episodes ran ({before} before, {after} now); these are no results. "
            "Find out what trains it or writes to it, and run the same command again."
        )
