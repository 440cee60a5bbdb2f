"""Objects of the user's own, one folder each: how a scan lies on disk, and how it is read back and checked.

`object.json` says what it is and holds the SHA-256 of the other files: `mesh.npz`, `hulls.npz` and `texture.png`. All are parsed, none
is executed. The folder of folders is `data/objects`, or the environment variable VAP_OBJECTS.
"""

import io
import json
import os
import shutil
import zipfile
from dataclasses import asdict
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from PIL import Image, UnidentifiedImageError

from vap_core.errors import BadObject, BadOutput
from vap_core.sim.shapes import Hull, Mesh
from vap_core.values import Rgb, value

FORMAT, VERSION = "vap-object", 1
FILES = ("mesh.npz", "hulls.npz", "texture.png")
AGAIN = "import the object again with --replace, or delete its folder"


@value
class Scan:
    """A shape that was not drawn but brought along: its mesh, its convex parts, and the picture that its texture coordinates point into."""

    form: Mesh
    hulls: tuple[Hull, ...]
    image: Rgb

    def mesh(self) -> Mesh:
        return self.form

    def solids(self) -> tuple[Hull, ...]:
        return self.hulls

    def aspect(self) -> float:
        return self.image.shape[1] / self.image.shape[0]


@value
class Card:
    """What is known of a scan: its names, its mass (kg), where it came from and under which licence."""

    name: str
    category: str
    mass_kg: float
    source: str
    source_sha256: str
    licence: str
    vap: str
    split: str = "personal"


def home() -> Path:
    """The folder that holds the scans."""
    return Path(os.environ.get("VAP_OBJECTS", "data/objects"))


def scans() -> dict[str, Path]:
    """The folder of every scan by its name."""
    return {path.parent.name: path.parent for path in sorted(home().glob("[!.]*/object.json"))}


def free(folder: Path, name: str, replace: bool) -> Path:
    """Where a scan of that name goes. Raises: BadOutput when there is one already and `replace` is off."""
    if (folder / name).exists() and not replace:
        raise BadOutput(f"objects: {folder / name} exists; choose another --name or pass --replace.")
    return folder / name


def save(folder: Path, card: Card, scan: Scan, *, replace: bool = False) -> Path:
    """Write a scan into `folder/<name>`, whole or not at all.

    Raises:
        BadOutput: the folder cannot be written, or holds that name and `replace` is off.
    """
    place = free(folder, card.name, replace)
    form, written = scan.form, {}
    written["mesh.npz"] = _npz({"vertex": form.vertex, "normal": form.normal, "uv": form.uv, "face": form.face})
    hulls = {f"{i:02d}.{key}": part for i, hull in enumerate(scan.hulls) for key, part in (("vertex", hull.vertex), ("volume", hull.volume))}
    written["hulls.npz"] = _npz(hulls)
    picture = io.BytesIO()
    Image.fromarray(scan.image).save(picture, "PNG")
    written["texture.png"] = picture.getvalue()
    about = {"format": FORMAT, "version": VERSION, **asdict(card), "sha256": {name: sha256(data).hexdigest() for name, data in written.items()}}
    written["object.json"] = json.dumps(about, indent=1, ensure_ascii=False).encode()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stage = Path(mkdtemp(prefix=".", dir=folder))
        for name, data in written.items():
            (stage / name).write_bytes(data)
        stage.chmod(0o755)
        if place.exists():
            os.replace(place, stage.with_suffix(".old"))
        os.replace(stage, place)
        shutil.rmtree(stage.with_suffix(".old"), ignore_errors=True)
    except OSError as error:
        raise BadOutput(f"objects: {folder} cannot be written ({error.strerror}); choose another folder with --out.") from error
    return place


def load(place: Path) -> tuple[Card, Scan]:
    """Read a scan from its folder, checked.

    Raises:
        BadObject: a file is missing, damaged or of another version; the message names it.
    """
    about = place / "object.json"
    if not about.is_file():
        raise BadObject(f"objects: {about} is not a file; {AGAIN}.")
    return _load(place, about.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _load(place: Path, written_ns: int) -> tuple[Card, Scan]:
    card, sums = _card(place)
    read = {}
    for name in FILES:
        path = place / name
        read[name] = path.read_bytes() if path.is_file() else b""
        if sha256(read[name]).hexdigest() != sums.get(name):
            raise BadObject(f"objects: {path} is {'damaged (its SHA-256 differs)' if read[name] else 'missing or empty'}; {AGAIN}.")
    name = FILES[0]
    try:
        mesh = _arrays(read[name])
        form = Mesh(mesh["vertex"], mesh["normal"], mesh["uv"], mesh["face"])
        if not len(form.vertex) == len(form.normal) == len(form.uv) or not 0 <= form.face.min() <= form.face.max() < len(form.vertex):
            raise ValueError("faces name vertices that are not there")
        name = FILES[1]
        parts = _arrays(read[name])
        hulls = tuple(Hull(parts[f"{i:02d}.vertex"], float(parts[f"{i:02d}.volume"])) for i in range(len(parts) // 2))
        if not hulls:
            raise ValueError("no hulls")
        name = FILES[2]
        with Image.open(io.BytesIO(read[name])) as picture:
            image = np.array(picture.convert("RGB"))
    except (KeyError, ValueError, TypeError, OSError, zipfile.BadZipFile, UnidentifiedImageError) as error:
        raise BadObject(f"objects: {place / name} lacks what an object needs ({error}); {AGAIN}.") from error
    return card, Scan(form, hulls, image)


def _card(place: Path) -> tuple[Card, dict[str, str]]:
    path = place / "object.json"
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if (about.pop("format"), about.pop("version")) != (FORMAT, VERSION):
            raise BadObject(f"objects: {path} is of another version than {FORMAT} {VERSION}; {AGAIN}.")
        sums = about.pop("sha256")
        card = Card(**about)
        if card.name != place.name or not np.isfinite(card.mass_kg) or card.mass_kg <= 0 or not isinstance(sums, dict):
            raise ValueError(f"name {card.name!r}, mass {card.mass_kg} kg")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise BadObject(f"objects: {path} is damaged ({error}); {AGAIN}.") from error
    return card, sums


def _npz(arrays: dict[str, np.ndarray | float]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **{key: np.asarray(array) for key, array in arrays.items()})
    return file.getvalue()


def _arrays(data: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return dict(file)
