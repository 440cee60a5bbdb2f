"""Shoes and slippers."""

import numpy as np

from vap_make.objects.bodies.shoe import Shoe
from vap_make.objects.bodies.slipper import Slipper
from vap_make.objects.catalogue.family import Family
from vap_make.objects.catalogue.sampling import (
    ColourScheme,
    choose,
    recolour_with,
    uniform_outside,
)
from vap_make.objects.textures import Srgb, Texture

BRICK: Srgb = (158, 78, 58)
CHALK: Srgb = (224, 224, 220)
CHESTNUT: Srgb = (120, 82, 54)
CORAL: Srgb = (196, 100, 78)
DUSK: Srgb = (92, 112, 138)
HONEY: Srgb = (222, 200, 166)
INKY: Srgb = (38, 38, 42)
IRON: Srgb = (74, 76, 84)
MIDNIGHT: Srgb = (58, 66, 96)
MIST: Srgb = (134, 154, 172)
OLIVE: Srgb = (122, 130, 86)
PETAL: Srgb = (208, 152, 152)
WINE: Srgb = (112, 46, 58)
WOOL: Srgb = (240, 228, 206)

SHOE_COLOURS: tuple[ColourScheme, ...] = (
    ((110, 120, 130), (52, 52, 56), (236, 234, 230)),
    ((60, 64, 74), (226, 224, 220), (206, 204, 200)),
    ((226, 224, 220), (80, 100, 130), (240, 238, 234)),
    ((170, 70, 62), (40, 40, 44), (230, 226, 216)),
    ((104, 84, 66), (60, 46, 38), (190, 160, 116)),
    ((88, 128, 110), (44, 54, 52), (228, 228, 218)),
)
SLIPPER_COLOURS: tuple[ColourScheme, ...] = (
    ((206, 190, 166), (140, 104, 76), (232, 220, 200)),
    ((130, 130, 136), (70, 70, 76), (226, 222, 216)),
    ((150, 104, 72), (90, 62, 46), (226, 206, 176)),
    ((204, 164, 170), (150, 96, 110), (244, 230, 226)),
    ((96, 112, 140), (56, 64, 84), (214, 214, 208)),
    ((150, 160, 132), (94, 102, 80), (232, 228, 210)),
)


def _draw_shoe(rng: np.random.Generator) -> Shoe:
    return Shoe(
        length=uniform_outside(rng, 0.092, 0.107, gap=(0.0995, 0.1055)),
        width=rng.uniform(0.041, 0.047),
        height=rng.uniform(0.059, 0.065),
        sole=rng.uniform(0.011, 0.017),
        closure=choose(rng, ("laces", "laces", "straps", "slip")),
        side=choose(rng, ("bars", "wave", "patch", "none")),
        toe=choose(rng, ("plain", "cap", "bumper")),
    )


def _draw_slipper(rng: np.random.Generator) -> Slipper:
    return Slipper(
        length=uniform_outside(rng, 0.094, 0.109, gap=(0.1015, 0.1075)),
        width=rng.uniform(0.043, 0.049),
        height=rng.uniform(0.0605, 0.065),
        sole=rng.uniform(0.007, 0.012),
        back=choose(rng, ("mule", "mule", "bootie")),
        charm=choose(rng, ("none", "none", "bow", "pompom", "ears", "band")),
        lining=choose(rng, ("light", "accent", "ink")),
    )


SHOE = Family(
    category="shoe",
    mass_kg=0.10,
    draw=_draw_shoe,
    instances=(
        (
            Shoe(),
            Texture(base=DUSK, ink=INKY, accent=CHALK, motif="sleek", repeats=4),
        ),
        (
            Shoe(
                length=0.102,
                width=0.045,
                height=0.062,
                sole=0.0125,
                closure="laces",
                side="bars",
                toe="cap",
            ),
            Texture(base=DUSK, ink=INKY, accent=CHALK, motif="cord", repeats=4),
        ),
        (
            Shoe(
                length=0.105,
                width=0.043,
                height=0.06,
                sole=0.016,
                closure="straps",
                side="patch",
                toe="plain",
            ),
            Texture(base=DUSK, ink=INKY, accent=CHALK, motif="checks", repeats=7),
        ),
        (
            Shoe(
                length=0.101,
                width=0.044,
                height=0.061,
                sole=0.0135,
                closure="laces",
                side="patch",
                toe="bumper",
            ),
            Texture(base=DUSK, ink=BRICK, accent=CHALK, motif="dots", repeats=7),
        ),
        (
            Shoe(
                length=0.103,
                width=0.045,
                height=0.06,
                sole=0.015,
                closure="laces",
                side="bars",
                toe="bumper",
            ),
            Texture(base=CORAL, ink=INKY, accent=CHALK, motif="chevron", repeats=5),
        ),
        (
            Shoe(
                length=0.1,
                width=0.044,
                height=0.06,
                sole=0.012,
                closure="slip",
                side="none",
                toe="cap",
            ),
            Texture(base=OLIVE, ink=WINE, accent=CHALK, motif="plaid", repeats=5),
        ),
    ),
    recolour=recolour_with(SHOE_COLOURS),
)
SLIPPER = Family(
    category="slipper",
    mass_kg=0.08,
    draw=_draw_slipper,
    instances=(
        (
            Slipper(),
            Texture(base=HONEY, ink=CHESTNUT, accent=WOOL, motif="quilt", repeats=6),
        ),
        (
            Slipper(
                length=0.104,
                width=0.047,
                height=0.061,
                sole=0.008,
                back="mule",
                charm="band",
                lining="accent",
            ),
            Texture(base=HONEY, ink=CHESTNUT, accent=WOOL, motif="cord", repeats=4),
        ),
        (
            Slipper(
                length=0.103,
                width=0.046,
                height=0.062,
                sole=0.01,
                back="bootie",
                charm="bow",
                lining="accent",
            ),
            Texture(base=HONEY, ink=CHESTNUT, accent=WOOL, motif="dots", repeats=6),
        ),
        (
            Slipper(
                length=0.105,
                width=0.047,
                height=0.06,
                sole=0.009,
                back="mule",
                charm="pompom",
                lining="light",
            ),
            Texture(base=HONEY, ink=MIDNIGHT, accent=WOOL, motif="hoops", repeats=9),
        ),
        (
            Slipper(
                length=0.107,
                width=0.046,
                height=0.06,
                sole=0.011,
                back="bootie",
                charm="none",
                lining="ink",
            ),
            Texture(base=PETAL, ink=CHESTNUT, accent=WOOL, motif="plaid", repeats=5),
        ),
        (
            Slipper(
                length=0.102,
                width=0.047,
                height=0.06,
                sole=0.009,
                back="mule",
                charm="ears",
                lining="light",
            ),
            Texture(base=MIST, ink=IRON, accent=WOOL, motif="sleek", repeats=4),
        ),
    ),
    recolour=recolour_with(SLIPPER_COLOURS),
)
