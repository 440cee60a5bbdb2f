"""A user's own objects on disk, one folder each: how a scan is written, read back and checked.

`object.json` says what it is and holds the SHA-256 of the other files: `mesh.npz`, `hulls.npz` and
`texture.png`. All are parsed, none is executed. The folder of folders is `data/objects`, or the
environment variable VAP_OBJECTS.
"""

import io
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from zipfile import ZipFile

import numpy as np
from PIL import Image

from vap_core.base.errors import BadObject, BadOutput, UnknownName
from vap_core.base.files import parse_json, remove_scratch
from vap_core.base.media import decode_picture
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.shapes import Hull, Mesh

FORMAT, VERSION = "vap-object", 1
VARIABLE = "VAP_OBJECTS"
MESH_FILE, HULLS_FILE, TEXTURE_FILE = FILES = ("mesh.npz", "hulls.npz", "texture.png")
METADATA_FILE = "object.json"
FORMER, STAGE = ".old", ".stage-"
UNPACKED_BYTES = 500_000_000
"""Of a mesh or its hulls: zeros pack a thousandfold."""
REMEDY = "import the object again with --replace, or delete its folder"


@value
class Scan:
    """An imported shape: its mesh, its convex parts, and its texture."""

    form: Mesh
    hulls: tuple[Hull, ...]
    image: Rgb

    def mesh(self) -> Mesh:
        return self.form

    def solids(self) -> tuple[Hull, ...]:
        return self.hulls

    def picture(self) -> Rgb:
        return self.image


@value
class ScanMetadata:
    """What is known of a scan: its names, its mass (kg), its source file and its licence.

    `vap` is the version of this package that imported it.
    """

    name: str
    category: str
    mass_kg: float
    source: str
    source_sha256: str
    licence: str
    vap: str
    split: str = "personal"


def scans_folder() -> Path:
    """The folder that holds the scans."""
    return Path(os.environ.get(VARIABLE) or "data/objects")


def scan_folders() -> dict[str, Path]:
    """The folder of every scan by its name.

    Where a replacement was killed half way, that is the place of the former scan.

    Raises: UnknownName when VAP_OBJECTS names no folder.
    """
    folder = scans_folder()
    if os.environ.get(VARIABLE) and not folder.is_dir():
        raise UnknownName(
            f"objects: {VARIABLE}={folder} is no folder; name the one that holds your objects, or "
            "unset the variable."
        )
    folders = {}
    for path in sorted(folder.glob(f"[!.]*/{METADATA_FILE}")):
        folders[path.parent.name] = path.parent
    for path in sorted(folder.glob(f".*{FORMER}/{METADATA_FILE}")):
        folders.setdefault(_name_of(path.parent), path.parent)
    return dict(sorted(folders.items()))


def target_folder(folder: Path, name: str, replace: bool) -> Path:
    """Where a scan of that name goes. Raises: BadOutput if it exists and `replace` is off."""
    target = folder / name
    if not replace and (target.exists() or _former(target).exists()):
        raise BadOutput(f"objects: {target} exists; choose another --name or pass --replace.")
    return target


def _former(target: Path) -> Path:
    """Where the former scan is while a new one takes its place, or a killed process left it."""
    return target.with_name(f".{target.name}{FORMER}")


def _name_of(folder: Path) -> str:
    """The name of the scan in a folder, `_former` ones included."""
    if folder.name.startswith("."):
        return folder.name.removeprefix(".").removesuffix(FORMER)
    return folder.name


def save_scan(folder: Path, metadata: ScanMetadata, scan: Scan, *, replace: bool = False) -> Path:
    """Write a scan into `folder/<name>`, whole or not at all.

    Raises:
        BadOutput: the folder cannot be written, or holds that name and `replace` is off.
    """
    target = target_folder(folder, metadata.name, replace)
    files = _encode_scan(scan)
    digests = {name: sha256(data).hexdigest() for name, data in files.items()}
    about = {"format": FORMAT, "version": VERSION, **asdict(metadata), "sha256": digests}
    files[METADATA_FILE] = json.dumps(about, indent=1, ensure_ascii=False).encode()
    try:
        _write_folder(target, files, replace)
    except OSError as error:
        target_folder(folder, metadata.name, replace)
        raise BadOutput(
            f"objects: {folder} cannot be written ({error.strerror}); choose another folder with "
            "--out."
        ) from error
    return target


def _encode_scan(scan: Scan) -> dict[str, bytes]:
    """The contents of `FILES`."""
    hulls: dict[str, np.ndarray] = {}
    for i, hull in enumerate(scan.hulls):
        hulls[f"{i:02d}.vertex"] = hull.vertex
        hulls[f"{i:02d}.volume"] = np.asarray(hull.volume)
    mesh = {name: getattr(scan.form, name) for name in ("vertex", "normal", "uv", "face")}
    files = {}
    for file, arrays in ((MESH_FILE, mesh), (HULLS_FILE, hulls)):
        packed = io.BytesIO()
        np.savez_compressed(packed, allow_pickle=False, **arrays)
        files[file] = packed.getvalue()
    picture = io.BytesIO()
    Image.fromarray(scan.image).save(picture, "PNG")
    return {**files, TEXTURE_FILE: picture.getvalue()}


def _write_folder(target: Path, files: Mapping[str, bytes], replace: bool) -> None:
    """Write the files into a new folder, then give it the target's name.

    No call exchanges two folders on every system. Between the two renames of a replacement the
    former scan is at `_former`, where readers find it; it goes when the new one is in place.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_scratch(target.parent, f"{STAGE}*")
    stage = Path(mkdtemp(prefix=STAGE, dir=target.parent))
    try:
        for name, data in files.items():
            (stage / name).write_bytes(data)
        stage.chmod(0o755)
        if replace and target.exists():
            shutil.rmtree(_former(target), ignore_errors=True)
            os.replace(target, _former(target))
        os.replace(stage, target)  # fails where a folder that holds files has that name by now
        shutil.rmtree(_former(target), ignore_errors=True)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def load_scan(folder: Path) -> tuple[ScanMetadata, Scan]:
    """Read a scan from its folder, checked.

    Raises:
        BadObject: a file is missing, damaged or of another version; the message names it.
    """
    about = folder / METADATA_FILE
    if not about.is_file():
        raise BadObject(f"objects: {about} is not a file; {REMEDY}.")
    return _load_version(folder, about.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _load_version(folder: Path, written_ns: int) -> tuple[ScanMetadata, Scan]:
    """The scan as it was written at that time."""
    metadata, digests = _read_metadata(folder)
    parts = []
    for name, decode in DECODERS.items():
        path = folder / name
        data = path.read_bytes() if path.is_file() else b""
        if sha256(data).hexdigest() != digests.get(name):
            flaw = "damaged (its SHA-256 differs)" if data else "missing or empty"
            raise BadObject(f"objects: {path} is {flaw}; {REMEDY}.")
        try:
            parts.append(decode(data))
        except Exception as error:  # a damaged file makes the decoders raise anything
            raise BadObject(
                f"objects: {path} lacks what an object needs ({error}); {REMEDY}."
            ) from error
    return metadata, Scan(*parts)


def _decode_mesh(data: bytes) -> Mesh:
    mesh = Mesh(**_decode_arrays(data))
    known = min(map(len, (mesh.vertex, mesh.normal, mesh.uv)))
    if not 0 <= mesh.face.min() <= mesh.face.max() < known:
        raise ValueError("faces name vertices that are not there")
    return mesh


def _decode_hulls(data: bytes) -> tuple[Hull, ...]:
    arrays = _decode_arrays(data)
    if len(arrays) < 2:
        raise ValueError("no hulls")
    names = (f"{i:02d}" for i in range(len(arrays) // 2))
    return tuple(Hull(arrays[f"{n}.vertex"], float(arrays[f"{n}.volume"])) for n in names)


DECODERS: dict[str, Callable[[bytes], Any]] = {
    MESH_FILE: _decode_mesh,
    HULLS_FILE: _decode_hulls,
    TEXTURE_FILE: lambda data: decode_picture(io.BytesIO(data), TEXTURE_FILE, formats=("PNG",)),
}


def _read_metadata(folder: Path) -> tuple[ScanMetadata, dict[str, str]]:
    """What `object.json` says, and the SHA-256 of the other files by their names."""
    path = folder / METADATA_FILE
    try:
        about = parse_json(path.read_text(encoding="utf-8"))
        if (about.pop("format"), about.pop("version")) != (FORMAT, VERSION):
            raise BadObject(
                f"objects: {path} is of another version than {FORMAT} {VERSION}; {REMEDY}."
            )
        digests = dict(about.pop("sha256"))
        metadata = ScanMetadata(**about)
        if metadata.name != _name_of(folder) or not 0 < metadata.mass_kg < np.inf:
            raise ValueError(f"name {metadata.name!r}, mass {metadata.mass_kg} kg")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise BadObject(f"objects: {path} is damaged ({error}); {REMEDY}.") from error
    return metadata, digests


def _decode_arrays(data: bytes) -> dict[str, np.ndarray]:
    with ZipFile(io.BytesIO(data)) as packed:
        if sum(part.file_size for part in packed.infolist()) > UNPACKED_BYTES:
            raise ValueError(f"over {UNPACKED_BYTES / 1e6:.0f} MB unpacked")
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = dict(file)
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise ValueError("numbers that are not finite")
    return arrays
