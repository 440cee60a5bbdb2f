"""What it would cost not to act where the vote is narrow, and what that would prevent.

A run of a suite and of the same suite without its targets (NAME-absent) says, for every threshold
on the margin of the vote at t = 0, in how many episodes the robot still acts, how often it succeeds
in those, and how often it acts although its object is not there.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vap_core.evaluation.metrics import Rate, rate
from vap_core.simulation.suites import ABSENT

if TYPE_CHECKING:
    import pandas as pd

THRESHOLDS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Least margins to act on, in shares of the votes: one vote of five apart."""


@dataclass(frozen=True)
class Abstention:
    """One method with one policy at one threshold, by suite.

    `acts` is the share of the episodes with a target in which it acts, `success` that of those in
    which it then succeeds; `acts_absent` the share of the episodes without one in which it acts,
    and `touches_absent` that in which it acts and touches an object.
    """

    suite: str
    method: str
    policy: str
    threshold: float
    acts: Rate
    success: Rate
    acts_absent: Rate
    touches_absent: Rate


def abstentions(episodes: "pd.DataFrame") -> list[Abstention]:
    """Every method that votes, by policy, in every suite that was run with and without targets."""
    found: list[Abstention] = []
    if "margin" not in episodes or "touched" not in episodes:
        return found
    groups = {}
    for key, of_key in episodes.groupby(["suite", "method", "policy"], sort=False):
        # An episode that ended before the vote has no margin: it does not act.
        if of_key["margin"].notna().any():
            groups[key] = of_key
    for (suite, method, policy), present in groups.items():
        absent = groups.get((f"{suite}{ABSENT}", method, policy))
        if absent is None:
            continue
        for threshold in THRESHOLDS:
            acting = present[present["margin"] >= threshold]
            without = absent[absent["margin"] >= threshold]
            touching = int(without["touched"].eq(True).sum())
            found.append(
                Abstention(
                    suite=str(suite),
                    method=str(method),
                    policy=str(policy),
                    threshold=threshold,
                    acts=rate(len(acting), len(present)),
                    success=rate(int(acting["success"].eq(True).sum()), len(acting)),
                    acts_absent=rate(len(without), len(absent)),
                    touches_absent=rate(touching, len(absent)),
                )
            )
    return found


def abstention_rows(found: list[Abstention]) -> list[list[str]]:
    """The table as text cells, header first."""
    rows = [
        [
            "suite",
            "method",
            "policy",
            "least margin",
            "acts [95 %]",
            "SR when it acts [95 %]",
            "acts without the target [95 %]",
            "and touches something [95 %]",
        ]
    ]
    for line in found:
        rates = (line.acts, line.success, line.acts_absent, line.touches_absent)
        named = [line.suite, line.method, line.policy]
        rows.append([*named, f"{line.threshold:g}", *map(str, rates)])
    return rows
