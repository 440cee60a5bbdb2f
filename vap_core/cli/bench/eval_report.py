"""The tables of the evaluation benchmark."""

import os
from collections.abc import Sequence

import numpy as np

from vap_core.base.tables import align
from vap_core.cli.bench.eval_plan import FOLLOW, SUITE, TASK, Arm, Plan
from vap_core.evaluation.statistics import ratio


def report(plan: Plan, theirs: Sequence[Arm], ours: Sequence[Arm]) -> str:
    """Three tables: episodes per hour, ratios, and how long each part of a step takes."""
    best = min(theirs, key=_median_seconds)
    default = _default_arm(theirs)
    arms = [*theirs, *ours]
    names = _part_names([best, *ours])
    title = (
        f"{SUITE}/{TASK}: n = {plan.episodes} episodes of {plan.steps} steps, "
        f"{plan.repeats} repeats, {len(os.sched_getaffinity(0))} cores"
    )
    tables = (
        _rates_table(plan, arms),
        _ratios_table(plan, default, best, ours),
        _parts_table(plan, arms, names),
    )
    lines = [title]
    for table in tables:
        lines += ["", align(table)]
    return "\n".join(lines)


def times_as_fast(slow: Arm, fast: Arm) -> list[str]:
    """How many times as fast one arm is as another: the ratio, and its 95 % interval."""
    middle, low, high = ratio(slow.seconds, fast.seconds)
    return [f"{middle:.2f}", f"{low:.2f} .. {high:.2f}"]


def _rates_table(plan: Plan, arms: Sequence[Arm]) -> list[list[str]]:
    rows = [["", "episodes/hour", "seconds, every repeat"]]
    for arm in arms:
        per_hour = 3600 * plan.episodes / _median_seconds(arm)
        seconds = " ".join(f"{s:.1f}" for s in arm.seconds)
        rows.append([arm.name, f"{per_hour:.0f}", seconds])
    return rows


def _ratios_table(plan: Plan, default: Arm, best: Arm, ours: Sequence[Arm]) -> list[list[str]]:
    """Ours over lerobot's as it comes and at its best, and ours with more workers over one."""
    at_steps = ours[::2]
    at_calls = ours[1::2]
    rows = [["times as fast", "ratio", "95 % interval"]]
    for fast in (at_steps[-1], at_calls[-1]):
        rows.append([f"{fast.name} / {default.name}", *times_as_fast(default, fast)])
        rows.append([f"{fast.name} / {best.name} (its best)", *times_as_fast(best, fast)])
    if len(at_steps) > 1:
        alone = at_steps[0]
        rows.append([f"{alone.name} / {best.name} (its best)", *times_as_fast(best, alone)])
        for ending, arms in zip(FOLLOW.values(), (at_steps, at_calls), strict=True):
            name = f"scaling, 1 to {plan.workers} workers{ending}"
            rows.append([name, *times_as_fast(arms[0], arms[1])])
    return rows


def _default_arm(theirs: Sequence[Arm]) -> Arm:
    """lerobot as it comes, with videos; the first arm where none has them."""
    for arm in theirs:
        if "videos" in arm.name:
            return arm
    return theirs[0]


def _part_names(arms: Sequence[Arm]) -> list[str]:
    names: dict[str, None] = {}
    for arm in arms:
        names |= dict.fromkeys(arm.parts)
    return list(names)


def _parts_table(plan: Plan, arms: Sequence[Arm], names: Sequence[str]) -> list[list[str]]:
    n_steps = plan.episodes * plan.steps * plan.repeats
    rows = [["ms a control step (summed over workers)", *names]]
    for arm in arms:
        row = [arm.name]
        for part in names:
            cell = "-"
            if part in arm.parts:
                cell = f"{1e3 * arm.parts[part] / n_steps:.1f}"
            row.append(cell)
        rows.append(row)
    return rows


def _median_seconds(arm: Arm) -> float:
    return float(np.median(arm.seconds))
