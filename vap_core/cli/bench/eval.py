"""Our rollouts against lerobot's own evaluation loop, in one run: on equal CPU, and in wall time.

Both run the same policy, environment, episodes and per-step VAP. The policy is lerobot's PI0 at toy
size with random weights, which change nothing about speed; no episode is solved, so all last
`steps`. Equal CPU is one process with one thread on either side, in CPU time: the merit of the
loop. Wall time is what a user sees on this machine's cores, each as it comes: lerobot's in one
process or with environments in theirs, torch on one thread or on all; ours in several processes.
lerobot's loop shares `attend` with ours and so gets faster when ours does: `earlier` names a
checkout whose loop is the fixed denominator. Start-up does not count: everything is built and warm.
"""

import json
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from vap_core.cli.bench.eval_lerobot import lerobot_arms
from vap_core.cli.bench.eval_plan import QUICK, SUITE, TASK, Arm, Cost, Plan
from vap_core.cli.bench.eval_rollout import rollout_arms
from vap_core.cli.bench.measurement import Measurement, provenance, read, write

SAME = ("commit", "machine", "libraries", "n", "task")
"""What must be the same for a measurement to go on."""


def measure(
    workers: int = 2,
    earlier: Path | None = None,
    *,
    repeats: int = 5,
    quick: bool = False,
    part: Path | None = None,
) -> Measurement:
    """Measure all arms; four minutes a repeat with an earlier checkout, `quick` a minute in all.

    The arms of a repeat follow each other in turn, beginning with another one each time. Whole
    repeats are kept in the file `part`; interrupted, the same call goes on after the last of them.

    Raises: BadOutput, when `part` cannot be read or written.
    """
    from tqdm import tqdm

    plan = QUICK if quick else replace(Plan(), workers=workers, repeats=repeats)
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        folder = Path(scratch)
        arms = lerobot_arms(plan, folder, stack, earlier)
        # The last of lerobot's processes has prepared this folder with this checkout's code.
        prepared = sorted(folder.glob("lerobot-*"))[-1]
        arms += rollout_arms(plan, prepared, stack)
        done = 0 if part is None else resume(arms, part, _measurement(plan, arms, earlier))
        turns = range(done * len(arms), plan.repeats * len(arms))
        for turn in tqdm(turns, unit="run", disable=None):
            repeat = turn // len(arms)
            arms[(turn + repeat) % len(arms)].repeat()
            if part is not None and turn % len(arms) == len(arms) - 1:
                write(_measurement(plan, arms, earlier), part)
    return _measurement(plan, arms, earlier)


def resume(arms: list[Arm], part: Path, now: Measurement) -> int:
    """Give arms the costs of the whole repeats in `part`, and return how many these are.

    They are none where that measurement was of another machine, code or plan than `now`.

    Raises: BadOutput.
    """
    if not part.exists():
        return 0
    kept = read(part)
    about = json.loads(json.dumps(now.provenance))
    if any(kept.provenance[name] != about[name] for name in SAME):
        return 0
    if [arm["name"] for arm in kept.values["arms"]] != [arm.name for arm in arms]:
        return 0
    for arm, values in zip(arms, kept.values["arms"], strict=True):
        arm.costs = [Cost(**cost) for cost in values["costs"]]
    return len(arms[0].costs)


def _measurement(plan: Plan, arms: list[Arm], earlier: Path | None) -> Measurement:
    command = "python -m vap_core bench eval"
    if earlier is not None:
        command += " --lerobot-from DIR"
    about = provenance(
        command,
        n=f"{plan.episodes} episodes of {plan.steps} steps",
        repeats=len(arms[0].costs),
        task=f"{SUITE}/{TASK}",
    )
    values = {
        "episodes": plan.episodes,
        "steps": plan.steps,
        "workers": plan.workers,
        "arms": [arm.values() for arm in arms],
    }
    return Measurement("eval", about, values)
