"""Bake the objects that ship: `python -m vap_make.objects`; two minutes.

They are the catalogue's, and all that the rows of suites place.
"""

import io
import json
import lzma
from dataclasses import asdict
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np
from PIL import Image

from vap_core.base.files import write_atomic
from vap_core.base.types import Rgb
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import FORMS, KEY, RED, ROWS, ObjectModel
from vap_core.simulation.assets.shapes import Mesh
from vap_core.simulation.suites.open_row import models_of
from vap_make.objects import FIXED, Drawn, draw
from vap_make.objects.textures import draw_spots, wall_px

SMALL = {"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 3, "pb": 3}
"""Columns of doubles are a fifth smaller so."""


def placed() -> list[str]:
    """The catalogue's names, then the others that rows place: red ones last."""
    listed = [f"{name}{dev}" for name in suites.BENCHMARKS for dev in ("", "-dev")]
    listed += [f"{name}{RED}" for name in listed]
    names: set[str] = set()
    for name in (*listed, *suites.SHARED, *suites.WARM_UPS):
        for task in suites.suite(name).tasks:
            names.update(models_of(suites.rows(name, task.name)))
    others = sorted(names - set(FIXED), key=lambda name: (name.endswith(RED), name))
    return [*FIXED, *others]


class Bake:
    """The rows of `objects.jsonl`, and the contents of `forms.zip` by name."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.files: dict[str, bytes] = {}
        self.meshes: dict[str, list[Mesh]] = {}
        self.pictures: dict[str, Rgb] = {}

    def add(self, model: ObjectModel) -> None:
        """Equal meshes of a stem are held once; a red picture as its change of colours."""
        form = model.form
        assert isinstance(form, Drawn)
        name, texture, wall = model.name, form.texture, 0
        plain = name.removesuffix(RED)
        if texture.motif == "speckle":
            wall = wall_px(form.body.aspect())
            if plain == name:
                self.files[f"{name}.png"] = _image(draw_spots(texture, 1024, wall), "PNG")
        else:
            self.pictures[name] = picture = form.picture()
            if plain != name:
                colours, picture = _changed_colours(self.pictures[plain], picture)
                self.files[f"{name}.npy"] = _array(colours)
            if plain == name or picture.any():
                how = {"lossless": True, "exact": True, "quality": 100, "method": 6}
                self.files[f"{name}.webp"] = _image(picture, "WEBP", **how)
        if plain == name:
            self._add_row(model, form, wall)

    def _add_row(self, model: ObjectModel, form: Drawn, wall: int) -> None:
        stem = model.name
        for part in ("-personal", "-lookalike-", "-prop", "-generic-"):
            stem = stem.partition(part)[0]
        mesh, held = form.mesh(), self.meshes.setdefault(stem, [])
        at = next((i for i, other in enumerate(held) if _equal(other, mesh)), len(held))
        if at == len(held):
            held.append(mesh)
        first, face = (sum(map(len, part)) for part in _parts(held[:at]))
        solids = []
        for s in form.solids():
            turned = (s.axis, s.euler) if s.axis != "z" or any(s.euler) else ()
            solids.append((s.kind, s.size, s.pos, *turned))
        row = {
            "name": model.name,
            "category": model.category,
            "split": model.split,
            "mass_kg": model.mass_kg,
            "stem": stem,
            "mesh": (first, first + len(mesh.vertex), face, face + len(mesh.face)),
            "shape": model.shape,
            "texture": asdict(form.texture),
            "solids": solids,
        }
        self.rows.append({**row, "wall_px": wall} if wall else row)

    def lines(self) -> bytes:
        short = json.JSONEncoder(separators=(",", ":"), default=lambda number: number.tolist())
        return "".join(f"{short.encode(row)}\n" for row in self.rows).encode()

    def archive(self) -> bytes:
        """The same bytes for the same contents."""
        files = dict(self.files)
        for stem, held in self.meshes.items():
            corners = [np.concatenate([m.vertex, m.normal, m.uv], axis=1) for m in held]
            faces = np.concatenate([mesh.face.ravel() for mesh in held])
            steps = np.diff(faces, prepend=0).astype(np.int16)
            for part, array in (("corner", np.concatenate(corners).T), ("face", steps)):
                data = _array(np.ascontiguousarray(array))
                files[f"{stem}.{part}.xz"] = lzma.compress(data, filters=[SMALL])
        written = io.BytesIO()
        with ZipFile(written, "w") as archive:
            for name in sorted(files):
                archive.writestr(ZipInfo(name), files[name])
        return written.getvalue()


def _parts(held: list[Mesh]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [mesh.vertex for mesh in held], [mesh.face for mesh in held]


def _equal(one: Mesh, other: Mesh) -> bool:
    names = ("vertex", "normal", "uv", "face")
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    return all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


def _changed_colours(before: Rgb, after: Rgb) -> tuple[np.ndarray, Rgb]:
    """The colours of one picture, sorted, with what each is in the other, and the rest that adds.

    It is modulo 256, and nothing but zeros where every colour becomes one other.
    """
    pixels, becomes = before.reshape(-1, 3), after.reshape(-1, 3)
    _, first, at, n = np.unique(
        pixels @ KEY, return_index=True, return_inverse=True, return_counts=True
    )
    mean = np.stack([np.bincount(at, channel) / n for channel in becomes.T], axis=1)
    new = np.rint(mean).astype(np.uint8)
    return np.stack([pixels[first], new]), (becomes - new[at]).reshape(before.shape)


def _image(pixels: np.ndarray, kind: str, **how: Any) -> bytes:
    written = io.BytesIO()
    Image.fromarray(pixels).save(written, kind, **how)
    return written.getvalue()


def _array(array: np.ndarray) -> bytes:
    written = io.BytesIO()
    np.save(written, array, allow_pickle=False)
    return written.getvalue()


def main() -> None:
    bake = Bake()
    for name in placed():
        model = draw(name)
        assert model is not None, name
        bake.add(model)
    ROWS.parent.mkdir(exist_ok=True)
    write_atomic(ROWS, bake.lines())
    write_atomic(FORMS, bake.archive())
    print(f"{len(bake.rows)} rows; {ROWS.stat().st_size + FORMS.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
