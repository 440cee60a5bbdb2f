"""lerobot's own evaluation loop in a process of its own, for `bench eval`; run as a script.

    python -P lerobot_process.py FOLDER PLAN.json

`vap_core` is whichever the process finds first, so that the loop of an earlier checkout can be
timed with PYTHONPATH. Therefore this file takes from the package only what it had at 1cce9d7, and
the timing helper by its path. It prints {"ready": PATH OF THE PACKAGE}; then, for every line of
standard input that names an arm (n_envs, in_processes, threads, videos), one line of seconds: wall,
cpu, and CPU by part. Everything is built and warm before the first; what others print goes to
standard error.
"""

import importlib.util
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import vap_core
from vap_core.memory import register, save
from vap_core.perception.stacks import load_stack
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.lerobot.step import VapEnvConfig, attach
from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, toy_sizes
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views


def main() -> None:
    """Answer every line of standard input."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    folder = Path(sys.argv[1])
    plan = json.loads(Path(sys.argv[2]).read_text())
    toy = Toy(**plan["toy"])
    with toy_sizes(toy), ExitStack() as stack:
        prepare(plan, toy, folder)
        run = _loop(plan, folder, stack)
        print(json.dumps({"ready": vap_core.__file__}), file=answers, flush=True)
        for line in sys.stdin:
            print(json.dumps(run(**json.loads(line))), file=answers, flush=True)


def prepare(plan: dict[str, Any], toy: Toy, folder: Path) -> None:
    """The memory of the personal object, a toy PI0, and the same one with VAP for lerobot.

    Raises: BadOutput when `folder` cannot be written, or holds them already.
    """
    suite, task = plan["suite"], plan["task"]
    stack = load_stack("embedded")
    row = suites.rows(suite, task)[0]
    photos = reference_views(get_object(row.target))
    obj, _ = register(row.target, row.category, photos, stack.detector, stack.encoder)
    save(folder / "memory", obj)
    env = VapEnvConfig(task=f"{suite}/{task}")
    save_toy(
        folder / "pi0",
        suites.suite(suite).cameras,
        env.features["agent_pos"].shape[0],
        env.features["action"].shape[0],
        toy,
    )
    attach(folder / "pi0", folder / "vap", folder / "memory")


def _loop(plan: dict[str, Any], folder: Path, stack: ExitStack) -> Callable[..., dict[str, Any]]:
    """lerobot.scripts.lerobot_eval.eval_policy, called as its command calls it."""
    import torch
    from lerobot.policies import make_pre_post_processors
    from lerobot.scripts.lerobot_eval import eval_policy

    timing = _timing()
    policy = load_policy(folder / "pi0", "cpu").policy
    config = VapEnvConfig(task=f"{plan['suite']}/{plan['task']}", max_steps=plan["steps"])
    before, after = config.get_env_processors()
    preprocessor, postprocessor = make_pre_post_processors(policy.config, str(folder / "vap"))
    prompt = preprocessor.steps[1]
    envs: dict[tuple[int, bool], Any] = {}
    for n_envs, in_processes in plan["loops"]:
        env: Any = config.create_envs(n_envs, use_async_envs=in_processes)[plan["suite"]][0]
        stack.callback(env.close)
        env.reset(seed=list(range(n_envs)))
        n_actions = policy.config.action_feature.shape[0]
        env.step(np.zeros((n_envs, n_actions), np.float32))
        envs[n_envs, in_processes] = env

    def run(n_envs: int, in_processes: bool, threads: int, videos: bool) -> dict[str, Any]:
        """One evaluation of all episodes."""
        env = envs[n_envs, in_processes]
        torch.set_num_threads(threads)
        parts = timing.Parts()
        with ExitStack() as hooks:
            preprocessor.steps[1] = parts.timed(prompt, "attend", whole=True)
            for owner, name, part in (
                (env, "step", "environment"),
                (env, "reset", "environment"),
                (policy, "select_action", "policy"),
            ):
                hooks.enter_context(parts.hooked(owner, name, part, whole=True))
            wall, cpu = time.perf_counter(), _cpu_seconds()
            done = eval_policy(
                env=env,
                policy=policy,
                env_preprocessor=before,
                env_postprocessor=after,
                preprocessor=preprocessor,
                postprocessor=postprocessor,
                n_episodes=plan["episodes"],
                max_episodes_rendered=10 if videos else 0,
                videos_dir=folder / "videos" if videos else None,
                start_seed=0,
            )
            wall, cpu = time.perf_counter() - wall, _cpu_seconds() - cpu
        preprocessor.steps[1] = prompt
        assert len(done["per_episode"]) == plan["episodes"]
        return {"wall": wall, "cpu": cpu, "parts": parts.with_rest(cpu)}

    return run


def _cpu_seconds() -> float:
    """Of this process, and of its children that have ended."""
    used = 0.0
    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        usage = resource.getrusage(who)
        used += usage.ru_utime + usage.ru_stime
    return used


def _timing() -> Any:
    """timing.py beside this file, whichever package is imported."""
    spec = importlib.util.spec_from_file_location(
        "bench_timing", Path(__file__).with_name("timing.py")
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
