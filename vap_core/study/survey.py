"""The survey of perception: its jobs, tables and text."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vap_core.base.errors import one_of
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow
from vap_core.study import measurement, store, tracking
from vap_core.study.measurement import Measurement, Tables
from vap_core.study.perception import (
    KS,
    RULES,
    USUAL_K,
    agreements,
    opening_views,
    registered_object,
    survey,
)
from vap_core.study.stats import NONE, Estimate, mean_by, precision, share, summary
from vap_core.study.table import printed
from vap_core.study.tracking import HIDDEN, LIMITS_MS
from vap_core.study.trials import Study

if TYPE_CHECKING:
    import pandas as pd

WHOLE, ABSENT = 60, 12
"""Episodes a task, at most, of which the views are compared: of the lists with several cameras and
their development lists, and of every list without its targets."""
EPISODES = {"simpler-fractal": 30, "simpler-bridge": 16, "vlabench": 8, "tabletop": 5}
"""Opening frames a task, as episodes spread evenly over its list.

Suites with three cameras need fewer.
"""
FOREIGN = 6
"""Opening frames a task of other libraries' suites."""
QUICK = 2
"""Episodes a task of a quick survey.

It tracks one episode of each suite, and hides its target once.
"""
CHUNK = 6
"""Episodes of one job: little is lost when a run is killed."""
TABLES = (
    *("views", "objects", "detections", "choices", "agreements", "references", "tracks", "speed"),
)


@dataclass(frozen=True)
class Job:
    """A piece of work for one process; its name is its file's.

    `what` are the episodes whose opening frames are surveyed, or an episode to track; None is the
    time of its pieces, which is measured alone, so that nothing of this run disturbs it.
    `together`: the views of each episode are compared, and nothing else is surveyed.
    """

    name: str
    what: tuple[EpisodeRow, ...] | tracking.Job | None
    together: bool = False

    @property
    def alone(self) -> bool:
        return self.what is None


@dataclass(frozen=True)
class Survey(Measurement):
    """What is asked for.

    `episodes` None takes `EPISODES` opening frames a task, and tracking.plan's episodes.

    Raises: UnknownName for a suite that is no benchmark, or a stack that does not exist.
    """

    stack: str = "embedded"
    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    episodes: int | None = None
    quick: bool = False
    caller: ClassVar[str] = "measure perception"

    def __post_init__(self) -> None:
        for name in self.suites:
            if name not in (*suites.BENCHMARKS, *suites.ELSEWHERE):
                raise one_of("Survey: suite", name, (*suites.BENCHMARKS, *suites.ELSEWHERE))
        check_stack(self.stack, "Survey")

    def n_openings(self, suite: str) -> int:
        """Opening frames a task."""
        return self.episodes or (QUICK if self.quick else EPISODES.get(suite, FOREIGN))

    def n_tracked(self, suite: str) -> int:
        """Episodes a task that are tracked to their end; our own expert plays them."""
        if suite in suites.ELSEWHERE:
            return 0
        usual = 1 if self.quick else tracking.EPISODES[suite]
        return min(usual, self.episodes or usual)

    def settings(self) -> dict[str, Any]:
        """What the results depend on, as JSON: the world, weights and lists by their checksums.

        Raises: BadSuite, as `Study.configuration`; MissingWeights: the stack's models are not here.
        """
        counts = {
            name: {"openings": self.n_openings(name), "tracks": self.n_tracked(name)}
            for name in self.suites
        }
        tasks = suites.tasks_of(self.suites)
        shown = Study(tasks, ("generic",), policy="expert", stack=self.stack).configuration()
        return {
            "survey": "perception",
            "stack": self.stack,
            "episodes": counts,
            "ks": list(KS),
            "seed": 0,
            **{name: shown[name] for name in ("version", "lists", "world")},
            **checksums(self.stack),
        }

    def jobs(self) -> list[Job]:
        """Every job, the long ones first, so that processes finish together.

        Raises: BadSuite for a damaged list.
        """
        jobs = []
        own = tuple(name for name in self.suites if name not in suites.ELSEWHERE)
        tracked = tracking.plan({name: self.n_tracked(name) for name in own}, own)
        if self.quick:
            first = {job.row.suite: job for job in reversed(tracked)}
            tracked = [replace(first[name], hidden=(HIDDEN,)) for name in own]
        for what in tracked:
            row = what.row
            hidden = "-".join(map(str, what.hidden))
            name = f"tracks.{row.suite}.{row.task}.{row.episode}.{what.kind}.{what.every}.{hidden}"
            jobs.append(Job(name, what))
        for suite in self.suites:
            for task in suites.suite(suite).tasks:
                rows = suites.rows(suite, task.name, self.n_openings(suite))
                for i in range(0, len(rows), CHUNK):
                    part = rows[i : i + CHUNK]
                    episodes = f"{part[0].episode}-{part[-1].episode}"
                    jobs.append(Job(f"openings.{suite}.{task.name}.{episodes}", part))
            if suite in own:
                jobs += self._compared(suite)
        return [*jobs, Job("speed", None)]

    def _compared(self, suite: str) -> list[Job]:
        """The jobs that compare the views of an episode, over the lists of a suite."""
        lists = {suite + suites.ABSENT: ABSENT}
        if len(suites.suite(suite).cameras) > 1:
            lists |= {suite: WHOLE, suite + suites.DEVELOPMENT: WHOLE}
        jobs = []
        for listed, most in lists.items():
            for task in suites.suite(listed).tasks:
                n = self.n_openings(suite) if self.quick or self.episodes else most
                rows = suites.rows(listed, task.name, n)
                for i in range(0, len(rows), CHUNK):
                    name = f"together.{listed}.{task.name}.{rows[i].episode}"
                    jobs.append(Job(name, rows[i : i + CHUNK], together=True))
        return jobs

    def run(self, job: Job, folder: Path) -> Tables:
        """Raises: as `tracking.track_episode`, `opening_views` and `survey`."""
        stack = _load_stack(self.stack)
        if job.what is None:
            return {"speed": tracking.measure(stack, repeat=5 if self.quick else 25)}
        if isinstance(job.what, tracking.Job):
            return {"tracks": tracking.track_episode(job.what, stack)}
        tables: Tables = {name: [] for name in TABLES}
        if job.together:
            for episode in opening_views(job.what):
                mine, _ = registered_object(stack, episode[0].row.target, USUAL_K)
                tables["agreements"] += agreements(episode, mine, stack)
            return tables
        for episode in opening_views(job.what):
            for name, rows in survey(episode, stack).items():
                tables[name] += rows
        first = job.what[0]
        about = {"suite": first.suite, "task": first.task, "target": first.target}
        is_first = first.episode == suites.rows(first.suite, first.task, 1)[0].episode
        for k in KS if is_first else ():  # once a task
            whole = len(registered_object(stack, first.target, k)[1])
            tables["references"].append({**about, "k": k, "whole": whole})
        return tables


_load_stack = cache(load_stack)


def run_survey(
    asked: Survey, folder: Path, *, workers: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks of the survey, and return its tables. Raises: as `measure`."""
    return measurement.measure(asked, folder, workers=workers, progress=progress)


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished survey in `to` as perception_NAME.parquet, with their settings.

    Raises: BadOutput.
    """
    measurement.read(folder, Survey.caller, TABLES)
    stack = store.read_manifest(folder)["configuration"]["stack"]
    prefix = "perception" if stack == "embedded" else f"perception_{stack}"
    tables = {f"{prefix}_{name}.parquet": folder / f"{name}.parquet" for name in TABLES}
    kept = {name: path.read_bytes() for name, path in tables.items()}
    return store.publish_tables(kept, to, caller=Survey.caller)


def published(folder: Path, stack: str = "embedded") -> "dict[str, pd.DataFrame]":
    """The tables that `publish` keeps in `folder`. Raises: BadOutput."""
    prefix = "perception" if stack == "embedded" else f"perception_{stack}"
    paths = {name: folder / f"{prefix}_{name}.parquet" for name in TABLES}
    return store.read_tables(paths, Survey.caller)


ALL = "all"
CASES = ("right", "case 1", "case 2", "nothing")
NOTE = (
    f"value [95 % interval] n; K = {USUAL_K}, vote, unless said otherwise. Shares: Wilson over "
    "views (objects for recall, tracks for identity), too narrow where views are of one object or "
    "tracks of one episode; IoU and AP50: bootstrap by episode.\n"
    "Views that show less of the target than 100 px of 224 x 224 do not count. 'hard': a "
    "look-alike of the target's own base and ink colours is in view."
)
Statistic = Callable[["pd.DataFrame"], Estimate]


def measures(tables: "dict[str, pd.DataFrame]") -> "pd.DataFrame":
    """Every measure of perception: an `Estimate` per suite and over all of them, the least that it
    should be (`target`, a fraction; nan for one that only explains the others), and a verdict:
    "met", "short: " and the suites, or "not measured"; "" without a target.
    """
    import pandas as pd

    views, objects, choices, tracks = (
        _counting(tables[name]) for name in ("views", "objects", "choices", "tracks")
    )
    usual = choices.query("k == @USUAL_K and rule == 'vote'")
    standard, hard = (usual[usual.tier == tier] for tier in ("standard", "hard"))
    key = ["suite", "task", "episode", "camera"]
    where_proposed = usual.merge(views[[*key, "proposed"]], on=key).query("proposed == True")
    asked = objects.dropna(subset=["recalled_unseen"])
    still, behind, lookalikes, arm = tracks, tracks, tracks, tracks
    if len(tracks):
        still = tracks.query("target and hidden == 0")
        lookalikes = tracks.query("not target and hidden == 0")
        behind, arm = (
            tracks.query("target and hidden == @HIDDEN and kind == @kind")
            for kind in ("plate", "arm")
        )
    ap50, unseen = (_ap50_of(kind, tables["detections"]) for kind in ("category", "unseen"))
    rows: list[tuple[str, float | None, pd.DataFrame, Statistic]] = [
        ("detection recall@10, IoU .5", 0.97, objects, _share_of("recalled")),
        ("detection AP50", 0.85, objects, ap50),
        ("right instance, standard", 0.97, standard, _share_of("right")),
        ("right instance, hard", 0.90, hard, _share_of("right")),
        ("mask IoU of the right instance", 0.88, usual, _mean_of("mask_iou")),
        ("identity kept, never hidden", 0.98, still, _share_of("kept")),
        (f"identity kept, {HIDDEN} frames fully hidden", 0.95, behind, _share_of("kept")),
        ("track IoU, whole episodes", 0.80, still, _mean_of("mean_iou")),
        ("recall at the detector's own threshold", None, objects, _share_of("proposed")),
        ("target proposed", None, views, _share_of("proposed")),
        ("right given true boxes, standard", None, standard, _share_of("right_given_boxes")),
        ("right given true boxes, hard", None, hard, _share_of("right_given_boxes")),
        ("right where proposed, all", None, where_proposed, _share_of("right")),
        ("mask IoU from the true box", None, views, _mean_of("mask_iou_true_box")),
        ("recall@10, unseen phrase", None, asked, _share_of("recalled_unseen")),
        ("AP50, unseen phrase", None, asked, unseen),
        ("false alarm, absent category", None, views, _share_of("false_alarm")),
        ("look-alikes: identity kept, never hidden", None, lookalikes, _share_of("kept")),
        ("look-alikes: track IoU", None, lookalikes, _mean_of("mean_iou")),
        (f"identity kept, {HIDDEN} frames behind an arm", None, arm, _share_of("kept")),
    ]
    listed = (*suites.BENCHMARKS, *suites.ELSEWHERE)
    suite_names = [name for name in listed if (views.suite == name).any()]
    lines = []
    for measure, target, table, statistic in rows:
        cells = {name: NONE for name in [*suite_names, ALL]}
        for name in cells:
            part = table if name == ALL or not len(table) else table[table.suite == name]
            if len(part):
                cells[name] = statistic(part)
        line = {"measure": measure, "target": target}
        lines.append({**line, **cells, "verdict": verdict(target, cells)})
    return pd.DataFrame(lines)


def verdict(target: float | None, cells: dict[str, Estimate]) -> str:
    """How the estimates of suites stand to a target."""
    if target is None:
        return ""
    if not any(found.n for found in cells.values()):
        return "not measured"
    missed = [
        name for name, found in cells.items() if name != ALL and found.n and found.value < target
    ]
    return f"short: {', '.join(missed)}" if missed else "met"


def measures_text(found: "pd.DataFrame") -> "pd.DataFrame":
    """`measures` as text."""
    cells = found.columns[2:-1]
    shown = found.assign(**{name: [each.text() for each in found[name]] for name in cells})
    targets = ["" if target != target else f">= {100 * target:.0f}" for target in found["target"]]
    return shown.assign(target=targets).rename(columns={"measure": "measure, %"})


def report(tables: "dict[str, pd.DataFrame]", stack: str) -> str:
    """What the command prints."""
    left_out = ", ".join(
        f"{name} {int((~part.counts).sum())} of {len(part)}"
        for name, part in tables["views"].groupby("suite", sort=False)
    )
    cut = share(
        hit
        for row in tables["references"].itertuples()
        for hit in [False] * row.whole + [True] * (row.k - row.whole)
    )
    note = (
        f"stack {stack}. {NOTE}\n"
        f"Views without target, left out: {left_out}. "
        f"Reference photos cut by the detector: {cut.text()}."
    )
    parts = [printed(measures_text(measures(tables))), note, printed(_by_k(tables["choices"]))]
    if len(tables["agreements"]):
        parts.append(printed(_by_association(tables["agreements"])))
    return "\n\n".join([*parts, printed(_by_camera(tables)), printed(_speed(tables["speed"]))])


def conclude(tables: "dict[str, pd.DataFrame]", stack: str, folder: Path) -> str:
    """Write `summary.json` into the run's folder, and return the text to print.

    Raises: BadOutput.
    """
    lines = []
    for line in measures(tables).to_dict("records"):
        about = {name: line.pop(name) for name in ("measure", "target", "verdict")}
        about["target"] = None if about["target"] != about["target"] else about["target"]
        cells = {
            name: dict(value=found.value, low=found.low, high=found.high, n=found.n)
            if found.n
            else None
            for name, found in line.items()
        }
        lines.append({**about, "cells": cells})
    content = {"summary.json": json.dumps(lines, indent=1)}
    return measurement.report(Survey(stack), report(tables, stack), folder, content)


def abstention(choices: "pd.DataFrame", margin: str = "margin", k: int = USUAL_K) -> "pd.DataFrame":
    """Share of right instances among the views whose margin is at least a threshold.

    One row per threshold that changes the share, with Wilson's interval. `coverage` is the share of
    these views among all views that show the target; a view without candidates is never among them.
    """
    import pandas as pd

    usual = choices[(choices.k == k) & (choices.rule == "vote")]
    answered = usual[usual.elected != ""]
    rows = []
    for threshold in sorted(answered[margin].unique(), reverse=True):
        kept = answered[answered[margin] >= threshold]
        right = share(kept.right)
        line = {"threshold": threshold, "coverage": len(kept) / len(usual), "right": right.value}
        rows.append({**line, "low": right.low, "high": right.high, "n": right.n})
    return pd.DataFrame(rows)


def lookalike_pairs(objects: "pd.DataFrame") -> "pd.DataFrame":
    """One row per look-alike and view that shows the target too.

    `tier` is the look-alike's; `ahead` is by how much the target's true crop is nearer to the
    references.
    """
    key = ["suite", "task", "episode", "camera"]
    is_target = objects.role == "target"
    targets = objects.loc[is_target, [*key, "cosine"]]
    pairs = objects[~is_target].merge(targets, on=key, suffixes=("", "_target"))
    return pairs.assign(ahead=pairs.cosine_target - pairs.cosine)


def _share_of(column: str) -> Statistic:
    return lambda table: share(table[column])


def _mean_of(column: str) -> Statistic:
    return lambda table: mean_by(table, column)


def _ap50_of(asked: str, detections: "pd.DataFrame") -> Statistic:
    """AP50 of the detections of one kind of phrase, on the objects of the table."""
    found = detections[detections.asked == asked] if len(detections) else detections

    def ap50(wanted: "pd.DataFrame") -> Estimate:
        names = wanted.suite.unique()
        return precision(found[found.suite.isin(names)] if len(found) else found, wanted)

    return ap50


def _counting(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of views that count: the others have no figures of the target."""
    return table[table.counts] if "counts" in table else table


def _by_k(choices: "pd.DataFrame") -> "pd.DataFrame":
    """A row per number of references and rule: right instances by suite."""
    import pandas as pd

    both = pd.concat([choices, choices.assign(suite=ALL)])
    found = summary(both, ["k", "rule", "suite"], share=["right"])
    found["right"] = [each.text() for each in found["right"]]
    wide = found.pivot(index=["k", "rule"], columns="suite", values="right")
    wide = wide.reindex([(k, rule) for k in KS for rule in RULES])
    listed = (*suites.BENCHMARKS, *suites.ELSEWHERE, ALL)
    wide = wide[[name for name in listed if name in wide]]
    wide.insert(0, "right instance, %", [f"K = {k}, {rule}" for k, rule in wide.index])
    return wide


def _by_association(agreements: "pd.DataFrame") -> "pd.DataFrame":
    """What the views of an episode highlight together, and in how many views it is the target, by
    suite and way to associate.
    """
    import pandas as pd

    lines = []
    for (suite, way), part in agreements.groupby(["suite", "associate"], sort=False):
        line: dict[str, Any] = {"views associated, % of episodes": suite, "by": way}
        line |= {case: share(part.case == case).text() for case in CASES}
        hits = [i < row.right for row in part.itertuples() for i in range(row.views)]
        lines.append({**line, "% of views right": share(hits).text()})
    return pd.DataFrame(lines)


def _by_camera(tables: "dict[str, pd.DataFrame]") -> "pd.DataFrame":
    import pandas as pd

    lines = []
    cameras = tables["views"][["suite", "camera"]].drop_duplicates()
    for suite, camera in cameras.itertuples(index=False, name=None):
        views, objects, detections, choices = (
            table[(table.suite == suite) & (table.camera == camera)] if len(table) else table
            for table in (tables[n] for n in ("views", "objects", "detections", "choices"))
        )
        usual = choices.query("k == @USUAL_K and rule == 'vote'")
        line: dict[str, Any] = {"by camera, %": f"{suite} {camera}"}
        line["views"] = int(views.counts.sum())
        line["recall@10"] = share(objects.recalled).text()
        line["AP50"] = precision(detections[detections.asked == "category"], objects).text()
        for tier in ("standard", "hard"):
            line[f"right, {tier}"] = share(usual[usual.tier == tier].right).text()
        lines.append({**line, "mask IoU": mean_by(usual, "mask_iou").text()})
    return pd.DataFrame(lines)


def _speed(speed: "pd.DataFrame") -> "pd.DataFrame":
    """A row per piece of work, with its ratio to each that has no budget of its own."""
    limits = speed.what.map(LIMITS_MS)
    table = speed[["what"]].assign(
        **{
            "one thread, 224 px view": speed.what + ", " + speed.rounds.astype(str) + " rounds",
            "ms (quartiles)": [
                f"{row.ms:.1f} ({row.low_ms:.1f}, {row.high_ms:.1f})" for row in speed.itertuples()
            ],
            "budget": ["" if limit != limit else f"<= {limit:g}" for limit in limits],
        }
    )
    for other in speed[limits.isna()].itertuples():
        table[f"x {other.what}"] = (speed.ms / other.ms).map("{:.2f}".format)
    table["verdict"] = (
        (speed.ms <= limits).map({True: "met", False: "short"}).where(limits.notna(), "")
    )
    return table.drop(columns="what")
