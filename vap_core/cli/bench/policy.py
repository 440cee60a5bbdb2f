"""What the shipped frozen policies cost: a call for one episode, and what is gained by asking for many episodes at once."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from vap_core.base.errors import BadStudy
from vap_core.base.tables import align
from vap_core.evaluation.policy_names import MINI, shipped
from vap_core.evaluation.statistics import ratio
from vap_core.perception.embedded.backbone import features
from vap_core.policies.lerobot.adapter import IMAGE, STATE, LeRobot, load
from vap_core.policies.protocol import PolicyInput
from vap_core.simulation.suites import BENCHMARKS

SIDE, BATCHES, REPEAT, WARM = 224, (1, 4, 16), 12, 2
CALL_MS, GAIN = 60.0, 4.0
"""Targets: of one call with one view, and of the throughput of the largest batch over that of the smallest."""


def run(quick: bool = False) -> str:
    """Time calls of every shipped policy, batch sizes in turn within each repeat; CPU time of one thread. Raises: BadStudy when none ships."""
    folders = {name: shipped(name) for name in BENCHMARKS if shipped(name).is_dir()}
    if not folders:
        raise BadStudy(
            f"bench policy: no {MINI} ships; train one: python -m vap_core train policy --suite simpler-bridge"
        )
    rng, rows, repeat = np.random.default_rng(0), [], 2 if quick else REPEAT
    view = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    unit = float(
        np.median(
            [
                _seconds(partial(features, [view + np.uint8(i)], ["head"]))
                for i in range(WARM + repeat)
            ][WARM:]
        )
    )
    for name, folder in folders.items():
        took = _took(load(folder), rng, repeat)
        gains = [
            ratio(took[1], [seconds / batch for seconds in took[batch]]) for batch in BATCHES[1:]
        ]
        call, views = float(np.median(took[1])), len(BENCHMARKS[name].cameras)
        told = [f"{middle:.1f} [{low:.1f}, {high:.1f}]" for middle, low, high in gains]
        rows.append([name, str(views), f"{1e3 * call:.1f}", f"{call / unit:.1f}", *told])
    return "\n".join(
        [
            f"one thread, CPU time, {repeat} repeats; unit: one EfficientNet-Lite0 pass of a {SIDE} px view in the same run, {1e3 * unit:.1f} ms",
            f"targets: a call with one view in {CALL_MS:.0f} ms at most, batch {BATCHES[-1]} at {GAIN:.0f} times the throughput of batch 1",
            "",
            align(
                [
                    [
                        "policy",
                        "views",
                        "one call, ms",
                        "units",
                        *(f"throughput at batch {batch} [95 %]" for batch in BATCHES[1:]),
                    ],
                    *rows,
                ]
            ),
        ]
    )


def _took(policy: LeRobot, rng: np.random.Generator, repeat: int) -> dict[int, list[float]]:
    """Seconds of a call, by batch size."""
    shapes = policy.wanted
    views = [key.removeprefix(IMAGE) for key in shapes if key != STATE]
    inputs = [
        PolicyInput(
            {name: rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8) for name in views}, "pick up the red cup",
            rng.normal(size=shapes[STATE]).astype(np.float32),
        ) for _ in range(max(BATCHES))
    ]  # fmt: skip
    states = [policy.start(np.random.default_rng(i)) for i in range(max(BATCHES))]
    took: dict[int, list[float]] = {batch: [] for batch in BATCHES}
    for i in range(WARM + repeat):
        for batch in BATCHES:
            seconds = _seconds(partial(policy.plan, states[:batch], inputs[:batch]))
            if i >= WARM:
                took[batch].append(seconds)
    return took


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
