"""Potted plants, and scrubbers knitted as fruit."""

from dataclasses import replace

import numpy as np

from vap_make.objects.bodies.plants import Plant
from vap_make.objects.bodies.scrubber import Scrubber
from vap_make.objects.catalogue.colours import PORCELAIN, VIVID_COLOURS
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

AVOCADO: Srgb = (128, 132, 62)
BERRY: Srgb = (200, 40, 48)
CLAY: Srgb = (190, 108, 76)
EUCALYPTUS: Srgb = (104, 158, 108)
LEMON: Srgb = (236, 204, 70)
MULBERRY: Srgb = (112, 70, 104)
SALMON: Srgb = (214, 122, 118)
SEED: Srgb = (246, 218, 150)
SKY: Srgb = (98, 160, 200)
STALK: Srgb = (66, 126, 58)
VIOLET: Srgb = (112, 84, 164)

LEAF_COLOURS: tuple[Srgb, ...] = (
    (72, 128, 64),
    (96, 150, 84),
    (56, 104, 72),
    (130, 160, 90),
    (84, 132, 108),
    (112, 140, 60),
)
POT_COLOURS: tuple[Srgb, ...] = (
    (178, 102, 72),
    (226, 222, 212),
    (110, 116, 122),
    (196, 162, 120),
    (84, 108, 140),
    (208, 176, 72),
    (160, 84, 92),
)


def _draw_plant(rng: np.random.Generator) -> Plant:
    pot, spread, rise, pot_height = rng.uniform(
        (0.0175, 0.0235, 0.024, 0.036), (0.0205, 0.0285, 0.036, 0.041)
    ).tolist()
    return Plant(
        kind=choose(rng, ("rosette", "aloe", "cactus", "bush")),
        pot=pot,
        pot_height=pot_height,
        height=pot_height + rise,
        spread=spread,
        leaves=int(rng.integers(6, 10)),
        blunt=float(rng.uniform(0.45, 0.9)),
        tips=choose(rng, ("ink", "accent")),
        rim=choose(rng, ("base", "accent", "none")),
    )


def _draw_scrubber(rng: np.random.Generator) -> Scrubber:
    radius, body, bump, leaf, loop = rng.uniform(
        (0.0195, 0.044, 0.010, 0.014, 0.0085), (0.0220, 0.054, 0.030, 0.020, 0.0105)
    ).tolist()
    return Scrubber(
        outline=choose(rng, ("pear", "drum", "ball")),
        radius=radius,
        body=body,
        rows=int(rng.integers(5, 9)),
        bump=bump,
        leaves=choose(rng, (0, 4, 5, 8)),
        leaf=leaf,
        loop=loop,
    )


def _recolour_plant(texture: Texture, index: int) -> Texture:
    """A pot in the base colour, leaves in the ink; every other plant has vivid tips."""
    accent = texture.accent
    if index % 2:
        accent = VIVID_COLOURS[(3 * index) % len(VIVID_COLOURS)]
    return replace(
        texture,
        base=POT_COLOURS[index % len(POT_COLOURS)],
        ink=LEAF_COLOURS[index % len(LEAF_COLOURS)],
        accent=accent,
    )


def _recolour_scrubber(texture: Texture, index: int) -> Texture:
    """A vivid body with a soft motif; two in three have a green crown."""
    accent = texture.accent
    if index % 3:
        accent = LEAF_COLOURS[index % len(LEAF_COLOURS)]
    rng = np.random.default_rng(index)
    return Texture(
        base=VIVID_COLOURS[(3 * index + 1) % len(VIVID_COLOURS)],
        ink=texture.base,
        accent=accent,
        motif=choose(rng, ("crochet", "crochet", "waves", "speckle")),
        layout="whole",
        repeats=8 + index % 6,
    )


PLANT = Family(
    category="plant",
    mass_kg=0.12,
    draw=_draw_plant,
    instances=(
        (
            Plant(),
            Texture(base=CLAY, ink=EUCALYPTUS, accent=SALMON, motif="hoops", repeats=4),
        ),
        (
            Plant(
                kind="rosette",
                pot=0.02,
                pot_height=0.038,
                height=0.06,
                spread=0.0265,
                leaves=6,
                blunt=0.95,
                tips="ink",
                rim="accent",
            ),
            Texture(
                base=CLAY, ink=EUCALYPTUS, accent=SALMON, motif="leaf", layout="brick", repeats=7
            ),
        ),
        (
            Plant(
                kind="aloe",
                pot=0.019,
                pot_height=0.037,
                height=0.066,
                spread=0.027,
                leaves=8,
                blunt=0.8,
                tips="accent",
            ),
            Texture(
                base=CLAY,
                ink=EUCALYPTUS,
                accent=PORCELAIN,
                motif="chevron",
                repeats=7,
            ),
        ),
        (
            Plant(
                kind="rosette",
                pot=0.0205,
                pot_height=0.036,
                height=0.063,
                spread=0.027,
                leaves=7,
                blunt=0.85,
                tips="ink",
            ),
            Texture(base=CLAY, ink=MULBERRY, accent=PORCELAIN, motif="dots", repeats=8),
        ),
        (
            Plant(
                kind="rosette",
                pot=0.019,
                pot_height=0.036,
                height=0.06,
                spread=0.0255,
                leaves=9,
                blunt=0.6,
                tips="ink",
                rim="none",
            ),
            Texture(
                base=PORCELAIN,
                ink=EUCALYPTUS,
                accent=CLAY,
                motif="stripes",
                repeats=10,
            ),
        ),
        (
            Plant(
                kind="bush",
                pot=0.019,
                pot_height=0.038,
                height=0.066,
                spread=0.0265,
                leaves=9,
                blunt=0.8,
                tips="ink",
                rim="none",
            ),
            Texture(base=PORCELAIN, ink=STALK, accent=CLAY, motif="heart", layout="row", repeats=5),
        ),
        (
            Plant(
                kind="cactus", pot=0.0195, pot_height=0.037, height=0.07, spread=0.0265, leaves=9
            ),
            Texture(base=SKY, ink=AVOCADO, accent=SALMON, motif="star", layout="brick", repeats=6),
        ),
    ),
    recolour=_recolour_plant,
)
SCRUBBER = Family(
    category="scrubber",
    mass_kg=0.07,
    draw=_draw_scrubber,
    instances=(
        (
            Scrubber(),
            Texture(base=BERRY, ink=SEED, accent=STALK, motif="seeds", repeats=9),
        ),
        (
            Scrubber(
                outline="apple", radius=0.022, body=0.046, rows=6, bump=0.03, leaves=4, leaf=0.016
            ),
            Texture(base=BERRY, ink=SEED, accent=STALK, motif="dots", repeats=12),
        ),
        (
            Scrubber(
                outline="strawberry",
                radius=0.021,
                body=0.05,
                rows=9,
                bump=0.015,
                leaves=8,
                leaf=0.016,
            ),
            Texture(base=BERRY, ink=SEED, accent=STALK, motif="knit", repeats=10),
        ),
        (
            Scrubber(
                outline="strawberry",
                radius=0.0215,
                body=0.046,
                rows=7,
                bump=0.025,
                leaves=5,
                leaf=0.02,
            ),
            Texture(base=BERRY, ink=VIOLET, accent=STALK, motif="hoops", repeats=11),
        ),
        (
            Scrubber(
                outline="acorn", radius=0.0215, body=0.048, rows=7, bump=0.025, leaves=6, leaf=0.018
            ),
            Texture(base=LEMON, ink=SEED, accent=STALK, motif="chevron", repeats=8),
        ),
        (
            Scrubber(
                outline="strawberry",
                radius=0.0215,
                body=0.048,
                rows=7,
                bump=0.025,
                leaves=6,
                leaf=0.018,
            ),
            Texture(base=SKY, ink=PORCELAIN, accent=BERRY, motif="stripes", repeats=8),
        ),
        (
            Scrubber(
                outline="apple",
                radius=0.0215,
                body=0.048,
                rows=7,
                bump=0.025,
                leaves=0,
                leaf=0.0,
                loop=0.01,
            ),
            Texture(base=VIOLET, ink=LEMON, accent=STALK, motif="star", layout="brick", repeats=6),
        ),
    ),
    recolour=_recolour_scrubber,
)
