"""When an episode has succeeded, and who was moved (SPEC 6, SIMPLER's thresholds).

Pure functions over the ground truth of every step.

*Picked*: raised more than 1 cm above where it settled and touching nothing but the robot, for at
least 5 steps in a row.
*Near*: moved more than 3 cm and more than any other object, its centre within both half-diagonals
+ 10 cm of the goal's, the goal its nearest neighbour, on the table or in the gripper, and no object
dropped by 2 cm.
*Put*: its centre within the receptacle's half-diagonal (+ 3 mm) of the receptacle's, which stands
upright, its middle above the receptacle's foot, its underside no more than 2 cm above the rim,
touching the receptacle and besides it at most the robot, and what an earlier sub-goal put there.
*Selected*: pressed by the gripper for more than 10 ms, no other object touched by the robot before.
The goal of a task is no object to be confused with: touching or moving it is neither right nor
wrong, and what an earlier sub-goal put into it moves when it moves within it.
*Official*: what the environment of another library says.
*CMR* (P 5.1): the target moved more than 3 cm from where it settled, at least once, whatever the
outcome; undefined for selection.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

from vap_core.base.types import Event, value
from vap_core.simulation.types import REST, ROBOT, EpisodeRow, Outcome, Pose, SuccessRule, Truth

LIFT_M = 0.01
MOVED_M = 0.03
NEAR_M = 0.10
DROPPED_M = 0.02
OVER_M = 0.003
GAP_M = 0.02
PRESSED_S = 0.010
UPRIGHT = 0.8
STILL_M = 0.001
STILL_STEPS = 5
"""Released at the goal for STILL_STEPS, and moved less than STILL_M in the last: it may end."""
LIFTED_M = 0.05
"""A held target this high is clear of the table: the lift is done and the episode may end."""
HELD_STEPS: Mapping[SuccessRule, int] = {
    **{"picked": 5, "near": 1, "put": 1, "selected": 1, "official": 1}
}
"""Steps in a row for which a rule's condition must hold."""
Size = tuple[float, float, float]
"""Full extents of an object, metres."""
Sizes = Mapping[str, Size]
"""By model name."""
Point = tuple[float, float, float]
"""In the world, metres."""
Names = tuple[str, ...]
"""Objects in the order in which the robot touched or moved them."""


@value
class Judge:
    """What is known of one episode so far; `step` returns the next state.

    `events` are those of the last step alone. `run` counts the current unbroken run of steps in
    which the rule's condition held, `held_steps` the longest; `order` names the objects in the
    order in which the robot touched or moved them; it begins with the target, or the first object
    was not the right one. `step_m` is how far the target moved in the last step. `first` is the
    step at which it began: 0, or the end of an earlier sub-goal.
    """

    row: EpisodeRow
    sizes_m: Sizes
    start_world: Mapping[str, Pose]
    now: Truth
    steps: int = 0
    first: int = 0
    step_m: float = 0.0
    run: int = 0
    held_steps: int = 0
    success_once: bool = False
    order: tuple[str, ...] = ()
    moved: frozenset[str] = frozenset()
    events: tuple[Event, ...] = ()

    @staticmethod
    def start(row: EpisodeRow, sizes_m: Sizes, truth: Truth, first: int = 0) -> "Judge":
        """Before the first action, with everything settled, `first` steps after the episode's."""
        start_world = {}
        for place in row.placements if truth.objects_world else ():
            start_world[place.model] = truth.objects_world[place.model].copy()
        return Judge(
            row=row, sizes_m=sizes_m, start_world=start_world, now=truth, steps=first, first=first
        )

    def step(self, truth: Truth) -> "Judge":
        """The state after one more control step."""
        target = self.row.target
        moved = set(self.moved)
        for name in self.start_world:
            if self.strayed_m(name, truth) > MOVED_M:
                moved.add(name)
        order = list(self.order)
        for name in (*truth.touched, *sorted(moved)):
            if name in self.start_world and name not in (*order, self.row.goal):
                order.append(name)
        run = self.run + 1 if CONDITIONS[self.row.rule](self, truth, tuple(order)) else 0
        after = replace(
            self,
            now=truth,
            steps=self.steps + 1,
            step_m=math.dist(_middle_of(self, truth, target), _middle_of(self, self.now, target))
            if self.start_world
            else 0.0,
            run=run,
            held_steps=max(self.held_steps, run),
            success_once=self.success_once or run >= HELD_STEPS[self.row.rule],
            order=tuple(order),
            moved=frozenset(moved),
            events=(),
        )
        events = _events(self, after)
        return replace(after, events=events) if events else after

    def travel_m(self, name: str, truth: Truth | None = None) -> float:
        """How far the middle of an object is from where it settled: toppling is moving."""
        start = _middle(self.start_world[name], self.sizes_m[name])
        return math.dist(_middle_of(self, truth or self.now, name), start)

    def strayed_m(self, name: str, truth: Truth) -> float:
        """`travel_m`; of what lies in the goal already, within it: it rides along.

        What an earlier sub-goal failed to put there stands still where the goal is moved.
        """
        travel_m = self.travel_m(name, truth)
        if name not in self.row.inside:
            return travel_m
        ridden = []
        for poses in (self.start_world, truth.objects_world):
            middle, carrier = (
                _middle(poses[one], self.sizes_m[one]) for one in (name, self.row.goal)
            )
            ridden.append([a - b for a, b in zip(middle, carrier, strict=True)])
        return min(travel_m, math.dist(*ridden))

    @property
    def over(self) -> bool:
        """Whether no action is left to take: it is done, or out of time."""
        return self.done or self.steps - self.first >= self.row.max_steps

    @property
    def success(self) -> bool:
        """The rule holds now; a selection, once made, stands."""
        if self.row.rule == "selected":
            return self.success_once
        return self.run >= HELD_STEPS[self.row.rule]

    @property
    def done(self) -> bool:
        """Nothing is left to do: lifted clear of the table, released at the goal, or selected."""
        if self.row.rule == "picked":
            return self.success and _lift_m(self, self.now) > LIFTED_M
        if self.row.rule in ("selected", "official"):
            return self.success
        free = ROBOT not in self.now.contacts.get(self.row.target, ())
        return self.success and free and self.step_m < STILL_M and self.run >= STILL_STEPS

    def outcome(
        self, status: Literal["success", "failure", "error"] | None = None, detail: str = ""
    ) -> Outcome:
        """How it ended; without `status` the rule decides. An error is never a success."""
        if status is None:
            status = "success" if self.success else "failure"
        target = self.row.target
        selecting = self.row.rule == "selected"
        known = bool(self.start_world)
        others = set(self.start_world) - {target, self.row.goal}
        handled = set(self.moved)
        if selecting:
            handled.update(self.order)
        return Outcome(
            status=status,
            success=status == "success",
            success_once=self.success_once,
            held_steps=self.held_steps,
            cmr=None if selecting or not known else target in self.moved,
            wrong_object=bool(others & handled) if known else None,
            first_object_correct=self.order[:1] == (target,) if known else None,
            steps=self.steps - self.first,
            detail=detail,
            touched=bool(self.order) if known else None,
        )


def rejudge(row: EpisodeRow, sizes_m: Sizes, truths: Sequence[Truth]) -> Judge:
    """The judge at the end of a saved episode.

    `truths` are the settled start, then one truth per control step.
    """
    judge = Judge.start(row, sizes_m, truths[0])
    for truth in truths[1:]:
        judge = judge.step(truth)
    return judge


def _picked(judge: Judge, truth: Truth, order: Names) -> bool:
    return _lift_m(judge, truth) > LIFT_M and judge.row.target in truth.held


def _near(judge: Judge, truth: Truth, order: Names) -> bool:
    target = judge.row.target
    goal = judge.row.goal
    gap = _apart_m(judge, truth, target, goal)
    limit = _half_diagonal_m(judge.sizes_m[target]) + _half_diagonal_m(judge.sizes_m[goal]) + NEAR_M
    travel = judge.travel_m(target, truth)
    if not (travel > MOVED_M and gap < limit):
        return False
    for name in judge.start_world:
        dropped = judge.start_world[name][2] - truth.objects_world[name][2]
        if not dropped < DROPPED_M:
            return False
        if name != target and not travel > judge.travel_m(name, truth):
            return False
        if name not in (target, goal) and not gap < _apart_m(judge, truth, target, name):
            return False
    return bool(truth.contacts.get(target, frozenset()) & {REST, ROBOT})


def _put(judge: Judge, truth: Truth, order: Names) -> bool:
    target = judge.row.target
    goal = judge.row.goal
    partners = truth.contacts.get(target, frozenset())
    stand = truth.objects_world[goal]
    foot = _lowest_m(truth.objects_world[target], judge.sizes_m[target]) - float(stand[2])
    middle = _middle_of(judge, truth, target)
    reach = _half_diagonal_m(judge.sizes_m[goal]) + OVER_M
    return (
        goal in partners
        and partners <= {goal, ROBOT, *judge.row.inside}
        and _apart_m(judge, truth, target, goal) <= reach
        and foot <= judge.sizes_m[goal][2] + GAP_M
        and bool(middle[2] > stand[2])
        and bool(1 - 2 * (stand[4] ** 2 + stand[5] ** 2) > UPRIGHT)
    )


def _selected(judge: Judge, truth: Truth, order: Names) -> bool:
    target = judge.row.target
    clean = order[:1] == (target,) and set(judge.order) <= {target}
    return clean and truth.pressed_s.get(target, 0.0) > PRESSED_S


CONDITIONS: Mapping[SuccessRule, Callable[[Judge, Truth, Names], bool]] = {
    "picked": _picked,
    "near": _near,
    "put": _put,
    "selected": _selected,
    "official": lambda judge, truth, order: truth.succeeded,
}
"""Whether a rule's condition holds: of the judge before a step, the truth after it, and `order`."""


def _lift_m(judge: Judge, truth: Truth) -> float:
    target = judge.row.target
    return float(truth.objects_world[target][2] - judge.start_world[target][2])


def _half_diagonal_m(size: Size) -> float:
    return 0.5 * math.hypot(size[0], size[1])


def _apart_m(judge: Judge, truth: Truth, first: str, second: str) -> float:
    """Between two objects' middles (_middle), across the table."""
    return math.dist(_middle_of(judge, truth, first)[:2], _middle_of(judge, truth, second)[:2])


def _middle_of(judge: Judge, truth: Truth, name: str) -> Point:
    return _middle(truth.objects_world[name], judge.sizes_m[name])


def _middle(pose: Pose, size: Size) -> Point:
    """Half the bounding box's height above an object's origin.

    Of most objects that is the middle of the box. Of those with a handle or a strap on one side the
    origin is the centre of the body's base, and the box's middle is up to 1 cm beside it.
    """
    x, y, z, *quat = pose.tolist()
    along_x, along_y, along_z = _axis_z(*quat)
    half = 0.5 * size[2]
    return x + half * along_x, y + half * along_y, z + half * along_z


def _lowest_m(pose: Pose, size: Size) -> float:
    """The height of the lowest corner of the bounding box, were it centred on the origin."""
    w, x, y, z = pose[3:].tolist()
    norm = w * w + x * x + y * y + z * z
    slope_x = 2 * (x * z - w * y) / norm
    slope_y = 2 * (y * z + w * x) / norm
    slope_z = _axis_z(w, x, y, z)[2]
    sides = 0.5 * (abs(slope_x) * size[0] + abs(slope_y) * size[1])
    return float(pose[2]) - sides + min(0.0, slope_z * size[2])


def _axis_z(w: float, x: float, y: float, z: float) -> Point:
    """Where a rotation takes the z axis: the last column of its matrix."""
    norm = w * w + x * x + y * y + z * z
    return (
        2 * (x * z + w * y) / norm,
        2 * (y * z - w * x) / norm,
        (w * w - x * x - y * y + z * z) / norm,
    )


def _events(before: Judge, after: Judge) -> tuple[Event, ...]:
    """What happened in the last step."""
    target = after.row.target
    rule = after.row.rule
    events = []
    if after.order and not before.order:
        level = _level(after.order[0] == target)
        events.append(Event(after.steps, level, f"first object: {after.order[0]}"))
    for name in sorted(after.moved - before.moved):
        level = _level(name in (target, after.row.goal))
        events.append(Event(after.steps, level, f"moved: {name}"))
    if after.run == HELD_STEPS[rule]:
        events.append(Event(after.steps, "INFO", f"{rule}: {target}"))
    if before.run and not after.run and not after.success:
        text = f"lost after {before.run} held steps: {target}"
        events.append(Event(after.steps, "WARN", text))
    return tuple(events)


def _level(expected: bool) -> Literal["INFO", "WARN"]:
    return "INFO" if expected else "WARN"
