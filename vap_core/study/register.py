"""Remembers an object from photos as a person takes them, and says how far its vote can be trusted.

A box is chosen in every photo, and all are shown on a contact sheet. Doubtful ones are left out;
where too few are good they stop it.
"""

import os.path
import shlex
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vap_core.base.errors import BadMemory, BadPhoto, number_of
from vap_core.base.files import writing
from vap_core.base.media import is_video, load_mask, load_photo, photos_in, sharp_frames
from vap_core.base.types import PersonalObject, Rgb, value
from vap_core.instruction.context import fold
from vap_core.memory import load, object_files, object_path, remember
from vap_core.perception.boxes import mask_box, parse_box
from vap_core.perception.candidates import embed_crops
from vap_core.perception.protocols import Encoder, Stack
from vap_core.perception.references import (
    FEWEST,
    LEAST_COSINE,
    SMALL_PX,
    Box,
    Reference,
    choose_references,
    whole_photos,
)
from vap_core.vote import similarity, vote

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

LABEL_PX, COLUMNS = 34, 4
GAP_PX = 10
"""Between the tiles of a sheet of scenes, whose pictures would touch."""
LARGEST_PX, SMALLEST_PX = 13, 10
"""Sizes of a label's text, from that of a short one to that of a long one."""
TRUTH, RIGHT, WRONG, SILENT = (255, 255, 255), (60, 200, 90), (235, 60, 50), (160, 160, 160)
DOUBTFUL = (250, 180, 40)


def join_tiles(tiles: Sequence[Rgb], columns: int = COLUMNS, gap_px: int = 0) -> Rgb:
    """Tiles of one size in rows, on white; `gap_px` lie between two."""
    height, width = tiles[0].shape[:2]
    down, across = height + gap_px, width + gap_px
    rows = -(-len(tiles) // columns)
    shape = (rows * down - gap_px, min(columns, len(tiles)) * across - gap_px, 3)
    out = np.full(shape, 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = i // columns * down, i % columns * across
        out[y : y + height, x : x + width] = tile
    return out


def fit(rgb: Rgb, width: int, height: int) -> tuple[Rgb, float]:
    """The picture scaled to fit into a white tile, at its top left corner, and by how much."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    out = np.full((height, width, 3), 255, np.uint8)
    small = cv2.resize(rgb, size, interpolation=method)
    out[: small.shape[0], : small.shape[1]] = small
    return out, scale


def draw_box(rgb: Rgb, box: Sequence[float], colour: tuple[int, int, int], width: int) -> None:
    """A box on `rgb`, in place, with a dark rim so that it shows on any ground."""
    near = (round(box[0]), round(box[1]))
    far = (round(box[2]) - 1, round(box[3]) - 1)
    cv2.rectangle(rgb, near, far, (0, 0, 0), width + 2)
    cv2.rectangle(rgb, near, far, colour, width)


def labelled(rgb: Rgb, lines: Sequence[str]) -> Rgb:
    """The picture with two lines of text below, which are made to fit its width."""
    from PIL import Image, ImageDraw

    label = Image.new("RGB", (rgb.shape[1], LABEL_PX), "white")
    draw = ImageDraw.Draw(label)
    for i, line in enumerate(lines):
        text, size = fit_line(line, rgb.shape[1] - 8)
        draw.text((4, 9 + 16 * i), text, fill="black", font=_font(size), anchor="lm")
    return np.concatenate([rgb, np.asarray(label)])


def fit_line(line: str, width: int) -> tuple[str, int]:
    """The line and the size at which it is that wide at most: smaller, then without its middle."""
    for size in range(LARGEST_PX, SMALLEST_PX - 1, -1):
        if _font(size).getlength(line) <= width:
            return line, size
    for kept in range(len(line) - 1, 1, -1):
        head = (kept + 1) // 2
        shorter = f"{line[:head]}...{line[len(line) - kept + head :]}"
        if _font(SMALLEST_PX).getlength(shorter) <= width:
            return shorter, SMALLEST_PX
    return "", SMALLEST_PX


@cache
def _font(size: int) -> "FreeTypeFont":
    """Pillow's own font."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "Pillow has FreeType"
    return font


def write_picture(path: Path, rgb: Rgb) -> None:
    """Raises: BadOutput."""
    from PIL import Image

    with writing(path, "write_picture", "choose another folder"):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb).save(path)


CROP_SIDE = 512
"""The longer side of a crop that is kept; the encoder looks at fewer pixels."""
TILE_PX = 260


def gather_photos(paths: Sequence[Path]) -> list[Path]:
    """Picture files, each once; a folder gives its own in the order of their names.

    Raises: BadPhoto.
    """
    once: dict[str, Path] = {}
    for path in paths:
        found = photos_in(path) if os.path.isdir(path) else [path]
        if not found:
            raise BadPhoto(f"register: {path} holds no picture; name a folder of photos.")
        for photo in found:
            once.setdefault(os.path.realpath(photo), photo)
    return list(once.values())


def film_photos(video: Path, folder: Path, count: int) -> list[Path]:
    """The sharpest frames of a video, spread over it, as picture files in `folder`.

    Raises: BadPhoto, BadOutput.
    """
    if not is_video(video):
        raise BadPhoto(f"register: {video} is no video by its name; export it as MP4.")
    paths = [folder / f"{video.stem}-{i + 1}.png" for i in range(count)]
    for path, rgb in zip(paths, sharp_frames(video, count), strict=True):
        write_picture(path, rgb)
    return paths


def parse_given(
    boxes: Sequence[str], masks: Sequence[str], photos: Sequence[Path]
) -> dict[int, Box]:
    """The boxes of photos by their numbers, from "PHOTO=x0,y0,x1,y1" and "PHOTO=MASK".

    Boxes are pixels of the upright photo; a mask is a picture of its size, bright on the object.

    Raises: BadPhoto.
    """
    split = [_split(text, photos, "--box", "x0,y0,x1,y1") for text in boxes]
    given = {number: parse_box(words, "register: --box", BadPhoto) for number, words in split}
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


def leave_out_doubtful(
    references: Sequence[Reference], photos: Sequence[Path], sheet: Path
) -> tuple[list[int], list[str]]:
    """The numbers of the good crops, and a line about each that may be wrong.

    Raises: BadPhoto: some may be wrong, and fewer than FEWEST are good; BadOutput. The sheet of all
        is written then.
    """
    good = [i for i, reference in enumerate(references) if not reference.doubt]
    lines = []
    for reference, photo in zip(references, photos, strict=True):
        if reference.doubt:
            name = _shortest_name(photo, photos)
            ready = [
                f"--box {shlex.quote(name)}={','.join(f'{x:.0f}' for x in box)} (box {k})"
                for k, box in enumerate(alternatives(reference), 1)
            ]
            ready = ready or [f"--box {shlex.quote(name)}=x0,y0,x1,y1 in pixels"]
            lines.append(f"{name}: {reference.doubt}; give {' or '.join(ready)}")
    if lines and len(good) < FEWEST:
        write_sheet(sheet, references, photos)
        raise BadPhoto(f"register: {'; '.join(lines)}; or pass --accept. Look at {sheet}.")
    return good, lines


def alternatives(reference: Reference) -> list[Box]:
    """What could be meant in a doubtful photo, the chosen box first."""
    if not reference.doubt or reference.chosen_by == "whole":
        return []
    return [reference.box] if reference.rival is None else [reference.box, reference.rival]


def remember_references(
    name: str, category: str, references: Sequence[Reference], stack: Stack
) -> PersonalObject:
    """The object with the chosen crops. Raises: BadMemory, BadEncoder."""
    crops = [fit_crop(reference.crop) for reference in references]
    return remember(name, category, crops, stack.encoder)


def fit_crop(crop: Rgb) -> Rgb:
    """A crop of at most CROP_SIDE pixels."""
    height, width = crop.shape[:2]
    scale = CROP_SIDE / max(height, width)
    if scale >= 1:
        return crop
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(crop, size, interpolation=cv2.INTER_AREA)


def write_sheet(path: Path, references: Sequence[Reference], photos: Sequence[Path]) -> None:
    """A picture of every photo with its box, and of its crop beside it. Raises: BadOutput."""
    tiles = []
    for photo, reference in zip(photos, references, strict=True):
        shown, scale = fit(reference.photo, TILE_PX, TILE_PX)
        colour = DOUBTFUL if reference.doubt else RIGHT
        draw_box(shown, (scale * reference.box).tolist(), colour, 2)
        for k, box in enumerate(alternatives(reference), 1):
            draw_box(shown, (scale * box).tolist(), colour, 2)
            at = (scale * box[:2] + (6, 20)).astype(int).tolist()
            cv2.putText(shown, str(k), at, 0, 0.6, colour, 2)
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


def unknown_word(category: str, stack: Stack) -> str:
    """A line where the stack's detector was not taught the word, "" where it was."""
    from vap_core.perception.embedded.proposer import SNAP_COSINE, LiteDetector
    from vap_core.perception.text_encoder import embed_text
    from vap_core.simulation.assets.objects import CATEGORIES

    detector = stack.by_category
    if not isinstance(detector, LiteDetector):
        return ""
    if (detector.known @ embed_text([category])[0]).max() >= SNAP_COSINE:
        return ""
    near = get_close_matches(category, CATEGORIES, n=3, cutoff=0.75)
    meant = f"; did you mean {' or '.join(near)}?" if near else "; is it English, spelt right?"
    return (
        f"the detector does not know the word {category!r}: it proposes any object, and the photos "
        f"alone decide{meant}"
    )


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


def _split(text: str, photos: Sequence[Path], option: str, form: str) -> tuple[int, str]:
    """The photo's number and the rest of "PHOTO=REST"; both may hold "=", too."""
    names = [name for path in photos for name in (str(path), path.name)]
    photo = max((name for name in names if text.startswith(f"{name}=")), key=len, default="")
    fitting = [i for i, path in enumerate(photos) if photo in (str(path), path.name)]
    words = text[len(photo) :].removeprefix("=")
    if not photo and "=" not in words and len(photos) == 1:
        fitting = [0]
    if len(fitting) != 1:
        known = ", ".join(shlex.quote(_shortest_name(path, photos)) for path in photos[:6])
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


@value
class Trust:
    """Leave-one-out over K references: each in turn is a candidate, and the others vote.

    `right` counts the references that win against all rivals, `margin` is the least cosine by which
    one is ahead. Rivals are the crops of `others` remembered objects and `background` crops of the
    reference photos. `by_name` has the remembered objects that beat a reference.
    """

    right: int
    n: int
    margin: float
    others: int
    background: int
    by_name: tuple[str, ...]

    def __str__(self) -> str:
        if self.n < FEWEST:
            known = number_of(self.n, "reference")
            return f"vote not checked: {known}; give {FEWEST} or more, five are best"
        if not self.others + self.background:
            return "vote not checked: nothing else is remembered, and the photos show nothing else"
        text = (
            f"vote: each photo left out in turn, {self.right} of {self.n} are elected by the "
            f"others against {number_of(self.others, 'crop')} of other objects and "
            f"{self.background} of the background; least lead in cosine {self.margin:.2f}"
        )
        if self.by_name:
            text += f"; mistaken for {', '.join(self.by_name)}"
        if self.right < self.n:
            text += "; more photos, from all sides, or tighter crops help"
        return text


def leave_one_out(
    obj: PersonalObject,
    references: Sequence[Reference],
    bank: Mapping[str, PersonalObject],
    encoder: Encoder,
) -> Trust:
    """Elect each reference by the others among the crops of the bank and of the background."""
    background = [crop for reference in references for crop in reference.others]
    known = [each for each in bank.values() if each.name != obj.name]
    known = [each for each in known if each.encoder == obj.encoder]
    names = [""] * len(background) + [each.name for each in known for _ in each.embeddings]
    crops = embed_crops("remember", encoder, background)
    rivals = np.concatenate([crops, *(each.embeddings for each in known)])
    winners, margins = [], []
    n = len(obj.embeddings)
    for k in range(n) if n >= FEWEST and len(rivals) else ():
        others = np.delete(obj.embeddings, k, axis=0)
        cosine = similarity(np.concatenate([obj.embeddings[k : k + 1], rivals]), others)
        winners.append(vote(cosine).winner or 0)
        mean = cosine.mean(axis=1)
        margins.append(float(mean[0] - mean[1:].max()))
    return Trust(
        right=winners.count(0),
        n=n,
        margin=min(margins, default=float("nan")),
        others=len(rivals) - len(background),
        background=len(background),
        by_name=tuple(sorted({names[winner - 1] for winner in winners if winner} - {""})),
    )


def warnings(
    obj: PersonalObject, references: Sequence[Reference], names: Sequence[str]
) -> list[str]:
    """What is wrong with references that are used all the same, one line each."""
    shapes = [reference.crop.shape[:2] for reference in references]
    lines = [
        f"{name}: the object is only {width}x{height} pixels; go nearer, or take more pixels"
        for name, (height, width) in zip(names, shapes, strict=True)
        if min(height, width) < SMALL_PX
    ]
    cosine = obj.embeddings @ obj.embeddings.T
    to_others = (cosine.sum(axis=1) - cosine.diagonal()) / max(len(cosine) - 1, 1)
    for name, mean in zip(names, to_others.tolist(), strict=False):
        if len(cosine) > 1 and mean < LEAST_COSINE:
            lines.append(
                f"{name}: unlike the other references (mean cosine {mean:.2f}); is it the same "
                "object?"
            )
    return lines
