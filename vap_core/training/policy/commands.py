"""Commands for filmed frames, and the colours that fit them: one demonstration teaches many.

*Tinted*: the target carries a tint, as VAP's policy will see it, and is called by the colour.
*Painted*: it has the colour by nature. *Described*: nothing is coloured, and the command describes
the target's own look, where that differs from its rivals'. *Plain*: the command does not say which
object is meant; only frames in which the hand is nearer to the target than to any rival, so that a
plain command means what the hand already nears. Rivals are often painted.
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
from vap_core.training.words import (
    DETERMINERS,
    PAINTS,
    appearance_words,
    distinct_colours,
    phrases,
    similar_colours,
)

TINTED = 0.5
"""Share of tinted commands; what cannot be plain or described is tinted, too."""
PAINTED = 0.15
"""Share of painted commands."""
DESCRIBED = 0.1
"""Share of described commands; the rest is plain where it can be."""
AFTERWARDS = 0.15
"""How often the word for the target comes in a sentence of its own, as a description does."""
ALPHA = (0.3, 0.7)
"""Range of the opacity of a tint."""
COAT = (0.7, 0.95)
"""Range of the opacity of paint."""
OTHERS = 0.3
"""How often a rival is painted."""
LOST = 0.12
"""How often a view's tint is missing (a tracker that lost its target); one view keeps it."""
NEAR_M = 0.02
"""A hand that is nearer to its target than to any rival by this much gives its choice away."""


Way = Literal["tinted", "painted", "described", "plain"]
Images = UInt8[np.ndarray, "c s s 3"]
"""The views of one frame."""


@value
class Command:
    """One training sample: views and words, and how the two name the target, which is object 0."""

    images: Images
    text: str
    way: Way


def command(film: Film, t: int, suite_name: str, rng: np.random.Generator) -> Command:
    """Step t of a film, which has a picture, with a command that its action answers."""
    task = suite(suite_name).task(film.task)
    rivals = [i for i in range(1, len(film.names)) if i != film.goal]
    picture = t // every(suite_name)
    images = film.images[picture]
    ids = film.ids[picture]
    drawn = rng.random()
    may_paint = 1 - TINTED - PAINTED < drawn < 1 - TINTED
    colour = _draw_colour(film, rivals, PAINTS if may_paint else PALETTE, rng)
    images = _paint_rivals(images=images, ids=ids, rivals=rivals, target_colour=colour, rng=rng)
    phrase = ""
    if drawn < DESCRIBED:
        names = [film.names[i] for i in (0, *rivals)]
        phrase = draw_description(names, rng)
    way: Way = "tinted"
    word = colour.name
    if phrase:
        way = "described"
        word = phrase
        images = film.images[picture]
    elif DESCRIBED < drawn < 1 - TINTED - PAINTED and near(film, t, suite_name, rivals):
        way = "plain"
        word = ""
    elif may_paint:
        way = "painted"
        coat = float(rng.uniform(*COAT))
        images = painted(images, ids == 1, colour, coat)
    else:
        images = _tint_target(images, ids == 1, colour, rng)
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    lit = np.clip(images * gain, 0, 255).astype(np.uint8)
    return Command(images=lit, text=phrase_instruction(task, word, rng), way=way)


def near(film: Film, t: int, suite_name: str, rivals: Sequence[int]) -> bool:
    """Whether the hand is nearer to the target than to every rival, seen from above."""
    robot = robots.get(suite(suite_name).robot)
    hand = film.state[t, :2] + robot.base_world[:2]
    distances = np.linalg.norm(film.places[t, :, :2] - hand, axis=1)
    return bool((distances[0] + NEAR_M < distances[list(rivals)]).all())


def draw_description(names: Sequence[str], rng: np.random.Generator) -> str:
    """A word, or a captioner's phrase, that fits names[0] and no other; "" when there is none."""
    rivals = map(appearance_words, names[1:])
    words = sorted(appearance_words(names[0]).difference(*rivals))
    if not words:
        return ""
    if rng.random() < 0.5:
        return str(rng.choice(phrases(names[0])))
    return str(rng.choice(words))


def phrase_instruction(task: Task, word: str, rng: np.random.Generator) -> str:
    """The task's instruction with its "my" replaced: by "the" and a word, or by any determiner.

    A phrase, and now and then a word, comes afterwards, as a description does.
    """
    if " " in word or (word and rng.random() < AFTERWARDS):
        return f"{task.instruction}. My {task.category} is {word}."
    if word:
        determiner = f"the {word} "
    else:
        determiner = f"{rng.choice(DETERMINERS)} "
    return task.instruction.replace("my ", determiner, 1)


def tinted(images: Images, masks: np.ndarray, colour: Colour, alpha: float) -> Images:
    """As prompt.tint does it."""
    rgb = np.asarray(colour.rgb, np.float32)
    return _blend(images, masks, np.broadcast_to(rgb, images.shape), alpha)


def painted(images: Images, masks: np.ndarray, colour: Colour, coat: float) -> Images:
    """Coloured by nature: light and shade of the object stay."""
    light = images.astype(np.float32).mean(axis=-1, keepdims=True) / 255.0
    rgb = np.asarray(colour.rgb, np.float32)
    paint = rgb * (0.25 + 0.75 * light) + 40.0 * light
    return _blend(images, masks, paint, coat)


def roughen_mask(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A mask as a tracker draws it: now and then a little off, swollen or shrunk."""
    import cv2

    kind = rng.random()
    if kind < 0.5 or not mask.any():
        return mask
    if kind < 0.7:
        return np.roll(mask, rng.integers(-2, 3, 2), axis=(0, 1))
    change = cv2.dilate if kind < 0.85 else cv2.erode
    return change(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _draw_colour(
    film: Film, rivals: Sequence[int], colours: Sequence[Colour], rng: np.random.Generator
) -> Colour:
    """A colour for the target that nobody takes for the look of a rival."""
    taken: set[str] = set()
    for i in rivals:
        taken |= appearance_words(film.names[i])
    usable = distinct_colours(taken, colours)
    return usable[int(rng.integers(len(usable)))]


def _paint_rivals(
    images: Images,
    ids: UInt8[np.ndarray, "c s s"],
    rivals: Sequence[int],
    target_colour: Colour,
    rng: np.random.Generator,
) -> Images:
    """Paint some rivals in colours that nobody takes for the target's."""
    colours = [
        paint
        for paint in PAINTS
        if not similar_colours(paint.name) & similar_colours(target_colour.name)
    ]
    order = rng.permutation(len(colours))
    for rival, i in zip(rivals, order, strict=False):
        if rng.random() < OTHERS:
            coat = float(rng.uniform(*COAT))
            images = painted(images, ids == rival + 1, colours[i], coat)
    return images


def _tint_target(
    images: Images, masks: np.ndarray, colour: Colour, rng: np.random.Generator
) -> Images:
    """Tint the target by masks as a tracker draws them, at least in one view."""
    kept = rng.random(len(images)) > LOST
    kept[rng.integers(len(images))] = True
    tracked = []
    for mask, keep in zip(masks, kept, strict=True):
        tracked.append(roughen_mask(mask, rng) & bool(keep))
    return tinted(images, np.stack(tracked), colour, float(rng.uniform(*ALPHA)))


def _blend(
    images: Images, masks: np.ndarray, paint: Float32[np.ndarray, "c s s 3"], share: float
) -> Images:
    """Mix paint into the masked pixels."""
    mixed = images.astype(np.float32)
    mixed[masks] = (1 - share) * mixed[masks] + share * paint[masks]
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
