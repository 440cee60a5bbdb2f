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
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import batched, combinations
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from vap_core import __version__
from vap_core.attend import Attender
from vap_core.base.errors import BadPhoto, BadPhotoSet
from vap_core.base.files import read_rows
from vap_core.base.media import load_mask, load_photo, photos_in
from vap_core.base.types import Boxes, Mask, PersonalObject, Rgb, value
from vap_core.memory import (
    NAME,
    NAME_RULE,
    kind_instead,
    load_bank,
    plain_category,
    reference_rows,
    save,
)
from vap_core.perception.boxes import box_iou, mask_iou, parse_box
from vap_core.perception.candidates import Candidates, Proposals, embed, judge, prove, segment
from vap_core.perception.protocols import Stack, TargetTracker
from vap_core.perception.stacks import checksums, load_stack, ships_thresholds
from vap_core.study import measurement
from vap_core.study.measurement import Measurement, Row, Tables
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
from vap_core.study.stats import clustered_share, mean_by, share_by, summary
from vap_core.study.table import printed
from vap_core.vote import similarity, vote

if TYPE_CHECKING:
    import pandas as pd

BOX = ("x0", "y0", "x1", "y1")
MASKS = "masks"
SCENES_CSV, BOXES_CSV, OBJECTS_CSV = "scenes.csv", "references/boxes.csv", "objects.csv"
Box = Float32[np.ndarray, "4"]


@value
class Subject:
    """An object with references, what is registered and asked for: its photos, each with its box
    where the folder gives one.
    """

    name: str
    category: str
    photos: tuple[tuple[Path, Box | None], ...]


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
        return tuple(sorted(set(self.categories) - {subject.name for subject in self.subjects}))


_read_csv = partial(read_rows, caller="measure photos", error=BadPhotoSet)


def _wrong(text: str) -> BadPhotoSet:
    return BadPhotoSet(f"measure photos: {text}")


def read_photo_set(folder: Path) -> PhotoSet:
    """Read a folder in this form.

    Raises: BadPhotoSet: something is missing, or a line does not fit; the message names it.
    """
    if not folder.is_dir():
        raise _wrong(f"{folder} is no folder; see ./vap measure photos --help.")
    photos = _read_references(folder)
    scenes = _read_scenes(folder, photos)
    shown = {name for scene in scenes for name in scene.boxes}
    if photos and shown.isdisjoint(photos):
        raise _wrong(
            f"{folder / SCENES_CSV} names {', '.join(sorted(shown)[:4])}, references are there of "
            f"{', '.join(sorted(photos)[:4])}; name an object alike in both."
        )
    categories = read_categories(folder, {*photos, *shown})
    subjects = [Subject(name, categories[name], found) for name, found in photos.items()]
    return PhotoSet(tuple(subjects), scenes, categories, _sha256(folder))


def _read_references(folder: Path) -> dict[str, tuple[tuple[Path, Box | None], ...]]:
    """The photos of every object, with their boxes."""
    root, table = folder / "references", folder / BOXES_CSV
    folders = sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    if not folders and (folder / MASKS).is_dir():
        return {}
    if not folders:
        raise _wrong(
            f"{root} holds no folder of photos; put each object's photos into references/OBJECT."
        )
    boxes = {
        row["photo"]: _box_of(row, f"{table} line {line}")
        for line, row in (_read_csv(table, ("photo", *BOX)) if table.exists() else ())
    }
    objects = {}
    for path in folders:
        if not NAME.fullmatch(path.name):
            raise _wrong(f"{path} cannot name an object; call it by {NAME_RULE}.")
        photos = photos_in(path)
        if not photos:
            raise _wrong(
                f"{path} holds no picture; put photos of the object there, or remove the folder."
            )
        objects[path.name] = tuple(
            (photo, boxes.pop(f"{path.name}/{photo.name}", None)) for photo in photos
        )
    if boxes:
        raise _wrong(
            f"{table} names {sorted(boxes)[0]!r}, which is not there; name photos as OBJECT/FILE."
        )
    return objects


def _read_scenes(folder: Path, known: Mapping[str, Any]) -> tuple[Scene, ...]:
    """Every scene with its rows of scenes.csv."""
    root, table = folder / "scenes", folder / SCENES_CSV
    paths = {path.name: path for path in photos_in(root)} if root.is_dir() else {}
    if not paths:
        raise _wrong(f"{root} holds no picture; put photos of scenes there.")
    if not table.exists():
        raise _wrong(
            f"{table} is not there; write a line scene,object,x0,y0,x1,y1 for every object of "
            "every scene."
        )
    rows: dict[str, dict[str, list[Box]]] = {}
    for line, row in _read_csv(table, ("scene", "object", *BOX)):
        where, name = f"{table} line {line}", row["object"]
        if row["scene"] not in paths:
            raise _wrong(
                f"{where} names the scene {row['scene']!r}, which is not in {root}; give its file "
                "name."
            )
        box = _box_of(row, where)
        if box is None and name not in known:
            raise _wrong(
                f"{where} has no box and no references of {name!r}; give one, or put photos into "
                f"references/{name}."
            )
        boxes = rows.setdefault(row["scene"], {}).setdefault(name, [])
        boxes += [] if box is None else [box]
    for name in paths:
        if name not in rows:
            raise _wrong(
                f"{table} has no line for {name}; name its objects, or remove it from {root}."
            )
    masks = _read_masks(folder, rows)
    return tuple(
        Scene(
            name,
            path,
            {obj: np.array(each, np.float32).reshape(-1, 4) for obj, each in rows[name].items()},
            masks.get(name, {}),
        )
        for name, path in paths.items()
    )


def _read_masks(
    folder: Path, rows: Mapping[str, Mapping[str, list[Box]]]
) -> dict[str, dict[str, Path]]:
    """The masks of every scene's objects, `rows`."""
    root, found = folder / MASKS, {}
    for place in sorted(root.iterdir()) if root.is_dir() else ():
        if not place.is_dir():
            continue
        name = place.name
        if name not in rows:
            raise _wrong(
                f"{place} holds masks of no scene; name the folder as the scene's file, for "
                "example masks/desk.jpg."
            )
        found[name] = {mask.stem: mask for mask in photos_in(place)}
        for stem, mask in found[name].items():
            if len(rows[name].get(stem, ())) != 1:
                raise _wrong(
                    f"{mask} is a mask, but {SCENES_CSV} gives no single box of {stem!r} in "
                    f"{name}; name masks as {MASKS}/SCENE/OBJECT.png."
                )
    return found


def read_categories(folder: Path, named: Iterable[str]) -> dict[str, str]:
    """The kind of every object: objects.csv's, else its name. Raises: BadPhotoSet."""
    categories = {name: name.replace("_", " ").replace("-", " ").strip() for name in named}
    table = folder / OBJECTS_CSV
    for line, row in _read_csv(table, ("object", "category")) if table.exists() else ():
        if row["object"] not in categories:
            raise _wrong(
                f"{table} line {line} names {row['object']!r}, which has no references "
                "and is in no scene; mend the name."
            )
        categories[row["object"]] = row["category"]
    for name, category in categories.items():
        categories[name] = plain_category(category)
        if kind_instead(category):
            raise _wrong(
                f"{category!r} cannot be a category; write {name},KIND into {table} "
                "with the kind in words, for example mug-1,cup."
            )
    return categories


def _box_of(row: Mapping[str, str], where: str) -> Box | None:
    """The box of a row; None where all four cells are empty."""
    cells = [row[name] for name in BOX]
    return (
        parse_box(",".join(cells), f"measure photos: {where}", BadPhotoSet) if any(cells) else None
    )


def _sha256(folder: Path) -> str:
    """One checksum of every file of the form."""
    digest = hashlib.sha256()
    tables = [folder / SCENES_CSV, folder / BOXES_CSV, folder / OBJECTS_CSV]
    pictures = [*(folder / "references").rglob("*"), *(folder / "scenes").iterdir()]
    for path in sorted({*tables, *pictures, *(folder / MASKS).rglob("*")}):
        if path.is_file():
            digest.update(str(path.relative_to(folder)).encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


CAMERA = "photo"
BEYOND_PX = 4
"""How far a box that is drawn by hand may reach beyond its photo; it is clipped."""
Memory = Mapping[str, PersonalObject]


def measure_scene(
    scene: Scene, photo_set: PhotoSet, memory: Memory, attender: Attender
) -> list[Row]:
    """One row for every remembered object that the scene's lines name.

    Raises: BadPhoto when the photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    owners = np.array([name for name, boxes in scene.boxes.items() for _ in boxes], str)
    kinds = np.array([photo_set.categories[owner] for owner in owners], str)
    true_boxes = _true_boxes(np.concatenate([np.zeros((0, 4), np.float32), *scene.boxes.values()]))
    stack = attender.stack
    candidates = segment(
        rgb, embed(rgb, judge(rgb, true_boxes, true_boxes.phrase, stack), stack), stack
    )
    rows = []
    for name, boxes in scene.boxes.items():
        if name not in memory:
            continue
        category = photo_set.categories[name]
        own, alike = owners == name, kinds == category
        row = {
            "scene": scene.name,
            "object": name,
            "category": category,
            "present": len(boxes) > 0,
            "lookalikes": int((alike & ~own).sum()),
            **_ground(rgb, boxes, memory[name], attender),
        }
        for among, eligible in (("all", own | True), ("kind", alike)) if len(boxes) else ():
            row |= _vote(among, own, eligible, candidates, memory[name], attender, rgb)
        rows.append(row)
    return rows


def _true_boxes(xyxy: Float32[np.ndarray, "n 4"]) -> Boxes:
    return Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes")


def clip_boxes(scene: Scene, rgb: Rgb) -> Scene:
    """The scene with its boxes clipped to its photo.

    Raises: BadPhotoSet: a box lies outside the photo, or reaches more than BEYOND_PX beyond it.
    """
    height, width = rgb.shape[:2]
    clipped = {}
    for name, boxes in scene.boxes.items():
        clipped[name] = np.clip(boxes, 0, (width, height, width, height)).astype(np.float32)
        for box, inside in zip(boxes, clipped[name], strict=True):
            flaw = "reaches beyond" if abs(box - inside).max() > BEYOND_PX else ""
            flaw = "lies outside" if (inside[2:] - inside[:2] < 1).any() else flaw
            if flaw:
                raise _wrong(
                    f"the box {box.tolist()} of {name!r} {flaw} {scene.path}, which has "
                    f"{width}x{height} pixels when upright; mend scenes.csv."
                )
    return replace(scene, boxes=clipped)


def _ground(
    rgb: Rgb, boxes: Float32[np.ndarray, "_ 4"], obj: PersonalObject, attender: Attender
) -> Row:
    """The method's first step on the photo, and how its choice overlaps the true boxes.

    The box that the vote elected is there whether it is tinted or not; None without candidates.
    """
    started, cpu_started = perf_counter(), process_time()
    _, attended = attender.start({CAMERA: rgb}, f"bring my {obj.category}", objects=[obj.name])
    ms, cpu_ms = 1000 * (perf_counter() - started), 1000 * (process_time() - cpu_started)
    (grounding,) = attended.groundings[CAMERA]
    candidates, chosen = grounding.candidates, grounding.chosen
    overlap = box_iou(candidates.xyxy, boxes).max(axis=1, initial=0.0)
    elected = dict.fromkeys((*BOX, "cosine", "likeness", "chosen_iou", "margin", "verified"))
    if chosen is not None:
        verified = candidates.verified
        elected = {
            **dict(zip(BOX, candidates.xyxy[chosen].tolist(), strict=True)),
            "cosine": float(grounding.similarity[chosen].mean()),
            "likeness": float(grounding.likeness[chosen]),
            "chosen_iou": float(overlap[chosen]),
            "margin": grounding.ballot.margin,
            "verified": None if verified is None else int(verified[chosen]),
        }
    return {
        "candidates": len(overlap),
        "proposed_iou": float(overlap.max(initial=0.0)),
        "tinted": grounding.winner is not None,
        "verified": elected.pop("verified"),
        "familiar": candidates.familiar,
        "iou": 0.0 if grounding.winner is None else float(overlap[grounding.winner]),
        "ms": round(ms, 1),
        "cpu_ms": round(cpu_ms, 1),
        **elected,
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
    few = Candidates(
        boxes=candidates.boxes.take(rows),
        embeddings=candidates.embeddings[rows],
        masks=candidates.masks[rows],
        ids=tuple(range(len(rows))),
    )
    singles = [obj.take(slice(k, k + 1)) for k in range(len(obj.crops))]
    *alone, together = (own[rows[_elect(rgb, each, few, attender)]] for each in (*singles, obj))
    return dict(zip(names, (len(rows), float(np.mean(alone)), bool(together)), strict=True))


def _elect(rgb: Rgb, obj: PersonalObject, among: Candidates, attender: Attender) -> int:
    """The candidate that the method elects, points compared as in any such photo."""
    verifier = attender.stack.verifier
    if verifier is not None and not among.boxes.familiar:
        proved = prove(rgb, obj, Proposals(among.boxes, among.embeddings), verifier)
        among = replace(among, boxes=proved.boxes)
    winner = attender.ground(CAMERA, obj, among).ballot.winner
    assert winner is not None, "there are candidates"
    return winner


CHOSEN = 3
"""References that elect a left-out photo."""
TRIALS = 500
"""Elections of one object, drawn with seed 0."""


def mask_rows(scene: Scene, stack: Stack) -> list[Row]:
    """The IoU of the stack's mask from the true box with the true mask, a row per given mask.

    Raises: BadPhoto, BadPhotoSet: a mask cannot be read, or is not as large as its scene; or as
        `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    names = sorted(scene.masks)
    clipped = clip_boxes(scene, rgb).boxes
    boxes = _true_boxes(np.concatenate([clipped[name] for name in names]))
    found = stack.segmenter(rgb, judge(rgb, boxes, boxes.phrase, stack))
    rows: list[Row] = []
    for name, mask in zip(names, found, strict=True):
        truth = load_mask(scene.masks[name])
        if truth.shape != mask.shape:
            raise _wrong(
                f"the mask {scene.masks[name]} has {truth.shape[1]}x{truth.shape[0]} pixels, its "
                f"scene {mask.shape[1]}x{mask.shape[0]}; save it as large as the upright photo."
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
        others = [other for other in memory if other != name]
        alike = [other for other in others if memory[other].category == memory[name].category]
        others = alike if len(alike) >= 2 else others
        if len(own) <= CHOSEN or len(others) < 2:
            continue
        rng = np.random.default_rng(0)
        chosen = list(combinations(range(len(own)), CHOSEN))
        pairs = list(combinations(others, 2))
        for _ in range(TRIALS):
            references = list(chosen[int(rng.integers(len(chosen)))])
            candidates = [own[int(rng.choice(np.setdiff1d(np.arange(len(own)), references)))]]
            candidates.extend(
                rows_of[rival][int(rng.integers(len(rows_of[rival])))]
                for rival in pairs[int(rng.integers(len(pairs)))]
            )
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

    def with_twins(self, boxes: Float[np.ndarray, "n 4"]) -> Float64[np.ndarray, "m 4"]:
        """Each box of the photo, and then that of its copy."""
        twin = np.array([self.photo_width, 0.0, self.photo_width, 0.0])
        return np.stack([boxes.astype(np.float64), boxes + twin], axis=1).reshape(-1, 4)


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
        yield cv2.resize(doubled[:, left : left + pan.width], size, interpolation=cv2.INTER_AREA)


def follow_scene(scene: Scene, photo_set: PhotoSet, stack: Stack) -> list[Row]:
    """A row for every object that is in view and has references, tracked through the clip.

    `end` is what the mask lies on when the window is back: object, twin, other, or "" for no mask.
    `on_object` counts frames, of the `in_view` ones, `on_twin` of all `frames`.

    Raises: BadPhoto when the scene's photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    pan = pan_over(rgb)
    known = {subject.name for subject in photo_set.subjects}
    rows: list[Row] = []
    for name, boxes in scene.boxes.items():
        if name not in known or not len(boxes):
            continue
        pair = pan.with_twins(boxes[:1])
        ends, seen, states = [], [], None
        for number, frame in enumerate(frames_of(rgb, pan)):
            if states is None:
                states, mask = _start(frame, pan, scene, name, stack)
            else:
                states, tracks = stack.tracker.step(states, [frame])
                mask = tracks[0][0].mask
            here = pan.boxes(number, pair)
            ends.append(lies_on(mask, here))
            seen.append(visible_share(here[0], frame) >= IN_VIEW)
        on_object = sum(end == "object" for end, is_seen in zip(ends, seen, strict=True) if is_seen)
        row = {"scene": scene.name, "object": name, "frames": FRAMES, "in_view": sum(seen)}
        rows.append(row | dict(on_object=on_object, on_twin=ends.count("twin"), end=ends[-1]))
    return rows


def _start(
    frame: Rgb, pan: Pan, scene: Scene, name: str, stack: Stack
) -> tuple[list[Any], Mask | None]:
    """The tracker of the first frame, and the object's mask there; the object is identity 0."""
    order = [name, *(other for other in scene.boxes if other != name)]
    known = np.concatenate([scene.boxes[other][:1] for other in order])
    here = pan.boxes(0, pan.with_twins(known))
    kept = [i for i, box in enumerate(here) if i == 0 or visible_share(box, frame) >= IN_VIEW]
    height, width = frame.shape[:2]
    boxes = _true_boxes(np.clip(here[kept], 0, (width, height, width, height)).astype(np.float32))
    masks = stack.segmenter(frame, judge(frame, boxes, boxes.phrase, stack))
    tracker = stack.tracker
    if isinstance(tracker, TargetTracker):
        return tracker.start_targets([frame], [masks], [[0]]), masks[0]
    return tracker.start([frame], [masks]), masks[0]


def visible_share(box: Float64[np.ndarray, "4"], frame: Rgb) -> float:
    """The share of a box that lies inside of the frame."""
    height, width = frame.shape[:2]
    inside = np.clip(box, 0, (width, height, width, height))
    return float(np.maximum(inside[2:] - inside[:2], 0).prod() / (box[2:] - box[:2]).prod())


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
    """What the command prints of the questions."""
    seconds = f"ms a photo: median {table.ms.median():.0f}, slowest {table.ms.max():.0f}"
    if "cpu_ms" in table:
        cpu = table.cpu_ms
        seconds += f"; of CPU: median {cpu.median():.0f}, slowest {cpu.max():.0f}"
    parts = [printed(each(table)) for each in (object_table, scene_table, vote_table)]
    return "\n\n".join([*parts, f"{seconds}\n{NOTE}"])


def _judged(table: "pd.DataFrame") -> "pd.DataFrame":
    """With what became of every question."""
    right, silent = table.iou >= RIGHT_IOU, ~table.tinted.astype(bool)
    return table.assign(
        **{
            "proposed": table.proposed_iou >= RIGHT_IOU,
            "right": right,
            "right at IoU .25": table.iou >= LOOSE_IOU,
            "wrong tinted": ~silent & ~right,
            "silent": silent,
            "not in view": silent.where(table.chosen_iou.astype(float).fillna(0) >= RIGHT_IOU),
        }
    )


def object_table(table: "pd.DataFrame") -> "pd.DataFrame":
    """One line per object, and one for all: counts."""
    import pandas as pd

    found = _judged(table)
    seen = found.present.astype(bool)
    flags = {
        "in view": seen,
        "right": seen & found.right,
        "IoU .25": seen & found["right at IoU .25"],
        "wrong": seen & found["wrong tinted"],
        "silent": seen & found.silent,
        "absent": ~seen,
        "tinted": ~seen & ~found.silent,
    }
    keyed = found[["object"]].assign(kind=found.category, **flags)
    whole = pd.concat([keyed.sort_values(["object", "kind"]), keyed.assign(object="all", kind="")])
    return whole.groupby(["object", "kind"], sort=False)[list(flags)].sum().reset_index()


def scene_table(table: "pd.DataFrame") -> "pd.DataFrame":
    """One line per kind of scene: with the object and without, with look-alikes and without."""
    import pandas as pd

    found = _judged(table)
    seen, beside = found.present.astype(bool), found.lookalikes > 0
    given_absent = ["wrong tinted", "silent"]
    measures = ["proposed", "right", "right at IoU .25", *given_absent, "not in view"]
    kinds = (
        ("object in view", seen, measures),
        ("- beside look-alikes", seen & beside, measures),
        ("- alone of its kind", seen & ~beside, measures),
        ("object absent", ~seen, given_absent),
        ("- look-alikes in view", ~seen & beside, given_absent),
        ("- none of its kind", ~seen & ~beside, given_absent),
    )
    lines = [
        {"scenes": name}
        | {each: share_by(found[chosen], each, ["scene"]).text(digits=0) for each in given}
        for name, chosen, given in kinds
    ]
    return pd.DataFrame(lines, columns=["scenes", *measures]).fillna("")


def vote_table(table: "pd.DataFrame") -> "pd.DataFrame":
    """How the vote does among the true boxes of a scene."""
    import pandas as pd

    lines = []
    for among, name in (("all", "all true boxes"), ("kind", "those of its kind")):
        column = f"{among}_boxes"
        known = table.dropna(subset=[column]) if column in table else table.iloc[:0]
        line = dict.fromkeys(("boxes", "chance", "one reference", "all references"), "-")
        if len(known):
            boxes = known[column].to_numpy(float)
            line["boxes"], line["chance"] = f"{boxes.mean():.1f}", f"{100 * (1 / boxes).mean():.0f}"
            for part, title in (("one", "one reference"), ("every", "all references")):
                line[title] = share_by(known, f"{among}_{part}", ["scene"]).text(digits=0)
        lines.append({"vote among": name, **line})
    return pd.DataFrame(lines)


def clip_report(clips: "pd.DataFrame") -> str:
    """What became of the objects in clips made of the scenes."""
    if "end" not in clips:
        return "clips: no object with references is in view in any scene"
    ends = {"on the object": "object", "on its twin": "twin", "elsewhere": "other", "no mask": ""}
    flags = clips.assign(**{name: clips.end == end for name, end in ends.items()})
    table = summary(flags, share=list(ends), cluster=["scene"])[list(ends)]
    table.insert(0, "clips", "at the end")
    total = clips[["in_view", "on_object", "on_twin", "frames"]].sum()
    return (
        f"{printed(table.map(lambda each: each if isinstance(each, str) else each.text(digits=0)))}"
        f"\n\nclips: the object's mask in {total.on_object} of {total.in_view} frames that show "
        f"it, its twin's in {total.on_twin} of {total.frames} frames. The window pans from a photo "
        "to a copy of it and back; the tracker starts from the true boxes."
    )


def single_report(single: "pd.DataFrame") -> str:
    """How often three references elect a left-out photo of their object among two others'."""
    found = clustered_share(single.right.to_numpy(float), single.object)
    by_object = single.groupby("object").right.mean()
    return (
        f"photos of one object: three references elect a left-out one among photos of two others "
        f"in {found.text()} elections of {len(by_object)} objects, which are the independent "
        f"units; worst: {by_object.idxmin()}, {100 * by_object.min():.0f}"
    )


WIDTH_PX, HEIGHT_PX, TILES = 360, 270, 24


def write_sheets(photo_set: PhotoSet, table: "pd.DataFrame", folder: Path) -> list[Path]:
    """Write sheet-01.png and so on, at most 24 questions each, in the order of the scenes.

    White: the true box. Green: tinted and right. Red: tinted and wrong. Grey: elected, not tinted.

    Raises: BadOutput.
    """
    scenes = {scene.name: scene for scene in photo_set.scenes}
    tiles, paths = [], []
    for name, part in table.groupby("scene", sort=True):
        rgb = load_photo(scenes[str(name)].path, long_side=None)
        tiles += [_tile(rgb, scenes[str(name)], row) for row in part.to_dict("records")]
    for number, some in enumerate(batched(tiles, TILES), 1):
        paths.append(folder / f"sheet-{number:02}.png")
        write_picture(paths[-1], join_tiles(some, gap_px=GAP_PX))
    return paths


def _tile(rgb: Rgb, scene: Scene, row: Mapping[Any, Any]) -> Rgb:
    tile, scale = fit(rgb, WIDTH_PX, HEIGHT_PX)
    for box in scene.boxes[row["object"]]:
        draw_box(tile, (scale * box).tolist(), TRUTH, 2)
    verdict = "nothing proposed"
    if row["x0"] == row["x0"] and row["x0"] is not None:
        colour, verdict = (RIGHT, "right") if row["iou"] >= RIGHT_IOU else (WRONG, "wrong")
        if not row["tinted"]:
            colour, verdict = SILENT, "not tinted"
        elected = np.array([row[name] for name in BOX], np.float64)
        draw_box(tile, (scale * elected).tolist(), colour, 2)
    presence = "in view" if row["present"] else "absent"
    about = f"{row['object']} ({presence}) in {scene.name}"
    return labelled(tile, [about, f"{verdict}{evidence(row)}"])


def evidence(row: Mapping[Any, Any]) -> str:
    """What a label says of the elected box, tinted or not; "" where none is elected.

    Its overlap with the object, where that is in view, and the likeness that the threshold of "not
    in view" reads.
    """
    if row["likeness"] is None or row["likeness"] != row["likeness"]:
        return ""
    overlap = f", IoU {row['chosen_iou']:.2f}" if row["present"] else ""
    return f"{overlap}, likeness {row['likeness']:.2f}"


TABLE: Final = "questions"
"""The table of what was asked."""
Kind = Literal["questions", "masks", "clips", "single"]


@dataclass(frozen=True)
class Job:
    """What is measured of one scene; `single` of the references alone."""

    kind: Kind
    scene: str = ""

    @property
    def name(self) -> str:
        if self.kind == "single":
            return self.kind
        return self.scene if self.kind == TABLE else f"{self.scene}.{self.kind}"


@dataclass(frozen=True)
class PhotoMeasurement(Measurement):
    """A folder of photos, measured with a stack.

    With `clips` objects are followed through clips made of the scenes, too. Where not `kept`,
    thresholds that were kept on this machine do not count: the best candidate wins.
    """

    folder: Path
    stack: str = "embedded"
    clips: bool = False
    kept: bool = True
    caller: ClassVar[str] = "measure photos"

    def settings(self) -> dict[str, Any]:
        """Raises: BadPhotoSet; MissingWeights."""
        return {
            "measurement": "photos",
            "photos": _photo_set(self.folder).sha256,
            "stack": self.stack,
            "version": __version__,
            **checksums(self.stack, self.kept),
        }

    def jobs(self) -> list[Job]:
        photo_set = _photo_set(self.folder)
        jobs = [Job(TABLE, scene.name) for scene in photo_set.scenes if photo_set.subjects]
        jobs += [Job("single")] if photo_set.subjects else []
        jobs += [Job("masks", scene.name) for scene in photo_set.scenes if scene.masks]
        return [*jobs, *(Job("clips", scene.name) for scene in photo_set.scenes if self.clips)]

    def prepare(self, folder: Path) -> None:
        subjects = _photo_set(self.folder).subjects
        remember_subjects(subjects, _models(self.stack, self.kept), folder / "memory")

    def run(self, job: Job, folder: Path) -> Tables:
        """Raises: as `measure_scene`, `mask_rows` and `follow_scene`."""
        photo_set, stack = _photo_set(self.folder), _models(self.stack, self.kept)
        memory = _memory(self, folder)
        if job.kind == "single":
            return {job.kind: single_rows(memory, stack)}
        (scene,) = (scene for scene in photo_set.scenes if scene.name == job.scene)
        if job.kind == "masks":
            return {job.kind: mask_rows(scene, stack)}
        if job.kind == "clips":
            return {job.kind: follow_scene(scene, photo_set, stack)}
        return {job.kind: measure_scene(scene, photo_set, memory, Attender(stack, memory))}


_photo_set = cache(read_photo_set)


@cache
def _models(name: str, kept: bool) -> Stack:
    stack = load_stack(name)
    return stack if kept or ships_thresholds(name) else replace(stack, thresholds=None)


@cache
def _memory(asked: PhotoMeasurement, folder: Path) -> dict[str, PersonalObject]:
    known = load_bank(folder / "memory", _models(asked.stack, asked.kept).encoder.name)
    return {subject.name: known[subject.name] for subject in _photo_set(asked.folder).subjects}


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

    `clips` and `kept` are `PhotoMeasurement`'s. With `progress` stderr has a bar, and a note of the
    objects that have no references.

    Raises: BadPhotoSet, BadPhoto; MissingWeights; BadOutput when `out` holds another run.
    """
    for each in (_photo_set, _models, _memory):
        each.cache_clear()
    photo_set = _photo_set(folder)
    if progress and photo_set.subjects and photo_set.rivals:
        # A misspelt object is a rival, too, and no question then asks for it.
        print(
            f"note: {SCENES_CSV} names {', '.join(photo_set.rivals)} without references: taken as "
            "rivals, not asked for; where one is misspelt, mend it and measure anew",
            file=sys.stderr,
        )
    asked = PhotoMeasurement(folder, stack_name, clips, kept)
    tables = measurement.measure(asked, out, progress=progress)
    parts = []
    if TABLE in tables:
        write_sheets(photo_set, tables[TABLE], out)
        parts.append(text_report(tables[TABLE]))
    if len(tables.get("single", ())):
        parts.append(single_report(tables["single"]))
    if "masks" in tables:
        found = mean_by(tables["masks"], "mask_iou", ["scene"])
        parts.append(f"masks from true boxes: mean IoU {found.text(scale=1.0, digits=2)}")
    if clips:
        parts.append(clip_report(tables["clips"]))
    return measurement.report(asked, "\n\n".join(parts), out)


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
            paths = [path for path, _ in subject.photos]
            given = {i: box for i, (_, box) in enumerate(subject.photos) if box is not None}
            try:
                references = choose(paths, subject.category, stack, given, whole=False)
            except BadPhoto as error:
                raise _wrong(str(error)) from error
            write_sheet(folder / f"{subject.name}.references.png", references, paths)
            obj = remember_references(subject.name, subject.category, references, stack)
            save(folder, obj)
        memory[subject.name] = obj
    return memory
