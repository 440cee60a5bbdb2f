"""What is said beside a filmed frame, and how it is coloured to fit: one demonstration teaches many commands.

*Tinted*: the target carries a tint, as VAP's policy will see it, and is called by the colour. *Painted*: it has the colour by nature.
*Described*: nothing is coloured, and what it looks like is said, where that tells it from its rivals. *Plain*: nothing tells it; only frames in
which the hand is nearer to the target than to any rival, so that a plain command means what the hand already nears. Rivals are often painted.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from vap_core.base.types import Colour, value
from vap_core.prompt import PALETTE
from vap_core.simulation import robots
from vap_core.simulation.suites import Task, suite
from vap_core.training.films.demonstrations import Film, every
from vap_core.training.words import DETERMINERS, PAINTS, akin, free, looks, phrases

TINTED, PAINTED, DESCRIBED = 0.5, 0.15, 0.1
"""Shares of the commands; the rest is plain where it can be, and what cannot be plain or described is tinted."""
AFTERWARDS = 0.15
"""How often the word that tells the target comes in a sentence of its own, as a description does."""
ALPHA, COAT = (0.3, 0.7), (0.7, 0.95)
"""Opacity of a tint, and of paint."""
OTHERS, LOST = 0.3, 0.12
"""How often a rival is painted, and a view's tint is missing (a tracker that lost its target); one view keeps it."""
NEAR_M = 0.02
"""A hand that is nearer to its target than to any rival by this much gives its choice away."""


Way = Literal["tinted", "painted", "described", "plain"]


@value
class Command:
    """One training sample: views and words, and how the two name the target, which is object 0."""

    images: UInt8[np.ndarray, "c s s 3"]
    text: str
    way: Way


def command(film: Film, t: int, suite_name: str, rng: np.random.Generator) -> Command:
    """Step t of a film, which has a picture, with something said that its action answers."""
    task = suite(suite_name).task(film.task)
    rivals = [i for i in range(1, len(film.names)) if i != film.goal]
    images, ids = (part[t // every(suite_name)] for part in (film.images, film.ids))
    drawn = rng.random()
    natural = 1 - TINTED - PAINTED < drawn < 1 - TINTED
    usable = free(
        {word for i in rivals for word in looks(film.names[i])}, PAINTS if natural else PALETTE
    )
    mine = usable[int(rng.integers(len(usable)))]
    others = [colour for colour in PAINTS if not akin(colour.name) & akin(mine.name)]
    others = [others[i] for i in rng.permutation(len(others))]
    for rival, colour in zip(rivals, others, strict=False):
        if rng.random() < OTHERS:
            images = painted(images, ids == rival + 1, colour, float(rng.uniform(*COAT)))
    word = mine.name
    way: Way = "tinted"
    if drawn < DESCRIBED and (told := telling([film.names[i] for i in (0, *rivals)], rng)):
        images, way, word = film.images[t // every(suite_name)], "described", told
    elif DESCRIBED < drawn < 1 - TINTED - PAINTED and near(film, t, suite_name, rivals):
        way, word = "plain", ""
    elif natural:
        images, way = painted(images, ids == 1, mine, float(rng.uniform(*COAT))), "painted"
    if way == "tinted":
        seen = rng.random(len(images)) > LOST
        seen[rng.integers(len(images))] = True
        masks = np.stack([rough(ids[c] == 1, rng) & bool(seen[c]) for c in range(len(images))])
        images = tinted(images, masks, mine, float(rng.uniform(*ALPHA)))
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    return Command(np.clip(images * gain, 0, 255).astype(np.uint8), say(task, word, rng), way)


def near(film: Film, t: int, suite_name: str, rivals: Sequence[int]) -> bool:
    """Whether the hand is nearer to the target than to every rival, seen from above."""
    hand = film.state[t, :2] + robots.get(suite(suite_name).robot).base_world[:2]
    away = np.linalg.norm(film.places[t, :, :2] - hand, axis=1)
    return bool(all(away[0] + NEAR_M < away[i] for i in rivals))


def telling(names: Sequence[str], rng: np.random.Generator) -> str:
    """A word, or a captioner's phrase, that fits names[0] and none of the others; "" when there is none."""
    mine, *others = (looks(name) for name in names)
    words = sorted(mine.difference(*others))
    if not words:
        return ""
    return str(rng.choice(phrases(names[0]))) if rng.random() < 0.5 else str(rng.choice(words))


def say(task: Task, word: str, rng: np.random.Generator) -> str:
    """The task's instruction with its "my" replaced: by "the" and a word, or by any determiner; a phrase, and now and then a word, comes
    afterwards, as a description does."""
    if " " in word or (word and rng.random() < AFTERWARDS):
        return f"{task.instruction}. My {task.category} is {word}."
    return task.instruction.replace(
        "my ", f"the {word} " if word else f"{rng.choice(DETERMINERS)} ", 1
    )


def tinted(
    images: UInt8[np.ndarray, "c s s 3"], masks: np.ndarray, colour: Colour, alpha: float
) -> UInt8[np.ndarray, "c s s 3"]:
    """As prompt.tint does it."""
    return _blend(
        images, masks, np.broadcast_to(np.asarray(colour.rgb, np.float32), images.shape), alpha
    )


def painted(
    images: UInt8[np.ndarray, "c s s 3"], masks: np.ndarray, colour: Colour, coat: float
) -> UInt8[np.ndarray, "c s s 3"]:
    """Coloured by nature: light and shade of the object stay."""
    light = images.astype(np.float32).mean(axis=-1, keepdims=True) / 255.0
    return _blend(
        images,
        masks,
        np.asarray(colour.rgb, np.float32) * (0.25 + 0.75 * light) + 40.0 * light,
        coat,
    )


def _blend(
    images: UInt8[np.ndarray, "c s s 3"],
    masks: np.ndarray,
    paint: Float32[np.ndarray, "c s s 3"],
    share: float,
) -> np.ndarray:
    out = images.astype(np.float32)
    out[masks] = (1 - share) * out[masks] + share * paint[masks]
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def rough(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A mask as a tracker draws it: now and then a little off, swollen or shrunk."""
    import cv2

    kind = rng.random()
    if kind < 0.5 or not mask.any():
        return mask
    if kind < 0.7:
        return np.roll(mask, rng.integers(-2, 3, 2), axis=(0, 1))
    change = cv2.dilate if kind < 0.85 else cv2.erode
    return change(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
