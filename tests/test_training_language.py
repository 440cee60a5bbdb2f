"""The language of training does not give the method away: tint and paint say nothing about the target, under any form of command."""

from collections import defaultdict
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from vap_core.base.types import Description
from vap_core.perception.describe import COLOURS
from vap_core.prompt import PALETTE
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import BENCHMARKS, suite
from vap_make.films.demonstrations import Film
from vap_make.policy import colouring
from vap_make.policy.colouring import (
    colour_of,
    draw_colouring,
    is_distinct,
    natural_colours,
    tints,
)
from vap_make.policy.commands import Command, Form, Known, command
from vap_make.recipe import RECIPES, filmed_task
from vap_make.words import PAINTS, similar_colours, vocabulary

SUITE, SIDE, THINGS = "simpler-bridge", 8, 40
RECIPE = RECIPES[SUITE]


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


def drawn(known: Known, n: int, seed: int = 1, **changes: object) -> list[Command]:
    rng = np.random.default_rng(seed)
    recipe = replace(RECIPE, **changes)
    return [command(film(rng), 0, recipe, known, rng) for _ in range(n)]


@pytest.fixture(scope="module")
def commands(known: Known) -> list[Command]:
    return drawn(known, 4_500)


def test_an_object_is_as_often_tinted_or_painted_whether_it_is_the_target_or_not(
    commands: list[Command],
) -> None:
    """For every form, the target's share less the rivals' is 0 within 3.5 standard errors of at most 2 points."""
    for name in ("tinted", "painted"):
        for form in get_args(Form):
            differences, own = [], []
            for made in commands:
                if made.form == form:
                    marked = [i in getattr(made.colouring, name) for i in range(len(made.things))]
                    differences.append(marked[0] - np.mean(marked[1:]))
                    own.append(marked[0])
            error = np.std(differences) / np.sqrt(len(differences))
            assert abs(np.mean(differences)) <= 3.5 * error, (form, name)
            assert error < 0.021
            if name == "tinted":
                assert np.mean(own) > 0.02, "the target of any form is tinted, too"
            elif form in ("plain", "coloured"):
                assert np.mean(own) > 0.1, "the target of a plain command is painted, too"


def test_whether_and_where_a_scene_is_tinted_does_not_depend_on_the_form(
    commands: list[Command],
) -> None:
    """A fifth of the scenes, and of them every object or none with equal odds."""
    carriers: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
    for made in commands:
        carrier = next(iter(made.colouring.tinted), len(made.things))
        if not made.colouring.tinted and not made.colouring.nothing:
            carrier = -1
        carriers[made.form, len(made.things)].append(carrier)
    for (form, n), found in carriers.items():
        share = np.mean(np.array(found) >= 0)
        assert share == pytest.approx(0.2, abs=4 * np.sqrt(0.16 / len(found))), (form, n)
        for i in range(n + 1):
            expected = 0.2 / (n + 1)
            bound = 4 * np.sqrt(expected / len(found))
            assert np.mean(np.array(found) == i) == pytest.approx(expected, abs=bound), (form, n, i)


def test_the_share_of_tinted_targets_that_are_called_by_their_tint_is_small(
    commands: list[Command],
) -> None:
    named = [made.form == "coloured" and 0 in made.colouring.tinted for made in commands]
    assert 0.005 < np.mean(named) < 0.04


def test_without_a_tint_share_no_tint_appears(
    known: Known, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object) -> None:
        raise AssertionError("tinted")

    monkeypatch.setattr(colouring, "tinted", refuse)
    for made in drawn(known, 300, tint_share=0.0):
        assert not made.colouring.tinted
        assert not made.colouring.nothing
    with pytest.raises(AssertionError, match="tinted"):
        drawn(known, 300)


def test_held_out_tints_and_opacities_are_never_drawn(
    known: Known, monkeypatch: pytest.MonkeyPatch
) -> None:
    opacities = []
    blend = colouring.tinted

    def note(images: np.ndarray, masks: np.ndarray, colour: object, alpha: float) -> np.ndarray:
        opacities.append(alpha)
        return blend(images, masks, colour, alpha)

    monkeypatch.setattr(colouring, "tinted", note)
    used = set()
    for made in drawn(known, 800, tint_share=1.0):
        used |= {colour.name for colour in made.colouring.tinted.values()}
    assert used == {colour.name for colour in PALETTE} - {"magenta", "yellow"}
    assert used == {colour.name for colour in tints(RECIPE)}
    assert len(opacities) > 400
    held_out = [alpha for alpha in opacities if 0.42 < alpha < 0.58]
    assert not held_out
    assert min(opacities) >= 0.25
    assert max(opacities) <= 0.75


def test_colour_words_come_from_natural_colours_and_paint_and_the_held_out_tints_too(
    commands: list[Command],
) -> None:
    told = {
        name
        for made in commands
        if made.form == "coloured" and 0 not in made.colouring.tinted
        for name in ("magenta", "yellow", *COLOURS)
        if f" {name}" in made.text
    }
    assert told >= {colour.name for colour in PAINTS if colour.name in (*COLOURS, "magenta")}


def test_the_colour_of_a_coloured_command_is_one_that_no_other_object_shows(known: Known) -> None:
    rng = np.random.default_rng(2)
    for n in (2, 3, 4, 5) * 40:
        looks = [known.captions[f"thing-{i}"] for i in rng.permutation(THINGS)[:n]]
        made = draw_colouring(
            looks, replace(RECIPE, tint_share=0.5), rng, may_paint=True, distinct=True
        )
        if made is None:  # five objects and a tint may use up all colours
            assert n == 5
            continue
        assert is_distinct(looks, made)
        for i in range(n):
            similar = similar_colours(colour_of(i, looks, made))
            for j in set(range(n)) - {i}:
                assert colour_of(j, looks, made) not in similar
                if j not in made.painted:
                    assert similar.isdisjoint(natural_colours(looks[j]))


def test_forms_have_their_shares_and_the_captioners_grammar(
    commands: list[Command], known: Known
) -> None:
    words = set(vocabulary())
    task = filmed_task(SUITE, "put-camera")
    phrases = {
        text for caption in known.captions.values() for text in (caption.short, caption.long)
    }
    shares = {form: np.mean([made.form == form for made in commands]) for form in get_args(Form)}
    assert shares["described"] > 0.3
    assert shares["plain"] > 0.1
    assert shares["coloured"] > 0.3
    assert shares["learned"] == pytest.approx(0.125, abs=0.02), "half of a quarter's"
    for made in commands[:2000]:
        said = made.text.lower().replace(".", "").replace(",", "").split()
        assert set(said) <= words, made.text
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
    for name, recipe in RECIPES.items():
        assert recipe.suite == name
        assert 0 <= recipe.tint_share <= 0.2
        assert recipe.described >= 0.3
        assert 1 <= recipe.execute <= recipe.chunk
        evaluated = {task.category for task in suite(name).tasks}
        evaluated |= {get_object(task.goal).category for task in suite(name).tasks if task.goal}
        assert recipe.held_out_category in evaluated
        assert len(set(recipe.held_out_tints) & {colour.name for colour in PALETTE}) == 2
