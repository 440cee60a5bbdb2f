"""When an episode has succeeded, and who was moved: pure functions over the ground truth of every step (SPEC 6, SIMPLER's thresholds).

*Picked*: raised more than 1 cm above where it settled and touching nothing but the robot, for at least 5 steps in a row.
*Near*: moved more than 3 cm and more than any other object, its centre within both half-diagonals + 10 cm of the goal's, the goal its
nearest neighbour, on the table or in the hand, and nobody dropped by 2 cm. *Put*: its centre within the receptacle's half-diagonal (+ 3 mm)
of the receptacle's, which stands upright, its middle above the receptacle's foot, its underside no more than 2 cm above the rim, touching
the receptacle and besides it at most the robot. *Selected*: pressed by the gripper for more than 10 ms, no other object touched by the robot before.
The goal of a task is no object to be confused with: touching or moving it is neither right nor wrong.
*CMR* (P 5.1): the target moved more than 3 cm from where it settled, at least once, whatever the outcome; undefined for selection.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import Event, value
from vap_core.simulation.types import REST, ROBOT, EpisodeRow, Outcome, Pose, SuccessRule, Truth

LIFT_M = 0.01
MOVED_M = 0.03
NEAR_M = 0.10
DROPPED_M = 0.02
OVER_M, GAP_M = 0.003, 0.02
PRESSED_S = 0.010
UPRIGHT = 0.8
STILL_M, STILL_STEPS = 0.001, 5
"""Let go, and moved less than this in the last of so many steps at the goal: the episode may end."""
LIFTED_M = 0.05
"""A held target this high is clear of the table: the lift is done and the episode may end."""
HELD_STEPS: Mapping[SuccessRule, int] = {"picked": 5, "near": 1, "put": 1, "selected": 1}
"""Steps in a row for which a rule's condition must hold."""
Sizes = Mapping[str, tuple[float, float, float]]
"""Full extents of every object, metres, by model name."""


@value
class Judge:
    """What is known of one episode so far. `step` returns the next state; `events` are those of the last step alone.

    `run` counts the current unbroken run of steps in which the rule's condition held, `held_steps` the longest; `order` names the
    objects in the order in which the robot touched or moved them (`earlier`: before the last step); it begins with the target, or the first
    object was not the right one. `step_m` is how far the target moved in the last step.
    """

    row: EpisodeRow
    sizes_m: Sizes
    start_world: Mapping[str, Pose]
    now: Truth
    steps: int = 0
    step_m: float = 0.0
    run: int = 0
    held_steps: int = 0
    success_once: bool = False
    earlier: tuple[str, ...] = ()
    order: tuple[str, ...] = ()
    moved: frozenset[str] = frozenset()
    events: tuple[Event, ...] = ()

    @staticmethod
    def start(row: EpisodeRow, sizes_m: Sizes, truth: Truth) -> "Judge":
        """Before the first action, with everything settled."""
        return Judge(
            row,
            sizes_m,
            {place.model: truth.objects_world[place.model].copy() for place in row.placements},
            truth,
        )

    def step(self, truth: Truth) -> "Judge":
        """The state after one more control step."""
        moved = self.moved | {
            name for name in self.start_world if self.travel_m(name, truth) > MOVED_M
        }
        news = [
            name
            for name in (*truth.touched, *sorted(moved))
            if name in self.start_world and name not in (*self.order, self.row.goal)
        ]
        after = replace(
            self, now=truth, steps=self.steps + 1, step_m=_distance(self, self.row.target, truth), earlier=self.order,
            order=(*self.order, *dict.fromkeys(news)), moved=moved, events=(),
        )  # fmt: skip
        run = self.run + 1 if CONDITIONS[self.row.rule](after) else 0
        after = replace(
            after,
            run=run,
            held_steps=max(self.held_steps, run),
            success_once=self.success_once or run >= HELD_STEPS[self.row.rule],
        )
        return replace(after, events=_news(self, after))

    def travel_m(self, name: str, truth: Truth | None = None) -> float:
        """How far the middle of an object is from where it settled: toppling is moving."""
        middle = _box(truth or self.now, self.sizes_m, name).mean(axis=0)
        return float(
            np.linalg.norm(
                middle - _corners(self.start_world[name], self.sizes_m[name]).mean(axis=0)
            )
        )

    @property
    def success(self) -> bool:
        """The rule holds now; a selection, once made, stands."""
        return (
            self.success_once
            if self.row.rule == "selected"
            else self.run >= HELD_STEPS[self.row.rule]
        )

    @property
    def done(self) -> bool:
        """Nothing is left to do: lifted clear of the table, let go at the goal, or selected."""
        if self.row.rule == "picked":
            return self.success and _lift_m(self) > LIFTED_M
        if self.row.rule == "selected":
            return self.success
        free = ROBOT not in self.now.contacts.get(self.row.target, ())
        return self.success and free and self.step_m < STILL_M and self.run >= STILL_STEPS

    def outcome(
        self, status: Literal["success", "failure", "error"] | None = None, detail: str = ""
    ) -> Outcome:
        """How it ended; without `status` the rule decides. An error is never a success."""
        if status is None:
            status = "success" if self.success else "failure"
        target, selecting = self.row.target, self.row.rule == "selected"
        others = set(self.start_world) - {target, self.row.goal}
        return Outcome(
            status=status,
            success=status == "success",
            success_once=self.success_once,
            held_steps=self.held_steps,
            cmr=None if selecting else target in self.moved,
            wrong_object=bool(others & (self.moved | set(self.order if selecting else ()))),
            first_object_correct=self.order[:1] == (target,),
            steps=self.steps,
            detail=detail,
            touched=bool(self.order),
        )


def rejudge(row: EpisodeRow, sizes_m: Sizes, truths: Sequence[Truth]) -> Judge:
    """The judge's last word over a saved episode: the settled start, then one truth per control step."""
    judge = Judge.start(row, sizes_m, truths[0])
    for truth in truths[1:]:
        judge = judge.step(truth)
    return judge


def _picked(judge: Judge) -> bool:
    return _lift_m(judge) > LIFT_M and judge.row.target in judge.now.held


def _near(judge: Judge) -> bool:
    target, goal = judge.row.target, judge.row.goal
    others = [name for name in judge.start_world if name not in (target, goal)]
    gap = _apart_m(judge, target, goal)
    limit = _half_diagonal_m(judge.sizes_m[target]) + _half_diagonal_m(judge.sizes_m[goal]) + NEAR_M
    return (
        judge.travel_m(target) > max(MOVED_M, *(judge.travel_m(name) for name in (*others, goal)))
        and gap < limit
        and all(gap < _apart_m(judge, target, name) for name in others)
        and all(
            judge.start_world[name][2] - judge.now.objects_world[name][2] < DROPPED_M
            for name in judge.start_world
        )
        and bool(judge.now.contacts.get(target, frozenset()) & {REST, ROBOT})
    )


def _put(judge: Judge) -> bool:
    target, goal = judge.row.target, judge.row.goal
    partners = judge.now.contacts.get(target, frozenset())
    stand = judge.now.objects_world[goal]
    box = _box(judge.now, judge.sizes_m, target)
    foot = float(box[:, 2].min() - stand[2])
    return (
        goal in partners
        and partners <= {goal, ROBOT}
        and _apart_m(judge, target, goal) <= _half_diagonal_m(judge.sizes_m[goal]) + OVER_M
        and foot <= judge.sizes_m[goal][2] + GAP_M
        and bool(box[:, 2].mean() > stand[2])
        and bool(1 - 2 * (stand[4] ** 2 + stand[5] ** 2) > UPRIGHT)
    )


def _selected(judge: Judge) -> bool:
    target = judge.row.target
    clean = judge.order[:1] == (target,) and set(judge.earlier) <= {target}
    return clean and judge.now.pressed_s.get(target, 0.0) > PRESSED_S


CONDITIONS: Mapping[SuccessRule, Callable[[Judge], bool]] = {
    "picked": _picked,
    "near": _near,
    "put": _put,
    "selected": _selected,
}


def _lift_m(judge: Judge) -> float:
    return float(
        judge.now.objects_world[judge.row.target][2] - judge.start_world[judge.row.target][2]
    )


def _half_diagonal_m(size: tuple[float, float, float]) -> float:
    return 0.5 * float(np.hypot(size[0], size[1]))


def _apart_m(judge: Judge, one: str, other: str) -> float:
    """Between two objects' centres, across the table."""
    middle = [_box(judge.now, judge.sizes_m, name).mean(axis=0) for name in (one, other)]
    return float(np.linalg.norm((middle[0] - middle[1])[:2]))


def _distance(judge: Judge, name: str, truth: Truth) -> float:
    """How far the middle of an object is from where it was a step ago."""
    return float(
        np.linalg.norm(
            (_box(truth, judge.sizes_m, name) - _box(judge.now, judge.sizes_m, name)).mean(axis=0)
        )
    )


def _box(truth: Truth, sizes_m: Sizes, name: str) -> Float64[np.ndarray, "8 3"]:
    return _corners(truth.objects_world[name], sizes_m[name])


def _corners(pose: Pose, size: tuple[float, float, float]) -> Float64[np.ndarray, "8 3"]:
    """The bounding box's corners in the world; an object's origin is the centre of its base."""
    from scipy.spatial.transform import Rotation

    x, y, z = size
    local = np.array(
        [(i * x / 2, j * y / 2, k * z) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)]
    )
    return Rotation.from_quat(pose[3:], scalar_first=True).apply(local) + pose[:3]


def _news(before: Judge, after: Judge) -> tuple[Event, ...]:
    target, at, rule = after.row.target, after.steps, after.row.rule
    fine: Mapping[bool, Literal["INFO", "WARN"]] = {True: "INFO", False: "WARN"}
    first = (
        [Event(at, fine[after.order[0] == target], f"first object: {after.order[0]}")]
        if after.order and not before.order
        else []
    )
    moved = [
        Event(at, fine[name in (target, after.row.goal)], f"moved: {name}")
        for name in sorted(after.moved - before.moved)
    ]
    met = [Event(at, "INFO", f"{rule}: {target}")] if after.run == HELD_STEPS[rule] else []
    lost = (
        [Event(at, "WARN", f"lost after {before.run} held steps: {target}")]
        if before.run and not after.run and not after.success
        else []
    )
    return (*first, *moved, *met, *lost)
