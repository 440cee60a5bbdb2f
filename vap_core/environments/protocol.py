"""What a rollout needs of an environment. Ground truth is optional."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float32
from numpy import ndarray

from vap_core.base.types import Camera, Views
from vap_core.simulation.robots import Robot
from vap_core.simulation.types import Action, EpisodeRow, Observation, Truth


@runtime_checkable
class Environment(Protocol):
    """One running episode at a time.

    `reset`, `step` and `observe` speak of images by camera (RGB, uint8), and of metres, radians and
    a gripper's opening 0..1 (simulation.types); an adapter converts. `seconds` sums wall time by
    part ("render", ...). `truth` is empty but for `succeeded` where the environment knows no more:
    consumers that need masks, contacts or poses say that they are absent. The frame of all poses
    has z = 0 on the table top; cameras that are not calibrated in such a frame say so, and
    association refuses them.
    """

    hz: float
    seconds: dict[str, float]

    @property
    def action_names(self) -> tuple[str, ...]: ...

    @property
    def time_s(self) -> float: ...

    def reset(self, row: EpisodeRow) -> None: ...

    def observe(self) -> Observation: ...

    def state(self) -> Float32[ndarray, " s"]: ...

    def look(self, longer_px: int) -> Views:
        """The views of this moment with so many pixels on their longer side."""
        ...

    def step(self, action: Action) -> None: ...

    def is_beyond_limits(self, action: Action) -> bool: ...

    def truth(self, masks: bool = False) -> Truth: ...

    def cameras(self) -> tuple[Camera, ...]: ...


@runtime_checkable
class World(Protocol):
    """What the environments of one task share; our own simulator's is simulation.scenes.Scene.

    `sizes_m` are the objects' full extents, empty where nothing is known; `cameras` the views by
    name, and `image_size` the side (pixels) at which a policy gets them.
    """

    robot: Robot

    @property
    def sizes_m(self) -> Mapping[str, tuple[float, float, float]]: ...

    @property
    def cameras(self) -> tuple[str, ...]: ...

    @property
    def image_size(self) -> int: ...

    @property
    def objects(self) -> tuple[str, ...]: ...

    def open(self, image_size: int, cameras: Sequence[str]) -> Environment: ...

    def close(self) -> None: ...
