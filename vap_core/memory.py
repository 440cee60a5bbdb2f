"""The visual memory: references of personal objects, and the bank on disk (P 3.3).

References are crops of photos, and their embeddings Z_o.
"""

import json
import os.path
import re
import shlex
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadEncoder, BadMemory, BadOutput, BadPhoto, UnknownName, an, one_of
from vap_core.base.files import encode_tensors, parse_json, read_file, remove_scratch, write_atomic
from vap_core.base.media import load_photo as load_photo
from vap_core.base.types import Description, PersonalObject, Rgb, Target
from vap_core.instruction.context import belonging, check_owner, owners_of
from vap_core.perception.boxes import crop
from vap_core.perception.candidates import describe_fault, detect, embed_crops, row_fault
from vap_core.perception.protocols import Detector, Encoder, ReferenceCropper

FORMAT = "vap-personal-object"
VERSION = 1
SUFFIX = ".object.safetensors"
REFERENCE_THRESHOLD = 0.05
"""A photo of the object shows one of its category, so a reference's box needs a lower score than a
proposal does."""
CATEGORY = re.compile(r"[^\W\d_][\w -]*")
OWNED = re.compile(r"(?:(?:my|our|his|her|their|the|an?) )+(?=.)")
"""What stands before a category in an instruction, and is no part of it."""
OWNER_WORDS = ("my", "our", "his", "her", "their", "the", "an", "this", "that", "these", "those")
"""No kind of thing by themselves; "a" may be one, as the letter."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}")
NAME_RULE = (
    "a letter a to z or a digit, then letters, digits, space, dot, dash or underscore, at most 64 "
    "characters"
)
"""`NAME` in words."""
AGAIN = "register the object again with --replace, or delete the file"


def register(
    name: str,
    category: str,
    photos: Sequence[Rgb],
    detector: Detector,
    encoder: Encoder,
    *,
    threshold: float = REFERENCE_THRESHOLD,
) -> tuple[PersonalObject, tuple[int, ...]]:
    """Remember one object from its reference photos.

    Each photo is cropped by the detector that is used at test time (P 3.3), to its
    `reference_box`; where there is none, the whole photo is the crop. Also returns the indices of
    those photos.
    """
    boxes = [reference_box(photo, category, detector, threshold=threshold) for photo in photos]
    pairs = zip(photos, boxes, strict=True)
    crops = [photo if box is None else crop(photo, box) for photo, box in pairs]
    whole = tuple(i for i, box in enumerate(boxes) if box is None)
    return remember(name, category, crops, encoder), whole


def reference_box(
    photo: Rgb, category: str, detector: Detector, *, threshold: float = REFERENCE_THRESHOLD
) -> Float32[np.ndarray, "4"] | None:
    """Where a photo shows the object that it is a reference of; None where nothing is found.

    It is the best box of the category. Of boxes of any object it is the likeliest that holds the
    photo's centre.
    """
    if not isinstance(detector, ReferenceCropper):
        (boxes,) = detect(detector, [photo], category, threshold)
        return boxes.xyxy[0] if len(boxes) else None
    boxes, evidence = detector.reference_boxes(photo, category, threshold)
    h, w = photo.shape[:2]
    centre = np.array([w / 2, h / 2])
    inside = (boxes.xyxy[:, :2] <= centre) & (centre <= boxes.xyxy[:, 2:])
    holding = np.flatnonzero(inside.all(axis=1))
    if not len(holding):
        return None
    return boxes.xyxy[holding[evidence[holding].argmax()]]


def remember(name: str, category: str, crops: Sequence[Rgb], encoder: Encoder) -> PersonalObject:
    """Embed reference crops that are cut out already.

    Raises:
        BadMemory: no usable name or category; BadPhoto: no crops; BadEncoder: its rows are no
            float32 array with one a crop, not finite, or not of length 1 (within 1e-3).
    """
    check_names(name, category)
    if not crops:
        raise BadPhoto(f"remember: {name!r} has no photos; give at least one, five are best.")
    rows = embed_crops("remember", encoder, crops)
    fault = row_fault(rows, rows)
    if fault:
        raise BadEncoder(describe_fault("remember", encoder, fault))
    return PersonalObject(name, plain_category(category), rows, tuple(crops), encoder.name)


def plain_category(category: str) -> str:
    """A category as it is remembered: lower case, with single spaces, an umlaut one character."""
    return " ".join(normalize("NFC", category).lower().split())


def kind_instead(category: str) -> str:
    """A word to write instead of a category that will not do; "" where it will."""
    plain = plain_category(category)
    before = OWNED.match(plain)
    kind = plain[before.end() :] if before else plain
    if not CATEGORY.fullmatch(plain) or kind in OWNER_WORDS:
        return "cup"
    return kind if before else ""


def check_names(name: str, category: str) -> None:
    """Raises: BadMemory: no usable name or category of an object."""
    if not NAME.fullmatch(name):
        raise BadMemory(f"remember: {name!r} cannot name an object; use {NAME_RULE}.")
    kind = kind_instead(category)
    if kind:
        raise BadMemory(
            f"remember: {category!r} cannot be a category; name the kind of thing alone, in words, "
            f"for example --category {shlex.quote(kind)}."
        )


def reference_rows(obj: PersonalObject, encoder: Encoder) -> Float32[np.ndarray, "k d"]:
    """Z_o by this encoder: the remembered rows if they are its own, else from the kept crops.

    Raises: BadEncoder, as `embed_crops` does.
    """
    if encoder.name == obj.encoder:
        return obj.embeddings
    return _embed_crops(obj, _ByIdentity(encoder))


def recall(
    memory: Mapping[str, PersonalObject],
    target: Target,
    name: str | None = None,
    speaker: str = "",
) -> PersonalObject:
    """The remembered object that a target means when `speaker` speaks ("" where nobody said).

    It is found by name when given, else it is the only one of its category and of its owner.

    Raises:
        UnknownName: nothing, or more than one object, fits; BadInstruction: several owners do.
    """
    name = name or target.object
    if name is not None:
        if name not in memory:
            raise one_of("recall: object", name, memory)
        return memory[name]
    of_category = []
    known = []
    for obj in memory.values():
        whose = f", {obj.owner}'s" if obj.owner else ""
        known.append(f"{obj.name} ({obj.category}{whose})")
        if obj.category == target.category:
            of_category.append(obj)
    owners = owners_of(memory.values())
    fitting = belonging(of_category, target.owner, speaker, owners)
    if of_category and not fitting:
        who = f"{speaker} speaks" if speaker else "nobody is named with --speaker"
        raise UnknownName(
            f"recall: no {target.category!r} is {target.owner!r} where {who}; the memory holds "
            f"{', '.join(sorted(known))[:120]}. Say whose it is, name the --speaker, "
            "or name it with --object."
        )
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(sorted(obj.name for obj in fitting))
        raise UnknownName(
            f"recall: {len(fitting)} objects are {an(target.category)}: {names}; choose with "
            "--object."
        )
    named = memory.get(target.category)
    if named is not None:
        raise UnknownName(
            f"recall: {named.name!r} is the name of {an(named.category)}; "
            f'say "my {named.category}".'
        )
    contents = ", ".join(sorted(known)) or "nothing yet"
    raise UnknownName(
        f"recall: no {target.category!r} is remembered; the memory holds {contents}. Register one, "
        "or point --memory at its folder."
    )


def save(bank: Path | str, obj: PersonalObject, *, replace: bool = False) -> Path:
    """Write one object into the bank (a folder), atomically.

    Raises:
        BadMemory: no usable name or category; BadOutput: the folder cannot be written, or holds
            that name and `replace` is off.
    """
    check_names(obj.name, obj.category)
    check_owner(obj.owner, obj.known_as, obj.note)
    bank = Path(bank)
    path = object_path(bank, obj.name)
    tensors = {"embeddings": obj.embeddings}
    for i, reference in enumerate(obj.crops):
        tensors[f"crop.{i:03d}"] = np.ascontiguousarray(reference)
    header = {
        "format": FORMAT,
        "version": str(VERSION),
        "name": obj.name,
        "category": obj.category,
        "encoder": obj.encoder,
    }
    if obj.description is not None:
        header["description"] = json.dumps(asdict(obj.description))
    if obj.owner:
        header |= {"owner": obj.owner, "known_as": json.dumps(obj.known_as)}
    if obj.note:
        header["note"] = obj.note
    try:
        bank.mkdir(parents=True, exist_ok=True)
        remove_scratch(bank)
        write_atomic(path, encode_tensors(tensors, header), replace=replace)
    except OSError as error:
        if os.path.lexists(path) and not replace:
            raise taken(path) from error
        raise BadOutput(
            f"save: {bank} cannot be written ({error.strerror}); choose another folder with "
            "--memory."
        ) from error
    return path


def object_path(bank: Path, name: str) -> Path:
    """The file of an object in a bank."""
    return bank / f"{name}{SUFFIX}"


def object_files(bank: Path) -> list[Path]:
    """The files of a bank's objects, in the order of their names.

    Hidden files, such as the `._NAME` that macOS writes beside its files, are left out.

    Raises: BadMemory: the folder cannot be read.
    """
    try:
        paths = sorted(bank.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise BadMemory(
            f"load_bank: {bank} cannot be read ({error.strerror or error}); check its permissions, "
            "or choose another folder with --memory."
        ) from error
    return [path for path in paths if path.name.endswith(SUFFIX) and not path.name.startswith(".")]


def taken(path: Path) -> BadOutput:
    """The error for an object whose name a bank holds already."""
    return BadOutput(f"save: {path} exists; choose another name or pass --replace.")


def load(path: Path | str, encoder: str | None = None) -> PersonalObject:
    """Read one object; the file is parsed, never executed.

    Raises:
        BadMemory: missing, unreadable, damaged, of another version, or embedded by another encoder.
    """
    path = Path(path)
    header, tensors = _read(path)
    if header.get("format") != FORMAT or header.get("version") != str(VERSION):
        raise BadMemory(
            f"load: {path} is version {header.get('version', 'unknown')}, this program reads "
            f"version {VERSION}; {AGAIN}."
        )
    if encoder is not None and header.get("encoder") != encoder:
        raise BadMemory(
            f"load: {path} was embedded by {header.get('encoder')!r}, this stack uses {encoder!r}; "
            f"{AGAIN}."
        )
    name, category = str(header.get("name")), str(header.get("category"))
    if path.name != f"{name}{SUFFIX}" or not NAME.fullmatch(name):
        raise BadMemory(
            f"load: {path} holds an object named {name[:64]!r}, which is not the file's name; "
            f"{AGAIN}."
        )
    if not CATEGORY.fullmatch(category):
        raise BadMemory(f"load: {path} has the category {category[:64]!r}; {AGAIN}.")
    try:
        crops = [tensors[key] for key in sorted(tensors) if key.startswith("crop.")]
        description = None
        if "description" in header:
            description = Description(**parse_json(header["description"]))
        owner, note = header.get("owner", ""), header.get("note", "")
        known_as = tuple(parse_json(header.get("known_as", "[]")))
        check_owner(owner, known_as, note)
        return PersonalObject(
            name=name,
            category=category,
            embeddings=tensors["embeddings"],
            crops=tuple(crops),
            encoder=header["encoder"],
            description=description,
            owner=owner,
            known_as=known_as,
            note=note,
        )
    except (KeyError, ValueError, TypeError, BadMemory) as error:
        raise BadMemory(
            f"load: {path} lacks what an object needs ({type(error).__name__}); {AGAIN}."
        ) from error


def load_bank(
    bank: Path | str, encoder: str | None = None, caller: str = ""
) -> dict[str, PersonalObject]:
    """Every object of a bank by name; a bank that does not exist yet is empty.

    Raises: BadMemory, as `load` and `object_files`; for an empty one where a `caller` needs some.
    """
    found = {obj.name: obj for obj in (load(path, encoder) for path in object_files(Path(bank)))}
    if caller and not found:
        raise BadMemory(
            f"{caller}: {bank} holds no object; register one there, or name another folder with "
            "--memory."
        )
    return found


@dataclass(frozen=True, eq=False)
class _ByIdentity:
    """An encoder as a key, for it need not be hashable."""

    encoder: Encoder

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByIdentity) and self.encoder is other.encoder

    def __hash__(self) -> int:
        return id(self.encoder)


@lru_cache(maxsize=256)
def _embed_crops(obj: PersonalObject, by: _ByIdentity) -> Float32[np.ndarray, "k d"]:
    return embed_crops("remember", by.encoder, obj.crops)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header's metadata and the tensors of a memory file."""
    from safetensors import SafetensorError
    from safetensors.numpy import load as decode

    try:
        data = read_file(path)
    except OSError as error:
        raise BadMemory(
            f"load: {path} cannot be read ({error.strerror or error}); check its permissions, or "
            f"{AGAIN}."
        ) from error
    damaged = (
        SafetensorError,
        struct.error,
        ValueError,
        MemoryError,
        OverflowError,
        AttributeError,
    )
    try:
        (size,) = struct.unpack("<Q", data[:8])
        header = parse_json(data[8 : 8 + size]).get("__metadata__", {})
        tensors = decode(data)
    except damaged as error:
        raise BadMemory(f"load: {path} is damaged ({type(error).__name__}); {AGAIN}.") from error
    if not isinstance(header, dict):
        header = {}
    return header, tensors
