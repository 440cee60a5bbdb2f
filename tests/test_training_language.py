"""The language of training does not give the method away: no picture has an overlay, colour words are those of materials, and a look says nothing about whether a plain or described command means it."""

import ast
import inspect
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from vap_core.base.types import Description
from vap_core.perception.describe import COLOURS
from vap_core.prompt import PALETTE
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import BENCHMARKS, suite
from vap_make import colours, objects
from vap_make.colours import HUES_DEG, seen, similar, stands_out
from vap_make.films import demonstrations
from vap_make.films.demonstrations import Film
from vap_make.policy import commands as language
from vap_make.policy.commands import Command, Form, Known, Seen, command
from vap_make.recipe import RECIPES, filmed_task
from vap_make.words import vocabulary

SUITE, SIDE, THINGS = "simpler-bridge", 8, 40
RECIPE = replace(RECIPES[SUITE], thin=1)


def look(rng: np.random.Generator) -> Description:
    main, other = rng.choice(COLOURS, 2, replace=False)
    short = f"{main} with {other} spots" if rng.random() < 0.7 else str(main)
    return Description(short, f"a tall camera, mostly {short}")


@pytest.fixture(scope="module")
def known() -> Known:
    rng = np.random.default_rng(0)
    captions = {f"thing-{i}": look(rng) for i in range(THINGS)}
    learned = {f"thing-{i}": rng.normal(size=4).astype(np.float32) for i in range(0, THINGS, 4)}
    return Known(captions, learned)


def film(rng: np.random.Generator) -> Film:
    """Two pictures of a target, one to three rivals and a plate; any of the things is the target."""
    n = int(rng.integers(2, 5))
    names = [f"thing-{i}" for i in rng.permutation(THINGS)[:n]]
    names.insert(1, "plate-prop")
    ids = rng.integers(0, n + 2, (2, 1, SIDE, SIDE)).astype(np.uint8)
    places = rng.normal(size=(2, n + 1, 3)).astype(np.float32)
    state = rng.normal(size=(2, 13)).astype(np.float32)
    if rng.random() < 0.7:  # the hand is above the target, and the plain command fits
        state[:, :2] = places[:, 0, :2] - robots.get("wx250s").base_world[:2]
    return Film(
        images=rng.integers(0, 256, (2, 1, SIDE, SIDE, 3), np.uint8),
        ids=ids,
        state=state,
        action=np.zeros((2, 7), np.float32),
        places=places,
        names=tuple(names),
        task="put-camera",
        goal=1,
    )


def painted(shown: Film, rng: np.random.Generator) -> list[Seen]:
    """What the objects are said to show; half of them have a colour of their own."""
    words = rng.permutation([w for w in HUES_DEG if w not in RECIPE.held_out_words]).tolist()
    drawn = [words.pop() if rng.random() < 0.5 else "grey" for _ in shown.names]
    return [(word, frozenset({word})) for word in drawn]


Drawn = tuple[Film, list[Seen], Command]


def drawn(known: Known, n: int, seed: int = 1, **changes: Any) -> list[Drawn]:
    rng = np.random.default_rng(seed)
    recipe = replace(RECIPE, **changes)
    found: list[Drawn] = []
    while len(found) < n:
        shown = film(rng)
        colours = painted(shown, rng)
        made = command(shown, 0, recipe, known, colours, rng)
        if made is not None:
            found.append((shown, colours, made))
    return found


@pytest.fixture(scope="module")
def commands(known: Known) -> list[Drawn]:
    return drawn(known, 4_000)


def test_no_recipe_has_an_overlay(known: Known) -> None:
    """No function of the recipe blends into a mask: what is drawn is the film, lighter or darker."""
    for module in (language, colours, demonstrations, objects):
        called = {
            node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            for node in ast.walk(ast.parse(Path(inspect.getfile(module)).read_text("utf-8")))
            if isinstance(node, ast.Call)
        }
        assert called.isdisjoint({"tint", "addWeighted", "composite", "blend", "paste"}), module
    for shown, _, made in drawn(known, 300):
        gain = made.images.astype(float) / np.maximum(shown.images[0], 1)
        bright = (shown.images[0] > 60) & (made.images < 255)
        for channel in range(3):
            of = gain[..., channel][bright[..., channel]]
            assert of.max() - of.min() < 0.03, "one gain a channel, everywhere"


def test_colour_words_are_those_of_pixels_and_stand_out(commands: list[Drawn]) -> None:
    told = set()
    for _, seen_colours, made in commands:
        if made.form == "coloured":
            word, shown = seen_colours[made.things[0]]
            assert f" {word}" in made.text
            assert stands_out(word, [seen_colours[i][1] for i in made.things[1:]])
            assert word in shown
            told.add(word)
    assert told >= set(HUES_DEG) - set(RECIPE.held_out_words)


@pytest.mark.parametrize("form", ["plain", "described", "learned"])
def test_a_look_says_nothing_about_other_forms(commands: list[Drawn], form: str) -> None:
    """A target with a colour of its own is as frequent as a rival with one, within 3.5 errors."""
    differences = []
    for _, seen_colours, made in commands:
        if made.form == form:
            vivid = [seen_colours[i][0] != "grey" for i in made.things]
            differences.append(vivid[0] - np.mean(vivid[1:]))
    error = np.std(differences) / np.sqrt(len(differences))
    assert abs(np.mean(differences)) <= 3.5 * error
    assert error < 0.04


def test_colours_are_judged_by_pixels() -> None:
    whole = np.ones((8, 8), bool)
    for word, rgb in (
        ("red", (200, 30, 30)), ("orange", (230, 120, 20)), ("yellow", (230, 210, 40)), ("green", (40, 160, 60)),
        ("cyan", (40, 170, 180)), ("blue", (40, 70, 200)), ("purple", (120, 50, 200)), ("magenta", (200, 30, 170)),
        ("pink", (240, 130, 170)), ("white", (245, 245, 245)), ("black", (12, 12, 12)), ("grey", (120, 120, 122)),
        ("brown", (105, 75, 45)),
    ):  # fmt: skip
        flat = np.full((8, 8, 3), rgb, np.uint8)
        assert seen([flat], [whole]) == (word, frozenset({word})), (word, rgb)
    half = flat.copy()
    half[:, 4:] = (40, 70, 200)
    word, shown = seen([half], [whole])
    assert (word, shown) in {
        ("blue", frozenset({"blue", "brown"})),
        ("brown", frozenset({"blue", "brown"})),
    }
    nothing = np.zeros((8, 8), bool)
    assert seen([half], [nothing]) == ("", frozenset())
    assert seen([half, half], [nothing, whole])[1] == shown, "an object that one view hides"
    assert all(word in similar(other) for word in HUES_DEG for other in similar(word))


def test_films_show_no_held_out_colour() -> None:
    for name, recipe in RECIPES.items():
        rng = np.random.default_rng(3)
        task = demonstrations.filmed_tasks(name)[0]
        words = set()
        for _ in range(4):
            for model in demonstrations.draw_objects(suite(name), task, rng):
                if "-generic-" in model:
                    word, shown = objects.material_colours(model)
                    words.add(word)
                    assert shown.isdisjoint(recipe.held_out_words), model
        assert len(words & set(HUES_DEG)) > 3, words


def test_forms_have_their_shares_and_the_captioners_grammar(
    commands: list[Drawn], known: Known
) -> None:
    words = set(vocabulary())
    task = filmed_task(SUITE, "put-camera")
    phrases = {
        text for caption in known.captions.values() for text in (caption.short, caption.long)
    }
    made_of = [made for _, _, made in commands]
    shares = {form: np.mean([made.form == form for made in made_of]) for form in get_args(Form)}
    assert all(share > 0.08 for share in shares.values()), shares
    assert shares["coloured"] > 0.25
    for made in made_of[:2000]:
        said = made.text.lower().replace(".", "").replace(",", "").split()
        assert set(said) <= words, made.text
        assert set(said).isdisjoint(RECIPE.held_out_words), made.text
        assert (made.embedding is None) == (made.form != "learned")
        if made.form == "described":
            start = f"{task.instruction}. My camera is "
            assert made.text.startswith(start)
            assert made.text.removeprefix(start).removesuffix(".") in phrases
        if made.form == "learned":
            assert made.text == "put <my_0> on the plate"
        if made.form == "plain":
            assert made.text in {f"put {word} camera on the plate" for word in ("my", "the", "a")}


def test_every_suites_recipe_can_be_said_in_the_vocabulary() -> None:
    assert set(RECIPES) == {*BENCHMARKS, "shared-pair"}
    assert set(colours.WORDS) <= set(vocabulary())
    for name, recipe in RECIPES.items():
        assert recipe.suite == name
        assert recipe.described >= 0.2
        assert 1 <= recipe.execute <= recipe.chunk
        evaluated = {task.category for task in suite(name).tasks}
        evaluated |= {get_object(task.goal).category for task in suite(name).tasks if task.goal}
        assert recipe.held_out_category in evaluated
        assert len(set(recipe.held_out_words) & {colour.name for colour in PALETTE}) == 2


def test_a_film_that_is_not_thinned_as_the_recipe_says_is_refused(known: Known) -> None:
    """Its pictures would be of earlier steps than the actions beside them."""
    rng = np.random.default_rng(0)
    shown = film(rng)
    with pytest.raises(ValueError, match="not a picture every 2 steps"):
        command(shown, 0, RECIPES[SUITE], known, painted(shown, rng), rng)
