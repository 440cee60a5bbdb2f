"""Commands for filmed frames: one demonstration teaches many.

*Coloured*: the target is called by its colour, which is that of its materials (`colours.seen` of
the pictures). *Described*: as a hard prompt does it, in the captioner's words. *Learned*: by a
learned word, as a soft prompt does it. *Plain*: the command does not say which object is meant;
only frames in which the hand is nearer to the target than to any rival, so that a plain command
means what the hand already nears. A pair's command is plain, or names both its objects by their
colours.

The form is drawn before it is asked whether it fits, and a frame that it does not fit is left out:
what an object looks like says nothing about whether a plain or described command means it.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from vap_core.base.types import Description, value
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.rollout.prompters import soft_prompt
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import Task, suite
from vap_make.colours import seen, stands_out
from vap_make.films.captions import distinguishes
from vap_make.films.demonstrations import Film, has_every
from vap_make.recipe import FILMED, Recipe, filmed_task
from vap_make.words import DETERMINERS

AFTERWARDS = 0.15
"""How often a colour comes in a sentence of its own, as a description does."""
NEAR_M = 0.02
"""A hand that is nearer to its target than to any rival by this much gives its choice away."""
Form = Literal["coloured", "described", "learned", "plain"]
Embedding = Float32[np.ndarray, " d"]
Images = UInt8[np.ndarray, "c s s 3"]
"""The views of one frame."""
Seen = tuple[str, frozenset[str]]
"""What an object is called by its colour, and the colours that it shows, as `colours.seen`."""


@dataclass(frozen=True)
class Known:
    """What can be said of the films' objects, by name.

    Every target and rival has a description, some have the embedding of a learned word.
    """

    captions: Mapping[str, Description]
    learned: Mapping[str, Embedding] = field(default_factory=dict)


@value
class Command:
    """One training sample: views and words, and how the two name the target.

    `things` are the numbers of the film's target, which comes first, of its rivals, and last of a
    pair's goal. `embedding` is that of the learned word in `text`, if there is one.
    """

    images: Images
    text: str
    form: Form
    things: tuple[int, ...]
    embedding: Embedding | None = None


def colours_of(film: Film) -> list[Seen]:
    """The colours of every object of a film, from the pictures that show the most of it."""
    found = []
    for i in range(len(film.names)):
        masks = film.ids == i + 1
        best = masks.sum(axis=(1, 2, 3)).argmax()
        found.append(seen(list(film.images[best]), list(masks[best])))
    return found


def command(
    film: Film,
    t: int,
    recipe: Recipe,
    known: Known,
    colours: Sequence[Seen],
    rng: np.random.Generator,
) -> Command | None:
    """Step t of a film, which has a picture, with a command that its action answers.

    `colours` are `colours_of` the film. None where the form that was drawn does not fit the frame.

    Raises: UnknownName for a film of a task that the recipe's suite does not film; ValueError for
        one that is not `thinned` as the recipe says.
    """
    if not has_every(film, recipe.interval):
        raise ValueError(f"command: the film has not a picture every {recipe.interval} steps")
    task = filmed_task(recipe.suite, film.task)
    pairs = FILMED[recipe.suite].pairs
    things = nameable(film, recipe.suite)
    names = [film.names[i] for i in things]
    length: Literal["short", "long"] = "long" if rng.random() < 0.5 else "short"
    words, shown = map(list, zip(*(colours[i] for i in things), strict=True))
    form = _draw_form(recipe, names[0] in known.learned, rng)
    embedding = None
    if form == "coloured":
        named = (0, len(things) - 1) if pairs else (0,)
        for i in named:
            if not stands_out(words[i], shown[:i] + shown[i + 1 :]):
                return None
        text = phrase_instruction(task, words[0], rng)
        if pairs:
            text = phrase_pair(task, words[0], words[-1])
    elif form == "described":
        phrase = getattr(known.captions[names[0]], length)
        held_out = any(word in phrase for word in recipe.held_out_words)
        if pairs or held_out or not distinguishes(known.captions, names, length):
            return None
        text = describe_instruction(task, phrase)
    elif form == "learned":
        text = soft_prompt(WORD, [task.category]).rewrite(task.instruction)
        embedding = known.learned[names[0]]
    else:
        if not near(film, t, recipe.suite, things[1:]):
            return None
        text = phrase_instruction(task, "", rng)
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    lit = np.clip(film.images[t // recipe.interval] * gain, 0, 255).astype(np.uint8)
    return Command(lit, text, form, tuple(things), embedding)


def nameable(film: Film, suite_name: str) -> list[int]:
    """The numbers of what a command may name: the target, its rivals, and last a pair's goal."""
    things = [i for i in range(len(film.names)) if i != film.goal]
    if FILMED[suite_name].pairs:
        things.append(film.goal)
    return things


def near(film: Film, t: int, suite_name: str, rivals: Sequence[int]) -> bool:
    """Whether the hand is nearer to the target than to every rival, seen from above.

    Raises: UnknownName for a suite that no registry holds.
    """
    robot = robots.get(suite(suite_name).robot)
    hand = film.state[t, :2] + robot.base_world[:2]
    distances = np.linalg.norm(film.places[t, :, :2] - hand, axis=1)
    return bool((distances[0] + NEAR_M < distances[list(rivals)]).all())


def phrase_instruction(task: Task, word: str, rng: np.random.Generator) -> str:
    """The task's instruction with its "my" replaced: by "the" and a word, or by any determiner.

    Now and then the word comes afterwards, as a description does.
    """
    if word and rng.random() < AFTERWARDS:
        return describe_instruction(task, word)
    if word:
        determiner = f"the {word} "
    else:
        determiner = f"{rng.choice(DETERMINERS)} "
    return task.instruction.replace("my ", determiner, 1)


def phrase_pair(task: Task, word: str, goal_word: str) -> str:
    """A pair's instruction with both its objects named by their colours, as VAP does it.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    text = task.instruction.replace("my ", f"the {word} ", 1)
    goal = get_object(task.goal).category
    return re.sub(rf"\b\w+ (?={goal}$)", f"the {goal_word} ", text)


def describe_instruction(task: Task, phrase: str) -> str:
    """The task's instruction and a description, as a hard prompt is put together."""
    return f"{task.instruction}. My {task.category} is {phrase}."


def _draw_form(recipe: Recipe, has_word: bool, rng: np.random.Generator) -> Form:
    """A form, by the recipe's shares."""
    if has_word and rng.random() < recipe.learned:
        return "learned"
    drawn = rng.random()
    if drawn < recipe.described:
        return "described"
    return "plain" if drawn < recipe.described + recipe.plain else "coloured"
