"""Where a policy looks while it decides: while somebody watches, a policy that attends to image patches tells how its actions weigh them.

with watching() as seen:
    policy.plan(states, inputs)
seen[0]["front"]        # of the first episode in the batch: height x width of patches, each the share of the attention that it gets

Policies that tell nothing (no transformer over patches, or one asked step by step) leave `seen` empty.
"""

import numpy as np
from jaxtyping import Float32

from vap_core.policies.telling import Ear

Heat = Float32[np.ndarray, "h w"]
Heats = dict[int, dict[str, Heat]]
"""By episode of the batch, then by camera."""
_eye: Ear[Heat] = Ear("attention")
watching, watched, tell = _eye.open, _eye.opened, _eye.tell
