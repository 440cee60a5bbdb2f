"""The measures of a replay as tables of text and numbers."""

from typing import TYPE_CHECKING

from vap_core.analysis.attention.patterns import LOCALISATIONS, per_episode, with_localisation
from vap_core.analysis.attention.prediction import predict_success
from vap_core.base.tables import align
from vap_core.evaluation.store import KEY

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("lift", "on_target", "on_rival", "drift", "switches", "entropy")
"""The measures of an episode whose relation to success is reported."""


def text(tables: "dict[str, pd.DataFrame]") -> str:
    """Where every query looks, the patterns, and how well the measures tell successes."""
    episodes = tables["episodes"]
    table = per_episode(tables["calls"], episodes)
    again = int(episodes["reproduced"].sum())
    parts = [
        f"{len(episodes)} episodes run again, {again} of them end as in the run; up to the first "
        "touch:",
        align(_rows(where_queries_look(table))),
        align(_rows(pattern_counts(with_localisation(table)))),
    ]
    lines = [["suite", "method", "measure", "AUC for success [95 %]"]]
    for (suite, method), group in with_localisation(table).groupby(
        ["suite", "method"], observed=True
    ):
        for name, area in predict_success(group, MEASURES).items():
            lines.append([str(suite), str(method), name, str(area)])
    parts.append(align(lines))
    return "\n\n".join(parts)


def where_queries_look(table: "pd.DataFrame") -> "pd.DataFrame":
    """Means over episodes, by suite, method and query; `table` is `per_episode`'s."""
    names = ["share", "chance", "lift", "lift_lookalikes", "on_target", "chance_hit", "on_rival"]
    names += ["drift", "entropy"]
    groups = table.groupby(["suite", "method", "query"], observed=True, sort=False)
    means = groups[names].mean().round(2)
    means.insert(0, "n", groups.size())
    return means.reset_index()


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
    return pd.DataFrame(rows)


def layer_table(layers: "pd.DataFrame") -> "pd.DataFrame":
    """Density on the target and on the look-alikes by layer, mean over heads and episodes.

    `best_head` is the mean over episodes of the densest head on the target.
    """
    import pandas as pd

    rows = []
    keys = ["suite", "method", "query", "layer"]
    for key, group in layers.groupby(keys, observed=True, sort=False):
        seen = group[group["chance_target"] > 0]
        row = dict(zip(keys, key, strict=True))
        row["n"] = len(seen[KEY].drop_duplicates())
        row["lift"] = seen["share_target"].sum() / seen["chance_target"].sum()
        row["lift_lookalikes"] = seen["share_lookalikes"].sum() / seen["chance_lookalikes"].sum()
        by_head = seen.groupby("head", observed=True)[["share_target", "chance_target"]].sum()
        row["best_head"] = (by_head["share_target"] / by_head["chance_target"]).max()
        rows.append(row)
    return pd.DataFrame(rows)


def _rows(table: "pd.DataFrame") -> list[list[str]]:
    return [list(map(str, table.columns)), *table.astype(str).to_numpy().tolist()]
