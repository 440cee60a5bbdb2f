"""Episodes per hour of our rollouts against lerobot's own evaluation loop: the same policy, environment, episodes and per-step VAP, in one run.

The policy is lerobot's PI0 at toy size with random weights, which change nothing about speed; no episode is solved, so all last `steps`. lerobot
runs as it comes on a machine of few cores (one environment, videos of the first ten episodes) and at its best (no videos; one or four
environments; in this process or in their own; torch on one thread or on all). Start-up is nobody's: everything is built and warm.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, redirect_stderr
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.tables import align
from vap_core.evaluation.processes import end_with_parent
from vap_core.evaluation.statistics import ratio
from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, toy_sizes
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

SUITE, TASK = "simpler-bridge", "put-camera"
TOY = Toy(image=128, patch=16, width=128, layers=4, expert=96, chunk=4, denoise=10)
BATCH = 4
FOLLOW = {"step": "", "call": ", at calls"}
"""rollout.Trial's: at every step is the work that lerobot's loop does; at the policy's calls is less, which that loop cannot leave out."""


@dataclass(frozen=True)
class Plan:
    """How much is measured: `episodes` of `steps` control steps, `repeats` times over. `workers` of ours, besides one; 0: in this process."""

    episodes: int = 8
    steps: int = 40
    repeats: int = 4
    workers: int = 2
    toy: Toy = TOY
    loops: tuple[tuple[int, bool], ...] = ((1, False), (4, False), (4, True))
    """lerobot's number of environments, and whether each is a process."""
    threads: tuple[int, ...] = tuple(sorted({1, len(os.sched_getaffinity(0))}))
    """torch's, in lerobot's process; its default is one per core. Ours always has one."""

    def rows(self) -> list[EpisodeRow]:
        return [
            replace(row, max_steps=self.steps) for row in suites.rows(SUITE, TASK)[: self.episodes]
        ]


QUICK = Plan(
    episodes=2,
    steps=2,
    repeats=2,
    workers=0,
    toy=Toy(image=64, patch=16, width=32, layers=1, expert=32, denoise=2),
    loops=((1, False),),
    threads=(1,),
)


@dataclass
class Arm:
    """One way to run all episodes: wall seconds of every repeat, and seconds by part summed over all of them."""

    name: str
    run: Callable[[], Mapping[str, float]]
    seconds: list[float]
    parts: dict[str, float]

    def go(self) -> None:
        start = time.perf_counter()
        parts = self.run()
        self.seconds.append(time.perf_counter() - start)
        for part, seconds in parts.items():
            self.parts[part] = self.parts.get(part, 0.0) + seconds


def run(workers: int = 2, quick: bool = False) -> str:
    """Measure everything and say it; takes about ten minutes, `quick` half a minute for a smoke test."""
    return report(*measure(QUICK if quick else replace(Plan(), workers=workers)))


def measure(plan: Plan) -> tuple[Plan, list[Arm], list[Arm]]:
    """lerobot's arms and ours; the arms of a repeat follow each other in turn, beginning with another one each time."""
    import torch
    from tqdm import tqdm

    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as scratch, toy_sizes(plan.toy), ExitStack() as stack:
        folder = Path(scratch)
        prepare(plan, folder)
        theirs = [Arm(name, work, [], {}) for name, work in _lerobot(plan, folder, stack)]
        ours = [Arm(name, work, [], {}) for name, work in _ours(plan, folder, stack)]
        arms = [*theirs, *ours]
        try:
            for turn in tqdm(range(plan.repeats * len(arms)), unit="run", disable=None):
                arms[(turn + turn // len(arms)) % len(arms)].go()
        finally:
            torch.set_num_threads(threads)
    return plan, theirs, ours


def prepare(plan: Plan, folder: Path) -> None:
    """The memory of the personal object, a toy PI0, and the same one with VAP attached for lerobot."""
    from vap_core.memory import register, save
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.step import VapEnvConfig, attach
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import reference_views

    stack, row, env = load_stack("embedded"), plan.rows()[0], VapEnvConfig(task=f"{SUITE}/{TASK}")
    obj, _ = register(
        row.target,
        row.category,
        reference_views(get_object(row.target)),
        stack.detector,
        stack.encoder,
    )
    save(folder / "memory", obj)
    save_toy(
        folder / "pi0",
        suites.suite(SUITE).cameras,
        env.features["agent_pos"].shape[0],
        env.features["action"].shape[0],
        plan.toy,
    )
    attach(folder / "pi0", folder / "vap", folder / "memory")


def _lerobot(
    plan: Plan, folder: Path, stack: ExitStack
) -> Iterator[tuple[str, Callable[[], Mapping[str, float]]]]:
    """lerobot.scripts.lerobot_eval.eval_policy, called as its command calls it."""
    from lerobot.policies import make_pre_post_processors

    from vap_core.policies.lerobot.adapter import load
    from vap_core.policies.lerobot.step import VapEnvConfig

    policy = load(folder / "pi0", "cpu").policy
    config = VapEnvConfig(task=f"{SUITE}/{TASK}", max_steps=plan.steps)
    for n, processes in plan.loops:
        env: Any = config.create_envs(n, use_async_envs=processes)[SUITE][0]
        stack.callback(env.close)
        env.reset(seed=list(range(n)))
        env.step(np.zeros((n, policy.config.action_feature.shape[0]), np.float32))
        for threads in plan.threads:
            for videos in [True, False] if n == 1 and threads == plan.threads[-1] else [False]:
                pipelines = (
                    *config.get_env_processors(),
                    *make_pre_post_processors(policy.config, str(folder / "vap")),
                )
                kind = "in processes" if processes else "in one process"
                name = f"lerobot, {n} env {kind}, {threads} thread{'s'[: threads - 1]}{', videos (as it comes)' if videos else ''}"
                yield (
                    name,
                    _loop(
                        plan, env, policy, pipelines, threads, folder / "videos" if videos else None
                    ),
                )


def _loop(
    plan: Plan, env: Any, policy: Any, pipelines: Sequence[Any], threads: int, videos: Path | None
) -> Callable[[], Mapping[str, float]]:
    """One evaluation of all episodes, and where its time went."""
    import torch
    from lerobot.scripts.lerobot_eval import eval_policy

    before, after, preprocessor, postprocessor = pipelines
    prompt = preprocessor.steps[1]

    def go() -> Mapping[str, float]:
        parts: dict[str, float] = dict.fromkeys(
            ("environment", "all processors", "attend", "policy"), 0.0
        )
        torch.set_num_threads(threads)
        with ExitStack() as hooks:
            preprocessor.steps[1] = _timed(prompt, parts, "attend")
            for holder, name, part in (
                (env, "step", "environment"),
                (env, "reset", "environment"),
                (policy, "select_action", "policy"),
            ):
                hooks.enter_context(_hooked(holder, name, parts, part))
            whole = _timed(preprocessor, parts, "all processors")
            with (
                Path(os.devnull).open("w") as silence,
                redirect_stderr(silence),
            ):  # two progress bars
                done = eval_policy(
                    env, policy, before, after, whole, postprocessor, plan.episodes, 10 if videos else 0, videos, start_seed=0
                )  # fmt: skip
        assert len(done["per_episode"]) == plan.episodes
        parts["processors"] = parts.pop("all processors") - parts["attend"]
        return parts

    return go


def _ours(
    plan: Plan, folder: Path, stack: ExitStack
) -> Iterator[tuple[str, Callable[[], Mapping[str, float]]]]:
    """rollout in one warm process, then in several."""
    if not plan.workers:
        _build(plan, folder)
        stack.callback(_close)
        for follow in FOLLOW:
            yield (
                f"ours, batches of {BATCH}, in this process{FOLLOW[follow]}",
                partial(_batch, plan.rows(), follow),
            )
        return
    for workers in sorted({1, plan.workers}):
        pool = stack.enter_context(
            ProcessPoolExecutor(workers, get_context("spawn"), _worker, (plan, folder))
        )
        ready = [
            pool.submit(_batch, [], "step") for _ in range(workers)
        ]  # one for each: the first is still starting when the next comes
        for one in ready:
            one.result()
        for follow in FOLLOW:
            yield (
                f"ours, batches of {BATCH}, {workers} worker{'s'[: workers - 1]}{FOLLOW[follow]}",
                _spread(plan, pool, follow),
            )


def _spread(
    plan: Plan, pool: ProcessPoolExecutor, follow: str
) -> Callable[[], Mapping[str, float]]:
    rows = plan.rows()

    def go() -> Mapping[str, float]:
        parts: dict[str, float] = {}
        for found in pool.map(
            partial(_batch, follow=follow),
            [rows[i : i + BATCH] for i in range(0, len(rows), BATCH)],
        ):
            for part, seconds in found.items():
                parts[part] = parts.get(part, 0.0) + seconds
        return parts

    return go


_trial: Any = None


def _worker(plan: Plan, folder: Path) -> None:
    end_with_parent()
    _build(plan, folder)


def _build(plan: Plan, folder: Path) -> None:
    """All that an episode needs, and two steps of one to warm up."""
    global _trial
    from vap_core.attend import Attender
    from vap_core.memory import load_bank
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.adapter import load
    from vap_core.rollout.loop import Trial
    from vap_core.rollout.prompters.tint import TintPrompter
    from vap_core.simulation.suites.open_row import build_scene

    models = tuple(
        dict.fromkeys(place.model for row in suites.rows(SUITE, TASK) for place in row.placements)
    )
    suite = suites.suite(SUITE)
    with toy_sizes(plan.toy):
        policy = load(folder / "pi0", "cpu")
    attender = Attender(load_stack("embedded"), load_bank(folder / "memory"))
    _trial = Trial(
        method="vap",
        scene=build_scene(SUITE, models),
        policy=policy,
        prompter=TintPrompter(attender),
        control=suite.control,
        sensor=suite.sensor,
    )
    _batch([replace(row, max_steps=2) for row in plan.rows()[:BATCH]], "step")


def _close() -> None:
    global _trial
    _trial.scene.close()
    _trial = None


def _batch(rows: Sequence[EpisodeRow], follow: str) -> Mapping[str, float]:
    from vap_core.rollout.loop import rollout

    start, parts = (
        time.perf_counter(),
        dict.fromkeys(("environment", "attend", "policy", "record"), 0.0),
    )
    for episode in rollout(replace(_trial, follow=follow), rows, batch=BATCH):
        assert episode.outcome.status != "error", episode.outcome.detail
        assert episode.outcome.steps == episode.header.row.max_steps
        for part, seconds in episode.seconds.items():
            parts[part if part in parts else "environment"] += seconds
    return {**parts, "rest": time.perf_counter() - start - sum(parts.values())}


def report(plan: Plan, theirs: Sequence[Arm], ours: Sequence[Arm]) -> str:
    """Three tables: episodes per hour, ratios, and where a step goes."""
    best, default = (
        min(theirs, key=_typical),
        theirs[0]
        if len(theirs) == 1
        else next((arm for arm in theirs if "videos" in arm.name), theirs[0]),
    )
    hour = [["", "episodes/hour", "seconds, every repeat"]]
    hour += [
        [
            arm.name,
            f"{3600 * plan.episodes / _typical(arm):.0f}",
            " ".join(f"{s:.1f}" for s in arm.seconds),
        ]
        for arm in (*theirs, *ours)
    ]
    every, calls = ours[::2], ours[1::2]
    pairs = [
        (f"{fast.name} / {slow.name}{mark}", slow, fast)
        for fast in (every[-1], calls[-1])
        for slow, mark in ((default, ""), (best, " (its best)"))
    ]
    if len(every) > 1:
        pairs += [(f"{every[0].name} / {best.name} (its best)", best, every[0])]
        pairs += [
            (f"scaling, 1 to {plan.workers} workers{end}", arms[0], arms[1])
            for end, arms in zip(FOLLOW.values(), (every, calls), strict=True)
        ]
    ratios = [
        ["times as fast", "ratio", "95 % interval"],
        *([what, *_ratio(slow, fast)] for what, slow, fast in pairs),
    ]
    steps = plan.episodes * plan.steps * plan.repeats
    names = list(dict.fromkeys(part for arm in (best, *ours) for part in arm.parts))
    shares = [["ms a control step (summed over workers)", *names]]
    shares += [
        [
            arm.name,
            *(
                f"{1e3 * arm.parts[part] / steps:.1f}" if part in arm.parts else "-"
                for part in names
            ),
        ]
        for arm in (*theirs, *ours)
    ]
    return "\n".join(
        [
            f"{SUITE}/{TASK}: n = {plan.episodes} episodes of {plan.steps} steps, {plan.repeats} repeats, {len(os.sched_getaffinity(0))} cores",
            *("", align(hour), "", align(ratios), "", align(shares)),
        ]
    )


def _ratio(slow: Arm, fast: Arm) -> list[str]:
    middle, low, high = ratio(slow.seconds, fast.seconds)
    return [f"{middle:.2f}", f"{low:.2f} .. {high:.2f}"]


def _typical(arm: Arm) -> float:
    return float(np.median(arm.seconds))


def _timed(work: Callable[..., Any], parts: dict[str, float], part: str) -> Callable[..., Any]:
    def go(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return work(*args, **kwargs)
        finally:
            parts[part] += time.perf_counter() - start

    return go


@contextmanager
def _hooked(holder: Any, name: str, parts: dict[str, float], part: str) -> Iterator[None]:
    """Inside, `holder.name` counts its time."""
    held = name in vars(holder)
    assert not held, f"{name} is hooked already"
    setattr(holder, name, _timed(getattr(holder, name), parts, part))
    try:
        yield
    finally:
        delattr(holder, name)
