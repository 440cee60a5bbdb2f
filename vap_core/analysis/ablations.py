"""What published ablations show: all effects in one figure, and one small picture each.

results = ablation_results(ablation_episodes(Path("data/results/ablations.parquet")))
all_effects_figure(results)
sweep_figure(results["opacity"], {"opacity-0.1": 0.1, "vap": 0.5, "opaque": 1.0}, "opacity")
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.pictures import CASES, empty_figure
from vap_core.study.ablations import (
    CLEAR,
    PAPER,
    PAPER_SUITES,
    ArmResult,
    arm_results,
    draw_effects,
    draw_other,
    legend_handles,
)
from vap_core.study.ablations import across_policies as across_policies
from vap_core.study.ablations import policies_figure as policies_figure
from vap_core.study.ablations import policy_results as policy_results
from vap_core.study.methods import ABLATIONS
from vap_core.study.results import read_runs
from vap_core.study.stats import points_text

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Results = dict[str, list[ArmResult]]
"""The arms of every ablation, by its name."""
Block = list[tuple[str, ArmResult, ArmResult | None]]
"""Arms of one ablation on one suite, each with its label, and the same arm of another policy; the
first is what they are against."""


def ablation_episodes(path: Path) -> "pd.DataFrame":
    """Every episode of a published table of ablations. Raises: BadOutput."""
    import pandas as pd

    return pd.concat([episodes for _, episodes in read_runs(path)], ignore_index=True)


def ablation_results(episodes: "pd.DataFrame", *suites: str) -> Results:
    """The arms of every ablation that has been run, each against the first of its ablation.

    Of these suites, or of those that an ablation runs on where none is named. Those of policies are
    not among them (`policy_results`, `across_policies`).

    Raises: as `arm_results`.
    """
    found = {}
    for name, ablation in ABLATIONS.items():
        if ablation.policies:
            continue
        wanted = suites or ablation.suites
        results = arm_results(ablation, episodes[episodes["suite"].isin(wanted)])
        if results:
            found[name] = results
    return found


def all_effects_figure(
    results: Results, columns: int = 2, beside: Results | None = None, whose: str = ""
) -> "Figure":
    """Every arm of every ablation: points of success against the first arm of its suite.

    `beside` are the results of another policy, drawn below each, and `whose` says which.
    """
    blocks: list[Block] = []
    for name, arms in results.items():
        blocks += _blocks(name, arms, (beside or {}).get(name, ()))
    parts = _split_evenly(blocks, columns)
    most = max(sum(map(len, part)) for part in parts)
    figure = empty_figure(5.2 * len(parts), 0.9 + 0.17 * most)
    for axes, part in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts, strict=True):
        _draw_blocks(axes, part)
        axes.set_ylim(-most + 0.4, 0.6)
        axes.set_xlim(-103, 45)
        axes.set_xlabel("points of success against the first arm [95 %]", fontsize=8)
    figure.legend(
        handles=legend_handles(whose), loc="outside lower center", ncols=4, frameon=False,
        fontsize=8,
    )  # fmt: skip
    return figure


def _blocks(name: str, arms: Sequence[ArmResult], beside: Sequence[ArmResult]) -> list[Block]:
    """One block a suite of an ablation: its first arm, with the block's heading, and the others."""
    several = len({one.suite for one in arms}) > 1
    others = {(one.suite, one.arm): one for one in beside}
    blocks: list[Block] = []
    for one in arms:
        if one.against is None:
            where = f" on {one.suite}" if several else ""
            rate = f"{100 * one.sr.value:.0f} % of {one.sr.n}"
            blocks.append([(f"{name}{where}: against {one.arm}, {rate}", one, None)])
        else:
            blocks[-1].append((one.arm, one, others.get((one.suite, one.arm))))
    return blocks


def _split_evenly(blocks: Sequence[Block], columns: int) -> list[list[Block]]:
    """The blocks in their order, in columns of about as many lines."""
    n_lines = sum(map(len, blocks))
    parts: list[list[Block]] = [[]]
    done = 0
    for block in blocks:
        if parts[-1] and done + len(block) / 2 > n_lines * len(parts) / columns:
            parts.append([])
        parts[-1].append(block)
        done += len(block)
    return parts


def _draw_blocks(axes: "Axes", blocks: Sequence[Block]) -> None:
    labels: list[str] = []
    for block in blocks:
        heading, first, _ = block[0]
        labels.append(heading)
        for label, one, other in block[1:]:
            if other is not None:
                draw_other(axes, other, -len(labels) - 0.3)
            draw_effects(axes, one, [first], -len(labels))
            labels.append(label)
    ticks = axes.set_yticks([-y for y in range(len(labels))], labels, fontsize=7)
    headings = {block[0][0] for block in blocks}
    for tick, label in zip(ticks, labels, strict=True):
        if label in headings:
            tick.label1.set_fontweight("bold")
    axes.axvline(0, color="black", linewidth=0.8)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def sweep_figure(results: Sequence[ArmResult], places: Mapping[str, float], label: str) -> "Figure":
    """Success rates along a quantity, one part a suite: ours with 95 % intervals, the paper's
    dashed."""
    suites = _by_suite(results)
    figure = empty_figure(4.2 if len(suites) == 1 else 3.4 * len(suites), 2.6)
    parts = figure.subplots(1, len(suites), squeeze=False, sharey=True)[0]
    for axes, (suite, arms) in zip(parts, suites.items(), strict=True):
        by_arm = {one.arm: one for one in arms}
        present = sorted((place, by_arm[arm]) for arm, place in places.items() if arm in by_arm)
        xs = [place for place, _ in present]
        ours = [100 * one.sr.value for _, one in present]
        low = [100 * (one.sr.value - one.sr.low) for _, one in present]
        high = [100 * (one.sr.high - one.sr.value) for _, one in present]
        axes.errorbar(
            xs, ours, [low, high], color=CLEAR, marker="o", capsize=2, label="here, 95 % interval"
        )
        theirs = [(place, 100 * one.paper) for place, one in present if one.paper == one.paper]
        if theirs:
            px, py = zip(*theirs, strict=True)
            robot = f"the paper, {PAPER_SUITES[suite]}"
            axes.plot(px, py, "D--", color=PAPER, fillstyle="none", label=robot)
        axes.set_xticks(xs, [f"{x:g}" for x in xs])
        axes.minorticks_off()
        axes.set_ylim(-3, 103)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
        if len(suites) > 1:
            axes.set_title(_heading(suite, arms), fontsize=9)
    parts[0].set_ylabel("success rate, %")
    figure.supxlabel(label, fontsize=10)
    return figure


def rates_of_arms_figure(results: Sequence[ArmResult]) -> "Figure":
    """The success rate of every arm, one part a suite: ours with 95 % intervals, the paper's as
    diamonds."""
    suites = _by_suite(results)
    names = list(dict.fromkeys(one.arm for one in results))
    figure = empty_figure(1.6 + 3.0 * len(suites), 0.9 + 0.24 * len(names))
    parts = figure.subplots(1, len(suites), squeeze=False, sharey=True)[0]
    for axes, (suite, arms) in zip(parts, suites.items(), strict=True):
        _draw_rates(axes, arms, names)
        axes.set_title(_heading(suite, arms), fontsize=9)
    diamonds = "; diamonds: the paper" if any(one.paper == one.paper for one in results) else ""
    figure.supxlabel(f"success rate, % (95 % interval{diamonds})", fontsize=8)
    return figure


def cases_figure(results: Sequence[ArmResult]) -> "Figure":
    """The share of episodes that failed by Case 1 and by Case 2, one part a suite."""
    suites = _by_suite(results)
    most = max(map(len, suites.values()))
    figure = empty_figure(3.9 * len(suites), 1.0 + 0.3 * most)
    parts = figure.subplots(1, len(suites), squeeze=False)[0]
    for axes, (suite, arms) in zip(parts, suites.items(), strict=True):
        ys = range(len(arms) - 1, -1, -1)
        first = [100 * one.case_1.value for one in arms]
        second = [100 * one.case_2.value for one in arms]
        bars_1 = axes.barh(ys, first, color=CASES["case 1"], label="Case 1")
        bars_2 = axes.barh(ys, second, left=first, color=CASES["case 2"], label="Case 2")
        counts_1 = [str(one.case_1.k or "") for one in arms]
        counts_2 = [str(one.case_2.k or "") for one in arms]
        for bars, counts in ((bars_1, counts_1), (bars_2, counts_2)):
            axes.bar_label(bars, counts, label_type="center", color="white", fontsize=7)
        axes.set_yticks(ys, [f"{one.arm}, n {one.sr.n}" for one in arms], fontsize=8)
        axes.set_title(suite, fontsize=9)
        axes.set_xlabel("% of episodes (in the bars: how many)", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2,
                  frameon=False, fontsize=8)  # fmt: skip
    return figure


def cases_text(results: Sequence[ArmResult]) -> str:
    """One line an arm, after its suite where there are several: how many episodes failed by Case 1
    and by Case 2.
    """
    several = len(_by_suite(results)) > 1
    lines = []
    for one in results:
        where = f"{one.suite:16}" if several else ""
        lines.append(
            f"{where}{one.arm:22} SR {one.sr}, Case 1 {one.case_1.k} of {one.case_1.n}, "
            f"Case 2 {one.case_2.k} of {one.case_2.n}"
        )
    return "\n".join(lines)


def effect_text(results: Sequence[ArmResult], arm: str, suite: str = "") -> str:
    """Points of success of an arm against the first, with its interval; of the first its rate.

    `suite` says which, where there are several.
    """
    (one,) = [each for each in results if each.arm == arm and suite in ("", each.suite)]
    if one.against is None:
        return f"{100 * one.sr.value:.0f} % of {one.sr.n}"
    return points_text(one.against)


def _by_suite(results: Sequence[ArmResult]) -> dict[str, list[ArmResult]]:
    """The arms of each suite, in their order."""
    found: dict[str, list[ArmResult]] = {}
    for one in results:
        found.setdefault(one.suite, []).append(one)
    return found


def _heading(suite: str, arms: Sequence[ArmResult]) -> str:
    """The name of a suite, and how many episodes each of its arms has."""
    n = ", ".join(dict.fromkeys(str(one.sr.n) for one in arms))
    return f"{suite}, n {n}"


def _draw_rates(axes: "Axes", results: Sequence[ArmResult], names: Sequence[str]) -> None:
    """One line for each of `names`, from the top."""
    for one in results:
        y = len(names) - 1 - names.index(one.arm)
        low, mid, high = (100 * x for x in (one.sr.low, one.sr.value, one.sr.high))
        axes.plot([low, high], [y, y], color=CLEAR, linewidth=2)
        axes.plot(mid, y, "o", color=CLEAR)
        if one.paper == one.paper:
            axes.plot(100 * one.paper, y, "D", color=PAPER, fillstyle="none", markersize=5)
    axes.set_yticks(range(len(names)), names[::-1], fontsize=8)
    axes.set_ylim(-0.5, len(names) - 0.5)
    axes.set_xlim(-3, 103)
    axes.spines[["top", "right"]].set_visible(False)
