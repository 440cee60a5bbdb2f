"""The object registry: every object of the scenes by its name.

`data/catalogue` holds the objects that ship: `objects.jsonl` says what each is, `forms.zip` has its
mesh and its picture, as `python -m vap_make.objects` baked them. Every category has one personal
instance with its look-alikes, for evaluation; hard look-alikes share the personal instance's base
and ink colours and differ in motif, layout and subtle shape. Generic instances have motifs and
layouts that evaluation instances never have; those that suites place are baked, and importing
`vap_make.objects` adds all others. A user's own scans come from their folders.

A "kind" is a category ("pen holder") or the stem of an object's name ("paper-cup").
"""

import io
import json
import lzma
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipFile

import numpy as np
from PIL import Image, ImageDraw

from vap_core.base.errors import UnknownName, one_of
from vap_core.base.files import DATA
from vap_core.base.types import Rgb, value
from vap_core.simulation.assets.scans.storage import Scan, load_scan, scan_folders
from vap_core.simulation.assets.shapes import Form, Mesh, Solid, Srgb, Texture

CATALOGUE = DATA / "catalogue"
ROWS, FORMS = CATALOGUE / "objects.jsonl", CATALOGUE / "forms.zip"
RED = "-red"
"""Ends the name of an object that is red by nature, and else as the one before it."""
RED_PAINT: Srgb = (196, 24, 28)
CLUTTER = ("coke can", "toy bus", "painting", "plate", "basket", "plastic bowl")
"""Categories without evaluation instances: clutter and receptacles."""
ATLAS_PX, WALL_PX = 512, 384
"""The side of a drawn picture; its upper rows are the decorated wall, unrolled."""
KEY = (65536, 256, 1)
"""A colour times this is its number."""

Tier = Literal["hard", "medium", "easy"]
TIERS: tuple[Tier, ...] = ("hard", "medium", "easy")


@value
class ObjectModel:
    """One object: its category, the split that may use it, its shape, its texture and its mass.

    `shape` and `texture` are the parameters that a drawn object has. A scan is its own shape, and
    its texture is the picture. A "foreign" one is another library's; no recording holds its mesh.
    """

    name: str
    category: str
    split: Literal["generic", "personal", "lookalike", "prop", "foreign"]
    shape: dict[str, Any] | Scan
    texture: Texture | Rgb
    mass_kg: float
    form: Form


@value
class Baked:
    """The mesh, the solids and the picture of an object in `forms.zip`.

    `mesh_at` is the mesh's first and last vertex and face among those of its stem. Of a wall with
    random spots the archive has the spots; `wall_px` is how high it was drawn. Of a red picture it
    has what every colour of the plain one becomes and, where that is not all, the rest.
    """

    name: str
    texture: Texture
    solid: tuple[Solid, ...]
    stem: str
    mesh_at: tuple[int, int, int, int]
    wall_px: int

    def mesh(self) -> Mesh:
        corner, face = _meshes(self.stem)
        first, last, first_face, last_face = self.mesh_at
        parts = np.split(corner[:, first:last], (3, 6))
        vertex, normal, uv = (np.ascontiguousarray(part.T) for part in parts)
        return Mesh(vertex, normal, uv, face[first_face:last_face])

    def solids(self) -> tuple[Solid, ...]:
        return self.solid

    def picture(self) -> Rgb:
        plain = self.name.removesuffix(RED)
        if self.wall_px:
            return speckled(self.texture, _image(f"{plain}.png"), self.wall_px)
        if plain == self.name:
            return _image(f"{plain}.webp")
        before, after = np.load(io.BytesIO(_read(f"{self.name}.npy")))
        picture = after[np.searchsorted(before @ KEY, _image(f"{plain}.webp") @ KEY)]
        rest = f"{self.name}.webp"
        return picture + _image(rest) if rest in _archive().NameToInfo else picture


@cache
def _archive() -> ZipFile:
    """In memory: its directory is read once, and forked processes share no place in a file."""
    return ZipFile(io.BytesIO(FORMS.read_bytes()))


def _read(name: str) -> bytes:
    return _archive().read(name)


@cache
def _meshes(stem: str) -> tuple[np.ndarray, np.ndarray]:
    """Of all meshes of a stem the columns x, y, z, normal and u, v, and the faces."""
    corner, steps = (
        np.load(io.BytesIO(lzma.decompress(_read(f"{stem}.{part}.xz"))))
        for part in ("corner", "face")
    )
    return corner, np.cumsum(steps, dtype=np.int64).reshape(-1, 3)


def _image(name: str) -> np.ndarray:
    with Image.open(io.BytesIO(_read(name)), formats=["WEBP", "PNG"]) as picture:
        return np.asarray(picture)


def speckled(texture: Texture, spots: np.ndarray, height: int) -> Rgb:
    """A picture with soft spots of ink on the wall, which is drawn `height` pixels high."""
    size = (2 * ATLAS_PX, height)
    mask = Image.fromarray((255 * spots).astype(np.uint8)).resize(size, Image.Resampling.BICUBIC)
    base, ink = (Image.new("RGB", size, colour) for colour in (texture.base, texture.ink))
    return atlas(texture, Image.composite(ink, base, mask))


def atlas(texture: Texture, wall: Image.Image) -> Rgb:
    """A filled wall with its layout drawn over it, shrunk, above the swatches of plain parts."""
    draw = ImageDraw.Draw(wall)
    width, height = wall.size
    if texture.layout == "half":
        draw.rectangle((0, 0, width, 0.45 * height), fill=texture.accent)
    elif texture.layout == "middle":
        draw.rectangle((0, 0, width, 0.2 * height), fill=texture.base)
        draw.rectangle((0, 0.8 * height, width, height), fill=texture.accent)
    picture = Image.new("RGB", (ATLAS_PX, ATLAS_PX))
    picture.paste(wall.resize((ATLAS_PX, WALL_PX), Image.Resampling.BOX))
    draw = ImageDraw.Draw(picture)
    for i, colour in enumerate((texture.base, texture.accent, texture.ink, *FIXED_COLOURS)):
        left = i * ATLAS_PX // 8
        draw.rectangle((left, WALL_PX, left + ATLAS_PX // 8 - 1, ATLAS_PX), fill=colour)
    return np.asarray(picture)


FIXED_COLOURS: tuple[Srgb, ...] = (
    (44, 43, 47),
    (240, 236, 226),
    (158, 160, 164),
    (206, 150, 66),
    (66, 82, 98),
)
"""Swatches for caps, eyes, metal and other plain parts, after a texture's own colours."""


def _catalogue() -> dict[str, ObjectModel]:
    models = {}
    for line in ROWS.read_text().splitlines():
        row = json.loads(line)
        paint = row["texture"]
        colours = {part: tuple(paint[part]) for part in ("base", "ink", "accent")}
        texture = Texture(**{**paint, **colours})
        solids = []
        for kind, size, pos, *turned in row["solids"]:
            axis: Any
            axis, euler = turned or ("z", (0, 0, 0))
            solids.append(Solid(kind, tuple(size), tuple(pos), axis, tuple(euler)))
        mesh_at = (*row["mesh"],)
        form = Baked(
            row["name"], texture, tuple(solids), row["stem"], mesh_at, row.get("wall_px", 0)
        )
        about = {part: row[part] for part in ("name", "category", "split", "shape", "mass_kg")}
        models[row["name"]] = ObjectModel(**about, texture=texture, form=form)
    return models


BAKED: dict[str, ObjectModel] = _catalogue()
"""Every object that ships but the red ones."""
OBJECTS: dict[str, ObjectModel] = {
    name: model for name, model in BAKED.items() if model.split != "generic"
}
"""Personal objects, look-alikes and props."""
CATEGORIES: tuple[str, ...] = tuple(
    dict.fromkeys(model.category for model in OBJECTS.values() if model.split == "personal")
)
"""Categories with evaluation instances."""
type Maker = Callable[[str], ObjectModel | None]
MAKERS: list[Maker] = []
"""Where `get_object` looks for a name that is not baked. `vap_make.objects` adds its generator."""


def personal_instance(kind: str) -> ObjectModel:
    """The user's own instance of a kind. Raises: UnknownName."""
    model = OBJECTS.get(f"{kind.replace(' ', '-')}-personal")
    if model is None:
        raise one_of("objects: category", kind, CATEGORIES)
    return model


def lookalikes(kind: str) -> tuple[ObjectModel, ...]:
    """The look-alikes of the personal instance, hardest first."""
    prefix = personal_instance(kind).name.removesuffix("personal") + "lookalike-"
    return tuple(model for name, model in OBJECTS.items() if name.startswith(prefix))


def tier(lookalike: ObjectModel) -> Tier:
    """How close a look-alike's colours are to its personal instance's.

    hard: base and ink are both shared; medium: one of them; easy: neither, and other libraries'.
    """
    if lookalike.split == "foreign":
        return "easy"
    stem, _, _ = lookalike.name.partition("-lookalike-")
    ours, personal = lookalike.texture, OBJECTS[f"{stem}-personal"].texture
    assert isinstance(ours, Texture)
    assert isinstance(personal, Texture)
    return ("easy", "medium", "hard")[len({ours.base, ours.ink} & {personal.base, personal.ink})]


@lru_cache(maxsize=512)
def _red(name: str) -> ObjectModel | None:
    """The baked object with this name, red where its base colour is."""
    model = BAKED.get(name.removesuffix(RED))
    if model is None or not isinstance(model.form, Baked):
        return None
    if not model.form.wall_px and f"{name}.npy" not in _archive().NameToInfo:
        return None
    texture = replace(model.form.texture, base=RED_PAINT)
    form = replace(model.form, name=name, texture=texture)
    return replace(model, name=name, texture=texture, form=form)


def get_object(name: str) -> ObjectModel:
    """The object of that name: one that ships, one that MAKERS know, or a scan of the user's own.

    Raises:
        UnknownName: there is no such object, or VAP_OBJECTS names no folder.
        BadObject: it is a scan that is damaged.
    """
    if name in BAKED:
        return BAKED[name]
    finders: list[Maker] = [_red, *MAKERS]
    for find in finders:
        model = find(name)
        if model is not None:
            return model
    scanned = scan_folders()
    if name in scanned:
        return load_scanned_object(scanned[name])
    raise UnknownName(
        f"{one_of('objects: object', name, [*OBJECTS, *scanned])} Generic ones of any number exist "
        "after `import vap_make.objects`. One that was registered has photos alone: bring its scan "
        "by objects import, or point VAP_OBJECTS at its folder."
    )


def load_scanned_object(folder: Path) -> ObjectModel:
    """The scan in that folder. Raises: BadObject when it is damaged."""
    about, scan = load_scan(folder)
    return ObjectModel(
        about.name, about.category, "personal", scan, scan.image, about.mass_kg, form=scan
    )


@lru_cache(maxsize=256)
def mesh_of(model: ObjectModel) -> Mesh:
    """The visual mesh, metres, standing on z = 0."""
    return model.form.mesh()


@lru_cache(maxsize=256)
def texture_image(model: ObjectModel) -> Rgb:
    """The picture that the mesh's texture coordinates point into."""
    return model.form.picture()


def extent_m(model: ObjectModel) -> tuple[float, float, float]:
    """Full x, y, z extents of the visual mesh, metres."""
    x, y, z = np.ptp(mesh_of(model).vertex, axis=0)
    return float(x), float(y), float(z)


def object_table() -> str:
    """Every object by name, the user's own last.

    Columns: name, category, split, tier of a look-alike, size (cm), faces, mass (g).
    """
    lines = [
        f"{'name':28} {'category':14} {'split':10} {'tier':7} {'size, cm':>18} {'faces':>6} "
        f"{'mass, g':>8}"
    ]
    for model in (*OBJECTS.values(), *map(get_object, scan_folders())):
        grade = tier(model) if model.split == "lookalike" else "-"
        size = " x ".join(f"{100 * side:.1f}" for side in extent_m(model))
        lines.append(
            f"{model.name:28} {model.category:14} {model.split:10} {grade:7} {size:>18} "
            f"{len(mesh_of(model).face):6} {1000 * model.mass_kg:8.0f}"
        )
    return "\n".join(lines)
