"""The tables of the evaluation benchmark."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from vap_core.cli.bench.eval_plan import FOLLOW
from vap_core.cli.bench.measurement import Measurement, Table
from vap_core.evaluation.statistics import ratio

Values = Mapping[str, Any]
Arm = dict[str, Any]
"""One arm's values (eval_plan.Arm.values)."""
Clock = Literal["cpu", "wall"]
EQUAL: Clock = "cpu"
WALL: Clock = "wall"
COLUMNS = {"cpu": "equal_cpu", "wall": "wall"}
"""The field of an arm that names its part in the table of each clock."""
PARTS = ("environment", "attend", "policy", "rest")
SETTINGS = ("as it comes", "best")
"""Of lerobot's loop."""


def tables(measurement: Measurement) -> list[Table]:
    """Equal CPU and wall time, each with its ratios."""
    values = measurement.values
    return [
        _equal_cpu(values),
        _ratios("Times as fast as lerobot's loop on equal CPU", values, EQUAL),
        _wall(values),
        _ratios("Times as fast as lerobot's loop in wall time", values, WALL),
    ]


def speed_up(
    values: Values, clock: Clock, ours: str, theirs: str, code: str = ""
) -> tuple[float, float, float]:
    """How many times as fast ours is as lerobot's: mean within repeats, 95 % interval.

    `ours` is of FOLLOW's names, `theirs` of SETTINGS, of the checkout `code` (default: the first
    that was measured, the fixed denominator).
    """
    fast = _ours(values, clock, ours)
    slow = lerobot_arm(values, clock, theirs, code or lerobot_codes(values)[0])
    return ratio(seconds(slow, clock), seconds(fast, clock))


def scaling(values: Values, ours: str) -> tuple[float, float, float]:
    """How many times as fast ours is with its workers as with one, in wall time."""
    alone = seconds(_ours(values, EQUAL, ours), WALL)
    return ratio(alone, seconds(_ours(values, WALL, ours), WALL))


def lerobot_codes(values: Values) -> list[str]:
    """The versions whose lerobot loop was measured."""
    codes = [arm["code"] for arm in values["arms"] if arm["loop"] == "lerobot"]
    return list(dict.fromkeys(codes))


def lerobot_arm(values: Values, clock: Clock, setting: str, code: str) -> Arm:
    """lerobot's loop in a setting; of several that may be its best the fastest."""
    found = []
    for arm in values["arms"]:
        is_code = arm["loop"] == "lerobot" and arm["code"] == code
        if is_code and arm[COLUMNS[clock]] == setting:
            found.append(arm)
    return min(found, key=lambda arm: float(np.median(seconds(arm, clock))))


def seconds(arm: Arm, clock: Clock) -> list[float]:
    """What the arm took in every repeat."""
    return [cost[clock] for cost in arm["costs"]]


def in_brackets(found: tuple[float, float, float]) -> str:
    """A ratio and its interval."""
    middle, low, high = found
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def _ours(values: Values, clock: Clock, name: str) -> Arm:
    for arm in values["arms"]:
        if arm["loop"] == "ours" and arm[COLUMNS[clock]] == name:
            return dict(arm)
    raise AssertionError(f"no arm of ours {name}")


def _label(arm: Arm) -> str:
    if arm["loop"] == "ours":
        return f"ours: {arm['name']}"
    return f"lerobot's loop of {arm['code']}: {arm['name']}"


def _equal_cpu(values: Values) -> Table:
    header = ["one process, one thread", "episodes per CPU-hour", "ms a step", *PARTS]
    rows = [header]
    n_steps = values["episodes"] * values["steps"]
    for arm in values["arms"]:
        if not arm["equal_cpu"]:
            continue
        row = [_label(arm), _per_hour(values, arm, EQUAL)]
        row.append(f"{1e3 * np.median(seconds(arm, EQUAL)) / n_steps:.1f}")
        for part in PARTS:
            spent = np.median([cost["parts"][part] for cost in arm["costs"]])
            row.append(f"{1e3 * spent / n_steps:.1f}")
        rows.append(row)
    note = (
        "Medians of the repeats. The environment is the simulator, its truth and the judge; the "
        "rest of lerobot's loop is its processors and, as it comes, its videos."
    )
    return Table("Equal CPU", rows, note)


def _wall(values: Values) -> Table:
    rows = [["as each comes on all cores", "episodes per hour", "seconds, every repeat"]]
    for arm in values["arms"]:
        if arm["wall"]:
            every = " ".join(f"{s:.1f}" for s in seconds(arm, WALL))
            rows.append([_label(arm), _per_hour(values, arm, WALL), every])
    texts = [f"{in_brackets(scaling(values, name))} {name}" for name in FOLLOW.values()]
    note = f"Ours, from one worker to {values['workers']}: times {', '.join(texts)}."
    return Table("Wall time", rows, note)


def _ratios(title: str, values: Values, clock: Clock) -> Table:
    header = ["ours"]
    for code in lerobot_codes(values):
        for setting in SETTINGS:
            header.append(f"{setting}, {code}")
    rows = [header]
    for ours in FOLLOW.values():
        row = [ours]
        for code in lerobot_codes(values):
            for setting in SETTINGS:
                row.append(in_brackets(speed_up(values, clock, ours, setting, code)))
        rows.append(row)
    note = "Geometric means of the ratios within repeats, 95 % intervals."
    if clock == WALL:
        best = [lerobot_arm(values, WALL, "best", code)["name"] for code in lerobot_codes(values)]
        note += f" lerobot's best: {'; '.join(best)}."
    return Table(title, rows, note)


def _per_hour(values: Values, arm: Arm, clock: Clock) -> str:
    return f"{3600 * values['episodes'] / np.median(seconds(arm, clock)):.0f}"
