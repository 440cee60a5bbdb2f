"""The price and the gain of every threshold, and the choice among them.

The price is the share of rightly elected objects that a threshold refuses; the gain are the wrong
candidates that it refuses, most of all where the object is absent.
"""

from typing import TYPE_CHECKING

import numpy as np

from vap_core.base.types import value
from vap_core.perception.protocols import FamiliarityJudge, Stack, Thresholds
from vap_core.study.stats import clustered_share
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd

PRICE = 0.03
"""Share of the rightly elected objects that the chosen threshold may refuse."""
LEAST_RIGHT = 30
"""Rightly elected objects from which on a threshold is chosen."""
STEP = 0.01
SHOWN = (-0.08, -0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08)
"""The thresholds of the table, from the chosen one."""
NOTE = (
    "value [95 % interval] n, in %; Wilson's interval with n reduced to what the scenes, which are "
    "the independent units, are worth.\n"
    "right refused: of the objects that are elected rightly (the price). tinted: views in which a "
    "wrong candidate stays, which should be 0: of an object that is in view, of one with only "
    "look-alikes in view, and of one of whose kind nothing is.\n"
    "familiar: views of the world that the stack's own models were trained on, as far as the "
    "phrase shows: where nothing of its kind is in view, most are not."
)
BRANCHES = {True: "familiar", False: "unfamiliar"}


@value
class Choice:
    """The chosen threshold of each kind of view; None where too few objects were elected."""

    familiar: float | None
    unfamiliar: float | None

    def thresholds(self, stack: Stack) -> Thresholds | None:
        """Those of a stack; None where one is lacking that the stack needs."""
        unfamiliar = self.unfamiliar
        if not isinstance(stack.detector, FamiliarityJudge):
            unfamiliar = self.familiar  # all its views are familiar
        if self.familiar is None or unfamiliar is None:
            return None
        return Thresholds(self.familiar, unfamiliar)


def choose(table: "pd.DataFrame", price: float = PRICE) -> Choice:
    """The highest thresholds that refuse no more than `price` of the rightly elected objects."""
    chosen = {}
    for familiar, name in BRANCHES.items():
        right = table[(table.familiar == familiar) & table.right].likeness.to_numpy(float)
        chosen[name] = _highest(right, price) if len(right) >= LEAST_RIGHT else None
    return Choice(chosen["familiar"], chosen["unfamiliar"])


def text_report(table: "pd.DataFrame", chosen: Choice, stack: Stack) -> str:
    """What the command prints."""
    parts = []
    for familiar, name in BRANCHES.items():
        part = table[table.familiar == familiar]
        if not len(part):
            continue
        threshold: float | None = getattr(chosen, name)
        current = None if stack.thresholds is None else getattr(stack.thresholds, name)
        lines = [f"{name} views:"]
        if threshold is None:
            more = "take more --scenes, or name a photo set with --photos"
            if not familiar:
                more = "name a photo set with --photos, or one with more photos"
            lines.append(
                f"{int(part.right.sum())} rightly elected objects, fewer than {LEAST_RIGHT}: none "
                f"is chosen; {more}."
            )
        if threshold is not None or current is not None:
            lines.append(printed(threshold_rows(part, threshold, current)))
        parts.append("\n".join(lines))
    thresholds = chosen.thresholds(stack)
    if thresholds is not None:
        parts.append(f"chosen: {thresholds}; the stack has {stack.thresholds}")
    return "\n\n".join([*parts, NOTE])


def threshold_rows(
    part: "pd.DataFrame", chosen: float | None, current: float | None
) -> list[list[str]]:
    """A line per threshold around the chosen one, or the present one; then one per source."""
    rows = [
        ["threshold", "", "right refused", "tinted, in view", "tinted, look-alikes", "tinted, none"]
    ]
    middle = current if chosen is None else chosen
    assert middle is not None, "one of them is known"
    shown = {round(middle + step, 2) for step in SHOWN}
    if current is not None:
        shown.add(current)
    for threshold in sorted(shown):
        marks = []
        if threshold == chosen:
            marks.append("chosen")
        if threshold == current:
            marks.append("now")
        rows.append([f"{threshold:.2f}", ", ".join(marks), *_cells(part, threshold)])
    if part.source.nunique() > 1:
        for source, of_source in part.groupby("source"):
            rows.append([f"{middle:.2f}", str(source), *_cells(of_source, middle)])
    return rows


def _highest(right: np.ndarray, price: float) -> float:
    """The highest multiple of STEP below which at most a share `price` of the values lies."""
    allowed = int(price * len(right) + 1e-9)
    lowest_kept = np.sort(right)[min(allowed, len(right) - 1)]
    return round(float(np.floor(lowest_kept / STEP + 1e-6)) * STEP, 2)


def _cells(part: "pd.DataFrame", threshold: float) -> list[str]:
    """The price, and three shares of views in which a wrong candidate is tinted."""
    right = part[part.right]
    kept = part.likeness >= threshold  # nan, where there are no candidates, is not
    cells = [_share(~kept[right.index], right)]
    for case in ("present", "look-alikes", "absent"):
        asked = part[part.case == case]
        cells.append(_share(kept[asked.index] & ~asked.right, asked))
    return cells


def _share(hits: "pd.Series", part: "pd.DataFrame") -> str:
    """The share of hits with its interval, scenes of one source as clusters."""
    clusters = part.source.astype(str) + " " + part.scene.astype(str)
    return clustered_share(hits.to_numpy(float), clusters).text(digits=0)
