"""What perception costs on one thread: start-up grounding and one tracked step of a 224 px view, in milliseconds and against other work.

Everything is timed in turn within each round, so that whatever else the machine does falls on all alike; ratios are of medians. The tracker
follows the expert's episode frame by frame, three objects at once: a view in which nothing moves would cost it next to nothing.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vap_core.attend import Attender
from vap_core.evaluation.perception.first_frames import USUAL_K, remembered
from vap_core.evaluation.perception.tracking import Job, shoot
from vap_core.evaluation.policy_names import scripted
from vap_core.perception.embedded.backbone import features
from vap_core.perception.protocols import Stack
from vap_core.policies.protocol import PolicyInput
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.scenes import Scene
from vap_core.simulation.suites.open_row import build_scene

SUITE, TASK = "simpler-bridge", "pick-shaver"
Work = Callable[[], object]
START, STEP, PASS, POLICY = (
    "start-up grounding",
    "track step",
    "backbone pass",
    "scripted policy's plan",
)
LIMITS_MS = {START: 300.0, STEP: 45.0}


def measure(
    stack: Stack, repeat: int = 25, against: Mapping[str, Work] | None = None
) -> list[dict[str, Any]]:
    """A line per piece of work: its median, quartiles, and how many rounds. `against` names more work to compare with, such as another policy's
    step; a step of the scripted policy (a 224 px view of its own) and a pass of the backbone are always there.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with build_scene(
            SUITE, [place.model for place in suites.rows(SUITE, TASK, 1)[0].placements]
        ) as scene:
            works = {**_works(stack, scene), **(against or {})}
            for work in works.values():
                work()
            took: dict[str, list[float]] = {name: [] for name in works}
            for _ in range(repeat):
                for name, work in works.items():
                    start = time.perf_counter()
                    work()
                    took[name].append(1e3 * (time.perf_counter() - start))
    finally:
        torch.set_num_threads(threads)
    lines = []
    for name, all_ms in took.items():
        low, middle, high = np.percentile(all_ms, [25, 50, 75])
        lines.append(
            {
                "what": name,
                "ms": float(middle),
                "low_ms": float(low),
                "high_ms": float(high),
                "rounds": repeat,
            }
        )
    return lines


def _works(stack: Stack, scene: Scene) -> dict[str, Work]:
    row = suites.rows(SUITE, TASK, 1)[0]
    film = shoot(Job(row, 1, (), "plate"), scene).frames
    env, policy = Env(scene), scripted(stack.detector, scene, suites.suite(SUITE))
    env.reset(row)
    seen = env.observe()
    camera = env.camera_names[0]
    views = {camera: seen.images[camera]}
    attender = Attender(stack, {row.target: remembered(stack, row.target, USUAL_K)[0]})
    first = np.stack(list(film[0][camera][1].values()))
    states, at = stack.tracker.start([film[0][camera][0]], [first]), 0
    asked = policy.start(np.random.default_rng(0))

    def step() -> None:
        nonlocal states, at
        at = (at + 1) % len(film)
        states, _ = stack.tracker.step(states, [film[at][camera][0]])

    return {
        START: lambda: attender.start(views, row.instruction),
        STEP: step,
        PASS: lambda: features([views[camera]], ["head"]),
        POLICY: lambda: policy.plan(
            [asked], [PolicyInput(seen.images, row.instruction, seen.state)]
        ),
    }
