"""What a tracker is."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from vap_core.values import Rgb, Track


@runtime_checkable
class Tracker(Protocol):
    """Follows every identity of each view; state is argument and result, and may be consumed."""

    def start(self, images: Sequence[Rgb], masks: Sequence[Bool[np.ndarray, "_n _h _w"]]) -> list[Any]:
        """One state per view (t = 0); row i of a view's masks is identity i."""
        ...

    def step(self, states: Sequence[Any], images: Sequence[Rgb]) -> tuple[list[Any], list[tuple[Track, ...]]]:
        """The next frame of every view: one Track per identity, in order; its mask is None while it is not visible."""
        ...
