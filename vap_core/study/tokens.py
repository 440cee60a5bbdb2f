"""Learns the token of every personal object from few or many photos, and measures it as it grows.

A job is one training: of one task's target, from so many photos, in the vision-language model or
in the policy's own weights. Afterwards a token that was learned in the model is read by the policy,
copied as it is and rotated into the policy's space, and the model chooses by it among the objects
of listed episodes, each cut out by its true mask. Every object has one learned token: intervals and
p values take objects, not episodes, as the independent units.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadStudy, one_of
from vap_core.base.types import Mask, Rgb, value
from vap_core.perception.boxes import mask_box
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import (
    Photos,
    TokenTraining,
    align,
    answers,
    lessons,
    recognized,
)
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views
from vap_core.study import measurement, store
from vap_core.study.engine import spread_evenly
from vap_core.study.measurement import Measurement, Row, Tables
from vap_core.study.perception import opening_views
from vap_core.study.stats import (
    Estimate,
    holm,
    rate,
    rates,
    resampled_mean,
    share_by,
    sign_flip,
    student,
)
from vap_core.study.table import printed
from vap_core.study.trials import Study, shipped

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.policies.mini_pi0.vlm import MiniVlm

KS = (1, 3, 5, 7)
"""Numbers of photos to learn from."""
USUAL_K = learned_token.K
SHARES = (0.05, 0.15, 0.3, 0.5, 1.0)
"""Shares of a training after which the token is measured, besides before its first step."""
OTHER = "other objects"
TABLES = ("answers", "embeddings", "choices")
"""Kinds of parts: photos to which the answer was yes; what was learned; scores of the objects of
episodes."""
TRAINING = ["suite", "task", "k", "learned_in", "epochs"]
"""The columns that name one training."""
Place = Literal["vlm", "policy"]
PLACES: tuple[Place, ...] = ("vlm", "policy")
"""Where a token is learned: in the model, or in the policy's own weights."""


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


@dataclass(frozen=True)
class Tokens(Measurement):
    """What is asked for: the suites, numbers of photos, epochs of a training, and where.

    Raises: UnknownName for a place that is none of PLACES, or a suite that is no benchmark;
        BadStudy for a suite for which no mini-pi0 ships.
    """

    suites: tuple[str, ...] = tuple(suites.BENCHMARKS)
    ks: tuple[int, ...] = KS
    epochs: int = TokenTraining().epochs
    places: tuple[str, ...] = PLACES
    caller: ClassVar[str] = "measure tokens"

    def __post_init__(self) -> None:
        known = {"place": PLACES, "suite": suites.BENCHMARKS}
        for what, named in (("place", self.places), ("suite", self.suites)):
            for name in named:
                if name not in known[what]:
                    raise one_of(f"measure tokens: {what}", name, known[what])
        for name in self.suites:
            if not shipped(name).is_dir():
                raise BadStudy(
                    f"measure tokens: no mini-pi0 for {name} ships; run: ./vap train "
                    f"policy --suite {name}"
                )

    def settings(self) -> dict[str, Any]:
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
            "views": learned_token.VIEWS,
            "vlms": models,
            "policies": policies,
            **{name: shown[name] for name in ("version", "lists", "world")},
        }

    def jobs(self) -> list[Job]:
        """Every job: the usual number of photos of every object first.

        Raises: BadStudy when nothing is asked for.
        """
        jobs = [
            Job(suite, task.name, k, place, self.epochs)
            for ks in ([k for k in self.ks if k == USUAL_K], [k for k in self.ks if k != USUAL_K])
            for suite in self.suites
            for task in suites.suite(suite).tasks
            for k in ks
            for place in PLACES
            if place in self.places and (place == "vlm" or k == USUAL_K)
        ]
        if not jobs:
            raise BadStudy(
                f"measure tokens: in the policy a token is learned from {USUAL_K} photos alone; "
                f"ask for --k {USUAL_K}."
            )
        return jobs

    def run(self, job: Job, folder: Path) -> Tables:
        """Learn one token, and return the rows of every table.

        Raises: BadPolicy for a shipped policy or model that is absent or damaged; BadMemory when a
            kind of photo is missing; BadSuite for a damaged list.
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
            measured = {0, *(max(1, round(share * job.epochs)) for share in SHARES)}
            for epoch, (step, embedding) in enumerate(lessons(teacher, target, taught, training)):
                if epoch in measured:
                    where = {**about, "step": step, "token": "as learned", "read_by": job.where}
                    answers += _answers(where, teacher, embedding, shown)
            where = {**about, "token": "as learned", "read_by": job.where}
            views = scenes(job.suite, job.task)
            for name, part in (
                (SCENE, views),
                (PHOTO, in_photos(views, shown)),
            ):
                chosen += scores({**where, "seen_in": name}, teacher, embedding, part)
            if job.where == "vlm":
                reader = _policy_model(job.suite)
                aligned = align(embedding, model_folder, policy_folder)
                for token, read in (("copied", embedding), ("aligned", aligned)):
                    where = {**about, "step": step, "token": token, "read_by": "policy"}
                    answers += _answers(where, reader, read, shown)
        learned = {**about, "step": step, "embedding": embedding.tolist()}
        return {"answers": answers, "embeddings": [learned], "choices": chosen}


def publish(folder: Path, to: Path) -> list[Path]:
    """Keep the tables in `to` as token_NAME.parquet, with the configurations of their runs.

    Trainings that `to` holds and the run does not stay there. Raises: BadOutput.
    """
    manifest = store.read_manifest(folder)
    tables = {}
    for name, table in measurement.read(folder, Tokens.caller, TABLES).items():
        path = to / f"token_{name}.parquet"
        tables[path.name] = store.add_rows(path, table, TRAINING, {b"runs": manifest})
    return store.publish_tables(tables, to, caller=Tokens.caller)


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
    rivals = {
        name: tuple(reference_views(get_object(name), learned_token.VIEWS, seed))
        for name in learned_token.lookalikes(rows)
    }
    return rivals, learned_token.other_objects(rows, seed)


def _photos(suite: str, task: str, seed: int, k: int) -> Photos:
    """What teach_token.photographs takes, with the negatives rendered once."""
    target = get_object(suites.rows(suite, task, 1)[0].target)
    rivals, others = _negatives(suite, task, seed)
    photos = tuple(view for views in rivals.values() for view in views)
    return Photos(tuple(reference_views(target, k, seed)), photos, others)


def _shown(suite: str, task: str) -> dict[str, Sequence[Rgb]]:
    """Photos that no training saw, by the object that they show; the target's first."""
    photos = _photos(suite, task, 1, learned_token.VIEWS)
    target = suites.rows(suite, task, 1)[0].target
    rivals, others = _negatives(suite, task, 1)
    return {target: photos.own, **rivals, OTHER: others}


def _model_folder(suite: str) -> Path:
    """The shipped model that a suite's policy grew from."""
    return learned_token.model_of_policy(shipped(suite))


@lru_cache(maxsize=2)
def _model(folder: Path) -> "MiniVlm":
    from vap_core.policies.mini_pi0.vlm import load_vlm

    return load_vlm(folder)


@lru_cache(maxsize=1)
def _policy_model(suite: str) -> "MiniVlm":
    from vap_core.policies.mini_pi0.vlm import load_from_policy

    return load_from_policy(shipped(suite))


EPISODES = 48
"""Episodes of a suite, spread evenly over its tasks."""
SIZE = 448
"""Pixels along the edges of a view, four times what a policy reads."""
FILL = 0.55
"""The object's share of a crop's edge, as in a reference photo."""
KEY = ["suite", "task", "episode"]
"""What names an episode of a list."""
SCENE, PHOTO = "scene", "photo"
"""What the objects are seen in: the column `seen_in`."""
IN_PHOTOS, IN_SCENE = "model, in photos", "model, in the scene"
AFTER_RIGHT = "soft, where the model is right"
AFTER_WRONG = "soft, where it is wrong"
"""Columns of `beside_policy` beside the methods."""
ALL_SUITES = "all suites"
OBJECTS = ("object",)
"""What tells independent units apart."""
TO_SCENE, TO_POLICY = "photo to scene", "scene to policy"
"""Steps at which an object is lost, the rows of `losses`."""


@value
class Scene:
    """An episode's objects of the target's category, each as its crops from the first views."""

    episode: int
    target: str
    crops: Mapping[str, tuple[Rgb, ...]]


def photo_crop(rgb: Rgb, mask: Mask) -> Rgb | None:
    """The square around an object of which it fills FILL; None where it is not in view.

    Beyond the view its edge is repeated.
    """
    box = mask_box(mask)
    if box is None:
        return None
    x0, y0, x1, y1 = box.tolist()
    side = max(8, round(max(x1 - x0, y1 - y0) / FILL))
    left = round((x0 + x1 - side) / 2)
    top = round((y0 + y1 - side) / 2)
    padded = cv2.copyMakeBorder(rgb, side, side, side, side, cv2.BORDER_REPLICATE)
    return padded[top + side : top + 2 * side, left + side : left + 2 * side].copy()


@lru_cache(maxsize=1)
def scenes(suite: str, task: str) -> tuple[Scene, ...]:
    """The first views of a task's share of EPISODES, cut into objects.

    Raises: UnknownName for a suite or a task that no registry holds; BadSuite for a damaged list.
    """
    n = max(1, EPISODES // len(suites.suite(suite).tasks))
    found = []
    for views in opening_views(spread_evenly(suites.rows(suite, task), n), SIZE):
        row = views[0].row
        crops: dict[str, list[Rgb]] = {}
        for view in views:
            for name, mask in view.visible().items():
                crop = photo_crop(view.rgb, mask)
                if get_object(name).category == row.category and crop is not None:
                    crops.setdefault(name, []).append(crop)
        kept = {name: tuple(pictures) for name, pictures in crops.items()}
        found.append(Scene(episode=row.episode, target=row.target, crops=kept))
    return tuple(found)


def in_photos(shown: Sequence[Scene], photos: Mapping[str, Sequence[Rgb]]) -> tuple[Scene, ...]:
    """The same episodes with as many unseen photos of every object in place of its crops.

    What the model chooses there and in the scene differs by what it sees, not by what it is asked.
    """

    def drawn(name: str, i: int, n: int) -> tuple[Rgb, ...]:
        return tuple(photos[name][j % len(photos[name])] for j in range(i * n, (i + 1) * n))

    return tuple(
        replace(
            scene, crops={name: drawn(name, i, len(crops)) for name, crops in scene.crops.items()}
        )
        for i, scene in enumerate(shown)
    )


def scores(
    about: Mapping[str, Any],
    reader: "MiniVlm",
    embedding: Float32[np.ndarray, " d"],
    shown: Sequence[Scene],
) -> Iterator[dict[str, Any]]:
    """A row per episode and object: by how much yes scores above no, as a mean over its views."""
    for scene in shown:
        for name, crops in scene.crops.items():
            score = float(answers(reader, embedding, crops).mean())
            where = {"episode": scene.episode, "shown": name, "views": len(crops)}
            yield {**about, **where, "score": score}


def chosen(table: "pd.DataFrame") -> "pd.DataFrame":
    """One row per episode: whether the highest score is the target's alone, and chance.

    `table` has the rows of `scores` of one reading and one training of each object's word. Episodes
    whose target no view shows count as wrong.

    Raises: BadStudy for rows of several trainings.
    """
    import pandas as pd

    if table.duplicated([*KEY, "object", "shown"]).any():
        raise BadStudy(
            "tokens: the rows are of several trainings of one word; choose one by k, epochs and "
            "the reading."
        )
    rows = []
    for key, group in table.groupby([*KEY, "object"], observed=True, sort=False):
        is_target = group["shown"] == group["object"]
        best = group["score"] == group["score"].max()
        line = dict(zip([*KEY, "object"], key, strict=True))
        line["right"] = bool(best[is_target].any() and best.sum() == 1)
        line["chance"] = float(is_target.any()) / len(group)
        rows.append(line)
    return pd.DataFrame(rows, columns=[*KEY, "object", "right", "chance"])


def beside_policy(
    table: "pd.DataFrame", episodes: "pd.DataFrame", methods: Sequence[str]
) -> "pd.DataFrame":
    """The model's choices, and what a policy touches first in the same episodes, by suite.

    `table` has the rows of `scores` of one reading, of SCENE and of PHOTO; `episodes` are those of
    a published table, whose methods are columns. A row per suite and, if there are several, one for
    ALL_SUITES; shares are `Estimate`s with intervals over objects. The last two columns are soft's
    first touches where the model's choice in the scene was right, and where it was not.
    """
    import pandas as pd

    first = episodes.pivot_table(
        index=KEY, columns="method", values="first_object_correct", aggfunc="first", observed=True
    )
    lines = {}
    for name, part in _parts(_chosen_twice(table).merge(first.reset_index(), on=KEY)):
        shares = {
            IN_PHOTOS: (part, "right_photo"),
            IN_SCENE: (part, "right"),
            **{method: (part, method) for method in methods},
            AFTER_RIGHT: (part[part["right"]], "soft"),
            AFTER_WRONG: (part[~part["right"]], "soft"),
        }
        lines[name] = {
            "chance": float(part["chance"].mean()),
            **{title: share_by(*of, OBJECTS) for title, of in shares.items()},
        }
    return pd.DataFrame(lines).T


def _chosen_twice(table: "pd.DataFrame") -> "pd.DataFrame":
    """`chosen` of the scene, with `right_photo` of the photos."""
    photo = chosen(table[table["seen_in"] == PHOTO])[[*KEY, "right"]]
    return chosen(table[table["seen_in"] == SCENE]).merge(photo, on=KEY, suffixes=("", "_photo"))


def losses(table: "pd.DataFrame", episodes: "pd.DataFrame") -> "pd.DataFrame":
    """What is lost at TO_SCENE and at TO_POLICY, by suite.

    `table` and `episodes` are `beside_policy`'s. A row per step and suite, and one for ALL_SUITES
    if there are several: `loss` is an `Estimate` over `objects`, `p` the exact test that an object
    is as likely to win as to lose (`sign_flip`), `p_holm` is `p` corrected for the suites of a
    step; that of ALL_SUITES is `p`.
    """
    import pandas as pd

    rows = []
    both = _chosen_twice(table)
    soft = episodes[episodes["method"] == "soft"][[*KEY, "first_object_correct"]]
    steps = (
        (TO_SCENE, both, "right_photo", "right"),
        (TO_POLICY, both.merge(soft, on=KEY), "right", "first_object_correct"),
    )
    for step, of_step, before, after in steps:
        gains = of_step.assign(gain=of_step[before].astype(float) - of_step[after].astype(float))
        for suite, part in _parts(gains):
            grouped = part.groupby(["suite", "object"], sort=True, observed=True)["gain"]
            by_object = grouped.agg(["sum", "size"])
            p = sign_flip(by_object["sum"].to_numpy(float))
            line = {"step": step, "suite": suite, "objects": len(by_object)}
            rows.append({**line, "loss": resampled_mean(by_object), "p": p, "p_holm": p})
    found = pd.DataFrame(rows)
    for index in found[found["suite"] != ALL_SUITES].groupby("step").groups.values():
        found.loc[index, "p_holm"] = holm(found.loc[index, "p"])
    return found.set_index(["step", "suite"])


def _parts(joined: "pd.DataFrame") -> "list[tuple[str, pd.DataFrame]]":
    """The episodes of each suite; all of them at the end where there are several suites."""
    parts = [(str(name), part) for name, part in joined.groupby("suite", sort=False)]
    if len(parts) > 1:
        parts.append((ALL_SUITES, joined))
    return parts


KINDS = ("own", "look-alikes", "other objects")
READINGS = {
    "as learned": ("vlm", "as learned", "vlm"),
    "copied into the policy": ("vlm", "copied", "policy"),
    "rotated into the policy": ("vlm", "aligned", "policy"),
    "learned in the policy": ("policy", "as learned", "policy"),
}
"""Where a token is learned, which form of it is read, and by whom."""
NOTE = (
    "yes, % of photos that no training saw [95 % Wilson interval] n; right: as many photos of the "
    "object as of others, each kind with half of the weight (no interval: it is of two rates). The "
    "paper asks for more than 95 % right. Photos of one object are not independent of each other: "
    "intervals over objects would be wider. What the model chooses has its interval over objects, "
    "of which each has one token."
)


def kind_of(table: "pd.DataFrame") -> "pd.Series":
    """Of every row, whether its photos show the object itself, a look-alike, or another."""
    kinds = table.shown.map({OTHER: "other objects"}).fillna("look-alikes")
    return kinds.where(table.shown != table.object, "own")


def final(answers: "pd.DataFrame") -> "pd.DataFrame":
    """The rows after the last step of each training."""
    training = answers.groupby(["object", "k", "learned_in"]).step
    return answers[answers.step == training.transform("max")]


def reading(answers: "pd.DataFrame", name: str) -> "pd.DataFrame":
    """The rows of one of READINGS."""
    asked = answers[["learned_in", "token", "read_by"]].astype(str)
    return answers[(asked == READINGS[name]).all(axis=1)]


def said_yes(rows: "pd.DataFrame") -> Estimate:
    """The share of the rows' photos to which the answer was yes."""
    return rate(int(rows.yes.sum()), int(rows.n.sum()))


def right(rows: "pd.DataFrame") -> float:
    """The share of right answers, the object's photos and all others with equal weight."""
    is_own = kind_of(rows) == "own"
    return (said_yes(rows[is_own]).value + 1 - said_yes(rows[~is_own]).value) / 2


def curve(answers: "pd.DataFrame") -> "pd.DataFrame":
    """By number of photos and step: yes to each kind of photo, over all objects of the rows.

    Columns: k, step, kind, objects, n, value, low, high.
    """
    import pandas as pd

    rows = reading(answers, "as learned")
    lines = []
    for (k, step, kind), part in rows.groupby(["k", "step", kind_of(rows)]):
        about = dict(k=k, step=step, kind=kind, objects=part.object.nunique())
        found = said_yes(part)
        lines.append({**about, "n": found.n, **asdict(found)})
    return pd.DataFrame(lines)


def readings(answers: "pd.DataFrame") -> "pd.DataFrame":
    """By object and reading: right, and yes to each kind of photo, `Estimate`s."""
    import pandas as pd

    lines = []
    for name, ends in _read_ends(answers, USUAL_K):
        for (suite, obj), part in ends.groupby(["suite", "object"], sort=False):
            line = {"suite": suite, "object": obj, "reading": name, "right": right(part)}
            lines.append(line | _yes_by_kind(part))
    return pd.DataFrame(lines, columns=["suite", "object", "reading", "right", *KINDS])


def _read_ends(answers: "pd.DataFrame", k: int) -> "Iterator[tuple[str, pd.DataFrame]]":
    """The rows after the last step of trainings from `k` photos, by reading."""
    ends = final(answers)
    return ((name, reading(ends[ends.k == k], name)) for name in READINGS)


def _yes_by_kind(rows: "pd.DataFrame") -> dict[str, Estimate]:
    kinds = kind_of(rows)
    return {kind: said_yes(rows[kinds == kind]) for kind in KINDS}


def pooled(answers: "pd.DataFrame", k: int = USUAL_K) -> "pd.DataFrame":
    """By reading, over all objects: right as a mean over objects, yes to each kind of photo.

    All are `Estimate`s: yes has Wilson's interval over photos, right has Student's over objects.
    """
    import pandas as pd

    lines = []
    for name, part in _read_ends(answers, k):
        if len(part):
            of_objects = [right(rows) for _, rows in part.groupby("object", sort=False)]
            line = {"reading": name, "right": mean_of_tokens(of_objects)}
            lines.append(line | _yes_by_kind(part))
    return pd.DataFrame(lines, columns=["reading", "right", *KINDS]).set_index("reading")


def confusions(answers: "pd.DataFrame") -> "pd.DataFrame":
    """By object and look-alike: the share of its photos that are taken for the object's."""
    import pandas as pd

    ends = final(reading(answers, "as learned"))
    ends = ends[(ends.k == USUAL_K) & (kind_of(ends) == "look-alikes")]
    lines = ends[["suite", "object", "shown"]].rename(columns={"shown": "look-alike"})
    columns = ["n", "value", "low", "high"]
    numbers = pd.DataFrame(list(map(asdict, rates(ends.yes, ends.n))), lines.index, columns)
    return lines.join(numbers).reset_index(drop=True)


def success_by_token(episodes: "pd.DataFrame", other: str, one: str = "soft") -> "pd.Series":
    """By task, how much more often `other` succeeds than `one` in the episodes that both ran.

    A task has one target, and so one learned token of each form: tasks are the independent units.
    """
    key = ["suite", "task", "episode"]
    wide = episodes.pivot(index=key, columns="method", values="success")[[one, other]].dropna()
    gain = wide[other].astype(float) - wide[one].astype(float)
    return gain.groupby(["suite", "task"], sort=False).mean()


def mean_of_tokens(values: Sequence[float], least: float = 0.0) -> Estimate:
    """The mean of one value per token with Student's 95 % interval, inside `least` to 1.

    A single token has no interval. `least` is -1 for differences.
    """
    found = student(values)
    return replace(found, low=max(found.low, least), high=min(found.high, 1.0))


def report(tables: "Mapping[str, pd.DataFrame]") -> str:
    """What the command prints."""
    import pandas as pd

    answers = tables["answers"]
    found = readings(answers).drop(columns="suite")
    names = {kind: f"yes to {kind}" for kind in KINDS}
    texts = {kind: [each.text() for each in found[kind]] for kind in KINDS}
    shown = found.assign(right=(100 * found["right"]).map("{:.1f}".format), **texts)
    shown = shown.rename(columns={"reading": "token", "right": "right, %", **names})
    lines = []
    for (k, step), part in curve(answers).groupby(["k", "step"]):
        line = {"photos, steps": f"{k}, {step}", "objects": int(part.objects.max())}
        for kind, row in zip(part.kind, part.itertuples(), strict=True):
            line[names[str(kind)]] = Estimate(row.value, row.low, row.high, row.n).text()
        lines.append(line)
    by_k = pd.DataFrame(lines)[["photos, steps", "objects", *names.values()]]
    return "\n\n".join([*map(printed, (shown, by_k, _choices(tables["choices"]))), NOTE])


def _choices(table: "pd.DataFrame") -> "pd.DataFrame":
    """By suite: whether the model chooses the target among the objects of listed episodes."""
    import pandas as pd

    lines = []
    usual = reading(table, "as learned")
    usual = usual[usual.k == USUAL_K]
    several = usual["epochs"].nunique() > 1
    for (suite, epochs, seen_in), part in usual.groupby(["suite", "epochs", "seen_in"], sort=False):
        found = chosen(part)
        name = f"{suite}, {epochs} epochs" if several else suite
        line = {"objects of first views": name, "seen in": seen_in}
        line["chance"] = f"{100 * found.chance.mean():.1f}"
        right = share_by(found, "right", OBJECTS).text()
        lines.append({**line, "the model chooses the target": right})
    return pd.DataFrame(lines)
