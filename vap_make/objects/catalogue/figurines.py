"""Figurines: owls and cats."""

import numpy as np

from vap_make.objects.bodies.cat import Cat
from vap_make.objects.bodies.owl import Owl
from vap_make.objects.catalogue.colours import (
    BONE,
    COCOA,
    CREAM,
    MOSS,
    MUSTARD,
    SAGE,
    SAND,
    TEAL,
)
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import (
    ColourScheme,
    choose,
    recolour_with,
    uniform_outside,
)
from vap_make.objects.textures import Srgb, Texture

AMBER: Srgb = (214, 160, 60)
ASH: Srgb = (152, 142, 148)
FLAX: Srgb = (240, 220, 186)
GINGER: Srgb = (206, 128, 62)
JADE: Srgb = (126, 168, 92)
SNOW: Srgb = (236, 232, 224)
SOOT: Srgb = (43, 42, 46)

CAT_COATS: tuple[ColourScheme, ...] = (
    ((58, 56, 60), (176, 166, 160), (192, 170, 66)),
    ((150, 148, 152), (84, 82, 88), (120, 160, 110)),
    ((196, 118, 66), (240, 214, 176), (110, 150, 80)),
    ((226, 214, 194), (146, 108, 80), (96, 140, 170)),
    ((110, 80, 62), (206, 172, 136), (200, 160, 70)),
    ((240, 236, 230), (90, 86, 88), (90, 140, 180)),
)


def _draw_owl(rng: np.random.Generator) -> Owl:
    return Owl(
        height=rng.uniform(0.070, 0.084),
        belly=rng.uniform(0.0200, 0.0218),
        ears=choose(rng, ("tuft", "wide", "none")),
        eye=rng.uniform(0.006, 0.0085),
        wings=choose(rng, ("folded", "spread")),
    )


def _draw_cat(rng: np.random.Generator) -> Cat:
    return Cat(
        height=uniform_outside(rng, 0.069, 0.088, gap=(0.0725, 0.0805)),
        girth=rng.uniform(0.0170, 0.0205),
        ears=choose(rng, ("round", "pointed", "pointed", "folded")),
        tail=choose(rng, ("curl", "up", "wrap")),
        face=choose(rng, ("plain", "muzzle", "mask")),
        collar=bool(rng.random() < 0.4),
    )


OWL = Family(
    category="owl figurine",
    mass_kg=0.11,
    draw=_draw_owl,
    instances=(
        (
            Owl(),
            Texture(base=SAND, ink=COCOA, accent=CREAM, motif="heart", layout="brick", repeats=8),
        ),
        (
            Owl(height=0.076, belly=0.0215, ears="wide", eye=0.008),
            Texture(base=SAND, ink=COCOA, accent=CREAM, motif="hoops", repeats=8),
        ),
        (
            Owl(height=0.074, belly=0.021, ears="none", eye=0.0068),
            Texture(base=SAND, ink=COCOA, accent=CREAM, motif="dots", repeats=9),
        ),
        (
            Owl(height=0.08, belly=0.021, ears="tuft", eye=0.0062, wings="spread"),
            Texture(base=SAND, ink=MOSS, accent=CREAM, motif="chevron", repeats=8),
        ),
        (
            Owl(height=0.078, belly=0.0215, ears="wide", eye=0.007, wings="spread"),
            Texture(base=SAND, ink=COCOA, accent=MUSTARD, motif="star", layout="band", repeats=6),
        ),
        (
            Owl(height=0.077, belly=0.021, ears="tuft", eye=0.0076),
            Texture(base=SAGE, ink=COCOA, accent=CREAM, motif="stripes", repeats=10),
        ),
        (
            Owl(height=0.073, belly=0.0215, ears="none", eye=0.0082, wings="spread"),
            Texture(base=BONE, ink=TEAL, accent=CREAM, motif="leaf", layout="brick", repeats=8),
        ),
    ),
)
CAT = Family(
    category="cat figurine",
    mass_kg=0.10,
    draw=_draw_cat,
    instances=(
        (Cat(), Texture(base=SOOT, ink=ASH, accent=AMBER, motif="sleek", repeats=4)),
        (
            Cat(height=0.074, girth=0.019, ears="pointed", tail="up", face="muzzle"),
            Texture(base=SOOT, ink=ASH, accent=AMBER, motif="tabby", repeats=6),
        ),
        (
            Cat(height=0.078, girth=0.018, ears="folded", tail="curl", face="plain", collar=True),
            Texture(base=SOOT, ink=ASH, accent=JADE, motif="heart", layout="brick", repeats=6),
        ),
        (
            Cat(height=0.075, girth=0.019, ears="pointed", tail="wrap", face="mask"),
            Texture(base=SOOT, ink=SNOW, accent=AMBER, motif="patches", repeats=4, seed=3),
        ),
        (
            Cat(height=0.08, girth=0.0185, ears="round", tail="up", face="muzzle", collar=True),
            Texture(base=SNOW, ink=ASH, accent=AMBER, motif="dots", repeats=6),
        ),
        (
            Cat(height=0.073, girth=0.0195, ears="pointed", tail="curl", face="mask"),
            Texture(base=GINGER, ink=FLAX, accent=AMBER, motif="stripes", repeats=6),
        ),
    ),
    recolour=recolour_with(CAT_COATS),
)
