"""The effect of every arm as a forest plot: points of SR against the ablation's first arm."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vap_core.base.palette import method_marks
from vap_core.evaluation.ablations.table import ArmResult
from vap_core.evaluation.statistics import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

CLEAR, UNCLEAR = "#0072b2", "#9aa0a6"
"""Differences that are shown, and those that are not."""
LEVEL = 0.05
"""The exact p, corrected over the arms of a suite, below which a difference counts as shown."""
PAPER = "#d55e00"
OTHER = "#cc79a7"
"""Another policy's differences."""


def effects_figure(results: Sequence[ArmResult], title: str) -> "Figure":
    """One row per arm and suite: the difference in SR with its 95 % interval.

    A diamond is the paper's difference, where the paper has both arms.
    """
    from matplotlib.figure import Figure as NewFigure

    first = {one.suite: one for one in results if one.against is None}
    shown = [one for one in results if one.against is not None]
    figure = NewFigure(figsize=(7.2, 1.1 + 0.3 * len(shown)), layout="constrained")
    axes = figure.subplots()
    for y, one in enumerate(reversed(shown)):
        draw_effects(axes, one, results, y)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(shown)), [_label(one, first) for one in reversed(shown)])
    axes.set_xlabel("success rate against the first arm, points (95 % interval)")
    axes.set_title(title, loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        handles=legend_handles(), loc="outside lower center", ncols=3, frameon=False, fontsize=8
    )
    return figure


def draw_effects(
    axes: "Axes", one: ArmResult, results: Sequence[ArmResult], y: int | float
) -> None:
    """An arm's difference from the first arm of its suite among `results`, at height `y`."""
    assert one.against is not None
    low, mid, high = _points(one.against)
    colour = CLEAR if is_shown(one.against) else UNCLEAR
    axes.plot([low, high], [y, y], color=colour, linewidth=2)
    axes.plot(mid, y, "o", color=colour)
    (first,) = [each for each in results if each.suite == one.suite and each.against is None]
    theirs = 100 * (one.paper - first.paper)
    if theirs == theirs:
        axes.plot(theirs, y, "D", color=PAPER, markersize=5, fillstyle="none")


def draw_other(axes: "Axes", one: ArmResult, y: float) -> None:
    """The difference of the same arm with another policy, at height `y`."""
    assert one.against is not None
    low, mid, high = _points(one.against)
    axes.plot([low, high], [y, y], color=OTHER, linewidth=1)
    axes.plot(mid, y, "s", color=OTHER, markersize=2.5)


def _points(found: Comparison) -> tuple[float, float, float]:
    return 100 * found.low, 100 * found.difference, 100 * found.high


def policies_figure(
    of_policies: Mapping[str, Sequence[ArmResult]],
    label: str,
    again: Sequence[Sequence[ArmResult]] = (),
) -> "Figure":
    """The success rate of every method (95 %), with the policies side by side; `label` says what
    tells them apart. `again` has another training of each, drawn hollow.
    """
    from matplotlib.figure import Figure as NewFigure

    figure = NewFigure(figsize=(4.6, 3.0), layout="constrained")
    axes = figure.subplots()
    methods = dict.fromkeys(one.arm for results in of_policies.values() for one in results)
    for i, (method, (colour, marker)) in enumerate(method_marks(list(methods)).items()):
        offset = 0.08 * (i - (len(methods) - 1) / 2)
        look = {"color": colour, "marker": marker}
        _draw_rates(axes, list(of_policies.values()), method, offset, label=method, **look)
        if again:
            hollow = {**look, "markerfacecolor": "white", "linestyle": ":"}
            _draw_rates(axes, again, method, offset + 0.04, **hollow)
    n = ", ".join(dict.fromkeys(str(one.sr.n) for part in of_policies.values() for one in part))
    axes.set_xticks(range(len(of_policies)), list(of_policies))
    axes.set(xlabel=label, ylabel=f"success rate, % (95 %, n {n})", ylim=(-3, 103))
    axes.spines[["top", "right"]].set_visible(False)
    title = "hollow: trained\na second time" if again else None
    figure.legend(
        loc="outside right center", frameon=False, fontsize=8, title=title, title_fontsize=8
    )
    return figure


def _draw_rates(
    axes: "Axes",
    of_policies: Sequence[Sequence[ArmResult]],
    method: str,
    offset: float,
    **look: Any,
) -> None:
    """One method's success rate at each policy's place."""
    xs, rates = [], []
    for x, results in enumerate(of_policies):
        for one in results:
            if one.arm == method:
                xs.append(x + offset)
                rates.append(one.sr)
    bounds = [
        [100 * (one.value - one.low) for one in rates],
        [100 * (one.high - one.value) for one in rates],
    ]
    axes.errorbar(xs, [100 * one.value for one in rates], bounds, capsize=2, **look)


def is_shown(found: Comparison) -> bool:
    """Whether a difference is beyond chance.

    A bootstrap interval alone does not say so where few episodes come out otherwise: with five of
    96, all the same way, it leaves out 0, and the exact p is .06.
    """
    return found.p_holm < LEVEL


def legend_handles(whose: str = "") -> "list[Line2D]":
    """What the marks of `draw_effects` mean, and those of `draw_other`: `whose` they are."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=CLEAR, marker="o", label=f"a difference (exact p < {LEVEL:g}, Holm)"),
        Line2D([], [], color=UNCLEAR, marker="o", label="none shown"),
        Line2D([], [], color=PAPER, marker="D", fillstyle="none", linewidth=0, label="the paper's"),
    ]
    if whose:
        handles.append(Line2D([], [], color=OTHER, marker="s", linewidth=1, label=whose))
    return handles


def _label(one: ArmResult, first: dict[str, ArmResult]) -> str:
    if len(first) == 1:
        return f"{one.arm}, n {one.sr.n}"
    return f"{one.suite} {one.arm}, n {one.sr.n}"
