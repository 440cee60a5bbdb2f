"""What the films show is not what the evaluation shows: looks, textures, distractors, a category."""

from dataclasses import replace

import numpy as np
import pytest

from vap_core.base.errors import UnknownName
from vap_core.base.files import DATA
from vap_core.simulation.looks import DEFAULT_STYLE
from vap_core.simulation.suites import BENCHMARKS, VARIANTS, benchmark
from vap_core.simulation.suites.suite import Variant
from vap_make.films import looks
from vap_make.films.demonstrations import DISTRACTORS, draw_models
from vap_make.films.looks import APART, FIRST_GRAIN, distance, draw_look
from vap_make.films.scenes import TRAIN_INSTANCES, draw_style
from vap_make.lists import benchmarks
from vap_make.recipe import FILMED, RECIPES, filmed_task, filmed_tasks


def overlaps(style: object) -> list[str]:
    """The properties in which a training look is too close to an evaluated one."""
    found = []
    for name, apart in APART.items():
        values = getattr(style, name)
        if name != "planks":
            values = (values,)
        for value in values:
            numbers = value if isinstance(value, tuple) else (value,)
            if distance(name, numbers) < apart:
                found.append(name)
    if style.grain < FIRST_GRAIN:
        found.append("grain")
    return found


def test_no_evaluated_look_is_a_look_of_training() -> None:
    for seed in range(300):
        assert overlaps(draw_look(np.random.default_rng(seed))) == []
    for name, variant in VARIANTS.items():
        assert overlaps(variant.style), name
        assert variant.style.grain < FIRST_GRAIN
    described = {field for field in VARIANTS["base"].style.__slots__ if field != "shadows"}
    assert described == {*APART, "grain"}, "every property of a style is kept apart"


def test_an_evaluated_look_that_comes_close_to_training_is_found_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A new variant takes its surroundings out of training, whatever it is."""
    drawn = draw_look(np.random.default_rng(0))
    monkeypatch.setitem(VARIANTS, "new", Variant("table", replace(drawn, grain=7)))
    assert {"planks", "wall", "floor", "robot", "camera_shift_m"} <= set(overlaps(drawn))
    assert overlaps(draw_look(np.random.default_rng(0))) == []
    assert looks.evaluated("wall")[-1] == drawn.wall


def test_the_evaluated_looks_lie_among_those_of_training() -> None:
    """Apart from them, but on all sides: the base look is not far from everything that was seen."""
    drawn = [draw_look(np.random.default_rng(seed)) for seed in range(400)]
    base = VARIANTS["base"].style
    for name in ("planks", "wall", "floor", "lamp_pos_m"):
        values = np.array([getattr(style, name) for style in drawn]).reshape(400, -1)
        middle = np.array(getattr(base, name)).reshape(-1)
        assert (values.min(0) < middle).all(), name
        assert (values.max(0) > middle).all(), name


@pytest.mark.parametrize("suite", sorted(BENCHMARKS))
def test_the_held_out_category_is_in_no_film_of_its_suite(suite: str) -> None:
    held_out = RECIPES[suite].held_out_category
    evaluated = {task.category for task in BENCHMARKS[suite].tasks}
    filmed = {task.category for task in filmed_tasks(suite)}
    assert held_out in evaluated
    assert held_out not in filmed
    assert evaluated - filmed == {held_out}
    names = [task.name for task in filmed_tasks(suite)]
    assert len(set(names)) == len(names) >= 3
    for task in filmed_tasks(suite):
        assert filmed_task(suite, task.name) == task
        assert f"my {task.category}" in task.instruction
    (held_task,) = [task for task in BENCHMARKS[suite].tasks if task.category == held_out]
    rules = {(task.rule, task.goal) for task in filmed_tasks(suite)}
    assert (held_task.rule, held_task.goal) in rules, "the skill itself is shown"
    with pytest.raises(UnknownName):
        filmed_task(suite, held_task.name)


def test_distractors_of_films_are_no_distractors_of_the_evaluation() -> None:
    assert TRAIN_INSTANCES < benchmarks.NOVEL
    known = BENCHMARKS["simpler-fractal"]
    evaluated, filmed, scenes = set(), set(), 0
    for row in benchmark("simpler-fractal"):
        evaluated |= {place.model for place in row.placements if "-generic-" in place.model}
    for seed in range(120):
        for task in filmed_tasks(known.name):
            models = draw_models(known, task, np.random.default_rng(seed), held_out=False)
            names = {model.name for model in models}
            own = {name for name in names if name.startswith(f"{task.stem}-generic")}
            others = names - own
            assert len(models) + bool(task.goal) <= 6
            assert len(own) > 1
            filmed |= others
            scenes += bool(others)
    assert evaluated
    assert filmed
    assert not evaluated & filmed
    assert scenes / 360 == pytest.approx(FILMED[known.name].distractors, abs=0.1)
    stems = {name.partition("-generic-")[0] for name in filmed | evaluated}
    assert stems <= {kind.replace(" ", "-") for kind in DISTRACTORS}


def test_the_pages_say_which_rooms_the_heads_of_perception_know() -> None:
    drawn = [draw_style(np.random.default_rng(i)) for i in range(500)]
    known = np.mean([style.planks == DEFAULT_STYLE.planks for style in drawn])
    assert known == pytest.approx(0.4, abs=0.05)
    for page in (DATA.parent / "docs" / "perception.md", DATA / "weights" / "README.md"):
        assert "two in five of the" in " ".join(page.read_text().lower().split())
