"""The colours of 3-D files: every source that a format has, as the format says it."""

import base64
import json
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.command import refused
from tests.test_media import SPACES, icc
from vap_core.base.errors import BadObject
from vap_core.simulation.assets.scans.mesh_file import read_mesh_file

QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
"""Of a picture: red and green above, blue and yellow below."""
Scene = dict[str, Any]


def body(uv: tuple[float, float] = (0.25, 0.25)) -> trimesh.Trimesh:
    """A ball of 10 cm whose texture coordinates are all in the middle of one quarter."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    picture = Image.fromarray(QUARTERS.repeat(8, 0).repeat(8, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    spots = np.tile(np.array(uv), (len(mesh.vertices), 1))
    mesh.visual = trimesh.visual.TextureVisuals(uv=spots, material=material)
    return mesh


def plain() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 255, 255, 255])
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(mesh.vertices), 2)), material=material
    )
    return mesh


def glb(path: Path, mesh: trimesh.Trimesh, change: Callable[[Scene], object]) -> Path:
    """The mesh as a GLB file whose header was changed."""
    data = mesh.export(file_type="glb")
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    change(scene)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    path.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)
    return path


def surface(scene: Scene) -> dict[str, Any]:
    found: dict[str, Any] = scene["materials"][0].setdefault("pbrMetallicRoughness", {})
    return found


def factor(*rgba: float) -> Callable[[Scene], object]:
    return lambda scene: surface(scene).update(baseColorFactor=rgba)


def colours(path: Path) -> np.ndarray:
    """Sorted; one number a colour, since `np.unique` of rows takes a hundred times as long."""
    whole = np.unique(np.asarray(read_mesh_file(path).rgb, np.int64) @ [1 << 16, 1 << 8, 1])
    return np.stack([whole >> 16, whole >> 8 & 255, whole & 255], axis=1)


@pytest.mark.parametrize("level", [10, 55, 128, 200, 255])
def test_a_factor_of_gltf_is_light(tmp_path: Path, level: int) -> None:
    """Grey 128 became 55, nearly black."""
    light = ((level / 255 + 0.055) / 1.055) ** 2.4 if level > 10 else level / 255 / 12.92
    path = glb(tmp_path / "a.glb", plain(), factor(light, light, light, 1))
    assert np.abs(colours(path).astype(int) - level).max() <= 1


def test_a_material_without_a_factor_is_white(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", plain(), lambda s: surface(s).pop("baseColorFactor", None))
    assert colours(path).tolist() == [[255, 255, 255]]
    path = glb(tmp_path / "b.glb", plain(), lambda s: s["materials"][0].clear())
    assert colours(path).tolist() == [[255, 255, 255]]


def test_a_factor_and_a_texture_are_multiplied_as_light(tmp_path: Path) -> None:
    """The quarter is yellow; half its light in red is 188 of 255."""
    path = glb(tmp_path / "a.glb", body((0.75, 0.25)), factor(0.5, 1, 1, 1))
    assert colours(path).tolist() == [[188, 255, 0]]


@pytest.mark.parametrize("textured", [False, True])
def test_vertex_colours_of_gltf_are_light_and_multiplied(tmp_path: Path, textured: bool) -> None:
    light = np.array([0.5, 0.21586, 1.0, 1.0], "<f4")
    mesh = body((0.75, 0.25)) if textured else plain()
    count = len(mesh.vertices)

    def paint(scene: Scene) -> None:
        view = {
            "buffer": 0,
            "byteOffset": scene["buffers"][0]["byteLength"],
            "byteLength": 16 * count,
        }
        scene["bufferViews"].append(view)
        scene["accessors"].append(
            {"bufferView": len(scene["bufferViews"]) - 1, "componentType": 5126,
             "count": count, "type": "VEC4"}
        )  # fmt: skip
        attributes = scene["meshes"][0]["primitives"][0]["attributes"]
        attributes["COLOR_0"] = len(scene["accessors"]) - 1
        scene["buffers"][0]["byteLength"] += 16 * count

    path = glb(tmp_path / "a.glb", mesh, paint)
    path.write_bytes(path.read_bytes() + light.tobytes() * count)
    expected = np.array([188, 128, 0 if textured else 255])
    assert np.abs(colours(path).astype(int) - expected).max() <= 1


def test_a_texture_transform_and_further_coordinates_are_read(tmp_path: Path) -> None:
    """Wrong quarters were shown, in silence. (u, v) is (.25, .75) in glTF: v runs down."""
    where = {"offset": [0.5, -0.5], "scale": [1, 1]}

    def move(scene: Scene) -> None:
        surface(scene)["baseColorTexture"]["extensions"] = {"KHR_texture_transform": where}
        scene["extensionsUsed"] = ["KHR_texture_transform"]

    assert colours(glb(tmp_path / "a.glb", body(), lambda s: None)).tolist() == [[0, 0, 255]]
    assert colours(glb(tmp_path / "b.glb", body(), move)).tolist() == [[0, 255, 0]]

    def second(scene: Scene) -> None:
        attributes = scene["meshes"][0]["primitives"][0]["attributes"]
        attributes["TEXCOORD_1"] = attributes.pop("TEXCOORD_0")
        surface(scene)["baseColorTexture"]["texCoord"] = 1

    assert colours(glb(tmp_path / "c.glb", body(), second)).tolist() == [[0, 0, 255]]


@pytest.mark.parametrize(("mode", "expected"), [("BLEND", 127), ("MASK", 127), ("OPAQUE", 0)])
def test_what_is_transparent_is_grey(tmp_path: Path, mode: str, expected: int) -> None:
    """It was baked as black."""
    mesh = body()
    clear = Image.new("RGBA", (8, 8), (0, 0, 0, 0))
    mesh.visual.material.baseColorTexture = clear
    path = glb(tmp_path / "a.glb", mesh, lambda s: s["materials"][0].update(alphaMode=mode))
    assert colours(path).tolist() == [[expected] * 3]


def draco(scene: Scene) -> None:
    scene["extensionsRequired"] = scene["extensionsUsed"] = ["KHR_draco_mesh_compression"]


def rotated(scene: Scene) -> None:
    turn = {"KHR_texture_transform": {"rotation": 0.5}}
    surface(scene)["baseColorTexture"]["extensions"] = turn


def undeclared(where: str, name: str) -> Callable[[Scene], object]:
    return lambda scene: scene[where][-1].update(extensions={name: {}})


def posed(**more: object) -> Callable[[Scene], object]:
    return lambda scene: [node.update(more) for node in scene["nodes"] if "mesh" in node]


def wrapped(mode: int) -> Callable[[Scene], object]:
    """A picture that is not repeated, moved by its whole width."""

    def change(scene: Scene) -> None:
        scene["samplers"] = [{"wrapS": mode}]
        scene["textures"][0]["sampler"] = 0
        where = {"KHR_texture_transform": {"offset": [1, 0]}}
        surface(scene)["baseColorTexture"]["extensions"] = where

    return change


def whole_png(kind: type = np.uint8) -> bytes:
    whole = BytesIO()
    Image.fromarray(np.full((8, 8), 90, kind)).save(whole, "PNG")
    return whole.getvalue()


def stored(data: bytes) -> Callable[[Scene], object]:
    """The texture as a picture inside the file's own text."""
    uri = "data:image/png;base64," + base64.b64encode(data).decode()
    return lambda scene: scene.update(images=[{"uri": uri}])


def glowing(scene: Scene) -> None:
    """All of the picture is given off, as of an object without light."""
    texture = surface(scene).pop("baseColorTexture", None)
    surface(scene).update(baseColorFactor=[0, 0, 0, 1])
    more = {"emissiveTexture": texture} if texture else {}
    scene["materials"][0].update(emissiveFactor=[1, 1, 1], **more)


def seen(alpha: float, mode: str, **more: float) -> Callable[[Scene], object]:
    def change(scene: Scene) -> None:
        surface(scene).update(baseColorFactor=[1, 0, 0, alpha])
        scene["materials"][0].update(alphaMode=mode, **more)

    return change


def without_material(scene: Scene) -> None:
    scene["meshes"][0]["primitives"][0].pop("material")


@pytest.mark.parametrize(
    ("mesh", "change", "expected"),
    [
        (plain, without_material, (255, 255, 255)),
        (plain, seen(0.3, "BLEND"), (165, 89, 89)),
        (plain, seen(0.3, "MASK"), (127, 127, 127)),
        (plain, seen(0.5, "MASK"), (255, 0, 0)),
        (plain, seen(0.8, "MASK", alphaCutoff=0.9), (127, 127, 127)),
        (plain, seen(0.3, "OPAQUE"), (255, 0, 0)),
        (body, glowing, (0, 0, 255)),  # it was black
        (plain, glowing, (255, 255, 255)),
        (body, stored(whole_png()), (90, 90, 90)),
        (body, lambda s: s.update(scenes=[*s["scenes"], {"nodes": []}], scene=0), (0, 0, 255)),
        (plain, posed(matrix=[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), (255, 255, 255)),
    ],
)
def test_what_a_material_of_gltf_says_is_seen(
    tmp_path: Path, mesh: Callable[[], trimesh.Trimesh], change: Callable[[Scene], object], expected
) -> None:
    found = colours(glb(tmp_path / "a.glb", mesh(), change))
    assert np.abs(found.astype(int) - expected).max() <= 1


REFUSED = [
    (draco, "uses KHR_draco_mesh_compression, which is not read here; export it again without"),
    (lambda s: s.update(extensionsUsed=["KHR_mesh_quantization"]), "KHR_mesh_quantization"),
    (lambda s: s.update(extensionsUsed=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    (lambda s: s.update(extensionsUsed=["KHR_materials_pbrSpecularGlossiness"]), "Glossiness, wh"),
    (rotated, "turns a texture by KHR_texture_transform"),
    (lambda s: s.update(extensionsUsed=["KHR_node_visibility"]), "uses KHR_node_visibility"),
    (undeclared("nodes", "EXT_mesh_gpu_instancing"), "uses EXT_mesh_gpu_instancing"),
    (undeclared("textures", "EXT_texture_webp"), "uses EXT_texture_webp"),
    (undeclared("materials", "KHR_materials_pbrSpecularGlossiness"), "Glossiness, which"),
    (lambda s: s["accessors"][0].update(sparse={"count": 1}), "uses sparse accessors"),
    (posed(skin=0), "uses a skin"),
    (posed(weights=[0.0, 1.0]), "uses weights of morph targets"),
    (lambda s: s["meshes"][0]["primitives"][0].update(mode=6), "uses triangle fans"),
    (lambda s: s["buffers"][0].update(uri="gone.bin"), "refers to 'gone.bin'"),
    (lambda s: s["images"][0].update(uri="gone.png"), "refers to 'gone.png'"),
    (lambda s: s["images"][0].update(uri="../../q.png"), "refers to '../../q.png'"),
    (wrapped(33071), "clamps or mirrors a texture beyond its edge"),  # it was repeated
    (wrapped(33648), "clamps or mirrors a texture beyond its edge"),
    (lambda s: stored(whole_png()[:45])(s), "a texture cannot be read"),  # it was white
    (lambda s: stored(whole_png(np.uint16))(s), "a texture has I;16 pixels"),
    (factor(2, 0, 0, 1), "has a colour's factor outside 0..1"),
    (lambda s: surface(s)["baseColorTexture"].update(texCoord=3), "lacks .* TEXCOORD_3"),
]


@pytest.mark.parametrize(("change", "words"), REFUSED)
def test_what_is_not_read_is_refused_by_name(
    tmp_path: Path, change: Callable[[Scene], object], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(BadObject, match=words):
        read_mesh_file(glb(tmp_path / "a.glb", body(), change))
    assert capfd.readouterr() == ("", "")


def test_an_extension_without_a_say_in_colours_passes(tmp_path: Path) -> None:
    names = ["KHR_materials_ior", "KHR_lights_punctual", "KHR_materials_unlit"]
    path = glb(tmp_path / "a.glb", body(), lambda s: s.update(extensionsUsed=names))
    assert colours(path).tolist() == [[0, 0, 255]]


def obj(folder: Path, material: str, name: str = "a") -> Path:
    """A ball as OBJ with texture coordinates in the blue quarter, and its .mtl."""
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    lines = [f"mtllib {name}.mtl", "vt 0.25 0.25", "usemtl one"]
    lines += ["v " + " ".join(map(str, vertex)) for vertex in mesh.vertices]
    lines += ["f " + " ".join(f"{i + 1}/1" for i in face) for face in mesh.faces]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    (folder / f"{name}.mtl").write_text(f"newmtl one\n{material}\n")
    return folder / f"{name}.obj"


@pytest.mark.parametrize(
    "line",
    [
        "map_Kd pictures/q.png",
        "map_Kd pictures\\q.png",
        "map_Kd C:\\Users\\me\\q.png",
        "map_Kd -s 1 1 1 pictures/q.png",
        "map_Kd -clamp on -o 0 0 -s 1 1 1 pictures\\q.png",
        "Kd 0.8 0.8 0.8\nmap_Kd pictures/q.png",
        'map_Kd "pictures/q.png"',
        "map_Kd Pictures/Q.PNG",
        "map_Kd \\\\server\\share\\q.png",
        "map_Kd pictures/%71.png",
        "map_Kd -mm 0 1 -blendu off pictures/q.png",
    ],
)
def test_a_picture_of_an_obj_is_found(tmp_path: Path, line: str) -> None:
    (tmp_path / "pictures").mkdir()
    picture = Image.fromarray(QUARTERS.repeat(8, 0).repeat(8, 1))
    picture.save(tmp_path / "pictures" / "q.png")
    if ":" in line or "server" in line or "Pictures" in line:
        picture.save(tmp_path / "q.png")
    assert colours(obj(tmp_path, line)).tolist() == [[0, 0, 255]]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("Kd 0.1 0.3 0.8", (26, 76, 204)),
        ("Kd 0.5", (128, 128, 128)),
        ("Kd 1 0 0\nd 0.3", (165, 89, 89)),
        ("Kd 1 0 0\nTr 0.7", (165, 89, 89)),
        ("Kd 0 0 0\nKe 1 0 0", (255, 0, 0)),
    ],
)
def test_kd_alone_colours_an_obj(tmp_path: Path, lines: str, expected: tuple[int, ...]) -> None:
    assert np.abs(colours(obj(tmp_path, lines)).astype(int) - expected).max() <= 1


def test_the_vertices_of_an_obj_have_colours(tmp_path: Path) -> None:
    """They were dropped where it has texture coordinates or a material."""
    for material in ("Kd 1 1 1", ""):
        path = obj(tmp_path, material)
        lines = [
            line + " 0.2 0.4 0.6" * line.startswith("v ") for line in path.read_text().split("\n")
        ]
        path.write_text("\n".join(line for line in lines if material or "mtl" not in line))
        assert np.abs(colours(path).astype(int) - (51, 102, 153)).max() <= 1
    path.write_text(path.read_text().replace("0.2 0.4 0.6", "51 102 153"))
    with pytest.raises(BadObject, match=r"has vertex colours outside 0\.\.1"):
        colours(path)


def test_a_clamped_texture_of_an_obj_is_refused_beyond_its_edge(tmp_path: Path) -> None:
    Image.fromarray(QUARTERS.repeat(8, 0).repeat(8, 1)).save(tmp_path / "q.png")
    path = obj(tmp_path, "map_Kd -clamp on q.png")
    assert colours(path).tolist() == [[0, 0, 255]]
    path.write_text(path.read_text().replace("vt 0.25", "vt 1.25"))
    with pytest.raises(BadObject, match="clamps or mirrors a texture beyond its edge"):
        colours(path)


@pytest.mark.parametrize("size", [1, 2])
def test_a_picture_of_one_pixel_is_one(tmp_path: Path, size: int) -> None:
    """It was taken for one that is missing: refused in an OBJ, white in a GLB."""
    Image.new("RGB", (size, size), (10, 200, 30)).save(tmp_path / "q.png")
    assert colours(obj(tmp_path, "map_Kd q.png")).tolist() == [[10, 200, 30]]
    path = glb(tmp_path / "a.glb", body(), stored((tmp_path / "q.png").read_bytes()))
    assert colours(path).tolist() == [[10, 200, 30]]


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_the_profile_of_a_texture(tmp_path: Path, kind: str) -> None:
    """glTF says that textures are in sRGB whatever they declare; other formats say nothing."""
    picture = Image.new("RGB", (8, 8), (180, 120, 90))
    picture.save(tmp_path / "q.png", icc_profile=icc(np.array(SPACES["Display P3"][0]), 2.2))
    path = obj(tmp_path, "map_Kd q.png")
    if kind == "glb":
        path = glb(tmp_path / "a.glb", body(), stored((tmp_path / "q.png").read_bytes()))
    expected = (180, 120, 90) if kind == "glb" else (192, 117, 83)
    assert np.abs(colours(path).astype(int) - expected).max() <= 1


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("map_Kd missing.png", "refers to 'missing.png', and there is no such file beside it"),
        ("map_Kd -s 2 2 1 q.png", "a texture is moved, scaled or brightened .-s 2 2 1."),
        ("Ns 10", "has no texture, UV map or vertex colours"),
        ("map_Kd -mm 0.2 0.5 q.png", "moved, scaled or brightened .-mm 0.2 0.5."),
        ("map_Kd ../q.png", "refers to '../q.png'"),
        ("Kd 200 30 40", "has Kd outside 0..1"),
        ("Kd nan 0 0", "has Kd outside 0..1"),
    ],
)
def test_what_an_obj_lacks_is_named(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(BadObject, match=words):
        read_mesh_file(obj(tmp_path, line))
    if "missing" in line:
        found = read_mesh_file(tmp_path / "a.obj", colour="#aa3322")
        assert np.unique(found.rgb, axis=0).tolist() == [[0xAA, 0x33, 0x22]]


@pytest.mark.parametrize(
    ("kind", "cells", "words"),
    [
        ("uchar", "200 30 40", ""),
        ("ushort", "51400 7710 10280", ""),
        ("float", "0.7843 0.1176 0.1569", ""),
        ("float", "200 30 40", "has colours in floats outside 0..1"),  # they were white
        ("float", "nan 0 0", "has colours in floats outside 0..1"),
    ],
)
def test_the_colours_of_a_ply(tmp_path: Path, kind: str, cells: str, words: str) -> None:
    lines = ["ply", "format ascii 1.0", "element vertex 4"]
    lines += [f"property float {name}" for name in ("x", "y", "z")]
    lines += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    lines += ["element face 4", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{xyz} {cells}" for xyz in ("0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1")]
    lines += ["3 0 2 1", "3 0 1 3", "3 1 2 3", "3 0 3 2"]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    if words:
        with pytest.raises(BadObject, match=words):
            colours(tmp_path / "a.ply")
    else:
        assert np.abs(colours(tmp_path / "a.ply").astype(int) - (200, 30, 40)).max() <= 1


def test_a_ply_without_its_picture_is_one_line(tmp_path: Path) -> None:
    """The log of the library came before it, eight lines of traceback."""
    lines = ["ply", "format ascii 1.0", "comment TextureFile label.png", "element vertex 4"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    lines += ["element face 4", "property list uchar int vertex_indices", "end_header"]
    lines += ["0 0 0 0 0", "0.1 0 0 1 0", "0 0.1 0 0 1", "0 0 0.1 1 1"]
    lines += ["3 0 2 1", "3 0 1 3", "3 1 2 3", "3 0 3 2"]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    line = refused("objects", "import", tmp_path / "a.ply", "--category", "cup")
    assert "refers to 'label.png'" in line
    lines.insert(2, "comment TextureFile other.png")
    for name in ("label.png", "other.png"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    with pytest.raises(BadObject, match="has several textures; bake them into one"):
        read_mesh_file(tmp_path / "a.ply")
