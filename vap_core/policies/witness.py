"""What a policy really consumes: while a witness listens, policies tell the digest of every image tensor and of the tokens, where they use them.

with listening() as heard:
    policy.plan(states, inputs)
heard[0]["front"]       # of the first episode in the batch
"""

import hashlib

import numpy as np

from vap_core.policies.telling import Ear

TEXT = "text"
"""The name under which words or tokens are told; images go by their camera's."""
Heard = dict[int, dict[str, str]]
"""By episode of the batch: what was consumed, as hexadecimal SHA-256 digests."""
_ear: Ear[str] = Ear("heard")
listening, listened = _ear.open, _ear.opened


def tell(episode: int, name: str, consumed: np.ndarray | str) -> None:
    """Say that episode number `episode` of the batch consumes this array, or this text, under `name`."""
    if listened():
        data = (
            consumed.encode()
            if isinstance(consumed, str)
            else str((consumed.dtype, consumed.shape)).encode() + np.ascontiguousarray(consumed).tobytes()
        )
        _ear.tell(episode, name, hashlib.sha256(data).hexdigest())
