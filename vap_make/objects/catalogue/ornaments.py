"""Flat-sided ornaments: miniature houses, toy buses and framed paintings."""

from dataclasses import replace

import numpy as np

from vap_make.objects.bodies.bus import Bus
from vap_make.objects.bodies.house import House
from vap_make.objects.bodies.painting import Painting
from vap_make.objects.catalogue.colours import PORCELAIN, VIVID_COLOURS
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

BLUE: Srgb = (48, 100, 178)
EGGSHELL: Srgb = (238, 230, 212)
FIRE_BRICK: Srgb = (190, 50, 46)
GOLD: Srgb = (226, 176, 64)
LAWN: Srgb = (86, 146, 72)
UMBER: Srgb = (92, 64, 46)

SKY_COLOURS: tuple[Srgb, ...] = (
    (150, 196, 226),
    (238, 198, 150),
    (226, 224, 206),
    (176, 206, 196),
    (206, 184, 214),
    (120, 160, 204),
)
LAND_COLOURS: tuple[Srgb, ...] = (
    (70, 120, 84),
    (44, 92, 140),
    (150, 84, 66),
    (112, 84, 130),
    (196, 92, 60),
    (40, 110, 120),
)
CANVAS_MOTIFS = ("gradient", "plain", "gradient", "speckle")


def _draw_house(rng: np.random.Generator) -> House:
    wide, deep, eaves, rise = rng.uniform(
        (0.048, 0.040, 0.032, 0.0225), (0.064, 0.050, 0.044, 0.032)
    ).tolist()
    storeys = 1
    if eaves > 0.038:
        storeys = 2
    return House(
        wide=wide,
        deep=deep,
        eaves=eaves,
        rise=rise,
        roof=choose(rng, ("gable", "hip", "barn", "flat")),
        roof_paint=choose(rng, ("accent", "ink", "dark", "warm")),
        windows=int(rng.integers(1, 4)),
        storeys=storeys,
        chimney=bool(rng.random() < 0.5),
    )


def _draw_bus(rng: np.random.Generator) -> Bus:
    long, wide = rng.uniform((0.080, 0.037), (0.098, 0.043)).tolist()
    decks = choose(rng, (1, 1, 2))
    nose = 0.0
    if decks == 1:
        height = float(rng.uniform(0.061, 0.066))
        if rng.random() < 0.4:
            nose = float(rng.uniform(0.014, 0.020))
    else:
        height = float(rng.uniform(0.070, 0.080))
    return Bus(
        long=long,
        wide=wide,
        height=height,
        decks=decks,
        nose=nose,
        stripe=choose(rng, ("light", "base", "accent")),
    )


def _draw_painting(rng: np.random.Generator) -> Painting:
    wide, high, frame = rng.uniform((0.080, 0.086, 0.007), (0.096, 0.106, 0.011)).tolist()
    return Painting(
        wide=wide,
        high=high,
        frame=frame,
        scene=choose(rng, ("hills", "sea", "flower", "blocks")),
        frame_paint=choose(rng, ("warm", "dark", "light", "accent")),
    )


def _recolour_bus(texture: Texture, index: int) -> Texture:
    """A vivid body; the base colour drawn becomes the ink."""
    return replace(texture, base=VIVID_COLOURS[index % len(VIVID_COLOURS)], ink=texture.base)


def _recolour_painting(texture: Texture, index: int) -> Texture:
    """A sky for a canvas, and land in the colour of the ink."""
    return Texture(
        base=SKY_COLOURS[index % len(SKY_COLOURS)],
        ink=LAND_COLOURS[(index // 2) % len(LAND_COLOURS)],
        accent=texture.accent,
        motif=CANVAS_MOTIFS[index % len(CANVAS_MOTIFS)],
        layout="whole",
        repeats=2,
        seed=texture.seed,
    )


HOUSE = Family(
    category="miniature house",
    mass_kg=0.14,
    draw=_draw_house,
    instances=(
        (
            House(),
            Texture(base=FIRE_BRICK, ink=BLUE, accent=LAWN, motif="planks", repeats=30),
        ),
        (
            House(
                wide=0.056,
                deep=0.044,
                eaves=0.04,
                rise=0.022,
                roof="hip",
                roof_paint="base",
                windows=1,
                storeys=1,
                chimney=False,
            ),
            Texture(base=FIRE_BRICK, ink=BLUE, accent=LAWN, motif="dots", repeats=16),
        ),
        (
            House(
                wide=0.06,
                deep=0.044,
                eaves=0.034,
                rise=0.03,
                roof="barn",
                roof_paint="ink",
                windows=3,
            ),
            Texture(base=FIRE_BRICK, ink=BLUE, accent=GOLD, motif="stripes", repeats=14),
        ),
        (
            House(
                wide=0.052,
                deep=0.048,
                eaves=0.044,
                rise=0.024,
                roof="gable",
                roof_paint="base",
                windows=2,
                storeys=2,
            ),
            Texture(
                base=FIRE_BRICK,
                ink=EGGSHELL,
                accent=LAWN,
                motif="checks",
                repeats=12,
            ),
        ),
        (
            House(
                wide=0.06,
                deep=0.046,
                eaves=0.036,
                rise=0.024,
                roof="gable",
                roof_paint="ink",
                windows=2,
                storeys=1,
                chimney=False,
            ),
            Texture(
                base=EGGSHELL,
                ink=BLUE,
                accent=FIRE_BRICK,
                motif="heart",
                layout="brick",
                repeats=12,
            ),
        ),
        (
            House(
                wide=0.05,
                deep=0.044,
                eaves=0.042,
                rise=0.022,
                roof="flat",
                roof_paint="light",
                windows=2,
                storeys=2,
                chimney=False,
            ),
            Texture(base=GOLD, ink=UMBER, accent=LAWN, motif="hoops", repeats=12),
        ),
        (
            House(
                wide=0.058,
                deep=0.044,
                eaves=0.036,
                rise=0.028,
                roof="hip",
                roof_paint="warm",
                windows=3,
            ),
            Texture(base=LAWN, ink=PORCELAIN, accent=UMBER, motif="chevron", repeats=14),
        ),
    ),
)
BUS = Family(category="toy bus", mass_kg=0.14, draw=_draw_bus, recolour=_recolour_bus)
PAINTING = Family(
    category="painting", mass_kg=0.10, draw=_draw_painting, recolour=_recolour_painting
)
