"""What the shipped frozen policies cost.

A call for one episode, and what is gained by asking for many episodes at once.
"""

import time
from functools import partial
from pathlib import Path

import numpy as np

from vap_core.analysis.attention.effects import noise_input
from vap_core.base.errors import BadStudy
from vap_core.base.tables import align
from vap_core.cli.bench.timing import seconds_of
from vap_core.evaluation.policy_names import MINI, shipped
from vap_core.evaluation.statistics import ratio
from vap_core.perception.embedded.backbone import features
from vap_core.policies.hooks import observe_attention, observe_inputs
from vap_core.policies.lerobot.adapter import LeRobot, load_policy
from vap_core.policies.lerobot.traced import CALLS_BEFORE_TRACE
from vap_core.simulation.suites import BENCHMARKS

SIDE = 224
BATCHES = (1, 4, 16)
REPEAT = 12
WARM = 2
"""First repeats, which do not count."""
CALL_MS = 60.0
"""Target of one call with one view."""
GAIN = 4.0
"""Target of the throughput of the largest batch over that of the smallest."""


def run(quick: bool = False) -> str:
    """Time calls of every shipped policy; CPU time of one thread.

    Batch sizes follow each other within each repeat. Raises: BadStudy when no policy ships.
    """
    folders = _shipped_folders()
    if not folders:
        raise BadStudy(
            f"bench policy: no {MINI} ships; "
            "train one: python -m vap_core train policy --suite simpler-bridge"
        )
    rng = np.random.default_rng(0)
    repeat = 2 if quick else REPEAT
    unit = _backbone_seconds(rng, repeat)
    header = ["policy", "views", "one call, ms", "units"]
    for batch in BATCHES[1:]:
        header.append(f"throughput at batch {batch} [95 %]")
    header += ["eager call, ms", "with attention, ms"]
    rows = [header]
    for name, folder in folders.items():
        policy = load_policy(folder)
        seconds = _call_seconds(policy, rng, repeat)
        call = float(np.median(seconds[1]))
        n_views = len(BENCHMARKS[name].cameras)
        gains = [_gain_text(seconds, batch) for batch in BATCHES[1:]]
        eager, observed = _observed_seconds(policy, rng, repeat)
        costs = [f"{1e3 * eager:.1f}", f"{1e3 * observed:.1f}"]
        rows.append([name, str(n_views), f"{1e3 * call:.1f}", f"{call / unit:.1f}", *gains, *costs])
    about = (
        f"one thread, CPU time, {repeat} repeats; unit: one EfficientNet-Lite0 pass of a "
        f"{SIDE} px view in the same run, {1e3 * unit:.1f} ms"
    )
    wanted = (
        f"targets: a call with one view in {CALL_MS:.0f} ms at most, "
        f"batch {BATCHES[-1]} at {GAIN:.0f} times the throughput of batch 1"
    )
    return "\n".join([about, wanted, "", align(rows)])


def _shipped_folders() -> dict[str, Path]:
    """The folders of the shipped policies, by benchmark."""
    folders = {}
    for name in BENCHMARKS:
        folder = shipped(name)
        if folder.is_dir():
            folders[name] = folder
    return folders


def _backbone_seconds(rng: np.random.Generator, repeat: int) -> float:
    """The median of the backbone's passes, each of a new view."""
    view = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    seconds = []
    for i in range(WARM + repeat):
        work = partial(features, [view + np.uint8(i)], ["head"])
        seconds.append(seconds_of(work, time.process_time))
    return float(np.median(seconds[WARM:]))


def _gain_text(seconds: dict[int, list[float]], batch: int) -> str:
    """How many times the throughput of batch 1 a batch has, and the interval."""
    per_episode = [s / batch for s in seconds[batch]]
    middle, low, high = ratio(seconds[1], per_episode)
    return f"{middle:.1f} [{low:.1f}, {high:.1f}]"


def _call_seconds(policy: LeRobot, rng: np.random.Generator, repeat: int) -> dict[int, list[float]]:
    """Seconds of a call, by batch size, once the policy is traced."""
    inputs = []
    states = []
    for i in range(max(BATCHES)):
        inputs.append(noise_input(policy, rng, SIDE))
        states.append(policy.start(np.random.default_rng(i)))
    seconds: dict[int, list[float]] = {batch: [] for batch in BATCHES}
    # The trace is made in one round; in the next one every other batch size is compared with it.
    warm = CALLS_BEFORE_TRACE // len(BATCHES) + 1 + WARM
    for i in range(warm + repeat):
        for batch in BATCHES:
            call = partial(policy.plan, states[:batch], inputs[:batch])
            call_seconds = seconds_of(call, time.process_time)
            if i >= warm:
                seconds[batch].append(call_seconds)
    return seconds


def _observed_seconds(
    policy: LeRobot, rng: np.random.Generator, repeat: int
) -> tuple[float, float]:
    """The medians of an eager call for one episode, and of one whose attention is observed.

    An observed call is never a traced one; the queries are two words and the expert's tokens.
    """
    one = noise_input(policy, rng, SIDE)
    states = [policy.start(rng)]
    call = partial(policy.plan, states, [one])

    def eager_call() -> None:
        with observe_inputs():  # hashes the inputs, a fraction of a millisecond, and is eager
            call()

    def observed_call() -> None:
        with observe_attention([{"colour": ("red",), "category": ("cup",)}]):
            call()

    eager = []
    observed = []
    for i in range(WARM + repeat):
        times = (
            seconds_of(eager_call, time.process_time),
            seconds_of(observed_call, time.process_time),
        )
        if i >= WARM:
            eager.append(times[0])
            observed.append(times[1])
    return float(np.median(eager)), float(np.median(observed))
