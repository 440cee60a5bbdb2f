"""Any Gymnasium environment as a suite: a Python file maps its pictures, state and success.

`--suite FILE.py`, whose SUITE is `MAP.suite()` and whose rows() are `MAP.rows()`. Ground truth is
absent, and so are calibrated cameras.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadAction, BadSuite
from vap_core.base.types import Camera, Views, value
from vap_core.simulation import robots
from vap_core.simulation.env import timed
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import Action, EpisodeRow, Observation, Placement, Truth


@value
class Map:
    """What of an environment goes where.

    `id` and `options` are gymnasium.make's; the file registers the environment or imports what
    does. `images` gives a picture (height, width, 3, uint8) by camera and `state` the
    proprioception, from an observation and from what `render` returns; `success` reads a step's
    reward, whether it terminated, and its info. `target` names the personal object in memory.
    """

    name: str
    id: str
    category: str
    target: str
    instruction: str
    hz: float
    max_steps: int
    images: Mapping[str, Callable[[Any, Any], np.ndarray]]
    state: Callable[[Any], np.ndarray]
    success: Callable[[float, bool, Mapping[str, Any]], bool]
    episodes: int = 20
    options: Mapping[str, Any] = field(default_factory=dict)

    def suite(self) -> Suite:
        MAPS[self.name] = self
        task = Task(self.category, self.category, self.instruction, self.max_steps, "official")
        return Suite(self.name, "panda", self.hz, (*self.images,), (task,), environment="gym")

    def rows(self) -> tuple[EpisodeRow, ...]:
        """An episode for each seed of the environment from 0 on."""
        place = Placement(self.target, 0.0, 0.0, 0.0)
        return self.suite().rows_of(self.episodes, lambda task, i: (place,))


MAPS: dict[str, Map] = {}
"""The maps of the files that are open in this process, by suite."""


class GymWorld:
    """One task; each of its environments is made anew."""

    image_size: int = 256
    sizes_m: Mapping[str, tuple[float, float, float]] = {}
    objects: tuple[str, ...] = ()

    def __init__(self, row: EpisodeRow) -> None:
        self.map = MAPS[row.suite]
        self.cameras = (*self.map.images,)
        self.robot = replace(robots.get("panda"), name=self.map.id, hz=self.map.hz)

    def open(self, image_size: int, cameras: Sequence[str]) -> "GymEnv":
        return GymEnv(self.map, image_size, cameras)

    def close(self) -> None:
        """Nothing is shared."""


class GymEnv:
    """One running episode; see protocol.Environment."""

    def __init__(self, of: Map, image_size: int, cameras: Sequence[str]) -> None:
        import gymnasium

        self.map, self.hz, self.image_size, self.camera_names = of, of.hz, image_size, cameras
        self.seconds = dict.fromkeys(("physics", "render", "truth"), 0.0)
        self._env = gymnasium.make(of.id, render_mode="rgb_array", **of.options)
        space = self._env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise BadSuite(
                f"{of.name}: actions of {of.id} are {space}; they must be one row (Box)."
            )
        self._low, self._high = space.low, space.high
        self._steps, self._succeeded = 0, False
        self._seen = self._env.reset(seed=0)[0]
        self._cameras = tuple(
            Camera(name, rgb.shape[1], rgb.shape[0], np.eye(3), np.eye(4), calibrated=False)
            for name, rgb in self.look(image_size).items()
        )

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(f"action_{i}" for i in range(len(self._low)))

    @property
    def time_s(self) -> float:
        return self._steps / self.hz

    def reset(self, row: EpisodeRow) -> None:
        seed = int(np.random.SeedSequence([row.seed, row.episode]).generate_state(1)[0])
        self._seen = self._env.reset(seed=seed)[0]
        self._steps, self._succeeded = 0, False

    def observe(self) -> Observation:
        return Observation(self.look(self.image_size), self.state())

    def look(self, longer_px: int) -> Views:
        views = {}
        with timed(self.seconds, "render"):
            drawn = self._env.render()
            for name in self.camera_names:
                rgb = self.map.images[name](self._seen, drawn)
                if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
                    raise BadSuite(
                        f"{self.map.name}: picture {name!r} is {rgb.dtype} {rgb.shape}; give "
                        "uint8, height x width x 3."
                    )
                k = longer_px / max(rgb.shape[:2])
                views[name] = cv2.resize(rgb, None, fx=k, fy=k, interpolation=cv2.INTER_AREA)
        return views

    def state(self) -> Float32[np.ndarray, " s"]:
        return np.asarray(self.map.state(self._seen), np.float32).ravel()

    def step(self, action: Action) -> None:
        """Actions go as they are, cut to the space. Raises: BadAction."""
        if len(action) != len(self._low) or not np.isfinite(action).all():
            raise BadAction(f"{self.map.id}: {action.tolist()}; {len(self._low)} finite numbers.")
        with timed(self.seconds, "physics"):
            cut = np.clip(action, self._low, self._high).astype(self._low.dtype)
            self._seen, reward, ended, _, info = self._env.step(cut)
            self._steps += 1
            self._succeeded |= bool(self.map.success(float(reward), ended, info))

    def is_beyond_limits(self, action: Action) -> bool:
        return False

    def truth(self, masks: bool = False) -> Truth:
        return Truth({}, {}, (), {}, {}, succeeded=self._succeeded)

    def cameras(self) -> tuple[Camera, ...]:
        return self._cameras
