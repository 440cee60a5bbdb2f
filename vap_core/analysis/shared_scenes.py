"""What is measured in shared scenes: two objects in turn, two at once, and how parsers do.

episodes = shared_episodes(Path("data/results/shared.parquet"))
sequence_table(episodes)
pair_table(episodes)
shared_figure(episodes)
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import BadOutput
from vap_core.base.pictures import FRAME, GRID, METHODS, TEXT, empty_figure
from vap_core.policies.protocol import MINI, TEMPERATURE, checkpoint_of, shipped_checkpoint
from vap_core.simulation import suites
from vap_core.simulation.suites import shared
from vap_core.simulation.suites.benchmarks import FILMED_AREA
from vap_core.study import paper
from vap_core.study.parsers import KINDS
from vap_core.study.results import read_runs
from vap_core.study.stats import Rate, bootstrap_interval, rate

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALL = "all"
SEQUENCES = ("shared-sequence-bridge", "shared-sequence")
PAIR = "shared-pair"
PAPER_PAIRS = {
    "put-pouch-near-vase": "put my pouch near my vase",
    "move-plant-next-to-cup": "move my plushie next to my cup",
    "put-scrubber-near-slipper": "put my scrubber near my slipper",
    "move-stuffed-toy-next-to-plant": "move my stuffed toy next to my plant",
    "put-pouch-near-cup": "put my pouch near my cup",
}
"""The paper's instruction for each of our pairs; its plushie is our plant."""
GROUP = ["suite", "policy", "method"]
SUITE_ORDER = (*SEQUENCES, PAIR)
TAUGHT = f"{MINI}, taught pairs"
"""Short for tabletop's policy after `train policy --suite shared-pair`."""
POLICY_ORDER = (MINI, TAUGHT, "scripted", "expert")


def shared_episodes(path: Path) -> "pd.DataFrame":
    """Every episode of a published table in the lists' order.

    A policy of POLICY_ORDER has its short name. Others come after them, under their labels.

    Raises: BadOutput, also for a table with episodes of other suites.
    """
    import pandas as pd

    episodes = pd.concat([episodes for _, episodes in read_runs(path)], ignore_index=True)
    others = sorted(set(episodes["suite"]) - set(SUITE_ORDER))
    if others:
        raise BadOutput(
            f"shared_episodes: {path} holds episodes of {', '.join(others)}; publish those of "
            f"shared scenes alone: --suite {' --suite '.join(SUITE_ORDER)}."
        )
    episodes = episodes.assign(policy=episodes["policy"].map(_policy_name))
    own = sorted(set(episodes["policy"]) - set(POLICY_ORDER))
    order = pd.DataFrame(
        {
            "suite": episodes["suite"].map(SUITE_ORDER.index),
            "policy": episodes["policy"].map([*POLICY_ORDER, *own].index),
            "method": episodes["method"],
            "task": episodes["task"].map(_task_order()),
            "episode": episodes["episode"],
        }
    )
    return episodes.loc[order.sort_values(list(order.columns)).index].reset_index(drop=True)


def sequence_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Two steps in turn: a line per suite, policy, method and task, and one for all tasks.

    `both` is the share in which both steps succeeded, `step 1` that of the first, `step 2 after 1`
    that of the second where the first had succeeded. `first touch right` says that the first thing
    touched in step 1 was its target. `wrong object` counts every episode in which another object
    was moved or selected; the failures divide into those with a wrong object and `other failures`
    (P tab:multiuser_seq).
    """
    import pandas as pd

    lines = []
    for keys, group in _groups(episodes[episodes["suite"].isin(SEQUENCES)]):
        first = group["subgoal_1"].astype(bool)
        wrong = group["wrong_object"].astype(bool)
        success = group["success"].astype(bool)
        rates = {
            "n": len(group),
            "both": _share(success),
            "step 1": _share(first),
            "step 2 after 1": _share(success[first]),
            "first touch right": _first_touch(group),
            "wrong object": _share(wrong),
            "failed, wrong object": _share(~success & wrong),
            "other failures": _share(~success & ~wrong),
        }
        lines.append({**keys, **rates})
    return pd.DataFrame(lines)


def area_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """VAP's first steps on the WidowX, by whether the target stands where films showed objects.

    The list's grid has a column on either side beyond that area (simpler.FILMED_AREA).

    Raises: BadSuite for a damaged list.
    """
    import pandas as pd

    name = SEQUENCES[0]
    area = FILMED_AREA
    filmed = {}
    for row in suites.benchmark(name):
        target = row.placements[0]
        inside = area.x0 <= target.x <= area.x1 and area.y0 <= target.y <= area.y1
        filmed[row.task, row.episode] = "inside" if inside else "outside"
    chosen = episodes[(episodes["suite"] == name) & (episodes["method"] == "vap")]
    places = [filmed[key] for key in zip(chosen["task"], chosen["episode"], strict=True)]
    lines = []
    for (policy, place), group in chosen.assign(place=places).groupby(["policy", "place"]):
        line = {"policy": policy, "the films' area": place, "n": len(group)}
        lines.append({**line, "step 1": _share(group["subgoal_1"])})
    return pd.DataFrame(lines)


def pair_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Two targets at once: a line per policy, method and task, the paper's SR in % beside.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    lines = []
    for keys, group in _groups(episodes[episodes["suite"] == PAIR]):
        rates = {
            "n": len(group),
            "SR": _share(group["success"]),
            "target moved": _share(group["cmr"]),
            "first touch right": _first_touch(group),
            "wrong object": _share(group["wrong_object"]),
        }
        lines.append({**keys, **rates, "paper": paper_pair(str(keys["task"]))})
    return pd.DataFrame(lines)


def paper_pair(task: str) -> float:
    """The paper's SR in % on one of the pairs, or their mean (P tab:multi_object).

    Raises: BadOutput, as `paper.ledger`.
    """
    published = paper.ledger()
    rates = published[published["table"] == "multi_object"].set_index("row")["value"]
    return float(rates.mean() if task == ALL else rates[PAPER_PAIRS[task]])


def paper_sequence() -> dict[str, float]:
    """The paper's shares in %: both steps, a wrong object, other failures (P tab:multiuser_seq).

    Raises: BadOutput, as `paper.ledger`.
    """
    published = paper.ledger()
    shares = published[published["table"] == "multiuser_seq"].set_index("metric")["value"]
    return {
        "both": float(shares["2-step SR"]),
        "failed, wrong object": float(shares["wrong object"]),
        "other failures": float(shares["others"]),
    }


def paper_parser() -> "pd.DataFrame":
    """The paper's parser, %: a line per task (P tab:llm_parser).

    Raises: BadOutput, as `paper.ledger`.
    """
    published = paper.ledger()
    rates = published[published["table"] == "llm_parser"]
    named = rates.assign(what=rates["column"] + ", " + rates["metric"])
    return named.pivot_table(index="row", columns="what", values="value", sort=False)


def parser_table(answers: "pd.DataFrame", part: str = "test") -> "pd.DataFrame":
    """How often each parser is right: a line per parser and kind of instruction.

    `low` and `high` are the 95 % interval with whole template families resampled; `right` has
    Wilson's.
    """
    import pandas as pd

    lines = []
    of_part = answers[answers["part"] == part]
    for parser, group in of_part.groupby("parser", sort=False):
        for kind in (*KINDS, ALL):
            of_kind = group if kind == ALL else group[group["kind"] == kind]
            families = of_kind.groupby("family")["right"].agg(["sum", "count"])
            gain = families["sum"].to_numpy(float)
            low, high = bootstrap_interval(gain, families["count"].to_numpy(float), least=0.0)
            silent = of_kind["found"] == ""
            wrong = ~silent & ~of_kind["right"].astype(bool)
            line = {
                "parser": parser,
                "kind": kind,
                "families": len(families),
                "n": len(of_kind),
                "right": _share(of_kind["right"]),
                "low": float(np.clip(low, 0, 1)),
                "high": float(np.clip(high, 0, 1)),
                "abstains": _share(silent),
                "wrong object": _share(wrong),
            }
            lines.append(line)
    return pd.DataFrame(lines)


def parser_figure(table: "pd.DataFrame", title: str = "") -> "Figure":
    """Accuracy of every parser by kind, 95 % over families.

    The paper's range of tasks, of implicit instructions, is shaded in the row of that kind.

    Raises: BadOutput, as `paper.ledger`.
    """
    figure = empty_figure(6.4, 3.2)
    axes = figure.subplots()
    theirs = paper_parser()["implicit, parsing accuracy"]
    kinds = list(dict.fromkeys(table["kind"]))
    axes.barh(
        kinds.index("implicit"),
        theirs.max() - theirs.min(),
        height=0.9,
        left=theirs.min(),
        color=FRAME,
        alpha=0.45,
        label="the paper's GPT-4o-mini, implicit, by task",
    )
    looks = {"rule": (FRAME, "o", 0.14), "embedding": (METHODS["vap"][0], "s", -0.14)}
    for parser, (colour, marker, shift) in looks.items():
        for line in table[table["parser"] == parser].to_dict("records"):
            y = kinds.index(line["kind"]) + shift
            middle, low, high = (100 * x for x in (line["right"].value, line["low"], line["high"]))
            label = parser if line["kind"] == kinds[0] else None
            axes.plot([low, high], [y, y], color=colour, linewidth=1.4)
            axes.plot(middle, y, marker, color=colour, label=label)
    counts = {line.kind: line.n for line in table.itertuples()}
    axes.set_yticks(range(len(kinds)), [f"{kind}, n {counts[kind]}" for kind in kinds])
    axes.set(xlim=(-3, 103), ylim=(len(kinds) - 0.5, -0.5))
    axes.set_xlabel(
        "% of held-out sentences that are understood, 95 % interval over families", fontsize=9
    )
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    _finish(axes, figure, title)
    return figure


def shared_figure(episodes: "pd.DataFrame", title: str = "") -> "Figure":
    """Success in all tasks of each suite, and of the first step alone; diamonds: the paper's.

    Raises: BadOutput, as `paper.ledger`.
    """
    names = [name for name in SUITE_ORDER if name in set(episodes["suite"])]
    tables = {}
    for name in names:
        of_suite = episodes[episodes["suite"] == name]
        if name == PAIR:
            table = pair_table(of_suite).rename(columns={"SR": "both"})
        else:
            table = sequence_table(of_suite)
        tables[name] = table[table["task"] == ALL]
    n_lines = max(len(table) for table in tables.values())
    figure = empty_figure(3.3 * len(names), 0.34 * n_lines + 1.5)
    for axes, (name, table) in zip(
        figure.subplots(1, len(names), squeeze=False)[0], tables.items(), strict=True
    ):
        _draw_suite(axes, name, table.to_dict("records"))
    figure.supxlabel("% of episodes, 95 % interval; diamonds: the paper, a real arm", fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold")
    return figure


def _draw_suite(axes: "Axes", name: str, lines: list[dict[str, Any]]) -> None:
    """One suite's policies and methods, a line each."""
    theirs = paper_pair(ALL) if name == PAIR else paper_sequence()["both"]
    labels = []
    for y, line in enumerate(lines):
        colour, marker = METHODS.get(line["method"], (TEXT, "o"))
        if line["policy"] == "expert":
            colour = TEXT
        first = line.get("step 1")
        if isinstance(first, Rate):
            axes.plot(100 * first.value, y, marker, color=colour, fillstyle="none", alpha=0.8)
        both = line["both"]
        axes.plot([100 * both.low, 100 * both.high], [y, y], color=colour, linewidth=1.6)
        axes.plot(100 * both.value, y, marker, color=colour)
        if line["method"] == "vap":
            axes.plot(theirs, y, "D", color=TEXT, fillstyle="none", markersize=5)
        is_bound = line["policy"] == "expert"
        labels.append("expert (bound)" if is_bound else f"{line['policy']}, {line['method']}")
    axes.set_yticks(range(len(lines)), labels, fontsize=8)
    asked = "SR" if name == PAIR else "both steps; hollow: step 1"
    axes.set_title(f"{name}\nn = {lines[0]['n']} a line, {asked}", fontsize=9)
    axes.set(xlim=(-3, 104), ylim=(len(lines) - 0.5, -0.5))
    _finish(axes)


def _finish(axes: "Axes", figure: "Figure | None" = None, title: str = "") -> None:
    axes.grid(axis="x", color=GRID)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)
    if figure is not None and title:
        figure.suptitle(title, fontsize=11, fontweight="bold")


def _groups(episodes: "pd.DataFrame") -> "Iterator[tuple[dict[str, str], pd.DataFrame]]":
    """Every suite, policy, method and task, then all tasks of them."""
    for (suite, policy, method), group in episodes.groupby(GROUP, sort=False):
        keys = {"suite": str(suite), "policy": str(policy), "method": str(method)}
        for task, of_task in group.groupby("task", sort=False):
            yield {**keys, "task": str(task)}, of_task
        yield {**keys, "task": ALL}, group


def _first_touch(group: "pd.DataFrame") -> Rate:
    """How often the first object that the hand touches is the (first) target."""
    return _share(group["first_object_correct"].dropna())


def _share(chosen: "pd.Series") -> Rate:
    return rate(int(chosen.astype(bool).sum()), len(chosen))


def _task_order() -> dict[str, int]:
    """The place of every task in its suite."""
    order: dict[str, int] = {}
    for tasks in shared.TASKS.values():
        order |= {task.name: i for i, task in enumerate(tasks)}
    return order


def _policy_name(policy: str) -> str:
    """The short name of a policy that was published here; any other's label."""
    if TEMPERATURE in policy:
        return policy
    names = {shipped_checkpoint(benchmark).name: MINI for benchmark in suites.BENCHMARKS}
    names[f"{MINI}-{PAIR}"] = TAUGHT
    return names.get(checkpoint_of(policy), policy)
