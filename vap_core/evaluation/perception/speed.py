"""What perception costs on one thread, in milliseconds and against other work.

Timed are start-up grounding and one tracked step of a 224 px view. Everything is timed in turn
within each round, so that whatever else the machine does falls on all alike; ratios are of medians.
The tracker tracks through the expert's episode frame by frame, three objects at once: a view in
which nothing moves would cost it next to nothing.
"""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vap_core.attend import Attender
from vap_core.evaluation.perception.first_frames import USUAL_K, TableRow, registered_object
from vap_core.evaluation.perception.tracking import Frame, Job, record_film
from vap_core.evaluation.policy_names import scripted
from vap_core.perception.embedded.backbone import features
from vap_core.perception.protocols import Stack
from vap_core.policies.protocol import PolicyInput
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import build_scene

SUITE = "simpler-bridge"
TASK = "pick-shaver"
Work = Callable[[], object]
START = "start-up grounding"
STEP = "track step"
PASS = "backbone pass"
POLICY = "scripted policy's plan"
LIMITS_MS = {START: 300.0, STEP: 45.0}


def measure(stack: Stack, repeat: int = 25) -> list[TableRow]:
    """A row per piece of work: its median, its quartiles, and how many rounds.

    A step of the scripted policy (a 224 px view of its own) and a pass of the backbone are there to
    compare with.
    """
    import torch

    row = suites.rows(SUITE, TASK, 1)[0]
    models = [place.model for place in row.placements]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with build_scene(SUITE, models) as scene:
            times_ms = _time_in_turn(_works(stack, scene), repeat)
    finally:
        torch.set_num_threads(threads)
    rows = []
    for name, of_work_ms in times_ms.items():
        low, middle, high = np.percentile(of_work_ms, [25, 50, 75])
        row_of_work: TableRow = {
            "what": name,
            "ms": float(middle),
            "low_ms": float(low),
            "high_ms": float(high),
            "rounds": repeat,
        }
        rows.append(row_of_work)
    return rows


def _time_in_turn(works: Mapping[str, Work], repeat: int) -> dict[str, list[float]]:
    """Milliseconds of every piece of work in each round, after one round to warm up."""
    times_ms: dict[str, list[float]] = {}
    for name, work in works.items():
        work()
        times_ms[name] = []
    for _ in range(repeat):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            times_ms[name].append(1e3 * (time.perf_counter() - start))
    return times_ms


def _works(stack: Stack, scene: Scene) -> dict[str, Work]:
    """The work that is always timed, by its name."""
    row = suites.rows(SUITE, TASK, 1)[0]
    film = record_film(Job(row=row, every=1, hidden=(), kind="plate"), scene).frames
    env = Env(scene)
    policy = scripted(stack.category_detector, scene, suites.suite(SUITE))
    env.reset(row)
    observation = env.observe()
    camera = env.camera_names[0]
    views = {camera: observation.images[camera]}
    personal, _ = registered_object(stack, row.target, USUAL_K)
    attender = Attender(stack, {row.target: personal})
    track_step = _track_step(stack, film, camera)
    state = policy.start(np.random.default_rng(0))

    def plan() -> object:
        policy_input = PolicyInput(observation.images, row.instruction, observation.state)
        return policy.plan([state], [policy_input])

    return {
        START: lambda: attender.start(views, row.instruction),
        STEP: track_step,
        PASS: lambda: features([views[camera]], ["head"]),
        POLICY: plan,
    }


def _track_step(stack: Stack, film: Sequence[Frame], camera: str) -> Work:
    """A step of the tracker on the next frame of a film, which begins again at its end."""
    rgb, masks = film[0][camera]
    all_masks = list(masks.values())
    states = stack.tracker.start([rgb], [np.stack(all_masks)])
    t = 0

    def step() -> None:
        nonlocal states, t
        t = (t + 1) % len(film)
        states, _ = stack.tracker.step(states, [film[t][camera][0]])

    return step
