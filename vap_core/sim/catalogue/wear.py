"""What one carries and wears: leather bags, shoes, slippers and pouches."""

from vap_core.sim.bodies.bags import LeatherBag, Pouch
from vap_core.sim.bodies.footwear import Shoe, Slipper
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.catalogue.generics import beside, dressed
from vap_core.sim.textures import Texture

ESPRESSO, TAN, WALNUT, PARCHMENT, MARINE, STONE, ONYX = (
    (66, 43, 31), (172, 124, 78), (84, 55, 39), (230, 214, 186), (52, 64, 92), (150, 150, 148), (46, 44, 46),
)  # fmt: skip
DUSK, INKY, CHALK, BRICK, CORAL, OLIVE, WINE = (
    (92, 112, 138),
    (38, 38, 42),
    (224, 224, 220),
    (158, 78, 58),
    (196, 100, 78),
    (122, 130, 86),
    (112, 46, 58),
)
HONEY, CHESTNUT, WOOL, MIDNIGHT, PETAL, MIST, IRON = (
    (222, 200, 166), (120, 82, 54), (240, 228, 206), (58, 66, 96), (208, 152, 152), (134, 154, 172), (74, 76, 84),
)  # fmt: skip
LINEN, CAMEL, IVORY, RASPBERRY, FERN, LAGOON, DEEP = (
    (222, 204, 172), (168, 138, 98), (240, 230, 212), (172, 92, 104), (146, 154, 112), (86, 142, 146), (44, 66, 88),
)  # fmt: skip

FAMILIES: tuple[Family, ...] = (
    Family(
        "leather bag",
        0.12,
        lambda g: LeatherBag(beside(g, 0.080, 0.102, (0.0865, 0.0965)), g.uniform(0.030, 0.038), g.uniform(0.055, 0.066),
            pick(g, ("square", "round", "point", "none")), g.uniform(0.42, 0.62), pick(g, ("lock", "buckles", "button", "none")),
            pick(g, ("arch", "flat", "twin")), pick(g, ("metal", "gold"))),
        (
            (LeatherBag(), Texture(ESPRESSO, TAN, WALNUT, "hide", "full", 5)),
            (LeatherBag(0.090, 0.036, 0.062, "round", 0.60, "buckles", "arch", "gold"), Texture(ESPRESSO, TAN, WALNUT, "sleek", "full", 4)),
            (LeatherBag(0.094, 0.032, 0.058, "point", 0.55, "button", "flat"), Texture(ESPRESSO, TAN, WALNUT, "checks", "full", 6)),
            (LeatherBag(0.088, 0.036, 0.061, "square", 0.45, "buckles", "twin"), Texture(ESPRESSO, PARCHMENT, WALNUT, "star", "brick", 7)),
            (LeatherBag(0.095, 0.033, 0.060, "round", 0.56, "lock", "twin", "gold"), Texture(MARINE, TAN, WALNUT, "chevron", "full", 5)),
            (LeatherBag(0.089, 0.034, 0.064, "none", 0.50, "none", "twin"), Texture(STONE, ONYX, WALNUT, "plaid", "full", 5)),
        ),
        paint=dressed((
            ((102, 70, 50), (190, 146, 96), (82, 54, 40)), ((150, 98, 58), (226, 190, 140), (124, 78, 46)),
            ((58, 56, 58), (150, 140, 130), (74, 70, 72)), ((70, 84, 110), (190, 180, 160), (56, 66, 90)),
            ((130, 52, 48), (220, 190, 160), (104, 42, 40)), ((196, 168, 130), (110, 76, 50), (176, 146, 108)),
            ((92, 100, 74), (206, 186, 140), (76, 84, 62)),
        )),
    ),
    Family(
        "shoe",
        0.10,
        lambda g: Shoe(beside(g, 0.092, 0.107, (0.0995, 0.1055)), g.uniform(0.041, 0.047), g.uniform(0.059, 0.065), g.uniform(0.011, 0.017),
            pick(g, ("laces", "laces", "straps", "slip")), pick(g, ("bars", "wave", "patch", "none")), pick(g, ("plain", "cap", "bumper"))),
        (
            (Shoe(), Texture(DUSK, INKY, CHALK, "sleek", "full", 4)),
            (Shoe(0.102, 0.045, 0.062, 0.0125, "laces", "bars", "cap"), Texture(DUSK, INKY, CHALK, "cord", "full", 4)),
            (Shoe(0.105, 0.043, 0.060, 0.0160, "straps", "patch", "plain"), Texture(DUSK, INKY, CHALK, "checks", "full", 7)),
            (Shoe(0.101, 0.044, 0.061, 0.0135, "laces", "patch", "bumper"), Texture(DUSK, BRICK, CHALK, "dots", "full", 7)),
            (Shoe(0.103, 0.045, 0.060, 0.0150, "laces", "bars", "bumper"), Texture(CORAL, INKY, CHALK, "chevron", "full", 5)),
            (Shoe(0.100, 0.044, 0.060, 0.0120, "slip", "none", "cap"), Texture(OLIVE, WINE, CHALK, "plaid", "full", 5)),
        ),
        paint=dressed((
            ((110, 120, 130), (52, 52, 56), (236, 234, 230)), ((60, 64, 74), (226, 224, 220), (206, 204, 200)),
            ((226, 224, 220), (80, 100, 130), (240, 238, 234)), ((170, 70, 62), (40, 40, 44), (230, 226, 216)),
            ((104, 84, 66), (60, 46, 38), (190, 160, 116)), ((88, 128, 110), (44, 54, 52), (228, 228, 218)),
        )),
    ),
    Family(
        "slipper",
        0.08,
        lambda g: Slipper(beside(g, 0.094, 0.109, (0.1015, 0.1075)), g.uniform(0.043, 0.049), g.uniform(0.0605, 0.065), g.uniform(0.007, 0.012),
            pick(g, ("mule", "mule", "bootie")), pick(g, ("none", "none", "bow", "pompom", "ears", "band")), pick(g, ("light", "accent", "ink"))),
        (
            (Slipper(), Texture(HONEY, CHESTNUT, WOOL, "quilt", "full", 6)),
            (Slipper(0.104, 0.047, 0.061, 0.0080, "mule", "band", "accent"), Texture(HONEY, CHESTNUT, WOOL, "cord", "full", 4)),
            (Slipper(0.103, 0.046, 0.062, 0.0100, "bootie", "bow", "accent"), Texture(HONEY, CHESTNUT, WOOL, "dots", "full", 6)),
            (Slipper(0.105, 0.047, 0.060, 0.0090, "mule", "pompom", "light"), Texture(HONEY, MIDNIGHT, WOOL, "hoops", "full", 9)),
            (Slipper(0.107, 0.046, 0.060, 0.0110, "bootie", "none", "ink"), Texture(PETAL, CHESTNUT, WOOL, "plaid", "full", 5)),
            (Slipper(0.102, 0.047, 0.060, 0.0090, "mule", "ears", "light"), Texture(MIST, IRON, WOOL, "sleek", "full", 4)),
        ),
        paint=dressed((
            ((206, 190, 166), (140, 104, 76), (232, 220, 200)), ((130, 130, 136), (70, 70, 76), (226, 222, 216)),
            ((150, 104, 72), (90, 62, 46), (226, 206, 176)), ((204, 164, 170), (150, 96, 110), (244, 230, 226)),
            ((96, 112, 140), (56, 64, 84), (214, 214, 208)), ((150, 160, 132), (94, 102, 80), (232, 228, 210)),
        )),
    ),
    Family(
        "pouch",
        0.07,
        lambda g: Pouch(beside(g, 0.0312, 0.0334, (0.0314, 0.0326)), g.uniform(0.035, 0.043), g.uniform(0.009, 0.013),
            pick(g, ("top", "front", "none")), pick(g, ("ring", "tab", "drop")), pick(g, ("loop", "handle", "none")),
            pick(g, ("none", "button", "bar"))),
        (
            (Pouch(), Texture(LINEN, CAMEL, IVORY, "ribs", "full", 5)),
            (Pouch(0.0322, 0.038, 0.010, "top", "tab", "loop", "button"), Texture(LINEN, CAMEL, IVORY, "quilt", "full", 6)),
            (Pouch(0.0318, 0.041, 0.012, "front", "drop", "handle"), Texture(LINEN, CAMEL, IVORY, "dots", "full", 7)),
            (Pouch(0.0320, 0.039, 0.012, "top", "drop", "none", "bar"), Texture(LINEN, RASPBERRY, IVORY, "hoops", "full", 7)),
            (Pouch(0.0316, 0.041, 0.010, "front", "tab", "loop"), Texture(FERN, CAMEL, IVORY, "cord", "full", 5)),
            (Pouch(0.0324, 0.037, 0.011, "none", "ring", "handle", "button"), Texture(LAGOON, DEEP, IVORY, "stripes", "full", 7)),
        ),
        paint=dressed((
            ((210, 192, 160), (140, 110, 76), (236, 224, 200)), ((150, 150, 154), (84, 86, 92), (226, 224, 220)),
            ((120, 84, 60), (206, 170, 124), (232, 212, 180)), ((196, 140, 146), (132, 76, 92), (240, 222, 220)),
            ((90, 108, 140), (48, 58, 84), (220, 216, 204)), ((122, 140, 104), (72, 86, 62), (226, 222, 196)),
        )),
    ),
)  # fmt: skip
