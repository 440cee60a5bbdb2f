"""Development lists share no object and no layout with the lists that are reported; -absent leaves targets out."""

from collections import Counter
from dataclasses import asdict, replace
from itertools import combinations

import numpy as np
import pytest

from tests.test_lists import gap_m
from vap_core.base.errors import BadStudy, UnknownName
from vap_core.policies.scripted.scripted import Random
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import BENCHMARKS, lists, shared
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow
from vap_core.study import stats
from vap_core.study.engine import weights_by_suite
from vap_core.study.trials import Study, shipped
from vap_make.films.scenes import HELD_OUT, TRAIN_INSTANCES
from vap_make.lists import benchmarks, development

TASK = ("simpler-bridge-absent", "put-camera")


@pytest.fixture(scope="module", params=sorted(BENCHMARKS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def spots(row: EpisodeRow) -> frozenset[tuple[float, float]]:
    return frozenset((place.x, place.y) for place in row.placements if place.model != row.goal)


def test_the_builder_gives_the_committed_list(name: str) -> None:
    built = development.rows(BENCHMARKS[name])
    assert [asdict(row) for row in built] == [asdict(row) for row in lists.read(f"{name}-dev")]
    counts = Counter(row.task for row in built)
    assert set(counts.values()) == {development.LAYOUTS[name][1]}
    assert list(counts) == [task.name for task in BENCHMARKS[name].tasks]


def test_no_layout_and_no_object_of_the_list_that_is_reported_returns(name: str) -> None:
    reported = suites.benchmark(name)
    props = {row.goal for row in reported}
    tuned = suites.benchmark(f"{name}-dev")
    models = {place.model for row in reported for place in row.placements}
    stands = set(map(spots, reported))
    for row in tuned:
        assert {place.model for place in row.placements} & models <= props
        assert spots(row) not in stands
    assert len({stats.layout_name(row) for row in tuned}) == len(tuned)


def test_its_objects_are_of_the_task_and_of_no_film(name: str) -> None:
    assert TRAIN_INSTANCES < development.INSTANCE < HELD_OUT
    assert not benchmarks.NOVEL <= development.INSTANCE < benchmarks.NOVEL + 20, "distractors"
    for task in BENCHMARKS[name].tasks:
        met = set()
        for row in suites.rows(f"{name}-dev", task.name):
            target, *others = (place.model for place in row.placements)
            assert target == development.instance(task)
            assert row.instruction == task.instruction
            rivals = [each for each in others if each != row.goal]
            assert len(set(rivals)) == 2
            for each in (target, *rivals):
                assert objects.get_object(each).category == task.category
                assert objects.get_object(each).split == "generic"
            met.update(rivals)
        assert len(met) >= 5, "look-alikes take turns"


def test_its_objects_keep_apart(name: str) -> None:
    least = np.inf
    for row in suites.benchmark(f"{name}-dev")[::5]:
        for one, other in combinations(row.placements, 2):
            least = min(least, gap_m(one, other))
    assert least >= 0.02


def test_a_development_list_has_the_policy_of_its_benchmark() -> None:
    study = Study((("vlabench-dev", "select-shoe"),), ("generic",), policy="random")
    configuration = study.configuration()
    assert configuration["lists"] == {"vlabench-dev": lists.digest("vlabench-dev")}
    assert shipped("vlabench-dev-absent") == shipped("vlabench")
    absent = Study((("vlabench-absent", "select-shoe"),), ("generic",), policy="random")
    assert absent.configuration()["lists"] == {"vlabench-absent": lists.digest("vlabench")}
    pair = {
        "tasks": [["vlabench", "select-shoe"], ["vlabench-absent", "select-shoe"]],
        "methods": ["vap"], "episodes": 2, "checkpoints": ["a" * 64],
    }  # fmt: skip
    assert set(weights_by_suite(pair).values()) == {"a" * 12}


def test_twins_stand_where_the_lookalikes_of_the_list_do(name: str) -> None:
    rows = suites.benchmark(f"{name}-twins")
    shown = Counter(place.model for row in rows for place in row.placements)
    for row, listed in zip(rows, suites.benchmark(name), strict=True):
        hardest = set(shared.hardest(row.target.removesuffix("-personal")))
        pairs = list(zip(row.placements, listed.placements, strict=True))
        assert hardest == {one.model for one, other in pairs if "-lookalike-" in other.model}
        same = replace(listed, suite=f"{name}-twins", placements=row.placements)
        assert asdict(row) == asdict(same)
        for one, other in pairs:
            assert asdict(replace(one, model=other.model)) == asdict(other)
            assert one.model in hardest or one.model == other.model
        assert all(gap_m(one, other) > 0.015 for one, other in combinations(row.placements, 2))
        assert len({shown[twin] for twin in hardest}) == 1


def test_names_of_suites() -> None:
    assert suites.suite("tabletop-dev-absent").robot == "so101"
    for wrong in (
        "tabletop-dev-twins",
        "shared-pair-twins",
        "tabletop-absent-dev",
        "widowx-pick-dev",
        "tabletop-",
        "-dev",
        "absent",
    ):
        with pytest.raises(UnknownName, match="a benchmark also with -dev") as refused:
            suites.suite(wrong)
        assert len(str(refused.value)) <= 330


def test_rows_without_their_target_are_those_with_it() -> None:
    for seed in (0, 3):
        with_it = suites.rows("simpler-bridge", TASK[1], seed=seed)
        without = suites.rows(*TASK, seed=seed)
        for one, other in zip(with_it, without, strict=True):
            assert other.start.absent
            start = replace(other.start, absent=False)
            assert asdict(replace(other, suite=one.suite, start=start)) == asdict(one)
    with pytest.raises(BadStudy, match="leaves the target out"):
        Study((TASK,), ("generic",), policy="expert")


def test_an_absent_target_is_not_seen_not_reached_and_no_success() -> None:
    (row,) = suites.rows(*TASK, 1)
    with build_scene(TASK[0], [place.model for place in row.placements]) as scene:
        env = make_env(scene, TASK[0], image_size=64)
        env.reset(row)
        masks = env.truth(masks=True).masks["front"]
        assert row.target not in masks
        assert {place.model for place in row.placements[1:]} == set(masks)
        assert env.truth().objects_world[row.target][0] < -1
        known = suites.suite(row.suite)
        trial = Trial("generic", scene, Random(), generic(), control=known.control, image_size=64)
        (episode,) = rollout(trial, [replace(row, max_steps=6)])
        assert (episode.outcome.status, episode.outcome.steps) == ("failure", 6)
        env.reset(replace(row, start=replace(row.start, absent=False)))
        assert row.target in env.truth(masks=True).masks["front"], "the scene is as it was"
