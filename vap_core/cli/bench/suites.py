"""What a control step of each benchmark costs, part by part, and how long a whole list takes; CPU time of one process unless said otherwise."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vap_core.base.tables import align
from vap_core.cli.bench.loop import Limit
from vap_core.evaluation.engine import run as run_study
from vap_core.evaluation.study import Study
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.expert_loop import expert_steps
from vap_core.simulation import suites
from vap_core.simulation.suites import Suite
from vap_core.simulation.suites.open_row import make_env, open_row

STEPS, REPEAT = 12, 9
LIST = "simpler-bridge"


def run(workers: int = 2) -> str:
    """Measure every benchmark, then one whole list with its expert; takes about two minutes."""
    lines, limits = [["suite", "part", "CPU ms", "x one physics step of 2 ms"]], []
    for suite in suites.BENCHMARKS.values():
        parts, physics = _parts(suite)
        lines += [
            [suite.name, part, f"{ms:.1f}", f"{ms / physics:.0f}"] for part, ms in parts.items()
        ]
        slowest = max((part for part in parts if part.startswith("RGB")), key=parts.__getitem__)
        limits.append(
            Limit(
                f"{suite.name}: {slowest}",
                parts[slowest],
                12,
                "ms",
                f"{parts[slowest] / physics:.0f} physics steps",
            )
        )
    limits.append(_list(workers))
    return "\n".join(
        [
            align(lines),
            "",
            align(
                [["what", "measured", "budget", "", "ratio"], *(limit.row() for limit in limits)]
            ),
        ]
    )


def _parts(suite: Suite) -> tuple[dict[str, float], float]:
    """Milliseconds of CPU by part of one control step while the expert works, and of one physics step."""
    row = suites.rows(suite.name, suite.tasks[-1].name, 1)[0]
    with open_row(row) as env:
        scene, expert = env.scene, Expert()
        state = expert.start(np.random.default_rng(0))
        env.seconds.update(dict.fromkeys(env.seconds, 0.0))
        for judge, _ in expert_steps(env, row, expert, state):
            if judge.steps == STEPS:
                break
        parts = {
            f"{part}, a control step": 1e3 * env.seconds[part] / STEPS for part in ("physics", "ik")
        }
        physics = parts["physics, a control step"] / (
            1.0 / suite.hz / float(scene.model.opt.timestep)
        )
        for name in suite.cameras:
            one = make_env(scene, suite.name, cameras=(name,))
            one.restore(env.snapshot())
            parts[f"RGB, camera {name}, 224 px"] = _cpu_ms(one.observe)
        parts["poses and contacts"] = _cpu_ms(env.truth)
        parts["masks of all cameras (only when asked)"] = _cpu_ms(lambda: env.truth(masks=True))
    return parts, physics


def _list(workers: int) -> Limit:
    """The whole list with images every 4 steps, as `eval` runs it."""
    suite = suites.suite(LIST)
    study = Study(
        tuple((LIST, task.name) for task in suite.tasks),
        ("generic",),
        policy="expert",
        images_every=4,
    )
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        table = run_study(
            study, Path(scratch) / "run", workers=workers, record="none", progress=False
        )
        wall = time.perf_counter() - start
    simulated = float(table["steps"].sum()) / suite.hz
    what = f"{LIST}, {len(table)} episodes, images every 4 steps, {workers} processes"
    return Limit(
        what,
        wall,
        240,
        "s wall",
        f"{simulated / wall:.1f} x real time, {int(table['success'].sum())} solved",
    )


def _cpu_ms(work: Callable[[], object]) -> float:
    work()
    took = []
    for _ in range(REPEAT):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    return 1e3 * float(np.median(took))
