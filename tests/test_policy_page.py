"""What docs/policy.md says of the policies that ship and of the scenes held out is so."""

import re

import numpy as np
import pytest

from tests.pages import PAGES
from vap_core.policies.mini_pi0.teach_token import model_of_policy
from vap_core.policies.mini_pi0.token_alignment import shared_tables
from vap_core.policies.names import SHIPPED
from vap_core.simulation.suites import suite
from vap_make.films.demonstrations import draw_objects
from vap_make.films.looks import draw_look
from vap_make.policy.train import _is_held_out
from vap_make.recipe import RECIPES, filmed_tasks

MINI = "mini-pi0-"
POLICY = PAGES["docs/policy.md"]
DEFAULTS = {
    "mini-pi0-simpler-bridge-wide-seed-0",
    "mini-pi0-simpler-fractal-wide",
    "mini-pi0-vlabench-wide",
    "mini-pi0-tabletop-longer",
}
FIRST = {
    "mini-pi0-simpler-bridge",
    "mini-pi0-simpler-fractal",
    "mini-pi0-tabletop",
    "mini-pi0-vlabench",
}
WORDS = {"Ten": 10, "Fourteen": 14}


def shipped() -> set[str]:
    return {folder.name for folder in SHIPPED.glob(f"{MINI}*")}


def listed() -> str:
    """What policy.md says of the policies that are neither defaults nor first ones."""
    return POLICY[POLICY.index("more ship, all by this recipe") : POLICY.index("## What helped")]


def test_every_other_policy_that_ships_is_listed() -> None:
    named = re.findall(r"\]\(\.\./data/policies/(mini-pi0-[^)]+)\)", listed())
    assert sorted(named) == sorted(shipped() - DEFAULTS - FIRST)
    told = re.search(r"(\w+) more ship, all by this recipe", POLICY)
    assert told is not None
    assert WORDS[told[1]] == len(named)
    made = re.search(r"(\w+) policies were made by\s+it", PAGES["docs/benchmarks.md"])
    assert made is not None
    assert WORDS[made[1]] == len(shipped() - FIRST)


@pytest.mark.parametrize("name", sorted(shipped()))
def test_how_far_its_words_moved_is_as_told(name: str) -> None:
    folder = SHIPPED / name
    source, target = shared_tables(model_of_policy(folder), folder)
    # The word that pads has no direction.
    source, target = source[1:], target[1:]
    lengths = np.linalg.norm(source, axis=1) * np.linalg.norm(target, axis=1)
    mean = float(((source * target).sum(1) / lengths).mean())
    if name in FIRST:
        told = re.search(r"policies moved theirs \(([^)]+)\)", " ".join(listed().split()))
        assert told is not None
        assert f"{mean:.2f}" in re.split(r", | and ", told[1])
    else:
        assert "(mean cosine 1.000)" in listed()
        assert f"{mean:.3f}" == "1.000"


def films_objects(name: str, stage: int) -> set[str]:
    """The generic objects of a stage's films, by a suite's recipe; its goals are no such objects."""
    tasks = filmed_tasks(name)
    task = tasks[stage % len(tasks)]
    rng = np.random.default_rng([71, RECIPES[name].seed, *name.encode(), stage])
    draw_look(rng)
    return set(draw_objects(suite(name), task, rng)) - {task.goal}


@pytest.mark.parametrize("name", ["simpler-bridge", "simpler-fractal", "vlabench", "tabletop"])
def test_how_many_held_out_objects_are_in_training_films_is_as_told(name: str) -> None:
    trained: set[str] = set()
    held_out: set[str] = set()
    for stage in range(RECIPES[name].stages):
        part = held_out if _is_held_out(stage) else trained
        part |= films_objects(name, stage)
    told = f"{len(held_out & trained)} of {len(held_out)} on {name}"
    assert told in " ".join(POLICY.split())
