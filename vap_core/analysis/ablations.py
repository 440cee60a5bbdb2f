"""What published ablations show: all effects in one figure, and one small picture each.

results = ablation_results(Path("data/results/ablations.parquet"))
all_effects_figure(results)
sweep_figure(results["opacity"], {"opacity-0.1": 0.1, "vap": 0.5, "opaque": 1.0}, "opacity")
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.figures import empty_figure
from vap_core.evaluation.ablations.arms import ABLATIONS
from vap_core.evaluation.ablations.picture import CLEAR, PAPER, UNCLEAR, draw_effects
from vap_core.evaluation.ablations.table import ArmResult, arm_results
from vap_core.evaluation.publish import read_runs

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Results = dict[str, list[ArmResult]]
"""The arms of every ablation, by its name."""


def ablation_episodes(path: Path) -> "pd.DataFrame":
    """Every episode of a published table of ablations. Raises: BadOutput."""
    import pandas as pd

    return pd.concat([episodes for _, episodes in read_runs(path)], ignore_index=True)


def ablation_results(episodes: "pd.DataFrame") -> Results:
    """The arms of every ablation that has been run, each against the first of its ablation."""
    found = {}
    for name, ablation in ABLATIONS.items():
        of_suites = episodes[episodes["suite"].isin(ablation.suites)]
        results = arm_results(ablation, of_suites)
        if results:
            found[name] = results
    return found


def all_effects_figure(results: Results) -> "Figure":
    """Every arm of every ablation: points of success against the ablation's first arm."""
    shown = [(name, [one for one in arms if one.against]) for name, arms in results.items()]
    n_rows = sum(len(arms) for _, arms in shown)
    figure = empty_figure(7.4, 0.9 + 0.2 * (n_rows + len(shown)))
    axes = figure.subplots()
    y = 0.0
    ticks = []
    labels = []
    for name, arms in shown:
        first = results[name][0]
        ticks.append(y)
        labels.append(f"{name}: against {first.arm}, {100 * first.sr.value:.0f} % of {first.sr.n}")
        y -= 1
        for one in arms:
            draw_effects(axes, one, results[name], y)
            ticks.append(y)
            labels.append(one.arm)
            y -= 1
    axes.set_yticks(ticks, labels, fontsize=7)
    headings = {f"{name}: " for name, _ in shown}
    for label in axes.get_yticklabels():
        if any(label.get_text().startswith(heading) for heading in headings):
            label.set_fontweight("bold")
    axes.set_ylim(y + 0.4, 0.6)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_xlabel("success rate, points against the first arm (95 %, paired)")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    _explain(figure)
    return figure


def sweep_figure(
    results: Sequence[ArmResult], places: Mapping[str, float], label: str, log: bool = False
) -> "Figure":
    """Success rates along a quantity, ours with 95 % intervals, the paper's dashed."""
    figure = empty_figure(4.2, 2.5)
    axes = figure.subplots()
    by_arm = {one.arm: one for one in results}
    present = sorted((place, by_arm[arm]) for arm, place in places.items() if arm in by_arm)
    xs = [place for place, _ in present]
    ours = [100 * one.sr.value for _, one in present]
    low = [100 * (one.sr.value - one.sr.low) for _, one in present]
    high = [100 * (one.sr.high - one.sr.value) for _, one in present]
    axes.errorbar(xs, ours, [low, high], color=CLEAR, marker="o", capsize=2, label="here, 95 %")
    theirs = [(place, 100 * one.paper) for place, one in present if one.paper == one.paper]
    if theirs:
        px, py = zip(*theirs, strict=True)
        axes.plot(px, py, "D--", color=PAPER, fillstyle="none", label="the paper, WidowX")
    if log:
        axes.set_xscale("log")
    axes.set_xticks(xs, [f"{x:g}" for x in xs])
    axes.minorticks_off()
    axes.set_xlabel(label)
    _finish(axes)
    return figure


def rates_of_arms_figure(results: Sequence[ArmResult]) -> "Figure":
    """The success rate of every arm, ours with 95 % intervals, the paper's as diamonds."""
    figure = empty_figure(4.6, 0.8 + 0.24 * len(results))
    axes = figure.subplots()
    for y, one in enumerate(reversed(results)):
        low, mid, high = (100 * x for x in (one.sr.low, one.sr.value, one.sr.high))
        axes.plot([low, high], [y, y], color=CLEAR, linewidth=2)
        axes.plot(mid, y, "o", color=CLEAR)
        if one.paper == one.paper:
            axes.plot(100 * one.paper, y, "D", color=PAPER, fillstyle="none", markersize=5)
    names = [f"{one.arm}, n {one.sr.n}" for one in reversed(results)]
    axes.set_yticks(range(len(results)), names, fontsize=8)
    axes.set_xlim(-3, 103)
    axes.set_xlabel("success rate, % (95 %; diamonds: the paper)", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def cases_text(results: Iterable[ArmResult]) -> str:
    """One line an arm: how many episodes failed by Case 1 and by Case 2."""
    lines = []
    for one in results:
        lines.append(
            f"{one.arm:22} SR {one.sr}, Case 1 {one.case_1.k} of {one.case_1.n}, "
            f"Case 2 {one.case_2.k} of {one.case_2.n}"
        )
    return "\n".join(lines)


def effect_text(results: Sequence[ArmResult], arm: str) -> str:
    """Points of success of an arm against the first, with its interval and n."""
    (one,) = [each for each in results if each.arm == arm]
    if one.against is None:
        return f"{100 * one.sr.value:.0f} % of {one.sr.n}"
    low, mid, high = (100 * x for x in (one.against.low, one.against.difference, one.against.high))
    return f"{mid:+.0f} [{low:+.0f}, {high:+.0f}]"


def _finish(axes: "Axes") -> None:
    axes.set_ylim(-3, 103)
    axes.set_ylabel("success rate, %")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)


def _explain(figure: "Figure") -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=CLEAR, marker="o", label="a difference"),
        Line2D([], [], color=UNCLEAR, marker="o", label="none shown"),
        Line2D([], [], color=PAPER, marker="D", fillstyle="none", linewidth=0, label="the paper's"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
