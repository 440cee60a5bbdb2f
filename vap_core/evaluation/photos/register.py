"""Remembers an object from photos as a person takes them.

A box is chosen in every photo, all are shown on a contact sheet, and a doubtful one stops it.
"""

import os.path
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from vap_core.base.errors import BadMemory, BadPhoto, BadPhotoSet
from vap_core.base.photos import load_mask, load_photo, photos_in
from vap_core.base.types import PersonalObject, Rgb
from vap_core.base.video import is_video, sharp_frames
from vap_core.evaluation.photos.folder import Subject
from vap_core.evaluation.photos.pictures import (
    DOUBTFUL,
    RIGHT,
    draw_box,
    fit,
    join_tiles,
    labelled,
    write_picture,
)
from vap_core.instruction.owners import fold
from vap_core.memory import load, load_bank, object_files, object_path, remember, save
from vap_core.perception.boxes import mask_box
from vap_core.perception.protocols import Stack
from vap_core.perception.references import Box, Reference, choose_references, whole_photos

CROP_SIDE = 512
"""The longer side of a crop that is kept; the encoder looks at fewer pixels."""
TILE_PX = 260


def gather_photos(paths: Sequence[Path]) -> list[Path]:
    """Picture files, each once; a folder gives its own in the order of their names.

    Raises: BadPhoto.
    """
    found: list[Path] = []
    for path in paths:
        if not os.path.isdir(path):
            found.append(path)
            continue
        inside = photos_in(path)
        if not inside:
            raise BadPhoto(f"register: {path} holds no picture; name a folder of photos.")
        found.extend(inside)
    once: dict[str, Path] = {}
    for path in found:
        once.setdefault(os.path.realpath(path), path)
    return list(once.values())


def film_photos(video: Path, folder: Path, count: int) -> list[Path]:
    """The sharpest frames of a video, spread over it, as picture files in `folder`.

    Raises: BadPhoto, BadOutput.
    """
    if not is_video(video):
        raise BadPhoto(f"register: {video} is no video by its name; export it as MP4.")
    paths = []
    for i, rgb in enumerate(sharp_frames(video, count)):
        path = folder / f"{video.stem}-{i + 1}.png"
        write_picture(path, rgb)
        paths.append(path)
    return paths


def parse_given(
    boxes: Sequence[str], masks: Sequence[str], photos: Sequence[Path]
) -> dict[int, Box]:
    """The boxes of photos by their numbers, from "PHOTO=x0,y0,x1,y1" and "PHOTO=MASK".

    Boxes are pixels of the upright photo; a mask is a picture of its size, bright on the object.

    Raises: BadPhoto.
    """
    given = {}
    for text in boxes:
        number, words = _split(text, photos, "--box", "x0,y0,x1,y1")
        given[number] = _parse_box(text, words)
    for text in masks:
        number, words = _split(text, photos, "--mask", "MASK.png")
        given[number] = _box_of_mask(Path(words), photos[number])
    return given


def choose(
    photos: Sequence[Path], category: str, stack: Stack, given: Mapping[int, Box], *, whole: bool
) -> tuple[Reference, ...]:
    """Read the photos and choose the box of each. Raises: BadPhoto, BadEncoder."""
    if not photos:
        raise BadPhoto("register: no photos; name picture files, a folder of them, or --video.")
    pictures = [load_photo(photo, long_side=None) for photo in photos]
    if whole and given:
        raise BadPhoto("register: --whole uses photos as they are; leave --box and --mask out.")
    if whole:
        return whole_photos(pictures)
    for number, box in given.items():
        height, width = pictures[number].shape[:2]
        if box[2] > width or box[3] > height or box[:2].min() < 0:
            raise BadPhoto(
                f"register: the box {box.astype(int).tolist()} is not inside {photos[number]}, "
                f"which has {width}x{height} pixels when upright."
            )
    return choose_references(pictures, category, stack.detector, stack.encoder, given)


def refuse_doubtful(references: Sequence[Reference], photos: Sequence[Path], sheet: Path) -> None:
    """Stop at crops that may be wrong, after writing their sheet.

    Raises: BadPhoto, which names the sheet and the first photo whose crop may be wrong; BadOutput.
    """
    doubtful = [i for i, reference in enumerate(references) if reference.doubt]
    if not doubtful:
        return
    write_sheet(sheet, references, photos)
    first = doubtful[0]
    name = _shortest_name(photos[first], photos)
    more = ""
    if len(doubtful) > 1:
        more = f" ({len(doubtful) - 1} more are doubtful)"
    raise BadPhoto(
        f"register: {name}: {references[first].doubt}{more}; look at {sheet}, then give --box "
        f"{shlex.quote(name)}=x0,y0,x1,y1 in pixels, or pass --accept."
    )


def remember_references(
    name: str, category: str, references: Sequence[Reference], stack: Stack
) -> PersonalObject:
    """The object with the chosen crops. Raises: BadMemory, BadEncoder."""
    crops = [fit_crop(reference.crop) for reference in references]
    return remember(name, category, crops, stack.encoder)


def fit_crop(crop: Rgb) -> Rgb:
    """A crop of at most CROP_SIDE pixels."""
    import cv2

    scale = CROP_SIDE / max(crop.shape[:2])
    if scale >= 1:
        return crop
    size = (max(1, round(crop.shape[1] * scale)), max(1, round(crop.shape[0] * scale)))
    return cv2.resize(crop, size, interpolation=cv2.INTER_AREA)


def write_sheet(path: Path, references: Sequence[Reference], photos: Sequence[Path]) -> None:
    """A picture of every photo with its box, and of its crop beside it. Raises: BadOutput."""
    tiles = []
    for photo, reference in zip(photos, references, strict=True):
        shown, scale = fit(reference.photo, TILE_PX, TILE_PX)
        colour = DOUBTFUL if reference.doubt else RIGHT
        draw_box(shown, (scale * reference.box).tolist(), colour, 2)
        crop, _ = fit(reference.crop, TILE_PX, TILE_PX)
        verdict = reference.doubt or describe_choice(reference)
        tiles.append(labelled(np.concatenate([shown, crop], axis=1), [photo.name, verdict]))
    write_picture(path, join_tiles(tiles, columns=2))


def describe_choice(reference: Reference) -> str:
    """How a box that is not doubtful was chosen."""
    if reference.chosen_by == "given":
        return "box given by hand"
    if reference.chosen_by == "whole":
        return "used whole"
    if np.isnan(reference.agreement):
        return "box proposed; the only photo"
    return f"box proposed; cosine {reference.agreement:.2f} to the other photos"


def load_others(memory: Path, name: str) -> tuple[dict[str, PersonalObject], tuple[BadMemory, ...]]:
    """The objects of a memory besides `name`, and an error for each that cannot be loaded.

    The file of `name` itself is not read: it may be damaged, and is to be replaced.

    Raises: BadMemory: the folder cannot be read.
    """
    known = {}
    errors = []
    for path in object_files(memory):
        if path == object_path(memory, name):
            continue
        try:
            obj = load(path)
        except BadMemory as error:
            errors.append(error)
        else:
            known[obj.name] = obj
    return known, tuple(errors)


def next_words(
    obj: PersonalObject, memory: Path, stack: str, others: Mapping[str, PersonalObject]
) -> list[str]:
    """The command that grounds an object which was just registered beside `others`."""
    words = ["ground", "IMAGE", f"bring my {obj.category}", "--memory", str(memory)]
    if stack != "embedded":
        words += ["--stack", stack]
    if obj.owner:
        words += ["--speaker", obj.owner]
    for other in others.values():
        if other.category == obj.category and fold(other.owner) == fold(obj.owner):
            return [*words, "--object", obj.name]
    return words


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


def _split(text: str, photos: Sequence[Path], option: str, form: str) -> tuple[int, str]:
    """The photo's number and the rest of "PHOTO=REST"; both may hold "=", too."""
    photo = ""
    for path in photos:
        for known in (str(path), path.name):
            if text.startswith(f"{known}=") and len(known) > len(photo):
                photo = known
    fitting = []
    for i, path in enumerate(photos):
        if photo in (str(path), path.name):
            fitting.append(i)
    words = text[len(photo) :].removeprefix("=")
    if not photo and "=" not in words and len(photos) == 1:
        fitting = [0]
    if len(fitting) != 1:
        names = [shlex.quote(_shortest_name(path, photos)) for path in photos[:6]]
        known = ", ".join(names)
        raise BadPhoto(
            f"register: {option} {text!r} names no single photo; write {option} PHOTO={form} with "
            f"one of {known}."
        )
    return fitting[0], words


def _shortest_name(photo: Path, photos: Sequence[Path]) -> str:
    """A photo's file name; its path where another has the same name."""
    alike = [path for path in photos if path.name == photo.name]
    return photo.name if len(alike) == 1 else str(photo)


def _box_of_mask(mask_path: Path, photo: Path) -> Box:
    """Around what is bright in a mask of the photo's size. Raises: BadPhoto."""
    mask = load_mask(mask_path)
    height, width = load_photo(photo, long_side=None).shape[:2]
    if mask.shape != (height, width):
        raise BadPhoto(
            f"register: the mask {mask_path} has {mask.shape[1]}x{mask.shape[0]} pixels, its photo "
            f"{width}x{height}; save it as large as the upright photo."
        )
    box = mask_box(mask)
    if box is None:
        raise BadPhoto(f"register: the mask {mask_path} is dark all over; paint the object white.")
    return box


def _parse_box(text: str, words: str) -> Box:
    try:
        x0, y0, x1, y1 = map(float, words.split(","))
    except ValueError as error:
        raise BadPhoto(
            f"register: --box {text!r} is not PHOTO=x0,y0,x1,y1; for example --box "
            "mug-1.jpg=40,60,180,220."
        ) from error
    if not (np.isfinite([x0, y0, x1, y1]).all() and x1 - x0 >= 1 and y1 - y0 >= 1):
        raise BadPhoto(
            f"register: --box {text!r} has no area; x to the right, y down, far corner last."
        )
    return np.array([x0, y0, x1, y1], np.float32)
