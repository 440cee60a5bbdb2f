"""Curves of a survey: the tables behind them, and the figures. A table in, a table or a figure out; nothing is measured here."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.figures import OTHER, TIER_COLOURS, WINNER, empty_figure
from vap_core.evaluation.perception.estimates import Estimate, mean, share
from vap_core.evaluation.perception.first_frames import KS, RULES, USUAL_K
from vap_core.simulation.assets.objects import TIERS
from vap_core.simulation.suites import BENCHMARKS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARGINS = {"margin": "margin of votes", "cosine_margin": "margin of mean cosines"}
SUITE_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7")
"""Told apart by colour-blind eyes, too."""
RULE_COLOURS = {"vote": WINNER, "average": OTHER}


def abstention(choices: "pd.DataFrame", margin: str = "margin", k: int = USUAL_K) -> "pd.DataFrame":
    """Share of right instances among the views whose margin is at least a threshold, one line per threshold that changes it, with Wilson's interval.

    `coverage` is their share of all views that show the target; a view without candidates is never among them.
    """
    import pandas as pd

    usual = choices[(choices.k == k) & (choices.rule == "vote")]
    answered = usual[usual.elected != ""]
    lines = []
    for threshold in sorted(answered[margin].unique(), reverse=True):
        kept = answered[answered[margin] >= threshold]
        right = share(kept.right)
        lines.append(
            {
                "threshold": threshold,
                "coverage": len(kept) / len(usual),
                "right": right.value,
                "low": right.low,
                "high": right.high,
                "n": right.n,
            }
        )
    return pd.DataFrame(lines)


def duels(objects: "pd.DataFrame") -> "pd.DataFrame":
    """One line per look-alike and view that shows the target too: its tier, and by how much the target's true crop is nearer to the references."""
    key = ["suite", "task", "episode", "camera"]
    mine = objects.loc[objects.role == "target", [*key, "cosine"]]
    both = objects[objects.role != "target"].merge(mine, on=key, suffixes=("", "_target"))
    return both.assign(ahead=both.cosine_target - both.cosine)


def abstention_figure(choices: "pd.DataFrame") -> "Figure":
    """Right instances against coverage when views of small margin pass unmodified; bands are 95 % Wilson intervals."""
    figure, axes = _panel(6.4, 4.0)
    n = len(choices[(choices.k == USUAL_K) & (choices.rule == "vote")])
    for (margin, label), colour in zip(MARGINS.items(), (WINNER, OTHER), strict=True):
        curve = abstention(choices, margin)
        mark = "o" if len(curve) <= 2 * USUAL_K else None
        axes.plot(
            100 * curve.coverage,
            100 * curve.right,
            color=colour,
            marker=mark,
            markersize=4,
            label=f"abstain below a {label}",
        )
        axes.fill_between(
            100 * curve.coverage,
            100 * curve.low,
            100 * curve.high,
            color=colour,
            alpha=0.15,
            linewidth=0,
        )
    axes.set(
        xlabel=f"% of {n} views answered", ylabel="% right instance", xlim=(0, 101), ylim=(0, 101)
    )
    axes.legend(frameon=False, loc="lower left", fontsize=9)
    return figure


def hardness_figure(objects: "pd.DataFrame") -> "Figure":
    """How near the encoder finds the target and its look-alikes to the references; and how often a look-alike is nearer than the target beside it."""
    figure, grid = _panels(9.0, 3.8, 2)
    groups = {
        "target": objects[objects.role == "target"],
        **{
            f"{tier}": objects[(objects.role != "target") & (objects.tier == tier)]
            for tier in TIERS
        },
    }
    colours = [TIER_COLOURS["personal"], *(TIER_COLOURS[tier] for tier in TIERS)]
    shown = [
        (f"{name}\nn = {len(part)}", part.cosine.to_numpy(), colour)
        for (name, part), colour in zip(groups.items(), colours, strict=True)
        if len(part)
    ]
    drawn = grid[0].boxplot([cosine for _, cosine, _ in shown], tick_labels=[name for name, _, _ in shown], widths=0.55, patch_artist=True,
                            flierprops={"markersize": 2.5, "markeredgecolor": "#999999"}, medianprops={"color": "black"})  # fmt: skip
    for box, (_, _, colour) in zip(drawn["boxes"], shown, strict=True):
        box.set(facecolor=colour, alpha=0.75)
    grid[0].set(
        ylabel=f"mean cosine with {USUAL_K} references", xlabel="object in view, by its true box"
    )
    pairs = duels(objects)
    tiers = [tier for tier in TIERS if (pairs.tier == tier).any()]
    _bars(
        grid[1],
        tiers,
        [share(pairs[pairs.tier == tier].ahead < 0) for tier in tiers],
        [TIER_COLOURS[tier] for tier in tiers],
    )
    grid[1].set(ylabel="% of views: nearer than the target", xlabel="look-alike beside the target")
    return figure


def references_figure(choices: "pd.DataFrame") -> "Figure":
    """Right instance against the number of reference photos, by rule, with 95 % Wilson intervals: one panel per suite and one of all views."""
    suites = [*_suites(choices), "all"]
    figure, grid = _panels(2.7 * len(suites), 3.4, len(suites), sharey=True)
    for axes, suite in zip(grid, suites, strict=True):
        here = choices if suite == "all" else choices[choices.suite == suite]
        for i, rule in enumerate(RULES):
            found = [share(here[(here.k == k) & (here.rule == rule)].right) for k in KS]
            _line(axes, [k + 0.25 * (i - 0.5) for k in KS], found, RULE_COLOURS[rule], rule)
        axes.set(
            title=f"{suite}\n{len(here) // (len(KS) * len(RULES))} views",
            xlabel="reference photos",
            xticks=KS,
            ylim=(0, 103),
        )
    grid[0].set_ylabel("% right instance")
    grid[0].legend(frameon=False, loc="lower left")
    return figure


def time_figure(tracks: "pd.DataFrame") -> "Figure":
    """Mean IoU of the targets' undisturbed tracks over the episode, start to end, one line per suite; bands are bootstrapped by episode."""
    figure, axes = _panel(7.0, 3.8)
    free = tracks[tracks.target & (tracks.hidden == 0)]
    for suite, colour in _suites(free).items():
        part = free[free.suite == suite]
        bins = len(part.iou_over_time.iloc[0])
        found = [
            mean(part.assign(x=[curve[b] for curve in part.iou_over_time]), "x")
            for b in range(bins)
        ]
        time = np.linspace(0, 100, bins)
        axes.plot(
            time, [e.value for e in found], color=colour, label=f"{suite}, {len(part)} tracks"
        )
        axes.fill_between(
            time,
            [e.low for e in found],
            [e.high for e in found],
            color=colour,
            alpha=0.15,
            linewidth=0,
        )
    axes.axhline(0.8, color="#999999", linewidth=0.8, linestyle=":")
    axes.set(
        xlabel="% of the episode",
        ylabel="IoU with the visible target",
        ylim=(0, 1.02),
        xlim=(0, 100),
    )
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    return figure


def hidden_figure(tracks: "pd.DataFrame") -> "Figure":
    """Identity of the target kept to the episode's end against the frames for which it is hidden, with 95 % Wilson intervals."""
    figure, axes = _panel(6.4, 3.8)
    target = tracks[tracks.target]
    kinds = {"plate": "a plate hides it fully", "arm": "an arm moves in front"}
    for i, (kind, label) in enumerate(
        (kind, label) for kind, label in kinds.items() if (target.kind == kind).any()
    ):
        part = target[(target.hidden == 0) | (target.kind == kind)]
        hidden = sorted(part.hidden.unique())
        found = [share(part[part.hidden == n].kept) for n in hidden]
        _line(
            axes,
            [n + 0.12 * (i - 0.5) for n in hidden],
            found,
            (WINNER, OTHER)[i],
            label,
            counts=i == 0,
        )
    axes.set(
        xlabel="frames hidden (below: tracks behind the plate)",
        ylabel="% of targets tracked at the end",
        ylim=(0, 103),
        xticks=range(7),
    )
    axes.set_xlim(-0.4, 6.4)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 0.06))
    return figure


def size_figure(objects: "pd.DataFrame", bins: int = 7) -> "Figure":
    """Recall of the detector against the visible size of an object, in bins of equally many, with 95 % Wilson intervals."""
    figure, axes = _panel(6.4, 3.8)
    edges = np.unique(np.quantile(objects.px, np.linspace(0, 1, bins + 1)))
    place = np.clip(np.searchsorted(edges, objects.px, side="right") - 1, 0, len(edges) - 2)
    parts = [objects[place == i] for i in range(len(edges) - 1)]
    middles = [float(part.px.median()) for part in parts]
    for column, label, colour in (
        ("recalled", "among the 10 best boxes", WINNER),
        ("proposed", "above the detector's own threshold", OTHER),
    ):
        _line(axes, middles, [share(part[column]) for part in parts], colour, label)
    axes.set(
        xlabel=f"visible pixels ({len(objects)} objects in view, {len(parts)} bins)",
        ylabel="% found (IoU 0.5)",
        xscale="log",
        ylim=(0, 103),
    )
    axes.xaxis.set_major_formatter("{x:.0f}")
    axes.xaxis.set_minor_formatter("{x:.0f}")
    axes.legend(frameon=False, loc="best")
    return figure


def _suites(table: "pd.DataFrame") -> dict[str, str]:
    """The suites of a table in their usual order, each with its colour."""
    return {
        name: colour
        for name, colour in zip(BENCHMARKS, SUITE_COLOURS, strict=True)
        if (table.suite == name).any()
    }


def _line(
    axes: "Axes",
    x: Sequence[float],
    found: Sequence[Estimate],
    colour: str,
    label: str,
    counts: bool = False,
) -> None:
    middle = np.array([100 * e.value for e in found])
    spread = np.maximum(
        [middle - [100 * e.low for e in found], [100 * e.high for e in found] - middle], 0
    )
    axes.errorbar(
        x,
        middle,
        spread,
        color=colour,
        marker="o",
        markersize=4,
        capsize=3,
        linewidth=1.4,
        elinewidth=1,
        label=label,
    )
    for place, e in zip(x, found, strict=True):
        if counts:
            axes.text(place, 1.5, f"{e.n}", ha="center", fontsize=8, color="#666666")


def _bars(
    axes: "Axes", names: Sequence[str], found: Sequence[Estimate], colours: Sequence[str]
) -> None:
    middle = np.array([100 * e.value for e in found])
    spread = np.maximum(
        [middle - [100 * e.low for e in found], [100 * e.high for e in found] - middle], 0
    )
    axes.bar(range(len(found)), middle, 0.55, color=list(colours), alpha=0.85)
    axes.errorbar(
        range(len(found)), middle, spread, fmt="none", ecolor="black", capsize=3, linewidth=1
    )
    axes.set_xticks(
        range(len(found)), [f"{name}\nn = {e.n}" for name, e in zip(names, found, strict=True)]
    )


def _panel(width: float, height: float) -> "tuple[Figure, Axes]":
    figure, grid = _panels(width, height, 1)
    return figure, grid[0]


def _panels(
    width: float, height: float, n: int, sharey: bool = False
) -> "tuple[Figure, list[Axes]]":
    figure = empty_figure(width, height)
    grid = figure.subplots(1, n, squeeze=False, sharey=sharey)[0].tolist()
    for axes in grid:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, grid
