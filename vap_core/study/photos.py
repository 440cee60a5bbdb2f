"""The folder form that measure photos reads.

    references/OBJECT/*.jpg   photos of each object
    references/boxes.csv      optional: photo,x0,y0,x1,y1 with the photo as OBJECT/FILE
    scenes/*.jpg              photos of scenes
    scenes.csv                scene,object,x0,y0,x1,y1: where each object is; no box: it is absent
    objects.csv               optional: object,category; else an object's name is its category
    masks/SCENE/OBJECT.png    optional: bright on the object, of the scene's size; with masks there
                              need be no references, and masks alone are measured

Boxes are pixels of the upright photo, far corner exclusive. An object of scenes.csv without
references is a rival: it is never asked for. Several rows of one scene and object are alternatives.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import field, replace
from itertools import combinations
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.errors import BadPhoto, BadPhotoSet
from vap_core.base.files import Rows, align, read_rows, write_atomic, writing
from vap_core.base.media import load_mask, load_photo, photos_in
from vap_core.base.types import Boxes, Grounding, Mask, PersonalObject, Rgb, value
from vap_core.memory import (
    NAME,
    NAME_RULE,
    kind_instead,
    load_bank,
    plain_category,
    reference_rows,
    save,
)
from vap_core.perception.boxes import box_iou, mask_iou
from vap_core.perception.candidates import Candidates, Proposals, embed, prove, segment
from vap_core.perception.protocols import FamiliarityJudge, Stack, TargetTracker
from vap_core.perception.stacks import checksums, load_stack, ships_thresholds
from vap_core.study import store
from vap_core.study.register import (
    GAP_PX,
    RIGHT,
    SILENT,
    TRUTH,
    WRONG,
    choose,
    draw_box,
    fit,
    join_tiles,
    labelled,
    remember_references,
    write_picture,
    write_sheet,
)
from vap_core.study.stats import DRAWS, Estimate, clustered_share
from vap_core.study.store import read_json_part, write_json_part, write_table
from vap_core.vote import similarity, vote

if TYPE_CHECKING:
    import pandas as pd

BOX = ("x0", "y0", "x1", "y1")
MASKS = "masks"
SCENES_CSV, BOXES_CSV, OBJECTS_CSV = "scenes.csv", "references/boxes.csv", "objects.csv"
FORM = "see python -m vap_core measure photos --help"
Box = Float32[np.ndarray, "4"]


@value
class ReferencePhoto:
    """A photo of an object, and its box where the folder gives one."""

    path: Path
    box: Box | None


@value
class Subject:
    """An object with references: what is registered and asked for."""

    name: str
    category: str
    photos: tuple[ReferencePhoto, ...]


@value
class Scene:
    """One photo, the boxes of every object that scenes.csv names in it (none: it is absent), and
    the files of masks.
    """

    name: str
    path: Path
    boxes: Mapping[str, Float32[np.ndarray, "_n 4"]]
    masks: Mapping[str, Path] = field(default_factory=dict)


@value
class PhotoSet:
    """A folder's objects and scenes.

    `categories` holds the kind of every object, rivals too. `sha256` is that of all its files.
    """

    subjects: tuple[Subject, ...]
    scenes: tuple[Scene, ...]
    categories: Mapping[str, str]
    sha256: str

    @property
    def rivals(self) -> tuple[str, ...]:
        """The objects of scenes without references, which are never asked for."""
        asked = {subject.name for subject in self.subjects}
        return tuple(sorted(set(self.categories) - asked))


def read_photo_set(folder: Path) -> PhotoSet:
    """Read a folder in this form.

    Raises: BadPhotoSet: something is missing, or a line does not fit; the message names it.
    """
    if not folder.is_dir():
        raise BadPhotoSet(f"measure photos: {folder} is no folder; {FORM}.")
    photos = _read_references(folder)
    scenes = _read_scenes(folder, photos)
    _refuse_unasked(folder, photos, scenes)
    named = set(photos)
    for scene in scenes:
        named |= set(scene.boxes)
    categories = read_categories(folder, named)
    subjects = []
    for name, of_object in photos.items():
        subjects.append(Subject(name, categories[name], of_object))
    return PhotoSet(
        subjects=tuple(subjects),
        scenes=scenes,
        categories=categories,
        sha256=_sha256(folder),
    )


def _refuse_unasked(folder: Path, photos: Mapping[str, Any], scenes: Iterable["Scene"]) -> None:
    """Refuse a set in whose scenes no object with references is named, as where it is misspelt."""
    shown: set[str] = set()
    for scene in scenes:
        shown |= set(scene.boxes)
    if photos and shown.isdisjoint(photos):
        raise BadPhotoSet(
            f"measure photos: {folder / SCENES_CSV} names {', '.join(sorted(shown)[:4])}, "
            f"references are there of {', '.join(sorted(photos)[:4])}; name an object alike in "
            "both."
        )


def _read_references(folder: Path) -> dict[str, tuple[ReferencePhoto, ...]]:
    """The photos of every object, with their boxes."""
    root = folder / "references"
    folders = []
    if root.is_dir():
        folders = sorted(path for path in root.iterdir() if path.is_dir())
    if not folders and (folder / MASKS).is_dir():
        return {}
    if not folders:
        raise BadPhotoSet(
            f"measure photos: {root} holds no folder of photos; put each object's photos into "
            "references/OBJECT."
        )
    boxes = read_boxes(folder / BOXES_CSV)
    objects = {}
    for path in folders:
        check_object_folder(path)
        photos = []
        for photo in photos_in(path):
            photos.append(ReferencePhoto(photo, boxes.pop(f"{path.name}/{photo.name}", None)))
        if not photos:
            raise BadPhotoSet(
                f"measure photos: {path} holds no picture; put photos of the object there, or "
                "remove the folder."
            )
        objects[path.name] = tuple(photos)
    if boxes:
        raise BadPhotoSet(
            f"measure photos: {folder / BOXES_CSV} names {sorted(boxes)[0]!r}, which is not there; "
            "name photos as OBJECT/FILE."
        )
    return objects


def check_object_folder(path: Path, caller: str = "measure photos") -> None:
    """Raises: BadPhotoSet: the object of a folder of photos cannot be called as the folder is."""
    if not NAME.fullmatch(path.name):
        raise BadPhotoSet(f"{caller}: {path} cannot name an object; call it by {NAME_RULE}.")


def read_boxes(path: Path) -> dict[str, Box]:
    """The boxes of photos by OBJECT/FILE, none without the table. Raises: BadPhotoSet."""
    boxes: dict[str, Box] = {}
    if path.exists():
        for line, row in _read_csv(path, ("photo", *BOX)):
            box = _parse_box(row, f"{path} line {line}")
            if box is not None:
                boxes[row["photo"]] = box
    return boxes


def _read_scenes(folder: Path, known: Mapping[str, Any]) -> tuple[Scene, ...]:
    """Every scene with its rows of scenes.csv."""
    root, table = folder / "scenes", folder / SCENES_CSV
    if not root.is_dir() or not photos_in(root):
        raise BadPhotoSet(f"measure photos: {root} holds no picture; put photos of scenes there.")
    if not table.exists():
        raise BadPhotoSet(
            f"measure photos: {table} is not there; write a line scene,object,x0,y0,x1,y1 for "
            "every object of every scene."
        )
    paths = {path.name: path for path in photos_in(root)}
    rows: dict[str, dict[str, list[Box]]] = {}
    for line, row in _read_csv(table, ("scene", "object", *BOX)):
        where = f"{table} line {line}"
        if row["scene"] not in paths:
            raise BadPhotoSet(
                f"measure photos: {where} names the scene {row['scene']!r}, which is not in "
                f"{root}; give its file name."
            )
        box = _parse_box(row, where)
        if box is None and row["object"] not in known:
            raise BadPhotoSet(
                f"measure photos: {where} has no box and no references of {row['object']!r}; give "
                f"one, or put photos into references/{row['object']}."
            )
        boxes = rows.setdefault(row["scene"], {}).setdefault(row["object"], [])
        if box is not None:
            boxes.append(box)
    scenes = []
    for name, path in paths.items():
        if name not in rows:
            raise BadPhotoSet(
                f"measure photos: {table} has no line for {name}; name its objects, or remove it "
                f"from {root}."
            )
        of_scene = {}
        for obj, boxes in rows[name].items():
            of_scene[obj] = np.array(boxes, np.float32).reshape(-1, 4)
        scenes.append(Scene(name, path, of_scene, _masks_of(folder, name, of_scene)))
    _refuse_other_masks(folder, paths)
    return tuple(scenes)


def _masks_of(
    folder: Path, scene: str, boxes: Mapping[str, Float32[np.ndarray, "_n 4"]]
) -> dict[str, Path]:
    """The masks of one scene by the object's name. Raises: BadPhotoSet."""
    root = folder / MASKS / scene
    masks = {}
    if root.is_dir():
        for path in photos_in(root):
            if path.stem not in boxes or len(boxes[path.stem]) != 1:
                raise BadPhotoSet(
                    f"measure photos: {path} is a mask, but {SCENES_CSV} gives no single box of "
                    f"{path.stem!r} in {scene}; name masks as {MASKS}/SCENE/OBJECT.png."
                )
            masks[path.stem] = path
    return masks


def _refuse_other_masks(folder: Path, scenes: Mapping[str, Any]) -> None:
    if not (folder / MASKS).is_dir():
        return
    for path in sorted((folder / MASKS).iterdir()):
        if path.is_dir() and path.name not in scenes:
            raise BadPhotoSet(
                f"measure photos: {path} holds masks of no scene; name the folder as the scene's "
                "file, for example masks/desk.jpg."
            )


def read_categories(
    folder: Path, named: Iterable[str], caller: str = "measure photos"
) -> dict[str, str]:
    """The kind of every object: objects.csv's, else its name. Raises: BadPhotoSet."""
    categories = {}
    for name in named:
        categories[name] = name.replace("_", " ").replace("-", " ").strip()
    table = folder / OBJECTS_CSV
    if table.exists():
        for line, row in _read_csv(table, ("object", "category")):
            if row["object"] not in categories:
                raise BadPhotoSet(
                    f"{caller}: {table} line {line} names {row['object']!r}, which has no "
                    "references and is in no scene; mend the name."
                )
            categories[row["object"]] = row["category"]
    for name, category in categories.items():
        categories[name] = plain_category(category)
        if kind_instead(category):
            raise BadPhotoSet(
                f"{caller}: {category!r} cannot be a category; write {name},KIND into {table} "
                "with the kind in words, for example mug-1,cup."
            )
    return categories


def _read_csv(path: Path, columns: tuple[str, ...]) -> list[tuple[int, dict[str, str]]]:
    """Every row with the number of its line. Raises: BadPhotoSet."""
    return read_rows(path, columns, caller="measure photos", error=BadPhotoSet)


def _parse_box(row: Mapping[str, str], where: str) -> Box | None:
    """The box of a row; None where all four cells are empty."""
    cells = [row[name] for name in BOX]
    if not any(cells):
        return None
    try:
        box = np.array([float(cell) for cell in cells], np.float32)
    except ValueError as error:
        raise BadPhotoSet(
            f"measure photos: {where} has the box {','.join(cells)!r}; give four numbers "
            "x0,y0,x1,y1, or none where the object is absent."
        ) from error
    if not np.isfinite(box).all() or not (box[2:] > box[:2]).all():
        raise BadPhotoSet(
            f"measure photos: {where} has the box {','.join(cells)!r} without area; x to the "
            "right, y down, far corner last."
        )
    if (box[2:] - box[:2] < 1).any() or box.max() <= 1:
        raise BadPhotoSet(
            f"measure photos: {where} has the box {','.join(cells)!r} with a side of a pixel or "
            "less; give pixels, not fractions of the picture."
        )
    return box


def _sha256(folder: Path) -> str:
    """One checksum of every file of the form."""
    digest = hashlib.sha256()
    tables = [folder / SCENES_CSV, folder / BOXES_CSV, folder / OBJECTS_CSV]
    pictures = [*(folder / "references").rglob("*"), *(folder / "scenes").iterdir()]
    pictures += (folder / MASKS).rglob("*")
    for path in sorted({*tables, *pictures}):
        if path.is_file():
            digest.update(str(path.relative_to(folder)).encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


CAMERA = "photo"
BEYOND_PX = 4
"""How far a box that is drawn by hand may reach beyond its photo; it is clipped."""
Row = dict[str, Any]
Memory = Mapping[str, PersonalObject]


def measure_scene(
    scene: Scene, photo_set: PhotoSet, memory: Memory, attender: Attender
) -> list[Row]:
    """One row for every remembered object that the scene's lines name.

    Raises: BadPhoto when the photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    true_boxes, owners = _true_boxes(scene)
    candidates = _candidates(rgb, true_boxes, attender.stack)
    rows = []
    for name, boxes in scene.boxes.items():
        if name not in memory:
            continue
        category = photo_set.categories[name]
        kinds = [photo_set.categories[owner] for owner in owners]
        own = np.array([owner == name for owner in owners], bool)
        same_kind = np.array([kind == category for kind in kinds], bool)
        row: Row = {
            "scene": scene.name,
            "object": name,
            "category": category,
            "present": len(boxes) > 0,
            "lookalikes": int((same_kind & ~own).sum()),
        }
        row |= _ground(rgb, boxes, memory[name], attender)
        if len(boxes):
            every = np.ones(len(own), bool)
            row |= _vote("all", own, every, candidates, memory[name], attender, rgb)
            row |= _vote("kind", own, same_kind, candidates, memory[name], attender, rgb)
        rows.append(row)
    return rows


def clip_boxes(scene: Scene, rgb: Rgb) -> Scene:
    """The scene with its boxes clipped to its photo.

    Raises: BadPhotoSet: a box lies outside the photo, or reaches more than BEYOND_PX beyond it.
    """
    height, width = rgb.shape[:2]
    clipped = {}
    for name, boxes in scene.boxes.items():
        clipped[name] = np.clip(boxes, 0, (width, height, width, height)).astype(np.float32)
        for box, inside in zip(boxes, clipped[name], strict=True):
            flaw = ""
            if abs(box - inside).max() > BEYOND_PX:
                flaw = "reaches beyond"
            if (inside[2:] - inside[:2] < 1).any():
                flaw = "lies outside"
            if flaw:
                raise BadPhotoSet(
                    f"measure photos: the box {box.tolist()} of {name!r} {flaw} {scene.path}, "
                    f"which has {width}x{height} pixels when upright; mend scenes.csv."
                )
    return replace(scene, boxes=clipped)


def _true_boxes(scene: Scene) -> tuple[Boxes, list[str]]:
    """Every box of the scene, and whose it is."""
    every = [np.zeros((0, 4), np.float32)]
    owners = []
    for name, boxes in scene.boxes.items():
        every.append(boxes)
        owners += [name] * len(boxes)
    xyxy = np.concatenate(every)
    return Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes"), owners


def _candidates(rgb: Rgb, boxes: Boxes, stack: Stack) -> Candidates:
    """The true boxes, embedded as boxes of such a photo are, and their masks."""
    judged = judge(rgb, boxes, stack)
    return segment(rgb, embed(rgb, judged, stack), stack)


def judge(rgb: Rgb, boxes: Boxes, stack: Stack) -> Boxes:
    """Boxes given by hand, with whether their picture is familiar."""
    if isinstance(stack.detector, FamiliarityJudge):
        return replace(boxes, familiar=stack.detector.is_familiar(rgb, boxes.phrase))
    return boxes


def _ground(
    rgb: Rgb, boxes: Float32[np.ndarray, "_ 4"], obj: PersonalObject, attender: Attender
) -> Row:
    """The method's first step on the photo, and how its choice overlaps the true boxes."""
    started, cpu_started = perf_counter(), process_time()
    instruction = f"bring my {obj.category}"
    _, attended = attender.start({CAMERA: rgb}, instruction, objects=[obj.name])
    seconds, cpu_seconds = perf_counter() - started, process_time() - cpu_started
    (grounding,) = attended.groundings[CAMERA]
    overlap = box_iou(grounding.candidates.xyxy, boxes).max(axis=1, initial=0.0)
    row: Row = {
        "candidates": len(overlap),
        "proposed_iou": float(overlap.max(initial=0.0)),
        "tinted": grounding.winner is not None,
        "verified": _points(grounding),
        "familiar": grounding.candidates.familiar,
        "iou": 0.0,
        "ms": round(1000 * seconds, 1),
        "cpu_ms": round(1000 * cpu_seconds, 1),
        **_elected(grounding, overlap),
    }
    if grounding.winner is not None:
        row["iou"] = float(overlap[grounding.winner])
    return row


def _points(grounding: Grounding) -> int | None:
    """The verified points of the elected box; None where none were compared."""
    if grounding.chosen is None or grounding.candidates.verified is None:
        return None
    return int(grounding.candidates.verified[grounding.chosen])


def _elected(grounding: Grounding, overlap: Float[np.ndarray, " n"]) -> Row:
    """The box that the vote elected, tinted or not; None without candidates."""
    winner = grounding.chosen
    if winner is None:
        names = ("x0", "y0", "x1", "y1", "cosine", "likeness", "chosen_iou", "margin")
        return dict.fromkeys(names)
    x0, y0, x1, y1 = grounding.candidates.xyxy[winner].tolist()
    return {
        "x0": x0,
        "y0": y0,
        "x1": x1,
        "y1": y1,
        "cosine": float(grounding.similarity[winner].mean()),
        "likeness": float(grounding.likeness[winner]),
        "chosen_iou": float(overlap[winner]),
        "margin": grounding.ballot.margin,
    }


def _vote(
    among: str,
    own: Bool[np.ndarray, " n"],
    eligible: Bool[np.ndarray, " n"],
    candidates: Candidates,
    obj: PersonalObject,
    attender: Attender,
    rgb: Rgb,
) -> Row:
    """How the vote does among true boxes: with all references, and with each of them alone.

    The values are None where the object has no rival among them.
    """
    names = (f"{among}_boxes", f"{among}_one", f"{among}_every")
    rows = np.flatnonzero(eligible)
    if own[rows].all():
        return dict.fromkeys(names)
    among_them = _take(candidates, rows)
    right_alone = []
    for k in range(len(obj.crops)):
        elected = _elect(rgb, obj.take(slice(k, k + 1)), among_them, attender)
        right_alone.append(bool(own[rows[elected]]))
    elected = _elect(rgb, obj, among_them, attender)
    return {
        names[0]: len(rows),
        names[1]: float(np.mean(right_alone)),
        names[2]: bool(own[rows[elected]]),
    }


def _elect(rgb: Rgb, obj: PersonalObject, among: Candidates, attender: Attender) -> int:
    """The candidate that the method elects, points compared as in any such photo."""
    verifier = attender.stack.verifier
    if verifier is not None and not among.boxes.familiar:
        proved = prove(rgb, obj, Proposals(among.boxes, among.embeddings), verifier)
        among = replace(among, boxes=proved.boxes)
    winner = attender.ground(CAMERA, obj, among).ballot.winner
    assert winner is not None, "there are candidates"
    return winner


def _take(candidates: Candidates, rows: Int64[np.ndarray, " m"]) -> Candidates:
    """These candidates, in this order."""
    return Candidates(
        boxes=candidates.boxes.take(rows),
        embeddings=candidates.embeddings[rows],
        masks=candidates.masks[rows],
        ids=tuple(range(len(rows))),
    )


CHOSEN = 3
"""References that elect a left-out photo."""
TRIALS = 500
"""Elections of one object, drawn with seed 0."""


def mask_rows(scene: Scene, stack: Stack) -> list[Row]:
    """The IoU of the stack's mask from the true box with the true mask, a row per given mask.

    Raises: BadPhoto, BadPhotoSet: a mask cannot be read, or is not as large as its scene; or as
        `clip_boxes`.
    """
    if not scene.masks:
        return []
    rgb = load_photo(scene.path, long_side=None)
    names = sorted(scene.masks)
    true_boxes = clip_boxes(scene, rgb).boxes
    xyxy = np.concatenate([true_boxes[name] for name in names])
    boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes")
    found = stack.segmenter(rgb, judge(rgb, boxes, stack))
    rows: list[Row] = []
    for name, mask in zip(names, found, strict=True):
        truth = load_mask(scene.masks[name])
        if truth.shape != mask.shape:
            raise BadPhotoSet(
                f"measure photos: the mask {scene.masks[name]} has "
                f"{truth.shape[1]}x{truth.shape[0]} pixels, its scene "
                f"{mask.shape[1]}x{mask.shape[0]}; save it as large as the upright photo."
            )
        rows.append({"scene": scene.name, "object": name, "mask_iou": mask_iou(mask, truth)})
    return rows


def single_rows(memory: Mapping[str, PersonalObject], stack: Stack) -> list[Row]:
    """Whether three references elect a left-out photo of their object among photos of two others.

    All are cut as they were registered. Rivals are of the object's kind where two of it are known.
    A row per election; none of an object with fewer than four references, or without two rivals.
    """
    encoder = stack.unfamiliar_encoder or stack.encoder
    rows_of = {name: reference_rows(obj, encoder) for name, obj in memory.items()}
    rows: list[Row] = []
    for name, own in rows_of.items():
        kind = memory[name].category
        others = [other for other in memory if other != name]
        alike = [other for other in others if memory[other].category == kind]
        if len(alike) >= 2:
            others = alike
        if len(own) <= CHOSEN or len(others) < 2:
            continue
        rng = np.random.default_rng(0)
        chosen = list(combinations(range(len(own)), CHOSEN))
        pairs = list(combinations(others, 2))
        for _ in range(TRIALS):
            references = list(chosen[int(rng.integers(len(chosen)))])
            left_out = np.setdiff1d(np.arange(len(own)), references)
            candidates = [own[int(rng.choice(left_out))]]
            for rival in pairs[int(rng.integers(len(pairs)))]:
                candidates.append(rows_of[rival][int(rng.integers(len(rows_of[rival])))])
            cosine = similarity(np.stack(candidates), own[references])
            rows.append({"object": name, "right": vote(cosine).winner == 0})
    return rows


FRAMES = 48
"""Of one clip, there and back."""
WINDOW = 1.2
"""The window's width, in widths of the photo."""
SIDE = 640
"""The longer side of a frame."""
IN_VIEW = 0.5
"""Share of the object's box inside the frame from which on it is in view."""


@value
class Pan:
    """The frames' left edges in pixels of the doubled photo, and the scale of frames."""

    left: Float64[np.ndarray, " f"]
    scale: float
    width: int
    photo_width: int

    def boxes(self, frame: int, boxes: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
        """Boxes of the doubled photo in a frame's pixels; they may reach beyond it."""
        moved = boxes - self.left[frame] * np.array([1.0, 0.0, 1.0, 0.0])
        return moved * self.scale


def pan_over(rgb: Rgb) -> Pan:
    """The path of the window over a photo and its copy: all of the photo, all of the copy, back."""
    height, width = rgb.shape[:2]
    window = round(WINDOW * width)
    phase = 2 * np.pi * np.arange(FRAMES) / (FRAMES - 1)
    left = np.round((2 * width - window) * (1 - np.cos(phase)) / 2)
    scale = min(1.0, SIDE / max(window, height))
    return Pan(left=left, scale=scale, width=window, photo_width=width)


def frames_of(rgb: Rgb, pan: Pan) -> Iterator[Rgb]:
    """The frames of a clip."""
    doubled = np.concatenate([rgb, rgb], axis=1)
    size = (round(pan.scale * pan.width), round(pan.scale * rgb.shape[0]))
    for left in pan.left.astype(int).tolist():
        part = doubled[:, left : left + pan.width]
        yield cv2.resize(part, size, interpolation=cv2.INTER_AREA)


def follow_scene(scene: Scene, photo_set: PhotoSet, stack: Stack) -> list[Row]:
    """A row for every object that is in view and has references.

    `end` is what the mask lies on when the window is back: object, twin, other, or "" for no mask.
    `on_object` counts frames, of the `in_view` ones, `on_twin` of all `frames`.

    Raises: BadPhoto when the scene's photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    pan = pan_over(rgb)
    subjects = {subject.name for subject in photo_set.subjects}
    rows = []
    for name, boxes in scene.boxes.items():
        if name in subjects and len(boxes):
            rows.append(
                {"scene": scene.name, "object": name, **_follow(rgb, pan, scene, name, stack)}
            )
    return rows


def _follow(rgb: Rgb, pan: Pan, scene: Scene, name: str, stack: Stack) -> Row:
    """Track one object through the clip."""
    own = scene.boxes[name][0].astype(np.float64)
    twin = own + np.array([pan.photo_width, 0.0, pan.photo_width, 0.0])
    pair = np.stack([own, twin])
    counts = {"frames": FRAMES, "in_view": 0, "on_object": 0, "on_twin": 0}
    end = ""
    states: list[Any] = []
    for number, frame in enumerate(frames_of(rgb, pan)):
        if number == 0:
            states, mask = _start(frame, pan, scene, name, stack)
        else:
            states, tracks = stack.tracker.step(states, [frame])
            mask = tracks[0][0].mask
        here = pan.boxes(number, pair)
        end = lies_on(mask, here)
        if visible_share(here[0], frame) >= IN_VIEW:
            counts["in_view"] += 1
            counts["on_object"] += end == "object"
        counts["on_twin"] += end == "twin"
    return {**counts, "end": end}


def _start(
    frame: Rgb, pan: Pan, scene: Scene, name: str, stack: Stack
) -> tuple[list[Any], Mask | None]:
    """The tracker of the first frame, and the object's mask there; the object is identity 0."""
    order = [name, *(other for other in scene.boxes if other != name)]
    known: list[np.ndarray] = []
    for other in order:
        for box in scene.boxes[other][:1].astype(np.float64):
            twin = box + np.array([pan.photo_width, 0.0, pan.photo_width, 0.0])
            known += [box, twin]
    here = pan.boxes(0, np.stack(known))
    kept = [i for i, box in enumerate(here) if i == 0 or visible_share(box, frame) >= IN_VIEW]
    height, width = frame.shape[:2]
    xyxy = np.clip(here[kept], 0, (width, height, width, height)).astype(np.float32)
    boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes")
    masks = stack.segmenter(frame, judge(frame, boxes, stack))
    tracker = stack.tracker
    if isinstance(tracker, TargetTracker):
        return tracker.start_targets([frame], [masks], [[0]]), masks[0]
    return tracker.start([frame], [masks]), masks[0]


def visible_share(box: Float64[np.ndarray, "4"], frame: Rgb) -> float:
    """The share of a box that lies inside of the frame."""
    height, width = frame.shape[:2]
    inside = np.clip(box, 0, (width, height, width, height))
    sides = np.maximum(inside[2:] - inside[:2], 0)
    return float(sides.prod() / (box[2:] - box[:2]).prod())


def lies_on(mask: Mask | None, pair: Float64[np.ndarray, "2 4"]) -> str:
    """Where most of a mask lies: in the object's box, its twin's, or neither; "" for no mask."""
    if mask is None or not mask.any():
        return ""
    for name, box in zip(("object", "twin"), pair, strict=True):
        x0, y0, x1, y1 = np.maximum(np.round(box), 0).astype(int).tolist()
        if mask[y0:y1, x0:x1].sum() > 0.5 * mask.sum():
            return name
    return "other"


RIGHT_IOU, LOOSE_IOU = 0.5, 0.25
NOTE = (
    "value [95 % interval] n, in %; Wilson's interval with n reduced to what the scenes, which are "
    "the independent units, are worth.\n"
    "right: the tinted box overlaps the object by IoU .5; proposed: some candidate does. wrong: "
    "another box is tinted. silent: nothing is; not in view: of the rightly elected, those too "
    "unlike the references to be tinted. look-alikes: other objects of its kind in the "
    "scene.\n"
    "vote: the true boxes of a scene are the candidates; with one reference (the mean over them) "
    "and with all."
)


def text_report(table: "pd.DataFrame") -> str:
    """What the command prints."""
    seconds = f"ms a photo: median {table.ms.median():.0f}, slowest {table.ms.max():.0f}"
    if "cpu_ms" in table:
        cpu = table.cpu_ms
        seconds += f"; of CPU: median {cpu.median():.0f}, slowest {cpu.max():.0f}"
    parts = [align(object_rows(table)), align(scene_rows(table)), align(vote_rows(table))]
    return "\n\n".join([*parts, f"{seconds}\n{NOTE}"])


def clip_report(clips: "pd.DataFrame") -> str:
    """What became of the objects in clips made of the scenes."""
    if not len(clips):
        return "clips: no object with references is in view in any scene"
    rows = [["clips", "on the object", "on its twin", "elsewhere", "no mask"]]
    cells = []
    for end in ("object", "twin", "other", ""):
        cells.append(_share(clips.end == end, clips))
    rows.append(["at the end", *cells])
    in_view, on_object = int(clips.in_view.sum()), int(clips.on_object.sum())
    on_twin, frames = int(clips.on_twin.sum()), int(clips.frames.sum())
    return (
        f"{align(rows)}\n\nclips: the object's mask in {on_object} of {in_view} frames that show "
        f"it, its twin's in {on_twin} of {frames} frames. The window pans from a photo to a copy "
        "of it and back; the tracker starts from the true boxes."
    )


def mask_report(masks: "pd.DataFrame") -> str:
    """How well the true masks are met from true boxes; the interval resamples scenes."""
    if not len(masks):
        return ""
    estimate = clustered_mean(masks.mask_iou.to_numpy(np.float64), masks.scene)
    return f"masks from true boxes: mean IoU {estimate.text(scale=1.0, digits=2)}"


def single_report(single: "pd.DataFrame") -> str:
    """How often three references elect a left-out photo of their object among two others'."""
    if not len(single):
        return ""
    found = clustered_share(single.right.to_numpy(float), single.object)
    by_object = single.groupby("object").right.mean()
    return (
        f"photos of one object: three references elect a left-out one among photos of two others "
        f"in {found.text()} elections of {len(by_object)} objects, which are the independent "
        f"units; worst: {by_object.idxmin()}, {100 * by_object.min():.0f}"
    )


def clustered_mean(values: Float64[np.ndarray, " n"], clusters: Iterable[object]) -> Estimate:
    """The mean, and percentiles of it when whole clusters are drawn again, seeded."""
    _, number = np.unique([str(name) for name in clusters], return_inverse=True)
    sums = np.bincount(number, values)
    counts = np.bincount(number).astype(np.float64)
    low = high = float("nan")
    if len(sums) > 1:
        share = np.full(len(sums), 1 / len(sums))
        times = np.random.default_rng(0).multinomial(len(sums), share, DRAWS)
        low, high = np.percentile(times @ sums / (times @ counts), [2.5, 97.5]).tolist()
    return Estimate(value=float(values.mean()), low=low, high=high, n=len(values))


def object_rows(table: "pd.DataFrame") -> Rows:
    """One line per object, and one for all: counts."""
    rows = [
        ["object", "kind", "in view", "right", "IoU .25", "wrong", "silent", "absent", "tinted"]
    ]
    for (name, kind), part in table.groupby(["object", "category"], sort=True):
        rows.append([str(name), str(kind), *_counts(part)])
    rows.append(["all", "", *_counts(table)])
    return rows


def scene_rows(table: "pd.DataFrame") -> Rows:
    """One line per kind of scene: with the object and without, with look-alikes and without."""
    head = ["scenes", "proposed", "right", "right at IoU .25", "wrong tinted", "silent"]
    rows = [[*head, "not in view"]]
    seen, absent = table[table.present], table[~table.present]
    kinds = (
        ("object in view", seen),
        ("- beside look-alikes", seen[seen.lookalikes > 0]),
        ("- alone of its kind", seen[seen.lookalikes == 0]),
        ("object absent", absent),
        ("- look-alikes in view", absent[absent.lookalikes > 0]),
        ("- none of its kind", absent[absent.lookalikes == 0]),
    )
    for number, (name, part) in enumerate(kinds):
        right = part.iou >= RIGHT_IOU
        measures = [part.proposed_iou >= RIGHT_IOU, right, part.iou >= LOOSE_IOU]
        cells = [_share(hits, part) for hits in measures]
        if number >= 3:
            cells = ["", "", ""]
        cells += [_share(part.tinted & ~right, part), _share(~part.tinted, part)]
        elected = part[part.chosen_iou.astype(float).fillna(0) >= RIGHT_IOU]
        price = _share(~elected.tinted, elected)
        rows.append([name, *cells, price if number < 3 else ""])
    return rows


def vote_rows(table: "pd.DataFrame") -> Rows:
    """How the vote does among the true boxes of a scene."""
    rows = [["vote among", "boxes", "chance", "one reference", "all references"]]
    for among, name in (("all", "all true boxes"), ("kind", "those of its kind")):
        cells = [name]
        known = table
        if f"{among}_boxes" in table:
            known = table.dropna(subset=[f"{among}_boxes"])
        if f"{among}_boxes" not in table or not len(known):
            rows.append([*cells, "-", "-", "-", "-"])
            continue
        boxes = known[f"{among}_boxes"].to_numpy(float)
        cells += [f"{boxes.mean():.1f}", f"{100 * (1 / boxes).mean():.0f}"]
        for column in (f"{among}_one", f"{among}_every"):
            cells.append(_share(known[column], known))
        rows.append(cells)
    return rows


def _share(hits: "pd.Series", part: "pd.DataFrame") -> str:
    """The share of hits with its interval, scenes as clusters."""
    return clustered_share(hits.to_numpy(float), part.scene).text(digits=0)


def _counts(part: "pd.DataFrame") -> list[str]:
    """In view, right, right at IoU .25, wrong, silent; absent, tinted all the same."""
    seen, absent = part[part.present], part[~part.present]
    wrong = seen.tinted & (seen.iou < RIGHT_IOU)
    counts = (
        len(seen),
        (seen.iou >= RIGHT_IOU).sum(),
        (seen.iou >= LOOSE_IOU).sum(),
        wrong.sum(),
        (~seen.tinted).sum(),
        len(absent),
        absent.tinted.sum(),
    )
    return [str(int(count)) for count in counts]


WIDTH_PX, HEIGHT_PX, TILES = 360, 270, 24


def write_sheets(photo_set: PhotoSet, table: "pd.DataFrame", folder: Path) -> list[Path]:
    """Write sheet-01.png and so on, at most 24 questions each, in the order of the scenes.

    White: the true box. Green: tinted and right. Red: tinted and wrong. Grey: elected, not tinted.

    Raises: BadOutput.
    """
    scenes = {scene.name: scene for scene in photo_set.scenes}
    tiles = []
    for name, part in table.groupby("scene", sort=True):
        rgb = load_photo(scenes[str(name)].path, long_side=None)
        for row in part.to_dict("records"):
            tiles.append(_tile(rgb, scenes[str(name)], row))
    paths = []
    for first in range(0, len(tiles), TILES):
        path = folder / f"sheet-{1 + first // TILES:02}.png"
        write_picture(path, join_tiles(tiles[first : first + TILES], gap_px=GAP_PX))
        paths.append(path)
    return paths


def _tile(rgb: Rgb, scene: Scene, row: Mapping[str, object]) -> Rgb:
    tile, scale = fit(rgb, WIDTH_PX, HEIGHT_PX)
    name = str(row["object"])
    for box in scene.boxes[name]:
        draw_box(tile, (scale * box).tolist(), TRUTH, 2)
    verdict = "nothing proposed"
    if row["x0"] == row["x0"] and row["x0"] is not None:
        colour, verdict = _verdict(row)
        elected = np.array([row["x0"], row["y0"], row["x1"], row["y1"]], np.float64)
        draw_box(tile, (scale * elected).tolist(), colour, 2)
    presence = "in view" if row["present"] else "absent"
    return labelled(tile, [f"{name} ({presence}) in {scene.name}", f"{verdict}{evidence(row)}"])


def evidence(row: Mapping[str, object]) -> str:
    """What a label says of the elected box, tinted or not; "" where none is elected.

    Its overlap with the object, where that is in view, and the likeness that the threshold of "not
    in view" reads.
    """
    if row["likeness"] is None or row["likeness"] != row["likeness"]:
        return ""
    overlap = f", IoU {row['chosen_iou']:.2f}" if row["present"] else ""
    return f"{overlap}, likeness {row['likeness']:.2f}"


def _verdict(row: Mapping[str, object]) -> tuple[tuple[int, int, int], str]:
    if not row["tinted"]:
        return SILENT, "not tinted"
    iou = row["iou"]
    assert isinstance(iou, float)
    if iou >= RIGHT_IOU:
        return RIGHT, "right"
    return WRONG, "wrong"


TABLE, CLIPS, MASK_TABLE, SINGLE = "questions", "clips", "masks", "single"


def measure_photos(
    folder: Path,
    out: Path,
    stack_name: str,
    *,
    clips: bool = False,
    kept: bool = True,
    progress: bool = True,
) -> str:
    """Do what `out` lacks of the measurement, write tables and sheets, and return the report.

    With `clips` objects are followed through clips made of the scenes, too (clips.py). Where not
    `kept`, thresholds that were kept on this machine do not count: the best candidate wins. With
    `progress` stderr has bars, and a note of the objects that have no references.

    Raises: BadPhotoSet, BadPhoto; MissingWeights; BadOutput when `out` holds another run.
    """
    import pandas as pd

    photo_set = read_photo_set(folder)
    if progress and photo_set.subjects and photo_set.rivals:
        print(_rivals_note(photo_set), file=sys.stderr)
    store.open_run(out, _configuration(photo_set, stack_name, kept))
    parts: list[str] = []
    written: list[Path] = []
    with store.locked(out):
        stack = load_stack(stack_name)
        if not kept and not ships_thresholds(stack_name):
            stack = replace(stack, thresholds=None)
        if photo_set.subjects:
            memory = remember_subjects(photo_set.subjects, stack, out / "memory")
            attender = Attender(stack, memory)
            table = _of_scenes(
                photo_set,
                out,
                "",
                progress,
                lambda scene: measure_scene(scene, photo_set, memory, attender),
            )
            single = pd.DataFrame(single_rows(memory, stack))
            written += write_table(table, out, TABLE)
            if len(single):
                written += write_table(single, out, SINGLE)
            written += write_sheets(photo_set, table, out)
            parts += [text_report(table), single_report(single)]
        if any(scene.masks for scene in photo_set.scenes):
            masks = _of_scenes(
                photo_set, out, MASK_TABLE, progress, lambda scene: mask_rows(scene, stack)
            )
            written += write_table(masks, out, MASK_TABLE)
            parts.append(mask_report(masks))
        if clips:
            followed = _of_scenes(
                photo_set, out, CLIPS, progress, lambda scene: follow_scene(scene, photo_set, stack)
            )
            written += write_table(followed, out, CLIPS)
            parts.append(clip_report(followed))
        report = "\n\n".join(part for part in parts if part)
        with writing(out, "measure photos"):
            write_atomic(out / "report.txt", f"{report}\n".encode())
    names = ", ".join(map(str, written))
    return f"{report}\n\nwrote {names}"


def _rivals_note(photo_set: PhotoSet) -> str:
    """A misspelt object is a rival, too, and no question then asks for it."""
    return (
        f"note: {SCENES_CSV} names {', '.join(photo_set.rivals)} without references: taken as "
        "rivals, not asked for; where one is misspelt, mend it and measure anew"
    )


def _configuration(photo_set: PhotoSet, stack_name: str, kept: bool) -> dict[str, object]:
    """What the results depend on."""
    return {
        "measurement": "photos",
        "photos": photo_set.sha256,
        "stack": stack_name,
        "version": __version__,
        **checksums(stack_name, kept),
    }


def _of_scenes(
    photo_set: PhotoSet,
    out: Path,
    what: str,
    progress: bool,
    measure: Callable[[Scene], list[Row]],
) -> "pd.DataFrame":
    """The rows of every scene, measured or read again."""
    import pandas as pd
    from tqdm import tqdm

    rows: list[Row] = []
    suffix = f".{what}.json" if what else ".json"
    bar = tqdm(photo_set.scenes, unit="scene", desc=what or "photos", disable=not progress)
    for scene in bar:
        path = out / "parts" / f"{scene.name}{suffix}"
        if not path.exists():
            write_json_part(path, measure(scene), caller="measure photos")
        rows.extend(read_json_part(path, caller="measure photos"))
    return pd.DataFrame(rows)


def remember_subjects(
    subjects: Iterable[Subject], stack: Stack, folder: Path
) -> dict[str, PersonalObject]:
    """Every subject of a photo set as an object of `folder`; those that it holds are kept.

    Doubtful crops are used as they are, so that nothing is tuned by hand; a sheet shows each.

    Raises: BadPhoto, BadPhotoSet, BadEncoder.
    """
    known = load_bank(folder, stack.encoder.name)
    memory = {}
    for subject in subjects:
        obj = known.get(subject.name)
        if obj is None:
            paths = [photo.path for photo in subject.photos]
            given = {}
            for i, photo in enumerate(subject.photos):
                if photo.box is not None:
                    given[i] = photo.box
            try:
                references = choose(paths, subject.category, stack, given, whole=False)
            except BadPhoto as error:
                raise BadPhotoSet(f"measure photos: {error}") from error
            write_sheet(folder / f"{subject.name}.references.png", references, paths)
            obj = remember_references(subject.name, subject.category, references, stack)
            save(folder, obj)
        memory[subject.name] = obj
    return memory
