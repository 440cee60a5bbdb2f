"""Plushies and stuffed toys."""

import numpy as np

from vap_make.objects.bodies.plushie import Plushie
from vap_make.objects.bodies.stuffed_toy import StuffedToy
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import (
    ColourScheme,
    choose,
    recolour_with,
    uniform_outside,
)
from vap_make.objects.textures import Srgb, Texture

BARK: Srgb = (122, 88, 66)
BISCUIT: Srgb = (226, 206, 172)
BLUSH: Srgb = (214, 160, 150)
CHERRY: Srgb = (196, 58, 54)
DENIM: Srgb = (62, 84, 124)
LILAC: Srgb = (180, 162, 194)
MILK: Srgb = (238, 226, 202)
MINT: Srgb = (172, 188, 162)
NUT: Srgb = (112, 78, 56)
OAT: Srgb = (226, 196, 168)
PEBBLE: Srgb = (150, 146, 148)
PINE: Srgb = (58, 112, 108)
STORM: Srgb = (108, 136, 158)

PLUSHIE_COATS: tuple[ColourScheme, ...] = (
    ((138, 104, 76), (226, 200, 168), (236, 214, 190)),
    ((170, 166, 164), (226, 206, 206), (236, 222, 216)),
    ((218, 186, 140), (244, 226, 196), (238, 208, 176)),
    ((196, 156, 176), (240, 216, 222), (244, 226, 214)),
    ((96, 116, 140), (206, 216, 226), (226, 214, 200)),
    ((92, 70, 58), (196, 150, 120), (216, 180, 150)),
)
STUFFED_TOY_COLOURS: tuple[ColourScheme, ...] = (
    ((236, 220, 192), (96, 116, 150), (206, 110, 100)),
    ((206, 170, 128), (120, 84, 62), (150, 60, 60)),
    ((170, 190, 200), (70, 84, 104), (214, 150, 90)),
    ((226, 190, 196), (150, 90, 110), (190, 70, 90)),
    ((190, 204, 168), (90, 110, 76), (206, 130, 80)),
    ((240, 236, 226), (60, 60, 66), (200, 120, 60)),
)


def _draw_plushie(rng: np.random.Generator) -> Plushie:
    return Plushie(
        length=uniform_outside(rng, 0.068, 0.090, gap=(0.0735, 0.0835)),
        width=rng.uniform(0.056, 0.066),
        height=rng.uniform(0.0610, 0.066),
        coat=choose(rng, ("spines", "tufts", "mane", "smooth", "smooth")),
        ears=choose(rng, ("round", "long", "none")),
        snout=rng.uniform(0.014, 0.022),
    )


def _draw_stuffed_toy(rng: np.random.Generator) -> StuffedToy:
    return StuffedToy(
        radius=rng.uniform(0.0205, 0.0232),
        height=uniform_outside(rng, 0.060, 0.074, gap=(0.0635, 0.0695)),
        hat=choose(rng, ("brim", "beanie", "cap", "ears", "crest")),
        eyes=choose(rng, ("arcs", "dots", "crosses")),
        nose=choose(rng, ("ball", "bar", "wide")),
        limbs=choose(rng, ("stubs", "feet", "none")),
    )


PLUSHIE = Family(
    category="plushie",
    mass_kg=0.08,
    draw=_draw_plushie,
    instances=(
        (
            Plushie(),
            Texture(base=BARK, ink=BLUSH, accent=OAT, motif="fuzz", repeats=4),
        ),
        (
            Plushie(
                length=0.076, width=0.064, height=0.06, coat="tufts", ears="round", snout=0.016
            ),
            Texture(base=BARK, ink=BLUSH, accent=OAT, motif="patches", repeats=6),
        ),
        (
            Plushie(length=0.08, width=0.06, height=0.06, coat="mane", ears="none", snout=0.02),
            Texture(base=BARK, ink=BLUSH, accent=OAT, motif="hoops", repeats=8),
        ),
        (
            Plushie(
                length=0.075, width=0.062, height=0.062, coat="smooth", ears="round", snout=0.015
            ),
            Texture(base=BARK, ink=MILK, accent=OAT, motif="cord", repeats=4),
        ),
        (
            Plushie(
                length=0.082, width=0.06, height=0.058, coat="spines", ears="long", snout=0.018
            ),
            Texture(base=PEBBLE, ink=BLUSH, accent=OAT, motif="dots", repeats=7),
        ),
        (
            Plushie(
                length=0.077, width=0.064, height=0.062, coat="smooth", ears="long", snout=0.014
            ),
            Texture(base=STORM, ink=MILK, accent=OAT, motif="star", layout="brick", repeats=6),
        ),
    ),
    recolour=recolour_with(PLUSHIE_COATS),
)
STUFFED_TOY = Family(
    category="stuffed toy",
    mass_kg=0.07,
    draw=_draw_stuffed_toy,
    instances=(
        (
            StuffedToy(),
            Texture(base=BISCUIT, ink=NUT, accent=CHERRY, motif="sleek", repeats=4),
        ),
        (
            StuffedToy(radius=0.022, height=0.068, hat="beanie", eyes="dots", nose="wide"),
            Texture(base=BISCUIT, ink=NUT, accent=CHERRY, motif="dots", repeats=7),
        ),
        (
            StuffedToy(
                radius=0.0215, height=0.065, hat="cap", eyes="crosses", nose="bar", limbs="feet"
            ),
            Texture(base=BISCUIT, ink=NUT, accent=CHERRY, motif="hoops", repeats=9),
        ),
        (
            StuffedToy(
                radius=0.022, height=0.067, hat="brim", eyes="dots", nose="wide", limbs="feet"
            ),
            Texture(base=BISCUIT, ink=DENIM, accent=CHERRY, motif="cord", repeats=4),
        ),
        (
            StuffedToy(
                radius=0.0225, height=0.064, hat="ears", eyes="dots", nose="ball", limbs="stubs"
            ),
            Texture(base=MINT, ink=NUT, accent=CHERRY, motif="heart", layout="brick", repeats=7),
        ),
        (
            StuffedToy(
                radius=0.0215, height=0.069, hat="crest", eyes="arcs", nose="bar", limbs="none"
            ),
            Texture(base=LILAC, ink=PINE, accent=CHERRY, motif="star", layout="brick", repeats=6),
        ),
    ),
    recolour=recolour_with(STUFFED_TOY_COLOURS),
)
