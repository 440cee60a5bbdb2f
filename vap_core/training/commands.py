"""What is said beside a filmed frame, and how it is coloured to fit: one demonstration teaches many commands.

*Tinted*: the target carries a tint, as VAP's policy will see it, and is called by the colour. *Painted*: it has the colour by nature. *Plain*: no
colour is named; only frames in which the hand is nearer to the target than to any rival, so that a plain command means what the hand already nears.
Rivals and bystanders are often painted in other colours, in all three.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, UInt8

from vap_core.prompt import PALETTE
from vap_core.sim import robots
from vap_core.sim.objects import CATEGORIES, CLUTTER
from vap_core.suites import BENCHMARKS, suite
from vap_core.training.demonstrations import Film
from vap_core.values import Colour, value

TINTED, PAINTED = 0.5, 0.2
"""Shares of the commands; the rest is plain where it can be, else tinted."""
ALPHA, COAT = (0.3, 0.7), (0.7, 0.95)
"""Opacity of a tint, and of paint."""
OTHERS, LOST = 0.3, 0.12
"""How often a rival is painted, and a view's tint is missing (a tracker that lost its target); one view keeps it."""
DETERMINERS = ("my", "the", "a")
FIRST = ("<pad>", "<unk>", "\n")
RESERVED = tuple(f"<my_{i}>" for i in range(8))
"""Tokens that nothing is said with yet: a soft prompt learns one."""
QUESTIONS = re.findall(
    r"\w+", "where is there can you recognize in this image what colour yes no left right top bottom middle near far it point to at"
)
"""Words that a vision-language model is asked and answers with."""
PATTERNS = {"plain": "plain", "diagonal": "striped", "waves": "wavy", "speckle": "speckled", "tiles": "tiled", "gradient": "shaded"}
"""Words for motifs of generic objects; every other one is "patterned"."""
DESCRIBING = re.findall(
    r"\w+",
    "white grey black brown beige orange purple pink light dark bright pale "
    "plain striped wavy speckled tiled shaded patterned spotted checked dotted "
    "tall short wide narrow small large round square with and body top base stripes spots dots marks pattern lid handle mostly some",
)
"""Words of descriptions."""
NEAR_M = 0.02
"""A hand that is nearer to its target than to any rival by this much gives its choice away."""


@value
class Command:
    """One training sample: views (uint8), words, and the index of the object that is meant."""

    images: UInt8[np.ndarray, "c s s 3"]
    text: str
    target: int


def vocabulary() -> tuple[str, ...]:
    """Every word of the benchmarks' instructions, of colours and of questions; token i is word i."""
    said = [task.instruction for known in BENCHMARKS.values() for task in known.tasks] + [colour.name for colour in PALETTE]
    said += [*CATEGORIES, *CLUTTER]
    words = [word for text in said for word in re.findall(r"[\w']+", text.lower())]
    return (*FIRST, *dict.fromkeys([*words, *DETERMINERS, "up", *QUESTIONS, *DESCRIBING]), *RESERVED)


def command(film: Film, t: int, suite_name: str, rng: np.random.Generator) -> Command:
    """Frame t of a film with something said that its action answers."""
    instruction = suite(suite_name).task(film.task).instruction
    rivals = [i for i in range(1, len(film.names)) if i != film.goal]
    images, ids = film.images[t].copy(), film.ids[t]
    mine, *others = (PALETTE[i] for i in rng.permutation(len(PALETTE)))
    for rival, colour in zip(rivals, others, strict=False):
        if rng.random() < OTHERS:
            images = painted(images, ids == rival + 1, colour, float(rng.uniform(*COAT)))
    way = rng.random()
    if way < 1 - TINTED - PAINTED and near(film, t, suite_name, rivals):
        text = say(instruction, None, rng)
    elif way < 1 - TINTED:
        images, text = painted(images, ids == 1, mine, float(rng.uniform(*COAT))), say(instruction, mine, rng)
    else:
        seen = rng.random(len(images)) > LOST
        seen[rng.integers(len(images))] = True
        masks = np.stack([rough(ids[c] == 1, rng) & bool(seen[c]) for c in range(len(images))])
        images, text = tinted(images, masks, mine, float(rng.uniform(*ALPHA))), say(instruction, mine, rng)
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    return Command(np.clip(images * gain, 0, 255).astype(np.uint8), text, 0)


def near(film: Film, t: int, suite_name: str, rivals: Sequence[int]) -> bool:
    """Whether the hand is nearer to the target than to every rival, seen from above."""
    hand = film.state[t, :2] + robots.get(suite(suite_name).robot).base_world[:2]
    away = np.linalg.norm(film.places[t, :, :2] - hand, axis=1)
    return bool(all(away[0] + NEAR_M < away[i] for i in rivals))


def say(instruction: str, colour: Colour | None, rng: np.random.Generator) -> str:
    """The task's instruction with its "my" replaced: by a colour, or by any determiner."""
    return instruction.replace("my ", f"the {colour.name} " if colour else f"{rng.choice(DETERMINERS)} ", 1)


def tinted(images: UInt8[np.ndarray, "c s s 3"], masks: np.ndarray, colour: Colour, alpha: float) -> UInt8[np.ndarray, "c s s 3"]:
    """As prompt.tint does it."""
    return _blend(images, masks, np.broadcast_to(np.asarray(colour.rgb, np.float32), images.shape), alpha)


def painted(images: UInt8[np.ndarray, "c s s 3"], masks: np.ndarray, colour: Colour, coat: float) -> UInt8[np.ndarray, "c s s 3"]:
    """Coloured by nature: light and shade of the object stay."""
    light = images.astype(np.float32).mean(axis=-1, keepdims=True) / 255.0
    return _blend(images, masks, np.asarray(colour.rgb, np.float32) * (0.25 + 0.75 * light) + 40.0 * light, coat)


def _blend(images: UInt8[np.ndarray, "c s s 3"], masks: np.ndarray, paint: Float32[np.ndarray, "c s s 3"], share: float) -> np.ndarray:
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
