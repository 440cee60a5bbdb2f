"""The measures of a replay as tables of text and numbers."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.analysis.attention import intervals
from vap_core.analysis.attention.measures import LOOKALIKES, REGIONS, TARGET
from vap_core.analysis.attention.patterns import (
    LOCALISATIONS,
    over_views,
    per_episode,
    with_localisation,
)
from vap_core.base.errors import BadStudy
from vap_core.base.files import align
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study.stats import share
from vap_core.study.store import KEY

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("lift", "on_target", "on_rival", "drift", "switches", "entropy")
"""The measures of an episode whose relation to success is reported."""
ALL_SUITES = "all suites"
INTERVALS = ("lift", "lift_lookalikes", "on_target", "on_rival")
"""The measures of `where_queries_look` that get an interval, over layouts."""


def text(tables: "dict[str, pd.DataFrame]") -> str:
    """Where every query looks, and the patterns.

    Where no call came before the first touch, it says so.
    """
    episodes = tables["episodes"]
    table = per_episode(tables["calls"], episodes)
    whole = per_episode(tables["calls"], episodes, whole=True)
    again = int(episodes["reproduced"].sum())
    parts = [f"{len(episodes)} episodes run again, {again} of them end as in the run"]
    if len(table):
        parts[0] += "; before the first touch:"
        parts.append(align(_rows(where_text(where_queries_look(table)))))
    if len(whole):
        parts.append("the word that means the target, over whole episodes:")
        parts.append(align(_rows(pattern_counts(with_localisation(whole)))))
    if not len(table):
        parts.append("no call came before the first touch")
    return "\n\n".join(parts)


def in_order(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows by suite, then by the name of the method.

    The benchmarks come first, in their order, then others as they stand, and ALL_SUITES last.
    """
    if table.empty:
        return table
    suites = table["suite"].astype(str)
    places = list(dict.fromkeys([*BENCHMARKS, *suites[suites != ALL_SUITES], ALL_SUITES]))
    order = np.lexsort((table["method"].astype(str), suites.map(places.index)))
    return table.iloc[order].reset_index(drop=True)


def where_queries_look(table: "pd.DataFrame") -> "pd.DataFrame":
    """Means over episodes, by suite (and ALL_SUITES), method and query of `per_episode`'s table.

    Measures of INTERVALS have their 95 % interval beside them, as NAME_low and NAME_high.
    """
    import pandas as pd

    rows = []
    for key, group in _groups(table, ["method", "query"]):
        row: dict[str, Any] = dict(zip(["suite", "method", "query"], key, strict=True))
        row["n"] = len(group)
        for name in ("chance", "chance_hit", "drift", "entropy"):
            row[name] = group[name].mean()
        for name in INTERVALS:
            found = intervals.mean(
                group[name].to_numpy(float), list(group["layout"]), list(group["suite"])
            )
            row |= {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
        rows.append(row)
    return in_order(pd.DataFrame(rows))


def where_text(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of `where_queries_look` with two digits, and intervals in brackets."""
    shown = table[["suite", "method", "query", "n"]].copy()
    for name in INTERVALS:
        cells = []
        for row in table.to_dict("records"):
            cells.append(f"{row[name]:.2f} [{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}]")
        shown[name] = cells
    for name in ("chance_hit", "drift", "entropy"):
        shown[name] = table[name].map("{:.2f}".format)
    return shown


def first_look(calls: "pd.DataFrame", episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Whether the first call looks at the target rather than its look-alikes, and what follows.

    By suite (and ALL_SUITES), method and query: `looks` is the share of episodes whose first call
    is denser on the target than on its look-alikes; `then_touches` is how often the target is the
    first thing touched after such a look, and `else_touches` how often it is after another. All are
    `Estimate`s with Wilson's interval over episodes.
    """
    import pandas as pd

    merged = over_views(calls)
    merged = merged[merged[f"chance_{TARGET}"] > 0]
    order = merged.sort_values("step").groupby([*KEY, "query"], observed=True, sort=False)
    first = order.head(1).merge(episodes, on=KEY)
    density = first[f"share_{TARGET}"] / first[f"chance_{TARGET}"]
    rival = first[f"share_{LOOKALIKES}"] / first[f"chance_{LOOKALIKES}"].clip(lower=1e-9)
    first = first.assign(looks=density > rival, touches=first["touched"].astype(str) == TARGET)
    rows = []
    for key, group in _groups(first, ["method", "query"]):
        row: dict[str, Any] = dict(zip(["suite", "method", "query"], key, strict=True))
        row["looks"] = share(group["looks"])
        row["then_touches"] = share(group.loc[group["looks"], "touches"])
        row["else_touches"] = share(group.loc[~group["looks"], "touches"])
        rows.append(row)
    return in_order(pd.DataFrame(rows))


def pattern_counts(table: "pd.DataFrame") -> "pd.DataFrame":
    """Episodes of every localisation and their successes; `table` is `with_localisation`'s."""
    import pandas as pd

    rows = []
    for (suite, method), group in table.groupby(["suite", "method"], observed=True, sort=False):
        row = {"suite": str(suite), "method": str(method), "n": len(group)}
        for name in LOCALISATIONS:
            found = group[group["localisation"] == name]
            row[name] = len(found)
            row[f"{name}, success"] = int(found["success"].sum())
        rows.append(row)
    return in_order(pd.DataFrame(rows))


def layer_table(layers: "pd.DataFrame") -> "pd.DataFrame":
    """Density on the target and on the look-alikes by layer, mean over heads and episodes."""
    import pandas as pd

    rows = []
    keys = ["suite", "method", "query", "layer"]
    for key, group in layers.groupby(keys, observed=True, sort=False):
        seen = group[group["chance_target"] > 0]
        row = dict(zip(keys, key, strict=True))
        row["n"] = len(seen[KEY].drop_duplicates())
        row["lift"] = seen["share_target"].sum() / seen["chance_target"].sum()
        row["lift_lookalikes"] = seen["share_lookalikes"].sum() / seen["chance_lookalikes"].sum()
        rows.append(row)
    return in_order(pd.DataFrame(rows))


def _groups(
    table: "pd.DataFrame", keys: list[str]
) -> "Iterator[tuple[tuple[str, ...], pd.DataFrame]]":
    """The rows by suite and `keys`; where there are several suites, of all together, too."""
    for key, group in table.groupby(["suite", *keys], observed=True, sort=False):
        yield tuple(map(str, key)), group
    if table["suite"].nunique() > 1:
        for key, group in table.groupby(keys, observed=True, sort=False):
            yield (ALL_SUITES, *map(str, key)), group


def _rows(table: "pd.DataFrame") -> list[list[str]]:
    return [list(map(str, table.columns)), *table.astype(str).to_numpy().tolist()]


def causal_table(causal: "pd.DataFrame") -> "pd.DataFrame":
    """What is where by attention and by the causal measures of the same calls.

    Columns with a region's name are the density inside it, 1 where it is that of the whole view;
    `rank_gradient` and `rank_masking` are the mean rank correlations over patches with the two
    causal measures; n is calls.

    Raises: BadStudy when no call has causal measures.
    """
    if causal.empty:
        raise BadStudy(
            "attention: no call of these tables has causal measures; replay with --explain 2 and "
            "another --out."
        )
    groups = causal.groupby(["suite", "method", "measure"], observed=True, sort=False)
    table = groups[["hit", "chance_hit", "rank_gradient", "rank_masking"]].mean()
    for region in reversed(REGIONS):
        shares = groups[[f"share_{region}", f"chance_{region}"]].sum()
        table.insert(0, region, shares[f"share_{region}"] / shares[f"chance_{region}"])
    rounded = table.astype(float).round(2)  # two digits of a float32 are shown as six
    rounded.insert(0, "n", groups.size())
    return in_order(rounded.reset_index())
