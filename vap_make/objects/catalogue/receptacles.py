"""Receptacles: a plate, a basket and a plastic bowl, one fixed prop each."""

import numpy as np

from vap_make.objects.bodies.dishes import Basket, Dish
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

CHINA: Srgb = (238, 236, 230)
COBALT: Srgb = (48, 78, 146)
PETROL: Srgb = (36, 122, 132)
STRAW: Srgb = (205, 164, 103)
TEAK: Srgb = (104, 68, 36)
TURQUOISE: Srgb = (56, 164, 170)

CANE_COLOURS: tuple[Srgb, ...] = (
    (188, 142, 88),
    (160, 118, 74),
    (214, 184, 134),
    (132, 96, 62),
    (226, 210, 176),
)
PLASTIC_COLOURS: tuple[Srgb, ...] = (
    (214, 76, 62),
    (236, 186, 58),
    (96, 172, 84),
    (74, 112, 188),
    (226, 122, 160),
    (232, 230, 224),
    (150, 104, 180),
)
PLASTIC_MOTIFS = ("plain", "waves", "gradient")


def _darken(colour: Srgb, share: float) -> Srgb:
    red, green, blue = colour
    return round(share * red), round(share * green), round(share * blue)


def _draw_plate(rng: np.random.Generator) -> Dish:
    radius = float(rng.uniform(0.066, 0.084))
    height = float(rng.uniform(0.010, 0.018))
    floor = radius * float(rng.uniform(0.58, 0.72))
    return Dish(radius=radius, height=height, floor=floor, thick=0.004)


def _draw_bowl(rng: np.random.Generator) -> Dish:
    radius, height = rng.uniform((0.062, 0.040), (0.076, 0.054)).tolist()
    return Dish(
        radius=radius,
        height=height,
        floor=radius * float(rng.uniform(0.50, 0.62)),
        thick=0.0035,
        belly=float(rng.uniform(0.002, 0.008)),
        painted="outside",
    )


def _draw_basket(rng: np.random.Generator) -> Basket:
    wide, ratio, height, flare = rng.uniform(
        (0.066, 0.75, 0.042, 0.003), (0.080, 1.0, 0.058, 0.014)
    ).tolist()
    return Basket(
        half=(wide, wide * ratio),
        height=height,
        flare=flare,
        power=choose(rng, (2.0, 2.0, 4.0, 8.0)),
    )


def _recolour_basket(texture: Texture, index: int) -> Texture:
    """Rattan in one of the colours of cane, whatever was drawn."""
    base = CANE_COLOURS[index % len(CANE_COLOURS)]
    return Texture(
        base=base,
        ink=_darken(base, 0.5),
        accent=_darken(base, 0.7),
        motif="rattan",
        layout="whole",
        repeats=12 + index % 7,
    )


def _recolour_bowl(texture: Texture, index: int) -> Texture:
    """A plastic colour with a faint motif; only the accent drawn is kept."""
    base = PLASTIC_COLOURS[index % len(PLASTIC_COLOURS)]
    return Texture(
        base=base,
        ink=_darken(base, 0.85),
        accent=texture.accent,
        motif=PLASTIC_MOTIFS[index % len(PLASTIC_MOTIFS)],
        layout="whole",
        repeats=1 + index % 3,
    )


PLATE = Family(
    category="plate",
    mass_kg=0.40,
    draw=_draw_plate,
    prop=(
        (
            Dish(),
            Texture(base=CHINA, ink=COBALT, accent=COBALT, motif="chevron", repeats=28),
        ),
    ),
)
BASKET = Family(
    category="basket",
    mass_kg=0.40,
    draw=_draw_basket,
    prop=(
        (
            Basket(),
            Texture(base=STRAW, ink=TEAK, accent=TEAK, motif="wicker", repeats=22),
        ),
    ),
    recolour=_recolour_basket,
)
PLASTIC_BOWL = Family(
    category="plastic bowl",
    mass_kg=0.40,
    draw=_draw_bowl,
    prop=(
        (
            Dish(
                radius=0.07, height=0.045, floor=0.04, thick=0.0035, belly=0.006, painted="outside"
            ),
            Texture(base=TURQUOISE, ink=PETROL, accent=CHINA, motif="stripes", repeats=24),
        ),
    ),
    recolour=_recolour_bowl,
)
