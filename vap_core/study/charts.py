"""The pictures of results: success rates, differences, cases, the funnel, perception's curves."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from vap_core.base.pictures import CASES as CASE_COLOURS
from vap_core.base.pictures import (
    FRAME,
    FURTHER_POLICY_MARKERS,
    GRID,
    METHODS,
    OTHER,
    POLICY_MARKERS,
    TEXT,
    TIER_COLOURS,
    WINNER,
    empty_figure,
    method_marks,
    rgb8,
    suite_colour,
)
from vap_core.rollout.types import CASES
from vap_core.simulation.assets.objects import TIERS
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study.diagnosis import STAGES
from vap_core.study.failures import APART, FunnelRow
from vap_core.study.perception import KS, RULES, USUAL_K
from vap_core.study.results import track_title
from vap_core.study.stats import Comparison, Estimate, Score, mean, rate, share

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

MEANINGS = {
    "case 1": "Case 1: every view wrong alike",
    "case 2": "Case 2: views disagree",
    "case 3": "Case 3: right prompt, the hand fails",
    "unprompted": "unprompted: no mask to be wrong",
}
"""The cases in a legend."""
PERCENT_A_LETTER = 0.95
"""Width of a letter in a bar, in percent of its axis."""
FUNNEL_COLOURS = {name: METHODS[name][0] for name in ("generic", "soft", "vap", "oracle-mask")}
"""The methods of a funnel."""
SUCCESS_MARK = "D"
LABEL_APART = 6.0
"""Percent between two numbers at the ends of lines, so that both can be read."""


def funnel_figure(
    rows: Sequence[FunnelRow], colours: Mapping[str, str] = FUNNEL_COLOURS
) -> "Figure":
    """Per suite, the share of episodes that are left after each stage of the funnel.

    A line per method of `colours` and policy, methods that read the simulator dashed, the policies
    of one method with a marker each. A method that highlights nothing begins with the stage
    "touched"; one that has errors alone has no line. The last tick has two marks: a dot for
    episodes that succeed with every stage right, a diamond for all that succeed (SR).
    """
    by_suite: dict[str, list[FunnelRow]] = {}
    for row in rows:
        by_suite.setdefault(row.suite, []).append(row)
    columns = min(2, len(by_suite))
    lines = -(-len(by_suite) // columns)
    figure = empty_figure(5.4 * columns, 2.9 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    markers = _policy_markers(rows)
    drawn: dict[str, Line2D] = {}
    for axes, (suite, of_suite) in zip(panels, by_suite.items(), strict=False):
        shown = [row for row in of_suite if _plain(row.method) in colours]
        drawn |= _draw_funnel(axes, shown, colours, markers)
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=8, rotation=20)
        axes.set_xlim(-0.25, len(STAGES) - 0.4)
        axes.set(title=f"{suite}{_count_text(shown)}", ylim=(0, 104))
        axes.grid(color="#eeeeee")
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[len(by_suite) :]:
        axes.set_axis_off()
    for axes in panels[::columns]:
        axes.set_ylabel("% of episodes left after the stage", fontsize=8)
    (success,) = panels[0].plot([], [], SUCCESS_MARK, color="#555555", fillstyle="none")
    drawn["SR (every success)"] = success
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def cases_figure(counts: "pd.DataFrame", first: str = "vap") -> "Figure":
    """One bar per suite and method, as long as its share of failures, split by case (`breakdown`).

    One colour a case; within it thin lines separate the sub-cases, whose names stand where there is
    room. Methods stand below `first` in the order of the table; suites keep theirs.
    """
    lines = _first_on_top(counts[counts["n"] > 0], first)
    places = _spaced(lines["suite"])
    figure = empty_figure(10.5, 0.3 * (places[-1] + 1) + 1.5)
    axes = figure.subplots()
    start = np.zeros(len(lines))
    drawn: dict[str, BarContainer] = {}
    for case, sub_cases in CASES.items():
        for sub_case in sub_cases:
            percent = (100 * lines[f"{case}: {sub_case}"] / lines["n"]).to_numpy()
            if percent.any():
                bars = _draw_bars(axes, places, percent, start, case, sub_case)
                drawn.setdefault(case, bars)
            start += percent
    for place, line in zip(places, lines.itertuples(), strict=True):
        axes.text(
            start[places.index(place)] + 1,
            place,
            f"{line.failed} of {line.n}",
            fontsize=8,
            va="center",
        )
    _name_bars(axes, lines, places, first)
    axes.set(xlim=(0, 112), xticks=range(0, 101, 20), xlabel="failures, % of episodes")
    axes.spines[["top", "right", "left"]].set_visible(False)
    figure.legend(
        handles=list(drawn.values()),
        labels=[MEANINGS.get(case, case) for case in drawn],
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
    return figure


def _policy_markers(rows: Sequence[FunnelRow]) -> dict[str, str]:
    """The marker of every line: the policies of one method have one each."""
    markers: dict[str, str] = {}
    n_policies: Counter[str] = Counter()
    for row in rows:
        if row.method not in markers:
            method = _plain(row.method)
            markers[row.method] = POLICY_MARKERS[n_policies[method] % len(POLICY_MARKERS)]
            n_policies[method] += 1
    return markers


def _draw_funnel(
    axes: "Axes",
    rows: Sequence[FunnelRow],
    colours: Mapping[str, str],
    markers: Mapping[str, str],
) -> "dict[str, Line2D]":
    """A line per method with the percentage at its end; the lines by method."""
    drawn: dict[str, Line2D] = {}
    ends = []
    for row in rows:
        stages = []
        percent = []
        for i, left in enumerate(row.left):
            if left is not None:
                stages.append(i)
                percent.append(100 * rate(left, row.n).value)
        if not percent:
            continue
        colour = colours[_plain(row.method)]
        (drawn[row.method],) = axes.plot(
            stages,
            percent,
            "--" if row.bound else "-",
            marker=markers[row.method],
            markersize=4,
            color=colour,
            linewidth=1.8,
        )
        success = 100 * rate(row.succeeded, row.n).value
        axes.plot(
            len(STAGES) - 1, success, SUCCESS_MARK, color=colour, fillstyle="none", markersize=7
        )
        ends.append((percent[-1], success, colour))
    lowest = -LABEL_APART
    for percent_left, success, colour in sorted(ends):
        lowest = max(success, lowest + LABEL_APART)
        text = f"{success:.0f}"
        if round(percent_left) != round(success):
            text += f" (every stage {percent_left:.0f})"
        axes.annotate(
            text,
            (len(STAGES) - 1, lowest),
            (7, 0),
            textcoords="offset points",
            fontsize=8,
            color=colour,
            va="center",
        )
    return drawn


def _count_text(rows: Sequence[FunnelRow]) -> str:
    """How many episodes the lines are of."""
    counts = {row.n for row in rows if any(left is not None for left in row.left)}
    if not counts:
        return ""
    if len(counts) == 1:
        return f" (n {counts.pop()})"
    return f" (n {min(counts)} to {max(counts)})"


def _plain(method: str) -> str:
    """The method without its policy."""
    return method.partition(APART)[0]


def _first_on_top(counts: "pd.DataFrame", first: str) -> "pd.DataFrame":
    """The lines suite by suite, that of the method `first` before the others."""
    suites = list(dict.fromkeys(counts["suite"]))
    others = counts["method"].map(_plain) != first
    rank = counts["suite"].map(suites.index) + 0.5 * others
    return counts.assign(rank=rank).sort_values("rank", kind="stable").reset_index(drop=True)


def _spaced(suites: "pd.Series") -> list[float]:
    """The height of each bar; a new suite leaves room for its heading."""
    places = []
    seen: list[str] = []
    for i, suite in enumerate(suites):
        if suite not in seen:
            seen.append(suite)
        places.append(i + 1.0 * (len(seen) - 1))
    return places


def _name_bars(axes: "Axes", lines: "pd.DataFrame", places: Sequence[float], first: str) -> None:
    """Methods beside their bars, the suite above its first."""
    axes.set_yticks(places, lines["method"], fontsize=9)
    axes.set_ylim(places[-1] + 0.6, -1.2)
    axes.tick_params(axis="y", length=0)
    headed: set[str] = set()
    for place, label, line in zip(places, axes.get_yticklabels(), lines.itertuples(), strict=True):
        label.set_fontweight("bold" if _plain(line.method) == first else "normal")
        if line.suite not in headed:
            headed.add(line.suite)
            axes.text(0, place - 0.85, line.suite, fontsize=9, fontweight="bold", va="center")


def _draw_bars(
    axes: "Axes",
    places: Sequence[float],
    percent: np.ndarray,
    start: np.ndarray,
    case: str,
    sub_case: str,
) -> "BarContainer":
    """One sub-case of every line, with its name in bars that have room for it."""
    colour = CASE_COLOURS[case]
    bars = axes.barh(
        places,
        percent,
        left=start,
        color=colour,
        edgecolor="white",
        linewidth=0.8,
        height=0.82,
    )
    labels = []
    for each in percent:
        labels.append(sub_case if each >= PERCENT_A_LETTER * len(sub_case) else "")
    is_dark = sum(rgb8(colour)) < 400
    axes.bar_label(
        bars,
        labels,
        label_type="center",
        fontsize=7.5,
        color="white" if is_dark else "black",
    )
    return bars


Line = tuple[str, ...]
"""What a line of a forest plot is about: the words of its heading, then the task."""


def forest_figure(results: "pd.DataFrame") -> "Figure":
    """Success rates of every suite, track and task, a mark per method and policy.

    `results` is a table of `results.results`.
    """
    series = list(dict.fromkeys(zip(results["method"], results["policy"], strict=True)))
    methods = _unique(results["method"])
    policies = _unique(results["policy"])
    marks = method_marks(methods)
    lines = list(zip(results["suite"], results["split"], results["task"], strict=True))
    figure, axes, places = _forest_axes(lines, per_line=len(series), heading_x=0.0)
    for i, (method, policy) in enumerate(series):
        of_series = (results["method"] == method) & (results["policy"] == policy)
        shown = results[of_series & (results["n"] > 0)]
        low = 100 * shown["sr_layout_low"].fillna(shown["sr_low"]).to_numpy()
        high = 100 * shown["sr_layout_high"].fillna(shown["sr_high"]).to_numpy()
        middle = 100 * shown["sr"].to_numpy()
        heights = []
        for line in zip(shown["suite"], shown["split"], shown["task"], strict=True):
            heights.append(places[line])
        at = np.array(heights)
        colour, marker = marks[method]
        axes.errorbar(
            middle,
            at + _offset(i, len(series)),
            xerr=np.maximum([middle - low, high - middle], 0),
            label=method if len(policies) == 1 else f"{method}, {policy} policy",
            **_policy_style(colour, marker, policies.index(policy)),
        )
    axes.set(xlim=(-2, 102), xlabel="% of episodes that succeed, 95 % interval")
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=min(3, len(series)),
        frameon=False,
    )
    return figure


def differences_figure(comparisons: Sequence[Comparison]) -> "Figure":
    """Differences on the same episodes with their 95 % cluster bootstrap.

    A mark per pair of methods, filled where Holm's p is below 0.05. Colours and markers are those
    of the methods in `forest_figure`.
    """
    lines: list[Line] = []
    contrasts: list[tuple[str, str]] = []
    for c in comparisons:
        lines.append((c.suite, c.split, f"{c.policy} policy", c.task))
        if (c.other, c.one) not in contrasts:
            contrasts.append((c.other, c.one))
    marks = method_marks([comparisons[0].one, *(other for other, _ in contrasts)])
    lowest = min(-25.0, *(100 * c.low for c in comparisons))
    figure, axes, places = _forest_axes(lines, per_line=len(contrasts), heading_x=lowest)
    axes.axvline(0, color=TEXT, linewidth=1)
    for line, c in zip(lines, comparisons, strict=True):
        colour, marker = marks[c.other]
        i = contrasts.index((c.other, c.one))
        spread = np.maximum([[c.difference - c.low], [c.high - c.difference]], 0)
        axes.errorbar(
            100 * c.difference,
            places[line] + _offset(i, len(contrasts)),
            xerr=100 * spread,
            **_mark_style(colour, marker, filled=c.p_holm < 0.05),
        )
    for other, one in contrasts:
        colour, marker = marks[other]
        axes.plot([], [], marker, color=colour, label=f"{other} minus {one}")
    axes.set_xlim(lowest - 2, 102)
    axes.set_xlabel(
        "difference of success rates in points, same episodes, 95 % interval over layouts\n"
        "filled: p < 0.05 after Holm's correction"
    )
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=min(3, len(contrasts)),
        frameon=False,
    )
    return figure


def scores_table(scores: Sequence[Score]) -> "pd.DataFrame":
    """The success rates of scores as `forest_figure` reads them, with Wilson's intervals."""
    import pandas as pd

    lines = []
    for score in scores:
        line: dict[str, Any] = {}
        for name in ("suite", "split", "task", "method", "policy", "n"):
            line[name] = getattr(score, name)
        line |= {"sr": score.sr.value, "sr_low": score.sr.low, "sr_high": score.sr.high}
        lines.append({**line, "sr_layout_low": np.nan, "sr_layout_high": np.nan})
    return pd.DataFrame(lines)


def _forest_axes(
    lines: Sequence[Line], per_line: int, heading_x: float
) -> "tuple[Figure, Axes, dict[Line, float]]":
    """An empty figure, its axes, and the height of each line.

    A labelled line per task has room for `per_line` marks. Over each group of lines stands its
    heading, written from x = `heading_x`.
    """
    groups: list[Line] = []
    places: dict[Line, float] = {}
    headings: dict[Line, float] = {}
    for i, line in enumerate(dict.fromkeys(lines)):
        group = line[:-1]
        if group not in groups:
            groups.append(group)
        places[line] = i + 0.8 * (groups.index(group) + 1)
        headings.setdefault(group, places[line])
    bottom = max(places.values())
    figure = empty_figure(8.5, (0.2 + 0.13 * per_line) * (bottom + 1) + 1.2)
    axes = figure.subplots()
    for group, first in headings.items():
        axes.text(
            heading_x,
            first - 0.65,
            ", ".join(filter(None, group)),
            fontsize=9,
            fontweight="bold",
            va="center",
            backgroundcolor="white",
        )
    axes.set_yticks(list(places.values()), [line[-1] for line in places], fontsize=9)
    axes.set_ylim(bottom + 0.6, -0.2)
    axes.grid(axis="x", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes, places


def _policy_style(colour: str, marker: str, i: int) -> dict[str, Any]:
    """The mark of the i-th policy: the method's own, filled and hollow, then further ones."""
    markers = (marker, *FURTHER_POLICY_MARKERS)
    return _mark_style(colour, markers[i // 2 % len(markers)], filled=i % 2 == 0)


def _mark_style(colour: str, marker: str, filled: bool) -> dict[str, Any]:
    return {
        "color": colour,
        "markerfacecolor": colour if filled else "white",
        "fmt": marker,
        "markersize": 5,
        "capsize": 2.5,
        "linewidth": 1.2,
    }


def _offset(i: int, n: int) -> float:
    """How far below the middle of its line the i-th of n marks stands."""
    return min(0.24, 0.8 / n) * (i - (n - 1) / 2)


def _unique(column: "pd.Series") -> list[str]:
    return list(dict.fromkeys(column))


OURS = "vap"
"""The method that is set in bold."""
LARGEST_PT2 = 190.0
"""Area of the dot of 100 %, points squared."""


def suites_figure(results: "pd.DataFrame", title: str = "") -> "Figure":
    """Success rates of all tasks together: a panel per suite and track, a line per method.

    The methods' names stand at the left, each rate at its mark; methods that read the simulator
    come last, below a line. `results` is a table of `results.results` with one line per suite,
    track and method. Intervals are 95 %, over layouts where layouts return.
    """
    bounds = _bounds(results)
    methods = _bounds_last(results["method"], bounds)
    marks = method_marks(methods)
    tracks = list(dict.fromkeys(zip(results["suite"], results["split"], strict=True)))
    figure = empty_figure(2.35 * len(tracks) + 1.2, 0.3 * len(methods) + 1.15 + 0.3 * bool(title))
    panels = figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0]
    for axes, (suite, split) in zip(panels, tracks, strict=True):
        shown = results[(results["suite"] == suite) & (results["split"] == split)]
        for i, method in enumerate(methods):
            for line in shown[shown["method"] == method].itertuples():
                _draw_rate(axes, i, line, colour=marks[method][0], marker=marks[method][1])
        track = f"{suite}\n{split}" if split else f"{suite}\n"
        axes.set_title(f"{track}\nn = {shown['n'].max()} a method", fontsize=9)
        if 0 < len(bounds) < len(methods):
            axes.axhline(len(methods) - len(bounds) - 0.5, color=FRAME, linewidth=0.8)
        axes.set(xlim=(-3, 118), xticks=(0, 50, 100))
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
        axes.tick_params(length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
    panels[0].set_yticks(range(len(methods)), _labels(methods, bounds, " (bound)"), fontsize=9)
    _set_ours_bold(panels[0].get_yticklabels(), methods)
    panels[0].set_ylim(len(methods) - 0.5, -0.6)
    figure.supxlabel("% of episodes that succeed, 95 % interval", fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def tasks_figure(results: "pd.DataFrame", title: str = "") -> "Figure":
    """A matrix of success rates: a line per task, a column per method.

    The area of a dot is the rate in %, which stands beside it; the highest of the methods that do
    not read the simulator is bold. `results` is a table of `results.results`.
    """
    bounds = _bounds(results)
    methods = _bounds_last(results["method"], bounds)
    lines = list(
        dict.fromkeys(zip(results["suite"], results["split"], results["task"], strict=True))
    )
    places = _places(lines)
    bottom = max(places.values())
    figure = empty_figure(0.92 * len(methods) + 3.0, 0.28 * (bottom + 1) + 1.0)
    axes = figure.subplots()
    marks = method_marks(methods)
    for line, y in places.items():
        suite, split, task = line
        of_task = results[
            (results["suite"] == suite) & (results["split"] == split) & (results["task"] == task)
        ]
        rates = dict(zip(of_task["method"], of_task["sr"], strict=True))
        plain = [rate for name, rate in rates.items() if name not in bounds]
        for x, method in enumerate(methods):
            if method in rates:
                is_best = method not in bounds and rates[method] == max(plain)
                _draw_dot(axes, x, y, rates[method], colour=marks[method][0], bold=is_best)
    for line in lines:
        if line[2] == next(other[2] for other in lines if other[:2] == line[:2]):
            axes.text(
                -0.75,
                places[line] - 0.78,
                track_title(line[0], line[1]),
                fontsize=9,
                fontweight="bold",
                va="center",
                ha="right",
            )
    axes.set_yticks(list(places.values()), [line[2] for line in lines], fontsize=9)
    axes.set_xticks(range(len(methods)), _labels(methods, bounds, "\n(bound)"), fontsize=9)
    axes.xaxis.tick_top()
    axes.set_title("% of episodes that succeed; so is the area of a dot", fontsize=9)
    _set_ours_bold(axes.get_xticklabels(), methods)
    axes.set(xlim=(-0.7, len(methods) - 0.3), ylim=(bottom + 0.6, -1.1))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def _bounds(results: "pd.DataFrame") -> set[str]:
    """The methods that read the simulator."""
    return set(results.loc[results["bound"].astype(bool), "method"])


def _bounds_last(methods: "pd.Series", bounds: set[str]) -> list[str]:
    """Every method once, in the order of the table, those that read the simulator last."""
    names = list(dict.fromkeys(methods))
    return sorted(names, key=lambda name: name in bounds)


def _labels(methods: Sequence[str], bounds: set[str], mark: str) -> list[str]:
    """The methods' names; `mark` follows those that read the simulator."""
    labels = []
    for name in methods:
        labels.append(name + mark if name in bounds else name)
    return labels


def _set_ours_bold(labels: "Sequence[Text]", methods: Sequence[str]) -> None:
    for name, label in zip(methods, labels, strict=True):
        label.set_fontweight("bold" if name == OURS else "normal")


def _draw_rate(axes: "Axes", y: int, line: "pd.Series", *, colour: str, marker: str) -> None:
    """A rate with its interval and its number."""
    low, high = line.sr_layout_low, line.sr_layout_high
    if np.isnan(low):
        low, high = line.sr_low, line.sr_high
    middle = 100 * line.sr
    axes.errorbar(
        middle,
        y,
        xerr=np.maximum([[middle - 100 * low], [100 * high - middle]], 0),
        fmt=marker,
        color=colour,
        markersize=6,
        capsize=2.5,
        linewidth=1.2,
    )
    axes.text(
        100 * high + 3,
        y,
        f"{middle:.0f}",
        va="center",
        fontsize=8,
        color=colour if line.method == OURS else TEXT,
        fontweight="bold" if line.method == OURS else "normal",
    )


def _places(lines: Sequence[tuple[str, str, str]]) -> dict[tuple[str, str, str], float]:
    """The height of each line; a new suite or track has room for its heading."""
    places = {}
    groups: list[tuple[str, str]] = []
    for i, line in enumerate(lines):
        if line[:2] not in groups:
            groups.append(line[:2])
        places[line] = i + 1.0 * (len(groups) - 1)
    return places


def _draw_dot(axes: "Axes", x: int, y: float, rate: float, *, colour: str, bold: bool) -> None:
    """A dot of that area, and its number beside it."""
    axes.scatter(x - 0.2, y, s=LARGEST_PT2 * rate, color=colour, linewidths=0)
    axes.text(
        x + 0.05,
        y,
        f"{100 * rate:.0f}",
        va="center",
        fontsize=8.5,
        color=TEXT,
        fontweight="bold" if bold else "normal",
    )


MARGINS = {"margin": "margin of votes", "cosine_margin": "margin of mean cosines"}
COUNTS_BELOW = -4.0
"""Where the axis begins that has numbers below its curve, %."""
TIME_TARGET = 0.8
"""The IoU that a track is to keep."""
RULE_COLOURS = {"vote": WINNER, "average": OTHER}
OCCLUDERS = {"plate": "a plate hides it fully", "arm": "an arm moves in front"}


def abstention(choices: "pd.DataFrame", margin: str = "margin", k: int = USUAL_K) -> "pd.DataFrame":
    """Share of right instances among the views whose margin is at least a threshold.

    One row per threshold that changes the share, with Wilson's interval. `coverage` is the share of
    these views among all views that show the target; a view without candidates is never among them.
    """
    import pandas as pd

    usual = choices[(choices.k == k) & (choices.rule == "vote")]
    answered = usual[usual.elected != ""]
    rows = []
    for threshold in sorted(answered[margin].unique(), reverse=True):
        kept = answered[answered[margin] >= threshold]
        right = share(kept.right)
        rows.append(
            {
                "threshold": threshold,
                "coverage": len(kept) / len(usual),
                "right": right.value,
                "low": right.low,
                "high": right.high,
                "n": right.n,
            }
        )
    return pd.DataFrame(rows)


def lookalike_pairs(objects: "pd.DataFrame") -> "pd.DataFrame":
    """One row per look-alike and view that shows the target too.

    `tier` is the look-alike's; `ahead` is by how much the target's true crop is nearer to the
    references.
    """
    key = ["suite", "task", "episode", "camera"]
    is_target = objects.role == "target"
    targets = objects.loc[is_target, [*key, "cosine"]]
    lookalikes = objects[objects.role != "target"]
    pairs = lookalikes.merge(targets, on=key, suffixes=("", "_target"))
    return pairs.assign(ahead=pairs.cosine_target - pairs.cosine)


def abstention_figure(choices: "pd.DataFrame") -> "Figure":
    """Wrong instances against coverage when views of small margin pass unmodified.

    Bands are 95 % Wilson intervals. The axis ends at twice the largest share, so that the curve is
    seen where the interval of a few views is wide.
    """
    figure, axes = _make_panel(6.4, 4.0)
    n_views = len(choices[(choices.k == USUAL_K) & (choices.rule == "vote")])
    top = 0.0
    for (margin, label), colour in zip(MARGINS.items(), (WINNER, OTHER), strict=True):
        curve = abstention(choices, margin)
        coverage = 100 * curve.coverage
        axes.plot(
            coverage,
            100 * (1 - curve.right),
            color=colour,
            marker="o" if len(curve) <= 2 * USUAL_K else None,
            markersize=4,
            label=f"abstain below a {label}",
        )
        low, high = 100 * (1 - curve.high), 100 * (1 - curve.low)
        _draw_band(axes, x=coverage, low=low, high=high, colour=colour)
        top = max(top, 200 * float((1 - curve.right).max()))
    axes.set(xlabel=f"% of {n_views} views answered", ylabel="% of them wrong")
    axes.set(xlim=(0, 101), ylim=(0, max(top, 1.0)))
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return figure


def hardness_figure(objects: "pd.DataFrame") -> "Figure":
    """The encoder's cosines of the target and of its look-alikes, by hardness.

    The second panel shows how often a look-alike is nearer to the references than the target beside
    it.
    """
    figure, (left, right) = _make_panels(9.0, 3.8, n=2)
    _draw_cosines(left, objects)
    left.set(
        ylabel=f"mean cosine with {USUAL_K} references", xlabel="object in view, by its true box"
    )
    pairs = lookalike_pairs(objects)
    shares: dict[str, Estimate] = {}
    for tier in TIERS:
        same_tier = pairs[pairs.tier == tier]
        if len(same_tier):
            shares[tier] = share(same_tier.ahead < 0)
    _draw_estimates(right, shares, TIER_COLOURS)
    right.set(ylabel="% of views: nearer than the target", xlabel="look-alike beside the target")
    return figure


def references_figure(choices: "pd.DataFrame") -> "Figure":
    """Wrong instance against the number of reference photos, by rule.

    One panel per suite and one of all views, with 95 % Wilson intervals.
    """
    suites = [*_suite_colours(choices), "all"]
    figure, panels = _make_panels(2.7 * len(suites), 3.4, n=len(suites), sharey=True)
    for axes, suite in zip(panels, suites, strict=True):
        rows = choices
        if suite != "all":
            rows = choices[choices.suite == suite]
        for i, rule in enumerate(RULES):
            by_rule = rows[rows.rule == rule]
            shares = [share(~by_rule[by_rule.k == k].right.astype(bool)) for k in KS]
            x = np.array(KS) + 0.25 * (i - 0.5)
            _draw_line(axes, x, shares, colour=RULE_COLOURS[rule], label=rule)
        n_views = len(rows) // (len(KS) * len(RULES))
        axes.set(title=f"{suite}\n{n_views} views", xlabel="reference photos")
        axes.set(xticks=KS)
    panels[0].set_ylim(bottom=0)
    panels[0].set_ylabel("% wrong instance")
    panels[0].legend(frameon=False, loc="upper left")
    return figure


def time_figure(tracks: "pd.DataFrame") -> "Figure":
    """Mean IoU of the targets' undisturbed tracks over the episode, from start to end.

    One line per suite; bands are bootstrapped by episode.
    """
    figure, axes = _make_panel(7.0, 3.8)
    undisturbed = tracks[tracks.target & (tracks.hidden == 0)]
    for suite, colour in _suite_colours(undisturbed).items():
        part = undisturbed[undisturbed.suite == suite]
        means = _mean_iou_over_time(part)
        time = np.linspace(0, 100, len(means))
        middle, low, high = _estimate_bounds(means)
        axes.plot(time, middle, color=colour, label=f"{suite}, {len(part)} tracks")
        _draw_band(axes, x=time, low=low, high=high, colour=colour)
    axes.axhline(TIME_TARGET, color=FRAME, linewidth=0.8, linestyle=":", label="aimed at")
    axes.set(xlabel="% of the episode", ylabel="IoU with the visible target")
    axes.set(ylim=(0, 1.02), xlim=(0, 100))
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    return figure


def hidden_figure(tracks: "pd.DataFrame") -> "Figure":
    """Targets lost at the episode's end, against the frames for which they are hidden.

    Bars are 95 % Wilson intervals.
    """
    figure, axes = _make_panel(6.4, 3.8)
    targets = tracks[tracks.target]
    n_lines = 0
    for kind, label in OCCLUDERS.items():
        if not (targets.kind == kind).any():
            continue
        part = targets[(targets.hidden == 0) | (targets.kind == kind)]
        hidden = sorted(part.hidden.unique())
        estimates = [share(~part[part.hidden == n].kept.astype(bool)) for n in hidden]
        if n_lines > 0:  # the numbers below the axis are of the first occluder
            ns = [str(e.n) for n, e in zip(hidden, estimates, strict=True) if n > 0]
            label += f" (n = {', '.join(ns)})"
        _draw_line(
            axes,
            x=np.array(hidden) + 0.12 * (n_lines - 0.5),
            estimates=estimates,
            colour=(WINNER, OTHER)[n_lines],
            label=label,
            counts=n_lines == 0,
        )
        n_lines += 1
    axes.set(xlabel="frames hidden (below: tracks behind the plate)")
    axes.set(ylabel="% of targets lost at the end", xticks=range(7))
    axes.set_ylim(bottom=COUNTS_BELOW)
    axes.set_xlim(-0.4, 6.4)
    axes.legend(frameon=False, loc="upper left")
    return figure


def _suite_colours(table: "pd.DataFrame") -> dict[str, str]:
    """The suites of a table in their usual order, each with its colour."""
    colours = {}
    for suite in BENCHMARKS:
        if (table.suite == suite).any():
            colours[suite] = suite_colour(suite)
    return colours


def _mean_iou_over_time(tracks: "pd.DataFrame") -> list[Estimate]:
    """The mean IoU of tracks at each point of their normalised time."""
    n_points = len(tracks.iou_over_time.iloc[0])
    means = []
    for i in range(n_points):
        point = [curve[i] for curve in tracks.iou_over_time]
        at_point = tracks.assign(x=point)
        means.append(mean(at_point, "x"))
    return means


def _estimate_bounds(
    estimates: Sequence[Estimate],
) -> tuple[
    Float64[np.ndarray, " n"],
    Float64[np.ndarray, " n"],
    Float64[np.ndarray, " n"],
]:
    """The values, the lower and the upper bounds of estimates."""
    bounds = np.empty((3, len(estimates)))
    for i, estimate in enumerate(estimates):
        bounds[:, i] = estimate.value, estimate.low, estimate.high
    return bounds[0], bounds[1], bounds[2]


def _percentages(
    estimates: Sequence[Estimate],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "2 n"]]:
    """The values in %, and their distances to the lower and to the upper bound."""
    middle, low, high = _estimate_bounds(estimates)
    middle = 100 * middle
    distances = np.stack([middle - 100 * low, 100 * high - middle])
    return middle, np.maximum(distances, 0)


def _draw_band(
    axes: "Axes",
    *,
    x: "np.ndarray | pd.Series",
    low: "np.ndarray | pd.Series",
    high: "np.ndarray | pd.Series",
    colour: str,
) -> None:
    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)


def _draw_line(
    axes: "Axes",
    x: Float64[np.ndarray, " n"],
    estimates: Sequence[Estimate],
    *,
    colour: str,
    label: str,
    counts: bool = False,
) -> None:
    """Estimates in % at `x` with their intervals; `counts` writes n below each."""
    middle, spread = _percentages(estimates)
    axes.errorbar(
        x,
        middle,
        yerr=spread,
        color=colour,
        marker="o",
        markersize=4,
        capsize=3,
        linewidth=1.4,
        elinewidth=1,
        label=label,
    )
    if not counts:
        return
    for place, estimate in zip(x, estimates, strict=True):
        axes.text(
            place,
            COUNTS_BELOW / 2,
            f"{estimate.n}",
            ha="center",
            va="center",
            fontsize=8,
            color=TEXT,
        )


def _draw_estimates(
    axes: "Axes", estimates: Mapping[str, Estimate], colours: Mapping[str, str]
) -> None:
    """A bar in % per name, with its interval and n."""
    middle, spread = _percentages(list(estimates.values()))
    places = range(len(estimates))
    labels = []
    bar_colours = []
    for name, estimate in estimates.items():
        labels.append(f"{name}\nn = {estimate.n}")
        bar_colours.append(colours[name])
    axes.bar(places, middle, width=0.55, color=bar_colours, alpha=0.85)
    axes.errorbar(places, middle, yerr=spread, fmt="none", ecolor="black", capsize=3, linewidth=1)
    axes.set_xticks(places, labels)


def _draw_cosines(axes: "Axes", objects: "pd.DataFrame") -> None:
    """A box plot of the cosines of the target, and of its look-alikes of each tier."""
    is_target = objects.role == "target"
    parts = [("target", objects[is_target], TIER_COLOURS["personal"])]
    for tier in TIERS:
        lookalikes = objects[~is_target & (objects.tier == tier)]
        parts.append((tier, lookalikes, TIER_COLOURS[tier]))
    cosines = []
    labels = []
    colours = []
    for name, part, colour in parts:
        if len(part):
            cosines.append(part.cosine.to_numpy())
            labels.append(f"{name}\nn = {len(part)}")
            colours.append(colour)
    drawn = axes.boxplot(
        cosines,
        tick_labels=labels,
        widths=0.55,
        patch_artist=True,
        flierprops={"markersize": 2.5, "markeredgecolor": FRAME},
        medianprops={"color": "black"},
    )
    for box, colour in zip(drawn["boxes"], colours, strict=True):
        box.set(facecolor=colour, alpha=0.75)


def _make_panel(width: float, height: float) -> "tuple[Figure, Axes]":
    figure, panels = _make_panels(width, height, n=1)
    return figure, panels[0]


def _make_panels(
    width: float, height: float, *, n: int, sharey: bool = False
) -> "tuple[Figure, list[Axes]]":
    """A figure of that size (inches) with `n` panels beside each other."""
    figure = empty_figure(width, height)
    grid = figure.subplots(1, n, squeeze=False, sharey=sharey)
    panels = grid[0].tolist()
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels
