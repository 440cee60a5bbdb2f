"""A GLB file made plain for trimesh: colours in sRGB, one set of texture coordinates, no extension.

glTF says factors and vertex colours in linear light, and multiplies both with the texture, which is
in sRGB. trimesh hands on the numbers as they are, opens every picture itself, and ignores what else
a file may say.
"""

import json
import re
import struct
from base64 import b64decode
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vap_core.base.errors import BadObject, BadPhoto
from vap_core.base.files import parse_json
from vap_core.base.media import BEHIND, decode_picture, to_linear, to_srgb
from vap_core.base.types import Rgb

TRANSFORM = "KHR_texture_transform"
STRENGTH = "KHR_materials_emissive_strength"
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
HARMLESS = re.compile(r"KHR_(materials_\w+|lights_\w+|xmp\w*|animation_pointer)")
"""Extensions that change neither the form nor the base colour."""
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
UBYTE, FLOAT = 5121, 5126
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
TRIANGLES, STRIP, FAN = 4, 5, 6
REPEAT = 10497
CLAMPED = (
    "clamps or mirrors a texture beyond its edge, which is not read here; unwrap the mesh within "
    "0..1"
)


def multiply(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Two colours in sRGB, 0 to 255, multiplied as light; the result is rounded."""
    product = to_linear(np.asarray(one) / 255) * to_linear(np.asarray(other) / 255)
    return np.asarray(np.round(255 * to_srgb(product)))


def shares(values: Any, path: Path, what: str) -> np.ndarray:
    """Numbers of a colour. Raises: BadObject for one outside 0..1."""
    found = np.atleast_1d(np.asarray(values, np.float64))
    if not ((found >= 0) & (found <= 1)).all():
        raise BadObject(
            f"objects: {path} has {what} outside 0..1; export it again with colours as shares."
        )
    return found


def outside(uv: np.ndarray) -> np.ndarray:
    """Which texture coordinates lie beyond the picture's edge, by more than a hundredth."""
    return (uv < -0.01) | (uv > 1.01)


def as_bitmap(rgb: Rgb) -> bytes:
    """A picture for trimesh, which reads one of 2 x 2 pixels as one that is missing."""
    if max(rgb.shape[:2]) <= 2:
        rgb = rgb.repeat(4, 0).repeat(4, 1)
    whole = BytesIO()
    Image.fromarray(rgb).save(whole, "BMP")
    return whole.getvalue()


def plain_glb(path: Path, find: Callable[[str], bytes]) -> bytes:
    """The file with its colours in sRGB: of every part a factor, or an opaque picture.

    `find` gives the bytes of a file beside it.

    Raises:
        BadObject: it says something that is not read here; the message names it.
    """
    data = path.read_bytes()
    magic, _, _, length, kind = struct.unpack_from("<4s4I", data)
    if magic != b"glTF" or kind != JSON_CHUNK:
        raise BadObject(f"objects: {path} is no binary glTF 2 file; export it again as GLB.")
    scene = parse_json(data[20 : 20 + length])
    _refuse_unread(path, scene)
    plain = {"bufferViews": [], **scene, "materials": [], "textures": [], "images": []}
    glb = _Glb(path, find, plain, bytearray(data[28 + length :]), scene)
    known: dict[str, int] = {}
    for mesh in scene.get("meshes", []):
        for part in mesh["primitives"]:
            if part.get("mode", TRIANGLES) not in (TRIANGLES, STRIP):
                continue
            attributes = part["attributes"]
            if "COLOR_0" in attributes:
                colours = shares(glb.read(attributes["COLOR_0"]), path, "vertex colours")
                rgba = np.ones((len(colours), 4))
                rgba[:, : colours.shape[1]] = colours
                rgba[:, :3] = to_srgb(rgba[:, :3])
                rows = np.round(255 * rgba).astype(np.uint8)
                attributes["COLOR_0"] = glb.append(rows, UBYTE, normalized=True)
            material = scene["materials"][part["material"]] if "material" in part else {}
            glb.place_texture(attributes, material)
            about = json.dumps({**material, "name": "", "doubleSided": False}, sort_keys=True)
            if about not in known:
                known[about] = len(plain["materials"])
                plain["materials"].append(glb.plain_material(material))
            part["material"] = known[about]
    glb.add(b"")
    if plain.get("buffers"):
        plain["buffers"][0]["byteLength"] = len(glb.blob)
    text = json.dumps(plain).encode()
    text += b" " * (-len(text) % 4)
    whole = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(glb.blob))
    for chunk, kind in ((text, JSON_CHUNK), (glb.blob, BINARY_CHUNK)):
        whole += struct.pack("<II", len(chunk), kind) + chunk
    return whole


def _refuse_unread(path: Path, scene: dict[str, Any]) -> None:
    """Raises: BadObject for what changes the form or the base colour, and is not read here."""
    declared = [scene.get(f"extensions{part}", []) for part in ("Used", "Required")]
    named = set(chain(*declared, _extensions(scene))) - {TRANSFORM}
    unread = sorted(name for name in named if name == GLOSSY or not HARMLESS.fullmatch(name))
    meshes, nodes = scene.get("meshes", []), scene.get("nodes", [])
    placed = [(node, meshes[node["mesh"]]) for node in nodes if "mesh" in node]
    weights = [each.get("weights") or () for pair in placed for each in pair]
    modes = [part.get("mode") for mesh in meshes for part in mesh["primitives"]]
    flaws = {
        "sparse accessors": any("sparse" in each for each in scene.get("accessors", [])),
        "a skin (apply the armature)": any("skin" in node for node, _ in placed),
        "weights of morph targets (apply the shape keys)": any(map(any, weights)),
        "triangle fans": FAN in modes,
    }
    unread += [flaw for flaw, there in flaws.items() if there]
    if unread:
        raise BadObject(
            f"objects: {path} uses {', '.join(unread)}, which is not read here; export it again "
            "without (for example without compression, with PNG or JPEG textures)."
        )


def _extensions(part: Any) -> Iterator[str]:
    """The extensions that a part of a file has, declared or not."""
    if isinstance(part, dict):
        yield from part.get("extensions", {})
    for inner in part.values() if isinstance(part, dict) else part:
        if isinstance(inner, dict | list):
            yield from _extensions(inner)


@dataclass
class _Glb:
    """A file on its way to a plain one: `scene` and its numbers; `given` is what it said."""

    path: Path
    find: Callable[[str], bytes]
    scene: dict[str, Any]
    blob: bytearray
    given: dict[str, Any]

    def add(self, data: bytes) -> int:
        """The number of a new view of these bytes, on a place that four divides."""
        self.blob += bytes(-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.scene["bufferViews"].append(view)
        self.blob += data
        return len(self.scene["bufferViews"]) - 1

    def append(self, rows: np.ndarray, component: int, **more: bool) -> int:
        """The number of a new accessor with these rows."""
        (kind,) = (name for name, width in WIDTHS.items() if width == rows.shape[1])
        about = {"componentType": component, "count": len(rows), "type": kind, **more}
        self.scene["accessors"].append({"bufferView": self.add(rows.tobytes()), **about})
        return len(self.scene["accessors"]) - 1

    def read(self, number: int) -> np.ndarray:
        """The numbers of an accessor, a row each; integers as shares of their largest."""
        accessor = self.scene["accessors"][number]
        if "bufferView" not in accessor:
            raise BadObject(
                f"objects: {self.path} has an accessor without numbers; export it again."
            )
        view = self.scene["bufferViews"][accessor["bufferView"]]
        if view.get("buffer") or "uri" in self.scene["buffers"][0]:
            raise BadObject(
                f"objects: {self.path} keeps its numbers in another file; export it as one GLB."
            )
        dtype, width = np.dtype(TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
        stride = view.get("byteStride", dtype.itemsize * width)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        shape, strides = (accessor["count"], width), (stride, dtype.itemsize)
        rows: np.ndarray = np.ndarray(shape, dtype, bytes(self.blob), start, strides)
        return rows.astype(np.float64) / (1 if dtype.kind == "f" else np.iinfo(dtype).max)

    def plain_material(self, material: dict[str, Any]) -> dict[str, Any]:
        """A material of one factor or one opaque picture in sRGB.

        What it gives off is added to its base colour. Grey stands behind what is transparent, as in
        photos, unless the material says that it is opaque.
        """
        surface = material.get("pbrMetallicRoughness", {})
        factor = shares(surface.get("baseColorFactor", [1.0] * 4), self.path, "a colour's factor")
        glow = np.array(material.get("emissiveFactor", [0.0] * 3), np.float32)
        glow *= material.get("extensions", {}).get(STRENGTH, {}).get("emissiveStrength", 1.0)
        textures = surface.get("baseColorTexture"), material.get("emissiveTexture")
        found = [self.picture(each) for each in textures[: 1 + glow.any()]]
        sizes = [each.shape[1::-1] for each in found if each is not None] or [(1, 1)]
        white = np.full((1, 1, 4), 255, np.uint8)
        pictures = [Image.fromarray(white if each is None else each) for each in found]
        rgba, *shining = (np.array(picture.resize(sizes[0])) for picture in pictures)
        rgb, seen = rgba[..., :3], rgba[..., 3] / 255 * factor[3]
        if shining or (factor[:3] != 1).any():
            light = to_linear(np.arange(256) / 255).astype(np.float32)
            total = light[rgb] * factor[:3].astype(np.float32)
            total += sum(light[each[..., :3]] * glow for each in shining)
            rgb = np.round(255 * to_srgb(total)).astype(np.uint8)
        mode = material.get("alphaMode", "OPAQUE")
        if mode == "MASK":
            seen = 1.0 * (seen >= material.get("alphaCutoff", 0.5) - 1e-6)
        if mode != "OPAQUE" and (seen < 1).any():
            opacity = Image.fromarray(np.round(255 * seen).astype(np.uint8))
            grey = Image.new("RGB", sizes[0], (BEHIND,) * 3)
            rgb = np.array(Image.composite(Image.fromarray(rgb), grey, opacity))
        if all(each is None for each in found):
            return {"pbrMetallicRoughness": {"baseColorFactor": [*(rgb[0, 0] / 255).tolist(), 1.0]}}
        number = len(self.scene["images"])
        image = {"bufferView": self.add(as_bitmap(rgb)), "mimeType": "image/bmp"}
        self.scene["images"].append(image)
        self.scene["textures"].append({"source": number})
        return {"pbrMetallicRoughness": {"baseColorTexture": {"index": number}}}

    def picture(self, texture: dict[str, Any] | None) -> np.ndarray | None:
        """The pixels of a texture, h x w x 4; None where there is none. Raises: BadObject."""
        if texture is None:
            return None
        image = self.given["images"][self.given["textures"][texture["index"]]["source"]]
        uri = image.get("uri", "")
        if uri.startswith("data:"):
            data = b64decode(uri.partition(",")[2])
        elif uri:
            try:
                data = self.find(uri)
            except FileNotFoundError:  # `find` has taken note of it
                return None
        else:
            view = self.given["bufferViews"][image["bufferView"]]
            data = bytes(self.blob[view.get("byteOffset", 0) :][: view["byteLength"]])
        name = f"objects: {self.path}: a texture"
        try:
            return decode_picture(BytesIO(data), name, "RGBA", upright=False, convert=False)
        except BadPhoto as error:
            raise BadObject(str(error)) from error

    def place_texture(self, attributes: dict[str, int], material: dict[str, Any]) -> None:
        """Give a part its base colour's texture coordinates, moved and scaled, as the first."""
        textures = [material.get("pbrMetallicRoughness", {}).get("baseColorTexture")]
        if any(material.get("emissiveFactor", ())):
            textures.append(material.get("emissiveTexture"))
        used = [texture for texture in textures if texture is not None]
        if not used:
            return
        transform = used[0].get("extensions", {}).get(TRANSFORM, {})
        number = transform.get("texCoord", used[0].get("texCoord", 0))
        name = f"TEXCOORD_{number}"
        unread = "which is not read here; apply it in your 3-D tool"
        faults = {
            f"turns a texture by {TRANSFORM}, {unread}": transform.get("rotation"),
            f"places its emissive texture otherwise than its base colour, {unread}": (
                {**used[0], "index": 0} != {**used[-1], "index": 0}
            ),
            f"lacks the texture coordinates {name} that a material names; unwrap the mesh and "
            "export it again": name not in attributes,
        }
        for fault, there in faults.items():
            if there:
                raise BadObject(f"objects: {self.path} {fault}.")
        sampler = self.given["textures"][used[0]["index"]].get("sampler")
        wraps = {} if sampler is None else self.given["samplers"][sampler]
        repeats = np.array([wraps.get(axis, REPEAT) == REPEAT for axis in ("wrapS", "wrapT")])
        if transform or number or not repeats.all():
            uv = self.read(attributes[name])
            uv = uv * transform.get("scale", [1, 1]) + transform.get("offset", [0, 0])
            if (outside(uv) & ~repeats).any():
                raise BadObject(f"objects: {self.path} {CLAMPED}.")
            attributes["TEXCOORD_0"] = self.append(uv.astype("<f4"), FLOAT)
