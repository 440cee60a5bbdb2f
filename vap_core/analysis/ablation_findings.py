"""Whether the paper's ablations hold here: every arm's difference beside the paper's.

findings_table(ablation_results(episodes))
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vap_core.base.files import signed
from vap_core.study.ablations import ArmResult, is_shown
from vap_core.study.stats import Comparison, points_text

if TYPE_CHECKING:
    import pandas as pd

NO_POINT = 0.005
"""Differences of success below it round to no point."""


def findings_table(results: Mapping[str, Sequence[ArmResult]]) -> "pd.DataFrame":
    """One row for every arm that the paper has, too; differences in points of success."""
    import pandas as pd

    rows = []
    for name, arms in results.items():
        for first, one in _pairs(arms):
            theirs = one.paper - first.paper
            if theirs != theirs:
                continue
            found = one.against
            assert found is not None
            row = {
                "ablation": name,
                "arm": one.arm,
                "n": one.sr.n,
                "here, points [95 %]": points_text(found),
                "paper": signed(100 * theirs),
                "the paper's finding": verdict(found, theirs),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def verdict(found: Comparison, theirs: float) -> str:
    """What a difference that was found says about another's difference, `theirs`.

    The other's own error is not known, and not counted. A difference of the other's that rounds to
    no point is none.
    """
    if abs(theirs) < NO_POINT:
        return "there is none, here is one" if is_shown(found) else "none is shown in either"
    within = found.low <= theirs <= found.high
    if not is_shown(found):
        beyond = theirs < found.low if theirs < 0 else theirs > found.high
        return "not here: as much is excluded" if beyond else "cannot tell"
    if within:
        return "holds"
    if theirs * found.difference < 0:
        return "the other way round"
    return "holds, weaker" if abs(theirs) > abs(found.difference) else "holds, stronger"


def _pairs(arms: Sequence[ArmResult]) -> list[tuple[ArmResult, ArmResult]]:
    """Every arm with the first arm of its suite."""
    first = {one.suite: one for one in arms if one.against is None}
    return [(first[one.suite], one) for one in arms if one.against is not None]
