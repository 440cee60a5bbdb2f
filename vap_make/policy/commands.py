"""Commands for filmed frames, and the colours that fit them: one demonstration teaches many.

*Coloured*: the target is called by its colour, which is its own, paint, or a tint. *Described*: as
a hard prompt does it, in the captioner's words. *Learned*: by a learned word, as a soft prompt does
it. *Plain*: the command does not say which object is meant; only frames in which the hand is nearer
to the target than to any rival, so that a plain command means what the hand already nears.
A pair's command is plain, or names both its objects by their colours.

The form is drawn from what the frame allows, and then the colours (`colouring`): under every form
an object is as often tinted or painted whether it is the target or not.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Description, value
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.rollout.prompters import soft_prompt
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import Task, suite
from vap_make.films.captions import distinguishes
from vap_make.films.demonstrations import Film
from vap_make.policy.colouring import (
    Colouring,
    Images,
    colour_of,
    colour_views,
    draw_colouring,
)
from vap_make.recipe import FILMED, Recipe, every, filmed_task
from vap_make.words import DETERMINERS

AFTERWARDS = 0.15
"""How often a colour comes in a sentence of its own, as a description does."""
NEAR_M = 0.02
"""A hand that is nearer to its target than to any rival by this much gives its choice away."""
Form = Literal["coloured", "described", "learned", "plain"]
Embedding = Float32[np.ndarray, " d"]


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
    pair's goal; the colouring counts them. `embedding` is that of the learned word in `text`, if
    there is one.
    """

    images: Images
    text: str
    form: Form
    things: tuple[int, ...]
    colouring: Colouring
    embedding: Embedding | None = None


def command(film: Film, t: int, recipe: Recipe, known: Known, rng: np.random.Generator) -> Command:
    """Step t of a film, which has a picture, with a command that its action answers.

    Raises: UnknownName for a film of a task that the recipe's suite does not film.
    """
    task = filmed_task(recipe.suite, film.task)
    pairs = FILMED[recipe.suite].pairs
    things = nameable(film, recipe.suite)
    names = [film.names[i] for i in things]
    looks = [known.captions[name] for name in names]
    length: Literal["short", "long"] = "long" if rng.random() < 0.5 else "short"
    fits: dict[Form, bool] = {
        "coloured": True,
        "described": not pairs and distinguishes(known.captions, names, length),
        "learned": names[0] in known.learned,
        "plain": near(film, t, recipe.suite, things[1:]),
    }
    form = _draw_form(recipe, fits, rng)
    colouring = draw_colouring(
        looks,
        recipe,
        rng,
        may_paint=form in ("coloured", "plain"),
        distinct=form == "coloured",
        at_once=2 if pairs else 1,
    )
    if colouring is None:
        # No colours distinguish these objects: as rare as it is, a description has to do.
        form = "described"
        colouring = Colouring(tinted={}, painted={})
    embedding = None
    if form == "coloured" and pairs:
        text = phrase_pair(
            task, colour_of(0, looks, colouring), colour_of(len(things) - 1, looks, colouring)
        )
    elif form == "coloured":
        text = phrase_instruction(task, colour_of(0, looks, colouring), rng)
    elif form == "described":
        text = describe_instruction(task, getattr(looks[0], length))
    elif form == "learned":
        text = soft_prompt(WORD, [task.category]).rewrite(task.instruction)
        embedding = known.learned[names[0]]
    else:
        text = phrase_instruction(task, "", rng)
    picture = t // every(recipe.suite)
    images = colour_views(
        images=film.images[picture],
        ids=film.ids[picture],
        things=things,
        colouring=colouring,
        recipe=recipe,
        rng=rng,
    )
    gain = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    lit = np.clip(images * gain, 0, 255).astype(np.uint8)
    return Command(
        images=lit,
        text=text,
        form=form,
        things=tuple(things),
        colouring=colouring,
        embedding=embedding,
    )


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


def _draw_form(recipe: Recipe, fits: Mapping[Form, bool], rng: np.random.Generator) -> Form:
    """A form that fits, by the recipe's shares; what does not fit is coloured."""
    if fits["learned"] and rng.random() < recipe.learned:
        return "learned"
    drawn = rng.random()
    form: Form = "coloured"
    if drawn < recipe.described:
        form = "described"
    elif drawn < recipe.described + recipe.plain:
        form = "plain"
    return form if fits[form] else "coloured"
