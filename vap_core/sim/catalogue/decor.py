"""Things that decorate a home: miniature houses, toy buses, plants, knitted scrubbers and paintings."""

import numpy as np

from vap_core.sim.bodies.kitchen import Scrubber
from vap_core.sim.bodies.plants import Plant
from vap_core.sim.bodies.toys import Bus, House, Painting
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.textures import Ink, Texture

BRICK, BLUE, LAWN, IVORY, GOLD, WALNUT = (190, 50, 46), (48, 100, 178), (86, 146, 72), (238, 230, 212), (226, 176, 64), (92, 64, 46)
CLAY, JADE, BLUSH, CHALK, PLUM, OLIVE = (190, 108, 76), (104, 158, 108), (214, 122, 118), (232, 228, 220), (112, 70, 104), (128, 132, 62)
BERRY, SEED, STALK, SKY, LEMON, VIOLET = (200, 40, 48), (246, 218, 150), (66, 126, 58), (98, 160, 200), (236, 204, 70), (112, 84, 164)
GREENS: tuple[Ink, ...] = ((72, 128, 64), (96, 150, 84), (56, 104, 72), (130, 160, 90), (84, 132, 108), (112, 140, 60))
POTS: tuple[Ink, ...] = ((178, 102, 72), (226, 222, 212), (110, 116, 122), (196, 162, 120), (84, 108, 140), (208, 176, 72), (160, 84, 92))
VIVID: tuple[Ink, ...] = (
    (236, 178, 40),
    (208, 56, 48),
    (54, 112, 186),
    (66, 150, 90),
    (236, 122, 44),
    (226, 130, 160),
    (128, 92, 170),
    (90, 180, 190),
)
SKIES: tuple[Ink, ...] = ((150, 196, 226), (238, 198, 150), (226, 224, 206), (176, 206, 196), (206, 184, 214), (120, 160, 204))
LANDS: tuple[Ink, ...] = ((70, 120, 84), (44, 92, 140), (150, 84, 66), (112, 84, 130), (196, 92, 60), (40, 110, 120))


def _leafy(drawn: Texture, index: int) -> Texture:
    return Texture(
        POTS[index % 7],
        GREENS[index % 6],
        VIVID[(3 * index) % 8] if index % 2 else drawn.accent,
        drawn.motif,
        drawn.layout,
        drawn.repeats,
        drawn.word,
        drawn.seed,
    )


def _vivid(drawn: Texture, index: int) -> Texture:
    return Texture(VIVID[index % 8], drawn.base, drawn.accent, drawn.motif, drawn.layout, drawn.repeats, drawn.word, drawn.seed)


def _woolly(drawn: Texture, index: int) -> Texture:
    base, leaf = VIVID[(3 * index + 1) % 8], GREENS[index % 6] if index % 3 else drawn.accent
    return Texture(base, drawn.base, leaf, pick(np.random.default_rng(index), ("crochet", "crochet", "waves", "speckle")), "whole", 8 + index % 6)


def _canvas(drawn: Texture, index: int) -> Texture:
    return Texture(SKIES[index % 6], LANDS[(index // 2) % 6], drawn.accent, ("gradient", "plain", "gradient", "speckle")[index % 4], "whole", 2,
                   seed=drawn.seed)  # fmt: skip


def _house(rng: np.random.Generator) -> House:
    wide, deep, eaves, rise = rng.uniform((0.048, 0.040, 0.032, 0.0225), (0.064, 0.050, 0.044, 0.032)).tolist()
    return House(wide, deep, eaves, rise, pick(rng, ("gable", "hip", "barn", "flat")), pick(rng, ("accent", "ink", "dark", "warm")),
                 int(rng.integers(1, 4)), 2 if eaves > 0.038 else 1, bool(rng.random() < 0.5))  # fmt: skip


def _bus(rng: np.random.Generator) -> Bus:
    long, wide = rng.uniform((0.080, 0.037), (0.098, 0.043)).tolist()
    decks = pick(rng, (1, 1, 2))
    height = float(rng.uniform(0.061, 0.066) if decks == 1 else rng.uniform(0.070, 0.080))
    nose = float(rng.uniform(0.014, 0.020)) if decks == 1 and rng.random() < 0.4 else 0.0
    return Bus(long, wide, height, decks, nose, pick(rng, ("light", "base", "accent")))


def _plant(rng: np.random.Generator) -> Plant:
    pot, spread, tall, base = rng.uniform((0.0175, 0.0235, 0.024, 0.036), (0.0205, 0.0285, 0.036, 0.041)).tolist()
    return Plant(pick(rng, ("rosette", "aloe", "cactus", "bush")), pot, base, base + tall, spread, int(rng.integers(6, 10)),
                 float(rng.uniform(0.45, 0.9)), pick(rng, ("ink", "accent")), pick(rng, ("base", "accent", "none")))  # fmt: skip


def _scrubber(rng: np.random.Generator) -> Scrubber:
    radius, body, bump, leaf, loop = rng.uniform((0.0195, 0.044, 0.010, 0.014, 0.0085), (0.0220, 0.054, 0.030, 0.020, 0.0105)).tolist()
    return Scrubber(pick(rng, ("pear", "drum", "ball")), radius, body, int(rng.integers(5, 9)), bump, pick(rng, (0, 4, 5, 8)), leaf, loop)


def _painting(rng: np.random.Generator) -> Painting:
    wide, high, frame = rng.uniform((0.080, 0.086, 0.007), (0.096, 0.106, 0.011)).tolist()
    return Painting(wide, high, frame, pick(rng, ("hills", "sea", "flower", "blocks")), pick(rng, ("warm", "dark", "light", "accent")))


FAMILIES: tuple[Family, ...] = (
    Family(
        "miniature house",
        0.14,
        _house,
        (
            (House(), Texture(BRICK, BLUE, LAWN, "planks", "full", 30)),
            (House(0.056, 0.044, 0.040, 0.022, "hip", "base", 1, 1, False), Texture(BRICK, BLUE, LAWN, "dots", "full", 16)),
            (House(0.060, 0.044, 0.034, 0.030, "barn", "ink", 3), Texture(BRICK, BLUE, GOLD, "stripes", "full", 14)),
            (House(0.052, 0.048, 0.044, 0.024, "gable", "base", 2, 2), Texture(BRICK, IVORY, LAWN, "checks", "full", 12)),
            (House(0.060, 0.046, 0.036, 0.024, "gable", "ink", 2, 1, False), Texture(IVORY, BLUE, BRICK, "heart", "brick", 12)),
            (House(0.050, 0.044, 0.042, 0.022, "flat", "light", 2, 2, False), Texture(GOLD, WALNUT, LAWN, "hoops", "full", 12)),
            (House(0.058, 0.044, 0.036, 0.028, "hip", "warm", 3), Texture(LAWN, CHALK, WALNUT, "chevron", "full", 14)),
        ),
    ),
    Family(
        "toy bus",
        0.14,
        _bus,
        paint=_vivid,
    ),
    Family(
        "plant",
        0.12,
        _plant,
        (
            (Plant(), Texture(CLAY, JADE, BLUSH, "hoops", "full", 4)),
            (Plant("rosette", 0.0200, 0.038, 0.060, 0.0265, 6, 0.95, "ink", "accent"), Texture(CLAY, JADE, BLUSH, "leaf", "brick", 7)),
            (Plant("aloe", 0.0190, 0.037, 0.066, 0.0270, 8, 0.8, "accent"), Texture(CLAY, JADE, CHALK, "chevron", "full", 7)),
            (Plant("rosette", 0.0205, 0.036, 0.063, 0.0270, 7, 0.85, "ink"), Texture(CLAY, PLUM, CHALK, "dots", "full", 8)),
            (Plant("rosette", 0.0190, 0.036, 0.060, 0.0255, 9, 0.6, "ink", "none"), Texture(CHALK, JADE, CLAY, "stripes", "full", 10)),
            (Plant("bush", 0.0190, 0.038, 0.066, 0.0265, 9, 0.8, "ink", "none"), Texture(CHALK, STALK, CLAY, "heart", "row", 5)),
            (Plant("cactus", 0.0195, 0.037, 0.070, 0.0265, 9), Texture(SKY, OLIVE, BLUSH, "star", "brick", 6)),
        ),
        paint=_leafy,
    ),
    Family(
        "scrubber",
        0.07,
        _scrubber,
        (
            (Scrubber(), Texture(BERRY, SEED, STALK, "seeds", "full", 9)),
            (Scrubber("apple", 0.0220, 0.046, 6, 0.03, 4, 0.016), Texture(BERRY, SEED, STALK, "dots", "full", 12)),
            (Scrubber("strawberry", 0.0210, 0.050, 9, 0.015, 8, 0.016), Texture(BERRY, SEED, STALK, "knit", "full", 10)),
            (Scrubber("strawberry", 0.0215, 0.046, 7, 0.025, 5, 0.020), Texture(BERRY, VIOLET, STALK, "hoops", "full", 11)),
            (Scrubber("acorn", 0.0215, 0.048, 7, 0.025, 6, 0.018), Texture(LEMON, SEED, STALK, "chevron", "full", 8)),
            (Scrubber("strawberry", 0.0215, 0.048, 7, 0.025, 6, 0.018), Texture(SKY, CHALK, BERRY, "stripes", "full", 8)),
            (Scrubber("apple", 0.0215, 0.048, 7, 0.025, 0, 0.0, 0.0100), Texture(VIOLET, LEMON, STALK, "star", "brick", 6)),
        ),
        paint=_woolly,
    ),
    Family("painting", 0.10, _painting, paint=_canvas),
)  # fmt: skip
