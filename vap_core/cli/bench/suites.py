"""What a control step of each benchmark costs, part by part, and how long a whole list takes.

CPU time of one process unless said otherwise.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vap_core.base.tables import align
from vap_core.cli.bench.loop import Limit, beside_budgets
from vap_core.cli.bench.timing import median_seconds
from vap_core.evaluation.engine import run as run_study
from vap_core.evaluation.study import Study
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.expert_loop import expert_steps
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.suites import Suite
from vap_core.simulation.suites.open_row import make_env, open_row

STEPS = 12
"""Control steps of the expert that are timed."""
REPEAT = 9
LIST = "simpler-bridge"
"""The benchmark whose whole list is run."""


def run(workers: int = 2) -> str:
    """Measure every benchmark, then one whole list with its expert; takes about two minutes.

    Raises: WorkerDied.
    """
    rows = [["suite", "part", "CPU ms", "x one physics step of 2 ms"]]
    limits = []
    for suite in suites.BENCHMARKS.values():
        parts, physics = _measure_parts(suite)
        for part, ms in parts.items():
            rows.append([suite.name, part, f"{ms:.1f}", f"{ms / physics:.0f}"])
        limits.append(_image_limit(suite, parts, physics))
    limits.append(_list_limit(workers))
    return "\n".join([align(rows), "", beside_budgets(limits)])


def _measure_parts(suite: Suite) -> tuple[dict[str, float], float]:
    """Milliseconds of CPU by part of one control step, and of one physics step.

    The expert works meanwhile.
    """
    row = suites.rows(suite.name, suite.tasks[-1].name, 1)[0]
    with open_row(row) as env:
        expert = Expert()
        state = expert.start(np.random.default_rng(0))
        env.seconds.update(dict.fromkeys(env.seconds, 0.0))
        for judge, _ in expert_steps(env, row, expert, state):
            if judge.steps == STEPS:
                break
        parts = {}
        for part in ("physics", "ik"):
            parts[f"{part}, a control step"] = 1e3 * env.seconds[part] / STEPS
        timestep_s = float(env.scene.model.opt.timestep)
        physics = parts["physics, a control step"] / (1.0 / suite.hz / timestep_s)
        parts |= _image_parts(suite, env)
        parts["poses and contacts"] = _cpu_ms(env.truth)
        parts["masks of all cameras (only when asked)"] = _cpu_ms(lambda: env.truth(masks=True))
    return parts, physics


def _image_parts(suite: Suite, env: Env) -> dict[str, float]:
    """Milliseconds of CPU of each camera's picture."""
    parts = {}
    for name in suite.cameras:
        one_camera = make_env(env.scene, suite.name, cameras=(name,))
        one_camera.restore(env.snapshot())
        parts[f"RGB, camera {name}, 224 px"] = _cpu_ms(one_camera.observe)
    return parts


def _image_limit(suite: Suite, parts: dict[str, float], physics: float) -> Limit:
    """The slowest picture of a suite."""
    pictures = [part for part in parts if part.startswith("RGB")]
    slowest = max(pictures, key=parts.__getitem__)
    return Limit(
        what=f"{suite.name}: {slowest}",
        measured=parts[slowest],
        budget=12,
        unit="ms",
        ratio=f"{parts[slowest] / physics:.0f} physics steps",
    )


def _list_limit(workers: int) -> Limit:
    """The whole list with images every 4 steps, as `eval` runs it."""
    suite = suites.suite(LIST)
    tasks = tuple((LIST, task.name) for task in suite.tasks)
    study = Study(tasks, ("generic",), policy="expert", images_every=4)
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        table = run_study(
            study, Path(scratch) / "run", workers=workers, record="none", progress=False
        )
        wall_s = time.perf_counter() - start
    simulated_s = float(table["steps"].sum()) / suite.hz
    n_solved = int(table["success"].sum())
    return Limit(
        what=f"{LIST}, {len(table)} episodes, images every 4 steps, {workers} processes",
        measured=wall_s,
        budget=240,
        unit="s wall",
        ratio=f"{simulated_s / wall_s:.1f} x real time, {n_solved} solved",
    )


def _cpu_ms(work: Callable[[], object]) -> float:
    """The median of REPEAT times, after a first one that does not count."""
    return 1e3 * median_seconds(work, REPEAT, clock=time.process_time)
