"""The table of an ablation: every arm with its rate, against the default on the same episodes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.base.types import value
from vap_core.evaluation import paper
from vap_core.evaluation.ablations.arms import Ablation
from vap_core.evaluation.layouts import layout_names
from vap_core.evaluation.metrics import Rate, rate
from vap_core.evaluation.statistics import (
    Comparison,
    compare,
    holm,
    points_text,
    rate_over_layouts,
)
from vap_core.policies.names import TEMPERATURE, checkpoint_of

if TYPE_CHECKING:
    import pandas as pd

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
