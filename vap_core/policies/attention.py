"""Where a policy looks while it decides: while somebody watches, a policy that attends to image patches tells how its actions weigh them.

with watching() as seen:
    policy.plan(states, inputs)
seen[0]["front"]        # of the first episode in the batch: height x width of patches, each the share of the attention that it gets

Policies that tell nothing (no transformer over patches, or one asked step by step) leave `seen` empty.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from jaxtyping import Float32

Heat = Float32[np.ndarray, "h w"]
Heats = dict[int, dict[str, Heat]]
"""By episode of the batch, then by camera."""
_seen: ContextVar[Heats | None] = ContextVar("seen", default=None)


@contextmanager
def watching() -> Iterator[Heats]:
    """Collect what policies tell inside the block."""
    found: Heats = {}
    token = _seen.set(found)
    try:
        yield found
    finally:
        _seen.reset(token)


def watched() -> bool:
    """Whether anybody watches: attention is kept then only."""
    return _seen.get() is not None


def tell(episode: int, camera: str, heat: Heat) -> None:
    """Say how episode number `episode` of the batch weighs the patches of a camera's image; what is told first stands."""
    seen = _seen.get()
    if seen is not None:
        seen.setdefault(episode, {}).setdefault(camera, heat)
