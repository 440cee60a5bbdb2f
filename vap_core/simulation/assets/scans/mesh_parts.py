"""The files that hold meshes: what may be opened, and the triangles that are in them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from vap_core.base.errors import BadObject
from vap_core.base.media import MAX_PIXELS, PICTURE_FORMATS

if TYPE_CHECKING:
    import trimesh
    from trimesh.resolvers import FilePathResolver

SUFFIXES = (".glb", ".obj", ".ply", ".stl")
MAX_MB, MAX_FACES = 200, 500_000


def check_file(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise BadObject(
            f"objects: {path} is no GLB, OBJ, PLY or STL file; export it as one of them."
        )
    if not path.exists():
        raise BadObject(f"objects: {path} is not there; check the path, or export it again.")
    if not path.is_file():
        raise BadObject(f"objects: {path} is no regular file; check the path.")
    if not path.stat().st_size:
        raise BadObject(f"objects: {path} is empty; check the path, or export it again.")
    if path.stat().st_size > MAX_MB * 1e6:
        raise BadObject(
            f"objects: {path} has {path.stat().st_size / 1e6:.0f} MB, over {MAX_MB}; decimate it "
            "or shrink its texture."
        )


def load_parts(path: Path) -> "list[trimesh.Trimesh]":
    """The file's meshes that have triangles, in one frame.

    Raises: BadObject: there is none, there are too many, or they are inconsistent.
    """
    import trimesh

    with _checked_pictures() as refused:
        scene = trimesh.load_scene(path, resolver=_beside(path))
    if refused:
        raise BadObject(f"objects: {path} has a texture that {refused[0]}.")
    meshes = {}
    for name, geometry in scene.geometry.items():
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            _check_part(geometry, path)
            meshes[name] = geometry
    count = 0
    for node in scene.graph.nodes_geometry:  # a mesh may be placed many times
        mesh = meshes.get(scene.graph[node][1])
        if mesh is not None:
            count += len(mesh.faces)
    if not count:
        raise BadObject(f"objects: {path} holds no triangles; export the object as a mesh.")
    if count > MAX_FACES:
        raise BadObject(
            f"objects: {path} has {count:,} faces, over {MAX_FACES:,}; decimate it first, a "
            "hundred thousand are plenty."
        )
    parts = []
    for geometry in scene.dump():
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            parts.append(geometry)
    return parts


def _check_part(part: "trimesh.Trimesh", path: Path) -> None:
    """Raises: BadObject when its faces, its texture coordinates and its vertices do not fit."""
    faces, count = np.asarray(part.faces), len(part.vertices)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= count:
        raise BadObject(
            f"objects: {path} has faces that name vertices that are not there; export it again."
        )
    visual: Any = part.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and (np.shape(uv) != (count, 2) or not np.isfinite(uv).all()):
        raise BadObject(
            f"objects: {path} has texture coordinates that do not fit its vertices; unwrap the "
            "mesh and export it again."
        )


def _beside(path: Path) -> "FilePathResolver":
    """Opens what the mesh refers to: regular files in its folder and below, of MAX_MB at most."""
    from trimesh.resolvers import FilePathResolver

    class Bounded(FilePathResolver):
        def get(self, name: str) -> bytes:
            for candidate in (name.strip(), Path(name.strip()).name):
                with suppress(ValueError):  # outside the folder
                    found = self.absolute(candidate)
                    if found.is_file() and found.stat().st_size <= MAX_MB * 1e6:
                        return found.read_bytes()
            raise FileNotFoundError(name)

    return Bounded(str(path))


@contextmanager
def _checked_pictures() -> Iterator[list[str]]:
    """Inside the block Pillow opens PICTURE_FORMATS up to MAX_PIXELS alone, whoever calls it.

    The readers of meshes open textures themselves, and go on without those that fail. The list
    says what was wrong with each.
    """
    unchecked = Image.open
    refused = []

    def checked(file: Any, *_: Any, **__: Any) -> Image.Image:
        try:
            image = unchecked(file, formats=PICTURE_FORMATS)
        except UnidentifiedImageError:
            refused.append(f"is none of {', '.join(PICTURE_FORMATS)}; save it as JPEG or PNG")
            raise
        except (Image.DecompressionBombError, Image.DecompressionBombWarning):
            refused.append(f"has over {MAX_PIXELS / 1e6:.0f} million pixels; shrink it")
            raise
        if image.width * image.height > MAX_PIXELS:
            refused.append(
                f"has {image.width}x{image.height} pixels, over {MAX_PIXELS / 1e6:.0f} million; "
                "shrink it"
            )
            raise Image.DecompressionBombError(refused[-1])
        return image

    Image.open = checked  # type: ignore[assignment]
    try:
        yield refused
    finally:
        Image.open = unchecked
