"""Makes a photo set in the form of eval-photos: objects cut out of photos, pasted into others.

    OBJECT/*.jpg           photos of each object, two or more
    boxes.csv              optional: photo,x0,y0,x1,y1 with the photo as OBJECT/FILE
    masks/OBJECT/FILE.png  optional: bright on the object, to be cut out along it
    objects.csv            optional: object,category

Of every object five photos or fewer stay whole, as its references. Of the others, up to three, the
box is chosen as `register` does where none is given, and the stack's mask is cut out where none is
given; doubtful ones are left. Where things are is known then, and light, sharpness and edges are
not those of one photo.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from vap_core.base.csv_rows import write_rows
from vap_core.base.errors import BadOutput, BadPhoto, BadPhotoSet
from vap_core.base.files import writing
from vap_core.base.photos import load_mask, load_photo, photos_in
from vap_core.base.types import Boxes, Mask, Rgb, value
from vap_core.evaluation.photos.folder import (
    BOX,
    BOXES_CSV,
    MASKS,
    OBJECTS_CSV,
    SCENES_CSV,
    Box,
    check_object_folder,
    read_boxes,
    read_categories,
)
from vap_core.evaluation.photos.measure import judge
from vap_core.evaluation.photos.pictures import fit, join_tiles, labelled, write_picture
from vap_core.evaluation.photos.register import choose
from vap_core.perception.boxes import box_cover, mask_box
from vap_core.perception.embedded.tracker.components import largest_component
from vap_core.perception.protocols import Stack

MOST_REFERENCES, MOST_CUT = 5, 3
LIGHT = 0.15
"""By how much a pasted object is darkened or brightened at most."""
TRIES = 60
"""Places that are tried for one object."""
TOUCH = 0.05
"""Of two pasted boxes, the share of the smaller that may be common."""
LEAST_SHARE = 0.3
"""Of its box: a smaller mask is a bad cut."""
Cut = UInt8[np.ndarray, "_h _w 4"]


@value
class Pasting:
    """What is asked for. `share` is the range of an object's longer side in the picture's width."""

    width: int
    height: int
    pictures: int
    objects: int
    share: tuple[float, float]
    seed: int


def parse_pasting(size: str, share: str, *, pictures: int, objects: int, seed: int) -> Pasting:
    """What is asked for, from WIDTHxHEIGHT and FROM,TO in per cent. Raises: BadPhotoSet."""
    try:
        width, height = map(int, size.lower().split("x"))
        low, high = (float(number) / 100 for number in share.split(","))
    except ValueError as error:
        raise BadPhotoSet(
            f"paste-photos: --size {size} --share {share}: give for example 640x480 and 15,35."
        ) from error
    if not (64 <= width <= 8000 and 64 <= height <= 6000 and 0.01 <= low <= high <= 0.9):
        raise BadPhotoSet(
            f"paste-photos: --size {size} --share {share}: 64x64 to 8000x6000 pixels, and 1 to 90 "
            "per cent, the lesser first."
        )
    return Pasting(width, height, pictures, objects, (low, high), seed)


def paste_photos(photos: Path, scenes: Path, out: Path, asked: Pasting, stack: Stack) -> str:
    """Write the set, a sheet of the cuts (cuts.png) beside it, and say what became of each object.

    Where it fails nothing is left of `out`, so that the same call can follow.

    Raises: BadPhoto, BadPhotoSet, BadOutput: a folder lacks what is needed or has boxes or masks of
        other photos, or `out` is there.
    """
    if out.exists():
        raise BadOutput(f"paste-photos: {out} is there already; choose another folder.")
    sources = _sources(photos)
    categories = read_categories(photos, sources, "paste-photos")
    boxes = read_boxes(photos / "boxes.csv")
    _refuse_others(photos, sources, boxes)
    backgrounds = _pictures_of(scenes)
    cuts: dict[str, list[Cut]] = {}
    kept: dict[str, list[Path]] = {}
    left_out = []
    known: list[tuple[str, ...]] = [("photo", *BOX)]
    for name, paths in sources.items():
        references, rest = split(paths)
        given = [boxes.get(f"{name}/{path.name}") for path in paths]
        masks = [photos / MASKS / name / f"{path.stem}.png" for path in paths]
        found = cut_out(paths, len(references), categories[name], stack, given, masks)
        if not found:
            left_out.append(f"left out: {name}: none of {len(rest)} photos gives a clean cut")
            continue
        cuts[name] = found
        kept[name] = references
        for path, box in zip(references, given, strict=False):
            if box is not None:
                known.append((f"{name}/{path.name}", *(f"{x:g}" for x in box)))
    if len(cuts) < 2:
        raise BadPhotoSet(f"paste-photos: {photos} gives fewer than two objects to paste.")
    try:
        with writing(out, "paste-photos"):
            for name, references in kept.items():
                _copy(references, out / "references" / name)
            if len(known) > 1:
                write_rows(out / BOXES_CSV, known)
            _write_cuts(out / "cuts.png", cuts)
            questions = _write_pictures(out, backgrounds, cuts, categories, asked)
    except BaseException:  # an interruption, too
        shutil.rmtree(out, ignore_errors=True)
        raise
    found_text = f"{len(cuts)} objects in {asked.pictures} pictures, {questions} questions"
    return "\n".join([*left_out, found_text])


def _write_pictures(
    out: Path,
    backgrounds: Sequence[Path],
    cuts: Mapping[str, Sequence[Cut]],
    categories: Mapping[str, str],
    asked: Pasting,
) -> int:
    """The scenes and their tables; returns how many questions they ask. Raises: BadPhoto."""
    rows: list[tuple[object, ...]] = [("scene", "object", *BOX)]
    for number in range(asked.pictures):
        rng = np.random.default_rng([asked.seed, number])
        ground = _cover(load_photo(backgrounds[number % len(backgrounds)], None), asked)
        picture, placed = compose(ground, cuts, asked, rng)
        scene = f"{number:03}.png"
        write_picture(out / "scenes" / scene, picture)
        for name, corners in placed.items():
            rows.append((scene, name, *corners))
        for name in absent(list(placed), list(cuts), categories, rng):
            rows.append((scene, name, "", "", "", ""))
    kinds = [(name, categories[name]) for name in cuts]
    write_rows(out / SCENES_CSV, rows)
    write_rows(out / OBJECTS_CSV, [("object", "category"), *kinds])
    return len(rows) - 1


def split(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The references, and the photos to cut out of; at least one of these."""
    count = min(MOST_REFERENCES, len(paths) - 1)
    return list(paths[:count]), list(paths[count : count + MOST_CUT])


def cut_out(
    paths: Sequence[Path],
    references: int,
    category: str,
    stack: Stack,
    boxes: Sequence[Box | None],
    masks: Sequence[Path],
) -> list[Cut]:
    """The object of every photo after the references, with its mask as a fourth channel.

    `boxes` and `masks` are those of the photos; where no mask's file exists the stack draws it.

    Raises: BadPhoto.
    """
    used = paths[: references + MOST_CUT]
    given = {i: box for i, box in enumerate(boxes[: len(used)]) if box is not None}
    drawn: dict[int, Mask] = {}
    for i, path in enumerate(masks[: len(used)]):
        if path.exists():
            drawn[i] = load_mask(path)
    cuts = []
    for i, chosen in enumerate(choose(used, category, stack, given, whole=False)):
        if i < references or (chosen.doubt and i not in drawn):
            continue
        if i in drawn:
            mask = drawn[i]
        else:
            box = Boxes(chosen.box[None], np.ones(1, np.float32), category)
            (mask,) = stack.segmenter(chosen.photo, judge(chosen.photo, box, stack))
        if mask.shape != chosen.photo.shape[:2]:
            raise BadPhoto(
                f"paste-photos: the mask {masks[i]} is not as large as its photo; save it so."
            )
        part = largest_component(mask, np.ones(mask.shape, np.float32))
        around = None if part is None else mask_box(part)
        if part is None or around is None:
            continue
        x0, y0, x1, y1 = around.astype(int).tolist()
        inside = part[y0:y1, x0:x1]
        if inside.mean() < LEAST_SHARE:
            continue
        alpha = cv2.GaussianBlur(255 * inside.astype(np.uint8), (3, 3), 0)
        cuts.append(np.dstack([chosen.photo[y0:y1, x0:x1], alpha]))
    return cuts


def compose(
    ground: Rgb, cuts: Mapping[str, Sequence[Cut]], asked: Pasting, rng: np.random.Generator
) -> tuple[Rgb, dict[str, tuple[int, int, int, int]]]:
    """Objects drawn at random, pasted where they hide nothing; and the box of each."""
    picture = ground.copy()
    boxes: dict[str, tuple[int, int, int, int]] = {}
    for name in rng.permutation(sorted(cuts))[: asked.objects].tolist():
        cut = cuts[name][int(rng.integers(len(cuts[name])))]
        side = asked.width * rng.uniform(*asked.share)
        scale = min(side / max(cut.shape[:2]), 0.9 * asked.height / cut.shape[0])
        size = (max(4, round(cut.shape[1] * scale)), max(4, round(cut.shape[0] * scale)))
        small = cv2.resize(cut, size, interpolation=cv2.INTER_AREA)
        light = 1 + rng.uniform(-LIGHT, LIGHT)
        for _ in range(TRIES):
            x = int(rng.integers(0, asked.width - size[0] + 1))
            y = int(rng.integers(0, asked.height - size[1] + 1))
            box = (x, y, x + size[0], y + size[1])
            if _is_free(box, list(boxes.values())):
                _paste(picture, small, box, light)
                boxes[name] = box
                break
    return picture, boxes


def absent(
    present: Sequence[str],
    known: Sequence[str],
    categories: Mapping[str, str],
    rng: np.random.Generator,
) -> list[str]:
    """One object that is missing beside its look-alikes, and one of whose kind nothing is there."""
    kinds = {categories[name] for name in present}
    beside: list[str] = []
    alone: list[str] = []
    for name in sorted(set(known) - set(present)):
        (beside if categories[name] in kinds else alone).append(name)
    drawn = []
    for names in (beside, alone):
        if names:
            drawn.append(names[int(rng.integers(len(names)))])
    return drawn


def _sources(photos: Path) -> dict[str, list[Path]]:
    """The photos of every object, from a folder of folders."""
    if not photos.is_dir():
        raise BadPhotoSet(f"paste-photos: {photos} is no folder; put photos into {photos}/OBJECT.")
    sources = {}
    folders = [path for path in photos.iterdir() if path.is_dir() and path.name != MASKS]
    for folder in sorted(folders):
        found = photos_in(folder)
        if found:
            check_object_folder(folder, "paste-photos")
        if len(found) == 1:
            raise BadPhotoSet(
                f"paste-photos: {folder} holds one photo; two are needed, one of them to cut out."
            )
        if found:
            sources[folder.name] = found
    if not sources:
        raise BadPhotoSet(
            f"paste-photos: {photos} holds no folder of photos; put each object's into "
            f"{photos}/OBJECT."
        )
    return sources


def _refuse_others(
    photos: Path, sources: Mapping[str, Sequence[Path]], boxes: Mapping[str, Box]
) -> None:
    """Raises: BadPhotoSet: a box or a mask belongs to no photo."""
    named = set()
    masks = set()
    for name, paths in sources.items():
        for path in paths:
            named.add(f"{name}/{path.name}")
            masks.add(photos / MASKS / name / f"{path.stem}.png")
    for photo in boxes:
        if photo not in named:
            raise BadPhotoSet(
                f"paste-photos: {photos / 'boxes.csv'} names {photo!r}, which is not there; name "
                "photos as OBJECT/FILE."
            )
    root = photos / MASKS
    folders = [root, *sorted(root.iterdir())] if root.is_dir() else []
    for folder in folders:
        for path in photos_in(folder) if folder.is_dir() else []:
            if path not in masks:
                raise BadPhotoSet(
                    f"paste-photos: {path} is the mask of no photo; name masks as "
                    f"{MASKS}/OBJECT/FILE.png after {photos}/OBJECT/FILE.jpg."
                )


def _pictures_of(scenes: Path) -> list[Path]:
    found = photos_in(scenes) if scenes.is_dir() else []
    if not found:
        raise BadPhoto(f"paste-photos: {scenes} holds no picture; name a folder of backgrounds.")
    return found


def _copy(photos: Sequence[Path], folder: Path) -> None:
    with writing(folder, "paste-photos", "choose another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        for photo in photos:
            shutil.copyfile(photo, folder / photo.name)


def _cover(rgb: Rgb, asked: Pasting) -> Rgb:
    """The middle of a photo, scaled so that it fills the picture."""
    scale = max(asked.width / rgb.shape[1], asked.height / rgb.shape[0])
    size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(rgb, size, interpolation=method)
    x, y = (size[0] - asked.width) // 2, (size[1] - asked.height) // 2
    return np.ascontiguousarray(large[y : y + asked.height, x : x + asked.width])


def _is_free(box: Sequence[int], taken: Sequence[Sequence[int]]) -> bool:
    if not taken:
        return True
    here = np.array([box], np.float32)
    others = np.array(taken, np.float32)
    return float(box_cover(here, others).max()) <= TOUCH


def _paste(picture: Rgb, cut: Cut, box: Sequence[int], light: float) -> None:
    x0, y0, x1, y1 = box
    alpha = cut[..., 3:].astype(np.float32) / 255
    lit = np.clip(cut[..., :3] * light, 0, 255)
    below = picture[y0:y1, x0:x1]
    picture[y0:y1, x0:x1] = np.round(alpha * lit + (1 - alpha) * below).astype(np.uint8)


def _write_cuts(path: Path, cuts: Mapping[str, Sequence[Cut]]) -> None:
    """Every cut on grey, to be looked at."""
    tiles = []
    for name, of_object in cuts.items():
        for cut in of_object:
            grey = np.full((*cut.shape[:2], 3), 127, np.uint8)
            _paste(grey, cut, (0, 0, cut.shape[1], cut.shape[0]), 1.0)
            tiles.append(labelled(fit(grey, 150, 150)[0], [name, ""]))
    write_picture(path, join_tiles(tiles, columns=10))
