"""From the calls of a replay to episodes, patterns, tables and figures.

The paper shows four patterns of a learned token (P appendix, attention analysis): localisation that
is stable while the episode fails, that drifts, that is confused by look-alikes, and that succeeds.
Here they are defined by thresholds, over all calls of an episode. What is to tell of the outcome in
advance is measured over the calls before the first touch of anything.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from vap_core.base.errors import BadStudy
from vap_core.policies.protocol import ACTION
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study import charts
from vap_core.study.attention import BACKGROUND, LOOKALIKES, REGIONS, TARGET, WORDS
from vap_core.study.attention import name_of as name_of
from vap_core.study.attention import read as read
from vap_core.study.stats import NONE, SEED, Estimate, share
from vap_core.study.store import KEY
from vap_core.study.table import printed

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

MEASURES = (
    *("calls", "share", "chance", "lift", "lift_lookalikes"),
    *("on_target", "chance_hit", "on_rival", "on_background"),
    *("drift", "switches", "entropy"),
)
"""What `per_episode` measures."""
INTERVALS = ("lift", "lift_lookalikes", "on_target", "on_rival")
"""The measures of `where_queries_look` that get an interval, over layouts."""
RESAMPLES = 2000
STABLE, DRIFTING, CONFUSED, ELSEWHERE = "stable", "drifting", "confused", "elsewhere"
LOCALISATIONS = (STABLE, DRIFTING, CONFUSED, ELSEWHERE)
PATTERNS = {
    "stable but failed": (STABLE, False),
    "drifting": (DRIFTING, None),
    "confused": (CONFUSED, None),
    "successful": (STABLE, True),
}
"""The paper's patterns: the localisation, and the success where the pattern says it."""
ALL_SUITES = "all suites"
CALLS_BEFORE, LEAST_EPISODES = 8, 4
"""Calls before the first touch that are shown, and episodes behind a point."""


@dataclass(frozen=True)
class Thresholds:
    """When a localisation is called what; shares are of an episode's calls.

    `rival` is the share of peaks on a look-alike from which on it is confused; so is one whose
    attention to the look-alikes is as dense as that to the target and `dense` times that to the
    whole view. `stable` is the share of peaks on the target from which on it is stable. Of the
    rest, it drifts where the region of the peak changes in a share `switches` of successive calls;
    else it stays elsewhere.
    """

    rival: float = 1 / 3
    dense: float = 1.0
    stable: float = 2 / 3
    switches: float = 1 / 3


def over_views(calls: "pd.DataFrame") -> "pd.DataFrame":
    """One row per call and query: shares over all views, and the peak of the highest view."""
    import pandas as pd

    keys = [*KEY, "step", "query"]
    weighted = calls[[*keys, "mass"]].copy()
    for region in REGIONS:
        weighted[region] = calls["mass"] * calls[f"share_{region}"]
        weighted[f"chance_{region}"] = calls[f"chance_{region}"]
    weighted["spread"] = calls["mass"] * calls["entropy"]
    groups = weighted.groupby(keys, observed=True, sort=False)
    totals, views = groups.sum(), groups.size()
    merged = pd.DataFrame({"mass": totals["mass"]})
    for region in REGIONS:
        merged[f"share_{region}"] = totals[region] / totals["mass"]
        merged[f"chance_{region}"] = totals[f"chance_{region}"] / views
    merged["entropy"] = totals["spread"] / totals["mass"]
    by_view = calls.groupby(keys, observed=True, sort=False)
    peaks = calls.loc[by_view["peak"].idxmax()].set_index(keys)
    for name in ("camera", "side", "peak_row", "peak_column", "peak_region", "hit"):
        merged[name] = peaks[name]
    merged["chance_hit"] = by_view["chance_hit"].mean()
    return merged.reset_index()


def main_words(calls: "pd.DataFrame") -> "pd.DataFrame":
    """The calls' rows of the word that means the target; of the expert where no word is there."""
    order = {query: i for i, query in enumerate((*WORDS, ACTION))}
    rank = calls["query"].astype(str).map(order)
    first = rank.groupby([calls[name] for name in KEY], observed=True).transform("min")
    return calls[rank == first]


def per_episode(
    calls: "pd.DataFrame", episodes: "pd.DataFrame", *, whole: bool = False
) -> "pd.DataFrame":
    """One row per episode and query, over the calls before the first touch, or `whole` episodes.

    `lift` is the density of attention on the target, 1 where it is that of the whole view, and
    `lift_lookalikes` that on the look-alikes. `on_target` and `on_rival` are the shares of peaks
    there. `drift` is the mean way of the peak between successive calls, in sides of a view;
    `switches` is how often its region changes. Without such calls it has its columns and no row.
    """
    import pandas as pd

    nothing = episodes[KEY].head(0).assign(query=pd.Series(dtype=str))
    nothing = nothing.reindex(columns=[*KEY, "query", *MEASURES]).merge(episodes, on=KEY)
    if calls.empty:
        return nothing
    merged = over_views(calls).merge(episodes, on=KEY)
    before = merged if whole else merged[merged["step"] < merged["first_touch"].fillna(np.inf)]

    def density(of: "pd.DataFrame", region: str) -> float:
        area = of[f"chance_{region}"].sum()
        return float(of[f"share_{region}"].sum() / area) if area > 0 else 0.0

    def measures(group: "pd.DataFrame") -> dict[str, Any]:
        of = group.sort_values("step")
        where = of[["peak_row", "peak_column"]].to_numpy(float)
        regions, views = (of[name].astype(str).to_numpy() for name in ("peak_region", "camera"))
        same_view = views[1:] == views[:-1]
        way = np.hypot(*(where[1:] - where[:-1]).T)[same_view] / of["side"].iloc[0]
        return {
            "calls": len(of),
            "share": of[f"share_{TARGET}"].mean(),
            "chance": of[f"chance_{TARGET}"].mean(),
            "lift": density(of, TARGET),
            "lift_lookalikes": density(of, LOOKALIKES),
            "on_target": of["hit"].mean(),
            "chance_hit": of["chance_hit"].mean(),
            "on_rival": (regions == LOOKALIKES).mean(),
            "on_background": (regions == BACKGROUND).mean(),
            "drift": way.mean() if len(way) else 0.0,
            "switches": (regions[1:] != regions[:-1]).mean() if len(regions) > 1 else 0.0,
            "entropy": of["entropy"].mean(),
        }

    rows = _summary(before, [*KEY, "query"], measures)
    return rows.merge(episodes, on=KEY) if len(rows) else nothing


def _summary(
    table: "pd.DataFrame",
    keys: list[str],
    measures: "Callable[[pd.DataFrame], dict[str, Any]]",
    *,
    all_suites: bool = False,
) -> "pd.DataFrame":
    """A row of measures for every group of rows; `all_suites` adds those of several together."""
    import pandas as pd

    tables = [table]
    if all_suites and table["suite"].nunique() > 1:
        tables.append(table.assign(suite=ALL_SUITES))
    rows = []
    for each in tables:
        for key, group in each.groupby(keys, observed=True, sort=False):
            rows.append(dict(zip(keys, key, strict=True)) | measures(group))
    return pd.DataFrame(rows)


def localisation(row: "pd.Series", thresholds: Thresholds = Thresholds()) -> str:
    """The localisation of an episode; `row` is one of `per_episode`."""
    dense = row["lift_lookalikes"] >= max(row["lift"], thresholds.dense)
    if dense or row["on_rival"] >= thresholds.rival:
        return CONFUSED
    if row["on_target"] >= thresholds.stable:
        return STABLE
    return DRIFTING if row["switches"] >= thresholds.switches else ELSEWHERE


def with_localisation(table: "pd.DataFrame") -> "pd.DataFrame":
    """`per_episode`'s rows of the word that means the target, with `localisation`."""
    words = main_words(table)
    return words.assign(localisation=[localisation(row) for _, row in words.iterrows()])


def of_pattern(table: "pd.DataFrame", pattern: str) -> "pd.DataFrame":
    """The episodes of `with_localisation` that show one of PATTERNS."""
    wanted, success = PATTERNS[pattern]
    found = table[table["localisation"] == wanted]
    return found if success is None else found[found["success"] == success]


def example(table: "pd.DataFrame", pattern: str) -> "pd.Series | None":
    """The episode that shows a pattern most clearly, None where there is none.

    That is the most peaks on the target for the two stable ones, the most changes of region for
    the drifting one, the densest attention to look-alikes beside that to the target for the
    confused one. A failure comes first.
    """
    found = of_pattern(table, pattern)
    if found.empty:
        return None
    clarity = {
        "drifting": found["switches"],
        "confused": found["lift_lookalikes"] - found["lift"],
    }.get(pattern, found["on_target"])
    order = found.assign(clarity=clarity).sort_values(
        ["success", "clarity", "calls"],
        ascending=[pattern != "successful", False, False],
        kind="stable",
    )
    return order.iloc[0]


def text(tables: "dict[str, pd.DataFrame]") -> str:
    """Where every query looks, and the patterns.

    Where no call came before the first touch, it says so.
    """

    calls, episodes = tables["calls"], tables["episodes"]
    table = per_episode(calls, episodes)
    whole = per_episode(calls, episodes, whole=True)
    again = int(episodes["reproduced"].sum())
    parts = [f"{len(episodes)} episodes run again, {again} of them end as in the run"]
    if len(table):
        parts[0] += "; before the first touch:"
        parts.append(printed(where_text(where_queries_look(table))))
    if len(whole):
        parts.append("the word that means the target, over whole episodes:")
        parts.append(printed(pattern_counts(with_localisation(whole))))
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


def mean(
    values: Float[np.ndarray, " n"], layouts: Sequence[str], suites: Sequence[str]
) -> Estimate:
    """The mean over episodes; its 95 % interval resamples whole layouts, whose episodes are alike.

    Layouts are drawn within their suite, so that every resample has as many of each suite.
    """
    if not len(values):
        return NONE
    names, of_layout = np.unique(np.asarray(layouts, dtype=str), return_inverse=True)
    suite_of = np.empty(len(names), object)
    suite_of[of_layout] = np.asarray(suites, dtype=str)
    rng = np.random.default_rng(SEED)
    times = np.zeros((RESAMPLES, len(names)))
    for suite in sorted(set(suite_of)):
        members = np.flatnonzero(suite_of == suite)
        drawn = members[rng.integers(len(members), size=(RESAMPLES, len(members)))]
        np.add.at(times, (np.arange(RESAMPLES)[:, None], drawn), 1.0)
    weights = times[:, of_layout]
    means = weights @ values / weights.sum(axis=1)
    finite = means[~np.isnan(means)]
    low, high = np.quantile(finite, [0.025, 0.975]) if len(finite) else (np.nan, np.nan)
    return Estimate(float(values.mean()), float(low), float(high), len(values))


def where_queries_look(table: "pd.DataFrame") -> "pd.DataFrame":
    """Means over episodes, by suite (and ALL_SUITES), method and query of `per_episode`'s table.

    Measures of INTERVALS have their 95 % interval beside them, as NAME_low and NAME_high.
    """

    def measures(group: "pd.DataFrame") -> dict[str, Any]:
        row: dict[str, Any] = {"n": len(group)}
        for name in ("chance", "chance_hit", "drift", "entropy"):
            row[name] = group[name].mean()
        layouts, suites = list(group["layout"]), list(group["layout_suite"])
        for name in INTERVALS:
            found = mean(group[name].to_numpy(float), layouts, suites)
            row |= {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
        return row

    table = table.assign(layout_suite=table["suite"].astype(str))
    return in_order(_summary(table, ["suite", "method", "query"], measures, all_suites=True))


def where_text(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of `where_queries_look` with two digits, and intervals in brackets."""
    shown = table[["suite", "method", "query", "n"]].copy()
    for name in INTERVALS:
        cells = table[[name, f"{name}_low", f"{name}_high"]].to_numpy()
        shown[name] = [f"{value:.2f} [{low:.2f}, {high:.2f}]" for value, low, high in cells]
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
    merged = over_views(calls)
    merged = merged[merged[f"chance_{TARGET}"] > 0]
    order = merged.sort_values("step").groupby([*KEY, "query"], observed=True, sort=False)
    first = order.head(1).merge(episodes, on=KEY)
    density = first[f"share_{TARGET}"] / first[f"chance_{TARGET}"]
    rival = first[f"share_{LOOKALIKES}"] / first[f"chance_{LOOKALIKES}"].clip(lower=1e-9)
    first = first.assign(looks=density > rival, touches=first["touched"].astype(str) == TARGET)

    def shares(group: "pd.DataFrame") -> dict[str, Any]:
        return {
            "looks": share(group["looks"]),
            "then_touches": share(group.loc[group["looks"], "touches"]),
            "else_touches": share(group.loc[~group["looks"], "touches"]),
        }

    return in_order(_summary(first, ["suite", "method", "query"], shares, all_suites=True))


def pattern_counts(table: "pd.DataFrame") -> "pd.DataFrame":
    """Episodes of every localisation and their successes; `table` is `with_localisation`'s."""

    def counts(group: "pd.DataFrame") -> dict[str, Any]:
        row = {"n": len(group)}
        for name in LOCALISATIONS:
            found = group[group["localisation"] == name]
            row |= {name: len(found), f"{name}, success": int(found["success"].sum())}
        return row

    return in_order(_summary(table, ["suite", "method"], counts))


def layer_table(layers: "pd.DataFrame") -> "pd.DataFrame":
    """Density on the target and on the look-alikes by layer, mean over heads and episodes."""

    def densities(group: "pd.DataFrame") -> dict[str, Any]:
        seen = group[group["chance_target"] > 0]
        return {
            "n": len(seen[KEY].drop_duplicates()),
            "lift": seen["share_target"].sum() / seen["chance_target"].sum(),
            "lift_lookalikes": seen["share_lookalikes"].sum() / seen["chance_lookalikes"].sum(),
        }

    return in_order(_summary(layers, ["suite", "method", "query", "layer"], densities))


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


def where_figure(table: "pd.DataFrame", title: str = "") -> "Figure":
    """Density of attention on the target and on its look-alikes, a panel per suite.

    `table` is `where_queries_look`'s; 1 is what an even attention would have, intervals are over
    layouts.
    """
    import pandas as pd

    lines = in_order(table)
    lines = lines.assign(
        line=lines["method"] + " · " + lines["query"],
        suite=lines["suite"].astype(str) + ", n " + lines["n"].map(str),
    )
    marks = []
    for name, region in (("lift", "target"), ("lift_lookalikes", "look-alikes")):
        of_region = lines[["suite", "line"]].assign(value=lines[name], region=region)
        marks.append(of_region.assign(low=lines[f"{name}_low"], high=lines[f"{name}_high"]))
    shown = pd.concat(marks)
    label = "attention per area before the first touch, whole view = 1 [95 %]"
    most = 1.05 * float(shown["high"].max())
    return charts.dots(
        shown,
        "line",
        panel="suite",
        series="region",
        label=label,
        title=title,
        scale=1.0,
        limits=(0.0, most),
    )


def layers_figure(table: "pd.DataFrame") -> "Figure":
    """Density on the target by layer, a panel per suite and method; `table` is `layer_table`'s.

    Words of the last layer have no effect on the actions.
    """
    shown = table.assign(
        panel=table["suite"].astype(str) + ", " + table["method"].astype(str),
        layer=table["layer"] + 1,
        value=table["lift"],
    )
    label = "attention per area on the target"
    return charts.curves(
        shown,
        "layer",
        label_x="layer",
        panel="panel",
        series="query",
        label=label,
        scale=1.0,
        top=None,
    )


def patterns_figure(counts: "pd.DataFrame") -> "Figure":
    """Episodes of every localisation, successes and failures; `counts` is `pattern_counts`'."""
    import pandas as pd

    lines = []
    for line in counts.to_dict("records"):
        for name in LOCALISATIONS:
            won = line[f"{name}, success"]
            about = {"of": f"{line['suite']}, {line['method']}", "localisation": name}
            lines.append({**about, "n": line["n"], "success": won, "failure": line[name] - won})
    return charts.stacked(
        pd.DataFrame(lines),
        "localisation",
        ["success", "failure"],
        group="of",
        label="% of episodes (in the bars: how many)",
    )


def time_figure(calls: "pd.DataFrame", episodes: "pd.DataFrame") -> "Figure":
    """Share of peaks on the target by the number of calls left to the first touch of anything.

    Episodes that succeed and that fail apart, without those that touch nothing; `calls` are of one
    query a method.
    """
    import pandas as pd

    merged = over_views(calls).merge(episodes, on=KEY)
    touched = merged[merged["first_touch"].notna() & (merged["step"] < merged["first_touch"])]
    keys = [touched[name] for name in KEY]
    left = 1 - touched.groupby(keys, observed=True)["step"].rank(ascending=False)
    shown = touched.assign(left=left)[left >= -CALLS_BEFORE]
    shown["ends"] = shown["success"].map({True: "success", False: "failure"})
    groups = shown.groupby(["method", "ends", "left"], observed=True)["hit"]
    rates = groups.mean()[groups.size() >= LEAST_EPISODES].rename("value").reset_index()
    chance = shown.groupby("method", observed=True)["chance_hit"].mean()
    even = rates.drop_duplicates(["method", "left"])
    even = even.assign(ends="chance", value=even["method"].map(chance).astype(float))
    lines = pd.concat([rates, even.sort_values("left")])
    titles = {}
    for method, of in episodes.groupby("method", observed=True):
        touch = of["first_touch"].notna()
        told = [
            f"{(touch & which).sum()} of {which.sum()} {name}"
            for name, which in (("successes", of["success"]), ("failures", ~of["success"]))
        ]
        titles[method] = f"{method}: of episodes that touch something\n{', '.join(told)}"
    lines["method"] = lines["method"].map(titles)
    return charts.curves(
        lines,
        "left",
        label_x="calls before the first touch",
        panel="method",
        series="ends",
        label="peak on the target, %",
        dashed=["chance"],
    )
