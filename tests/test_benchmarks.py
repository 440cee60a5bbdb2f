"""Every task of the four benchmarks in the real simulator: it starts at rest and in view, it can be done, not by chance, and again the same."""

import os
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import asdict
from io import StringIO
from typing import NamedTuple

import numpy as np
import pytest

from vap_core.base.errors import BadAction
from vap_core.policies.scripted.expert import Expert
from vap_core.policies.scripted.scripted import Random
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import scenes
from vap_core.simulation.env import Env
from vap_core.simulation.suites import BENCHMARKS, VARIANTS, Suite, Task, rows
from vap_core.simulation.types import REST, EpisodeRow

TASKS = [(suite.name, task.name) for suite in BENCHMARKS.values() for task in suite.tasks]
TYPICAL = {
    (suite.name, task.rule): (suite.name, task.name)
    for suite in BENCHMARKS.values()
    for task in suite.tasks
}
"""One task of each rule of success in each suite."""
STILL_M, UPRIGHT_COS = 0.005, np.cos(np.deg2rad(5.0))
SEEN_PX = 40
"""Of a 224 x 224 picture."""
JOINT = ("vlabench", "select-shoe")


class Bench(NamedTuple):
    """A task with the scene of its first, middle and last row."""

    suite: Suite
    task: Task
    rows: tuple[EpisodeRow, ...]
    scene: scenes.Scene

    def env(self, image_size: int = 32) -> Env:
        return Env(
            self.scene,
            image_size=image_size,
            cameras=self.suite.cameras,
            control=self.suite.control,
            sensor=self.suite.sensor,
        )

    def trial(self, policy: Expert | Random) -> Trial:
        return Trial(
            method="generic",
            scene=self.scene,
            policy=policy,
            prompter=generic(),
            control=self.suite.control,
            sensor=self.suite.sensor,
        )


def opened(suite: str, task: str, chosen: tuple[EpisodeRow, ...]) -> Bench:
    names = tuple(dict.fromkeys(place.model for row in chosen for place in row.placements))
    (variant,) = {row.variant for row in chosen}
    scene = scenes.build(BENCHMARKS[suite].robot, names, style=VARIANTS[variant].style)
    return Bench(BENCHMARKS[suite], BENCHMARKS[suite].task(task), chosen, scene)


PLAYED = (
    "test_the_expert_solves_it_and_touches_the_right_thing_first",
    "test_chance_does_not_solve_it",
)
"""They play whole episodes: of typical tasks every day, of the others in the sweeps."""


def pytest_generate_tests(metafunc):
    if "bench" not in metafunc.fixturenames:
        return
    played, params = metafunc.function.__name__ in PLAYED, []
    for each in TASKS:
        daily = not played or each in TYPICAL.values()
        params.append(pytest.param(each, marks=() if daily else pytest.mark.sweep))
    metafunc.parametrize(
        "bench", params, indirect=True, scope="module", ids=["/".join(each) for each in TASKS]
    )


@pytest.fixture(scope="module")
def bench(request):
    suite, task = request.param
    known = [
        row for row in rows(suite, task) if suite != "simpler-fractal" or row.variant == "base"
    ]
    made = opened(suite, task, (known[0], known[len(known) // 2], known[-1]))
    yield made
    made.scene.close()


@pytest.fixture(scope="module")
def joint():
    made = opened(*JOINT, rows(*JOINT, 3))
    yield made
    made.scene.close()


def idle(env: Env) -> np.ndarray:
    """Stay, gripper open."""
    return np.array([*[0] * (env.action_size - 1), 1], np.float32)


def up(pose: np.ndarray) -> float:
    """The cosine of how far an object leans."""
    return float(1 - 2 * (pose[4] ** 2 + pose[5] ** 2))


def test_everything_stands_still_on_the_table_alone(bench):
    env = bench.env()
    for row in bench.rows:
        env.reset(row)
        before = env.truth()
        assert {name: before.contacts.get(name) for name in before.objects_world} == dict.fromkeys(
            before.objects_world, frozenset({REST})
        )
        for place in row.placements:
            assert before.objects_world[place.model][:3] == pytest.approx(
                [place.x, place.y, 0], abs=STILL_M
            )
        for _ in range(round(env.hz)):
            env.step(idle(env))
            assert env.truth().touched == ()
        after = env.truth()
        for name, pose in before.objects_world.items():
            assert np.linalg.norm(after.objects_world[name][:3] - pose[:3]) < STILL_M, name
            assert up(pose) > UPRIGHT_COS, name
            assert up(after.objects_world[name]) > UPRIGHT_COS, name


def test_everything_is_in_view_of_every_fixed_camera_of_the_suite(bench):
    """And the Panda's wrist camera has the target in view from the start."""
    env = bench.env(224)
    for row in bench.rows:
        env.reset(row)
        seen = env.truth(masks=True).masks
        assert tuple(seen) == row.cameras == bench.suite.cameras == tuple(env.observe().images)
        assert tuple(cam.name for cam in env.cameras()) == row.cameras
        for camera, masks in seen.items():
            looked_for = (
                masks if camera != "wrist" else [row.target] * (bench.suite.robot == "panda")
            )
            assert all(masks[name].sum() >= SEEN_PX for name in looked_for), (row.key, camera)


def test_the_expert_solves_it_and_touches_the_right_thing_first(bench):
    slow = bench.task.max_steps >= 300
    for episode in rollout(bench.trial(Expert()), bench.rows[: 1 if slow else 2]):
        assert (episode.outcome.status, episode.outcome.detail[-600:]) == ("success", ""), (
            episode.header.row.key
        )
        assert episode.outcome.success_once
        assert episode.outcome.first_object_correct
        assert not episode.outcome.wrong_object
        assert episode.outcome.cmr is (None if bench.task.rule == "selected" else True)
        assert episode.outcome.steps <= bench.task.max_steps


def test_chance_does_not_solve_it(bench):
    (episode,) = rollout(bench.trial(Random()), bench.rows[-1:])
    assert (episode.outcome.status, episode.outcome.success_once) == ("failure", False)
    assert episode.outcome.steps == bench.task.max_steps


def test_chance_closes_the_gripper_as_often_as_it_opens_it(bench):
    env = bench.env()
    env.reset(bench.rows[0])
    chance = Random()
    states = [chance.start(np.random.default_rng(0))]
    opening = []
    for _ in range(2000):
        states, (chunk,) = chance.plan_from_simulation(states, [env])
        opening.append(chunk[0, -1])
    assert np.mean(opening) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.array(opening) < 0.2) > 0.3


def test_an_action_of_the_wrong_length_is_refused(bench):
    env = bench.env()
    env.reset(bench.rows[0])
    right = {"google": 7, "wx250s": 7, "panda": 8, "so101": 6}[bench.suite.robot]
    assert env.action_size == right
    kept = env.snapshot().state
    for wrong in (0, right - 1, right + 1):
        with pytest.raises(
            BadAction,
            match=f"{wrong} numbers, but {bench.suite.control} control of {bench.suite.robot} takes {right}",
        ):
            env.step(np.zeros(wrong, np.float32))
    assert (env.snapshot().state == kept).all()


def test_a_batch_equals_one_by_one(joint):
    trial = joint.trial(Expert())
    together, alone = (list(rollout(trial, joint.rows, batch=size)) for size in (3, 1))
    for one, other in zip(together, alone, strict=True):
        assert asdict(one.outcome) == asdict(other.outcome)
        for a, b in zip(one.frames, other.frames, strict=True):
            assert np.array_equal(a.action, b.action)
            assert (a.state == b.state).all()
            assert all(
                (a.truth.objects_world[name] == pose).all()
                for name, pose in b.truth.objects_world.items()
            )


def played(
    bench: Bench, row: EpisodeRow, steps: int
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """What every camera sees after so many steps of the expert, and the states and poses on the way; by then the arm is in view."""
    env, expert, states = bench.env(112), Expert(), []
    env.reset(row)
    state = expert.start(np.random.default_rng(0))
    for _ in range(steps):
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        env.step(chunk[0])
        states += [env.state(), *env.truth().objects_world.values()]
    return dict(env.observe().images), states


@pytest.fixture(scope="module")
def usual():
    """The first pick of the Google Robot under every variant; its layout is the same."""
    task = "pick-pen-holder"
    row = {
        row.variant: row for row in reversed(rows("simpler-fractal", task)) if row.episode % 75 == 0
    }
    with opened("simpler-fractal", task, (row["base"],)).scene as scene:
        made = Bench(
            BENCHMARKS["simpler-fractal"],
            BENCHMARKS["simpler-fractal"].task(task),
            (row["base"],),
            scene,
        )
        yield row, played(made, row["base"], 3)


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name != "base"])
def test_a_variant_changes_the_picture_and_not_the_physics(variant, usual):
    row, (picture, states) = usual
    made = opened("simpler-fractal", "pick-pen-holder", (row[variant],))
    with made.scene:
        other, moved = played(made, row[variant], 3)
    changed = (np.abs(other["head"].astype(int) - picture["head"]).max(axis=2) > 8).mean()
    assert changed > 0.01, f"{changed:.2%} of the picture"
    if not VARIANTS[variant].distractors:
        assert all((a == b).all() for a, b in zip(states, moved, strict=True))


FINGERPRINT = """
import hashlib
import numpy as np
from vap_core.policies.scripted.expert import Expert
from vap_core.simulation import scenes
from vap_core.simulation.env import Env
from vap_core.simulation.suites import BENCHMARKS, rows

for name, suite in BENCHMARKS.items():
    (row,) = rows(name, suite.tasks[-1].name, 1, seed=4)
    with scenes.build(suite.robot, [place.model for place in row.placements]) as scene:
        env, expert, found = Env(scene, image_size=96, control=suite.control, sensor=suite.sensor), Expert(), hashlib.sha256()
        env.reset(row)
        state = expert.start(np.random.default_rng(0))
        for _ in range(5):
            (state,), (chunk,) = expert.plan_from_simulation([state], [env])
            env.step(chunk[0])
            seen = env.observe()
            for part in (*seen.images.values(), seen.state, chunk, *env.truth().objects_world.values()):
                found.update(np.ascontiguousarray(part).tobytes())
    print(name, found.hexdigest())
"""


def test_two_processes_see_the_same_bits():
    """This one and another, whatever order their sets and dictionaries of names happen to have."""
    command = [sys.executable, "-c", FINGERPRINT]
    env = {**os.environ, "PYTHONHASHSEED": "1"}
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as process:
        here = StringIO()
        with redirect_stdout(here):
            exec(FINGERPRINT, {})
        there, _ = process.communicate(timeout=200)
    assert process.returncode == 0
    assert here.getvalue() == there
    assert [line.split()[0] for line in there.splitlines()] == list(BENCHMARKS)
