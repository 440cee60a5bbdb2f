"""Leather bags and pouches."""

import numpy as np

from vap_make.objects.bodies.leather_bag import LeatherBag
from vap_make.objects.bodies.pouch import Pouch
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import (
    ColourScheme,
    choose,
    recolour_with,
    uniform_outside,
)
from vap_make.objects.textures import Srgb, Texture

CAMEL: Srgb = (168, 138, 98)
DEEP: Srgb = (44, 66, 88)
ESPRESSO: Srgb = (66, 43, 31)
FERN: Srgb = (146, 154, 112)
IVORY: Srgb = (240, 230, 212)
LAGOON: Srgb = (86, 142, 146)
LINEN: Srgb = (222, 204, 172)
MARINE: Srgb = (52, 64, 92)
ONYX: Srgb = (46, 44, 46)
PARCHMENT: Srgb = (230, 214, 186)
RASPBERRY: Srgb = (172, 92, 104)
STONE: Srgb = (150, 150, 148)
TAN: Srgb = (172, 124, 78)
WALNUT: Srgb = (84, 55, 39)

LEATHERS: tuple[ColourScheme, ...] = (
    ((102, 70, 50), (190, 146, 96), (82, 54, 40)),
    ((150, 98, 58), (226, 190, 140), (124, 78, 46)),
    ((58, 56, 58), (150, 140, 130), (74, 70, 72)),
    ((70, 84, 110), (190, 180, 160), (56, 66, 90)),
    ((130, 52, 48), (220, 190, 160), (104, 42, 40)),
    ((196, 168, 130), (110, 76, 50), (176, 146, 108)),
    ((92, 100, 74), (206, 186, 140), (76, 84, 62)),
)
POUCH_COLOURS: tuple[ColourScheme, ...] = (
    ((210, 192, 160), (140, 110, 76), (236, 224, 200)),
    ((150, 150, 154), (84, 86, 92), (226, 224, 220)),
    ((120, 84, 60), (206, 170, 124), (232, 212, 180)),
    ((196, 140, 146), (132, 76, 92), (240, 222, 220)),
    ((90, 108, 140), (48, 58, 84), (220, 216, 204)),
    ((122, 140, 104), (72, 86, 62), (226, 222, 196)),
)


def _draw_leather_bag(rng: np.random.Generator) -> LeatherBag:
    return LeatherBag(
        width=uniform_outside(rng, 0.080, 0.102, gap=(0.0865, 0.0965)),
        depth=rng.uniform(0.030, 0.038),
        height=rng.uniform(0.055, 0.066),
        flap=choose(rng, ("square", "round", "point", "none")),
        cover=rng.uniform(0.42, 0.62),
        clasp=choose(rng, ("lock", "buckles", "button", "none")),
        handle=choose(rng, ("arch", "flat", "twin")),
        hardware=choose(rng, ("metal", "gold")),
    )


def _draw_pouch(rng: np.random.Generator) -> Pouch:
    return Pouch(
        radius=uniform_outside(rng, 0.0312, 0.0334, gap=(0.0314, 0.0326)),
        thick=rng.uniform(0.035, 0.043),
        rim=rng.uniform(0.009, 0.013),
        zip=choose(rng, ("top", "front", "none")),
        pull=choose(rng, ("ring", "tab", "drop")),
        strap=choose(rng, ("loop", "handle", "none")),
        badge=choose(rng, ("none", "button", "bar")),
    )


LEATHER_BAG = Family(
    category="leather bag",
    mass_kg=0.12,
    draw=_draw_leather_bag,
    instances=(
        (
            LeatherBag(),
            Texture(base=ESPRESSO, ink=TAN, accent=WALNUT, motif="hide", repeats=5),
        ),
        (
            LeatherBag(
                width=0.09,
                depth=0.036,
                height=0.062,
                flap="round",
                cover=0.6,
                clasp="buckles",
                handle="arch",
                hardware="gold",
            ),
            Texture(base=ESPRESSO, ink=TAN, accent=WALNUT, motif="sleek", repeats=4),
        ),
        (
            LeatherBag(
                width=0.094,
                depth=0.032,
                height=0.058,
                flap="point",
                cover=0.55,
                clasp="button",
                handle="flat",
            ),
            Texture(base=ESPRESSO, ink=TAN, accent=WALNUT, motif="checks", repeats=6),
        ),
        (
            LeatherBag(
                width=0.088,
                depth=0.036,
                height=0.061,
                flap="square",
                cover=0.45,
                clasp="buckles",
                handle="twin",
            ),
            Texture(
                base=ESPRESSO, ink=PARCHMENT, accent=WALNUT, motif="star", layout="brick", repeats=7
            ),
        ),
        (
            LeatherBag(
                width=0.095,
                depth=0.033,
                height=0.06,
                flap="round",
                cover=0.56,
                clasp="lock",
                handle="twin",
                hardware="gold",
            ),
            Texture(base=MARINE, ink=TAN, accent=WALNUT, motif="chevron", repeats=5),
        ),
        (
            LeatherBag(
                width=0.089,
                depth=0.034,
                height=0.064,
                flap="none",
                cover=0.5,
                clasp="none",
                handle="twin",
            ),
            Texture(base=STONE, ink=ONYX, accent=WALNUT, motif="plaid", repeats=5),
        ),
    ),
    recolour=recolour_with(LEATHERS),
)
POUCH = Family(
    category="pouch",
    mass_kg=0.07,
    draw=_draw_pouch,
    instances=(
        (
            Pouch(),
            Texture(base=LINEN, ink=CAMEL, accent=IVORY, motif="ribs", repeats=5),
        ),
        (
            Pouch(
                radius=0.0322,
                thick=0.038,
                rim=0.01,
                zip="top",
                pull="tab",
                strap="loop",
                badge="button",
            ),
            Texture(base=LINEN, ink=CAMEL, accent=IVORY, motif="quilt", repeats=6),
        ),
        (
            Pouch(radius=0.0318, thick=0.041, rim=0.012, zip="front", pull="drop", strap="handle"),
            Texture(base=LINEN, ink=CAMEL, accent=IVORY, motif="dots", repeats=7),
        ),
        (
            Pouch(
                radius=0.032,
                thick=0.039,
                rim=0.012,
                zip="top",
                pull="drop",
                strap="none",
                badge="bar",
            ),
            Texture(base=LINEN, ink=RASPBERRY, accent=IVORY, motif="hoops", repeats=7),
        ),
        (
            Pouch(radius=0.0316, thick=0.041, rim=0.01, zip="front", pull="tab", strap="loop"),
            Texture(base=FERN, ink=CAMEL, accent=IVORY, motif="cord", repeats=5),
        ),
        (
            Pouch(
                radius=0.0324,
                thick=0.037,
                rim=0.011,
                zip="none",
                pull="ring",
                strap="handle",
                badge="button",
            ),
            Texture(base=LAGOON, ink=DEEP, accent=IVORY, motif="stripes", repeats=7),
        ),
    ),
    recolour=recolour_with(POUCH_COLOURS),
)
