"""The survey of perception: its jobs, tables and text."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput, one_of, require
from vap_core.base.files import align, read_parquet, write_atomic, writing
from vap_core.base.types import value
from vap_core.perception.stacks import check_stack, checksums, load_stack
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow
from vap_core.study import store, tracking
from vap_core.study.perception import (
    KS,
    RULES,
    USUAL_K,
    TableRow,
    Tables,
    opening_views,
    registered_object,
    survey,
)
from vap_core.study.processes import results
from vap_core.study.stats import NONE, Estimate, mean, precision, share
from vap_core.study.tracking import HIDDEN, LIMITS_MS
from vap_core.study.trials import Study

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

EPISODES = {"simpler-fractal": 30, "simpler-bridge": 16, "vlabench": 8, "tabletop": 5}
"""Opening frames a task, as episodes spread evenly over its list.

Suites with three cameras need fewer.
"""
QUICK = 2
"""Episodes a task of a quick survey.

It tracks one episode of each suite, and hides its target once.
"""
CHUNK = 6
"""Episodes of one job: little is lost when a run is killed."""
TABLES = (
    "views",
    "objects",
    "detections",
    "choices",
    "agreements",
    "references",
    "tracks",
    "speed",
)
WORLD = ("version", "lists", "world")
"""What a survey's configuration takes from a study's."""


@dataclass(frozen=True)
class Survey:
    """What is asked for.

    `episodes` None takes `EPISODES` opening frames a task, and tracking.plan's episodes.

    Raises: UnknownName for a suite that is no benchmark, or a stack that does not exist.
    """

    stack: str = "embedded"
    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    episodes: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for name in self.suites:
            if name not in suites.BENCHMARKS:
                raise one_of("Survey: suite", name, suites.BENCHMARKS)
        check_stack(self.stack, "Survey")

    def n_openings(self, suite: str) -> int:
        """Opening frames a task."""
        if self.episodes:
            return self.episodes
        return QUICK if self.quick else EPISODES[suite]

    def n_tracked(self, suite: str) -> int:
        """Episodes a task that are tracked to their end."""
        usual = 1 if self.quick else tracking.EPISODES[suite]
        return min(usual, self.episodes or usual)

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON: the world, weights and lists by their checksums.

        Raises: BadSuite, as `Study.configuration`; MissingWeights: the stack's models are not here.
        """
        counts = {}
        for name in self.suites:
            counts[name] = {"openings": self.n_openings(name), "tracks": self.n_tracked(name)}
        study = Study(
            tasks=suites.tasks_of(self.suites),
            methods=("generic",),
            policy="expert",
            stack=self.stack,
        )
        of_study = study.configuration()
        configuration: dict[str, Any] = {
            "survey": "perception",
            "stack": self.stack,
            "episodes": counts,
            "ks": list(KS),
            "seed": 0,
        }
        for key in WORLD:
            configuration[key] = of_study[key]
        return configuration | checksums(self.stack)


@dataclass(frozen=True)
class Job:
    """A piece of work for one process; its name is its file's.

    `what` are the episodes whose opening frames are surveyed, or an episode to track.
    """

    name: str
    stack: str
    what: tuple[EpisodeRow, ...] | tracking.Job


def plan(asked: Survey) -> list[Job]:
    """Every job, the long ones first, so that processes finish together.

    Raises: BadSuite for a damaged list.
    """
    return [*_tracking_jobs(asked), *_opening_jobs(asked)]


def run_job(job: Job) -> Tables:
    """Do one job in this process, and return its part of the tables.

    Raises: as `tracking.track_episode`, `opening_views` and `survey`.
    """
    stack = _load_stack(job.stack)
    if isinstance(job.what, tracking.Job):
        return {"tracks": tracking.track_episode(job.what, stack)}
    tables: Tables = {}
    for episode in opening_views(job.what):
        for name, rows in survey(episode, stack).items():
            tables.setdefault(name, []).extend(rows)
    first = job.what[0]
    tables["references"] = []
    for k in KS:
        _, whole_photos = registered_object(stack, first.target, k)
        reference: TableRow = {
            "suite": first.suite,
            "task": first.task,
            "target": first.target,
            "k": k,
            "whole": len(whole_photos),
        }
        tables["references"].append(reference)
    return tables


def run_survey(
    asked: Survey, folder: Path, *, jobs: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks of the survey, write a parquet table each and return them.

    Speed is measured last and alone, so that nothing of this run disturbs it.

    Raises: BadOutput when the folder holds another run, or is in use; WorkerDied; MissingPart.
    """
    require("foundation", "the unit of speed, a pass of the backbone by torch,")
    store.open_run(folder, asked.configuration())
    with store.locked(folder):
        planned = plan(asked)
        parts = folder / "parts"
        with writing(folder, "survey"):
            parts.mkdir(exist_ok=True)
        missing = []
        paths = []
        for job in planned:
            path = _part_path(parts, job.name)
            paths.append(path)
            if not path.exists():
                missing.append(job)
        _run_missing(missing, parts=parts, total=len(planned), jobs=jobs, progress=progress)
        speed_path = _part_path(parts, "speed")
        paths.append(speed_path)
        if not speed_path.exists():
            speed = {"speed": _measure_speed(asked)}
            store.write_json_part(speed_path, speed, caller="survey", default=_to_number)
        return _write_tables(folder, paths)


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables of a finished survey. Raises: BadOutput."""
    store.read_manifest(folder)
    missing = [name for name in TABLES if not _table_path(folder, name).exists()]
    if missing:
        raise BadOutput(
            f"survey: {folder} lacks {', '.join(missing)}; run the same measure perception again "
            "to finish it."
        )
    return _read_tables(folder)


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished survey in `to` as perception_NAME.parquet.

    Their configuration is in their metadata. Raises: BadOutput.
    """
    read(folder)
    stack = store.read_manifest(folder)["configuration"]["stack"]
    prefix = "perception"
    if stack != "embedded":
        prefix = f"perception_{stack}"
    tables = {}
    for name in TABLES:
        tables[f"{prefix}_{name}.parquet"] = _table_path(folder, name).read_bytes()
    return store.publish_tables(tables, to, caller="survey")


_load_stack = cache(load_stack)


def _tracking_jobs(asked: Survey) -> list[Job]:
    """A job per episode to track."""
    counts = {}
    for suite in asked.suites:
        counts[suite] = asked.n_tracked(suite)
    tracked = tracking.plan(counts, asked.suites)
    if asked.quick:
        tracked = _first_of_each_suite(tracked, asked.suites)
    jobs = []
    for what in tracked:
        row = what.row
        hidden = "-".join(map(str, what.hidden))
        name = f"tracks.{row.suite}.{row.task}.{row.episode}.{what.kind}.{what.every}.{hidden}"
        jobs.append(Job(name, asked.stack, what))
    return jobs


def _first_of_each_suite(
    tracked: Sequence[tracking.Job], names: Sequence[str]
) -> list[tracking.Job]:
    """The first episode of each suite, with its target hidden once."""
    first: dict[str, tracking.Job] = {}
    for job in tracked:
        first.setdefault(job.row.suite, job)
    return [replace(first[name], hidden=(tracking.HIDDEN,)) for name in names]


def _opening_jobs(asked: Survey) -> list[Job]:
    """A job per CHUNK opening frames of one task."""
    jobs = []
    for suite in asked.suites:
        for task in suites.suite(suite).tasks:
            rows = suites.rows(suite, task.name, asked.n_openings(suite))
            for first in range(0, len(rows), CHUNK):
                part = rows[first : first + CHUNK]
                episodes = f"{part[0].episode}-{part[-1].episode}"
                jobs.append(Job(f"openings.{suite}.{task.name}.{episodes}", asked.stack, part))
    return jobs


def _run_missing(
    missing: Sequence[Job], *, parts: Path, total: int, jobs: int, progress: bool
) -> None:
    """Do the jobs in `jobs` processes, and write each one's part when it is finished."""
    from tqdm import tqdm

    with tqdm(
        total=total,
        initial=total - len(missing),
        unit="job",
        desc="perception",
        disable=not progress,
    ) as bar:
        for job, tables in results(run_job, missing, workers=jobs, remedy="--jobs"):
            path = _part_path(parts, job.name)
            store.write_json_part(path, tables, caller="survey", default=_to_number)
            bar.update()


def _measure_speed(asked: Survey) -> list[TableRow]:
    from vap_core.study import tracking

    return tracking.measure(_load_stack(asked.stack), repeat=5 if asked.quick else 25)


def _part_path(parts: Path, name: str) -> Path:
    return parts / f"{name}.json"


def _table_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.parquet"


def _to_number(scalar: Any) -> Any:
    """A NumPy scalar as a Python number."""
    return scalar.item()


def _write_tables(folder: Path, parts: Sequence[Path]) -> "dict[str, pd.DataFrame]":
    """All parts as one table of each kind, with the run's configuration in every file's metadata.

    Raises: BadOutput for a damaged part, or when the disk is full.
    """
    tables: Tables = {name: [] for name in TABLES}
    for path in parts:
        for name, rows in store.read_json_part(path, caller="survey").items():
            tables[name] += rows
    tables["references"] = _unique_rows(tables["references"])
    manifest = json.dumps(store.read_manifest(folder), sort_keys=True)
    for name, rows in tables.items():
        table = _arrow_table(rows).replace_schema_metadata({b"run": manifest.encode()})
        data = store.encode_table(table)
        with writing(folder, "survey"):
            write_atomic(_table_path(folder, name), data)
    return _read_tables(folder)


def _unique_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    unique: list[TableRow] = []
    for row in rows:
        if row not in unique:
            unique.append(row)
    return unique


def _arrow_table(rows: list[TableRow]) -> "pa.Table":
    """The rows as a table; one without rows has a column of suites nevertheless."""
    import pyarrow as pa

    if rows:
        return pa.Table.from_pylist(rows)
    return pa.table({"suite": pa.array([], pa.string())})


def _read_tables(folder: Path) -> "dict[str, pd.DataFrame]":
    tables = {}
    for name in TABLES:
        path = _table_path(folder, name)
        tables[name] = read_parquet(
            path, "measure perception", "delete it and run the same command again"
        )
    return tables


SurveyTables = Mapping[str, "pd.DataFrame"]
"""The tables of a survey by name."""
Statistic = Callable[["pd.DataFrame"], Estimate]
Cells = Sequence[str]
ALL = "all"
CASES = ("right", "case 1", "case 2", "nothing")
TIERS = ("standard", "hard")
NOTE = (
    f"value [95 % interval] n; K = {USUAL_K}, vote, unless said otherwise. Shares: Wilson over "
    "views (objects for recall, tracks for identity), too narrow where views are of one object or "
    "tracks of one episode; IoU and AP50: bootstrap by episode.\n"
    "Views that show less of the target than 100 px of 224 x 224 do not count. 'hard': a "
    "look-alike of the target's own base and ink colours is in view."
)


@value
class Measure:
    """One estimate per suite and over all of them, and the least it should be.

    `target` is a fraction; None for a measure that only explains the others.
    """

    name: str
    target: float | None
    cells: Mapping[str, Estimate]

    @property
    def missed_suites(self) -> list[str]:
        """The suites whose value misses the target."""
        missed: list[str] = []
        if self.target is None:
            return missed
        for name, estimate in self.cells.items():
            if name != ALL and estimate.n and estimate.value < self.target:
                missed.append(name)
        return missed

    @property
    def verdict(self) -> str:
        """Either "met", "short: " and the suites, or "not measured"; "" without a target."""
        if self.target is None:
            return ""
        if not any(estimate.n for estimate in self.cells.values()):
            return "not measured"
        if self.missed_suites:
            return f"short: {', '.join(self.missed_suites)}"
        return "met"

    def row(self) -> list[str]:
        """Name, target, every estimate and the verdict as text."""
        target = ""
        if self.target is not None:
            target = f">= {100 * self.target:.0f}"
        estimates = [estimate.text() for estimate in self.cells.values()]
        return [self.name, target, *estimates, self.verdict]


def measures(tables: SurveyTables) -> list[Measure]:
    """Every measure of perception by suite, in %."""
    names = _suite_names(_counting_views(tables["views"]))
    parts = [
        *_requirements(tables),
        *_detector_measures(tables),
        *_unseen_measures(tables),
        *_tracker_measures(tables),
    ]
    found = []
    for name, target, table, statistic in parts:
        cells = _estimate_by_suite(names, table, statistic)
        found.append(Measure(name, target, cells))
    return found


def report(tables: SurveyTables, stack: str) -> str:
    """What the command prints."""
    found = measures(tables)
    cells = list(found[0].cells)
    views = _text_of_views_without_target(tables["views"], cells)
    cut = _share_of_cut_photos(tables["references"])
    note = (
        f"stack {stack}. {NOTE}\n"
        f"Views without target, left out: {views}. "
        f"Reference photos cut by the detector: {cut.text()}."
    )
    later_tables = [_rows_by_k(tables["choices"], cells)]
    if len(tables["agreements"]):
        later_tables.append(_rows_by_association(tables["agreements"]))
    later_tables.append(_rows_by_camera(tables))
    later_tables.append(_speed_rows(tables["speed"]))
    paragraphs = [align(_measure_rows(found)), note]
    for rows in later_tables:
        paragraphs.append(align(rows))
    return "\n\n".join(paragraphs)


def summary(found: Iterable[Measure]) -> list[dict[str, object]]:
    """The measures as JSON."""
    rows: list[dict[str, object]] = []
    for measure in found:
        rows.append(
            {
                "measure": measure.name,
                "target": measure.target,
                "verdict": measure.verdict,
                "cells": _summarize_cells(measure.cells),
            }
        )
    return rows


def conclude(tables: SurveyTables, stack: str, folder: Path) -> str:
    """Write `summary.json` into the run's folder, and return the text to print.

    Raises: BadOutput.
    """
    path = folder / "summary.json"
    rows = summary(measures(tables))
    content = json.dumps(rows, indent=1)
    with writing(folder, "survey"):
        write_atomic(path, content.encode())
    return f"{report(tables, stack)}\n\nwrote {path} and the tables beside it"


Part = tuple[str, float | None, "pd.DataFrame", Statistic]
"""Name and target of a measure, the rows that it is about, and what it takes of them."""


def _requirements(tables: SurveyTables) -> list[Part]:
    """The measures that have a target."""
    objects = _counting_views(tables["objects"])
    choices = _usual_choices(_counting_views(tables["choices"]))
    standard = choices[choices.tier == "standard"]
    hard = choices[choices.tier == "hard"]
    undisturbed = _target_tracks(tables, hidden=0)
    plate = _of_kind(_target_tracks(tables, hidden=HIDDEN), "plate")
    kept = _share_of("kept")
    right = _share_of("right")
    mask_iou = _mean_of("mask_iou")
    ap50 = _ap50_of("category", tables["detections"])
    return [
        ("detection recall@10, IoU .5", 0.97, objects, _share_of("recalled")),
        ("detection AP50", 0.85, objects, ap50),
        ("right instance, standard", 0.97, standard, right),
        ("right instance, hard", 0.90, hard, right),
        ("mask IoU of the right instance", 0.88, choices, mask_iou),
        ("identity kept, never hidden", 0.98, undisturbed, kept),
        (f"identity kept, {HIDDEN} frames fully hidden", 0.95, plate, kept),
        ("track IoU, whole episodes", 0.80, undisturbed, _mean_of("mean_iou")),
    ]


def _detector_measures(tables: SurveyTables) -> list[Part]:
    """What the detector and the segmenter contribute, without targets."""
    objects = _counting_views(tables["objects"])
    views = _counting_views(tables["views"])
    choices = _usual_choices(_counting_views(tables["choices"]))
    standard = choices[choices.tier == "standard"]
    hard = choices[choices.tier == "hard"]
    where_proposed = _where_proposed(choices, views)
    proposed = _share_of("proposed")
    ideal = _share_of("right_given_boxes")
    mask_iou = _mean_of("mask_iou_true_box")
    return [
        ("recall at the detector's own threshold", None, objects, proposed),
        ("target proposed", None, views, proposed),
        ("right given true boxes, standard", None, standard, ideal),
        ("right given true boxes, hard", None, hard, ideal),
        ("right where proposed, all", None, where_proposed, _share_of("right")),
        ("mask IoU from the true box", None, views, mask_iou),
    ]


def _unseen_measures(tables: SurveyTables) -> list[Part]:
    """The detector on phrases that it was not trained with, and on absent categories."""
    views = _counting_views(tables["views"])
    objects = _counting_views(tables["objects"])
    asked = objects.dropna(subset=["recalled_unseen"])
    ap50 = _ap50_of("unseen", tables["detections"])
    return [
        ("recall@10, unseen phrase", None, asked, _share_of("recalled_unseen")),
        ("AP50, unseen phrase", None, asked, ap50),
        ("false alarm, absent category", None, views, _share_of("false_alarm")),
    ]


def _tracker_measures(tables: SurveyTables) -> list[Part]:
    """The tracker on look-alikes and behind an arm, without targets."""
    tracks = _counting_views(tables["tracks"])
    lookalikes = tracks
    if len(tracks):
        lookalikes = tracks[~tracks.target & (tracks.hidden == 0)]
    arm = _of_kind(_target_tracks(tables, hidden=HIDDEN), "arm")
    kept = _share_of("kept")
    return [
        ("look-alikes: identity kept, never hidden", None, lookalikes, kept),
        ("look-alikes: track IoU", None, lookalikes, _mean_of("mean_iou")),
        (f"identity kept, {HIDDEN} frames behind an arm", None, arm, kept),
    ]


def _share_of(column: str) -> Statistic:
    """The share of rows where a column holds."""

    def share_of_column(table: "pd.DataFrame") -> Estimate:
        return share(table[column])

    return share_of_column


def _mean_of(column: str) -> Statistic:
    """The mean of a column."""

    def mean_of_column(table: "pd.DataFrame") -> Estimate:
        return mean(table, column)

    return mean_of_column


def _ap50_of(asked: str, detections: "pd.DataFrame") -> Statistic:
    """AP50 of the detections of one kind of phrase, on the objects of the table."""
    found = detections
    if len(detections):
        found = detections[detections.asked == asked]

    def ap50(wanted: "pd.DataFrame") -> Estimate:
        of_suites = found
        if len(found):
            of_suites = found[found.suite.isin(wanted.suite.unique())]
        return precision(of_suites, wanted)

    return ap50


def _estimate_by_suite(
    names: Sequence[str], table: "pd.DataFrame", statistic: Statistic
) -> dict[str, Estimate]:
    """A statistic of the rows of each suite, and of all rows; NONE where there are no rows."""
    cells = {}
    for name in [*names, ALL]:
        rows = _of_suite(table, name)
        cells[name] = NONE
        if len(rows):
            cells[name] = statistic(rows)
    return cells


def _of_suite(table: "pd.DataFrame", name: str) -> "pd.DataFrame":
    """The rows of a suite; every row for ALL."""
    if name == ALL or not len(table):
        return table
    return table[table.suite == name]


def _suite_names(views: "pd.DataFrame") -> list[str]:
    """The suites of a table in their usual order."""
    names = []
    for name in suites.BENCHMARKS:
        if (views.suite == name).any():
            names.append(name)
    return names


def _counting_views(table: "pd.DataFrame") -> "pd.DataFrame":
    """The rows of views that count: the others have no figures of the target."""
    if "counts" not in table.columns:
        return table
    return table[table.counts]


def _usual_choices(choices: "pd.DataFrame") -> "pd.DataFrame":
    """The choices by USUAL_K references and vote."""
    return choices[(choices.k == USUAL_K) & (choices.rule == "vote")]


def _target_tracks(tables: SurveyTables, hidden: int) -> "pd.DataFrame":
    """The tracks of targets that were hidden for so many frames."""
    tracks = _counting_views(tables["tracks"])
    if len(tracks):
        tracks = tracks[tracks.target]
    if len(tracks):
        tracks = tracks[tracks.hidden == hidden]
    return tracks


def _of_kind(tracks: "pd.DataFrame", kind: str) -> "pd.DataFrame":
    """The tracks behind one kind of occluder."""
    if not len(tracks):
        return tracks
    return tracks[tracks.kind == kind]


def _where_proposed(choices: "pd.DataFrame", views: "pd.DataFrame") -> "pd.DataFrame":
    """The choices of the views in which the target was proposed."""
    key = ["suite", "task", "episode", "camera"]
    with_views = choices.merge(views[[*key, "proposed"]], on=key)
    return with_views.query("proposed == True")


def _summarize_cells(cells: Mapping[str, Estimate]) -> dict[str, dict[str, float] | None]:
    """The estimates as JSON; None without cases."""
    summaries: dict[str, dict[str, float] | None] = {}
    for name, estimate in cells.items():
        summaries[name] = None
        if estimate.n:
            summaries[name] = {
                "value": estimate.value,
                "low": estimate.low,
                "high": estimate.high,
                "n": estimate.n,
            }
    return summaries


def _measure_rows(found: Sequence[Measure]) -> list[list[str]]:
    """Head, the measures with a target, an empty row, and the measures without."""
    head = ["measure, %", "target", *found[0].cells, "verdict"]
    with_target = []
    without_target = []
    for measure in found:
        if measure.target:
            with_target.append(measure.row())
        else:
            without_target.append(measure.row())
    return [head, *with_target, [""] * len(head), *without_target]


def _text_of_views_without_target(views: "pd.DataFrame", cells: Cells) -> str:
    """How many views of each suite do not count."""
    texts = []
    for name in cells:
        if name != ALL:
            part = views[views.suite == name]
            n_left_out = int((~part.counts).sum())
            texts.append(f"{name} {n_left_out} of {len(part)}")
    return ", ".join(texts)


def _share_of_cut_photos(references: "pd.DataFrame") -> Estimate:
    """The share of reference photos that the detector cut; `whole` counts the others."""
    cut: list[bool] = []
    for row in references.itertuples():
        cut += [False] * row.whole + [True] * (row.k - row.whole)
    return share(cut)


def _rows_by_k(choices: "pd.DataFrame", cells: Cells) -> list[list[str]]:
    """Head and a row per number of references and rule: right instances by suite."""
    rows = [["right instance, %", *cells]]
    for k in KS:
        for rule in RULES:
            part = choices[(choices.k == k) & (choices.rule == rule)]
            row = [f"K = {k}, {rule}"]
            for name in cells:
                of_suite = part
                if name != ALL:
                    of_suite = part[part.suite == name]
                row.append(share(of_suite.right).text())
            rows.append(row)
    return rows


def _rows_by_association(agreements: "pd.DataFrame") -> list[list[str]]:
    """Head and a row per suite and way to associate.

    What the views of an episode highlight together, and in how many views it is the target.
    """
    rows = [["views associated, % of episodes", "by", *CASES, "% of views right"]]
    for (suite, way), part in agreements.groupby(["suite", "associate"], sort=False):
        row = [str(suite), str(way)]
        for case in CASES:
            row.append(share(part.case == case).text())
        right: list[bool] = []
        for episode in part.itertuples():
            right += [True] * episode.right + [False] * (episode.views - episode.right)
        row.append(share(right).text())
        rows.append(row)
    return rows


def _rows_by_camera(tables: SurveyTables) -> list[list[str]]:
    """Head and a row per suite and camera."""
    head = ["by camera, %", "views", "recall@10", "AP50"]
    head += ["right, standard", "right, hard", "mask IoU"]
    rows = [head]
    cameras = tables["views"][["suite", "camera"]].drop_duplicates()
    for suite, camera in cameras.itertuples(index=False, name=None):
        views = _of_camera(tables["views"], suite, camera)
        objects = _of_camera(tables["objects"], suite, camera)
        detections = _of_camera(tables["detections"], suite, camera)
        choices = _usual_choices(_of_camera(tables["choices"], suite, camera))
        ap50 = precision(detections[detections.asked == "category"], objects)
        n_views = int(views.counts.sum())
        row = [f"{suite} {camera}", str(n_views)]
        row.append(share(objects.recalled).text())
        row.append(ap50.text())
        for tier in TIERS:
            of_tier = choices[choices.tier == tier]
            row.append(share(of_tier.right).text())
        row.append(mean(choices, "mask_iou").text())
        rows.append(row)
    return rows


def _of_camera(table: "pd.DataFrame", suite: str, camera: str) -> "pd.DataFrame":
    return table[(table.suite == suite) & (table.camera == camera)]


def _speed_rows(speed: "pd.DataFrame") -> list[list[str]]:
    """Head and a row per piece of work, with its ratio to each that has no budget of its own."""
    others_ms = {}
    for work in speed.itertuples():
        if work.what not in LIMITS_MS:
            others_ms[str(work.what)] = float(work.ms)
    head = ["one thread, 224 px view", "ms (quartiles)", "budget"]
    for name in others_ms:
        head.append(f"x {name}")
    head.append("verdict")
    rows = [head]
    for work in speed.itertuples():
        limit_ms = LIMITS_MS.get(work.what)
        row = [
            f"{work.what}, {work.rounds} rounds",
            f"{work.ms:.1f} ({work.low_ms:.1f}, {work.high_ms:.1f})",
            f"<= {limit_ms:g}" if limit_ms else "",
        ]
        for ms in others_ms.values():
            row.append(f"{work.ms / ms:.2f}")
        row.append(_verdict_on_time(work.ms, limit_ms))
        rows.append(row)
    return rows


def _verdict_on_time(ms: float, limit_ms: float | None) -> str:
    if limit_ms is None:
        return ""
    if ms <= limit_ms:
        return "met"
    return "short"
