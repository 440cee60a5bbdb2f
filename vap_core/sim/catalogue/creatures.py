"""Cat figurines, plushies and stuffed toys."""

from vap_core.sim.bodies.animals import Cat, Plushie
from vap_core.sim.bodies.softtoys import StuffedToy
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.catalogue.generics import beside, dressed
from vap_core.sim.textures import Texture

SOOT, ASH, AMBER, JADE, SNOW, GINGER, FLAX = (
    (43, 42, 46),
    (152, 142, 148),
    (214, 160, 60),
    (126, 168, 92),
    (236, 232, 224),
    (206, 128, 62),
    (240, 220, 186),
)
BARK, BLUSH, OAT, MILK, PEBBLE, STORM = (122, 88, 66), (214, 160, 150), (226, 196, 168), (238, 226, 202), (150, 146, 148), (108, 136, 158)
BISCUIT, NUT, CHERRY, DENIM, MINT, LILAC, PINE = (
    (226, 206, 172), (112, 78, 56), (196, 58, 54), (62, 84, 124), (172, 188, 162), (180, 162, 194), (58, 112, 108),
)  # fmt: skip

FAMILIES: tuple[Family, ...] = (
    Family(
        "cat figurine",
        0.10,
        lambda g: Cat(beside(g, 0.069, 0.088, (0.0725, 0.0805)), g.uniform(0.0170, 0.0205), pick(g, ("round", "pointed", "pointed", "folded")),
            pick(g, ("curl", "up", "wrap")), pick(g, ("plain", "muzzle", "mask")), bool(g.random() < 0.4)),
        (
            (Cat(), Texture(SOOT, ASH, AMBER, "sleek", "full", 4)),
            (Cat(0.074, 0.0190, "pointed", "up", "muzzle"), Texture(SOOT, ASH, AMBER, "tabby", "full", 6)),
            (Cat(0.078, 0.0180, "folded", "curl", "plain", True), Texture(SOOT, ASH, JADE, "heart", "brick", 6)),
            (Cat(0.075, 0.0190, "pointed", "wrap", "mask"), Texture(SOOT, SNOW, AMBER, "patches", "full", 4, seed=3)),
            (Cat(0.080, 0.0185, "round", "up", "muzzle", True), Texture(SNOW, ASH, AMBER, "dots", "full", 6)),
            (Cat(0.073, 0.0195, "pointed", "curl", "mask"), Texture(GINGER, FLAX, AMBER, "stripes", "full", 6)),
        ),
        paint=dressed((
            ((58, 56, 60), (176, 166, 160), (192, 170, 66)), ((150, 148, 152), (84, 82, 88), (120, 160, 110)),
            ((196, 118, 66), (240, 214, 176), (110, 150, 80)), ((226, 214, 194), (146, 108, 80), (96, 140, 170)),
            ((110, 80, 62), (206, 172, 136), (200, 160, 70)), ((240, 236, 230), (90, 86, 88), (90, 140, 180)),
        )),
    ),
    Family(
        "plushie",
        0.08,
        lambda g: Plushie(beside(g, 0.068, 0.090, (0.0735, 0.0835)), g.uniform(0.056, 0.066), g.uniform(0.0610, 0.066),
            pick(g, ("spines", "tufts", "mane", "smooth", "smooth")), pick(g, ("round", "long", "none")), g.uniform(0.014, 0.022)),
        (
            (Plushie(), Texture(BARK, BLUSH, OAT, "fuzz", "full", 4)),
            (Plushie(0.076, 0.064, 0.060, "tufts", "round", 0.016), Texture(BARK, BLUSH, OAT, "patches", "full", 6)),
            (Plushie(0.080, 0.060, 0.060, "mane", "none", 0.020), Texture(BARK, BLUSH, OAT, "hoops", "full", 8)),
            (Plushie(0.075, 0.062, 0.062, "smooth", "round", 0.015), Texture(BARK, MILK, OAT, "cord", "full", 4)),
            (Plushie(0.082, 0.060, 0.058, "spines", "long", 0.018), Texture(PEBBLE, BLUSH, OAT, "dots", "full", 7)),
            (Plushie(0.077, 0.064, 0.062, "smooth", "long", 0.014), Texture(STORM, MILK, OAT, "star", "brick", 6)),
        ),
        paint=dressed((
            ((138, 104, 76), (226, 200, 168), (236, 214, 190)), ((170, 166, 164), (226, 206, 206), (236, 222, 216)),
            ((218, 186, 140), (244, 226, 196), (238, 208, 176)), ((196, 156, 176), (240, 216, 222), (244, 226, 214)),
            ((96, 116, 140), (206, 216, 226), (226, 214, 200)), ((92, 70, 58), (196, 150, 120), (216, 180, 150)),
        )),
    ),
    Family(
        "stuffed toy",
        0.07,
        lambda g: StuffedToy(g.uniform(0.0205, 0.0232), beside(g, 0.060, 0.074, (0.0635, 0.0695)),
            pick(g, ("brim", "beanie", "cap", "ears", "crest")), pick(g, ("arcs", "dots", "crosses")), pick(g, ("ball", "bar", "wide")),
            pick(g, ("stubs", "feet", "none"))),
        (
            (StuffedToy(), Texture(BISCUIT, NUT, CHERRY, "sleek", "full", 4)),
            (StuffedToy(0.0220, 0.068, "beanie", "dots", "wide"), Texture(BISCUIT, NUT, CHERRY, "dots", "full", 7)),
            (StuffedToy(0.0215, 0.065, "cap", "crosses", "bar", "feet"), Texture(BISCUIT, NUT, CHERRY, "hoops", "full", 9)),
            (StuffedToy(0.0220, 0.067, "brim", "dots", "wide", "feet"), Texture(BISCUIT, DENIM, CHERRY, "cord", "full", 4)),
            (StuffedToy(0.0225, 0.064, "ears", "dots", "ball", "stubs"), Texture(MINT, NUT, CHERRY, "heart", "brick", 7)),
            (StuffedToy(0.0215, 0.069, "crest", "arcs", "bar", "none"), Texture(LILAC, PINE, CHERRY, "star", "brick", 6)),
        ),
        paint=dressed((
            ((236, 220, 192), (96, 116, 150), (206, 110, 100)), ((206, 170, 128), (120, 84, 62), (150, 60, 60)),
            ((170, 190, 200), (70, 84, 104), (214, 150, 90)), ((226, 190, 196), (150, 90, 110), (190, 70, 90)),
            ((190, 204, 168), (90, 110, 76), (206, 130, 80)), ((240, 236, 226), (60, 60, 66), (200, 120, 60)),
        )),
    ),
)  # fmt: skip
