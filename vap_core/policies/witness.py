"""What a policy really consumes: while a witness listens, policies tell the digest of every image tensor and of the tokens, where they use them.

with listening() as heard:
    policy.plan(states, inputs)
heard[0]["front"]       # of the first episode in the batch
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

TEXT = "text"
"""The name under which words or tokens are told; images go by their camera's."""
Heard = dict[int, dict[str, str]]
"""By episode of the batch: what was consumed, as hexadecimal SHA-256 digests."""
_heard: ContextVar[Heard | None] = ContextVar("heard", default=None)


@contextmanager
def listening() -> Iterator[Heard]:
    """Collect what policies tell inside the block."""
    found: Heard = {}
    token = _heard.set(found)
    try:
        yield found
    finally:
        _heard.reset(token)


def listened() -> bool:
    """Whether anybody listens: what is costly to gather is gathered then only."""
    return _heard.get() is not None


def tell(episode: int, name: str, consumed: np.ndarray | str) -> None:
    """Say that episode number `episode` of the batch consumes this array, or this text, under `name`."""
    heard = _heard.get()
    if heard is not None:
        data = (
            consumed.encode()
            if isinstance(consumed, str)
            else str((consumed.dtype, consumed.shape)).encode() + np.ascontiguousarray(consumed).tobytes()
        )
        heard.setdefault(episode, {})[name] = hashlib.sha256(data).hexdigest()
