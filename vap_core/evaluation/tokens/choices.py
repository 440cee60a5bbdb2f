"""Which object of an episode's first views the model takes for the token's.

Every object of the target's category is cut out by its true mask, as a photo shows it, and the
model is asked about each alone. The one with the highest answer, the mean over the views that show
it, is the model's choice. That is its recognition at its best: a policy sees all of them at once,
small, and has to move there as well. The same choice among unseen photos of the same objects says
what the change from photo to scene costs.

Every object has one learned token, so its episodes are not independent of each other: all intervals
and p values here take objects, not episodes, as the independent units.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadStudy
from vap_core.base.types import Mask, Rgb, value
from vap_core.evaluation.engine import spread_evenly
from vap_core.evaluation.perception.estimates import Estimate, share_by
from vap_core.evaluation.perception.first_frames import opening_views
from vap_core.evaluation.statistics import bootstrap_interval, holm, sign_flip
from vap_core.perception.boxes import mask_box
from vap_core.policies.mini_pi0.learned_token import answers
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object

if TYPE_CHECKING:
    import pandas as pd

    from vap_core.policies.mini_pi0.vlm import MiniVlm

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
    found = []
    for i, scene in enumerate(shown):
        drawn = {}
        for name, crops in scene.crops.items():
            of_object = photos[name]
            first = i * len(crops)
            drawn[name] = tuple(of_object[(first + j) % len(of_object)] for j in range(len(crops)))
        found.append(Scene(episode=scene.episode, target=scene.target, crops=drawn))
    return tuple(found)


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

    photo = chosen(table[table["seen_in"] == PHOTO])[[*KEY, "right"]]
    joined = chosen(table[table["seen_in"] == SCENE]).merge(photo, on=KEY, suffixes=("", "_photo"))
    first = episodes.pivot_table(
        index=KEY, columns="method", values="first_object_correct", aggfunc="first", observed=True
    )
    joined = joined.merge(first.reset_index(), on=KEY)
    lines = {}
    for name, part in _parts(joined):
        line: dict[str, Estimate | float] = {"chance": float(part["chance"].mean())}
        line[IN_PHOTOS] = share_by(part, "right_photo", OBJECTS)
        line[IN_SCENE] = share_by(part, "right", OBJECTS)
        for method in methods:
            line[method] = share_by(part, method, OBJECTS)
        line[AFTER_RIGHT] = share_by(part[part["right"]], "soft", OBJECTS)
        line[AFTER_WRONG] = share_by(part[~part["right"]], "soft", OBJECTS)
        lines[name] = line
    return pd.DataFrame(lines).T


def losses(table: "pd.DataFrame", episodes: "pd.DataFrame") -> "pd.DataFrame":
    """What is lost at TO_SCENE and at TO_POLICY, by suite.

    `table` and `episodes` are `beside_policy`'s. A row per step and suite, and one for ALL_SUITES
    if there are several: `loss` is an `Estimate` over `objects`, `p` the exact test that an object
    is as likely to win as to lose (`sign_flip`), `p_holm` is `p` corrected for the suites of a
    step; that of ALL_SUITES is `p`.
    """
    import pandas as pd

    rows = []
    steps = {TO_SCENE: _gains_of_photos(table), TO_POLICY: _gains_of_scene(table, episodes)}
    for step, gains in steps.items():
        of_step: list[dict[str, Any]] = []
        for suite, part in _parts(gains):
            by_object = _by_object(part)
            line = {"step": step, "suite": suite, "objects": len(by_object)}
            p = sign_flip(by_object["sum"].to_numpy(float))
            of_step.append({**line, "loss": _mean_gain(part), "p": p, "p_holm": p})
        single = [line for line in of_step if line["suite"] != ALL_SUITES]
        for line, p_holm in zip(single, holm([line["p"] for line in single]), strict=True):
            line["p_holm"] = p_holm
        rows += of_step
    return pd.DataFrame(rows).set_index(["step", "suite"])


def _parts(joined: "pd.DataFrame") -> "list[tuple[str, pd.DataFrame]]":
    """The episodes of each suite; all of them at the end where there are several suites."""
    parts = [(str(name), part) for name, part in joined.groupby("suite", sort=False)]
    if len(parts) > 1:
        parts.append((ALL_SUITES, joined))
    return parts


def _gains_of_photos(table: "pd.DataFrame") -> "pd.DataFrame":
    """By how much an episode is right in photos more than in the scene: -1, 0 or 1."""
    photo = chosen(table[table["seen_in"] == PHOTO])[[*KEY, "right"]]
    both = chosen(table[table["seen_in"] == SCENE]).merge(photo, on=KEY, suffixes=("", "_photo"))
    return both.assign(gain=both["right_photo"].astype(float) - both["right"].astype(float))


def _gains_of_scene(table: "pd.DataFrame", episodes: "pd.DataFrame") -> "pd.DataFrame":
    """By how much an episode is right in the scene more than in soft's first touch, likewise."""
    soft = episodes[episodes["method"] == "soft"][[*KEY, "first_object_correct"]]
    both = chosen(table[table["seen_in"] == SCENE]).merge(soft, on=KEY)
    touched = both["first_object_correct"].astype(float)
    return both.assign(gain=both["right"].astype(float) - touched)


def _by_object(gains: "pd.DataFrame") -> "pd.DataFrame":
    """The sum of an object's gains, and the number of its episodes."""
    return gains.groupby(["suite", "object"], sort=True, observed=True)["gain"].agg(["sum", "size"])


def _mean_gain(gains: "pd.DataFrame") -> Estimate:
    """The mean gain of episodes; its interval resamples objects with all their episodes."""
    by_object = _by_object(gains)
    low, high = bootstrap_interval(
        by_object["sum"].to_numpy(float), by_object["size"].to_numpy(float)
    )
    return Estimate(value=float(gains["gain"].mean()), low=low, high=high, n=len(gains))
