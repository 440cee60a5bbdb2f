"""The first families: vessels, owls and gadgets that stand upright between two fingers."""

import numpy as np

from vap_core.sim.bodies.gadgets import CameraBody, Can, Shaver
from vap_core.sim.bodies.vessels import Bottle, Cup, Owl, PenHolder, StrawCup, Vase
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.textures import Texture

CREAM, BONE, SAND, RUST = (233, 223, 201), (219, 214, 206), (201, 176, 139), (140, 79, 62)
SAGE, MOSS, TEAL, SLATE, NAVY = (157, 171, 146), (91, 106, 77), (71, 115, 117), (98, 112, 127), (51, 63, 86)
PLUM, ROSE, MUSTARD, COCOA, COAL = (102, 73, 93), (198, 151, 149), (198, 158, 83), (87, 66, 55), (57, 57, 61)
URN = ((0.0165, 0.0), (0.0185, 0.2), (0.0212, 0.55), (0.0195, 0.72), (0.011, 0.9), (0.0145, 1.0))
GOURD = ((0.0185, 0.0), (0.0212, 0.25), (0.0185, 0.55), (0.0172, 0.75), (0.0115, 0.9), (0.0155, 1.0))
AMPHORA = ((0.0150, 0.0), (0.0190, 0.35), (0.0215, 0.62), (0.0185, 0.76), (0.0085, 0.88), (0.0125, 1.0))
CARAFE = ((0.0190, 0.0), (0.0208, 0.15), (0.0200, 0.45), (0.0178, 0.70), (0.0120, 0.88), (0.0160, 1.0))
COKE = Texture((168, 38, 42), (240, 236, 232), (168, 38, 42), "word", "band", 2, "COLA")
FLUTE = ((0.0165, 0.0), (0.0172, 0.3), (0.0182, 0.6), (0.0195, 0.85), (0.0215, 1.0))


def _vase(rng: np.random.Generator) -> Vase:
    low, mid, neck, lip = rng.uniform((0.0150, 0.0190, 0.0080, 0.0110), (0.0185, 0.0220, 0.0150, 0.0185)).tolist()
    waist = float(rng.uniform(0.35, 0.6))
    return Vase(float(rng.uniform(0.098, 0.118)), ((low, 0.0), (mid, waist), (0.92 * mid, 0.74), (neck, 0.89), (lip, 1.0)),
                bool(rng.random() < 0.25))  # fmt: skip


FAMILIES: tuple[Family, ...] = (
    Family(
        "cup",
        0.10,
        lambda g: Cup(g.uniform(0.0175, 0.0210), g.uniform(0.0195, 0.0220), g.uniform(0.065, 0.080), pick(g, ("round", "square", "ear")),
            g.uniform(0.014, 0.020), pick(g, ("base", "ink", "accent"))),
        (
            (Cup(), Texture(CREAM, RUST, TEAL, "heart", "row", 4)),
            (Cup(0.0205, 0.0205, 0.070, "square", 0.016), Texture(CREAM, TEAL, RUST, "hoops", "full", 8)),
            (Cup(0.0185, 0.0215, 0.074, "ear", 0.018, "accent"), Texture(CREAM, CREAM, TEAL, "word", "band", 3, "MUG")),
            (Cup(0.0200, 0.0210, 0.068, "round", 0.015, "ink"), Texture(CREAM, RUST, TEAL, "dots", "full", 7)),
            (Cup(0.0195, 0.0215, 0.076, "ear", 0.016), Texture(CREAM, RUST, TEAL, "leaf", "brick", 6)),
            (Cup(0.0190, 0.0210, 0.073, "round", 0.016), Texture(CREAM, NAVY, TEAL, "stripes", "full", 8)),
            (Cup(0.0200, 0.0215, 0.069, "round", 0.018), Texture(NAVY, MUSTARD, CREAM, "star", "brick", 5)),
        ),
    ),
    Family(
        "bottle",
        0.12,
        lambda g: Bottle(g.uniform(0.0185, 0.0215), g.uniform(0.105, 0.120), g.uniform(0.65, 0.75), g.uniform(0.0075, 0.012),
            pick(g, ("screw", "sport", "ball")), g.uniform(0, 0.003)),
        (
            (Bottle(), Texture(SLATE, CREAM, MUSTARD, "star", "band", 4)),
            (Bottle(0.0205, 0.112, 0.72, 0.010, "sport"), Texture(SLATE, CREAM, MUSTARD, "stripes", "full", 7)),
            (Bottle(0.0195, 0.118, 0.66, 0.0085, "ball"), Texture(SLATE, CREAM, MUSTARD, "fish", "brick", 4)),
            (Bottle(0.0205, 0.114, 0.70, 0.009, "screw", 0.002), Texture(SLATE, CREAM, MUSTARD, "chevron", "half", 6)),
            (Bottle(0.0200, 0.110, 0.74, 0.011, "sport"), Texture(SLATE, CREAM, MUSTARD, "word", "row", 3, "H2O")),
            (Bottle(0.0195, 0.113, 0.70, 0.0095, "screw"), Texture(RUST, CREAM, SLATE, "dots", "full", 8)),
            (Bottle(0.0205, 0.117, 0.68, 0.0105, "ball"), Texture(PLUM, SAND, MUSTARD, "heart", "brick", 5)),
        ),
    ),
    Family(
        "pen holder",
        0.10,
        lambda g: PenHolder(g.uniform(0.0190, 0.0215), g.uniform(0.074, 0.084), pick(g, (4, 6, 24, 24)), int(g.integers(3, 6)),
            pick(g, ("base", "ink", "accent"))),
        (
            (PenHolder(), Texture(SAGE, COCOA, CREAM, "paw", "row", 4)),
            (PenHolder(0.0205, 0.082, 6, 3, "ink"), Texture(SAGE, COCOA, CREAM, "checks", "full", 6)),
            (PenHolder(0.0200, 0.078, 4, 4, "base"), Texture(SAGE, COCOA, CREAM, "smile", "band", 4)),
            (PenHolder(0.0210, 0.080, 24, 5, "ink"), Texture(SAGE, CREAM, COCOA, "bolt", "brick", 6)),
            (PenHolder(0.0205, 0.076, 24, 3, "accent"), Texture(SAGE, COCOA, CREAM, "stripes", "half", 8)),
            (PenHolder(0.0205, 0.081, 6, 4, "accent"), Texture(MUSTARD, COCOA, CREAM, "dots", "full", 8)),
            (PenHolder(0.0200, 0.079, 24, 5, "base"), Texture(RUST, NAVY, CREAM, "chevron", "full", 6)),
        ),
    ),
    Family(
        "straw cup",
        0.09,
        lambda g: StrawCup(g.uniform(0.0155, 0.0180), g.uniform(0.0200, 0.0218), g.uniform(0.074, 0.084), pick(g, ("flat", "dome", "step")),
            bool(g.random() < 0.5)),
        (
            (StrawCup(), Texture(ROSE, PLUM, CREAM, "moon", "brick", 4)),
            (StrawCup(0.0170, 0.0215, 0.078, "dome", False), Texture(ROSE, PLUM, CREAM, "plaid", "full", 5)),
            (StrawCup(0.0175, 0.0210, 0.082, "step", True), Texture(ROSE, PLUM, CREAM, "flower", "band", 4)),
            (StrawCup(0.0165, 0.0210, 0.080, "flat", False), Texture(ROSE, PLUM, CREAM, "hoops", "half", 10)),
            (StrawCup(0.0170, 0.0215, 0.076, "dome", True), Texture(ROSE, PLUM, CREAM, "word", "row", 3, "YUM")),
            (StrawCup(0.0168, 0.0212, 0.079, "step", False), Texture(CREAM, PLUM, ROSE, "stripes", "full", 9)),
            (StrawCup(0.0172, 0.0215, 0.077, "dome", False), Texture(TEAL, MUSTARD, CREAM, "dots", "full", 8)),
        ),
    ),
    Family(
        "owl figurine",
        0.11,
        lambda g: Owl(g.uniform(0.070, 0.084), g.uniform(0.0200, 0.0218), pick(g, ("tuft", "wide", "none")), g.uniform(0.006, 0.0085),
            pick(g, ("folded", "spread"))),
        (
            (Owl(), Texture(SAND, COCOA, CREAM, "heart", "brick", 8)),
            (Owl(0.076, 0.0215, "wide", 0.0080), Texture(SAND, COCOA, CREAM, "hoops", "full", 8)),
            (Owl(0.074, 0.0210, "none", 0.0068), Texture(SAND, COCOA, CREAM, "dots", "full", 9)),
            (Owl(0.080, 0.0210, "tuft", 0.0062, "spread"), Texture(SAND, MOSS, CREAM, "chevron", "full", 8)),
            (Owl(0.078, 0.0215, "wide", 0.0070, "spread"), Texture(SAND, COCOA, MUSTARD, "star", "band", 6)),
            (Owl(0.077, 0.0210, "tuft", 0.0076), Texture(SAGE, COCOA, CREAM, "stripes", "full", 10)),
            (Owl(0.073, 0.0215, "none", 0.0082, "spread"), Texture(BONE, TEAL, CREAM, "leaf", "brick", 8)),
        ),
    ),
    Family(
        "vase",
        0.12,
        _vase,
        (
            (Vase(), Texture(BONE, NAVY, SLATE, "leaf", "brick", 5)),
            (Vase(0.112, URN), Texture(BONE, NAVY, SLATE, "chevron", "full", 6)),
            (Vase(0.108, GOURD), Texture(BONE, NAVY, SLATE, "flower", "row", 4)),
            (Vase(0.114, AMPHORA, True), Texture(BONE, NAVY, SLATE, "hoops", "full", 10)),
            (Vase(0.106, FLUTE), Texture(BONE, BONE, NAVY, "fish", "band", 4)),
            (Vase(0.110, CARAFE), Texture(ROSE, NAVY, SLATE, "dots", "full", 8)),
            (Vase(0.112, URN, True), Texture(MOSS, MUSTARD, BONE, "stripes", "full", 9)),
        ),
    ),
    Family(
        "camera",
        0.14,
        lambda g: CameraBody(g.uniform(0.060, 0.074), g.uniform(0.050, 0.058), g.uniform(0.013, 0.018),
            pick(g, ("prism", "finder", "flash", "none")), bool(g.random() < 0.3)),
        (
            (CameraBody(), Texture(COAL, SAND, BONE, "dots", "full", 6)),
            (CameraBody(0.072, 0.052, 0.0150, "finder"), Texture(COAL, SAND, BONE, "stripes", "full", 5)),
            (CameraBody(0.064, 0.056, 0.0175, "flash"), Texture(COAL, BONE, SAND, "star", "brick", 5)),
            (CameraBody(0.070, 0.054, 0.0140, "none", True), Texture(COAL, SAND, BONE, "checks", "full", 5)),
            (CameraBody(0.066, 0.053, 0.0165, "prism", True), Texture(COAL, SAND, BONE, "chevron", "half", 5)),
            (CameraBody(0.067, 0.055, 0.0155, "flash", True), Texture(COAL, RUST, BONE, "hoops", "full", 7)),
            (CameraBody(0.073, 0.056, 0.0140, "none"), Texture(MUSTARD, TEAL, COAL, "flower", "brick", 6)),
        ),
    ),
    Family(
        "shaver",
        0.11,
        lambda g: Shaver(g.uniform(0.0175, 0.0195), g.uniform(0.106, 0.118), pick(g, ("foil", "wide", "rotary")), g.uniform(0, 0.0035),
            pick(g, ("round", "bar"))),
        (
            (Shaver(), Texture(TEAL, CREAM, COAL, "bolt", "brick", 4)),
            (Shaver(0.0190, 0.110, "rotary", 0.002, "bar"), Texture(TEAL, CREAM, COAL, "hoops", "half", 10)),
            (Shaver(0.0180, 0.116, "wide", 0.001), Texture(TEAL, CREAM, COAL, "stripes", "full", 6)),
            (Shaver(0.0190, 0.108, "foil", 0.002, "bar"), Texture(TEAL, CREAM, COAL, "checks", "full", 5)),
            (Shaver(0.0185, 0.114, "rotary", 0.0015), Texture(TEAL, CREAM, MUSTARD, "word", "band", 2, "TRIM")),
            (Shaver(0.0180, 0.112, "wide", 0.0025, "bar"), Texture(RUST, CREAM, COAL, "dots", "full", 8)),
            (Shaver(0.0190, 0.110, "rotary", 0.001, "bar"), Texture(MUSTARD, RUST, COAL, "chevron", "full", 6)),
        ),
    ),
    Family(
        "coke can",
        0.10,
        lambda g: Can(g.uniform(0.0205, 0.0220), g.uniform(0.078, 0.090)),
        prop=((Can(), COKE),),
        paint=lambda _, i: Texture((150, 52, 52), (232, 228, 222), (150, 52, 52), "waves", "middle", 1 + i % 3),
    ),
)  # fmt: skip
