"""True masks that are drawn only when somebody wants them after all.

An episode that is dropped unless it fails needs no masks while it runs. Its states are kept, a few
kilobytes a step, and the simulator draws from them what it would have drawn at the time.
"""

from collections.abc import Callable
from dataclasses import replace

from vap_core.rollout.types import Frame
from vap_core.simulation.env import Env, Snapshot


class LateMasks:
    """The states of one episode's steps; `make_env` makes an environment to draw them in."""

    def __init__(self, make_env: Callable[[], Env]) -> None:
        self._make_env = make_env
        self._env: Env | None = None
        self._snapshots: dict[int, Snapshot] = {}

    def keep(self, frame_index: int, snapshot: Snapshot) -> None:
        """Keep the state of a step whose masks are wanted later."""
        self._snapshots[frame_index] = snapshot

    def draw(self, frame: Frame) -> Frame:
        """The frame with its masks; one whose state was not kept stays as it is."""
        snapshot = self._snapshots.pop(frame.frame_index, None)
        if snapshot is None:
            return frame
        if self._env is None:
            self._env = self._make_env()
        self._env.restore(snapshot)
        drawn = self._env.truth(masks=True)
        return replace(frame, truth=replace(frame.truth, masks=drawn.masks, hand=drawn.hand))
