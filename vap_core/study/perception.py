"""Grounding on the benchmarks' opening frames, view by view, against the simulator.

It says what was found, which candidate was elected, which model was wrong, and whether views agree.
Rows are flat, one list per table: "views" (a row per view), "objects" (per visible object of the
target's category), "detections" (per box and phrase), "choices" (per view, K references and rule).
Every row carries the keys of `View.key`. Boxes that overlap by IoU 0.5 agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from vap_core.associate import compare_views
from vap_core.attend import GROUNDING_PX, Attender, Prompting
from vap_core.base.types import (
    Boxes,
    Camera,
    Mask,
    PersonalObject,
    Rgb,
    election_scores,
    likeness,
    value,
)
from vap_core.environments import Environment, open_world
from vap_core.memory import register
from vap_core.perception.boxes import box_iou, crop, mask_box, mask_iou
from vap_core.perception.candidates import Proposals, propose
from vap_core.perception.protocols import Stack
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS, UNSEEN
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import build_scene, make_env, models_of
from vap_core.simulation.types import EpisodeRow
from vap_core.vote import VoteRule, nominate, similarity, vote

VISIBLE_PX = 100
"""Visible pixels, of a view of 224 x 224, from which on an object counts."""
SAME_BOX = 0.5
"""IoU from which on two boxes agree."""
FLOOR = 0.03
"""Score from which on a box enters average precision."""
TOP = 10
"""How many of the best boxes count for recall."""
KS = (1, 3, 5, 7)
"""Numbers of reference photos; each set is taken anew, as a user would take so many."""
USUAL_K = 5
RULES: tuple[VoteRule, ...] = ("vote", "average")
TableRow = dict[str, Any]
"""A row of a table of the survey."""
Tables = dict[str, list[TableRow]]
Box = Float32[np.ndarray, "4"]


@value
class View:
    """One camera's opening frame, and the visible pixels of every object placed."""

    row: EpisodeRow
    camera: str
    rgb: Rgb
    masks: Mapping[str, Mask]
    optics: Camera | None = None

    @property
    def key(self) -> TableRow:
        """The columns that name this view in every table."""
        return {
            "suite": self.row.suite,
            "task": self.row.task,
            "episode": self.row.episode,
            "split": self.row.split,
            "variant": self.row.variant,
            "camera": self.camera,
            "size": self.rgb.shape[0],
            "category": self.row.category,
            "target": self.row.target,
        }

    @property
    def least_px(self) -> float:
        """VISIBLE_PX in a view of this size."""
        return VISIBLE_PX * self.rgb.shape[0] * self.rgb.shape[1] / 224**2

    def boxes(self) -> dict[str, Box]:
        """The box of every object of which anything shows."""
        boxes = {name: mask_box(mask) for name, mask in self.masks.items()}
        return {name: box for name, box in boxes.items() if box is not None}

    def visible(self) -> dict[str, Mask]:
        """The masks large enough to count."""
        return {name: mask for name, mask in self.masks.items() if mask.sum() >= self.least_px}


def opening_views(rows: Sequence[EpisodeRow], size: int = GROUNDING_PX) -> Iterator[list[View]]:
    """The views of each row in turn, by the cameras, look, control and sensor of its suite.

    Rows of one suite and variant share a scene and come together. Pictures are `size` pixels wide
    and high.

    Raises: UnknownName for a suite or an object that no registry holds.
    """
    groups: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    for row in rows:
        task = row.task if suites.suite(row.suite).environment else ""
        groups.setdefault((row.suite, row.variant, task), []).append(row)
    for (suite, variant, elsewhere), group in groups.items():
        env: Environment
        with ExitStack() as stack:
            if elsewhere:
                world = stack.enter_context(closing(open_world(group)))
                env = world.open(size, world.cameras)
            else:
                scene = stack.enter_context(build_scene(suite, models_of(group), variant))
                env = make_env(scene, suite, image_size=size)
            for row in group:
                env.reset(row)
                masks = env.truth(masks=True).masks
                optics = {each.name: each for each in env.cameras()}
                yield [
                    View(row, camera, rgb, masks[camera], optics[camera])
                    for camera, rgb in env.observe().images.items()
                ]


@cache
def registered_object(stack: Stack, target: str, k: int) -> tuple[PersonalObject, tuple[int, ...]]:
    """The personal object from `k` rendered reference photos; rendered once per process.

    The second value names the photos that no detector cut.

    Raises: UnknownName, BadObject, as `objects.get_object`.
    """
    model = objects.get_object(target)
    photos = reference_views(model, k)
    return register(
        name=target,
        category=model.category,
        photos=photos,
        detector=stack.detector,
        encoder=stack.encoder,
    )


def find_candidates(views: Sequence[View], stack: Stack) -> list[Proposals]:
    """What is proposed in the views of one episode, whichever personal object is asked for."""
    images = {view.camera: view.rgb for view in views}
    return list(propose(images, views[0].row.category, stack).values())


def survey_view(
    view: View, stack: Stack, memory: Mapping[int, PersonalObject], candidates: Proposals
) -> Tables:
    """The rows of one view, without its key.

    `memory` holds the target as registered from each number of photos; USUAL_K must be among them.
    "choices" and the figures of the mask are given for views that show the target; "detections" and
    "objects" for all.

    Raises: BadEncoder when the encoder gives numbers that are not finite.
    """
    row, boxes, visible = view.row, view.boxes(), view.visible()
    target, category = row.target, row.category
    alike = [name for name in visible if _category(name) == category]
    best = {"category": stack.category_detector([view.rgb], category, FLOOR)[0]}
    if phrase := _take_turn(UNSEEN.get(category, ()), row.episode):
        best["unseen"] = stack.category_detector([view.rgb], phrase, FLOOR)[0]
    may_mean = {category, *AMBIGUOUS.get(category, ())}
    others = [
        box for name, box in boxes.items() if name not in alike and _category(name) in may_mean
    ]
    detections = [
        {"asked": kind, "phrase": found.phrase, "score": float(score), "hit": hit}
        for kind, found in best.items()
        for score, hit in zip(
            found.score,
            match(found.xyxy, _stack_boxes([boxes[name] for name in alike]), _stack_boxes(others)),
            strict=True,
        )
        if hit is not None
    ]
    absent = _take_turn(_absent_categories(row), row.episode)
    crops = [crop(view.rgb, boxes[name]) for name in alike]
    embeddings = stack.encoder(crops)
    cosine = similarity(embeddings, memory[USUAL_K].embeddings)
    unseen = best["unseen"].xyxy[:TOP] if "unseen" in best else None
    object_rows: list[TableRow] = [
        {
            "object": name,
            "role": "target" if name == target else "look-alike",
            "tier": "personal" if name == target else objects.tier(objects.get_object(name)),
            "px": int(visible[name].sum()),
            "recalled": _is_found(best["category"].xyxy[:TOP], boxes[name]),
            "proposed": _is_found(candidates.boxes.xyxy, boxes[name]),
            "cosine": float(each.mean()),
            "recalled_unseen": None if unseen is None else _is_found(unseen, boxes[name]),
        }
        for name, each in zip(alike, cosine, strict=True)
    ]
    counts = target in visible
    tier = "hard" if any(each["tier"] == "hard" for each in object_rows) else "standard"
    view_row: TableRow = {
        "target_px": int(view.masks[target].sum()),
        "counts": counts,
        "visible_alike": len(object_rows),
        "tier": tier,
        "candidates": len(candidates.boxes),
        "unseen_phrase": phrase,
        "unseen_proposed": None
        if unseen is None or not counts
        else _is_found(unseen, boxes[target]),
        "absent_phrase": absent,
        "false_alarm": len(stack.category_detector([view.rgb], absent)[0]) > 0,
        "proposed": None,
        "mask_iou_true_box": None,
    }
    choices: list[TableRow] = []
    if counts:
        true_box = Boxes(boxes[target][None], np.ones(1, np.float32), category)
        view_row["proposed"] = _is_found(candidates.boxes.xyxy, boxes[target])
        if unseen is not None:
            view_row["unseen_proposed"] = _is_found(unseen, boxes[target])
        view_row["mask_iou_true_box"] = _segmented_iou(view, stack, true_box)
        found = _choices(view, stack, memory, candidates, embeddings, alike)
        choices = [{"tier": tier, **choice} for choice in found]
    return {
        "views": [view_row],
        "objects": object_rows,
        "detections": detections,
        "choices": choices,
    }


def object_under_box(view: View, box: Box) -> str:
    """The object that a box lies on, the target before others; "nothing" when it lies on none."""
    boxes = view.boxes()
    target = view.row.target
    if target in boxes and _is_found(box[None], boxes[target]):
        return target
    overlap = _box_ious(box[None], _stack_boxes(list(boxes.values())))[0]
    if overlap.max(initial=0.0) < SAME_BOX:
        return "nothing"
    return list(boxes)[int(overlap.argmax())]


def match(
    found: Float[np.ndarray, "n 4"],
    wanted: Float[np.ndarray, "m 4"],
    ignored: Float[np.ndarray, "i 4"],
    at: float = SAME_BOX,
) -> list[bool | None]:
    """Whether each box, best first, takes a wanted box that is still free.

    It takes one that it overlaps by `at`, as in average precision. None for any other that is the
    same box as an ignored one: it counts neither way.
    """
    free = np.ones(len(wanted), bool)
    hits: list[bool | None] = []
    both = zip(_box_ious(found, wanted), _box_ious(found, ignored), strict=True)
    for overlap, ignored_overlap in both:
        left = np.where(free, overlap, -1)
        if left.max(initial=-1) >= at:
            free[left.argmax()] = False
            hits.append(True)
        else:
            hits.append(None if ignored_overlap.max(initial=0.0) >= SAME_BOX else False)
    return hits


def _category(name: str) -> str:
    return objects.get_object(name).category


def _segmented_iou(view: View, stack: Stack, box: Boxes) -> float:
    """The IoU of the target's mask with the one that the segmenter draws from a single box."""
    return mask_iou(stack.segmenter(view.rgb, box)[0], view.masks[view.row.target])


def _choices(
    view: View,
    stack: Stack,
    memory: Mapping[int, PersonalObject],
    candidates: Proposals,
    true_embeddings: Float32[np.ndarray, "m d"],
    alike: Sequence[str],
) -> list[TableRow]:
    """Which candidate is elected, and which of the true boxes of the same objects.

    A row per number of references and rule. `alike` names the rows of `true_embeddings`.
    """
    target = view.row.target
    target_ious: dict[bytes, float] = {}
    rows = []
    for k, personal in memory.items():
        few, cosine = nominate(view.rgb, personal, candidates, stack)
        like = likeness(cosine, few.boxes)
        true_cosine = similarity(true_embeddings, personal.embeddings)
        for rule in RULES:
            ballot = vote(election_scores(cosine, few.boxes), rule)
            winner, true_winner = ballot.winner, vote(true_cosine, rule).winner
            assert true_winner is not None, "the target's true box is among them"
            elected, overlap = "", None
            if winner is not None:
                box = few.boxes.xyxy[[winner]]
                elected = object_under_box(view, box[0])
                if elected == target:
                    if box.tobytes() not in target_ious:
                        alone = Boxes(box, few.boxes.score[[winner]], few.boxes.phrase)
                        target_ious[box.tobytes()] = _segmented_iou(view, stack, alone)
                    overlap = target_ious[box.tobytes()]
            row: TableRow = {
                "k": k,
                "rule": rule,
                "right": elected == target,
                "right_given_boxes": alike[true_winner] == target,
                "elected": elected,
                "margin": ballot.margin,
                "cosine_margin": ballot.cosine_margin,
                "tie": winner is not None and bool(ballot.tied[winner]),
                "likeness": None if winner is None else float(like[winner]),
                "mask_iou": overlap,
            }
            rows.append(row)
    return rows


def _absent_categories(row: EpisodeRow) -> list[str]:
    """Categories of which nothing is placed, and nothing that the same word may name."""
    placed = {_category(place.model) for place in row.placements}
    return [
        category
        for category in objects.CATEGORIES
        if not placed & {category, *AMBIGUOUS.get(category, ())}
    ]


def _take_turn(names: Sequence[str], number: int) -> str:
    """Each name in turn; "" when there is none."""
    return names[number % len(names)] if names else ""


def _is_found(found: Float32[np.ndarray, "n 4"], box: Box) -> bool:
    """Whether any of the boxes found agrees with `box`."""
    return bool(_box_ious(found, box[None]).max(initial=0.0) >= SAME_BOX)


def _box_ious(
    a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]
) -> Float64[np.ndarray, "n m"]:
    return box_iou(a.astype(np.float64), b.astype(np.float64))


def _stack_boxes(boxes: Sequence[Box]) -> Float32[np.ndarray, "n 4"]:
    return np.array(boxes, np.float32).reshape(-1, 4)


OFF, ASSOCIATED = "off", "associated"
"""Views grounded one by one, as the paper does, and made to agree."""


def survey(episode: Sequence[View], stack: Stack, ks: Sequence[int] = KS) -> Tables:
    """Every table of `survey_view` with its keys.

    Raises: as `registered_object`.
    """
    memory = {k: registered_object(stack, episode[0].row.target, k)[0] for k in ks}
    candidates = find_candidates(episode, stack)
    tables: Tables = {"views": [], "objects": [], "detections": [], "choices": []}
    for view, of_view in zip(episode, candidates, strict=True):
        for name, rows in survey_view(view, stack, memory, of_view).items():
            tables[name] += [{**view.key, **row} for row in rows]
    return tables


def agreements(episode: Sequence[View], personal: PersonalObject, stack: Stack) -> list[TableRow]:
    """What the views of an episode highlight together, one by one and associated.

    `case` is the comparison of the views (SPEC section 7); `right` is in how many of the `views`
    that show the target it is highlighted. A box on no object is another thing in every view.

    Raises: as `Attender.start`.
    """
    row = episode[0].row
    images = {view.camera: view.rgb for view in episode}
    optics = {view.camera: view.optics for view in episode if view.optics is not None}
    shown = [view.camera for view in episode if row.target in view.visible()]
    table: list[TableRow] = []
    for name in (OFF, ASSOCIATED) if len(episode) > 1 else (OFF,):
        prompting = Prompting(associate=name == ASSOCIATED)
        attender = Attender(stack, {personal.name: personal}, prompting)
        _, attended = attender.start(images, f"bring my {personal.category}", cameras=optics)
        highlighted: dict[str, str | None] = {}
        for view in episode:
            (grounding,) = attended.groundings[view.camera]
            under = None
            if grounding.winner is not None:
                under = object_under_box(view, grounding.candidates.xyxy[grounding.winner])
            highlighted[view.camera] = f"nothing in {view.camera}" if under == "nothing" else under
        margins = [found.margin for found in attended.associations if found is not None]
        table.append(
            {
                "suite": row.suite,
                "task": row.task,
                "episode": row.episode,
                "target": row.target,
                "associate": name,
                "case": compare_views(highlighted, row.target),
                "right": sum(highlighted[camera] == row.target for camera in shown),
                "views": len(shown),
                "margin": margins[0] if margins else None,
            }
        )
    return table
