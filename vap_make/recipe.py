"""How the small policies are made: one recipe, and what differs from suite to suite.

    RECIPES["simpler-bridge"]                     # `train policy --suite simpler-bridge`
    FILMED["simpler-bridge"]                      # what its films show

What tells one training from another is here, and is what `train policy` takes when nothing else is
asked for; `Recipe` is written into its training.json. What all share stands beside the code that
uses it. Films are kept by suite, seed and stage: after a change of what they show name another
`--cache`.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

from vap_core.base.errors import one_of
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import Task, suite
from vap_core.simulation.suites.benchmarks import BRIDGE, FILMED_AREA, FRACTAL
from vap_core.simulation.suites.layout import Area
from vap_make.lists import benchmarks


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Features and layers of a mini-PaliGemma and of the action expert that grows from it."""

    width: int = 128
    depth: int = 4
    vision_width: int = 128
    vision_depth: int = 4
    expert_width: int = 96


@dataclass(frozen=True, kw_only=True)
class Recipe(Sizes):
    """How long, how large, and in which language.

    Language: a command calls its target by the colour of its materials; `plain` and `described` are
    the shares of those that do not. `held_out_words` are in no command and on no object. `taught`
    objects have a learned word, which `learned` of their commands use.

    Films: none shows `held_out_category`, which the suite evaluates. `draws` flow samples share one
    look at the pictures; frames close to the start, a grasp, a release or the end come `focus`
    times as often as others; one picture in `thin` is learned from, so that more films fit into
    memory. `execute` actions of each chunk of `chunk` are carried out. The arm's angles are read
    with noise of the deviation `angle_noise_rad`: in films the arm starts alike,
    and some angles hardly change. Without it simpler-bridge's first policy falls from 92 to 14 %
    where every joint starts up to 0.03 rad off (docs/benchmarks.md, other starts).
    """

    suite: str
    held_out_category: str
    stages: int = 960
    thin: int = 2
    steps: int = 9_600
    batch: int = 64
    chunk: int = 4
    execute: int = 4
    draws: int = 4
    rate: float = 1.4e-3
    seed: int = 0
    focus: float = 3.0
    angle_noise_rad: float = 0.02
    held_out_words: tuple[str, ...] = ("magenta", "yellow")
    plain: float = 0.2
    described: float = 0.25
    taught: int = 80
    learned: float = 0.5

    @property
    def interval(self) -> int:
        """Control steps from one picture that is learned from to the next."""
        return every(self.suite) * self.thin

    def as_json(self) -> dict[str, Any]:
        """Every field, as training.json keeps it."""
        return asdict(self)


TABLETOP = Recipe(
    suite="tabletop",
    held_out_category="slipper",
    stages=480,
    batch=32,
    rate=1e-3,
    angle_noise_rad=0.04,
    chunk=32,
    execute=10,
)
RECIPES: dict[str, Recipe] = {
    "simpler-bridge": Recipe(suite="simpler-bridge", held_out_category="owl figurine"),
    "simpler-fractal": Recipe(
        suite="simpler-fractal",
        held_out_category="bottle",
        steps=7_600,
        execute=2,
    ),
    "vlabench": Recipe(
        suite="vlabench",
        held_out_category="cat figurine",
        stages=240,
        thin=1,
        steps=1_840,
        angle_noise_rad=0.01,
    ),
    "tabletop": TABLETOP,
    "shared-pair": replace(TABLETOP, suite="shared-pair", taught=0),
}
"""The recipe of each suite; what is not named is as in `Recipe`."""


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """What the films of a suite show.

    The suite's tasks without the held-out category, and `instead` of them the same skill with
    categories that the suite does not evaluate. Objects stand in `area`. There is a picture
    `every` so many control steps: at 30 Hz neighbours hardly differ, and pictures are what a film
    costs. At most `most` objects of the category and the goal are in a scene; `distractors` is the
    share of scenes with one or two objects of other categories besides. With `pairs`, the goal is
    an object like the target (`films.pairs`).
    """

    area: Area
    instead: tuple[Task, ...] = ()
    every: int = 1
    most: int = 5
    distractors: float = 0.0
    pairs: bool = False


def _instead(task: Task, category: str) -> Task:
    """The task with another category."""
    slug = category.replace(" ", "-")
    return replace(
        task,
        name=task.name.replace(task.stem, slug),
        category=category,
        instruction=task.instruction.replace(task.category, category),
        slug="",
    )


FILMED: dict[str, Filmed] = {
    "simpler-bridge": Filmed(
        area=FILMED_AREA,
        instead=(_instead(BRIDGE.task("put-owl-figurine"), "vase"),),
        most=4,
    ),
    "simpler-fractal": Filmed(
        area=benchmarks.DESK,
        instead=(
            _instead(FRACTAL.task("move-bottle-near-coke-can"), "vase"),
            _instead(FRACTAL.task("move-bottle-near-coke-can"), "straw cup"),
        ),
        distractors=0.3,
    ),
    "vlabench": Filmed(area=benchmarks.VLABENCH_TABLE),
    "tabletop": Filmed(area=benchmarks.TABLETOP_TABLE, every=3),
    "shared-pair": Filmed(area=benchmarks.TABLETOP_TABLE, every=3, pairs=True),
}
"""What differs between the films of the suites; a put on the tabletop uses tabletop.REACH."""


def filmed_tasks(suite_name: str) -> tuple[Task, ...]:
    """The tasks that a suite's films show."""
    held_out = RECIPES[suite_name].held_out_category
    tasks = []
    for task in suite(suite_name).tasks:
        shown = {task.category}
        if task.goal:
            shown.add(get_object(task.goal).category)
        if held_out not in shown:
            tasks.append(task)
    return (*tasks, *FILMED[suite_name].instead)


def filmed_task(suite_name: str, name: str) -> Task:
    """The task called `name` of a suite's films. Raises: UnknownName."""
    tasks = filmed_tasks(suite_name)
    for task in tasks:
        if task.name == name:
            return task
    raise one_of(f"films of {suite_name}: task", name, [task.name for task in tasks])


def every(suite_name: str) -> int:
    """Control steps from one picture of a suite's films to the next."""
    return FILMED[suite_name].every
