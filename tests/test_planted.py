"""Failures planted in the real simulator, ten of each kind in the sweeps and two every day, are told apart: wrong prompts by hand-made masks, failed hands by hand-made policies."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.toys import TOYS, personal
from vap_core.attend import Attender, AttendState
from vap_core.base.errors import OutOfReach
from vap_core.base.types import Attended
from vap_core.policies.protocol import Chunk
from vap_core.policies.scripted.expert import (
    Expert,
    ExpertState,
    Waypoint,
    _clear_pose,
    _raised_within_reach,
    _reached,
    _step_towards,
)
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import Masks, Oracle, OraclePrompter, PromptContext
from vap_core.rollout.types import Diagnosis
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene, build
from vap_core.simulation.types import Action, EpisodeRow, Observation
from vap_core.study.diagnosis import diagnose

N = 10
Plant = Callable[[int, EpisodeRow, Masks], Masks]
"""Step, row, true masks -> the masks that the prompts are made from."""


class Planted(OraclePrompter):
    """Prompts by masks that somebody has tampered with."""

    def __init__(self, plant: Plant, mine: str, category: str, alike: frozenset[str]) -> None:
        super().__init__(
            Attender(TOYS, {mine: personal(mine, category, (90, 90, 90))}), Oracle("track"), alike
        )
        self.plant = plant

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        return super().start(observation, self.tampered(0, context))

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        planted = [
            self.tampered(state.frame_index + 1, context)
            for state, context in zip(states, contexts, strict=True)
        ]
        return super().steps(states, observations, planted)

    def tampered(self, step: int, context: PromptContext) -> PromptContext:
        truth = context.truth
        assert truth is not None
        masks = self.plant(step, truth.row, truth.masks)
        return replace(context, truth=replace(truth, masks=masks))


def true(step: int, row: EpisodeRow, masks: Masks) -> Masks:
    return masks


def rival(row: EpisodeRow) -> str:
    """Its first look-alike."""
    return next(
        place.model
        for place in row.placements[1:]
        if get_object(place.model).category == row.category
    )


def swapped(masks: Masks, row: EpisodeRow, cameras: Sequence[str]) -> Masks:
    """In some views the target and its first look-alike have changed places."""
    one, other = row.target, rival(row)
    return {c: {**m, one: m[other], other: m[one]} if c in cameras else m for c, m in masks.items()}


def rolled(step: int, row: EpisodeRow, masks: Masks) -> Masks:
    return {
        c: {name: np.roll(mask, (23, 41), axis=(0, 1)) for name, mask in m.items()}
        for c, m in masks.items()
    }


class Still:
    """Does nothing, with an open hand."""

    label, execute = "still", 1

    def start(self, rng: np.random.Generator) -> ExpertState:
        self.rng = rng
        return ExpertState()

    def plan_from_simulation(
        self, states: Sequence[ExpertState], envs: Sequence[Env]
    ) -> tuple[list[ExpertState], list[Chunk]]:
        told = [self.act(state, env) for state, env in zip(states, envs, strict=True)]
        return [state for state, _ in told], [action[None] for _, action in told]

    def act(self, state: ExpertState, env: Env) -> tuple[ExpertState, Action]:
        return state, np.array([0.0] * (env.action_size - 1) + [1.0], np.float32)


class Plans(Still, ABC):
    """Goes along waypoints, then stays there."""

    @abstractmethod
    def plan(self, env: Env) -> tuple[Waypoint, ...]: ...

    def act(self, state: ExpertState, env: Env) -> tuple[ExpertState, Action]:
        plan = state.plan or (self.plan(env) if state.phase == "grasp" else ())
        if len(plan) > 1 and _reached(plan[0], env, state.waited_s):
            plan, waited = plan[1:], 0.0
        else:
            waited = state.waited_s + 0.2 / env.hz
        return ExpertState("planned", plan, waited), _step_towards(plan[0], env)


class Misses(Plans):
    def plan(self, env: Env) -> tuple[Waypoint, ...]:
        over, low, *_ = Expert().start_with_miss(env, np.random.default_rng(env.row.episode)).plan
        return over, replace(low, gripper=1.0), replace(low, gripper=0.0, stay_s=1.0)


class Knocks(Plans):
    """Sweeps through the look-alike and back with a closed hand, then lays that hand on the target."""

    def plan(self, env: Env) -> tuple[Waypoint, ...]:
        truth = env.truth()
        low = Expert().plan_from_simulation([ExpertState()], [env])[0][0].plan[1].tcp_base
        away = truth.objects_world[rival(env.row)][:2] - truth.objects_world[env.row.target][:2]
        side = np.array([-away[1], away[0], 0.0]) / np.linalg.norm(away)
        at = low.copy()
        at[:2, 3] += away
        before, after = at.copy(), at.copy()
        before[:3, 3] -= 0.07 * side
        after[:3, 3] += 0.06 * side
        top = low.copy()
        top[2, 3] += 0.03
        path = [
            _clear_pose(env, truth, before),
            before,
            after,
            before,
            _clear_pose(env, truth, before),
            _clear_pose(env, truth, low),
            top,
        ]
        return tuple(Waypoint(pose, 0.0) for pose in path)


class Drops(Still, ABC):
    """Lifts the target, and then does something else."""

    def act(self, state: ExpertState, env: Env) -> tuple[ExpertState, Action]:
        if state.phase == "dropped":
            return state, self.after(env)
        if (
            env.row.target in env.truth().held
            and env.truth().objects_world[env.row.target][2] > 0.03
        ):
            self.drop(env)
            return ExpertState("dropped"), self.after(env)
        (state,), (chunk,) = Expert().plan_from_simulation([state], [env])
        return state, chunk[0]

    def drop(self, env: Env) -> None:
        """What is done to the world then; nothing, unless said otherwise."""
        return

    @abstractmethod
    def after(self, env: Env) -> Action: ...


class Slips(Drops):
    """The target turns to ice; the hand stays closed."""

    def drop(self, env: Env) -> None:
        model = env.scene.model
        geoms = model.body_rootid[model.geom_bodyid] == model.body(env.row.target).id
        model.geom_priority[geoms] = 9
        model.geom_friction[geoms] = 1e-5

    def after(self, env: Env) -> Action:
        up = Waypoint(_raised_within_reach(env, env.command.tcp_base, 0.02), 0.0)
        return _step_towards(up, env)


class LetsGo(Drops):
    def after(self, env: Env) -> Action:
        return np.array([0.0] * (env.action_size - 1) + [1.0], np.float32)


@pytest.fixture(scope="module")
def world() -> Iterator[Callable[[str, str], tuple[Scene, tuple[EpisodeRow, ...]]]]:
    """Scene and first rows of a task, the scene built once and closed in the end."""
    scenes: dict[tuple[str, str], Scene] = {}

    def of(suite: str, task: str) -> tuple[Scene, tuple[EpisodeRow, ...]]:
        rows = suites.rows(suite, task, n=3 * N)
        if (suite, task) not in scenes:
            names = tuple(dict.fromkeys(place.model for row in rows for place in row.placements))
            scenes[suite, task] = build(suites.suite(suite).robot, names)
        return scenes[suite, task], rows

    yield of
    for scene in scenes.values():
        scene.close()


def failures(
    scene: Scene,
    rows: Sequence[EpisodeRow],
    plant: Plant,
    policy: Still,
    steps: int,
    n: int,
) -> list[Diagnosis]:
    """Diagnoses of the first n rows in which the plant took: in which the hand could do what it was to do, and failed."""
    suite, found = suites.suite(rows[0].suite), []
    alike = frozenset(
        name for name in scene.objects if get_object(name).category == rows[0].category
    )
    planted = Planted(plant, rows[0].target, rows[0].category, alike)
    trial = Trial(
        method="planted",
        scene=scene,
        policy=policy,
        prompter=planted,
        control=suite.control,
        images_every=2,
    )
    friction, priority = scene.model.geom_friction.copy(), scene.model.geom_priority.copy()
    for row in rows:
        (episode,) = rollout(trial, [replace(row, max_steps=steps)], batch=1)
        scene.model.geom_friction[:], scene.model.geom_priority[:] = friction, priority
        if episode.outcome.status == "error":
            assert OutOfReach.__name__ in episode.outcome.detail, episode.outcome.detail
            continue
        assert not episode.outcome.success
        diagnosis = diagnose(episode)
        assert diagnosis is not None
        found.append(diagnosis)
        if len(found) == n:
            return found
    raise AssertionError(f"only {len(found)} planted")


BRIDGE = ("simpler-bridge", "put-owl-figurine")
FIRST = "no proposal", "shifted proposal", "distractor vote", "drift"
often = pytest.mark.parametrize("n", [2, pytest.param(N, marks=pytest.mark.sweep)])


@often
@pytest.mark.parametrize("kind", FIRST)
def test_case_1(world, kind, n):  # type: ignore[no-untyped-def]
    scene, rows = world(*BRIDGE)
    plants: dict[str, Plant] = {
        "no proposal": lambda step, row, masks: {camera: {} for camera in masks},
        "shifted proposal": rolled,
        "distractor vote": lambda step, row, masks: swapped(masks, row, list(masks)),
        "drift": lambda step, row, masks: swapped(masks, row, list(masks) if step >= 2 else ()),
    }
    found = failures(scene, rows, plants[kind], Still(), 8, n)
    assert [(each.case, each.sub_case) for each in found] == [("case 1", kind)] * n
    assert {each.frame_index for each in found} == {4 if kind == "drift" else 0}, (
        "images are taken every other step"
    )


@often
@pytest.mark.parametrize(("since", "kind"), [(0, "views disagree"), (2, "views drift apart")])
def test_case_2(world, since, kind, n):  # type: ignore[no-untyped-def]
    scene, rows = world("vlabench", "select-shoe")
    astray = rows[0].cameras[1]
    found = failures(
        scene,
        rows,
        lambda step, row, masks: swapped(masks, row, [astray] if step >= since else ()),
        Still(),
        8,
        n,
    )
    assert [(each.case, each.sub_case, each.camera, each.frame_index) for each in found] == [
        ("case 2", kind, astray, 2 * since)
    ] * n


HANDS = {
    "timeout": (Still(), 6),
    "missed grasp": (Misses(), 22),
    "collision": (Knocks(), 48),
    "slip": (Slips(), 34),
    "misplacement": (LetsGo(), 34),
}
"""Policies that fail at the object, and the steps that they are given."""


@often
@pytest.mark.parametrize("kind", HANDS)
def test_case_3(world, kind, n):  # type: ignore[no-untyped-def]
    scene, rows = world(*BRIDGE)
    policy, steps = HANDS[kind]
    found = failures(scene, rows, true, policy, steps, n)
    assert [(each.case, each.sub_case) for each in found] == [("case 3", kind)] * n, "\n".join(
        each.sentence for each in found
    )
