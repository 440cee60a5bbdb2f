"""Places to put things: a plate, a basket and a plastic bowl, one fixed prop each."""

import numpy as np

from vap_core.sim.bodies.dishes import Basket, Dish
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.textures import Ink, Texture

CHINA, COBALT, STRAW, BARK, TURQUOISE, LAGOON = (238, 236, 230), (48, 78, 146), (205, 164, 103), (104, 68, 36), (56, 164, 170), (36, 122, 132)
CANES: tuple[Ink, ...] = ((188, 142, 88), (160, 118, 74), (214, 184, 134), (132, 96, 62), (226, 210, 176))
PLASTICS: tuple[Ink, ...] = ((214, 76, 62), (236, 186, 58), (96, 172, 84), (74, 112, 188), (226, 122, 160), (232, 230, 224), (150, 104, 180))


def _dark(colour: Ink, share: float) -> Ink:
    red, green, blue = (round(share * c) for c in colour)
    return red, green, blue


def _cane(drawn: Texture, index: int) -> Texture:
    base = CANES[index % len(CANES)]
    return Texture(base, _dark(base, 0.5), _dark(base, 0.7), "rattan", "whole", 12 + index % 7)


def _plastic(drawn: Texture, index: int) -> Texture:
    base = PLASTICS[index % len(PLASTICS)]
    return Texture(base, _dark(base, 0.85), drawn.accent, ("plain", "waves", "gradient")[index % 3], "whole", 1 + index % 3)


def _plate(rng: np.random.Generator) -> Dish:
    radius = float(rng.uniform(0.066, 0.084))
    return Dish(radius, float(rng.uniform(0.010, 0.018)), radius * float(rng.uniform(0.58, 0.72)), 0.004)


def _bowl(rng: np.random.Generator) -> Dish:
    radius, height = rng.uniform((0.062, 0.040), (0.076, 0.054)).tolist()
    return Dish(radius, height, radius * float(rng.uniform(0.50, 0.62)), 0.0035, float(rng.uniform(0.002, 0.008)), "outside")


def _basket(rng: np.random.Generator) -> Basket:
    wide, ratio, height, flare = rng.uniform((0.066, 0.75, 0.042, 0.003), (0.080, 1.0, 0.058, 0.014)).tolist()
    return Basket((wide, wide * ratio), height, flare, power=pick(rng, (2.0, 2.0, 4.0, 8.0)))


FAMILIES: tuple[Family, ...] = (
    Family("plate", 0.40, _plate, prop=((Dish(), Texture(CHINA, COBALT, COBALT, "chevron", "full", 28)),)),
    Family("basket", 0.40, _basket, prop=((Basket(), Texture(STRAW, BARK, BARK, "wicker", "full", 22)),), paint=_cane),
    Family(
        "plastic bowl",
        0.40,
        _bowl,
        prop=((Dish(0.070, 0.045, 0.040, 0.0035, 0.006, "outside"), Texture(TURQUOISE, LAGOON, CHINA, "stripes", "full", 24)),),
        paint=_plastic,
    ),
)  # fmt: skip
