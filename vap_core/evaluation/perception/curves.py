"""The curves of a survey: the tables behind them, and the figures.

Every function takes a table of the survey (`run.read`) and returns a table or a figure; nothing is
measured here.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from vap_core.base.figures import OTHER, TIER_COLOURS, WINNER, empty_figure
from vap_core.base.palette import FRAME, TEXT, suite_colour
from vap_core.evaluation.perception.estimates import Estimate, mean, share
from vap_core.evaluation.perception.first_frames import KS, RULES, USUAL_K
from vap_core.simulation.assets.objects import TIERS
from vap_core.simulation.suites import BENCHMARKS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    _draw_bars(right, shares, TIER_COLOURS)
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
        middle, low, high = _bounds(means)
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


def _bounds(
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
    middle, low, high = _bounds(estimates)
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


def _draw_bars(axes: "Axes", estimates: Mapping[str, Estimate], colours: Mapping[str, str]) -> None:
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
