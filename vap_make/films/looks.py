"""The looks of filmed scenes: room, table, light, robot and cameras, none of them an evaluated one.

Every stage draws one. In every respect it keeps a distance from all that the evaluation shows
(suites.VARIANTS, of which "base" is one), so that no evaluated look is a look of training.
"""

from collections.abc import Callable, Sequence

import numpy as np

from vap_core.simulation.looks import Colour3, SceneStyle
from vap_core.simulation.suites.suite import VARIANTS

APART = {
    "planks": 0.08,
    "wall": 0.06,
    "floor": 0.06,
    "robot": 0.06,
    "lamp": 0.02,
    "ambient": 0.02,
    "lamp_pos_m": 0.15,
    "camera_shift_m": 0.008,
}
"""Least distance of every property from its evaluated values: the largest difference of a channel,
of strengths of light, or of metres along an axis."""
FAR_M = 0.022
"""Cameras are moved by at most so much along each axis."""
FIRST_GRAIN = 100
"""Grains of training tables begin here; the evaluated one is before."""
PLAIN = 0.3
"""Share of tables without grain."""


def draw_look(rng: np.random.Generator) -> SceneStyle:
    """A look that keeps its distance from every evaluated one."""
    return SceneStyle(
        planks=_draw_planks(rng),
        grain=FIRST_GRAIN + int(rng.integers(1_000_000)),
        wall=_draw(rng, "wall", lambda: _draw_grey(rng, 0.35, 0.9, warmth=0.05)),
        floor=_draw(rng, "floor", lambda: _draw_grey(rng, 0.2, 0.7, warmth=0.05)),
        lamp_pos_m=_draw(rng, "lamp_pos_m", lambda: _draw_lamp(rng)),
        lamp=_draw(rng, "lamp", lambda: (float(rng.uniform(0.38, 0.66)),))[0],
        ambient=_draw(rng, "ambient", lambda: (float(rng.uniform(0.28, 0.46)),))[0],
        robot=_draw(rng, "robot", lambda: _draw_robot(rng)),
        camera_shift_m=_draw(rng, "camera_shift_m", lambda: _draw_shift(rng)),
    )


def evaluated(name: str) -> list[tuple[float, ...]]:
    """The values of a property that the evaluation shows; both colours of a table's planks."""
    values: list[tuple[float, ...]] = []
    for variant in VARIANTS.values():
        value = getattr(variant.style, name)
        if name == "planks":
            values += value
        elif isinstance(value, float):
            values.append((value,))
        else:
            values.append(value)
    return values


def distance(name: str, value: Sequence[float]) -> float:
    """How far a property's value is from the nearest evaluated one, as `APART` counts."""
    found = []
    for other in evaluated(name):
        found.append(max(abs(a - b) for a, b in zip(value, other, strict=True)))
    return min(found)


def _draw[V: tuple[float, ...]](rng: np.random.Generator, name: str, draw: Callable[[], V]) -> V:
    """The first drawn value that is far enough from the evaluated ones."""
    while True:
        value = draw()
        if distance(name, value) >= APART[name]:
            return value


def _draw_planks(rng: np.random.Generator) -> tuple[Colour3, Colour3]:
    while True:
        light = _draw_grey(rng, 0.3, 0.92, warmth=0.14)
        dark = light
        if rng.random() >= PLAIN:
            shade = float(rng.uniform(0.72, 0.92))
            dark = (light[0] * shade, light[1] * shade, light[2] * shade)
        if min(distance("planks", light), distance("planks", dark)) >= APART["planks"]:
            return light, dark


def _draw_grey(rng: np.random.Generator, low: float, high: float, warmth: float) -> Colour3:
    """A grey, more or less warm: `warmth` is the most that red gains and blue loses."""
    grey = float(rng.uniform(low, high))
    warm = float(rng.uniform(-0.25, 1.0)) * warmth
    green = float(rng.uniform(-0.03, 0.03))
    red, green, blue = np.clip([grey + warm, grey + green, grey - warm], 0.02, 1.0).tolist()
    return red, green, blue


def _draw_lamp(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = rng.uniform((-0.5, -1.1, 1.3), (1.2, 1.1, 2.1)).tolist()
    return x, y, z


def _draw_robot(rng: np.random.Generator) -> Colour3:
    bright = float(rng.uniform(0.6, 1.0))
    red, green, blue = np.clip(bright + rng.uniform(-0.12, 0.12, 3), 0.4, 1.0).tolist()
    return red, green, blue


def _draw_shift(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = rng.uniform(-FAR_M, FAR_M, 3).tolist()
    return x, y, z
