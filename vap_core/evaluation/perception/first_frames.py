"""Grounding on the benchmarks' opening frames, view by view, against the simulator: what was found, who was elected, and whose mistake it was.

    for episode in openings(suites.rows("vlabench", "select-shoe", 12)):
        for view in episode:
            tables = survey_view(view, stack, memory, look(view, stack))

Rows are flat, one list per table: "views" (a line per view), "objects" (per visible object of the target's category), "detections" (per box
and phrase), "choices" (per view, K references and rule). Every line carries the keys of `View.key`. Boxes that overlap by IoU 0.5 agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, get_args

import numpy as np
from jaxtyping import Float32

from vap_core.base.types import Boxes, Camera, Mask, PersonalObject, Rgb, value
from vap_core.memory import register
from vap_core.perception.boxes import box_iou, crop, mask_box, mask_iou
from vap_core.perception.protocols import Stack
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS, UNSEEN
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import build_scene, make_env
from vap_core.simulation.types import EpisodeRow
from vap_core.vote import VoteRule, similarity, vote

LEAST_PX = 100
"""Visible pixels, of a view of 224 x 224, from which on an object counts."""
SAME_BOX = 0.5
FLOOR, TOP = 0.03, 10
"""Score from which on a box enters average precision, and how many of the best count for recall."""
KS = (1, 3, 5, 7)
"""Numbers of reference photos; each set is taken anew, as a user would take so many."""
USUAL_K = 5
RULES: tuple[VoteRule, ...] = get_args(VoteRule)
Line = dict[str, Any]
Tables = dict[str, list[Line]]


@value
class View:
    """One camera's opening frame, and what the simulator knows about it: the visible pixels of every object placed."""

    row: EpisodeRow
    camera: str
    rgb: Rgb
    masks: Mapping[str, Mask]
    optics: Camera | None = None

    @property
    def key(self) -> Line:
        row, size = self.row, self.rgb.shape[0]
        return {"suite": row.suite, "task": row.task, "episode": row.episode, "split": row.split, "variant": row.variant, "camera": self.camera,
                "size": size, "category": row.category, "target": row.target}  # fmt: skip

    @property
    def least_px(self) -> float:
        return LEAST_PX * self.rgb.shape[0] * self.rgb.shape[1] / 224**2

    def boxes(self) -> dict[str, Float32[np.ndarray, "4"]]:
        """Around every object of which anything shows."""
        return {name: _box(mask) for name, mask in self.masks.items() if mask.any()}

    def visible(self) -> dict[str, Mask]:
        """The masks large enough to count."""
        return {name: mask for name, mask in self.masks.items() if mask.sum() >= self.least_px}


def openings(rows: Sequence[EpisodeRow], size: int = 224) -> Iterator[list[View]]:
    """The views of each row in turn, by the cameras, look, control and sensor of its suite; rows of one task share scenes by variant."""
    for name, variant in dict.fromkeys((row.suite, row.variant) for row in rows):
        alike = [row for row in rows if (row.suite, row.variant) == (name, variant)]
        models = list(dict.fromkeys(place.model for row in alike for place in row.placements))
        with build_scene(name, models, variant) as scene:
            env = make_env(scene, name, image_size=size)
            for row in alike:
                env.reset(row)
                masks, optics = (
                    env.truth(masks=True).masks,
                    {camera.name: camera for camera in env.cameras()},
                )
                yield [
                    View(row, camera, rgb, masks[camera], optics[camera])
                    for camera, rgb in env.observe().images.items()
                ]


@cache
def remembered(stack: Stack, target: str, k: int) -> tuple[PersonalObject, tuple[int, ...]]:
    """The personal object from k rendered reference photos, and which of them no detector cut; once per process."""
    model = objects.get_object(target)
    return register(
        target, model.category, reference_views(model, k), stack.detector, stack.encoder
    )


@value
class Looked:
    """What the stack made of a view before anyone was asked for: candidates of the target's category and their embeddings."""

    found: Boxes
    rows: Float32[np.ndarray, "n d"]


def look(view: View, stack: Stack) -> Looked:
    found = stack.detector([view.rgb], view.row.category)[0]
    return Looked(found, stack.encoder([crop(view.rgb, box) for box in found.xyxy]))


def survey_view(
    view: View, stack: Stack, memory: Mapping[int, PersonalObject], looked: Looked
) -> Tables:
    """The lines of one view, without its key. `memory` holds the target as remembered from each number of photos; the usual one must be there.

    "choices" and the mask's figures are told of views that show the target; "detections" and "objects" of all.
    """
    seen, category = view.visible(), view.row.category
    alike = {
        name: mask for name, mask in seen.items() if objects.get_object(name).category == category
    }
    boxes, found = view.boxes(), looked.found
    true = _stack([boxes[name] for name in alike])
    best = stack.detector([view.rgb], category, FLOOR)[0]
    detections = _detections(best, category, "category", view, boxes, alike)
    unseen = _turn(UNSEEN.get(category, ()), view.row.episode)
    asked: Line = {"unseen_phrase": unseen, "unseen_proposed": None}
    if unseen:
        other = stack.detector([view.rgb], unseen, FLOOR)[0]
        detections += _detections(other, unseen, "unseen", view, boxes, alike)
        asked["unseen_proposed"] = (
            _any_on(other.xyxy[:TOP], boxes[view.row.target]) if view.row.target in seen else None
        )
    absent = _turn(_absent(view), view.row.episode)
    asked |= {
        "absent_phrase": absent,
        "false_alarm": len(stack.detector([view.rgb], absent)[0]) > 0,
    }
    rows = stack.encoder([crop(view.rgb, box) for box in true])
    near = similarity(rows, memory[USUAL_K].embeddings)
    lines: list[Line] = [
        {
            "object": name, "role": "target" if name == view.row.target else "look-alike",
            "tier": "personal" if name == view.row.target else objects.tier(objects.get_object(name)), "px": int(mask.sum()),
            "recalled": _any_on(best.xyxy[:TOP], boxes[name]), "proposed": _any_on(found.xyxy, boxes[name]), "cosine": float(near[i].mean()),
            "recalled_unseen": _any_on(other.xyxy[:TOP], boxes[name]) if unseen else None,
        }
        for i, (name, mask) in enumerate(alike.items())
    ]  # fmt: skip
    here: Line = {
        "target_px": int(view.masks[view.row.target].sum()), "counts": view.row.target in seen, "visible_alike": len(alike),
        "tier": "hard" if any(line["tier"] == "hard" for line in lines) else "standard", "candidates": len(found), **asked,
        "proposed": None, "mask_iou_true_box": None,
    }  # fmt: skip
    choices: list[Line] = []
    if here["counts"]:
        goal = view.masks[view.row.target]
        box = boxes[view.row.target]
        exact = Boxes(box[None], np.ones(1, np.float32), category)
        here |= {
            "proposed": _any_on(found.xyxy, box),
            "mask_iou_true_box": mask_iou(stack.segmenter(view.rgb, exact)[0], goal),
        }
        choices = _choices(view, stack, memory, looked, rows, list(alike))
    return {
        "views": [here],
        "objects": lines,
        "detections": detections,
        "choices": [{"tier": here["tier"], **line} for line in choices],
    }


def _choices(
    view: View,
    stack: Stack,
    memory: Mapping[int, PersonalObject],
    looked: Looked,
    true_rows: Float32[np.ndarray, "m d"],
    alike: Sequence[str],
) -> list[Line]:
    """Who is elected of the candidates, and of the true boxes of the same objects; a line per number of references and rule."""
    target, found = view.row.target, looked.found
    masks: dict[int, float] = {}
    lines = []
    for k, mine in memory.items():
        cosine, ideal = (
            similarity(looked.rows, mine.embeddings),
            similarity(true_rows, mine.embeddings),
        )
        for rule in RULES:
            b, ideal_winner = vote(cosine, rule), vote(ideal, rule).winner
            assert ideal_winner is not None, "the target's true box is among them"
            elected, overlap = "", None
            if (i := b.winner) is not None:
                elected = under(view, found.xyxy[i])
                if elected == target and i not in masks:
                    one = Boxes(found.xyxy[[i]], found.score[[i]], found.phrase)
                    masks[i] = mask_iou(stack.segmenter(view.rgb, one)[0], view.masks[target])
                overlap = masks[i] if elected == target else None
            lines.append(
                {
                    "k": k, "rule": rule, "right": elected == target, "right_given_boxes": alike[ideal_winner] == target, "elected": elected,
                    "margin": b.margin, "cosine_margin": b.cosine_margin, "tie": i is not None and bool(b.tied[i]), "mask_iou": overlap,
                }
            )  # fmt: skip
    return lines


def under(view: View, box: Float32[np.ndarray, "4"]) -> str:
    """The object that a box lies on, the target before others; "nothing" when it lies on none."""
    boxes = view.boxes()
    if view.row.target in boxes and _any_on(box[None], boxes[view.row.target]):
        return view.row.target
    overlap = box_iou(
        box[None].astype(np.float64), _stack(list(boxes.values())).astype(np.float64)
    )[0]
    return list(boxes)[int(overlap.argmax())] if overlap.max(initial=0.0) >= SAME_BOX else "nothing"


def _detections(
    found: Boxes,
    phrase: str,
    kind: str,
    view: View,
    boxes: Mapping[str, Float32[np.ndarray, "4"]],
    alike: Mapping[str, Mask],
) -> list[Line]:
    """Score and hit of every box that counts: not those on objects too small, or on kinds that one might call so too."""
    category = view.row.category
    also = {category, *AMBIGUOUS.get(category, ())}
    ignored = [
        name for name in boxes if name not in alike and objects.get_object(name).category in also
    ]
    hits = match(
        found.xyxy,
        _stack([boxes[name] for name in alike]),
        _stack([boxes[name] for name in ignored]),
    )
    return [
        {"asked": kind, "phrase": phrase, "score": float(s), "hit": hit}
        for s, hit in zip(found.score, hits, strict=True)
        if hit is not None
    ]


def match(
    found: Float32[np.ndarray, "n 4"],
    wanted: Float32[np.ndarray, "m 4"],
    ignored: Float32[np.ndarray, "i 4"],
    at: float = SAME_BOX,
) -> list[bool | None]:
    """Of boxes, best first, whether each takes a wanted one that is still free, as in average precision; None for one that counts neither way."""
    overlap, near = (
        box_iou(found.astype(np.float64), wanted.astype(np.float64)),
        box_iou(found.astype(np.float64), ignored.astype(np.float64)),
    )
    free, hits = np.ones(len(wanted), bool), list[bool | None]()
    for mine, other in zip(overlap, near, strict=True):
        chosen = int(np.where(free, mine, -1).argmax()) if len(wanted) else -1
        if chosen >= 0 and free[chosen] and mine[chosen] >= at:
            free[chosen] = False
            hits.append(True)
        else:
            hits.append(None if other.max(initial=0.0) >= at else False)
    return hits


def _absent(view: View) -> list[str]:
    """Categories of which nothing is placed, and nothing that one might call so."""
    placed = {objects.get_object(place.model).category for place in view.row.placements}
    return [kind for kind in objects.CATEGORIES if not placed & {kind, *AMBIGUOUS.get(kind, ())}]


def _turn(names: Sequence[str], number: int) -> str:
    """Each name in turn; "" when there is none."""
    return names[number % len(names)] if names else ""


def _any_on(found: Float32[np.ndarray, "n 4"], box: Float32[np.ndarray, "4"]) -> bool:
    return bool(
        box_iou(found.astype(np.float64), box[None].astype(np.float64)).max(initial=0.0) >= SAME_BOX
    )


def _box(mask: Mask) -> Float32[np.ndarray, "4"]:
    box = mask_box(mask)
    assert box is not None, "only masks that show something have a box"
    return box


def _stack(boxes: Sequence[Float32[np.ndarray, "4"]]) -> Float32[np.ndarray, "n 4"]:
    return np.array(boxes, np.float32).reshape(-1, 4)
