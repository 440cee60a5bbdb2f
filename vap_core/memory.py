"""The visual memory: reference photos of a personal object, their embeddings Z_o, and the bank on disk (P 3.3)."""

import json
import os
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np

from vap_core.detect import Detector
from vap_core.embed import Encoder, crop
from vap_core.errors import BadMemory, BadOutput, BadPhoto, UnknownName, one_of
from vap_core.values import Boxes, Description, PersonalObject, Rgb, Target

VERSION = 1
SUFFIX = ".object.safetensors"
MAX_PIXELS = 50_000_000
MAX_BYTES = 200_000_000
LONG_SIDE = 1024
KNOWN_PRESENT = 0.05
"""A photo of the object holds one of its category, so a reference's box needs less of a score than a proposal does."""
CATEGORY = re.compile(r"[^\W\d_][\w -]*")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}")


def load_photo(path: Path | str, long_side: int | None = LONG_SIDE) -> Rgb:
    """Read a picture file upright and shrink its longer side to `long_side` pixels (None keeps its size).

    Raises:
        BadPhoto: missing, empty, not an image, truncated, or more than 50 megapixels.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    path = Path(path)
    if not path.is_file():
        raise BadPhoto(f"load_photo: {path} is not a file; check the path.")
    if not path.stat().st_size:
        raise BadPhoto(f"load_photo: {path} is empty; export the photo again.")
    if path.stat().st_size > MAX_BYTES:
        raise BadPhoto(f"load_photo: {path} has {path.stat().st_size / 1e6:.0f} MB, over {MAX_BYTES / 1e6:.0f}; save it smaller.")
    try:
        with path.open("rb") as file, Image.open(file) as image:
            if image.width * image.height > MAX_PIXELS:
                raise BadPhoto(f"load_photo: {path} has {image.width}x{image.height} pixels, over {MAX_PIXELS / 1e6:.0f} million; scale it down.")
            if image.mode.startswith(("I", "F")):
                raise BadPhoto(f"load_photo: {path} has {image.mode} pixels, more than 8 bits each; save it as an 8-bit JPEG or PNG.")
            upright = ImageOps.exif_transpose(image).convert("RGB")
            if long_side is not None:
                upright.thumbnail((long_side, long_side))
            return np.array(upright, dtype=np.uint8)
    except BadPhoto:
        raise
    except (
        UnidentifiedImageError,
        Image.DecompressionBombError,
        Image.DecompressionBombWarning,
        OSError,
        ValueError,
        SyntaxError,
        struct.error,
    ) as error:
        raise BadPhoto(f"load_photo: {path} cannot be read as an image ({error}); export it as JPEG or PNG.") from error


def register(
    name: str, category: str, photos: Sequence[Rgb], detector: Detector, encoder: Encoder, *, threshold: float = KNOWN_PRESENT
) -> tuple[PersonalObject, tuple[int, ...]]:
    """Remember one object from its reference photos.

    Each photo is cropped by the same category detector that is used at test time (P 3.3), to its best box; where none scores
    `threshold`, the whole photo is the crop. Also returns the indices of those photos.
    """
    found: list[Boxes] = [detector([photo], category, threshold)[0] for photo in photos]
    whole = tuple(i for i, boxes in enumerate(found) if not len(boxes))
    crops = tuple(photo if i in whole else crop(photo, boxes.xyxy[0]) for i, (photo, boxes) in enumerate(zip(photos, found, strict=True)))
    return remember(name, category, crops, encoder), whole


def remember(name: str, category: str, crops: Sequence[Rgb], encoder: Encoder) -> PersonalObject:
    """Embed reference crops that are cut out already.

    Raises:
        BadMemory: no usable name or category; BadPhoto: no crops.
    """
    if not NAME.fullmatch(name):
        raise BadMemory(f"remember: {name!r} cannot name an object; use letters, digits, space, dot, dash or underscore.")
    if not CATEGORY.fullmatch(category.strip()):
        raise BadMemory(f"remember: {category!r} cannot be a category; name the kind of thing in words, for example --category cup.")
    if not crops:
        raise BadPhoto(f"remember: {name!r} has no photos; give at least one, five are best.")
    return PersonalObject(name, " ".join(category.lower().split()), encoder(crops), tuple(crops), encoder.name)


def save(bank: Path, obj: PersonalObject, *, replace: bool = False) -> Path:
    """Write one object into the bank (a folder), atomically.

    Raises:
        BadOutput: the folder cannot be written, or holds that name and `replace` is off.
    """
    from safetensors.numpy import save as encode

    path = bank / f"{obj.name}{SUFFIX}"
    if path.exists() and not replace:
        raise BadOutput(f"save: {path} exists; choose another name or pass --replace.")
    tensors = {"embeddings": obj.embeddings, **{f"crop.{i:03d}": np.ascontiguousarray(crop) for i, crop in enumerate(obj.crops)}}
    about = {"format": "vap-personal-object", "version": str(VERSION), "name": obj.name, "category": obj.category, "encoder": obj.encoder}
    if obj.description is not None:
        about["description"] = json.dumps(asdict(obj.description))
    try:
        bank.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=bank, prefix=".", suffix=".tmp", delete=False) as file:
            file.write(encode(tensors, metadata=about))
        os.replace(file.name, path)
    except OSError as error:
        raise BadOutput(f"save: {bank} cannot be written ({error.strerror}); choose another folder with --memory.") from error
    return path


def load(path: Path, encoder: str | None = None) -> PersonalObject:
    """Read one object; the file is parsed, never executed.

    Raises:
        BadMemory: missing, damaged, of another version, or embedded by another encoder than `encoder`.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load as decode

    again = "register the object again with --replace, or delete the file"
    if not path.is_file():
        raise BadMemory(f"load: {path} is not a file; {again}.")
    data = path.read_bytes()
    try:
        (size,) = struct.unpack("<Q", data[:8])
        about = json.loads(data[8 : 8 + size]).get("__metadata__", {})
        tensors = decode(data)
    except (SafetensorError, struct.error, ValueError, MemoryError, OverflowError, AttributeError) as error:
        raise BadMemory(f"load: {path} is damaged ({type(error).__name__}); {again}.") from error
    if not isinstance(about, dict) or about.get("format") != "vap-personal-object" or about.get("version") != str(VERSION):
        raise BadMemory(f"load: {path} is version {about.get('version', 'unknown')}, this program reads version {VERSION}; {again}.")
    if encoder is not None and about.get("encoder") != encoder:
        raise BadMemory(f"load: {path} was embedded by {about.get('encoder')!r}, this stack uses {encoder!r}; {again}.")
    try:
        crops = tuple(tensors[key] for key in sorted(tensors) if key.startswith("crop."))
        told = Description(**json.loads(about["description"])) if "description" in about else None
        return PersonalObject(about["name"], about["category"], tensors["embeddings"], crops, about["encoder"], told)
    except (KeyError, ValueError, TypeError) as error:
        raise BadMemory(f"load: {path} lacks what an object needs ({type(error).__name__}); {again}.") from error


def load_bank(bank: Path, encoder: str | None = None) -> dict[str, PersonalObject]:
    """Every object of a bank by name; a bank that does not exist yet is empty."""
    return {obj.name: obj for obj in (load(path, encoder) for path in sorted(bank.glob(f"*{SUFFIX}")))}


def recall(memory: Mapping[str, PersonalObject], target: Target, name: str | None = None) -> PersonalObject:
    """The remembered object that a target means: by name when given, else the only one of its category.

    Raises:
        UnknownName: nothing, or more than one thing, fits.
    """
    if name is not None:
        if name not in memory:
            raise one_of("recall: object", name, memory)
        return memory[name]
    fitting = [obj for obj in memory.values() if obj.category == target.category]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        known = ", ".join(sorted(f"{obj.name} ({obj.category})" for obj in memory.values())) or "nothing yet"
        raise UnknownName(f"recall: no {target.category!r} is remembered; the memory holds {known}. Register one, or point --memory at its folder.")
    raise UnknownName(
        f"recall: {len(fitting)} objects are a {target.category!r}: {', '.join(sorted(o.name for o in fitting))}; choose with --object."
    )
