"""Learns the token of every personal object from few or many photos, and measures it as it grows.

A job is one training: of one task's target, from so many photos, in the vision-language model or
in the policy's own weights. Afterwards a token that was learned in the model is read by the policy,
copied as it is and rotated into the policy's space, and the model chooses by it among the objects
of listed episodes. What a killed run had finished is found again.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadOutput, BadStudy, one_of
from vap_core.base.files import write_atomic, writing
from vap_core.base.parquet import read_parquet
from vap_core.base.types import Rgb
from vap_core.evaluation import measurements, store
from vap_core.evaluation.policy_names import shipped
from vap_core.evaluation.processes import results
from vap_core.evaluation.study import Study
from vap_core.evaluation.tokens import choices
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.mini_pi0 import teach_token
from vap_core.policies.mini_pi0.learned_token import Photos, TokenTraining, lessons, recognized
from vap_core.policies.mini_pi0.token_alignment import align
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.policies.mini_pi0.vlm import MiniVlm

CALLER = "measure tokens"
KS = (1, 3, 5, 7)
"""Numbers of photos to learn from."""
USUAL_K = teach_token.K
SHARES = (0.05, 0.15, 0.3, 0.5, 1.0)
"""Shares of a training after which the token is measured, besides before its first step."""
OTHER = "other objects"
TABLES = ("answers", "embeddings", "choices")
"""Kinds of parts: photos to which the answer was yes; what was learned; scores of the objects of
episodes."""
TRAINING = ["suite", "task", "k", "learned_in", "epochs"]
"""The columns that name one training."""
NOT_KEY = ("yes", "n", "embedding", "views", "score")
Place = Literal["vlm", "policy"]
PLACES: tuple[Place, ...] = ("vlm", "policy")
"""Where a token is learned: in the model, or in the policy's own weights."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Tokens:
    """What is asked for: the suites, numbers of photos, epochs of a training, and where.

    Raises: UnknownName for a place that is none of PLACES, or a suite that is no benchmark;
        BadStudy for a suite for which no mini-pi0 ships.
    """

    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    ks: tuple[int, ...] = KS
    epochs: int = TokenTraining().epochs
    places: tuple[str, ...] = PLACES

    def __post_init__(self) -> None:
        for place in self.places:
            if place not in PLACES:
                raise one_of("measure tokens: --learn-in", place, PLACES)
        for name in self.suites:
            if name not in suites.BENCHMARKS:
                raise one_of("measure tokens: suite", name, suites.BENCHMARKS)
            if not shipped(name).is_dir():
                raise BadStudy(
                    f"measure tokens: no mini-pi0 for {name} ships; run: python -m vap_core train "
                    f"policy --suite {name}"
                )

    def configuration(self) -> dict[str, Any]:
        """What the results depend on, as JSON; suites and numbers of photos may be added to.

        Raises: BadPolicy for a shipped policy or model that is absent or damaged; BadSuite,
            MissingWeights, as `Study.configuration`.
        """
        policies = {name: fingerprint(shipped(name)) for name in suites.BENCHMARKS}
        models = {name: _model(_model_folder(name)).sha256() for name in suites.BENCHMARKS}
        tasks = suites.tasks_of(suites.BENCHMARKS)
        shown = Study(tasks=tasks, methods=("generic",), policy="expert").configuration()
        return {
            "survey": "tokens",
            "epochs": self.epochs,
            "views": teach_token.VIEWS,
            "vlms": models,
            "policies": policies,
            **{name: shown[name] for name in ("version", "lists", "world")},
        }


@dataclass(frozen=True)
class Job:
    """One training: `where` the token is learned, from `k` photos."""

    suite: str
    task: str
    k: int
    where: Place
    epochs: int

    @property
    def name(self) -> str:
        return f"{self.suite}.{self.task}.{self.where}.{self.k}"


def plan(asked: Tokens) -> list[Job]:
    """Every job: the usual number of photos of every object first."""
    jobs = []
    usual = [k for k in asked.ks if k == USUAL_K]
    for ks in (usual, [k for k in asked.ks if k != USUAL_K]):
        for suite in asked.suites:
            for task in suites.suite(suite).tasks:
                for k in ks:
                    for place in PLACES:
                        if place in asked.places and (place == "vlm" or k == USUAL_K):
                            jobs.append(Job(suite, task.name, k, place, asked.epochs))
    return jobs


def run_job(job: Job) -> dict[str, list[Row]]:
    """Learn one token, and return the rows of every table.

    Raises: BadPolicy for a shipped policy or model that is absent or damaged; BadMemory when a kind
        of photo is missing; BadSuite for a damaged list.
    """
    from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused_attention

    target = suites.rows(job.suite, job.task, 1)[0].target
    taught = _photos(job.suite, job.task, 0, job.k)
    shown = _shown(job.suite, job.task)
    policy_folder, model_folder = shipped(job.suite), _model_folder(job.suite)
    teacher = _model(model_folder) if job.where == "vlm" else _policy_model(job.suite)
    training = TokenTraining(epochs=job.epochs)
    about = {"suite": job.suite, "task": job.task, "object": target, "k": job.k}
    about |= {"learned_in": job.where, "epochs": job.epochs}
    answers: list[Row] = []
    chosen: list[Row] = []
    with fused_attention():
        measured = _measured_epochs(job.epochs)
        for epoch, (step, embedding) in enumerate(lessons(teacher, target, taught, training)):
            if epoch in measured:
                where = {**about, "step": step, "token": "as learned", "read_by": job.where}
                answers += _answers(where, teacher, embedding, shown)
        where = {**about, "token": "as learned", "read_by": job.where}
        scenes = choices.scenes(job.suite, job.task)
        for name, part in (
            (choices.SCENE, scenes),
            (choices.PHOTO, choices.in_photos(scenes, shown)),
        ):
            chosen += choices.scores({**where, "seen_in": name}, teacher, embedding, part)
        if job.where == "vlm":
            reader = _policy_model(job.suite)
            aligned = align(embedding, model_folder, policy_folder)
            for token, read in (("copied", embedding), ("aligned", aligned)):
                where = {**about, "step": step, "token": token, "read_by": "policy"}
                answers += _answers(where, reader, read, shown)
    learned = {**about, "step": step, "embedding": embedding.tolist()}
    return {"answers": answers, "embeddings": [learned], "choices": chosen}


def run(
    asked: Tokens, folder: Path, *, workers: int = 1, progress: bool = True
) -> "dict[str, pd.DataFrame]":
    """Do what `folder` lacks, and return the tables.

    Raises: BadOutput when the folder holds another run, is in use or cannot be written; BadStudy
        when nothing is asked for; WorkerDied.
    """
    from tqdm import tqdm

    jobs = plan(asked)
    if not jobs:
        raise BadStudy(
            f"measure tokens: in the policy a token is learned from {USUAL_K} photos alone; ask "
            f"for --k {USUAL_K}, or for --learn-in vlm."
        )
    store.open_run(folder, asked.configuration())
    with store.locked(folder):
        done = folder / "done"
        with writing(folder, CALLER):
            done.mkdir(exist_ok=True)
        missing = [job for job in jobs if not _is_done(folder, job)]
        with tqdm(
            total=len(jobs),
            initial=len(jobs) - len(missing),
            unit="token",
            disable=not progress,
        ) as bar:
            for job, tables in results(run_job, missing, workers=workers, remedy="--workers"):
                parts = []
                for name, rows in tables.items():
                    part = store.write_part(folder, name, rows, caller=CALLER)
                    parts.append(f"{part.relative_to(folder)}\n")
                with writing(folder, CALLER):
                    write_atomic(done / job.name, "".join(parts).encode())
                bar.update()
    return read(folder)


def _is_done(folder: Path, job: Job) -> bool:
    """Whether a training has ended and every part that it wrote is still there.

    It wrote some: a file that names none was not written to its end.
    """
    try:
        parts = (folder / "done" / job.name).read_text().splitlines()
    except OSError:
        return False
    return bool(parts) and all((folder / part).exists() for part in parts)


def read(folder: Path) -> "dict[str, pd.DataFrame]":
    """The tables of a run, as far as it is. Raises: BadOutput."""
    import pandas as pd

    tables = {}
    for name in TABLES:
        parts = []
        for path in sorted((folder / name).glob("*.parquet")):
            remedy = "delete it and run the same command again"
            parts.append(read_parquet(path, "measure tokens", remedy))
        if not parts:
            raise BadOutput(
                f"measure tokens: {folder} holds no {name}; run the same command again to finish "
                "it."
            )
        whole = pd.concat(parts, ignore_index=True)
        key = [column for column in whole.columns if column not in NOT_KEY]
        # A run that was killed between two files has written one of them twice.
        whole = whole.drop_duplicates(key, ignore_index=True)
        tables[name] = whole.sort_values(key, ignore_index=True)
    return tables


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables in `to` as token_NAME.parquet, with the configurations of their runs.

    Trainings that `to` holds and the run does not stay there. Raises: BadOutput.
    """
    manifest = store.read_manifest(folder)
    tables = {}
    for name, table in read(folder).items():
        path = to / f"token_{name}.parquet"
        tables[path.name] = measurements.add_rows(path, table, TRAINING, {b"runs": manifest})
    return measurements.publish_tables(tables, to, caller="measure tokens")


def _measured_epochs(epochs: int) -> set[int]:
    """After how many epochs a token is measured."""
    return {0, *(max(1, round(share * epochs)) for share in SHARES)}


def _answers(
    about: Row,
    reader: "MiniVlm",
    embedding: Float32[np.ndarray, " d"],
    shown: Mapping[str, Sequence[Rgb]],
) -> Iterator[Row]:
    """A row per object of the photos: to how many of them the reader says yes."""
    for name, photos in shown.items():
        yes = recognized(reader, embedding, photos)
        yield {**about, "shown": name, "yes": int(yes.sum()), "n": len(yes)}


@lru_cache(maxsize=4)
def _negatives(
    suite: str, task: str, seed: int
) -> tuple[dict[str, tuple[Rgb, ...]], tuple[Rgb, ...]]:
    """Photos of every look-alike of a task's target, and of other objects."""
    rows = suites.rows(suite, task)
    rivals = {}
    for name in teach_token.lookalikes(rows):
        rivals[name] = tuple(reference_views(get_object(name), teach_token.VIEWS, seed))
    return rivals, teach_token.other_objects(rows, seed)


def _photos(suite: str, task: str, seed: int, k: int) -> Photos:
    """What teach_token.photographs takes, with the negatives rendered once."""
    target = get_object(suites.rows(suite, task, 1)[0].target)
    rivals, others = _negatives(suite, task, seed)
    photos: list[Rgb] = []
    for views in rivals.values():
        photos += views
    return Photos(tuple(reference_views(target, k, seed)), tuple(photos), others)


def _shown(suite: str, task: str) -> dict[str, Sequence[Rgb]]:
    """Photos that no training saw, by the object that they show; the target's first."""
    photos = _photos(suite, task, 1, teach_token.VIEWS)
    target = suites.rows(suite, task, 1)[0].target
    rivals, others = _negatives(suite, task, 1)
    return {target: photos.own, **rivals, OTHER: others}


def _model_folder(suite: str) -> Path:
    """The shipped model that a suite's policy grew from."""
    return teach_token.model_of_policy(shipped(suite))


@lru_cache(maxsize=2)
def _model(folder: Path) -> "MiniVlm":
    from vap_core.policies.mini_pi0.vlm import load_vlm

    return load_vlm(folder)


@lru_cache(maxsize=1)
def _policy_model(suite: str) -> "MiniVlm":
    from vap_core.policies.mini_pi0.vlm import load_from_policy

    return load_from_policy(shipped(suite))
