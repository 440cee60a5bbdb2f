"""Scans of the user's own: what comes in, what is refused and how it is mended, and that the object then works as any other."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from vap_core.errors import BadObject, BadOutput, UnknownName
from vap_core.sim import objects
from vap_core.sim.gl import ensure_gl
from vap_core.sim.scans import bring as bringing
from vap_core.sim.scans import stored
from vap_core.sim.scans.bring import bring
from vap_core.sim.scans.source import read
from vap_core.sim.scans.triangles import decimate
from vap_core.sim.scenes import build
from vap_core.sim.shapes import Hull
from vap_core.sim.studio import reference_views

ensure_gl()
import mujoco  # noqa: E402

RED, BLUE = (204, 40, 40), (30, 60, 170)


def mug(n: int = 24, rows: int = 5) -> trimesh.Trimesh:
    """A hollow mug, 9 cm tall and 7 cm wide, y up as glTF has it: its lower half blue, its upper half red outside and inside."""
    up, down = np.linspace(0, 0.09, rows), np.linspace(0.09, 0.01, rows)
    profile = [(0, 0), *((0.035, z) for z in up), *((0.029, z) for z in down), (0, 0.01)]
    radius, z = np.array(profile).T
    turn = 2 * np.pi * np.arange(n + 1) / n
    turn[-1] = 0
    grid = np.stack([radius[:, None] * np.cos(turn), np.broadcast_to(z[:, None], (len(z), n + 1)), -radius[:, None] * np.sin(turn)], axis=-1)
    uv = np.stack(np.broadcast_arrays(np.arange(n + 1) / n, z[:, None] / 0.09), axis=-1)
    start = (np.arange(len(z) - 1)[:, None] * (n + 1) + np.arange(n)).ravel()
    step = n + 1
    face = np.concatenate([np.stack([start, start + 1, start + step + 1], 1), np.stack([start, start + step + 1, start + step], 1)])
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:128], picture[128:] = RED, BLUE
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(uv=uv.reshape(-1, 2), material=material)
    return trimesh.Trimesh(grid.reshape(-1, 3), face, visual=visual, process=False)


def box(**look) -> trimesh.Trimesh:
    solid = trimesh.creation.box((0.06, 0.05, 0.08))
    if look:
        solid.visual.vertex_colors = np.tile([*look["rgb"], 255], (8, 1)).astype(np.uint8)
    return solid


def put(folder: Path, name: str, mesh: trimesh.Trimesh | trimesh.Scene) -> Path:
    mesh.export(folder / name)
    return folder / name


def vap(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "vap_core", "objects", *map(str, words)], capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """A folder of objects that holds one scanned mug, brought in by the command; all lookups go there."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("shelf")
        patch.setenv("VAP_OBJECTS", str(folder / "objects"))
        file = put(folder, "mug.glb", mug())
        done = vap("import", file, "--category", "Cup", "--name", "my-mug", "--licence", "CC-BY 4.0, Jane Doe")
        assert done.returncode == 0, done.stderr
        assert "convex parts" in done.stderr
        assert "my-mug: a cup, 7.0 x 7.0 x 9.0 cm" in done.stdout
        assert "next: python -m vap_core objects photograph 'my-mug'" in done.stdout
        yield folder


@pytest.fixture
def quick(monkeypatch):
    """One convex hull instead of a decomposition, and a small texture, where they are not what is tested."""

    def one(vertex, face):
        return (Hull(vertex, float(abs(trimesh.Trimesh(vertex, face).convex_hull.volume))),)

    monkeypatch.setattr(bringing, "_hulls", one)
    monkeypatch.setattr(bringing, "TEXTURE_PX", 256)
    monkeypatch.setattr("vap_core.sim.scans.source.PAINT_POINTS", 100_000)


def silent(line: str) -> None:
    """Say nothing."""


def test_an_imported_mug_is_an_object_like_any_other(shelf):
    model = objects.get("my-mug")
    assert (model.category, model.split) == ("cup", "personal")
    assert objects.extent_m(model) == pytest.approx((0.07, 0.07, 0.09), abs=1e-6)
    assert objects.mesh(model).vertex[:, 2].min() == pytest.approx(0, abs=1e-9)
    solids = model.shape.solids()
    assert 4 <= len(solids) <= bringing.HULLS
    assert model.mass_kg == pytest.approx(np.clip(400 * sum(hull.volume for hull in solids), 0.03, 0.5), abs=1e-4)
    about = json.loads((shelf / "objects" / "my-mug" / "object.json").read_text())
    assert about["licence"] == "CC-BY 4.0, Jane Doe"
    assert about["source"] == "mug.glb"
    assert len(about["source_sha256"]) == 64


def test_it_stands_on_the_table_and_holds_its_shape_as_a_cup(shelf):
    with build("wx250s", ["my-mug"]) as scene:
        data = mujoco.MjData(scene.model)
        data.joint("my-mug/free").qpos[:3] = 0.3, 0.0, 0.001
        mujoco.mj_step(scene.model, data, 600)
        pose = data.joint("my-mug/free").qpos
        assert pose[:3] == pytest.approx((0.3, 0.0, 0.0), abs=1e-3)
        assert 1 - 2 * (pose[4] ** 2 + pose[5] ** 2) > 0.999
        assert scene.model.body("my-mug").mass[0] == pytest.approx(objects.get("my-mug").mass_kg)
        mask = scene.eyes.masks(data, "front", 224)["my-mug"]
        seen = scene.eyes.rgb(data, "front", 224)[mask].astype(int)
    assert mask.sum() > 300
    assert (seen[:, 0] > 1.8 * seen[:, 2]).mean() > 0.25
    assert (seen[:, 2] > 1.8 * seen[:, 0]).mean() > 0.25


def test_its_photos_show_the_texture_the_right_way_up(shelf):
    for photo in reference_views(objects.get("my-mug"), n=3, size=160):
        rows = np.arange(160)[:, None]
        red, blue = ((photo[..., a] > 2.0 * photo[..., b]) & (photo[..., a] > 40) for a, b in ((0, 2), (2, 0)))
        assert min(red.sum(), blue.sum()) > 300
        assert (rows * red).sum() / red.sum() + 10 < (rows * blue).sum() / blue.sum()


def test_list_shows_it_beside_the_workspaces_own(shelf):
    done = vap("list")
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("my-mug"))
    assert line.split()[1:4] == ["cup", "personal", "-"]
    assert "7.0 x 7.0 x 9.0" in line
    assert "cup-lookalike-1" in done.stdout
    with pytest.raises(UnknownName, match="known: .*my-mug"):
        objects.get("my-jug")


def test_a_name_that_is_taken_needs_replace(shelf):
    file = shelf / "mug.glb"
    again = vap("import", file, "--category", "cup", "--name", "my-mug")
    assert again.returncode == 2
    assert again.stderr.strip().endswith("choose another --name or pass --replace.")
    with pytest.raises(BadObject, match="one of the workspace's own objects; choose another --name"):
        bring(file, "cup-personal", "cup")
    with pytest.raises(BadObject, match="cannot name an object"):
        bring(file, "../mug", "cup")
    with pytest.raises(BadObject, match="cannot be a category"):
        bring(file, "mug", "cup!")


@pytest.mark.parametrize("name", stored.FILES)
def test_a_damaged_file_is_named(shelf, tmp_path, name):
    card, body = stored.load(shelf / "objects" / "my-mug")
    place = stored.save(tmp_path, card, body)
    whole = (place / name).read_bytes()
    (place / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadObject, match=rf"{name} is damaged .*import the object again with --replace"):
        stored.load(place)
    (place / name).unlink()
    with pytest.raises(BadObject, match=rf"{name} is missing"):
        stored.load(place)


def test_a_damaged_card_is_named(shelf, tmp_path):
    card, body = stored.load(shelf / "objects" / "my-mug")
    path = stored.save(tmp_path, card, body) / "object.json"
    about = json.loads(path.read_text())
    for change, message in (
        ({"version": 9}, "another version"),
        ({"mass_kg": -1.0}, "is damaged"),
        ({"name": "x"}, "is damaged"),
        ({"boo": 1}, "is damaged"),
    ):
        path.write_text(json.dumps(about | change) + " " * len(message))
        with pytest.raises(BadObject, match=f"object.json is .*{message.removeprefix('is ')}"):
            stored._card(path.parent)
    path.write_text("{")
    with pytest.raises(BadObject, match="object.json is damaged"):
        stored._card(path.parent)


def test_what_was_saved_is_what_is_loaded(shelf, tmp_path):
    card, body = stored.load(shelf / "objects" / "my-mug")
    _, again = stored.load(stored.save(tmp_path, card, body))
    assert np.array_equal(again.form.vertex, body.form.vertex)
    assert np.array_equal(again.image, body.image)
    assert all(np.array_equal(a.vertex, b.vertex) for a, b in zip(again.hulls, body.hulls, strict=True))
    with pytest.raises(BadOutput, match="--replace"):
        stored.save(tmp_path, card, body)
    stored.save(tmp_path, card, body, replace=True)
    assert [path.name for path in tmp_path.iterdir()] == ["my-mug"]


def test_unreadable_files_are_refused(tmp_path):
    (tmp_path / "a.glb").write_bytes(b"glTF garbage")
    (tmp_path / "b.fbx").write_bytes(b"x")
    (tmp_path / "c.ply").write_bytes(b"")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "d.ply")
    for name, message in (
        ("a.glb", "cannot be read"),
        ("b.fbx", "no GLB, OBJ, PLY or STL"),
        ("c.ply", "is empty"),
        ("d.ply", "no triangles"),
        ("e.stl", "not there"),
    ):
        with pytest.raises(BadObject, match=message):
            read(tmp_path / name)


def test_a_hole_is_counted_and_can_be_repaired(tmp_path, quick):
    torn = box(rgb=RED)
    torn.update_faces(np.arange(12) != 5)
    file = put(tmp_path, "torn.ply", torn)
    with pytest.raises(BadObject, match="not watertight: 3 open edges .*pass --repair"):
        bring(file, "torn", "box", say=silent)
    _, body = bring(file, "torn", "box", repair=True, say=silent)
    assert len(np.unique(body.form.vertex, axis=0)) >= 8
    assert np.abs(body.image.reshape(-1, 3).astype(int) - RED).max() <= 2


def test_a_scan_without_a_bottom_and_with_crumbs_is_closed(tmp_path, quick):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    middle = ball.triangles_center
    ball.update_faces((middle[:, 2] > -0.03) & (np.linalg.norm(middle - (0.04, 0, 0), axis=1) > 0.01))
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.002)
    crumb.apply_translation((0.08, 0, 0))
    for part in (ball, crumb):
        part.visual.vertex_colors = np.tile([*RED, 255], (len(part.vertices), 1)).astype(np.uint8)
    file = put(tmp_path, "scan.ply", trimesh.util.concatenate([ball, crumb]))
    with pytest.raises(BadObject, match=r"\d\d+ open edges"):
        bring(file, "scan", "ball", say=silent)
    _, body = bring(file, "scan", "ball", repair=True, say=silent)
    assert np.ptp(body.form.vertex, axis=0) == pytest.approx((0.079, 0.08, 0.07), abs=0.002)
    vertex, face = np.unique(body.form.vertex, axis=0, return_inverse=True)[0], body.form.face
    corner = body.form.vertex[face]
    assert len(vertex) > 1000
    assert (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum() / 6 == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.06)


def test_triangles_that_face_both_ways_can_be_repaired(tmp_path, quick):
    turned = box(rgb=RED)
    turned.faces[3] = turned.faces[3][::-1]
    file = put(tmp_path, "turned.ply", turned)
    with pytest.raises(BadObject, match="face opposite ways along 3 edges; pass --repair"):
        bring(file, "turned", "box", say=silent)
    bring(file, "turned", "box", repair=True, say=silent)


def test_a_surface_inside_out_is_turned(tmp_path, quick):
    inside = box(rgb=RED)
    inside.invert()
    _, body = bring(put(tmp_path, "inside.ply", inside), "inside", "box", say=silent)
    corner = body.form.vertex[body.form.face]
    assert (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum() / 6 == pytest.approx(0.06 * 0.05 * 0.08, rel=1e-4)
    assert ((body.form.vertex - (0, 0, 0.04)) * body.form.normal).sum(axis=1).min() > 0


def test_a_colourless_mesh_asks_for_a_colour(tmp_path, quick):
    file = put(tmp_path, "plain.stl", box())
    with pytest.raises(BadObject, match="no texture, UV map or vertex colours; bake a texture .*--colour '#aa3322'"):
        bring(file, "plain", "box", say=silent)
    with pytest.raises(BadObject, match="no colour; write it as"):
        bring(file, "plain", "box", colour="reddish", say=silent)
    mug().export(tmp_path / "mug.obj")
    for beside in ("material.mtl", "material_0.png"):
        (tmp_path / beside).unlink()
    with pytest.raises(BadObject, match=r"an OBJ needs its \.mtl and picture beside it"):
        bring(tmp_path / "mug.obj", "mug", "cup", say=silent)
    _, body = bring(file, "plain", "box", colour="#aa3322", say=silent)
    assert (body.image == (0xAA, 0x33, 0x22)).all()


def test_wrong_units_ask_for_the_height(tmp_path, quick):
    giant = box(rgb=RED)
    giant.apply_scale(125_000)
    file = put(tmp_path, "giant.ply", giant)
    with pytest.raises(BadObject, match=r"would be 10 km long; an object is 1 cm to 60 cm.*units are most likely not metres.*--height-cm"):
        bring(file, "giant", "box", say=silent)
    _, body = bring(file, "giant", "box", height_cm=9.0, say=silent)
    assert np.ptp(body.form.vertex, axis=0) == pytest.approx((0.0675, 0.05625, 0.09), abs=1e-6)


def test_up_decides_how_it_stands(tmp_path, quick):
    file = put(tmp_path, "box.ply", box(rgb=RED))
    for up, size in (("z", (0.06, 0.05, 0.08)), ("y", (0.06, 0.08, 0.05))):
        _, body = bring(file, "box", "box", up=up, say=silent)
        assert np.ptp(body.form.vertex, axis=0) == pytest.approx(size, abs=1e-6)
        assert body.form.vertex.min(axis=0) == pytest.approx((-size[0] / 2, -size[1] / 2, 0), abs=1e-6)


def test_a_body_thinner_than_a_card_is_refused(tmp_path, quick):
    slab = trimesh.creation.box(extents=(0.07, 0.07, 0.00001))
    slab.visual = trimesh.visual.ColorVisuals(slab, vertex_colors=np.tile([180, 40, 40, 255], (len(slab.vertices), 1)))
    with pytest.raises(BadObject, match=r"only 0.001 cm thick, less than 0.2 cm; give it thickness"):
        bring(put(tmp_path, "flat.ply", slab), "flat", "cup", say=silent)


def test_a_sheet_encloses_nothing(tmp_path, quick):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]], process=False)
    with pytest.raises(BadObject, match="encloses no volume|not watertight"):
        bring(put(tmp_path, "sheet.stl", sheet), "sheet", "box", colour="red", say=silent)


def test_too_many_faces_ask_to_decimate(tmp_path, monkeypatch):
    monkeypatch.setattr("vap_core.sim.scans.source.MAX_FACES", 10)
    with pytest.raises(BadObject, match="has 12 faces, over 10; decimate it first"):
        read(put(tmp_path, "box.ply", box(rgb=RED)))


def test_a_heavy_mesh_is_reduced_and_its_texture_painted_anew(tmp_path, quick):
    _, body = bring(put(tmp_path, "fine.glb", mug(n=96, rows=30)), "fine", "cup", say=silent)
    assert 2500 <= len(body.form.face) <= bringing.VISUAL_FACES
    assert body.image.shape == (256, 256, 3)
    centre = body.form.vertex[body.form.face].mean(axis=1)
    uv = body.form.uv[body.form.face].mean(axis=1)
    colour = body.image[(uv[:, 1] * 256).astype(int), (uv[:, 0] * 256).astype(int)].astype(int)
    high, low = centre[:, 2] > 0.05, (centre[:, 2] < 0.04) & (centre[:, 2] > 1e-4)
    assert (np.abs(colour[high] - RED).max(axis=1) < 10).mean() > 0.95
    assert (np.abs(colour[low] - BLUE).max(axis=1) < 10).mean() > 0.95


def test_decimation_keeps_a_closed_surface_and_its_volume():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    vertex, face = decimate(np.array(ball.vertices), np.array(ball.faces), 600)
    fewer = trimesh.Trimesh(vertex, face, process=False)
    assert len(face) <= 610
    assert fewer.is_watertight
    assert fewer.is_winding_consistent
    assert fewer.volume == pytest.approx(ball.volume, rel=0.01)


def test_parts_of_several_colours_become_one_object(tmp_path, quick):
    scene = trimesh.Scene()
    lower, upper = box(), box()
    for part, rgb in ((lower, RED), (upper, BLUE)):
        part.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=[*rgb, 255]))
    scene.add_geometry(lower)
    scene.add_geometry(upper, transform=trimesh.transformations.translation_matrix((0, 0.1, 0)))
    _, body = bring(put(tmp_path, "two.glb", scene), "two", "box", say=silent)
    assert np.ptp(body.form.vertex, axis=0) == pytest.approx((0.06, 0.08, 0.15), abs=1e-6)
    found, count = np.unique(body.image.reshape(-1, 3), axis=0, return_counts=True)
    assert {tuple(map(int, rgb)) for rgb in found[np.argsort(-count)[:2]]} == {RED, BLUE}


def test_photograph_writes_the_reference_views(shelf):
    done = vap("photograph", "my-mug", "--out", shelf / "photos", "--views", "2")
    assert done.returncode == 0, done.stderr
    assert "register 'my-mug' --category 'cup'" in done.stdout
    for i in range(2):
        with Image.open(shelf / "photos" / f"my-mug-{i}.png") as photo:
            assert photo.size == (320, 320)
