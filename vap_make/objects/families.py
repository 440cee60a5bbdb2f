"""Families of objects, and how their generic instances are drawn.

They keep clear of the shapes and colours of the evaluation's objects.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vap_core.base.types import value
from vap_make.objects.bodies.animals import Cat, Owl
from vap_make.objects.bodies.bags import LeatherBag, Pouch
from vap_make.objects.bodies.bottles import Basket, Bottle, Dish, Vase
from vap_make.objects.bodies.cups import Cup, PaperCup, PenHolder, StrawCup
from vap_make.objects.bodies.gadgets import Bus, CameraBody, Can, Shaver
from vap_make.objects.bodies.ornaments import House, Painting
from vap_make.objects.bodies.plants import Plant, Scrubber
from vap_make.objects.bodies.shoes import Shoe
from vap_make.objects.bodies.slipper import Slipper
from vap_make.objects.bodies.toys import Plushie, StuffedToy
from vap_make.objects.fabrics import GENERIC_FABRICS
from vap_make.objects.shapes import Shape
from vap_make.objects.textures import Srgb, Texture


@value
class Family:
    """One kind of thing.

    `draw` makes the shape of a generic instance from its generator; `recolour` maps the texture
    drawn for it and its number to the texture that it gets. `name_stem` begins the names of the
    family's objects where the category alone would be ambiguous.
    """

    category: str
    mass_kg: float
    draw: Callable[[np.random.Generator], Shape]
    recolour: Callable[[Texture, int], Texture] | None = None
    name_stem: str = ""

    @property
    def stem(self) -> str:
        """What the names of the family's objects begin with."""
        return self.name_stem or self.category.replace(" ", "-")


ColourScheme = tuple[Srgb, Srgb, Srgb]
"""Base, ink and accent."""
UNCHANGED_SHARE = 0.25
"""Share of generic instances that keep the texture drawn for them."""
FABRIC_SHARE = 0.6
"""Share of the others that get a generic fabric for a motif."""
COLOUR_JITTER = 14
"""A colour of a scheme varies by at most this many levels a channel."""


def choose[T](rng: np.random.Generator, choices: tuple[T, ...]) -> T:
    """One of `choices`, with its own type."""
    return choices[int(rng.integers(len(choices)))]


def uniform_outside(
    rng: np.random.Generator, low: float, high: float, gap: tuple[float, float]
) -> float:
    """Uniform over low..high but never within `gap`, which lies inside."""
    below, above = gap[0] - low, high - gap[1]
    t = float(rng.uniform(0, below + above))
    if t < below:
        return low + t
    return gap[1] + (t - below)


def recolour_with(schemes: tuple[ColourScheme, ...]) -> Callable[[Texture, int], Texture]:
    """A family's `recolour`: most instances get the colours of a scheme, often with a fabric."""

    def recolour(texture: Texture, index: int) -> Texture:
        rng = np.random.default_rng([29, index])
        if rng.random() < UNCHANGED_SHARE:
            return texture
        base, ink, accent = choose(rng, schemes)
        recoloured = replace(
            texture,
            base=_jitter(rng, base),
            ink=_jitter(rng, ink),
            accent=_jitter(rng, accent),
        )
        if rng.random() >= FABRIC_SHARE:
            return recoloured
        return replace(
            recoloured,
            motif=choose(rng, tuple(GENERIC_FABRICS)),
            layout=choose(rng, ("whole", "whole", "middle")),
            word="",
        )

    return recolour


def _jitter(rng: np.random.Generator, colour: Srgb) -> Srgb:
    change = rng.integers(-COLOUR_JITTER, COLOUR_JITTER + 1, 3)
    red, green, blue = np.clip(np.array(colour) + change, 0, 255).tolist()
    return red, green, blue


VIVID_COLOURS: tuple[Srgb, ...] = (
    (236, 178, 40),
    (208, 56, 48),
    (54, 112, 186),
    (66, 150, 90),
    (236, 122, 44),
    (226, 130, 160),
    (128, 92, 170),
    (90, 180, 190),
)
"""Bright colours of generic toys, scrubbers and plants."""


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
)
STRAW_CUP = Family(
    category="straw cup",
    mass_kg=0.09,
    draw=_draw_straw_cup,
)
PAPER_CUP = Family(
    category="cup",
    mass_kg=0.07,
    draw=_draw_paper_cup,
    recolour=_recolour_paper_cup,
    name_stem="paper-cup",
)


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
)
VASE = Family(
    category="vase",
    mass_kg=0.12,
    draw=_draw_vase,
)
PEN_HOLDER = Family(
    category="pen holder",
    mass_kg=0.10,
    draw=_draw_pen_holder,
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
)
SHAVER = Family(
    category="shaver",
    mass_kg=0.11,
    draw=_draw_shaver,
)
COKE_CAN = Family(
    category="coke can",
    mass_kg=0.10,
    draw=_draw_can,
    recolour=_recolour_can,
)


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
)
CAT = Family(
    category="cat figurine",
    mass_kg=0.10,
    draw=_draw_cat,
    recolour=recolour_with(CAT_COATS),
)


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
    recolour=recolour_with(PLUSHIE_COATS),
)
STUFFED_TOY = Family(
    category="stuffed toy",
    mass_kg=0.07,
    draw=_draw_stuffed_toy,
    recolour=recolour_with(STUFFED_TOY_COLOURS),
)


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
    recolour=recolour_with(LEATHERS),
)
POUCH = Family(
    category="pouch",
    mass_kg=0.07,
    draw=_draw_pouch,
    recolour=recolour_with(POUCH_COLOURS),
)


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
    recolour=recolour_with(SHOE_COLOURS),
)
SLIPPER = Family(
    category="slipper",
    mass_kg=0.08,
    draw=_draw_slipper,
    recolour=recolour_with(SLIPPER_COLOURS),
)


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
)
BUS = Family(category="toy bus", mass_kg=0.14, draw=_draw_bus, recolour=_recolour_bus)
PAINTING = Family(
    category="painting", mass_kg=0.10, draw=_draw_painting, recolour=_recolour_painting
)


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
    recolour=_recolour_plant,
)
SCRUBBER = Family(
    category="scrubber",
    mass_kg=0.07,
    draw=_draw_scrubber,
    recolour=_recolour_scrubber,
)


CANE_COLOURS: tuple[Srgb, ...] = (
    (188, 142, 88),
    (160, 118, 74),
    (214, 184, 134),
    (132, 96, 62),
    (226, 210, 176),
)
PLASTIC_COLOURS: tuple[Srgb, ...] = (
    (214, 76, 62),
    (236, 186, 58),
    (96, 172, 84),
    (74, 112, 188),
    (226, 122, 160),
    (232, 230, 224),
    (150, 104, 180),
)
PLASTIC_MOTIFS = ("plain", "waves", "gradient")


def _darken(colour: Srgb, share: float) -> Srgb:
    red, green, blue = colour
    return round(share * red), round(share * green), round(share * blue)


def _draw_plate(rng: np.random.Generator) -> Dish:
    radius = float(rng.uniform(0.066, 0.084))
    height = float(rng.uniform(0.010, 0.018))
    floor = radius * float(rng.uniform(0.58, 0.72))
    return Dish(radius=radius, height=height, floor=floor, thick=0.004)


def _draw_bowl(rng: np.random.Generator) -> Dish:
    radius, height = rng.uniform((0.062, 0.040), (0.076, 0.054)).tolist()
    return Dish(
        radius=radius,
        height=height,
        floor=radius * float(rng.uniform(0.50, 0.62)),
        thick=0.0035,
        belly=float(rng.uniform(0.002, 0.008)),
        painted="outside",
    )


def _draw_basket(rng: np.random.Generator) -> Basket:
    wide, ratio, height, flare = rng.uniform(
        (0.066, 0.75, 0.042, 0.003), (0.080, 1.0, 0.058, 0.014)
    ).tolist()
    return Basket(
        half=(wide, wide * ratio),
        height=height,
        flare=flare,
        power=choose(rng, (2.0, 2.0, 4.0, 8.0)),
    )


def _recolour_basket(texture: Texture, index: int) -> Texture:
    """Rattan in one of the colours of cane, whatever was drawn."""
    base = CANE_COLOURS[index % len(CANE_COLOURS)]
    return Texture(
        base=base,
        ink=_darken(base, 0.5),
        accent=_darken(base, 0.7),
        motif="rattan",
        layout="whole",
        repeats=12 + index % 7,
    )


def _recolour_bowl(texture: Texture, index: int) -> Texture:
    """A plastic colour with a faint motif; only the accent drawn is kept."""
    base = PLASTIC_COLOURS[index % len(PLASTIC_COLOURS)]
    return Texture(
        base=base,
        ink=_darken(base, 0.85),
        accent=texture.accent,
        motif=PLASTIC_MOTIFS[index % len(PLASTIC_MOTIFS)],
        layout="whole",
        repeats=1 + index % 3,
    )


PLATE = Family(
    category="plate",
    mass_kg=0.40,
    draw=_draw_plate,
)
BASKET = Family(
    category="basket",
    mass_kg=0.40,
    draw=_draw_basket,
    recolour=_recolour_basket,
)
PLASTIC_BOWL = Family(
    category="plastic bowl",
    mass_kg=0.40,
    draw=_draw_bowl,
    recolour=_recolour_bowl,
)

FAMILIES: tuple[Family, ...] = (
    CUP,
    BOTTLE,
    PEN_HOLDER,
    STRAW_CUP,
    OWL,
    VASE,
    CAMERA,
    SHAVER,
    COKE_CAN,
    CAT,
    PLUSHIE,
    STUFFED_TOY,
    LEATHER_BAG,
    SHOE,
    SLIPPER,
    POUCH,
    HOUSE,
    BUS,
    PLANT,
    SCRUBBER,
    PAINTING,
    PLATE,
    BASKET,
    PLASTIC_BOWL,
    PAPER_CUP,
)
"""The order is part of what seeds mean: new families go to the end."""
