"""A GLB file made plain for trimesh: colours in sRGB, one set of texture coordinates, no extension.

glTF says factors and vertex colours in linear light, and multiplies both with the texture, which is
in sRGB. trimesh hands on the numbers as they are, and ignores what else a file may say.
"""

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from vap_core.base.errors import BadObject
from vap_core.base.files import parse_json
from vap_core.base.media import to_linear, to_srgb

TRANSFORM = "KHR_texture_transform"
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
HARMLESS = re.compile(r"KHR_(materials_\w+|lights_\w+|xmp\w*|animation_pointer|node_visibility)")
"""Extensions that change neither the form nor the base colour."""
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
UBYTE, FLOAT = 5121, 5126


def multiply(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Two colours in sRGB, 0 to 255, multiplied as light; the result is rounded."""
    product = to_linear(np.asarray(one) / 255) * to_linear(np.asarray(other) / 255)
    return np.asarray(np.round(255 * to_srgb(product)))


def plain_glb(path: Path) -> bytes:
    """The file with its factors and vertex colours in sRGB, and texture coordinates transformed.

    Raises:
        BadObject: it says something that is not read here; the message names it.
    """
    data = path.read_bytes()
    magic, _, _, length, kind = struct.unpack_from("<4s4I", data)
    if magic != b"glTF" or kind != 0x4E4F534A:
        raise BadObject(f"objects: {path} is no binary glTF 2 file; export it again as GLB.")
    scene = parse_json(data[20 : 20 + length])
    blob = bytearray(data[28 + length :])
    _refuse_extensions(path, scene)
    materials = scene.get("materials", [])
    for material in materials:
        surface = material.setdefault("pbrMetallicRoughness", {})
        *rgb, alpha = surface.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
        surface["baseColorFactor"] = [*to_srgb(np.array(rgb, float)).tolist(), alpha]
    for mesh in scene.get("meshes", []):
        for part in mesh["primitives"]:
            attributes = part["attributes"]
            if "COLOR_0" in attributes:
                colours = _read(path, scene, blob, attributes["COLOR_0"])
                rgba = np.ones((len(colours), 4))
                rgba[:, : colours.shape[1]] = colours
                rgba[:, :3] = to_srgb(rgba[:, :3])
                rows = np.round(255 * rgba).astype(np.uint8)
                attributes["COLOR_0"] = _append(scene, blob, rows, UBYTE, normalized=True)
            if "material" in part:
                _place_texture(path, scene, blob, attributes, materials[part["material"]])
    blob += bytes(-len(blob) % 4)
    if scene.get("buffers"):
        scene["buffers"][0]["byteLength"] = len(blob)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    whole = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(blob))
    whole += struct.pack("<II", len(text), 0x4E4F534A) + text
    return whole + struct.pack("<II", len(blob), 0x004E4942) + bytes(blob)


def _refuse_extensions(path: Path, scene: dict[str, Any]) -> None:
    """Raises: BadObject for one that changes the form or the base colour."""
    named = {*scene.get("extensionsUsed", []), *scene.get("extensionsRequired", [])} - {TRANSFORM}
    unread = sorted(name for name in named if name == GLOSSY or not HARMLESS.fullmatch(name))
    if unread:
        raise BadObject(
            f"objects: {path} uses {', '.join(unread)}, which is not read here; export it again "
            "without (for example without compression, with PNG or JPEG textures)."
        )


def _place_texture(
    path: Path, scene: dict[str, Any], blob: bytearray, attributes: dict[str, int], material: Any
) -> None:
    """Give a part the texture coordinates of its base colour, moved and scaled, as the first."""
    texture = material["pbrMetallicRoughness"].get("baseColorTexture")
    if texture is None:
        return
    transform = texture.get("extensions", {}).get(TRANSFORM, {})
    number = transform.get("texCoord", texture.get("texCoord", 0))
    name = f"TEXCOORD_{number}"
    if transform.get("rotation"):
        raise BadObject(
            f"objects: {path} turns a texture by {TRANSFORM}, which is not read here; apply it in "
            "your 3-D tool."
        )
    if name not in attributes:
        raise BadObject(
            f"objects: {path} lacks the texture coordinates {name} that a material names; unwrap "
            "the mesh and export it again."
        )
    if transform or number:
        uv = _read(path, scene, blob, attributes[name])
        uv = uv * transform.get("scale", [1, 1]) + transform.get("offset", [0, 0])
        attributes["TEXCOORD_0"] = _append(scene, blob, uv.astype("<f4"), FLOAT)


def _read(path: Path, scene: dict[str, Any], blob: bytearray, number: int) -> np.ndarray:
    """The numbers of an accessor, a row each; integers as shares of their largest."""
    accessor = scene["accessors"][number]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise BadObject(f"objects: {path} has sparse accessors; export it again without.")
    view = scene["bufferViews"][accessor["bufferView"]]
    if view.get("buffer") or "uri" in scene["buffers"][0]:
        raise BadObject(f"objects: {path} keeps its numbers in another file; export it as one GLB.")
    dtype, width = np.dtype(TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
    stride = view.get("byteStride", dtype.itemsize * width)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    rows: np.ndarray = np.ndarray(
        (accessor["count"], width), dtype, bytes(blob), start, (stride, dtype.itemsize)
    )
    found = rows.astype(np.float64)
    return found if dtype.kind == "f" else found / np.iinfo(dtype).max


def _append(
    scene: dict[str, Any], blob: bytearray, rows: np.ndarray, component: int, **more: bool
) -> int:
    """Add an accessor with these rows; its number."""
    blob += bytes(-len(blob) % 4)
    view = {"buffer": 0, "byteOffset": len(blob), "byteLength": rows.nbytes}
    blob += rows.tobytes()
    scene["bufferViews"].append(view)
    kinds = {width: name for name, width in WIDTHS.items()}
    scene["accessors"].append(
        {
            "bufferView": len(scene["bufferViews"]) - 1,
            "componentType": component,
            "count": len(rows),
            "type": kinds[rows.shape[1]],
            **more,
        }
    )
    return len(scene["accessors"]) - 1
