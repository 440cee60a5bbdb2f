"""How the cost of an episode grows: with cameras, image size, candidates, batch, workers.

Episodes of vlabench/select-cup under VAP, cut short; a toy PI0 that takes any cameras; one process
and one thread but for the workers. What is not said about a condition is one camera of 224 px,
three objects of the category and batches of five. Memory: memory.py.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vap_core.attend import Attender
from vap_core.cli.bench import memory
from vap_core.cli.bench.engine import local_cluster, time_run
from vap_core.cli.bench.eval_plan import TOY, Cost
from vap_core.cli.bench.measurement import Measurement, provenance
from vap_core.cli.bench.profile_parts import ROLLOUT_PARTS, profiled
from vap_core.evaluation import cluster, processes
from vap_core.evaluation.policy_names import MINI
from vap_core.evaluation.study import Study
from vap_core.evaluation.trials import register_personal
from vap_core.memory import load_bank
from vap_core.perception.stacks import load_stack
from vap_core.policies.lerobot.adapter import LeRobot, load_policy
from vap_core.policies.lerobot.toy_pi0 import save_toy, toy_sizes
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.tint import TintPrompter
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import EpisodeRow, Placement

SUITE, TASK = "vlabench", "select-cup"
LOOKALIKES = tuple(f"paper-cup-lookalike-{i}" for i in range(1, 7))
APART_M = 0.09
"""The least distance between two objects."""
STEPS = 20
EPISODES = 2
BATCH = 5
REPEATS = 3
ENGINE_TASKS = ("put-camera", "pick-shaver", "put-owl-figurine")
"""Of simpler-bridge, ten whole episodes each, for the workers."""


@dataclass(frozen=True)
class Condition:
    """One point of an axis."""

    axis: str
    label: str
    cameras: int = 1
    image_size: int | tuple[int, int] = 224
    candidates: int = 3
    batch: int = BATCH
    episodes: int = EPISODES


CONDITIONS = (
    Condition("cameras", "1", cameras=1),
    Condition("cameras", "2", cameras=2),
    Condition("cameras", "3", cameras=3),
    Condition("image size", "224 x 224"),
    Condition("image size", "448 x 448", image_size=448),
    Condition("image size", "640 x 480", image_size=(480, 640)),
    Condition("objects of the category", "1", candidates=1),
    Condition("objects of the category", "2", candidates=2),
    Condition("objects of the category", "3", candidates=3),
    Condition("objects of the category", "5", candidates=5),
    Condition("batch", "1", batch=1, episodes=10),
    Condition("batch", "5", batch=5, episodes=10),
    Condition("batch", "10", batch=10, episodes=10),
)


def measure(episodes: int = 200, quick: bool = False) -> Measurement:
    """All axes and the memory over `episodes`; five minutes on two cores, `quick` one.

    Raises: WorkerDied.
    """
    repeats = 1 if quick else REPEATS
    steps = 2 if quick else STEPS
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        costs = _measure_conditions(folder, repeats, steps)
        workers = _measure_workers(folder, quick)
        series = memory.measure(10 if quick else episodes, 5 if quick else 50, folder / "series")
    conditions = []
    for condition, found in zip(CONDITIONS, costs, strict=True):
        conditions.append(
            {**asdict(condition), "steps": steps, "costs": [asdict(cost) for cost in found]}
        )
    about = provenance(
        "python -m vap_core bench scale",
        n=f"{EPISODES} episodes of {steps} steps (batch: 10; memory: {series[-1][0]})",
        repeats=repeats,
        task=f"{SUITE}/{TASK}",
    )
    values = {"conditions": conditions, "workers": workers, "memory": series}
    return Measurement("scale", about, values)


def rows_with(condition: Condition, steps: int) -> list[EpisodeRow]:
    """Episodes with so many objects of the category in view, the target among them."""
    listed = suites.rows(SUITE, TASK)
    cameras = suites.suite(SUITE).cameras[: condition.cameras]
    places = [place for row in listed for place in row.placements]
    rows = []
    for row in listed[: condition.episodes]:
        placements = list(row.placements[: condition.candidates])
        unused = [name for name in LOOKALIKES if name not in {each.model for each in placements}]
        for place in places:
            if len(placements) == condition.candidates:
                break
            if min(_distance_m(place, other) for other in placements) >= APART_M:
                placements.append(replace(place, model=unused.pop()))
        assert len(placements) == condition.candidates
        rows.append(replace(row, placements=tuple(placements), cameras=cameras, max_steps=steps))
    return rows


def _distance_m(one: Placement, other: Placement) -> float:
    return float(((one.x - other.x) ** 2 + (one.y - other.y) ** 2) ** 0.5)


def _measure_conditions(folder: Path, repeats: int, steps: int) -> list[list[Cost]]:
    """What every condition cost in every repeat; they follow each other in turn."""
    register_personal(Study(((SUITE, TASK),), ("vap",)), folder / "memory")
    attender = Attender(load_stack("embedded"), load_bank(folder / "memory"))
    costs: list[list[Cost]] = [[] for _ in CONDITIONS]
    names = ("paper-cup-personal", *LOOKALIKES)
    with build_scene(SUITE, names) as scene:
        policies = _toy_policies(scene, folder)
        for repeat in tqdm(range(-1, repeats), unit="repeat", disable=None):
            for found, condition in zip(costs, CONDITIONS, strict=True):
                trial = _trial(condition, scene, policies[condition.cameras], attender)
                rows = rows_with(condition, steps)
                if repeat < 0:  # warm
                    rows = [replace(row, max_steps=2) for row in rows[: condition.batch]]
                cost = _cost(trial, rows, condition.batch)
                if repeat >= 0:
                    found.append(cost)
    return costs


def _cost(trial: Trial, rows: Sequence[EpisodeRow], batch: int) -> Cost:
    with profiled(ROLLOUT_PARTS) as parts:
        wall = time.perf_counter()
        cpu = time.process_time()
        for episode in rollout(trial, rows, batch=batch):
            assert episode.outcome.status != "error", episode.outcome.detail
        cpu = time.process_time() - cpu
        wall = time.perf_counter() - wall
    return Cost(wall, cpu, parts.with_rest(cpu))


def _trial(condition: Condition, scene: Scene, policy: LeRobot, attender: Attender) -> Trial:
    suite = suites.suite(SUITE)
    return Trial(
        method="vap",
        scene=scene,
        policy=policy,
        prompter=TintPrompter(attender),
        control=suite.control,
        sensor=suite.sensor,
        follow="call",
        image_size=condition.image_size,
    )


def _toy_policies(scene: Scene, folder: Path) -> dict[int, LeRobot]:
    """A policy for the first cameras of the suite, by their number."""
    suite = suites.suite(SUITE)
    env = Env(scene, control=suite.control)
    policies = {}
    with toy_sizes(TOY):
        for n in range(1, 1 + len(suite.cameras)):
            checkpoint = folder / f"pi0-{n}"
            save_toy(checkpoint, suite.cameras[:n], len(env.state()), env.action_size, TOY)
            policies[n] = load_policy(checkpoint, "cpu")
    return policies


def _measure_workers(folder: Path, quick: bool) -> list[dict[str, Any]]:
    """One and two local processes, and two workers of a Ray cluster where Ray is installed."""
    tasks = tuple(("simpler-bridge", task) for task in ENGINE_TASKS)
    study = Study(tasks, ("vap",), episodes=10, policy=MINI, follow="call")
    if quick:
        study = replace(study, methods=("generic",), policy="random", episodes=6)
    found = []
    for workers in (1, 2):
        run = time_run(study, folder / f"workers-{workers}", workers, processes.results)
        found.append({"label": f"{workers}", **asdict(run)})
    if find_spec("ray") is None:
        return found
    with local_cluster(2) as address:
        run = time_run(study, folder / "ray", 2, cluster.ray_executor(address))
    found.append({"label": "2, Ray", **asdict(run)})
    return found
