"""Grounding on the benchmarks' opening frames, view by view, against the simulator.

It says what was found, which candidate was elected, which model was wrong, and whether views agree.
Rows are flat, one list per table: "views" (a row per view), "objects" (per visible object of the
target's category), "detections" (per box and phrase), "choices" (per view, K references and rule).
Every row carries the keys of `View.key`. Boxes that overlap by IoU 0.5 agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from vap_core.associate import PAIRINGS, Pairing, Sighting, associate, compare_views
from vap_core.base.types import (
    Ballot,
    Boxes,
    Camera,
    Mask,
    PersonalObject,
    Rgb,
    election_scores,
    likeness,
    value,
)
from vap_core.memory import register
from vap_core.perception.boxes import box_iou, crop, mask_box, mask_iou
from vap_core.perception.candidates import Proposals, propose
from vap_core.perception.protocols import Stack
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.phrases import AMBIGUOUS, UNSEEN
from vap_core.simulation.env import Env
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import build_scene, make_env, models_of
from vap_core.simulation.types import EpisodeRow
from vap_core.vote import VoteRule, compare, nominate, similarity, vote

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
        boxes = {}
        for name, mask in self.masks.items():
            box = mask_box(mask)
            if box is not None:
                boxes[name] = box
        return boxes

    def visible(self) -> dict[str, Mask]:
        """The masks large enough to count."""
        return {name: mask for name, mask in self.masks.items() if mask.sum() >= self.least_px}


def opening_views(rows: Sequence[EpisodeRow], size: int = 224) -> Iterator[list[View]]:
    """The views of each row in turn, by the cameras, look, control and sensor of its suite.

    Rows of one suite and variant share a scene and come together. Pictures are `size` pixels wide
    and high.

    Raises: UnknownName for a suite or an object that no registry holds.
    """
    groups: dict[tuple[str, str], list[EpisodeRow]] = {}
    for row in rows:
        groups.setdefault((row.suite, row.variant), []).append(row)
    for (suite, variant), group in groups.items():
        with build_scene(suite, models_of(group), variant) as scene:
            env = make_env(scene, suite, image_size=size)
            for row in group:
                env.reset(row)
                yield _opening_views(env, row)


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
    boxes = view.boxes()
    alike = _same_category(view)
    best = _best_boxes(view, stack)
    detections = []
    for kind, found in best.items():
        detections += _detections(found, kind=kind, view=view, boxes=boxes, alike=alike)
    false_alarm = _false_alarm(view, stack)
    true_boxes = _stack_boxes([boxes[name] for name in alike])
    true_embeddings = stack.encoder([crop(view.rgb, box) for box in true_boxes])
    object_rows = _object_rows(
        view=view,
        cosine=similarity(true_embeddings, memory[USUAL_K].embeddings),
        best=best,
        candidates=candidates,
        boxes=boxes,
        alike=alike,
    )
    view_row = _view_row(view, candidates, object_rows)
    view_row |= _unseen_phrase(view, best, boxes) | false_alarm
    view_row |= {"proposed": None, "mask_iou_true_box": None}
    choices: list[TableRow] = []
    if view_row["counts"]:
        target_box = boxes[view.row.target]
        true_box = Boxes(target_box[None], np.ones(1, np.float32), view.row.category)
        view_row["proposed"] = _is_found(candidates.boxes.xyxy, target_box)
        view_row["mask_iou_true_box"] = _segmented_iou(view, stack, true_box)
        choices = _choices(
            view=view,
            stack=stack,
            memory=memory,
            candidates=candidates,
            true_embeddings=true_embeddings,
            alike=list(alike),
        )
    return {
        "views": [view_row],
        "objects": object_rows,
        "detections": detections,
        "choices": [{"tier": view_row["tier"], **choice} for choice in choices],
    }


def object_under_box(view: View, box: Box) -> str:
    """The object that a box lies on, the target before others; "nothing" when it lies on none."""
    boxes = view.boxes()
    target = view.row.target
    if target in boxes and _is_found(box[None], boxes[target]):
        return target
    all_boxes = _stack_boxes(list(boxes.values()))
    overlap = _box_ious(box[None], all_boxes)[0]
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
    with_wanted = _box_ious(found, wanted)
    with_ignored = _box_ious(found, ignored)
    free = np.ones(len(wanted), bool)
    hits: list[bool | None] = []
    for overlap, ignored_overlap in zip(with_wanted, with_ignored, strict=True):
        chosen = -1
        if len(wanted):
            chosen = int(np.where(free, overlap, -1).argmax())
        if chosen >= 0 and free[chosen] and overlap[chosen] >= at:
            free[chosen] = False
            hits.append(True)
        elif ignored_overlap.max(initial=0.0) >= SAME_BOX:
            hits.append(None)
        else:
            hits.append(False)
    return hits


def _opening_views(env: Env, row: EpisodeRow) -> list[View]:
    """The view of every camera of an environment that was just reset."""
    masks = env.truth(masks=True).masks
    optics = {}
    for calibrated in env.cameras():
        optics[calibrated.name] = calibrated
    views = []
    for camera, rgb in env.observe().images.items():
        view = View(
            row=row,
            camera=camera,
            rgb=rgb,
            masks=masks[camera],
            optics=optics[camera],
        )
        views.append(view)
    return views


def _same_category(view: View) -> dict[str, Mask]:
    """The masks of the visible objects of the target's category."""
    alike = {}
    for name, mask in view.visible().items():
        if objects.get_object(name).category == view.row.category:
            alike[name] = mask
    return alike


def _best_boxes(view: View, stack: Stack) -> dict[str, Boxes]:
    """The boxes down to FLOOR, best first, of the category and of its unseen phrase, if any."""
    best = {"category": stack.category_detector([view.rgb], view.row.category, FLOOR)[0]}
    phrase = _take_turn(UNSEEN.get(view.row.category, ()), view.row.episode)
    if phrase:
        best["unseen"] = stack.category_detector([view.rgb], phrase, FLOOR)[0]
    return best


def _false_alarm(view: View, stack: Stack) -> TableRow:
    """Whether anything is found of a category that is absent."""
    phrase = _take_turn(_absent_categories(view), view.row.episode)
    found = stack.category_detector([view.rgb], phrase)[0]
    return {"absent_phrase": phrase, "false_alarm": len(found) > 0}


def _unseen_phrase(view: View, best: Mapping[str, Boxes], boxes: Mapping[str, Box]) -> TableRow:
    """Whether the unseen phrase finds the target; None without such a phrase or visible target."""
    if "unseen" not in best:
        return {"unseen_phrase": "", "unseen_proposed": None}
    target = view.row.target
    proposed = None
    if target in view.visible():
        proposed = _is_found(best["unseen"].xyxy[:TOP], boxes[target])
    return {"unseen_phrase": best["unseen"].phrase, "unseen_proposed": proposed}


def _object_rows(
    *,
    view: View,
    cosine: Float32[np.ndarray, "m k"],
    best: Mapping[str, Boxes],
    candidates: Proposals,
    boxes: Mapping[str, Box],
    alike: Mapping[str, Mask],
) -> list[TableRow]:
    """A row per object of `alike`: whether it was found, and its cosine with the references.

    `best` are the boxes of each phrase, best first (`_best_boxes`).
    """
    rows = []
    for i, (name, mask) in enumerate(alike.items()):
        role = "look-alike"
        if name == view.row.target:
            role = "target"
        recalled_unseen = None
        if "unseen" in best:
            recalled_unseen = _is_found(best["unseen"].xyxy[:TOP], boxes[name])
        row: TableRow = {
            "object": name,
            "role": role,
            "tier": _tier_in_view(name, view),
            "px": int(mask.sum()),
            "recalled": _is_found(best["category"].xyxy[:TOP], boxes[name]),
            "proposed": _is_found(candidates.boxes.xyxy, boxes[name]),
            "cosine": float(cosine[i].mean()),
            "recalled_unseen": recalled_unseen,
        }
        rows.append(row)
    return rows


def _view_row(view: View, candidates: Proposals, object_rows: Sequence[TableRow]) -> TableRow:
    """What a view shows, and how many candidates were found in it."""
    target = view.row.target
    tier = "standard"
    for row in object_rows:
        if row["tier"] == "hard":
            tier = "hard"
    return {
        "target_px": int(view.masks[target].sum()),
        "counts": target in view.visible(),
        "visible_alike": len(object_rows),
        "tier": tier,
        "candidates": len(candidates.boxes),
    }


def _tier_in_view(name: str, view: View) -> str:
    if name == view.row.target:
        return "personal"
    return objects.tier(objects.get_object(name))


def _segmented_iou(view: View, stack: Stack, box: Boxes) -> float:
    """The IoU of the target's mask with the one that the segmenter draws from a single box."""
    mask = stack.segmenter(view.rgb, box)[0]
    return mask_iou(mask, view.masks[view.row.target])


def _choices(
    *,
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
    target_ious: dict[tuple[float, ...], float] = {}
    rows = []
    for k, personal in memory.items():
        few, _ = nominate(view.rgb, personal, candidates, stack)
        cosine = compare(personal, few, stack)
        like = likeness(cosine, few.boxes)
        true_cosine = similarity(true_embeddings, personal.embeddings)
        for rule in RULES:
            ballot = vote(election_scores(cosine, few.boxes), rule)
            true_winner = vote(true_cosine, rule).winner
            assert true_winner is not None, "the target's true box is among them"
            elected = _elected_object(view, few, ballot)
            overlap = None
            if elected == target and ballot.winner is not None:
                candidate = _select_box(few.boxes, ballot.winner)
                corners = tuple(candidate.xyxy[0].tolist())
                if corners not in target_ious:
                    target_ious[corners] = _segmented_iou(view, stack, candidate)
                overlap = target_ious[corners]
            row: TableRow = {
                "k": k,
                "rule": rule,
                "right": elected == target,
                "right_given_boxes": alike[true_winner] == target,
                "elected": elected,
                "margin": ballot.margin,
                "cosine_margin": ballot.cosine_margin,
                "tie": _is_tie(ballot),
                "likeness": None if ballot.winner is None else float(like[ballot.winner]),
                "mask_iou": overlap,
            }
            rows.append(row)
    return rows


def _elected_object(view: View, candidates: Proposals, ballot: Ballot) -> str:
    """The object under the winner's box; "" when there are no candidates."""
    if ballot.winner is None:
        return ""
    return object_under_box(view, candidates.boxes.xyxy[ballot.winner])


def _is_tie(ballot: Ballot) -> bool:
    return ballot.winner is not None and bool(ballot.tied[ballot.winner])


def _select_box(boxes: Boxes, i: int) -> Boxes:
    return Boxes(boxes.xyxy[[i]], boxes.score[[i]], boxes.phrase)


def _detections(
    found: Boxes,
    *,
    kind: str,
    view: View,
    boxes: Mapping[str, Box],
    alike: Mapping[str, Mask],
) -> list[TableRow]:
    """Score and hit of every box that counts.

    Boxes on objects that are too small do not count, nor boxes on kinds that the phrase may name
    too.
    """
    category = view.row.category
    ambiguous = {category, *AMBIGUOUS.get(category, ())}
    wanted = [boxes[name] for name in alike]
    ignored = []
    for name, box in boxes.items():
        if name not in alike and objects.get_object(name).category in ambiguous:
            ignored.append(box)
    hits = match(found.xyxy, _stack_boxes(wanted), _stack_boxes(ignored))
    rows: list[TableRow] = []
    for score, hit in zip(found.score, hits, strict=True):
        if hit is not None:
            rows.append({"asked": kind, "phrase": found.phrase, "score": float(score), "hit": hit})
    return rows


def _absent_categories(view: View) -> list[str]:
    """Categories of which nothing is placed, and nothing that the same word may name."""
    placed = {objects.get_object(place.model).category for place in view.row.placements}
    absent = []
    for category in objects.CATEGORIES:
        ambiguous = {category, *AMBIGUOUS.get(category, ())}
        if not placed & ambiguous:
            absent.append(category)
    return absent


def _take_turn(names: Sequence[str], number: int) -> str:
    """Each name in turn; "" when there is none."""
    if not names:
        return ""
    return names[number % len(names)]


def _is_found(found: Float32[np.ndarray, "n 4"], box: Box) -> bool:
    """Whether any of the boxes found agrees with `box`."""
    overlap = _box_ious(found, box[None])
    return bool(overlap.max(initial=0.0) >= SAME_BOX)


def _box_ious(
    a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]
) -> Float64[np.ndarray, "n m"]:
    return box_iou(a.astype(np.float64), b.astype(np.float64))


def _stack_boxes(boxes: Sequence[Box]) -> Float32[np.ndarray, "n 4"]:
    return np.array(boxes, np.float32).reshape(-1, 4)


OFF = "off"
"""Views grounded one by one, as the paper does."""


def survey(episode: Sequence[View], stack: Stack, ks: Sequence[int] = KS) -> Tables:
    """Every table of `survey_view` with its keys, and "agreements".

    "agreements" has a row per way to associate the views; none for a single view.

    Raises: as `registered_object` and `agreements`.
    """
    target = episode[0].row.target
    memory = {}
    for k in ks:
        memory[k], _ = registered_object(stack, target, k)
    candidates = find_candidates(episode, stack)
    tables: Tables = {"views": [], "objects": [], "detections": [], "choices": [], "agreements": []}
    for view, of_view in zip(episode, candidates, strict=True):
        of_tables = survey_view(view=view, stack=stack, memory=memory, candidates=of_view)
        for name, rows in of_tables.items():
            tables[name] += [{**view.key, **row} for row in rows]
    if len(episode) > 1:
        tables["agreements"] = agreements(episode, candidates, memory[USUAL_K], stack)
    return tables


def agreements(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    personal: PersonalObject,
    stack: Stack,
) -> list[TableRow]:
    """What the views of an episode highlight together, by every way to associate them.

    `case` is the comparison of the views (SPEC section 7); `right` is in how many of the `views`
    that show the target it is highlighted. A box on no object is another thing in every view.

    Raises: BadViews, as `associate`; BadEncoder, as `compare`.
    """
    few = []
    for view, of_view in zip(episode, candidates, strict=True):
        few.append(nominate(view.rgb, personal, of_view, stack)[0])
    sightings = _sightings(episode, few, personal, stack)
    single = {camera: vote(sighting.cosine).winner for camera, sighting in sightings.items()}
    pairings: Mapping[str, Pairing | None] = {OFF: None, **PAIRINGS}
    row = episode[0].row
    table = []
    for name, pairing in pairings.items():
        association = None
        if pairing is not None:
            association = associate(sightings, pairing)
        chosen: Mapping[str, int | None] = single
        margin = None
        if association is not None:
            chosen = association.chosen
            margin = association.margin
        highlighted = _highlighted_objects(episode, few, chosen)
        n_right, n_views = _count_right(episode, highlighted)
        agreement: TableRow = {
            "suite": row.suite,
            "task": row.task,
            "episode": row.episode,
            "target": row.target,
            "associate": name,
            "case": compare_views(_distinguish_nothing(highlighted), row.target),
            "right": n_right,
            "views": n_views,
            "margin": margin,
        }
        table.append(agreement)
    return table


def _sightings(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    personal: PersonalObject,
    stack: Stack,
) -> dict[str, Sighting]:
    """The candidates of each view, by camera, as `associate` takes them."""
    sightings = {}
    for view, of_view in zip(episode, candidates, strict=True):
        sightings[view.camera] = Sighting(
            cosine=election_scores(compare(personal, of_view, stack), of_view.boxes),
            xyxy=of_view.boxes.xyxy,
            camera=view.optics,
        )
    return sightings


def _highlighted_objects(
    episode: Sequence[View],
    candidates: Sequence[Proposals],
    chosen: Mapping[str, int | None],
) -> dict[str, str | None]:
    """The object under the chosen box of each camera; None where none is chosen."""
    highlighted: dict[str, str | None] = {}
    for view, of_view in zip(episode, candidates, strict=True):
        i = chosen[view.camera]
        highlighted[view.camera] = None
        if i is not None:
            highlighted[view.camera] = object_under_box(view, of_view.boxes.xyxy[i])
    return highlighted


def _count_right(episode: Sequence[View], highlighted: Mapping[str, str | None]) -> tuple[int, int]:
    """In how many views the target is highlighted, and how many show it."""
    target = episode[0].row.target
    n_right = 0
    n_views = 0
    for view in episode:
        if target in view.visible():
            n_views += 1
            n_right += highlighted[view.camera] == target
    return n_right, n_views


def _distinguish_nothing(highlighted: Mapping[str, str | None]) -> dict[str, str | None]:
    """The same objects, with "nothing" as another thing in every camera."""
    distinct = dict(highlighted)
    for camera, name in highlighted.items():
        if name == "nothing":
            distinct[camera] = f"nothing in {camera}"
    return distinct
