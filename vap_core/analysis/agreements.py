"""When should views be made to agree? Cases of first frames, by the margin that association asks.

agreements = pd.read_parquet("data/results/perception_agreements.parquet")
gated_cases(agreements, "geometry", [0.0, 0.5, 1.0])
gate_figure(agreements, "geometry")
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vap_core.base.figures import empty_figure
from vap_core.base.palette import CASES

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

EPISODE = ["suite", "task", "episode"]
ALONE = "off"
"""Every view for itself, in the table's column `associate`."""


def gated_cases(agreements: "pd.DataFrame", way: str, margins: Sequence[float]) -> "pd.DataFrame":
    """Episodes that are right, Case 1 or Case 2 at t = 0, by suite and the least margin.

    Where the best choice for all views leads the next by at least the margin (natural logarithms),
    the views agree on it; elsewhere each keeps its own. A margin of infinity associates nothing.
    """
    import pandas as pd

    alone = agreements[agreements["associate"].eq(ALONE)].set_index(EPISODE)["case"]
    joint = agreements[agreements["associate"].eq(way)].set_index(EPISODE)
    lines = []
    for least in margins:
        # An episode with one view has nothing to associate, and no margin.
        case = joint["case"].where(joint["margin"].ge(least), alone)
        for suite, cases in case.groupby(level="suite", sort=False):
            line = {"suite": suite, "margin": least, "n": len(cases)}
            for name in ("right", "case 1", "case 2"):
                line[name] = int(cases.eq(name).sum())
            lines.append(line)
    return pd.DataFrame(lines)


def gate_figure(agreements: "pd.DataFrame", way: str) -> "Figure":
    """Case 1 and Case 2 over the margin that is asked for, one part a suite."""
    import numpy as np

    margins = np.arange(0.0, 4.01, 0.1).tolist()
    cases = gated_cases(agreements, way, margins)
    suites = list(dict.fromkeys(cases["suite"]))
    figure = empty_figure(3.2 * len(suites), 2.4)
    parts = np.atleast_1d(figure.subplots(1, len(suites), sharey=True))
    for axes, suite in zip(parts, suites, strict=True):
        of_suite = cases[cases["suite"].eq(suite)]
        for name, style in (("case 1", "-"), ("case 2", "--")):
            share = 100 * of_suite[name] / of_suite["n"]
            axes.plot(of_suite["margin"], share, style, color=CASES[name], label=name)
        axes.set_title(f"{suite}, n {int(of_suite['n'].iloc[0])}", fontsize=9)
        axes.set_xlabel("least margin, nats", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    parts[0].set_ylabel("% of first frames", fontsize=8)
    parts[0].legend(frameon=False, fontsize=8)
    return figure
