"""Development scenes: generic objects at the benchmarks' tasks, which no film and no list shows.

Each scene asks three questions of every camera: where its target is; where an object of another
kind is, which is absent; and where a look-alike of the target is, which is absent too.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from vap_core.base.types import PersonalObject, election_scores, likeness
from vap_core.perception.candidates import Proposals, propose
from vap_core.perception.protocols import Stack
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS
from vap_core.simulation.suites import BENCHMARKS, suite
from vap_core.simulation.types import EpisodeRow
from vap_core.study.perception import View, object_under_box, opening_views, registered_object
from vap_core.vote import nominate, vote
from vap_make.films.demonstrations import draw_objects, row
from vap_make.objects import generic_instance
from vap_make.recipe import filmed_tasks

Case = Literal["present", "look-alikes", "absent"]
"""The object is in view; it is not, but others of its kind are; nothing of its kind is."""
Row = dict[str, Any]
REFERENCES = 5
SEED = 83
TRIES = 20
"""How often objects that do not fit are drawn again."""
TWINS = 6
"""Twins of a generic instance; 0 is the instance itself."""


def scene(number: int) -> EpisodeRow:
    """Scene `number`; benchmarks and their tasks take turns."""
    names = list(BENCHMARKS)
    known = suite(names[number % len(names)])
    tasks = filmed_tasks(known.name)
    task = tasks[number // len(names) % len(tasks)]
    for attempt in range(TRIES):
        rng = np.random.default_rng([SEED, number, attempt])
        drawn = draw_objects(known, task, rng, held_out=True)
        try:
            return row(known, task, drawn, number, rng)
        except ValueError:  # no room for them
            continue
    raise RuntimeError(f"scene {number}: {TRIES} draws of objects do not fit on the table")


def absent_lookalike(start: EpisodeRow) -> str:
    """A look-alike of the target that is not in the scene."""
    stem, _, numbers = start.target.rpartition("-generic-")
    index = int(numbers.partition("-")[0])
    placed = {place.model for place in start.placements}
    for twin in range(TWINS):
        name = generic_instance(stem, index, twin).name
        if name not in placed:
            return name
    raise RuntimeError(f"every twin of {start.target} is in the scene")


def absent_other(start: EpisodeRow, number: int) -> str:
    """The target of the next scene that is of no kind that this one shows."""
    placed = {objects.get_object(place.model).category for place in start.placements}
    while True:
        number += 1
        target = scene(number).target
        category = objects.get_object(target).category
        if not placed & {category, *AMBIGUOUS.get(category, ())}:
            return target


def measure_scene(number: int, stack: Stack) -> list[Row]:
    """One row per camera and question: the elected candidate's likeness, and if it is the object.

    `likeness` is None where there are no candidates; cameras that do not show the target are not
    asked for it.

    Raises: BadEncoder, as `vote.compare` does.
    """
    start = scene(number)
    (views,) = list(opening_views([start]))
    asked: dict[Case, str] = {
        "present": start.target,
        "look-alikes": absent_lookalike(start),
        "absent": absent_other(start, number),
    }
    rows = []
    proposals: dict[str, Mapping[str, Proposals]] = {}
    for case, name in asked.items():
        obj, _ = registered_object(stack, name, REFERENCES)
        if obj.category not in proposals:
            images = {view.camera: view.rgb for view in views}
            proposals[obj.category] = propose(images, obj.category, stack)
        for view in _views_of(case, views):
            offered = proposals[obj.category][view.camera]
            answer = _elect(obj, offered, view, stack)
            rows.append({"scene": number, "camera": view.camera, "case": case, **answer})
    return rows


def _views_of(case: Case, views: Sequence[View]) -> list[View]:
    """The views that are asked: those that show what the case says."""
    if case == "absent":
        return list(views)
    return [view for view in views if view.row.target in view.visible()]


def _elect(obj: PersonalObject, offered: Proposals, view: View, stack: Stack) -> Row:
    """What the vote elects in one view."""
    few, cosine = nominate(view.rgb, obj, offered, stack)
    winner = vote(election_scores(cosine, few.boxes)).winner
    answer: Row = {"familiar": few.boxes.familiar, "likeness": None, "right": False}
    if winner is not None:
        answer["likeness"] = float(likeness(cosine, few.boxes)[winner])
        answer["right"] = object_under_box(view, few.boxes.xyxy[winner]) == obj.name
    return answer
