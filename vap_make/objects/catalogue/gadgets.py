"""Cameras, shavers and drink cans."""

import numpy as np

from vap_make.objects.bodies.gadgets import CameraBody, Can, Shaver
from vap_make.objects.catalogue.colours import BONE, CREAM, MUSTARD, RUST, SAND, TEAL
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import choose
from vap_make.objects.textures import Srgb, Texture

COAL: Srgb = (57, 57, 61)

COLA_CAN = Texture(
    base=(168, 38, 42),
    ink=(240, 236, 232),
    accent=(168, 38, 42),
    motif="word",
    layout="band",
    repeats=2,
    word="COLA",
)


def _draw_camera(rng: np.random.Generator) -> CameraBody:
    return CameraBody(
        width=rng.uniform(0.060, 0.074),
        height=rng.uniform(0.050, 0.058),
        lens=rng.uniform(0.013, 0.018),
        bump=choose(rng, ("prism", "finder", "flash", "none")),
        strap=bool(rng.random() < 0.3),
    )


def _draw_shaver(rng: np.random.Generator) -> Shaver:
    return Shaver(
        radius=rng.uniform(0.0175, 0.0195),
        height=rng.uniform(0.106, 0.118),
        head=choose(rng, ("foil", "wide", "rotary")),
        waist=rng.uniform(0, 0.0035),
        switch=choose(rng, ("round", "bar")),
    )


def _draw_can(rng: np.random.Generator) -> Can:
    return Can(radius=rng.uniform(0.0205, 0.0220), height=rng.uniform(0.078, 0.090))


def _recolour_can(texture: Texture, index: int) -> Texture:
    """Waves in the can's own colours, whatever was drawn."""
    return Texture(
        base=(150, 52, 52),
        ink=(232, 228, 222),
        accent=(150, 52, 52),
        motif="waves",
        layout="middle",
        repeats=1 + index % 3,
    )


CAMERA = Family(
    category="camera",
    mass_kg=0.14,
    draw=_draw_camera,
    instances=(
        (
            CameraBody(),
            Texture(base=COAL, ink=SAND, accent=BONE, motif="dots", repeats=6),
        ),
        (
            CameraBody(width=0.072, height=0.052, lens=0.015, bump="finder"),
            Texture(base=COAL, ink=SAND, accent=BONE, motif="stripes", repeats=5),
        ),
        (
            CameraBody(width=0.064, height=0.056, lens=0.0175, bump="flash"),
            Texture(base=COAL, ink=BONE, accent=SAND, motif="star", layout="brick", repeats=5),
        ),
        (
            CameraBody(width=0.07, height=0.054, lens=0.014, bump="none", strap=True),
            Texture(base=COAL, ink=SAND, accent=BONE, motif="checks", repeats=5),
        ),
        (
            CameraBody(width=0.066, height=0.053, lens=0.0165, bump="prism", strap=True),
            Texture(base=COAL, ink=SAND, accent=BONE, motif="chevron", layout="half", repeats=5),
        ),
        (
            CameraBody(width=0.067, height=0.055, lens=0.0155, bump="flash", strap=True),
            Texture(base=COAL, ink=RUST, accent=BONE, motif="hoops", repeats=7),
        ),
        (
            CameraBody(width=0.073, height=0.056, lens=0.014, bump="none"),
            Texture(base=MUSTARD, ink=TEAL, accent=COAL, motif="flower", layout="brick", repeats=6),
        ),
    ),
)
SHAVER = Family(
    category="shaver",
    mass_kg=0.11,
    draw=_draw_shaver,
    instances=(
        (
            Shaver(),
            Texture(base=TEAL, ink=CREAM, accent=COAL, motif="bolt", layout="brick", repeats=4),
        ),
        (
            Shaver(radius=0.019, height=0.11, head="rotary", waist=0.002, switch="bar"),
            Texture(base=TEAL, ink=CREAM, accent=COAL, motif="hoops", layout="half", repeats=10),
        ),
        (
            Shaver(radius=0.018, height=0.116, head="wide", waist=0.001),
            Texture(base=TEAL, ink=CREAM, accent=COAL, motif="stripes", repeats=6),
        ),
        (
            Shaver(radius=0.019, height=0.108, head="foil", waist=0.002, switch="bar"),
            Texture(base=TEAL, ink=CREAM, accent=COAL, motif="checks", repeats=5),
        ),
        (
            Shaver(radius=0.0185, height=0.114, head="rotary", waist=0.0015),
            Texture(
                base=TEAL,
                ink=CREAM,
                accent=MUSTARD,
                motif="word",
                layout="band",
                repeats=2,
                word="TRIM",
            ),
        ),
        (
            Shaver(radius=0.018, height=0.112, head="wide", waist=0.0025, switch="bar"),
            Texture(base=RUST, ink=CREAM, accent=COAL, motif="dots", repeats=8),
        ),
        (
            Shaver(radius=0.019, height=0.11, head="rotary", waist=0.001, switch="bar"),
            Texture(base=MUSTARD, ink=RUST, accent=COAL, motif="chevron", repeats=6),
        ),
    ),
)
COKE_CAN = Family(
    category="coke can",
    mass_kg=0.10,
    draw=_draw_can,
    prop=((Can(), COLA_CAN),),
    recolour=_recolour_can,
)
