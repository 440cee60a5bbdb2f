"""Seconds by part of running code; as a script, lerobot's own evaluation loop for `bench eval`.

    python -P timing.py FOLDER PLAN.json

As a script `vap_core` is whichever the process finds first, so that the loop of an earlier checkout
can be timed with PYTHONPATH. Therefore it takes from the package only what it had at 1cce9d7, in
its functions. It prints {"ready": PATH OF THE PACKAGE}; then, for every line of standard input that
names an arm (n_envs, in_processes, threads, videos), one line of seconds: wall, cpu, and CPU by
part. Everything is built and warm before the first; what others print goes to standard error.
"""

import functools
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

_ABSENT = object()


class Parts:
    """Seconds by part, of functions that are hooked for a while.

    A part's seconds are without those of the parts that it calls. A part that is hooked as `whole`
    keeps them: inside it, no other part is counted.
    """

    def __init__(self, clock: Callable[[], float] = time.process_time) -> None:
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self._inside: list[float] = []
        self._whole = False

    @contextmanager
    def hooked(self, owner: Any, name: str, part: str, *, whole: bool = False) -> Iterator[None]:
        """Inside, calls of `owner.name` count for `part`; `owner` is a module, class or object."""
        before = vars(owner).get(name, _ABSENT)
        setattr(owner, name, self.timed(getattr(owner, name), part, whole=whole))
        try:
            yield
        finally:
            if before is _ABSENT:
                delattr(owner, name)
            else:
                setattr(owner, name, before)

    def timed(
        self, work: Callable[..., Any], part: str, *, whole: bool = False
    ) -> Callable[..., Any]:
        """`work`, whose calls count for `part`."""
        self.seconds.setdefault(part, 0.0)

        @functools.wraps(work)
        def counted(*args: Any, **kwargs: Any) -> Any:
            if self._whole:
                return work(*args, **kwargs)
            self._whole = whole
            self._inside.append(0.0)
            start = self.clock()
            try:
                return work(*args, **kwargs)
            finally:
                seconds = self.clock() - start
                self.seconds[part] += seconds - self._inside.pop()
                self._whole = False
                if self._inside:
                    self._inside[-1] += seconds

        return counted

    def with_rest(self, total: float) -> dict[str, float]:
        """Seconds by part, and as "rest" what `total` seconds have beyond them."""
        return {**self.seconds, "rest": total - sum(self.seconds.values())}


def main() -> None:
    """Answer every line of standard input."""
    import vap_core
    from vap_core.policies.lerobot.toy_pi0 import Toy, toy_sizes

    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    folder = Path(sys.argv[1])
    plan = json.loads(Path(sys.argv[2]).read_text())
    toy = Toy(**plan["toy"])
    with toy_sizes(toy), ExitStack() as stack:
        _prepare(plan, toy, folder)
        run = _loop(plan, folder, stack)
        print(json.dumps({"ready": vap_core.__file__}), file=answers, flush=True)
        for line in sys.stdin:
            print(json.dumps(run(**json.loads(line))), file=answers, flush=True)


def _prepare(plan: dict[str, Any], toy: Any, folder: Path) -> None:
    """The memory of the personal object, a toy PI0, and the same one with VAP for lerobot."""
    from vap_core.memory import register, save
    from vap_core.perception.stacks import load_stack
    from vap_core.policies.lerobot.step import VapEnvConfig, attach
    from vap_core.policies.lerobot.toy_pi0 import save_toy
    from vap_core.simulation import suites
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.studio import reference_views

    stack = load_stack("embedded")
    row = suites.rows(plan["suite"], plan["task"])[0]
    photos = reference_views(get_object(row.target))
    obj, _ = register(row.target, row.category, photos, stack.detector, stack.encoder)
    save(folder / "memory", obj)
    features = VapEnvConfig(task=f"{plan['suite']}/{plan['task']}").features
    sizes = (features["agent_pos"].shape[0], features["action"].shape[0])
    save_toy(folder / "pi0", suites.suite(plan["suite"]).cameras, *sizes, toy)
    attach(folder / "pi0", folder / "vap", folder / "memory")


def _loop(plan: dict[str, Any], folder: Path, stack: ExitStack) -> Callable[..., dict[str, Any]]:
    """lerobot.scripts.lerobot_eval.eval_policy, called as its command calls it."""
    import numpy as np
    import torch
    from lerobot.policies import make_pre_post_processors
    from lerobot.scripts.lerobot_eval import eval_policy

    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.step import VapEnvConfig

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
        env.step(np.zeros((n_envs, policy.config.action_feature.shape[0]), np.float32))
        envs[n_envs, in_processes] = env

    def cpu_seconds() -> float:
        """Of this process, and of its children that have ended."""
        used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return sum(usage.ru_utime + usage.ru_stime for usage in used)

    def run(n_envs: int, in_processes: bool, threads: int, videos: bool) -> dict[str, Any]:
        env = envs[n_envs, in_processes]
        torch.set_num_threads(threads)
        parts = Parts()
        with ExitStack() as hooks:
            preprocessor.steps[1] = parts.timed(prompt, "attend", whole=True)
            for owner, name, part in (
                (env, "step", "environment"),
                (env, "reset", "environment"),
                (policy, "select_action", "policy"),
            ):
                hooks.enter_context(parts.hooked(owner, name, part, whole=True))
            wall, cpu = time.perf_counter(), cpu_seconds()
            eval_policy(
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
            wall, cpu = time.perf_counter() - wall, cpu_seconds() - cpu
        preprocessor.steps[1] = prompt
        return {"wall": wall, "cpu": cpu, "parts": parts.with_rest(cpu)}

    return run


if __name__ == "__main__":
    main()
