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
from collections.abc import Iterable, Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core.base.csv_rows import read_rows
from vap_core.base.errors import BadPhotoSet
from vap_core.base.photos import photos_in
from vap_core.base.types import value
from vap_core.memory import NAME, NAME_RULE, kind_instead, plain_category

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
