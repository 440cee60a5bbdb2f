"""Other upright vessels: bottles, vases and pen holders."""

import numpy as np

from vap_make.objects.bodies.bottles import Bottle, Vase
from vap_make.objects.bodies.pen_holder import PenHolder
from vap_make.objects.catalogue.colours import (
    BONE,
    COCOA,
    CREAM,
    MOSS,
    MUSTARD,
    NAVY,
    PLUM,
    ROSE,
    RUST,
    SAGE,
    SAND,
)
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

SLATE: Srgb = (98, 112, 127)

URN = ((0.0165, 0.0), (0.0185, 0.2), (0.0212, 0.55), (0.0195, 0.72), (0.011, 0.9), (0.0145, 1.0))
"""Outlines of vases: (radius, share of the height), base to lip."""
GOURD = (
    (0.0185, 0.0),
    (0.0212, 0.25),
    (0.0185, 0.55),
    (0.0172, 0.75),
    (0.0115, 0.9),
    (0.0155, 1.0),
)
AMPHORA = (
    (0.0150, 0.0),
    (0.0190, 0.35),
    (0.0215, 0.62),
    (0.0185, 0.76),
    (0.0085, 0.88),
    (0.0125, 1.0),
)
CARAFE = (
    (0.0190, 0.0),
    (0.0208, 0.15),
    (0.0200, 0.45),
    (0.0178, 0.70),
    (0.0120, 0.88),
    (0.0160, 1.0),
)
FLUTE = ((0.0165, 0.0), (0.0172, 0.3), (0.0182, 0.6), (0.0195, 0.85), (0.0215, 1.0))


def _draw_bottle(rng: np.random.Generator) -> Bottle:
    return Bottle(
        radius=rng.uniform(0.0185, 0.0215),
        height=rng.uniform(0.105, 0.120),
        shoulder=rng.uniform(0.65, 0.75),
        neck=rng.uniform(0.0075, 0.012),
        cap=choose(rng, ("screw", "sport", "ball")),
        waist=rng.uniform(0, 0.003),
    )


def _draw_vase(rng: np.random.Generator) -> Vase:
    low, middle, neck, lip = rng.uniform(
        (0.0150, 0.0190, 0.0080, 0.0110), (0.0185, 0.0220, 0.0150, 0.0185)
    ).tolist()
    waist = float(rng.uniform(0.35, 0.6))
    return Vase(
        height=float(rng.uniform(0.098, 0.118)),
        knots=((low, 0.0), (middle, waist), (0.92 * middle, 0.74), (neck, 0.89), (lip, 1.0)),
        handles=bool(rng.random() < 0.25),
    )


def _draw_pen_holder(rng: np.random.Generator) -> PenHolder:
    return PenHolder(
        radius=rng.uniform(0.0190, 0.0215),
        height=rng.uniform(0.074, 0.084),
        sides=choose(rng, (4, 6, 24, 24)),
        pens=int(rng.integers(3, 6)),
        rim=choose(rng, ("base", "ink", "accent")),
    )


BOTTLE = Family(
    category="bottle",
    mass_kg=0.12,
    draw=_draw_bottle,
    instances=(
        (
            Bottle(),
            Texture(base=SLATE, ink=CREAM, accent=MUSTARD, motif="star", layout="band", repeats=4),
        ),
        (
            Bottle(radius=0.0205, height=0.112, shoulder=0.72, neck=0.01, cap="sport"),
            Texture(base=SLATE, ink=CREAM, accent=MUSTARD, motif="stripes", repeats=7),
        ),
        (
            Bottle(radius=0.0195, height=0.118, shoulder=0.66, neck=0.0085, cap="ball"),
            Texture(base=SLATE, ink=CREAM, accent=MUSTARD, motif="fish", layout="brick", repeats=4),
        ),
        (
            Bottle(radius=0.0205, height=0.114, shoulder=0.7, neck=0.009, cap="screw", waist=0.002),
            Texture(
                base=SLATE, ink=CREAM, accent=MUSTARD, motif="chevron", layout="half", repeats=6
            ),
        ),
        (
            Bottle(radius=0.02, height=0.11, shoulder=0.74, neck=0.011, cap="sport"),
            Texture(
                base=SLATE,
                ink=CREAM,
                accent=MUSTARD,
                motif="word",
                layout="row",
                repeats=3,
                word="H2O",
            ),
        ),
        (
            Bottle(radius=0.0195, height=0.113, shoulder=0.7, neck=0.0095, cap="screw"),
            Texture(base=RUST, ink=CREAM, accent=SLATE, motif="dots", repeats=8),
        ),
        (
            Bottle(radius=0.0205, height=0.117, shoulder=0.68, neck=0.0105, cap="ball"),
            Texture(base=PLUM, ink=SAND, accent=MUSTARD, motif="heart", layout="brick", repeats=5),
        ),
    ),
)
VASE = Family(
    category="vase",
    mass_kg=0.12,
    draw=_draw_vase,
    instances=(
        (
            Vase(),
            Texture(base=BONE, ink=NAVY, accent=SLATE, motif="leaf", layout="brick", repeats=5),
        ),
        (
            Vase(height=0.112, knots=URN),
            Texture(base=BONE, ink=NAVY, accent=SLATE, motif="chevron", repeats=6),
        ),
        (
            Vase(height=0.108, knots=GOURD),
            Texture(base=BONE, ink=NAVY, accent=SLATE, motif="flower", layout="row", repeats=4),
        ),
        (
            Vase(height=0.114, knots=AMPHORA, handles=True),
            Texture(base=BONE, ink=NAVY, accent=SLATE, motif="hoops", repeats=10),
        ),
        (
            Vase(height=0.106, knots=FLUTE),
            Texture(base=BONE, ink=BONE, accent=NAVY, motif="fish", layout="band", repeats=4),
        ),
        (
            Vase(height=0.11, knots=CARAFE),
            Texture(base=ROSE, ink=NAVY, accent=SLATE, motif="dots", repeats=8),
        ),
        (
            Vase(height=0.112, knots=URN, handles=True),
            Texture(base=MOSS, ink=MUSTARD, accent=BONE, motif="stripes", repeats=9),
        ),
    ),
)
PEN_HOLDER = Family(
    category="pen holder",
    mass_kg=0.10,
    draw=_draw_pen_holder,
    instances=(
        (
            PenHolder(),
            Texture(base=SAGE, ink=COCOA, accent=CREAM, motif="paw", layout="row", repeats=4),
        ),
        (
            PenHolder(radius=0.0205, height=0.082, sides=6, pens=3, rim="ink"),
            Texture(base=SAGE, ink=COCOA, accent=CREAM, motif="checks", repeats=6),
        ),
        (
            PenHolder(radius=0.02, height=0.078, sides=4, pens=4, rim="base"),
            Texture(base=SAGE, ink=COCOA, accent=CREAM, motif="smile", layout="band", repeats=4),
        ),
        (
            PenHolder(radius=0.021, height=0.08, sides=24, pens=5, rim="ink"),
            Texture(base=SAGE, ink=CREAM, accent=COCOA, motif="bolt", layout="brick", repeats=6),
        ),
        (
            PenHolder(radius=0.0205, height=0.076, sides=24, pens=3, rim="accent"),
            Texture(base=SAGE, ink=COCOA, accent=CREAM, motif="stripes", layout="half", repeats=8),
        ),
        (
            PenHolder(radius=0.0205, height=0.081, sides=6, pens=4, rim="accent"),
            Texture(base=MUSTARD, ink=COCOA, accent=CREAM, motif="dots", repeats=8),
        ),
        (
            PenHolder(radius=0.02, height=0.079, sides=24, pens=5, rim="base"),
            Texture(base=RUST, ink=NAVY, accent=CREAM, motif="chevron", repeats=6),
        ),
    ),
)
