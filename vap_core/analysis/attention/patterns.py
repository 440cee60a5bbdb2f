"""From calls to episodes: what the attention of the word that means the target did, in one line.

The paper shows four patterns of a learned token (P appendix, attention analysis): localisation that
is stable while the episode fails, that drifts, that is confused by look-alikes, and that succeeds.
Here they are defined by thresholds, over all calls of an episode. What is to tell of the outcome in
advance is measured over the calls before the first touch of anything.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vap_core.analysis.attention.measures import BACKGROUND, LOOKALIKES, REGIONS, TARGET
from vap_core.policies.protocol import ACTION
from vap_core.rollout.calls import CATEGORY, COLOUR, TOKEN
from vap_core.study.store import KEY

if TYPE_CHECKING:
    import pandas as pd

WORDS = (TOKEN, COLOUR, CATEGORY)
"""The queries that are words, in the order in which one of them means the target."""
MEASURES = (
    *("calls", "share", "chance", "lift", "lift_lookalikes"),
    *("on_target", "chance_hit", "on_rival", "on_background"),
    *("drift", "switches", "entropy"),
)
"""What `per_episode` measures."""
STABLE = "stable"
DRIFTING = "drifting"
CONFUSED = "confused"
ELSEWHERE = "elsewhere"
LOCALISATIONS = (STABLE, DRIFTING, CONFUSED, ELSEWHERE)
PATTERNS = {
    "stable but failed": (STABLE, False),
    "drifting": (DRIFTING, None),
    "confused": (CONFUSED, None),
    "successful": (STABLE, True),
}
"""The paper's patterns: the localisation, and the success where the pattern says it."""


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


THRESHOLDS = Thresholds()


def over_views(calls: "pd.DataFrame") -> "pd.DataFrame":
    """One row per call and query: shares over all views, and the peak of the highest view."""
    import pandas as pd

    keys = [*KEY, "step", "query"]
    weighted = calls[keys].copy()
    weighted["mass"] = calls["mass"]
    for region in REGIONS:
        weighted[region] = calls["mass"] * calls[f"share_{region}"]
        weighted[f"chance_{region}"] = calls[f"chance_{region}"]
    weighted["spread"] = calls["mass"] * calls["entropy"]
    groups = weighted.groupby(keys, observed=True, sort=False)
    totals = groups.sum()
    views = groups.size()
    merged = pd.DataFrame({"mass": totals["mass"]})
    for region in REGIONS:
        merged[f"share_{region}"] = totals[region] / totals["mass"]
        merged[f"chance_{region}"] = totals[f"chance_{region}"] / views
    merged["entropy"] = totals["spread"] / totals["mass"]
    highest = calls.loc[calls.groupby(keys, observed=True, sort=False)["peak"].idxmax()]
    peaks = highest.set_index(keys)
    for name in ("camera", "side", "peak_row", "peak_column", "peak_region", "hit"):
        merged[name] = peaks[name]
    merged["chance_hit"] = calls.groupby(keys, observed=True, sort=False)["chance_hit"].mean()
    return merged.reset_index()


def main_words(calls: "pd.DataFrame") -> "pd.DataFrame":
    """The calls' rows of the word that means the target; of the expert where no word is there."""
    order = {query: i for i, query in enumerate((*WORDS, ACTION))}
    rank = calls["query"].astype(str).map(order)
    first = rank.groupby([calls[name] for name in KEY], observed=True).transform("min")
    return calls[rank == first]


def first_calls(calls: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of every episode's first call, before which nothing has moved."""
    first = calls.groupby([calls[name] for name in KEY], observed=True)["step"].transform("min")
    return calls[calls["step"] == first]


def per_episode(
    calls: "pd.DataFrame", episodes: "pd.DataFrame", *, whole: bool = False
) -> "pd.DataFrame":
    """One row per episode and query, over the calls before the first touch, or `whole` episodes.

    `lift` is the density of attention on the target, 1 where it is that of the whole view, and
    `lift_lookalikes` that on the look-alikes. `on_target` and `on_rival` are the shares of peaks
    there. `drift` is the mean way of the peak between successive calls, in sides of a view;
    `switches` is how often its region changes. Without such calls it has its columns and no row.
    """
    import numpy as np
    import pandas as pd

    nothing = episodes[KEY].head(0).assign(query=pd.Series(dtype=str))
    nothing = nothing.reindex(columns=[*KEY, "query", *MEASURES]).merge(episodes, on=KEY)
    if calls.empty:
        return nothing
    merged = over_views(calls).merge(episodes, on=KEY)
    touch = merged["first_touch"].fillna(np.inf)
    before = merged if whole else merged[merged["step"] < touch]
    rows = []
    for key, group in before.groupby([*KEY, "query"], observed=True, sort=False):
        ordered = group.sort_values("step")
        where = ordered[["peak_row", "peak_column"]].to_numpy(float)
        regions = ordered["peak_region"].astype(str).to_numpy()
        views = ordered["camera"].astype(str).to_numpy()
        same_view = views[1:] == views[:-1]
        way = np.hypot(*(where[1:] - where[:-1]).T)[same_view] / ordered["side"].iloc[0]
        rows.append(
            {
                **dict(zip([*KEY, "query"], key, strict=True)),
                "calls": len(ordered),
                "share": ordered[f"share_{TARGET}"].mean(),
                "chance": ordered[f"chance_{TARGET}"].mean(),
                "lift": _density(ordered, TARGET),
                "lift_lookalikes": _density(ordered, LOOKALIKES),
                "on_target": ordered["hit"].mean(),
                "chance_hit": ordered["chance_hit"].mean(),
                "on_rival": (regions == LOOKALIKES).mean(),
                "on_background": (regions == BACKGROUND).mean(),
                "drift": way.mean() if len(way) else 0.0,
                "switches": (regions[1:] != regions[:-1]).mean() if len(regions) > 1 else 0.0,
                "entropy": ordered["entropy"].mean(),
            }
        )
    return pd.DataFrame(rows).merge(episodes, on=KEY) if rows else nothing


def localisation(row: "pd.Series", thresholds: Thresholds = THRESHOLDS) -> str:
    """The localisation of an episode; `row` is one of `per_episode`."""
    dense = row["lift_lookalikes"] >= max(row["lift"], thresholds.dense)
    if dense or row["on_rival"] >= thresholds.rival:
        return CONFUSED
    if row["on_target"] >= thresholds.stable:
        return STABLE
    return DRIFTING if row["switches"] >= thresholds.switches else ELSEWHERE


def with_localisation(table: "pd.DataFrame", thresholds: Thresholds = THRESHOLDS) -> "pd.DataFrame":
    """`per_episode`'s rows of the word that means the target, with `localisation`."""
    words = main_words(table)
    return words.assign(localisation=[localisation(row, thresholds) for _, row in words.iterrows()])


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
        "stable but failed": found["on_target"],
        "drifting": found["switches"],
        "confused": found["lift_lookalikes"] - found["lift"],
        "successful": found["on_target"],
    }[pattern]
    longest = found.assign(clarity=clarity).sort_values(
        ["success", "clarity", "calls"],
        ascending=[pattern != "successful", False, False],
        kind="stable",
    )
    return longest.iloc[0]


def _density(calls: "pd.DataFrame", region: str) -> float:
    """Attention inside a region by the area of it; 0 where it is not in view."""
    area = calls[f"chance_{region}"].sum()
    return float(calls[f"share_{region}"].sum() / area) if area > 0 else 0.0
