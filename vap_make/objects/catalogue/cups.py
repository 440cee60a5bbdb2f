"""Cups: ceramic ones, straw cups with a lid, and disposable ones of paper."""

from dataclasses import replace

import numpy as np

from vap_make.objects.bodies.cups import Cup
from vap_make.objects.bodies.disposable_cups import PaperCup, StrawCup
from vap_make.objects.catalogue.colours import (
    CREAM,
    MUSTARD,
    NAVY,
    PLUM,
    ROSE,
    RUST,
    TEAL,
)
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

COFFEE: Srgb = (74, 48, 36)
FOREST: Srgb = (54, 98, 80)
INDIGO: Srgb = (66, 74, 124)
KRAFT: Srgb = (192, 150, 104)
PAPER_WHITE: Srgb = (236, 230, 220)
TOMATO: Srgb = (196, 70, 52)

PAPER_COLOURS: tuple[Srgb, ...] = (
    (228, 224, 216),
    (204, 172, 130),
    (62, 64, 68),
    (190, 206, 196),
    (222, 190, 180),
    (178, 194, 214),
)


def _draw_cup(rng: np.random.Generator) -> Cup:
    return Cup(
        low=rng.uniform(0.0175, 0.0210),
        high=rng.uniform(0.0195, 0.0220),
        height=rng.uniform(0.065, 0.080),
        grip=choose(rng, ("round", "square", "ear")),
        reach=rng.uniform(0.014, 0.020),
        rim=choose(rng, ("base", "ink", "accent")),
    )


def _draw_straw_cup(rng: np.random.Generator) -> StrawCup:
    return StrawCup(
        low=rng.uniform(0.0155, 0.0180),
        high=rng.uniform(0.0200, 0.0218),
        height=rng.uniform(0.074, 0.084),
        lid=choose(rng, ("flat", "dome", "step")),
        bend=bool(rng.random() < 0.5),
    )


def _draw_paper_cup(rng: np.random.Generator) -> PaperCup:
    low, high, height, sleeve_bottom, sleeve_top = rng.uniform(
        (0.0165, 0.0205, 0.070, 0.15, 0.62), (0.0182, 0.0220, 0.082, 0.30, 0.80)
    ).tolist()
    return PaperCup(
        low=low,
        high=high,
        height=height,
        sleeve=(sleeve_bottom, sleeve_top),
        rim=choose(rng, ("base", "ink", "accent", "light")),
        lid=bool(rng.random() < 0.3),
    )


def _recolour_paper_cup(texture: Texture, index: int) -> Texture:
    return replace(texture, base=PAPER_COLOURS[index % len(PAPER_COLOURS)])


CUP = Family(
    category="cup",
    mass_kg=0.10,
    draw=_draw_cup,
    instances=(
        (Cup(), Texture(base=CREAM, ink=RUST, accent=TEAL, motif="heart", layout="row", repeats=4)),
        (
            Cup(low=0.0205, high=0.0205, height=0.07, grip="square", reach=0.016),
            Texture(base=CREAM, ink=TEAL, accent=RUST, motif="hoops", repeats=8),
        ),
        (
            Cup(low=0.0185, high=0.0215, height=0.074, grip="ear", reach=0.018, rim="accent"),
            Texture(
                base=CREAM,
                ink=CREAM,
                accent=TEAL,
                motif="word",
                layout="band",
                repeats=3,
                word="MUG",
            ),
        ),
        (
            Cup(low=0.02, high=0.021, height=0.068, grip="round", reach=0.015, rim="ink"),
            Texture(base=CREAM, ink=RUST, accent=TEAL, motif="dots", repeats=7),
        ),
        (
            Cup(low=0.0195, high=0.0215, height=0.076, grip="ear", reach=0.016),
            Texture(base=CREAM, ink=RUST, accent=TEAL, motif="leaf", layout="brick", repeats=6),
        ),
        (
            Cup(low=0.019, high=0.021, height=0.073, grip="round", reach=0.016),
            Texture(base=CREAM, ink=NAVY, accent=TEAL, motif="stripes", repeats=8),
        ),
        (
            Cup(low=0.02, high=0.0215, height=0.069, grip="round", reach=0.018),
            Texture(base=NAVY, ink=MUSTARD, accent=CREAM, motif="star", layout="brick", repeats=5),
        ),
    ),
)
STRAW_CUP = Family(
    category="straw cup",
    mass_kg=0.09,
    draw=_draw_straw_cup,
    instances=(
        (
            StrawCup(),
            Texture(base=ROSE, ink=PLUM, accent=CREAM, motif="moon", layout="brick", repeats=4),
        ),
        (
            StrawCup(low=0.017, high=0.0215, height=0.078, lid="dome", bend=False),
            Texture(base=ROSE, ink=PLUM, accent=CREAM, motif="plaid", repeats=5),
        ),
        (
            StrawCup(low=0.0175, high=0.021, height=0.082, lid="step", bend=True),
            Texture(base=ROSE, ink=PLUM, accent=CREAM, motif="flower", layout="band", repeats=4),
        ),
        (
            StrawCup(low=0.0165, high=0.021, height=0.08, lid="flat", bend=False),
            Texture(base=ROSE, ink=PLUM, accent=CREAM, motif="hoops", layout="half", repeats=10),
        ),
        (
            StrawCup(low=0.017, high=0.0215, height=0.076, lid="dome", bend=True),
            Texture(
                base=ROSE, ink=PLUM, accent=CREAM, motif="word", layout="row", repeats=3, word="YUM"
            ),
        ),
        (
            StrawCup(low=0.0168, high=0.0212, height=0.079, lid="step", bend=False),
            Texture(base=CREAM, ink=PLUM, accent=ROSE, motif="stripes", repeats=9),
        ),
        (
            StrawCup(low=0.0172, high=0.0215, height=0.077, lid="dome", bend=False),
            Texture(base=TEAL, ink=MUSTARD, accent=CREAM, motif="dots", repeats=8),
        ),
    ),
)
PAPER_CUP = Family(
    category="cup",
    mass_kg=0.07,
    draw=_draw_paper_cup,
    instances=(
        (
            PaperCup(),
            Texture(base=COFFEE, ink=KRAFT, accent=PAPER_WHITE, motif="hoops", repeats=8),
        ),
        (
            PaperCup(low=0.0182, high=0.0215, height=0.078, sleeve=(0.2, 0.72), rim="ink"),
            Texture(
                base=COFFEE,
                ink=KRAFT,
                accent=PAPER_WHITE,
                motif="chevron",
                repeats=9,
            ),
        ),
        (
            PaperCup(low=0.0178, high=0.0212, height=0.074, sleeve=(0.24, 0.74), rim="light"),
            Texture(
                base=COFFEE,
                ink=KRAFT,
                accent=PAPER_WHITE,
                motif="word",
                layout="row",
                repeats=3,
                word="CAFE",
            ),
        ),
        (
            PaperCup(low=0.018, high=0.0215, height=0.075, sleeve=(0.22, 0.66), rim="base"),
            Texture(
                base=COFFEE,
                ink=FOREST,
                accent=PAPER_WHITE,
                motif="stripes",
                repeats=12,
            ),
        ),
        (
            PaperCup(low=0.0176, high=0.0214, height=0.077, sleeve=(0.12, 0.86), rim="accent"),
            Texture(base=PAPER_WHITE, ink=KRAFT, accent=COFFEE, motif="dots", repeats=8),
        ),
        (
            PaperCup(
                low=0.0178, high=0.0213, height=0.073, sleeve=(0.26, 0.74), rim="accent", lid=True
            ),
            Texture(
                base=INDIGO, ink=PAPER_WHITE, accent=COFFEE, motif="star", layout="brick", repeats=5
            ),
        ),
        (
            PaperCup(low=0.018, high=0.0215, height=0.076, sleeve=(0.1, 0.88), rim="ink"),
            Texture(
                base=PAPER_WHITE,
                ink=TOMATO,
                accent=COFFEE,
                motif="heart",
                layout="brick",
                repeats=6,
            ),
        ),
    ),
    recolour=_recolour_paper_cup,
    name_stem="paper-cup",
)
