"""What a policy consumed and what it attended to, observed while it plans.

Without an observer a policy does no extra work.

    with observe_inputs() as digests:
        policy.plan(states, inputs)
    digests[0]["front"]       # first episode of the batch: SHA-256 of the tensor of camera "front"

    with observe_attention() as maps:
        policy.plan(states, inputs)
    maps[0]["front"]          # first episode: the share of attention of every patch, h x w

A policy that reports nothing leaves `digests` or `maps` empty.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from jaxtyping import Float32

TEXT = "text"
"""The name under which a policy reports its text or tokens.

Images are reported under their camera's name.
"""
InputDigests = dict[int, dict[str, str]]
"""By episode of the batch, then by TEXT or camera: hexadecimal SHA-256."""
AttentionMap = Float32[np.ndarray, "h w"]
AttentionMaps = dict[int, dict[str, AttentionMap]]
"""By episode of the batch, then by camera."""


class Hook[T]:
    """One kind of report. The first report of an episode under a name is kept."""

    def __init__(self, name: str) -> None:
        self._reports: ContextVar[dict[int, dict[str, T]] | None] = ContextVar(name, default=None)

    @contextmanager
    def observe(self) -> Iterator[dict[int, dict[str, T]]]:
        """Collect what policies report inside the block."""
        reports: dict[int, dict[str, T]] = {}
        token = self._reports.set(reports)
        try:
            yield reports
        finally:
            self._reports.reset(token)

    def observed(self) -> bool:
        """Whether a report would be collected; what is costly to compute is computed only then."""
        return self._reports.get() is not None

    def report(self, episode: int, name: str, value: T) -> None:
        """Report `value` for episode number `episode` of the batch."""
        reports = self._reports.get()
        if reports is not None:
            reports.setdefault(episode, {}).setdefault(name, value)


_inputs: Hook[str] = Hook("inputs")
observe_inputs = _inputs.observe
inputs_observed = _inputs.observed

_attention: Hook[AttentionMap] = Hook("attention")
observe_attention = _attention.observe
attention_observed = _attention.observed
report_attention = _attention.report


def report_input(episode: int, name: str, consumed: np.ndarray | str) -> None:
    """Report the digest of an array, or of a text, that the policy consumes for one episode."""
    if not inputs_observed():
        return
    if isinstance(consumed, str):
        data = consumed.encode()
    else:
        header = str((consumed.dtype, consumed.shape)).encode()
        data = header + np.ascontiguousarray(consumed).tobytes()
    _inputs.report(episode, name, hashlib.sha256(data).hexdigest())
