"""What is measured in shared scenes: two objects in turn, two at once, beside the paper's.

episodes = shared_episodes(Path("data/results/shared.parquet"))
sequence_table(episodes)
"""

from pathlib import Path
from typing import TYPE_CHECKING

from vap_core.base.errors import BadOutput
from vap_core.policies.names import MINI, TEMPERATURE, checkpoint_of, shipped_checkpoint
from vap_core.simulation import suites
from vap_core.simulation.suites import shared
from vap_core.simulation.suites.benchmarks import FILMED_AREA
from vap_core.study import charts, paper
from vap_core.study.results import read_runs
from vap_core.study.stats import summary, tidy

if TYPE_CHECKING:
    import pandas as pd
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
BY = ["suite", "policy", "method", "task"]
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
            f"shared_episodes: {path} holds episodes of {', '.join(others)}; publish the runs of "
            "shared scenes alone."
        )
    episodes = episodes.assign(policy=episodes["policy"].map(_policy_name))
    tasks = {task.name: i for named in shared.TASKS.values() for i, task in enumerate(named)}
    policies = [*POLICY_ORDER, *sorted(set(episodes["policy"]) - set(POLICY_ORDER))]
    order = episodes[[*BY, "episode"]].assign(
        suite=episodes["suite"].map(SUITE_ORDER.index),
        policy=episodes["policy"].map(policies.index),
        task=episodes["task"].map(tasks),
    )
    columns = ["suite", "policy", "method", "task", "episode"]
    return episodes.loc[order.sort_values(columns).index].reset_index(drop=True)


def _policy_name(policy: str) -> str:
    """The short name of a policy that was published here; any other's label."""
    if TEMPERATURE in policy:
        return policy
    names = {shipped_checkpoint(benchmark).name: MINI for benchmark in suites.BENCHMARKS}
    names[f"{MINI}-{PAIR}"] = TAUGHT
    return names.get(checkpoint_of(policy), policy)


def _with_all(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """The episodes of every suite, policy and method, and again as one task."""
    import pandas as pd

    parts = [episodes.iloc[:0]]
    for _, part in episodes.groupby(BY[:-1], sort=False):
        parts += [part, part.assign(task=ALL)]
    return pd.concat(parts, ignore_index=True)


def sequence_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Two steps in turn: a line per suite, policy, method and task, and one for all tasks.

    `both` is the share in which both steps succeeded, `step 1` that of the first, `step 2 after 1`
    that of the second where the first had succeeded. `first touch right` says that the first thing
    touched in step 1 was its target. `wrong object` counts every episode in which another object
    was moved or selected; the failures divide into those with a wrong object and `other failures`
    (P tab:multiuser_seq).
    """
    rows = _with_all(episodes[episodes["suite"].isin(SEQUENCES)])
    first, wrong, success = (
        rows[name].astype(bool) for name in ("subgoal_1", "wrong_object", "success")
    )
    measures = {
        "both": success,
        "step 1": first,
        "step 2 after 1": success.where(first),
        "first touch right": rows["first_object_correct"],
        "wrong object": wrong,
        "failed, wrong object": ~success & wrong,
        "other failures": ~success & ~wrong,
    }
    return summary(rows.assign(**measures), BY, share=list(measures))


def area_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """VAP's first steps on the WidowX, by whether the target stands where films showed objects.

    The list's grid has a column on either side beyond that area (benchmarks.FILMED_AREA).

    Raises: BadSuite for a damaged list.
    """
    name = SEQUENCES[0]
    area = FILMED_AREA
    filmed = {}
    for row in suites.benchmark(name):
        target = row.placements[0]
        inside = area.x0 <= target.x <= area.x1 and area.y0 <= target.y <= area.y1
        filmed[row.task, row.episode] = "inside" if inside else "outside"
    chosen = episodes[(episodes["suite"] == name) & (episodes["method"] == "vap")]
    places = [filmed[key] for key in zip(chosen["task"], chosen["episode"], strict=True)]
    where = "the films' area"
    steps = chosen.assign(**{where: places, "step 1": chosen["subgoal_1"].astype(bool)})
    return summary(steps.sort_values(["policy", where]), ["policy", where], share=["step 1"])


def pair_table(episodes: "pd.DataFrame") -> "pd.DataFrame":
    """Two targets at once: a line per policy, method and task, the paper's SR in % beside.

    Raises: BadOutput, as `paper.ledger`.
    """
    rows = _with_all(episodes[episodes["suite"] == PAIR])
    names = {"success": "SR", "cmr": "target moved", "first_object_correct": "first touch right"}
    names |= {"wrong_object": "wrong object"}
    table = summary(rows.rename(columns=names), BY, share=list(names.values()))
    return table.assign(paper=table["task"].map(paper_pair))


def paper_pair(task: str) -> float:
    """The paper's SR in % on one of the pairs, or their mean (P tab:multi_object).

    Raises: BadOutput, as `paper.ledger`.
    """
    rates = _published("multi_object").set_index("row")["value"]
    return float(rates.mean() if task == ALL else rates[PAPER_PAIRS[task]])


def paper_sequence() -> dict[str, float]:
    """The paper's shares in %: both steps, a wrong object, other failures (P tab:multiuser_seq).

    Raises: BadOutput, as `paper.ledger`.
    """
    shares = _published("multiuser_seq").set_index("metric")["value"]
    names = {"both": "2-step SR", "failed, wrong object": "wrong object"}
    names["other failures"] = "others"
    return {name: float(shares[theirs]) for name, theirs in names.items()}


def paper_parser() -> "pd.DataFrame":
    """The paper's parser, %: a line per task (P tab:llm_parser).

    Raises: BadOutput, as `paper.ledger`.
    """
    rates = _published("llm_parser")
    named = rates.assign(what=rates["column"] + ", " + rates["metric"])
    return named.pivot_table(index="row", columns="what", values="value", sort=False)


def _published(name: str) -> "pd.DataFrame":
    facts = paper.ledger()
    return facts[facts["table"] == name]


def shared_figure(episodes: "pd.DataFrame", title: str = "") -> "Figure":
    """Success in all tasks of each suite, and of the first step alone (hollow); diamonds: the
    paper's, on a real arm.

    Raises: BadOutput, as `paper.ledger`.
    """
    import pandas as pd

    pairs = pair_table(episodes).rename(columns={"SR": "both"}).assign(paper=paper_pair(ALL) / 100)
    turns = sequence_table(episodes).assign(paper=paper_sequence()["both"] / 100)
    marks = [
        tidy(turns[[*BY, "n", "both", "step 1", "paper"]], ["both", "step 1"]),
        tidy(pairs[[*BY, "n", "both", "paper"]], ["both"]),
    ]
    table = pd.concat(marks, ignore_index=True)
    table = table[table["task"] == ALL]
    bound = table["policy"] == "expert"
    table["line"] = (table["policy"] + ", " + table["method"]).mask(bound, "expert (bound)")
    table["panel"] = table["suite"] + "\nn = " + table["n"].astype(str) + " a line"
    ours = (table["method"] == "vap") & (table["measure"] == "both") & ~bound
    table = table.assign(filled=table["measure"] == "both", paper=table["paper"].where(ours))
    label = "% of episodes, 95 % interval; hollow: the first of two steps"
    return charts.dots(table, "line", panel="panel", series="method", label=label, title=title)
