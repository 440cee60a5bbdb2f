"""Our rollouts against lerobot's own evaluation loop, in one run: on equal CPU, and in wall time.

Both run the same policy, environment, episodes and per-step VAP. The policy is lerobot's PI0 at toy
size with random weights, which change nothing about speed; no episode is solved, so all last
`steps`. Equal CPU is one process with one thread on either side, in CPU time: the merit of the
loop. Wall time is what a user sees on this machine's cores, each as it comes: lerobot's in one
process or with environments in theirs, torch on one thread or on all; ours in several processes.
lerobot's loop shares `attend` with ours and so gets faster when ours does: `earlier` names a
checkout whose loop is the fixed denominator. Start-up does not count: everything is built and warm.
"""

import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from vap_core.cli.bench.eval_lerobot import lerobot_arms
from vap_core.cli.bench.eval_plan import QUICK, SUITE, TASK, Arm, Plan
from vap_core.cli.bench.eval_rollout import rollout_arms
from vap_core.cli.bench.measurement import Measurement, provenance


def measure(
    workers: int = 2, earlier: Path | None = None, *, repeats: int = 5, quick: bool = False
) -> Measurement:
    """Measure all arms; ten minutes with an earlier checkout, `quick` a minute.

    The arms of a repeat follow each other in turn, beginning with another one each time.
    """
    from tqdm import tqdm

    plan = QUICK if quick else replace(Plan(), workers=workers, repeats=repeats)
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        folder = Path(scratch)
        arms = lerobot_arms(plan, folder, stack, earlier)
        # The last of lerobot's processes has prepared this folder with this checkout's code.
        prepared = sorted(folder.glob("lerobot-*"))[-1]
        arms += rollout_arms(plan, prepared, stack)
        for turn in tqdm(range(plan.repeats * len(arms)), unit="run", disable=None):
            repeat = turn // len(arms)
            arms[(turn + repeat) % len(arms)].repeat()
    return _measurement(plan, arms, earlier)


def _measurement(plan: Plan, arms: list[Arm], earlier: Path | None) -> Measurement:
    command = "python -m vap_core bench eval"
    if earlier is not None:
        command += " --lerobot-from DIR"
    about = provenance(
        command,
        n=f"{plan.episodes} episodes of {plan.steps} steps",
        repeats=plan.repeats,
        task=f"{SUITE}/{TASK}",
    )
    values = {
        "episodes": plan.episodes,
        "steps": plan.steps,
        "workers": plan.workers,
        "arms": [arm.values() for arm in arms],
    }
    return Measurement("eval", about, values)
