"""The lists of the scenes that two people share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from vap_core.simulation.assets import objects
from vap_core.simulation.suites import shared
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
from vap_core.simulation.types import EpisodeRow, Placement
from vap_make.lists import benchmarks

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


def rows(name: str) -> tuple[EpisodeRow, ...]:
    """The whole list of a shared suite."""
    episodes = BRIDGE_EPISODES if shared.LIKE[name] == "simpler-bridge" else EPISODES
    listed = []
    for scene in shared.TASKS[name]:
        for episode in range(episodes):
            listed.append(row(name, scene, episode))
    return tuple(listed)


def row(name: str, scene: shared.Shared, episode: int) -> EpisodeRow:
    """One episode of a task of a shared suite; it depends on no other."""
    seed = [91, *f"{name} {scene.name}".encode(), episode]
    again = REDRAWN.get(scene.name, {}).get(episode, 0)
    rng = np.random.default_rng([*seed, again] if again else seed)
    if shared.LIKE[name] == "simpler-bridge":
        placements = _on_grid(scene, rng, episode)
    else:
        placements = _on_desk(scene, rng)
    plain = shared.SUITES[name].row(scene.task, episode, placements)
    return replace(plain, speaker=shared.SPEAKER, owned=scene.owned, subgoals=scene.subgoals)


def _models(scene: shared.Shared, rng: np.random.Generator) -> list[str]:
    """What stands on the table besides receptacles, the first target first."""
    targets = [owned.model for owned in scene.owned]
    stems = [step.stem for step in scene.steps]
    if scene.owner_of_goal:
        stems.append(scene.steps[0].goal.removesuffix("-personal"))
    if len(stems) == 2 and stems[0] == stems[1]:
        drawn = draw_lookalikes(rng, stems[0], 6)
        return [*targets, next(name for name in drawn if name not in targets)]
    beside = []
    for stem, target in zip(stems, targets, strict=True):
        personal = f"{stem}-personal"
        beside.append(shared.hardest(stem)[0] if target == personal else personal)
    return [*targets, *beside]


def _on_grid(scene: shared.Shared, rng: np.random.Generator, episode: int) -> tuple[Placement, ...]:
    """On a 2 x 3 grid; every ordered pair of its places has the two targets in turn."""
    models = _models(scene, rng)
    spots: list[Spot] = []
    for i in (-0.5, 0.5):
        for j in (-1, 0, 1):
            spots.append((benchmarks.CENTRE[0] + PITCH_M * i, benchmarks.CENTRE[1] + PITCH_M * j))
    order = np.random.default_rng([92, *scene.name.encode()]).permutation(30)
    pairs = list(permutations(range(6), 2))
    taken = list(pairs[int(order[episode])])
    rest = [i for i in rng.permutation(6).tolist() if i not in taken]
    placements = []
    for model, i in zip(models, [*taken, *rest], strict=False):
        placements.append(place(model, spots[i], random_yaw(rng)))
    free = rest[len(models) - 2 :]
    return tuple(_with_goals(placements, [shared.PLATE, shared.BASKET], [spots[i] for i in free]))


def _on_desk(scene: shared.Shared, rng: np.random.Generator) -> tuple[Placement, ...]:
    """On the SO-101's desk, beside the bowl where a step needs it.

    What is grasped, and its look-alikes, stand within the arm's reach; everything else anywhere.
    """
    models = _models(scene, rng)
    bowl = benchmarks.BOWLS[int(rng.integers(2))]
    has_bowl = any(step.goal == shared.BOWL for step in scene.steps)
    fixed = [(bowl, radius_m(shared.BOWL) / np.sqrt(2))] if has_bowl else []
    grasped = {step.category for step in scene.steps if step.rule != "selected"}
    within = [name for name in models if objects.get_object(name).category in grasped]
    gap_m = GAP_M if grasped else TOUCH_GAP_M
    pair = None
    if scene.owner_of_goal:
        step = scene.steps[0]
        pair = (step.model, step.goal, shared.hardest(step.stem)[0])
    while True:
        spots = try_desk(models, within, fixed=fixed, gap_m=gap_m, pair=pair, rng=rng)
        if spots is not None:
            break
    placements = place_at_random_yaws(rng, models, [spots[model] for model in models])
    return tuple(_with_goals(placements, [shared.BOWL], [bowl]) if has_bowl else placements)


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
