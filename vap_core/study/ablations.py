"""Runs an ablation, one run an arm: its table and its picture (P appendix)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import align, writing
from vap_core.base.pictures import method_marks, write_png
from vap_core.base.types import value
from vap_core.policies.protocol import TEMPERATURE, checkpoint_of
from vap_core.study import paper, store
from vap_core.study.engine import Record, run
from vap_core.study.logs import hiding_lines, switching_lines
from vap_core.study.methods import ABLATIONS, Ablation
from vap_core.study.stats import (
    Comparison,
    Rate,
    compare,
    holm,
    layout_names,
    points_text,
    rate,
    rate_over_layouts,
)
from vap_core.study.trials import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

PAPER_SUITES = {"simpler-fractal": "Google Robot", "simpler-bridge": "WidowX"}
"""The columns of the paper's ablation tables for our suites."""


@value
class ArmResult:
    """One arm over all episodes of a suite; errors count as no success.

    `against` compares it with the ablation's first arm on the same episodes; None for that arm.
    Its `p_holm` is corrected over the arms of one suite. `paper` is the paper's SR, a fraction, nan
    where it has none.
    """

    suite: str
    arm: str
    sr: Rate
    cmr: Rate
    case_1: Rate
    case_2: Rate
    against: Comparison | None
    paper: float


def arm_results(ablation: Ablation, episodes: "pd.DataFrame") -> list[ArmResult]:
    """The arms of every suite in `episodes` (rows of a results table) that ran the first arm and
    another.

    Raises: BadOutput when they are of several policies in a suite, when an arm shares no episode
        with the first, and as `paper.ledger`; BadSuite, as `statistics.compare`.
    """
    results = []
    for suite in dict.fromkeys(episodes["suite"]):
        of_suite = episodes[episodes["suite"] == suite].assign(split="")
        of_suite["layout"] = layout_names(of_suite)
        ran = set(of_suite["method"])
        arms = [arm for arm in ablation.names if arm in ran]
        if ablation.names[0] not in ran or len(arms) < 2:
            continue
        _refuse_policies(suite, of_suite[of_suite["method"].isin(arms)])
        against = _against_default(arms, of_suite, ablation.retired)
        for arm in arms:
            rows = of_suite[of_suite["method"] == arm]
            results.append(
                ArmResult(
                    suite=suite,
                    arm=arm,
                    sr=_share(rows, "success"),
                    cmr=_share(rows, "cmr"),
                    case_1=rate(int(rows["case"].eq("case 1").sum()), len(rows)),
                    case_2=rate(int(rows["case"].eq("case 2").sum()), len(rows)),
                    against=against.get(arm),
                    paper=_paper_sr(ablation, suite, arm),
                )
            )
    return results


def policy_results(ablation: Ablation, episodes: "pd.DataFrame") -> dict[str, list[ArmResult]]:
    """The methods of an ablation of policies, by the label of the policy that was run; each method
    against the first one with the same policy.

    Raises: as `arm_results`.
    """
    found = {}
    for label, checkpoint in ablation.policies.items():
        results = arm_results(ablation, _of_checkpoint(episodes, checkpoint))
        if results:
            found[label] = results
    return found


def across_policies(ablation: Ablation, episodes: "pd.DataFrame") -> list[ArmResult]:
    """The last method of an ablation of policies; its arms are the labels of the policies, each
    against the first one on the same episodes.

    Raises: as `arm_results`.
    """
    import pandas as pd

    method = ablation.names[-1]
    parts = []
    for label, checkpoint in ablation.policies.items():
        part = _of_checkpoint(episodes, checkpoint)
        parts.append(part[part["method"] == method].assign(method=label, policy=method))
    labels = Ablation(ablation.question, arms={}, methods=tuple(ablation.policies))
    return arm_results(labels, pd.concat(parts, ignore_index=True))


def _of_checkpoint(episodes: "pd.DataFrame", checkpoint: str) -> "pd.DataFrame":
    """The rows of a checkpoint of that name, with its own sampling noise."""
    labels = episodes["policy"]
    named = labels.map(checkpoint_of) == Path(checkpoint).name
    return episodes[named & ~labels.str.contains(TEMPERATURE, regex=False)]


def arm_rows(results: list[ArmResult]) -> list[list[str]]:
    """The table as text cells, header first; rates and differences in percent."""
    rows = [
        [
            "suite",
            "arm",
            "n",
            "SR % [95 %]",
            "CMR % [95 %]",
            "case 1",
            "case 2",
            "against the first, points [95 %]",
            "p Holm",
            "paper's SR %",
        ]
    ]
    for one in results:
        difference = p = "-"
        if one.against is not None:
            difference = points_text(one.against, digits=1)
            p = f"{one.against.p_holm:.3g}"
        published = "-" if one.paper != one.paper else f"{100 * one.paper:.1f}"
        cells = [one.suite, one.arm, str(one.sr.n), str(one.sr), str(one.cmr)]
        cases = [str(one.case_1.k), str(one.case_2.k)]
        rows.append([*cells, *cases, difference, p, published])
    return rows


def _against_default(
    arms: Sequence[str], of_suite: "pd.DataFrame", retired: int
) -> dict[str, Comparison]:
    """Each arm against the first, over all tasks of the suite; `retired` arms count as p = 1.

    Raises: BadOutput for one that shares no episode with the first.
    """
    default, *others = arms
    found = {}
    for arm in others:
        part = of_suite[of_suite["method"].isin([default, arm])]
        comparisons = compare(part, [default, arm], by_task=False)
        if not comparisons:
            suite = part["suite"].iloc[0]
            raise BadOutput(
                f"arm_results: {arm} shares no episode with {default} on {suite}, so they cannot "
                f"be compared; run it on {default}'s episodes (the same seeds), or leave its rows "
                "out."
            )
        (found[arm],) = comparisons
    p_holm = holm([*(comparison.p for comparison in found.values()), *[1.0] * retired])
    corrected = {}
    for (arm, comparison), p in zip(found.items(), p_holm, strict=False):
        corrected[arm] = replace(comparison, p_holm=p)
    return corrected


def _refuse_policies(suite: str, of_arms: "pd.DataFrame") -> None:
    """Raises: BadOutput for more than one policy."""
    policies = sorted(map(str, of_arms["policy"].unique()))
    if len(policies) > 1:
        raise BadOutput(
            f"arm_results: the arms on {suite} are of {len(policies)} policies "
            f"({', '.join(policies)}); name one: keep its rows alone. policy_results compares "
            "several."
        )


def _share(rows: "pd.DataFrame", column: str) -> Rate:
    """The share of episodes in which it holds, of those that can say, as `metrics.count` does; its
    interval is over layouts where one returns.
    """
    return rate_over_layouts(rows[rows[column].notna()], column)


def _paper_sr(ablation: Ablation, suite: str, arm: str) -> float:
    if arm not in ablation.rows or suite not in PAPER_SUITES:
        return float("nan")
    facts = paper.ledger()
    facts = facts[
        facts["table"].eq(ablation.paper)
        & facts["row"].eq(ablation.rows[arm])
        & facts["column"].eq(PAPER_SUITES[suite])
        & facts["metric"].eq("SR")
    ]
    return float(facts["value"].iloc[0]) / 100 if len(facts) else float("nan")


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


def ablate_text(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> str:
    """Run what `root` lacks, draw `NAME.png` there, and return the table.

    Raises: what `engine.run` and `arm_results` raise.
    """
    ablation = ABLATIONS[name]
    episodes = run_arms(name, study, root, workers=workers, record=record)
    picture = root / f"{name}.png"
    if ablation.policies:
        tables, figure = _of_policies(name, episodes)
        policy = "each by its label"
    else:
        results = arm_results(ablation, episodes)
        tables, figure = [align(arm_rows(results))], effects_figure(results, ablation.question)
        policy = study.policy
    with writing(picture, "ablate"):
        write_png(figure, picture, dpi=200)
    errors = int(episodes["outcome"].eq("error").sum())
    first = arm_folder(study, root, ablation.names[0])
    lines = [
        ablation.question,
        *tables,
        *switching_lines(episodes),
        *hiding_lines(episodes),
        f"n episodes a suite, {study.seeds} seed(s) from {study.seed}; policy {policy}; "
        f"{errors} errors. Intervals of rates: over layouts where they return, else Wilson's; of "
        "differences: cluster bootstrap over layouts. p exact, Holm's correction over the arms of "
        "a suite.",
        f"picture: {picture}",
        f"every arm is a run of its own: {study.next_command('diagnose', first)}",
    ]
    return "\n".join(lines)


def _of_policies(name: str, episodes: "pd.DataFrame") -> "tuple[list[str], Figure]":
    """A table for every policy, and one that compares the policies; and their picture."""
    ablation = ABLATIONS[name]
    of_policies = policy_results(ablation, episodes)
    tables = []
    for label, results in of_policies.items():
        tables += [f"{label}: {ablation.policies[label]}", align(arm_rows(results))]
    across = align(arm_rows(across_policies(ablation, episodes)))
    tables += [f"{ablation.names[-1]} with every policy, against the first", across]
    return tables, policies_figure(of_policies, name)


def run_arms(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> "pd.DataFrame":
    """The episodes of every arm of an ablation; those that `root` lacks are run.

    Each arm is a run in a folder of its own, so that ablations share the arms that they have in
    common; so is each arm with each policy, where the ablation has policies.

    Raises: what `engine.run` raises.
    """
    import pandas as pd

    tables = []
    for policy in ABLATIONS[name].policies.values() or (study.policy,):
        with_policy = replace(study, policy=policy)
        for arm in ABLATIONS[name].names:
            of_arm = replace(with_policy, methods=(arm,))
            folder = arm_folder(with_policy, root, arm)
            tables.append(run(of_arm, folder, workers=workers, record=record))
    columns = dict.fromkeys(chain.from_iterable(tables))
    kept = [table.dropna(axis="columns", how="all") for table in tables]
    return pd.concat(kept, ignore_index=True).reindex(columns=list(columns))


def arm_folder(study: Study, root: Path, arm: str) -> Path:
    """The run of one arm: its name, and the digest of everything that its results depend on."""
    digest = store.digest(replace(study, methods=(arm,)).configuration())
    return root / f"{arm}-{digest[:8]}"
