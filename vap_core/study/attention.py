"""Where a policy looks: episodes of a run again with the attention observed, measured call by call.

The same row, weights and seed give the same episode; observing changes no action. What a killed
command had finished is found again in its folder. The simulator's masks say what every patch shows;
the chance level of a share is the area, which even attention would have.

A replay is four tables: `episodes`; `calls`, a row per call of the policy, camera and query;
`layers`, one per query, layer and head over the calls before the first touch; `causal`, one per
explained call, measure and query.
"""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.stats import spearmanr

from vap_core.base.errors import BadOutput, BadStudy
from vap_core.base.files import code_version, parse_json, read_parquet, write_atomic, writing
from vap_core.policies.lerobot.adapter import LeRobot
from vap_core.policies.lerobot.attribution import gradient_maps, masking_maps
from vap_core.policies.protocol import PolicyInput, heat_map
from vap_core.rollout.calls import CATEGORY, COLOUR, QUERIES, TOKEN
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import EpisodeHeader, Frame
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.types import EpisodeRow, Outcome, Truth
from vap_core.study import store
from vap_core.study.engine import BATCH, spread_evenly
from vap_core.study.failures import listed_row, note_changed, study_of
from vap_core.study.methods import needs_token
from vap_core.study.results import read_runs
from vap_core.study.stats import layout_name
from vap_core.study.trials import Study, make_trial, register_personal
from vap_core.study.workers import prepare, results

if TYPE_CHECKING:
    import pandas as pd

TARGET, LOOKALIKES, HAND, GOAL, BACKGROUND = "target", "lookalikes", "hand", "goal", "background"
REGIONS = (TARGET, LOOKALIKES, HAND, GOAL, BACKGROUND)
"""Background is all else: table, arm and other objects."""
WORDS = (TOKEN, COLOUR, CATEGORY)
"""The queries that are words, in the order in which one of them means the target."""
NOTHING = "nothing"
"""The first touch of an episode that touches nothing."""
TABLES = ("episodes", "calls", "layers", "causal")
ERRORS = "errors"
"""Beside the tables in a part: the episodes that ended in an error, and its last line."""
PREFIX = "attention_"
ABOUT = b"attention"
"""Where the tables keep the runs and the code that they are of."""
PARTS = ("suite", "task", "method", "episode")
"""What names an episode, with slashes between; that of another seed has the seed at its end."""
Heat = Float32[np.ndarray, "rows columns"]
Areas = Mapping[str, Heat]
"""The share of every patch that a region covers; the regions of a patch sum to 1."""
Rows = list[dict[str, Any]]


def kind_of(name: str, row: EpisodeRow) -> str:
    """The region that an object belongs to. Raises: UnknownName, BadObject, as `get_object`."""
    if name in (row.target, row.goal):
        return TARGET if name == row.target else GOAL
    return LOOKALIKES if get_object(name).category == row.category else BACKGROUND


def patch_areas(row: EpisodeRow, truth: Truth, camera: str, side: int) -> Areas:
    """The share of every patch of a view that each region covers. Raises: as `kind_of`."""

    def covered(mask: np.ndarray) -> Heat:
        return cv2.resize(mask.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)

    areas: dict[str, np.ndarray] = {
        region: np.zeros((side, side), np.float32) for region in REGIONS
    }
    for name, mask in truth.masks[camera].items():
        areas[kind_of(name, row)] += covered(mask)
    areas[HAND] = covered(truth.hand[camera])
    known = sum(areas[region] for region in REGIONS[:-1])
    areas[BACKGROUND] = np.clip(1 - known, 0, 1).astype(np.float32)
    return areas


def measure(heat: Heat, areas: Areas) -> dict[str, float | int | str | bool]:
    """The measures of one map of one view.

    `side` is the number of patches along an edge, `mass` the attention to the whole view.
    `share_<region>` is the part of it inside a region, `chance_<region>` the region's area. `peak`
    is the attention of the most attended patch, of which `peak_region` is what covers most, things
    before background. `hit` says whether the patch shows any of the target (pointing game),
    `chance_hit` is the share of patches that do. `entropy` is 1 where all patches are attended to
    alike, and 0 where only one is.
    """
    mass = float(heat.sum())
    spread = heat / max(mass, 1e-12)
    row, column = (int(i) for i in np.unravel_index(int(heat.argmax()), heat.shape))
    measures: dict[str, float | int | str | bool] = {"side": len(heat), "mass": mass}
    for region in REGIONS:
        measures[f"share_{region}"] = float((spread * areas[region]).sum())
        measures[f"chance_{region}"] = float(areas[region].mean())
    things = {region: float(areas[region][row, column]) for region in REGIONS[:-1]}
    largest = max(things, key=lambda region: things[region])
    positive = spread[spread > 0].astype(np.float64)
    return measures | {
        "peak": float(heat[row, column]),
        "peak_row": row,
        "peak_column": column,
        "peak_region": largest if things[largest] > 0 else BACKGROUND,
        "hit": things[TARGET] > 0,
        "chance_hit": float((areas[TARGET] > 0).mean()),
        "entropy": float(-(positive * np.log(positive)).sum() / np.log(spread.size)),
    }


def inside(
    weights: Float32[np.ndarray, "layers heads rows columns"], areas: Areas
) -> Float[np.ndarray, "layers heads 3"]:
    """Attention to the whole view, to the target and to the look-alikes, of every head."""
    parts = [(weights * areas[region]).sum((2, 3)) for region in (TARGET, LOOKALIKES)]
    return np.stack([weights.sum((2, 3)), *parts], axis=-1)


class Observer:
    """Measures one episode while it runs, as a sink of the rollout; `tables` is whole once closed.

    `explain` asks for the causal measures of the first call and of the last before the first touch.
    """

    def __init__(self, header: EpisodeHeader, policy: LeRobot, *, explain: bool = False) -> None:
        self.header, self.policy, self.explain = header, policy, explain
        self.tables: dict[str, Rows] = {"calls": [], "layers": [], "causal": []}
        self.first_touch: tuple[int, str] | None = None
        self._heads: dict[str, list[np.ndarray]] = {}
        self._chances: list[np.ndarray] = []
        self._explained: list[tuple[Frame, dict[str, Areas]]] = []

    def frame(self, frame: Frame) -> None:
        """Measure a control step in which the policy was called."""
        row = self.header.row
        if self.first_touch is None:
            touched = {kind_of(name, row): None for name in frame.truth.touched}
            touched.pop(GOAL, None)
            if touched:
                self.first_touch = (
                    frame.frame_index,
                    TARGET if TARGET in touched else next(iter(touched)),
                )
        areas = {}
        for camera, of_queries in frame.attention.items():
            side = next(iter(of_queries.values())).shape[-1]
            areas[camera] = patch_areas(row, frame.truth, camera, side)
            for query, weights in of_queries.items():
                where = {"step": frame.frame_index, "camera": camera, "query": query}
                found = measure(heat_map(weights, query), areas[camera])
                self.tables["calls"].append(where | found)
        if not areas or self.first_touch is not None:
            return
        chances = [[a[TARGET].mean(), a[LOOKALIKES].mean()] for a in areas.values()]
        self._chances.append(np.mean(chances, axis=0, dtype=float))
        for query in next(iter(frame.attention.values())):
            views = [inside(frame.attention[camera][query], areas[camera]) for camera in areas]
            self._heads.setdefault(query, []).append(sum(views[1:], views[0]))
        if self.explain:
            self._explained = [*self._explained[:1], (frame, areas)]

    def close(self, outcome: Outcome) -> None:
        """Finish the tables: heads are means over the calls before the first touch."""
        for query, calls in self._heads.items():
            total = np.stack(calls)
            shares = (total[..., 1:] / np.maximum(total[..., :1], 1e-12)).mean(0)
            mass = total[..., 0].mean(0)
            chance = np.mean(self._chances, axis=0)
            for layer, head in np.ndindex(*mass.shape):
                row = {"query": query, "layer": layer, "head": head, "calls": len(calls)}
                row["mass"] = float(mass[layer, head])
                for i, region in enumerate((TARGET, LOOKALIKES)):
                    row[f"share_{region}"] = float(shares[layer, head, i])
                    row[f"chance_{region}"] = float(chance[i])
                self.tables["layers"].append(row)
        for frame, areas in self._explained:
            self._explain_call(frame, areas)
        self._explained = []

    def _explain_call(self, frame: Frame, areas: dict[str, Areas]) -> None:
        """Compare the attention of a call with the two causal measures of the same call."""
        header = self.header
        rng = np.random.default_rng([header.row.seed, header.row.episode])
        state = self.policy.start(rng)  # as the loop starts it
        seen = PolicyInput(frame.prompted, header.rewritten, frame.state)
        found = {
            "gradient": gradient_maps(self.policy, state, seen),
            "masking": masking_maps(self.policy, state, seen),
        }
        for query in next(iter(frame.attention.values())):
            found[query] = {c: heat_map(of[query], query) for c, of in frame.attention.items()}
        maps = {name: np.stack([of[c] for c in areas]) for name, of in found.items()}
        regions = {name: np.stack([a[name] for a in areas.values()]) for name in REGIONS}
        for name, heat in maps.items():
            row = {"step": frame.frame_index, "measure": name}
            for region, area in regions.items():
                row[f"share_{region}"] = float((heat * area).sum() / max(float(heat.sum()), 1e-12))
                row[f"chance_{region}"] = float(area.mean())
                if region == TARGET:
                    row["hit"] = bool(area.flat[int(heat.argmax())] > 0)
                    row["chance_hit"] = float((area > 0).mean())
            for causal in ("gradient", "masking"):
                even = np.ptp(heat) == 0 or np.ptp(maps[causal]) == 0
                rank = 0.0 if even else spearmanr(heat.ravel(), maps[causal].ravel()).statistic
                row[f"rank_{causal}"] = float(rank)
            self.tables["causal"].append(row)


@dataclass(frozen=True)
class Job:
    """Some episodes of one task, variant and method; its name is its file's.

    `known` is how they ended in the run: outcome and steps. `explained` of them get the causal
    measures.
    """

    name: str
    study: Study
    method: str
    rows: tuple[EpisodeRow, ...]
    known: tuple[tuple[str, int], ...]
    policy: str
    memory: Path
    explained: tuple[bool, ...]


@dataclass(frozen=True)
class Wanted:
    """Which episodes of a run: of these suites and methods (none named: all), of policies whose
    label holds `policy`, so many a task and method.

    `explain` of them get the causal measures, which take as long as many calls.
    """

    suites: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    policy: str = ""
    episodes: int | None = None
    explain: int = 2


def run_replay(
    source: Path, folder: Path, wanted: Wanted, *, workers: int = 2, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks, write a parquet table each and return them.

    `source` is a run's folder or a published table.

    Raises: BadOutput, BadStudy when nothing is left of what is asked for, when it was run with
        weights that are not here, or when no call of the policy was observed.
    """
    from tqdm import tqdm

    jobs = plan(source, folder / "memory", wanted)
    with writing(folder, "attention", "choose another folder with --out"):
        (folder / "parts").mkdir(parents=True, exist_ok=True)
    with store.locked(folder):
        paths = {job.name: folder / "parts" / f"{job.name}.json" for job in jobs}
        missing = [job for job in jobs if not paths[job.name].exists()]
        prepare(("vap_core.study.attention", "lerobot.policies"))
        n, left = (sum(len(job.rows) for job in each) for each in (jobs, missing))
        with tqdm(
            total=n, initial=n - left, unit="episode", desc="attention", disable=not progress
        ) as bar:
            # Tokens take a minute each: what needs none comes first, and is kept.
            for learns in (False, True):
                group = [job for job in missing if needs_token(job.method) == learns]
                for study in dict.fromkeys(job.study for job in group):
                    register_personal(study, folder / "memory")
                for job, rows in results(run_job, group, workers=workers, remedy="--workers"):
                    store.write_json_part(paths[job.name], rows, caller="attention")
                    bar.update(len(job.rows))
        return write_tables(source, folder, list(paths.values()))


def plan(source: Path, memory: Path, wanted: Wanted) -> list[Job]:
    """The jobs of the wanted episodes of a run. Raises: BadOutput, BadStudy."""
    jobs: list[Job] = []
    policies: dict[Any, set[str]] = {}
    for manifest, episodes in read_runs(source):
        asked = episodes["outcome"] != "error"
        asked &= episodes["policy"].str.contains(wanted.policy, regex=False)
        for column, values in (("suite", wanted.suites), ("method", wanted.methods)):
            asked &= episodes[column].isin(values) | (not values)
        for key, group in episodes[asked].groupby(["suite", "task", "method"], sort=False):
            lines = group.sort_values(["seed", "episode"]).to_dict("records")
            if wanted.episodes is not None:
                lines = spread_evenly(lines, wanted.episodes)
            jobs += _jobs_of(manifest, lines, memory, wanted.explain)
            policies.setdefault(key, set()).update(str(line["policy"]) for line in lines)
    if not jobs:
        raise BadStudy(
            f"attention: {source} holds no episode of what was asked for; leave --suite, --method "
            "or --policy out."
        )
    for names in policies.values():
        if len(names) > 1:
            raise BadStudy(
                f"attention: {source} holds episodes of one task and method by "
                f"{' and '.join(sorted(names))}; choose one with --policy."
            )
    return jobs


def _jobs_of(
    manifest: dict[str, Any], lines: Sequence[dict[str, Any]], memory: Path, explain: int
) -> Iterator[Job]:
    """The jobs of some episodes of one task and method.

    Raises: BadStudy for sub-goals, whose targets change on the way.
    """
    study = study_of(manifest, lines[0])
    method, policy = str(lines[0]["method"]), str(lines[0]["policy"])
    chosen = [id(line) for line in spread_evenly(lines, explain)] if explain else []
    by_variant: dict[str, list[dict[str, Any]]] = {}
    for line in lines:
        by_variant.setdefault(str(line["variant"]), []).append(line)
    for same in by_variant.values():
        for first in range(0, len(same), BATCH):
            batch = same[first : first + BATCH]
            rows = tuple(listed_row(study, line) for line in batch)
            if rows[0].subgoals:
                raise BadStudy(
                    f"attention: episodes of {rows[0].suite} in this run have sub-goals, and what "
                    "is measured here is one target's; choose other suites with --suite."
                )
            explained = tuple(id(line) in chosen for line in batch)
            what = {
                "run": manifest["digest"],
                "rows": [(row.task, row.seed, row.episode) for row in rows],
                "explained": explained,
                "method": method,
            }
            name = f"{rows[0].suite}.{rows[0].task}.{method}.{store.digest(what)}"
            known = tuple((str(line["outcome"]), int(line["steps"])) for line in batch)
            yield Job(name, study, method, rows, known, policy, memory, explained)


def run_job(job: Job) -> dict[str, Rows]:
    """Run the episodes of one job in this process, and return its part of the tables.

    Raises: BadStudy for a policy without attention maps, or one that has changed since.
    """
    trial = make_trial(job.study, job.rows, job.method, job.memory)
    policy: Any = trial.policy
    check_policy(policy, job.policy)
    keys = [(row.key, row.seed) for row in job.rows]
    explained = dict(zip(keys, job.explained, strict=True))
    observers: dict[tuple[str, int], Observer] = {}

    def observe(header: EpisodeHeader) -> Observer:
        key = header.row.key, header.row.seed
        observers[key] = Observer(header, policy, explain=explained[key])
        return observers[key]

    found: dict[str, Rows] = {name: [] for name in (*TABLES, ERRORS)}
    episodes = rollout(replace(trial, attention=QUERIES), job.rows, observe, batch=BATCH)
    for key, episode, known in zip(keys, list(episodes), job.known, strict=True):
        # An episode that ended in an error before its first call has no observer.
        observer = observers.get(key) or Observer(episode.header, policy)
        row, outcome = episode.header.row, episode.outcome
        about = {name: getattr(row, name) for name in ("suite", "task", "seed", "episode")}
        about["method"] = job.method
        step, touched = observer.first_touch or (None, NOTHING)
        ending = {
            "policy": episode.header.policy,
            "layout": f"{row.task} {layout_name(row)}",
            "text": episode.header.rewritten,
            "outcome": outcome.status,
            "success": outcome.success,
            "steps": outcome.steps,
            "first_touch": step,
            "touched": touched,
            "margin": episode.summary()["margin"],
            "reproduced": (outcome.status, outcome.steps) == known,
        }
        for name, rows in {"episodes": [ending], **observer.tables}.items():
            found[name] += [about | each for each in rows]
        if outcome.status == "error":
            found[ERRORS].append({**about, "error": outcome.detail.strip().rpartition("\n")[2]})
    return found


def check_policy(policy: Any, label: str) -> None:
    """Raises: BadStudy for a policy without attention maps, or another than the run's `label`."""
    if not getattr(policy, "attends", False):
        raise BadStudy(
            f"attention: {policy.label} gives no attention maps, as pi0, pi0.5, mini-pi0 and "
            "smolvla do on square pictures; choose another run."
        )
    if policy.label != label:
        raise BadStudy(
            f"attention: this was run with {label}, and {policy.label} is here now; run eval again."
        )


def write_tables(source: Path, folder: Path, parts: Sequence[Path]) -> "dict[str, pd.DataFrame]":
    """All parts as one table of each kind, with the runs and the code in the metadata.

    Episodes that ended in an error are left out, and told: they are no failures of a policy.

    Raises: BadStudy when they hold no call.
    """
    rows: dict[str, Rows] = {name: [] for name in (*TABLES, ERRORS)}
    for path in parts:
        for name, part in store.read_json_part(path, caller="attention").items():
            rows[name] += part
    n, errors = len(rows["episodes"]), rows.pop(ERRORS)
    told = f"{len(errors)} ended in an error"
    if errors:
        error = errors[0]["error"]
        told += f", the first is {'/'.join(str(errors[0][p]) for p in PARTS)}: {error:.200}"
    gone = set(map(name_of, errors))
    for name, part in rows.items():
        rows[name] = [row for row in part if name_of(row) not in gone]
    if not rows["calls"]:
        raise BadStudy(
            f"attention: no call of the policy was observed in {n} episodes; {told}. Mend it, "
            f"delete {folder / 'parts'} and run the same command again."
        )
    if errors:
        print(
            f"attention: of {n} episodes {told}; left out. To run them again delete "
            f"{folder / 'parts'}.",
            file=sys.stderr,
        )
    measured = {row["suite"] for row in rows["episodes"]}
    write(folder, rows, [m for m, of in read_runs(source) if measured & set(of["suite"])])
    return read(folder)


def write(folder: Path, rows: Mapping[str, Sequence[Mapping[str, Any]]], runs: list[Any]) -> None:
    """Write the four tables of a replay of some runs: four digits, names as categories.

    Raises: BadOutput.
    """
    import pandas as pd
    import pyarrow as pa

    about = json.dumps([{"runs": runs, "code": code_version()}], sort_keys=True).encode()
    for name in TABLES:
        found = pd.DataFrame(rows[name])
        for column in found.columns:
            if found[column].dtype == "float64":
                found[column] = found[column].round(4).astype("float32")
            elif found[column].dtype == "int64":
                found[column] = found[column].astype("int32")
            elif found[column].dtype == object and column not in ("layout", "text"):
                found[column] = found[column].astype("category")
        table = pa.Table.from_pandas(found, preserve_index=False)
        data = store.encode_table(table.replace_schema_metadata({ABOUT: about}))
        with writing(folder, "attention"):
            write_atomic(folder / f"{PREFIX}{name}.parquet", data)


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables that were published in a folder. Raises: BadOutput."""
    tables = {}
    for name in TABLES:
        path = folder / f"{PREFIX}{name}.parquet"
        if not path.exists():
            raise BadOutput(
                f"attention: {path} is missing; make it: ./vap measure attention RUN "
                f"--publish {folder}"
            )
        tables[name] = read_parquet(path, "attention", "publish it again")
    return tables


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables of a finished replay in another folder.

    What that holds of the suites and methods of these episodes goes, also from a table to which
    the replay adds nothing; what it holds of others stays. Raises: BadOutput.
    """
    import pyarrow.parquet as pq

    found = read(folder)
    files = {}
    for name, table in found.items():
        file = f"{PREFIX}{name}.parquet"
        (about,) = parse_json((pq.read_schema(folder / file).metadata or {})[ABOUT])
        files[file] = store.add_rows(
            to / file, table, ["suite", "method"], {ABOUT: about}, replaced=found["episodes"]
        )
    return store.publish_tables(files, to, caller="attention")


def name_of(line: Mapping[str, Any]) -> str:
    """An episode's name, which `record` takes."""
    name = "/".join(str(line[part]) for part in PARTS)
    return f"{name}/{line['seed']}" if line["seed"] else name


class Clearest:
    """A sink that records, and keeps the step of the call whose map of a word has the highest peak.

    It is 0 where no word is in the instruction.
    """

    def __init__(self, recorder: Any) -> None:
        self.step, self._peak, self._recorder = 0, -1.0, recorder

    def frame(self, frame: Frame) -> None:
        for of_queries in frame.attention.values():
            for query in of_queries.keys() & set(WORDS):
                peak = float(heat_map(of_queries[query], query).max())
                if peak > self._peak:
                    self.step, self._peak = frame.frame_index, peak
        self._recorder.frame(frame)

    def close(self, outcome: Outcome) -> None:
        self._recorder.close(outcome)


def record(
    source: Path, name: str, folder: Path, memory: Path, policy: str = ""
) -> tuple[Path, int]:
    """Record the named episode of a run, run again, with the maps of every query, in `folder`.

    It is of the first policy whose label holds `policy`. Another ending than that of the run is
    noted.

    Returns: the recording, and the step of its clearest call.

    Raises: BadOutput for a folder that cannot be written; BadStudy for an episode that the run does
        not hold, or as `check_policy`.
    """
    from vap_core.recording import Recorder
    from vap_core.study.diagnosis import explain

    parts = name.split("/")
    if len(parts) not in (4, 5) or not all(map(str.isdecimal, parts[3:])):
        raise BadStudy(
            f"attention: --record {name}: give SUITE/TASK/METHOD/EPISODE, such as "
            "simpler-bridge/put-camera/soft/22."
        )
    wanted = [*parts[:3], *map(int, [*parts[3:], "0"][:2])]
    for manifest, episodes in read_runs(source):
        held = episodes["policy"].str.contains(policy, regex=False)
        for column, value in zip((*PARTS, "seed"), wanted, strict=True):
            held &= episodes[column] == value
        if held.any():
            line = episodes[held].iloc[0].to_dict()
            study = study_of(manifest, line)
            break
    else:
        raise BadStudy(f"attention: {source} holds no episode {name}; choose another of --record.")
    path = folder / f"{name.replace('/', '.')}.rrd"
    with writing(folder, "attention", "choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
    row = listed_row(study, line)
    register_personal(study, memory)
    trial = make_trial(study, [row], str(line["method"]), memory)
    check_policy(trial.policy, str(line["policy"]))
    path.unlink(missing_ok=True)
    sinks = []

    def observe(header: EpisodeHeader) -> Clearest:
        sinks.append(Clearest(Recorder(path, header, explain=explain)))
        return sinks[-1]

    (episode,) = rollout(replace(trial, attention=QUERIES), [row], observe, batch=1)
    note_changed("run again", episode.outcome.status, episode.outcome.steps, line)
    return path, sinks[0].step if sinks else 0
