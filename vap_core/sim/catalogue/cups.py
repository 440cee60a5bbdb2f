"""A second kind of cup: disposable ones of paper."""

import numpy as np

from vap_core.sim.bodies.kitchen import PaperCup
from vap_core.sim.catalogue.family import Family, pick
from vap_core.sim.textures import Ink, Texture

ESPRESSO, KRAFT, MILK, PINE, TOMATO, INDIGO = (74, 48, 36), (192, 150, 104), (236, 230, 220), (54, 98, 80), (196, 70, 52), (66, 74, 124)
PAPERS: tuple[Ink, ...] = ((228, 224, 216), (204, 172, 130), (62, 64, 68), (190, 206, 196), (222, 190, 180), (178, 194, 214))


def _papery(drawn: Texture, index: int) -> Texture:
    return Texture(PAPERS[index % 6], drawn.ink, drawn.accent, drawn.motif, drawn.layout, drawn.repeats, drawn.word, drawn.seed)


def _paper_cup(rng: np.random.Generator) -> PaperCup:
    low, high, height, a, b = rng.uniform((0.0165, 0.0205, 0.070, 0.15, 0.62), (0.0182, 0.0220, 0.082, 0.30, 0.80)).tolist()
    return PaperCup(low, high, height, (a, b), pick(rng, ("base", "ink", "accent", "light")), bool(rng.random() < 0.3))


FAMILIES: tuple[Family, ...] = (
    Family(
        "cup",
        0.07,
        _paper_cup,
        (
            (PaperCup(), Texture(ESPRESSO, KRAFT, MILK, "hoops", "full", 8)),
            (PaperCup(0.0182, 0.0215, 0.078, (0.20, 0.72), "ink"), Texture(ESPRESSO, KRAFT, MILK, "chevron", "full", 9)),
            (PaperCup(0.0178, 0.0212, 0.074, (0.24, 0.74), "light"), Texture(ESPRESSO, KRAFT, MILK, "word", "row", 3, "CAFE")),
            (PaperCup(0.0180, 0.0215, 0.075, (0.22, 0.66), "base"), Texture(ESPRESSO, PINE, MILK, "stripes", "full", 12)),
            (PaperCup(0.0176, 0.0214, 0.077, (0.12, 0.86), "accent"), Texture(MILK, KRAFT, ESPRESSO, "dots", "full", 8)),
            (PaperCup(0.0178, 0.0213, 0.073, (0.26, 0.74), "accent", True), Texture(INDIGO, MILK, ESPRESSO, "star", "brick", 5)),
            (PaperCup(0.0180, 0.0215, 0.076, (0.10, 0.88), "ink"), Texture(MILK, TOMATO, ESPRESSO, "heart", "brick", 6)),
        ),
        paint=_papery,
        slug="paper-cup",
    ),
)  # fmt: skip
