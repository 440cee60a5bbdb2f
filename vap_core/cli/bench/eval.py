"""Episodes per hour of our rollouts against lerobot's own evaluation loop, in one run.

Both run the same policy, environment, episodes and per-step VAP. The policy is lerobot's PI0 at toy
size with random weights, which change nothing about speed; no episode is solved, so all last
`steps`. lerobot runs as it comes on a machine of few cores (one environment, videos of the first
ten episodes) and at its best (no videos; one or four environments; in this process or in their own;
torch on one thread or on all). Start-up does not count: everything is built and warm.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.cli.bench.eval_plan import QUICK, SUITE, TASK, Arm, Plan, Work, count_of
from vap_core.cli.bench.eval_report import report
from vap_core.cli.bench.eval_rollout import rollout_arms
from vap_core.policies.lerobot.toy_pi0 import save_toy, toy_sizes
from vap_core.simulation import suites


def run(workers: int = 2, quick: bool = False) -> str:
    """Measure everything and report it; about ten minutes, `quick` half a minute."""
    plan = QUICK if quick else replace(Plan(), workers=workers)
    plan, theirs, ours = measure(plan)
    return report(plan, theirs, ours)


def measure(plan: Plan) -> tuple[Plan, list[Arm], list[Arm]]:
    """The plan, lerobot's arms and ours.

    The arms of a repeat follow each other in turn, beginning with another one each time.
    """
    import torch
    from tqdm import tqdm

    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as scratch, toy_sizes(plan.toy), ExitStack() as stack:
        folder = Path(scratch)
        prepare(plan, folder)
        theirs = _lerobot_arms(plan, folder, stack)
        ours = rollout_arms(plan, folder, stack)
        arms = [*theirs, *ours]
        try:
            for turn in tqdm(range(plan.repeats * len(arms)), unit="run", disable=None):
                repeat = turn // len(arms)
                arms[(turn + repeat) % len(arms)].repeat()
        finally:
            torch.set_num_threads(threads)
    return plan, theirs, ours


def prepare(plan: Plan, folder: Path) -> None:
    """The memory of the personal object, a toy PI0, and the same one with VAP for lerobot."""
    from vap_core.memory import register, save
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.step import VapEnvConfig, attach
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import reference_views

    stack = load_stack("embedded")
    row = plan.rows()[0]
    photos = reference_views(get_object(row.target))
    obj, _ = register(row.target, row.category, photos, stack.detector, stack.encoder)
    save(folder / "memory", obj)
    env = VapEnvConfig(task=f"{SUITE}/{TASK}")
    save_toy(
        folder / "pi0",
        suites.suite(SUITE).cameras,
        env.features["agent_pos"].shape[0],
        env.features["action"].shape[0],
        plan.toy,
    )
    attach(folder / "pi0", folder / "vap", folder / "memory")


def _lerobot_arms(plan: Plan, folder: Path, stack: ExitStack) -> list[Arm]:
    """lerobot.scripts.lerobot_eval.eval_policy, called as its command calls it."""
    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.step import VapEnvConfig

    policy = load_policy(folder / "pi0", "cpu").policy
    config = VapEnvConfig(task=f"{SUITE}/{TASK}", max_steps=plan.steps)
    arms = []
    for n_envs, in_processes in plan.loops:
        env: Any = config.create_envs(n_envs, use_async_envs=in_processes)[SUITE][0]
        stack.callback(env.close)
        env.reset(seed=list(range(n_envs)))
        n_actions = policy.config.action_feature.shape[0]
        env.step(np.zeros((n_envs, n_actions), np.float32))
        for threads in plan.threads:
            place = "in processes" if in_processes else "in one process"
            name = f"lerobot, {n_envs} env {place}, {count_of(threads, 'thread')}"
            if n_envs == 1 and threads == plan.threads[-1]:
                work = _evaluation(
                    plan=plan,
                    env=env,
                    policy=policy,
                    pipelines=_pipelines(config, policy, folder),
                    threads=threads,
                    videos=folder / "videos",
                )
                arms.append(Arm(f"{name}, videos (as it comes)", work, [], {}))
            work = _evaluation(
                plan=plan,
                env=env,
                policy=policy,
                pipelines=_pipelines(config, policy, folder),
                threads=threads,
                videos=None,
            )
            arms.append(Arm(name, work, [], {}))
    return arms


def _pipelines(config: Any, policy: Any, folder: Path) -> tuple[Any, ...]:
    """lerobot's processors: of the environment, before and after, and of the policy with VAP."""
    from lerobot.policies import make_pre_post_processors

    of_policy = make_pre_post_processors(policy.config, str(folder / "vap"))
    return (*config.get_env_processors(), *of_policy)


def _evaluation(
    plan: Plan, env: Any, policy: Any, pipelines: Sequence[Any], threads: int, videos: Path | None
) -> Work:
    """One evaluation of all episodes; returns seconds by part."""
    import torch
    from lerobot.scripts.lerobot_eval import eval_policy

    before, after, preprocessor, postprocessor = pipelines
    prompt = preprocessor.steps[1]

    def evaluate() -> Mapping[str, float]:
        names = ("environment", "all processors", "attend", "policy")
        parts: dict[str, float] = dict.fromkeys(names, 0.0)
        torch.set_num_threads(threads)
        with ExitStack() as hooks:
            preprocessor.steps[1] = _timed(prompt, parts, "attend")
            hooks.enter_context(_timed_method(env, "step", parts, "environment"))
            hooks.enter_context(_timed_method(env, "reset", parts, "environment"))
            hooks.enter_context(_timed_method(policy, "select_action", parts, "policy"))
            # lerobot shows two progress bars.
            silence = hooks.enter_context(Path(os.devnull).open("w"))
            hooks.enter_context(redirect_stderr(silence))
            done = eval_policy(
                env=env,
                policy=policy,
                env_preprocessor=before,
                env_postprocessor=after,
                preprocessor=_timed(preprocessor, parts, "all processors"),
                postprocessor=postprocessor,
                n_episodes=plan.episodes,
                max_episodes_rendered=10 if videos else 0,
                videos_dir=videos,
                start_seed=0,
            )
        assert len(done["per_episode"]) == plan.episodes
        parts["processors"] = parts.pop("all processors") - parts["attend"]
        return parts

    return evaluate


def _timed(work: Callable[..., Any], parts: dict[str, float], part: str) -> Callable[..., Any]:
    """`work`, with its seconds added to a part."""

    def timed(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return work(*args, **kwargs)
        finally:
            parts[part] += time.perf_counter() - start

    return timed


@contextmanager
def _timed_method(owner: Any, name: str, parts: dict[str, float], part: str) -> Iterator[None]:
    """Inside, `owner.name` adds its seconds to a part."""
    assert name not in vars(owner), f"{name} is hooked already"
    setattr(owner, name, _timed(getattr(owner, name), parts, part))
    try:
        yield
    finally:
        delattr(owner, name)
