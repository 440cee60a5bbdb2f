"""What `bench scale` measured, as tables and as one picture of small multiples."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.figures import OURS, empty_figure
from vap_core.base.tables import signed
from vap_core.cli.bench.measurement import Measurement, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PARTS = {"environment": "#c9ccd1", "attend": "#c0392b", "policy": "#4e79a7", "rest": "#59a14f"}
"""The colours of the parts, from the bottom of a bar upwards."""


def tables(measurement: Measurement) -> list[Table]:
    """Cost by condition, workers, and memory."""
    return [_conditions(measurement), _workers(measurement), _memory(measurement)]


def figure(measurement: Measurement) -> "Figure":
    """CPU seconds of an episode along every axis, wall time by workers, memory by episodes."""
    whole = empty_figure(10.0, 6.0)
    axes = whole.subplots(2, 3).ravel()
    by_axis = _by_axis(measurement)
    for each, (axis, conditions) in zip(axes, by_axis.items(), strict=False):
        _draw_parts(each, axis, conditions)
    _draw_workers(axes[len(by_axis)], measurement.values["workers"])
    _draw_memory(axes[len(by_axis) + 1], measurement.values["memory"])
    handles, labels = axes[0].get_legend_handles_labels()
    whole.legend(handles, labels, loc="outside lower center", ncols=len(PARTS), frameon=False)
    return whole


def episode_s(condition: dict[str, Any]) -> list[float]:
    """CPU seconds of an episode in every repeat."""
    return [cost["cpu"] / condition["episodes"] for cost in condition["costs"]]


def ray_overhead_pct(workers: list[dict[str, Any]]) -> float | None:
    """What Ray adds to an episode beyond start-up, in percent; None where it was not measured."""
    seconds = {each["label"]: each["episode_s"] for each in workers}
    if "2, Ray" not in seconds:
        return None
    return float(100 * (seconds["2, Ray"] / seconds["2"] - 1))


def _by_axis(measurement: Measurement) -> dict[str, list[dict[str, Any]]]:
    by_axis: dict[str, list[dict[str, Any]]] = {}
    for condition in measurement.values["conditions"]:
        by_axis.setdefault(condition["axis"], []).append(condition)
    return by_axis


def _part_s(condition: dict[str, Any], part: str) -> float:
    """The median CPU seconds of an episode's part."""
    seconds = [cost["parts"][part] for cost in condition["costs"]]
    return float(np.median(seconds)) / condition["episodes"]


def _conditions(measurement: Measurement) -> Table:
    rows = [["", "", "CPU s an episode", "lowest .. highest", "times the first", *PARTS]]
    for axis, conditions in _by_axis(measurement).items():
        first = float(np.median(episode_s(conditions[0])))
        for condition in conditions:
            seconds = episode_s(condition)
            middle = float(np.median(seconds))
            row = [axis, condition["label"], f"{middle:.2f}"]
            row += [f"{min(seconds):.2f} .. {max(seconds):.2f}", f"{middle / first:.2f}"]
            row += [f"{_part_s(condition, part):.2f}" for part in PARTS]
            rows.append(row)
    return Table("CPU seconds of an episode, by part, medians of the repeats", rows)


def _workers(measurement: Measurement) -> Table:
    workers = measurement.values["workers"]
    rows = [["workers", "seconds of the run", "ms an episode beyond start-up"]]
    for each in workers:
        rows.append([each["label"], f"{each['seconds']:.1f}", f"{1e3 * each['episode_s']:.0f}"])
    overhead = ray_overhead_pct(workers)
    note = "Ray is not installed and was not measured."
    if overhead is not None:
        note = (
            f"Ray over processes: {signed(overhead)} % beyond start-up, in one run each; "
            "`bench engine` repeats it."
        )
    return Table("Wall time by workers", rows, note)


def _memory(measurement: Measurement) -> Table:
    rows = [["episodes", "MB that one process holds"]]
    for done, megabytes in measurement.values["memory"]:
        rows.append([str(done), f"{megabytes:.0f}"])
    return Table("Memory", rows)


def _draw_parts(axes: "Axes", axis: str, conditions: list[dict[str, Any]]) -> None:
    """Stacked bars of the parts, and a dot for every repeat's total."""
    labels = [condition["label"] for condition in conditions]
    bottom = np.zeros(len(conditions))
    for part, colour in PARTS.items():
        heights = np.array([_part_s(condition, part) for condition in conditions])
        axes.bar(labels, heights, bottom=bottom, color=colour, width=0.6, label=part)
        bottom += heights
    for i, condition in enumerate(conditions):
        seconds = episode_s(condition)
        axes.plot([i] * len(seconds), seconds, ".", color="black", markersize=4)
    axes.set_title(axis)
    axes.set_ylabel("CPU s an episode")
    _trim(axes)


def _draw_workers(axes: "Axes", workers: list[dict[str, Any]]) -> None:
    labels = [each["label"] for each in workers]
    axes.bar(labels, [each["episode_s"] for each in workers], color="#8c8c8c", width=0.6)
    axes.set_title("workers, beyond start-up")
    axes.set_ylabel("wall s an episode")
    _trim(axes)


def _draw_memory(axes: "Axes", series: list[tuple[int, float]]) -> None:
    done, megabytes = zip(*series, strict=True)
    axes.plot(done, np.array(megabytes) / 1e3, ".-", color=OURS)
    axes.set_ylim(bottom=0)
    axes.set_title("memory of one process")
    axes.set_xlabel("episodes run")
    axes.set_ylabel("GB")
    _trim(axes)


def _trim(axes: "Axes") -> None:
    axes.spines[["top", "right"]].set_visible(False)
