"""Scenes that two people share: two objects in turn, and two at once (P multi-user, multi-object).

Anna speaks. Her objects are the personal instances; her brother Ben's is the look-alike that the
encoder takes most for Anna's (data/results/lookalike_hardness.parquet, greatest mean cosine), so
that every target stands beside its hardest look-alike. Carla's things are personal instances of
their own categories.

`shared-sequence` (the SO-101's desk) and `shared-sequence-bridge` (WidowX): two sub-goals in order.
Of one category: both owners' objects and one more look-alike. Of two: both owners' objects, and
beside each its hardest look-alike. The paper has two distractors for each target. `shared-pair`
(the desk): one instruction with two targets, and the hardest look-alike of each. Four of its five
instructions are the paper's; the paper's plushie is a plant, because the SO-101 twin often drops
ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from vap_core.base.types import value
from vap_core.instruction.expressions import decompose
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import benchmarks
from vap_core.simulation.suites.layout import (
    Spot,
    draw_lookalikes,
    place,
    place_at_random_yaws,
    radius_m,
    random_yaw,
    scatter,
)
from vap_core.simulation.suites.rules import NEAR_M
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import EpisodeRow, Owned, Placement, SubGoal, SuccessRule

SPEAKER = "anna"
HARDEST = {
    "camera": "camera-lookalike-5",
    "owl-figurine": "owl-figurine-lookalike-2",
    "straw-cup": "straw-cup-lookalike-2",
    "vase": "vase-lookalike-5",
    "plant": "plant-lookalike-3",
    "cup": "cup-lookalike-2",
    "scrubber": "scrubber-lookalike-1",
    "stuffed-toy": "stuffed-toy-lookalike-1",
    "pouch": "pouch-lookalike-1",
    "slipper": "slipper-lookalike-1",
}
"""The look-alike of greatest mean cosine with the personal instance's photos, by stem."""
BOWL = benchmarks.BOWL
PLATE = "plate-prop"
BASKET = "basket-prop"
EPISODES = 20
BRIDGE_EPISODES = 24
GAP_M = 0.03
TOUCH_GAP_M = 0.05
"""Between objects of which two are touched in turn: the hand comes down twice."""
APART_M = 0.02
"""How far outside the near rule's limit a pair's target starts, and its look-alike."""
BESIDE_M = (0.03, 0.045)
"""Room between a pair's two targets once one is put near the other."""
PITCH_M = 0.15
"""Of the grid on the WidowX's table: simpler-bridge's square, with one more column."""
REDRAWN: Mapping[str, Mapping[int, int]] = {
    "select-vases": {15: 1},
    "put-plant-scrubber": {5: 1, 11: 1, 13: 1, 14: 1},
    "put-pouch-near-vase": {2: 1, 14: 1, 17: 1},
    "put-scrubber-near-slipper": {16: 1},
    "move-stuffed-toy-next-to-plant": {6: 1},
    "put-pouch-near-cup": {3: 1, 18: 1, 19: 1},
}
"""The draw of a layout, by task and episode, where the first was beyond the scripted expert.

Drawn again until the expert succeeds with seed 0, before any method ran on the list.
"""


@value
class Step:
    """One step of a task: whose object of which kind, what is done with it, and for how long."""

    stem: str
    owner: str
    rule: SuccessRule
    max_steps: int
    goal: str = ""

    @property
    def model(self) -> str:
        return HARDEST[self.stem] if self.owner == "ben" else f"{self.stem}-personal"

    @property
    def category(self) -> str:
        return objects.get_object(self.model).category


@value
class Shared:
    """A task in a shared scene: an instruction, and its steps in order.

    `owner_of_goal` is whose the second target of a pair is, "" where the goal is no one's.
    """

    name: str
    instruction: str
    steps: tuple[Step, ...]
    owner_of_goal: str = ""

    @property
    def task(self) -> Task:
        first = self.steps[0]
        return Task(
            name=self.name,
            category=first.category,
            instruction=self.instruction,
            max_steps=sum(step.max_steps for step in self.steps),
            rule=first.rule,
            goal=first.goal,
            slug=first.stem,
        )

    @property
    def owned(self) -> tuple[Owned, ...]:
        """The remembered objects: every step's, and a pair's second target."""
        found = [_owned(step.model, step.owner) for step in self.steps]
        if self.owner_of_goal:
            found.append(_owned(self.steps[0].goal, self.owner_of_goal))
        return tuple(found)

    @property
    def subgoals(self) -> tuple[SubGoal, ...]:
        """One for each step, with its command; none where there is a single step."""
        if len(self.steps) == 1:
            return ()
        found = []
        for step, command in zip(self.steps, decompose(self.instruction), strict=True):
            found.append(
                SubGoal(
                    instruction=command,
                    category=step.category,
                    target=step.model,
                    max_steps=step.max_steps,
                    rule=step.rule,
                    goal=step.goal,
                )
            )
        return tuple(found)


BRIDGE_TASKS = (
    Shared(
        "put-cameras",
        "put my brother's camera on the plate, then put my camera in the basket",
        (
            Step("camera", "ben", "put", 60, PLATE),
            Step("camera", SPEAKER, "put", 60, BASKET),
        ),
    ),
    Shared(
        "put-owl-figurines",
        "put my brother's owl figurine on the plate, then my owl figurine in the basket",
        (
            Step("owl-figurine", "ben", "put", 60, PLATE),
            Step("owl-figurine", SPEAKER, "put", 60, BASKET),
        ),
    ),
    Shared(
        "put-camera-straw-cup",
        "put my brother's camera on the plate, and then put my straw cup in the basket",
        (
            Step("camera", "ben", "put", 60, PLATE),
            Step("straw-cup", SPEAKER, "put", 120, BASKET),
        ),
    ),
)
DESK_TASKS = (
    Shared(
        "select-vases",
        "select my brother's vase, then my vase",
        (Step("vase", "ben", "selected", 150), Step("vase", SPEAKER, "selected", 150)),
    ),
    Shared(
        "select-cup-put-plant",
        "select my brother's cup, then put my plant into the plastic bowl",
        (Step("cup", "ben", "selected", 150), Step("plant", SPEAKER, "put", 300, BOWL)),
    ),
    Shared(
        "put-plant-scrubber",
        "put my brother's plant into the plastic bowl, then my scrubber",
        (
            Step("plant", "ben", "put", 300, BOWL),
            Step("scrubber", SPEAKER, "put", 300, BOWL),
        ),
    ),
)


def _pair(name: str, instruction: str, stem: str, other: str, owner: str = SPEAKER) -> Shared:
    step = Step(stem, SPEAKER, "near", 300, f"{other}-personal")
    return Shared(name, instruction, (step,), owner_of_goal=owner)


PAIR_TASKS = (
    _pair("put-pouch-near-vase", "put my pouch near her vase", "pouch", "vase", "carla"),
    _pair("move-plant-next-to-cup", "move my plant next to my cup", "plant", "cup"),
    _pair(
        "put-scrubber-near-slipper",
        "put my scrubber near her slipper",
        "scrubber",
        "slipper",
        "carla",
    ),
    _pair(
        "move-stuffed-toy-next-to-plant",
        "move my stuffed toy next to my plant",
        "stuffed-toy",
        "plant",
    ),
    _pair("put-pouch-near-cup", "put my pouch near my cup", "pouch", "cup"),
)
TASKS = {
    "shared-sequence": DESK_TASKS,
    "shared-sequence-bridge": BRIDGE_TASKS,
    "shared-pair": PAIR_TASKS,
}


def _suite(name: str, like: Suite) -> Suite:
    return replace(like, name=name, tasks=tuple(shared.task for shared in TASKS[name]))


SUITES = {
    "shared-sequence": _suite("shared-sequence", benchmarks.TABLETOP),
    "shared-sequence-bridge": _suite("shared-sequence-bridge", benchmarks.BRIDGE),
    "shared-pair": _suite("shared-pair", benchmarks.TABLETOP),
}
LIKE = {
    "shared-sequence": "tabletop",
    "shared-sequence-bridge": "simpler-bridge",
    "shared-pair": "tabletop",
}
"""The benchmark whose robot, cameras and frozen policy a shared suite has."""


def rows(name: str) -> tuple[EpisodeRow, ...]:
    """The whole list of a shared suite."""
    episodes = BRIDGE_EPISODES if LIKE[name] == "simpler-bridge" else EPISODES
    listed = []
    for shared in TASKS[name]:
        for episode in range(episodes):
            listed.append(row(name, shared, episode))
    return tuple(listed)


def row(name: str, shared: Shared, episode: int) -> EpisodeRow:
    """One episode of a task of a shared suite; it depends on no other."""
    seed = [91, *f"{name} {shared.name}".encode(), episode]
    again = REDRAWN.get(shared.name, {}).get(episode, 0)
    rng = np.random.default_rng([*seed, again] if again else seed)
    if LIKE[name] == "simpler-bridge":
        placements = _on_grid(shared, rng, episode)
    else:
        placements = _on_desk(shared, rng)
    plain = SUITES[name].row(shared.task, episode, placements)
    return replace(plain, speaker=SPEAKER, owned=shared.owned, subgoals=shared.subgoals)


def _owned(model: str, owner: str) -> Owned:
    return Owned(model, owner, ("anna's brother",) if owner == "ben" else ())


def _models(shared: Shared, rng: np.random.Generator) -> list[str]:
    """What stands on the table besides receptacles, the first target first."""
    targets = [owned.model for owned in shared.owned]
    stems = [step.stem for step in shared.steps]
    if shared.owner_of_goal:
        stems.append(shared.steps[0].goal.removesuffix("-personal"))
    if len(stems) == 2 and stems[0] == stems[1]:
        drawn = draw_lookalikes(rng, stems[0], 6)
        return [*targets, next(name for name in drawn if name not in targets)]
    beside = []
    for stem, target in zip(stems, targets, strict=True):
        personal = f"{stem}-personal"
        beside.append(HARDEST[stem] if target == personal else personal)
    return [*targets, *beside]


def _on_grid(shared: Shared, rng: np.random.Generator, episode: int) -> tuple[Placement, ...]:
    """On a 2 x 3 grid; every ordered pair of its places has the two targets in turn."""
    models = _models(shared, rng)
    spots: list[Spot] = []
    for i in (-0.5, 0.5):
        for j in (-1, 0, 1):
            spots.append((benchmarks.CENTRE[0] + PITCH_M * i, benchmarks.CENTRE[1] + PITCH_M * j))
    order = np.random.default_rng([92, *shared.name.encode()]).permutation(30)
    pairs = list(permutations(range(6), 2))
    taken = list(pairs[int(order[episode])])
    rest = [i for i in rng.permutation(6).tolist() if i not in taken]
    placements = []
    for model, i in zip(models, [*taken, *rest], strict=False):
        placements.append(place(model, spots[i], random_yaw(rng)))
    free = rest[len(models) - 2 :]
    return tuple(_with_goals(placements, [PLATE, BASKET], [spots[i] for i in free]))


def _on_desk(shared: Shared, rng: np.random.Generator) -> tuple[Placement, ...]:
    """On the SO-101's desk, beside the bowl where a step needs it.

    What is grasped, and its look-alikes, stand within the arm's reach; everything else anywhere.
    """
    models = _models(shared, rng)
    bowl = benchmarks.BOWLS[int(rng.integers(2))]
    has_bowl = any(step.goal == BOWL for step in shared.steps)
    fixed = [(bowl, radius_m(BOWL) / np.sqrt(2))] if has_bowl else []
    grasped = {step.category for step in shared.steps if step.rule != "selected"}
    within = [name for name in models if objects.get_object(name).category in grasped]
    gap_m = GAP_M if grasped else TOUCH_GAP_M
    pair = None
    if shared.owner_of_goal:
        step = shared.steps[0]
        pair = (step.model, step.goal, HARDEST[step.stem])
    while True:
        spots = try_desk(models, within, fixed=fixed, gap_m=gap_m, pair=pair, rng=rng)
        if spots is not None:
            break
    placements = place_at_random_yaws(rng, models, [spots[model] for model in models])
    return tuple(_with_goals(placements, [BOWL], [bowl]) if has_bowl else placements)


def try_desk(
    models: Sequence[str],
    within: Sequence[str],
    *,
    fixed: Sequence[tuple[Spot, float]] = (),
    gap_m: float = GAP_M,
    pair: tuple[str, str, str] | None = None,
    rng: np.random.Generator,
) -> dict[str, Spot] | None:
    """A spot on the SO-101's desk for every model, those `within` the arm's reach.

    `pair` is a target that is put near a goal, the goal, and the target's look-alike. None where
    they do not fit, or where the goal leaves no room beside it.
    """
    spots: dict[str, Spot] = {}
    taken = list(fixed)
    rest = [name for name in models if name not in within]
    for area, names in ((benchmarks.REACH, within), (benchmarks.TABLETOP_TABLE, rest)):
        radii = list(map(radius_m, names))
        try:
            drawn = scatter(rng, area, radii, fixed=taken, gap_m=gap_m, tries=20)
        except ValueError:
            return None
        spots |= zip(names, drawn, strict=True)
        taken += zip(drawn, radii, strict=True)
    if pair is not None and not _has_room(*pair, spots):
        return None
    return spots


def _has_room(target: str, goal: str, lookalike: str, spots: Mapping[str, Spot]) -> bool:
    """Whether a target can be put beside its goal, within reach, nearer to it than to the rest.

    Neither it nor its look-alike is near the goal at the start.
    """
    here = np.array(spots[goal])
    limit = radius_m(target) + radius_m(goal) + NEAR_M
    for name in (target, lookalike):
        if np.hypot(*(here - spots[name])) < limit + APART_M:
            return False
    others = [name for name in spots if name not in (target, goal)]
    for beside in BESIDE_M:
        distance = radius_m(target) + radius_m(goal) + beside
        for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
            x, y = here + distance * np.array([np.cos(angle), np.sin(angle)])
            reach = benchmarks.REACH
            if not (reach.x0 < x < reach.x1 and reach.y0 < y < reach.y1):
                continue
            gaps = [np.hypot(x - spots[name][0], y - spots[name][1]) for name in others]
            widest = max(map(radius_m, others)) + radius_m(target) + GAP_M
            if min(gaps) > max(distance + 0.02, widest):
                return True
    return False


def _with_goals(
    placements: Sequence[Placement], goals: Sequence[str], spots: Sequence[Spot]
) -> list[Placement]:
    """The first target, the receptacles, and everything else."""
    standing = [place(goal, spot, 0.0) for goal, spot in zip(goals, spots, strict=False)]
    return [placements[0], *standing, *placements[1:]]
