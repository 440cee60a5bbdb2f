"""What a paired comparison of two methods can detect at all, before it is run."""

from collections.abc import Sequence

import numpy as np

from vap_core.evaluation.layouts import layout_name
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

POWER = 0.8
"""The chance with which a difference is to be detected."""


def power(pairs: int, effect: float, *, alpha: float = 0.05, discordant: float = 0.5) -> float:
    """The chance that McNemar's exact two-sided test detects a true difference of success rates.

    `effect` is the difference, `pairs` the number of episodes. `discordant` is the share of
    episodes where exactly one method succeeds, of which (1 + effect / discordant) / 2 favour the
    better one.
    """
    from scipy.stats import binom

    m = np.arange(pairs + 1)
    # The test rejects when one side has at most `reject` of the m discordant pairs.
    reject = binom.ppf(alpha / 2, m, 0.5)
    reject = np.where(binom.cdf(reject, m, 0.5) > alpha / 2, reject - 1, reject)
    better = 0.5 * (1 + effect / discordant)
    detected = binom.cdf(reject, m, better) + binom.sf(m - reject - 1, m, better)
    return float((binom.pmf(m, pairs, discordant) * np.where(reject < 0, 0.0, detected)).sum())


def minimum_detectable_effect(pairs: int, *, discordant: float = 0.5) -> float:
    """The least difference of two success rates that is detected with the power `POWER`.

    nan where McNemar's exact test on `pairs` episodes detects none. Assumes that on the share
    `discordant` of the episodes exactly one method succeeds: 0.5 is what two unrelated methods of
    50 % success give. Between methods that mostly succeed on the same episodes smaller differences
    are detected.
    """
    from scipy.optimize import brentq

    def excess(effect: float) -> float:
        return power(pairs, effect, discordant=discordant) - POWER

    if excess(discordant) <= 0:
        return float("nan")
    return float(brentq(excess, 0.0, discordant, xtol=1e-4))


def detectable_effect_text(rows: Sequence[EpisodeRow]) -> str:
    """One line to print before a run: what a comparison of two methods on `rows` can detect."""
    pairs = len(rows)
    units = _count_layouts(rows)
    effect = minimum_detectable_effect(units)
    where = f"{pairs} paired episodes"
    assumed = "half of the pairs discordant"
    if units < pairs:
        where += f" on {units} layouts"
    if np.isnan(effect):
        return (
            f"{where}: too few to detect any difference of methods "
            f"(80 % power, alpha 5 %, exact McNemar, {assumed})"
        )
    if units < pairs:
        assumed += ", counting each layout once"
    return (
        f"{where}: differences of {100 * effect:.0f} points or more are detected with 80 % power "
        f"(alpha 5 %, exact McNemar, {assumed})"
    )


def _count_layouts(rows: Sequence[EpisodeRow]) -> int:
    layouts = set()
    for row in rows:
        # A benchmark's layouts return under every seed; those of a warm-up suite do not.
        seed = row.seed if row.suite in suites.WARM_UPS else 0
        layouts.add((row.suite, row.task, layout_name(row), seed))
    return len(layouts)
