"""Two-colour commands: films of pairs, what is said of them, and the training that goes on from a shipped policy."""

import re
from dataclasses import replace

import numpy as np
import pytest

from vap_core.base.types import Description
from vap_core.instruction.rule import parse, rewrite
from vap_core.perception.describe import COLOURS
from vap_core.prompt import PALETTE
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import Task, suite
from vap_core.simulation.suites.layout import radius_m
from vap_core.simulation.suites.rules import NEAR_M
from vap_make.colours import HUES_DEG
from vap_make.films import demonstrations, pairs
from vap_make.films.demonstrations import Film
from vap_make.lists import shared
from vap_make.policy.commands import Known, command, phrase_pair
from vap_make.recipe import RECIPES, every, filmed_tasks

SUITE = "shared-pair"
RECIPE = replace(RECIPES[SUITE], thin=1)
TASKS = filmed_tasks(SUITE)


def film(rng: np.random.Generator, names: tuple[str, ...] = (), side: int = 8, t: int = 1) -> Film:
    """An invented film of a pair: the target, its goal, a rival of each."""
    names = names or tuple(f"thing-{i}" for i in rng.permutation(20)[:4])
    places = rng.normal(size=(t, 4, 3)).astype(np.float32)
    state = rng.normal(size=(t, 12)).astype(np.float32)
    if rng.random() < 0.5:  # the hand is above the target, and the plain command fits
        state[:, :2] = places[:, 0, :2] - robots.get("so101").base_world[:2]
    pictures = -(-t // every(SUITE))
    return Film(
        images=rng.integers(100, 110, (pictures, 3, side, side, 1), np.uint8).repeat(3, axis=-1),
        ids=rng.integers(0, 5, (pictures, 3, side, side)).astype(np.uint8),
        state=state,
        action=rng.normal(size=(t, 6)).astype(np.float32),
        places=places,
        names=names,
        task=TASKS[0].name,
        goal=1,
    )


def test_a_coloured_command_names_target_and_goal_by_colours_of_their_own() -> None:
    rng = np.random.default_rng(0)
    known = Known({f"thing-{i}": Description(str(rng.choice(COLOURS)), "") for i in range(20)})
    forms = set()
    for _ in range(1_000):
        shown = film(rng)
        words = rng.choice([*HUES_DEG, "grey"], 4).tolist()
        colours = [(word, frozenset({word})) for word in words]
        made = command(shown, 0, RECIPE, known, colours, rng)
        if made is None:
            continue
        forms.add(made.form)
        assert made.things == (0, 2, 3, 1), "the goal comes last"
        if made.form == "coloured":
            said = re.fullmatch(r"put the (\w+) pouch near the (\w+) vase", made.text)
            assert said, made.text
            assert said[1] != said[2]
            for i, word in ((0, said[1]), (3, said[2])):
                assert word == words[made.things[i]]
    assert forms == {"coloured", "plain"}


@pytest.mark.parametrize("task", suite(SUITE).tasks, ids=lambda task: task.name)
def test_every_pair_is_said_as_vap_rewrites_it(task: Task) -> None:
    known = (task.category, get_object(task.goal).category)
    read = parse(task.instruction, known, owners=("carla",))
    assert len(read.targets) == 2
    red, blue = PALETTE[0], PALETTE[1]
    assert phrase_pair(task, red.name, blue.name) == rewrite(read, (red, blue))


def test_a_pairs_scene_is_generic_and_laid_out_as_the_suites_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(demonstrations, "dye_some", lambda models, *_: models)
    known = suite(SUITE)
    assert {task.name for task in known.tasks} - {task.name for task in TASKS} == {
        "put-scrubber-near-slipper"
    }
    for number, task in enumerate(TASKS * 3):
        rng = np.random.default_rng(10 + number)
        names = demonstrations.draw_objects(known, task, rng)
        assert {get_object(name).split for name in names} == {"generic"}
        drawn = demonstrations.row(known, task, names, number, rng)
        target, goal, rival, other = (placed.model for placed in drawn.placements)
        assert drawn.goal == goal
        assert {get_object(name).category for name in (target, rival)} == {task.category}
        category = get_object(task.goal).category
        assert {get_object(name).category for name in (goal, other)} == {category}
        at = {placed.model: np.array([placed.x, placed.y]) for placed in drawn.placements}
        limit = radius_m(target) + radius_m(goal) + NEAR_M
        assert np.hypot(*(at[target] - at[goal])) > limit + shared.APART_M - 1e-3


def test_a_scene_without_room_is_refused() -> None:
    names = [f"plant-generic-{i}" for i in (0, 1)] + [f"cup-generic-{i}" for i in (0, 1)]
    task = next(task for task in TASKS if task.category == "plant")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared, "try_desk", lambda *args, **kwargs: None)
        with pytest.raises(ValueError, match="no room"):
            pairs.row(suite(SUITE), task, names, 0, np.random.default_rng(0))


def test_the_expert_puts_a_generic_object_near_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of four: whether a single one is put depends on how a machine rounds."""
    monkeypatch.setattr(demonstrations, "EPISODES", 4)
    shoot, shot = demonstrations.shoot, []

    def shoot_until_it_is_put(**asked: object) -> Film | None:
        if any(shot):
            raise ValueError("no room")
        shot.append(shoot(**asked))
        return shot[-1]

    monkeypatch.setattr(demonstrations, "shoot", shoot_until_it_is_put)
    (made,) = demonstrations.films(SUITE, 0, 0)
    target, goal = made.names[:2]
    assert made.goal == 1
    assert made.task == TASKS[0].name
    assert made.images.shape[1:] == (3, demonstrations.SIDE, demonstrations.SIDE, 3)
    apart = np.linalg.norm(made.places[:, 0, :2] - made.places[:, 1, :2], axis=1)
    limit = radius_m(target) + radius_m(goal) + NEAR_M
    assert apart[0] > limit > apart[-1]
    assert all((made.ids == i + 1).any() for i in range(4)), "every object is seen"
