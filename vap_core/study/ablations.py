"""Runs an ablation, one run an arm: its table and its picture (P appendix).

arms = ablation_table(published_episodes(Path("data/results/ablations.parquet")))
effects_figure(arms)
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput
from vap_core.base.files import signed, writing
from vap_core.base.pictures import write_png
from vap_core.study import charts, paper, store
from vap_core.study.engine import Record, run
from vap_core.study.logs import hiding_lines, switching_lines
from vap_core.study.methods import ABLATIONS, Ablation
from vap_core.study.results import read_runs
from vap_core.study.stats import (
    compare,
    holm,
    points_text,
    rate,
    rate_over_layouts,
    tidy,
    with_layouts,
)
from vap_core.study.table import percent, printed
from vap_core.study.trials import Study

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PAPER_SUITES = {"simpler-fractal": "Google Robot", "simpler-bridge": "WidowX"}
"""The columns of the paper's ablation tables for our suites."""
LEVEL = 0.05
"""The exact p, corrected over the arms of a suite, below which a difference counts as shown.

A bootstrap interval alone does not say so where few episodes come out otherwise: with five of 96,
all the same way, it leaves out 0, and the exact p is .06.
"""
AGAINST = ("difference", "low", "high", "p", "p_holm")
COLUMNS = ["suite", "arm", "n", "sr", "cmr", "case 1", "case 2", *AGAINST, "shown", "paper"]
"""The columns of an arm: its rates, and its difference from the first arm of its suite."""


def arm_table(ablation: Ablation, episodes: "pd.DataFrame") -> "pd.DataFrame":
    """The arms of every suite in `episodes` (rows of a results table) that ran the first arm and
    another, over all episodes of a suite; errors count as no success.

    `sr`, `cmr`, `case 1` and `case 2` are `Estimate`s; `difference` compares an arm with the
    ablation's first one on the same episodes, nan for that one. `p_holm` is corrected over the arms
    of a suite (those that were retired count as p = 1), and `shown` where it is below LEVEL.
    `paper` is the paper's SR, `paper_difference` its difference, nan where it has none.

    Raises: BadOutput when they are of several policies in a suite, when an arm shares no episode
        with the first, and as `paper.ledger`; BadSuite, as `compare`.
    """
    import pandas as pd

    lines: list[dict[str, Any]] = []
    for suite in dict.fromkeys(episodes["suite"]):
        of_suite = with_layouts(episodes[episodes["suite"] == suite].assign(split=""))
        arms = [arm for arm in ablation.names if of_suite["method"].eq(arm).any()]
        if ablation.names[0] not in arms or len(arms) < 2:
            continue
        policies = sorted(map(str, of_suite[of_suite["method"].isin(arms)]["policy"].unique()))
        if len(policies) > 1:
            raise BadOutput(
                f"arm_table: the arms on {suite} are of {len(policies)} policies "
                f"({', '.join(policies)}); name one: keep its rows alone."
            )
        against = _against_first(arms, of_suite, ablation.retired)
        for arm in arms:
            rows = of_suite[of_suite["method"] == arm]
            rates = {
                name: rate_over_layouts(rows[rows[column].notna()], column)
                for name, column in (("sr", "success"), ("cmr", "cmr"))
            }
            for case in ("case 1", "case 2"):
                rates[case] = rate(int(rows["case"].eq(case).sum()), len(rows))
            line = {"suite": suite, "arm": arm, "n": len(rows), **rates, **against.get(arm, {})}
            lines.append({**line, "paper": _paper_sr(ablation, suite, arm)})
    table = pd.DataFrame(lines, columns=COLUMNS)
    table["shown"] = table["p_holm"] < LEVEL
    firsts = table.groupby("suite", sort=False)["paper"].transform("first")
    return table.assign(paper_difference=(table["paper"] - firsts).where(table["p"].notna()))


def _against_first(
    arms: Sequence[str], of_suite: "pd.DataFrame", retired: int
) -> dict[str, dict[str, float]]:
    """Each arm against the first, over all tasks of the suite; `retired` arms count as p = 1.

    Raises: BadOutput for one that shares no episode with the first.
    """
    first, *others = arms
    found = {}
    for arm in others:
        part = of_suite[of_suite["method"].isin([first, arm])]
        compared = compare(part, [first, arm], by_task=False)
        if compared.empty:
            suite = part["suite"].iloc[0]
            raise BadOutput(
                f"arm_table: {arm} shares no episode with {first} on {suite}, so they cannot "
                f"be compared; run it on {first}'s episodes (the same seeds), or leave its rows "
                "out."
            )
        found[arm] = compared.iloc[0][list(AGAINST)].to_dict()
    corrected = holm([*(each["p"] for each in found.values()), *[1.0] * retired])
    for each, p in zip(found.values(), corrected, strict=False):
        each["p_holm"] = p
    return found


def _paper_sr(ablation: Ablation, suite: str, arm: str) -> float:
    if arm not in ablation.rows or suite not in PAPER_SUITES:
        return float("nan")
    facts = paper.ledger()
    named = {"table": ablation.paper, "row": ablation.rows[arm], "column": PAPER_SUITES[suite]}
    for column, name in (named | {"metric": "SR"}).items():
        facts = facts[facts[column].eq(name)]
    return float(facts["value"].iloc[0]) / 100 if len(facts) else float("nan")


def published_episodes(path: Path) -> "pd.DataFrame":
    """Every episode of a published table. Raises: BadOutput."""
    import pandas as pd

    return pd.concat([episodes for _, episodes in read_runs(path)], ignore_index=True)


def ablation_table(episodes: "pd.DataFrame", *suites: str) -> "pd.DataFrame":
    """The arms of every `ablation` that has been run, each against the first of its ablation.

    Of these suites, or of those that an ablation runs on where none is named.

    Raises: as `arm_table`.
    """
    import pandas as pd

    tables = [pd.DataFrame(columns=["ablation", *COLUMNS, "paper_difference"])]
    for name, ablation in ABLATIONS.items():
        wanted = episodes["suite"].isin(suites or ablation.suites)
        arms = arm_table(ablation, episodes[wanted])
        if len(arms):
            arms.insert(0, "ablation", name)
            tables.append(arms)
    return pd.concat(tables[1:] or tables, ignore_index=True)


def shown_table(arms: "pd.DataFrame") -> "pd.DataFrame":
    """Arms to print; rates and differences in percent."""
    table = arms[["suite", "arm", "n"]].copy()
    table["SR % [95 %]"], table["CMR % [95 %]"] = arms["sr"].map(str), arms["cmr"].map(str)
    for case in ("case 1", "case 2"):
        table[case] = [each.k for each in arms[case]]
    points = [points_text(line, 1) if line.p == line.p else "-" for line in arms.itertuples()]
    table["against the first, points [95 %]"] = points
    table["p Holm"] = [f"{p:.3g}" if p == p else "-" for p in arms["p_holm"]]
    return table.assign(**{"paper's SR %": arms["paper"].map(percent)})


def effects_figure(arms: "pd.DataFrame", title: str = "", columns: int = 1) -> "Figure":
    """Points of success of every arm against the first arm of its suite, filled where a difference
    is shown; the paper's difference, where it has both arms, is a diamond.

    With the column `ablation` a heading for each; the headings are spread over `columns`. A column
    `series` tells the marks of one line apart.
    """
    names = [name for name in ("ablation", "suite") if name in arms and arms[name].nunique() > 1]
    headings = {}
    firsts = arms[arms["p"].isna()]
    for line in firsts.drop_duplicates(names or ["suite"]).to_dict("records"):
        key = tuple(line[name] for name in names)
        about = f"against {line['arm']}, {100 * line['sr'].value:.0f} % of {line['n']}"
        headings[key] = f"{' on '.join(map(str, key))}: {about}" if key else about
    shown = arms[arms["p"].notna()]
    keys = list(zip(*(shown[name] for name in names), strict=True)) if names else [()] * len(shown)
    lines = shown[["arm"]].assign(
        heading=list(map(headings.get, keys)),
        value=shown["difference"],
        low=shown["low"],
        high=shown["high"],
        filled=shown["shown"],
        paper=shown["paper_difference"],
        series=shown.get("series", ""),
    )
    order = list(dict.fromkeys(lines["heading"]))
    done = lines.groupby("heading", sort=False).size().add(1).cumsum().shift(fill_value=0)
    lines["panel"] = (
        lines["heading"]
        .map(done * columns // (len(lines) + len(order)))
        .map(lambda part: " " * (int(part) + 1))
    )
    label = f"points of success [95 %]; filled: exact p < {LEVEL:g}, Holm"
    series = "series" if lines["series"].nunique() > 1 else ""
    return charts.dots(
        lines,
        "arm",
        label=label,
        limits=(-103.0, 48.0),
        group="heading",
        panel="panel",
        series=series,
        title=title,
    )


def rates_figure(arms: "pd.DataFrame") -> "Figure":
    """The success rate of every arm, a panel per suite; the paper's are diamonds."""
    rates = tidy(arms[["suite", "arm", "sr", "paper"]], ["sr"])
    return charts.dots(rates, "arm", panel="suite", label="success rate, % (95 % interval)")


def sweep_figure(arms: "pd.DataFrame", places: dict[str, float], label: str) -> "Figure":
    """Success rates along a quantity, of which `places` has every arm's, a panel per suite."""
    rates = tidy(arms[arms["arm"].isin(places)][["suite", "arm", "sr", "paper"]], ["sr"])
    rates = rates.assign(x=rates["arm"].map(places)).sort_values("x", kind="stable")
    names = rates["suite"] + ", n " + rates["n"].astype(str)
    return charts.curves(
        rates.assign(panel=names), "x", panel="panel", label="success rate, % (95 %)", label_x=label
    )


def effect_text(arms: "pd.DataFrame", arm: str, suite: str = "") -> str:
    """Points of success of an arm against the first, with its interval; of the first its rate.

    `suite` says which, where there are several.
    """
    found = arms[arms["arm"] == arm]
    (one,) = (found[found["suite"] == suite] if suite else found).itertuples()
    return points_text(one) if one.p == one.p else f"{100 * one.sr.value:.0f} % of {one.n}"


NO_POINT = 0.005
"""Differences of success below it round to no point."""


def findings_table(arms: "pd.DataFrame") -> "pd.DataFrame":
    """Whether the paper's ablations hold here: every arm that it has, in points of success."""
    both = arms[arms["paper_difference"].notna()]
    return both[["ablation", "arm", "n"]].assign(
        **{
            "here, points [95 %]": list(map(points_text, both.itertuples())),
            "paper": [signed(100 * each) for each in both["paper_difference"]],
            "the paper's finding": list(map(verdict, both.itertuples())),
        }
    )


def verdict(found: Any) -> str:
    """What a difference that was found says about the paper's.

    The paper's own error is not known, and not counted; its difference that rounds to no point is
    none.
    """
    theirs = found.paper_difference
    if abs(theirs) < NO_POINT:
        return "there is none, here is one" if found.shown else "none is shown in either"
    if not found.shown:
        beyond = theirs < found.low if theirs < 0 else theirs > found.high
        return "not here: as much is excluded" if beyond else "cannot tell"
    if found.low <= theirs <= found.high:
        return "holds"
    if theirs * found.difference < 0:
        return "the other way round"
    return "holds, weaker" if abs(theirs) > abs(found.difference) else "holds, stronger"


def ablate_text(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> str:
    """Run what `root` lacks, draw `NAME.png` there, and return the table.

    Raises: what `engine.run` and `arm_table` raise.
    """
    ablation = ABLATIONS[name]
    episodes = run_arms(name, study, root, workers=workers, record=record)
    picture = root / f"{name}.png"
    arms = arm_table(ablation, episodes)
    with writing(picture, "ablate"):
        write_png(effects_figure(arms, ablation.question), picture, dpi=200)
    errors = int(episodes["outcome"].eq("error").sum())
    first = arm_folder(study, root, ablation.names[0])
    lines = [
        ablation.question,
        printed(shown_table(arms)),
        *switching_lines(episodes),
        *hiding_lines(episodes),
        f"n episodes a suite, {study.seeds} seed(s) from {study.seed}; policy {study.policy}; "
        f"{errors} errors. Intervals of rates: over layouts where they return, else Wilson's; of "
        "differences: cluster bootstrap over layouts. p exact, Holm's correction over the arms of "
        "a suite.",
        f"picture: {picture}",
        f"every arm is a run of its own: {study.next_command('diagnose', first)}",
    ]
    return "\n".join(lines)


def run_arms(
    name: str, study: Study, root: Path, *, workers: int = 2, record: Record = "none"
) -> "pd.DataFrame":
    """The episodes of every arm of an ablation; those that `root` lacks are run.

    Each arm is a run in a folder of its own, so that ablations share the arms that they have in
    common.

    Raises: what `engine.run` raises.
    """
    import pandas as pd

    tables = []
    for arm in ABLATIONS[name].names:
        folder = arm_folder(study, root, arm)
        tables.append(run(replace(study, methods=(arm,)), folder, workers=workers, record=record))
    columns = dict.fromkeys(chain.from_iterable(tables))
    kept = [table.dropna(axis="columns", how="all") for table in tables]
    return pd.concat(kept, ignore_index=True).reindex(columns=list(columns))


def arm_folder(study: Study, root: Path, arm: str) -> Path:
    """The run of one arm: its name, and the digest of everything that its results depend on."""
    digest = store.digest(replace(study, methods=(arm,)).configuration())
    return root / f"{arm}-{digest[:8]}"
