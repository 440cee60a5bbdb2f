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

from dataclasses import replace

from vap_core.base.types import value
from vap_core.instruction.expressions import decompose
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import benchmarks
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import Owned, SubGoal, SuccessRule

SPEAKER = "anna"
HARDEST = {
    "bottle": "34",
    "camera": "53",
    "cat-figurine": "31",
    "cup": "21",
    "leather-bag": "12",
    "miniature-house": "13",
    "owl-figurine": "24",
    "paper-cup": "21",
    "pen-holder": "34",
    "plant": "32",
    "plushie": "14",
    "pouch": "12",
    "scrubber": "12",
    "shaver": "25",
    "shoe": "31",
    "slipper": "12",
    "straw-cup": "24",
    "stuffed-toy": "12",
    "vase": "52",
}
"""Numbers of the two look-alikes of greatest mean cosine with the personal object's photos."""
BOWL = benchmarks.BOWL
PLATE = "plate-prop"
BASKET = "basket-prop"


def hardest(stem: str) -> tuple[str, ...]:
    """The two look-alikes that are hardest to tell from the personal instance, hardest first."""
    return tuple(f"{stem}-lookalike-{number}" for number in HARDEST[stem])


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
        return hardest(self.stem)[0] if self.owner == "ben" else f"{self.stem}-personal"

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


def _owned(model: str, owner: str) -> Owned:
    return Owned(model, owner, ("anna's brother",) if owner == "ben" else ())
