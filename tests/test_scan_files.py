"""Importing scans: what is accepted, what is refused, and what is repaired."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.scanned import BLUE, EPS, RED, box, fake_ghostscript, mug, put
from vap_core.base.errors import BadObject
from vap_core.simulation.assets.scans import import_scan as importing
from vap_core.simulation.assets.scans.gltf import to_linear
from vap_core.simulation.assets.scans.import_scan import import_scan
from vap_core.simulation.assets.scans.mesh_file import pack_charts, read_mesh_file
from vap_core.simulation.assets.shapes import Hull


@pytest.fixture
def quick(monkeypatch):
    """One convex hull instead of a decomposition, and a small texture, where they are not what is tested."""

    def one(vertex, face):
        return (Hull(vertex, float(abs(trimesh.Trimesh(vertex, face).convex_hull.volume))),)

    monkeypatch.setattr(importing, "convex_parts", one)
    monkeypatch.setattr(importing, "TEXTURE_PX", 256)
    monkeypatch.setattr("vap_core.simulation.assets.scans.mesh_file.SAMPLES", 100_000)


def ignore(line: str) -> None:
    """Print nothing."""


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
            read_mesh_file(tmp_path / name)


@pytest.mark.parametrize("name", ["mug.glb", "mug.obj"])
def test_a_texture_starts_no_program(tmp_path, monkeypatch, name):
    file = put(tmp_path, name, mug())
    marker = fake_ghostscript(tmp_path, monkeypatch)
    if name == "mug.glb":
        data = file.read_bytes()
        start, stop = data.index(b"\x89PNG"), data.index(b"IEND") + 8
        file.write_bytes(data[:start] + EPS.ljust(stop - start) + data[stop:])
    else:
        (tmp_path / "material_0.png").write_bytes(EPS)
    unchecked = Image.open
    with pytest.raises(BadObject, match="texture.* it is none of JPEG, .*export it as JPEG"):
        read_mesh_file(file)
    assert not marker.exists()
    assert Image.open is unchecked


def test_a_texture_of_too_many_pixels_is_refused(tmp_path):
    file = put(tmp_path, "mug.obj", mug())
    Image.new("1", (13000, 4000)).save(tmp_path / "material_0.png")
    with pytest.raises(BadObject, match="has 13000x4000 pixels, over 50 million; scale it down"):
        read_mesh_file(file)


def test_a_hole_is_counted_and_can_be_repaired(tmp_path, quick):
    torn = box(rgb=RED)
    torn.update_faces(np.arange(12) != 5)
    file = put(tmp_path, "torn.ply", torn)
    with pytest.raises(BadObject, match="not watertight: 3 open edges .*pass --repair"):
        import_scan(file, "torn", "box", report=ignore)
    _, scan = import_scan(file, "torn", "box", repair=True, report=ignore)
    assert len(np.unique(scan.form.vertex, axis=0)) >= 8
    assert np.abs(scan.image.reshape(-1, 3).astype(int) - RED).max() <= 2


def test_a_scan_without_a_bottom_and_with_crumbs_is_closed(tmp_path, quick):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    middle = ball.triangles_center
    ball.update_faces(
        (middle[:, 2] > -0.03) & (np.linalg.norm(middle - (0.04, 0, 0), axis=1) > 0.01)
    )
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.002)
    crumb.apply_translation((0.08, 0, 0))
    for part in (ball, crumb):
        part.visual.vertex_colors = np.tile([*RED, 255], (len(part.vertices), 1)).astype(np.uint8)
    file = put(tmp_path, "scan.ply", trimesh.util.concatenate([ball, crumb]))
    with pytest.raises(BadObject, match=r"\d\d+ open edges"):
        import_scan(file, "scan", "ball", report=ignore)
    _, scan = import_scan(file, "scan", "ball", repair=True, report=ignore)
    assert np.ptp(scan.form.vertex, axis=0) == pytest.approx((0.079, 0.08, 0.07), abs=0.002)
    vertex, face = np.unique(scan.form.vertex, axis=0, return_inverse=True)[0], scan.form.face
    corner = scan.form.vertex[face]
    assert len(vertex) > 1000
    assert (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum() / 6 == pytest.approx(
        4 / 3 * np.pi * 0.04**3, rel=0.06
    )


def test_triangles_that_face_both_ways_can_be_repaired(tmp_path, quick):
    turned = box(rgb=RED)
    turned.faces[3] = turned.faces[3][::-1]
    file = put(tmp_path, "turned.ply", turned)
    with pytest.raises(BadObject, match="face opposite ways along 3 edges; pass --repair"):
        import_scan(file, "turned", "box", report=ignore)
    import_scan(file, "turned", "box", repair=True, report=ignore)


def test_a_surface_inside_out_is_turned(tmp_path, quick):
    inside = box(rgb=RED)
    inside.invert()
    _, scan = import_scan(put(tmp_path, "inside.ply", inside), "inside", "box", report=ignore)
    corner = scan.form.vertex[scan.form.face]
    assert (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum() / 6 == pytest.approx(
        0.06 * 0.05 * 0.08, rel=1e-4
    )
    assert ((scan.form.vertex - (0, 0, 0.04)) * scan.form.normal).sum(axis=1).min() > 0


def test_a_colourless_mesh_asks_for_a_colour(tmp_path, quick):
    file = put(tmp_path, "plain.stl", box())
    with pytest.raises(
        BadObject, match="no texture, UV map or vertex colours; bake a texture .*--colour '#aa3322'"
    ):
        import_scan(file, "plain", "box", report=ignore)
    with pytest.raises(BadObject, match="no colour; write it as"):
        import_scan(file, "plain", "box", colour="reddish", report=ignore)
    mug().export(tmp_path / "mug.obj")
    for beside in ("material.mtl", "material_0.png"):
        (tmp_path / beside).unlink()
    with pytest.raises(BadObject, match="refers to 'material.mtl', and there is no such file"):
        import_scan(tmp_path / "mug.obj", "mug", "cup", report=ignore)
    _, scan = import_scan(file, "plain", "box", colour="#aa3322", report=ignore)
    assert (scan.image == (0xAA, 0x33, 0x22)).all()


def test_a_surface_that_cannot_be_reduced_is_refused(tmp_path, quick, monkeypatch):
    monkeypatch.setattr(importing, "MOST_VISUAL_FACES", 9_000)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    order = np.random.default_rng(0).permutation(len(ball.vertices))
    shuffled = trimesh.Trimesh(ball.vertices[order] * (1, 0.9, 0.8), ball.faces, process=False)
    file = put(tmp_path, "m.stl", shuffled)
    with pytest.raises(BadObject, match=r"cannot be reduced to 3,000 faces, [\d,]+ remain"):
        import_scan(file, "m", "cup", colour="#aa3322", height_cm=9.0, report=ignore)


def test_more_charts_than_fit_are_refused():
    corner = np.zeros((22_000, 3, 2))
    with pytest.raises(BadObject, match="falls into 22,000 pieces .* a texture holds 21,316"):
        pack_charts(np.arange(22_000), corner, 1024)
    uv = pack_charts(np.arange(400), np.tile([[0.0, 0], [1, 0], [0, 1]], (400, 1, 1)), 256)
    assert uv.max() <= 256


def test_wrong_units_ask_for_the_height(tmp_path, quick):
    giant = box(rgb=RED)
    giant.apply_scale(125_000)
    file = put(tmp_path, "giant.ply", giant)
    with pytest.raises(
        BadObject,
        match=r"would be 10 km long; an object is 1 cm to 60 cm.*units are most likely not metres.*--height-cm",
    ):
        import_scan(file, "giant", "box", report=ignore)
    _, scan = import_scan(file, "giant", "box", height_cm=9.0, report=ignore)
    assert np.ptp(scan.form.vertex, axis=0) == pytest.approx((0.0675, 0.05625, 0.09), abs=1e-6)


def test_up_decides_how_it_stands(tmp_path, quick):
    file = put(tmp_path, "box.ply", box(rgb=RED))
    for up, size in (("z", (0.06, 0.05, 0.08)), ("y", (0.06, 0.08, 0.05))):
        _, scan = import_scan(file, "box", "box", up=up, report=ignore)
        assert np.ptp(scan.form.vertex, axis=0) == pytest.approx(size, abs=1e-6)
        assert scan.form.vertex.min(axis=0) == pytest.approx(
            (-size[0] / 2, -size[1] / 2, 0), abs=1e-6
        )


def test_a_body_thinner_than_a_card_is_refused(tmp_path, quick):
    slab = trimesh.creation.box(extents=(0.07, 0.07, 0.00001))
    slab.visual = trimesh.visual.ColorVisuals(
        slab, vertex_colors=np.tile([180, 40, 40, 255], (len(slab.vertices), 1))
    )
    with pytest.raises(
        BadObject, match=r"only 0.001 cm thick, less than 0.2 cm; give it thickness"
    ):
        import_scan(put(tmp_path, "flat.ply", slab), "flat", "cup", report=ignore)


def test_a_sheet_encloses_nothing(tmp_path, quick):
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]],
        [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]],
        process=False,
    )
    with pytest.raises(BadObject, match="encloses no volume|not watertight"):
        import_scan(put(tmp_path, "sheet.stl", sheet), "sheet", "box", colour="red", report=ignore)


def test_too_many_faces_ask_to_decimate(tmp_path, monkeypatch):
    monkeypatch.setattr("vap_core.simulation.assets.scans.mesh_file.MAX_FACES", 10)
    with pytest.raises(BadObject, match="has 12 faces, over 10; decimate it first"):
        read_mesh_file(put(tmp_path, "box.ply", box(rgb=RED)))


def test_a_heavy_mesh_is_reduced_and_its_texture_painted_anew(tmp_path, quick):
    _, scan = import_scan(
        put(tmp_path, "fine.glb", mug(n=96, rows=30)), "fine", "cup", report=ignore
    )
    assert 2500 <= len(scan.form.face) <= importing.VISUAL_FACES
    assert scan.image.shape == (256, 256, 3)
    centre = scan.form.vertex[scan.form.face].mean(axis=1)
    uv = scan.form.uv[scan.form.face].mean(axis=1)
    colour = scan.image[(uv[:, 1] * 256).astype(int), (uv[:, 0] * 256).astype(int)].astype(int)
    high, low = centre[:, 2] > 0.05, (centre[:, 2] < 0.04) & (centre[:, 2] > 1e-4)
    assert (np.abs(colour[high] - RED).max(axis=1) < 10).mean() > 0.95
    assert (np.abs(colour[low] - BLUE).max(axis=1) < 10).mean() > 0.95


def test_parts_of_several_colours_become_one_object(tmp_path, quick):
    scene = trimesh.Scene()
    lower, upper = box(), box()
    for part, rgb in ((lower, RED), (upper, BLUE)):
        part.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*to_linear(np.array(rgb) / 255), 1.0]
            )
        )
    scene.add_geometry(lower)
    scene.add_geometry(upper, transform=trimesh.transformations.translation_matrix((0, 0.1, 0)))
    _, scan = import_scan(put(tmp_path, "two.glb", scene), "two", "box", report=ignore)
    assert np.ptp(scan.form.vertex, axis=0) == pytest.approx((0.06, 0.08, 0.15), abs=1e-6)
    found, count = np.unique(scan.image.reshape(-1, 3), axis=0, return_counts=True)
    most = sorted(map(tuple, found[np.argsort(-count)[:2]].astype(int)))
    assert np.abs(np.array(most) - sorted([RED, BLUE])).max() <= 8  # trimesh writes a byte of light


def test_the_up_axis_is_guessed_from_where_it_stands_flat(tmp_path, quick):
    """A mug that an OBJ holds z up, against the format's custom, and one as the custom is."""
    usual = put(tmp_path, "usual.obj", mug())
    lying = mug()
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    turned = put(tmp_path, "turned.obj", lying)
    lines = []
    for file, axis in ((usual, "y"), (turned, "z")):
        _, scan = import_scan(file, "mug", "cup", report=lines.append)
        size = np.ptp(scan.form.vertex, axis=0)
        assert size == pytest.approx((0.07, 0.07, 0.09), abs=1e-4)
        assert f"the file's {axis} axis points up; --up says otherwise" in lines
    box_file = put(tmp_path, "box.obj", box(rgb=(200, 30, 30)))
    assert importing.guess_up(read_mesh_file(box_file), box_file) == "y"


def test_splitting_that_does_not_end_is_ended(monkeypatch):
    """CoACD takes minutes over a surface that crosses itself; a limit of CPU time says so."""
    monkeypatch.setattr(importing, "SPLIT_CPU_S", 1)
    solid = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    order = np.random.default_rng(0).permutation(len(solid.vertices))
    vertex = np.array(solid.vertices)[order] * [1, 0.9, 0.8]
    with pytest.raises(BadObject, match="took over 1 s.*remesh or smooth it"):
        importing.convex_parts(vertex, np.asarray(solid.faces, np.int64))


def test_a_splitter_that_waits_is_ended(monkeypatch, tmp_path):
    monkeypatch.setattr(importing, "SPLIT_WALL_S", 1)
    (tmp_path / "sleeps.py").write_text("import time; time.sleep(100)")
    monkeypatch.setattr(importing, "SCRIPT", tmp_path / "sleeps.py")
    solid = trimesh.creation.box((0.05, 0.05, 0.05))
    with pytest.raises(BadObject, match="took over 60 s"):
        importing.convex_parts(np.asarray(solid.vertices), np.asarray(solid.faces, np.int64))


def test_a_splitter_that_dies_is_said(monkeypatch, tmp_path):
    (tmp_path / "dies.py").write_text("import os; os.abort()")
    monkeypatch.setattr(importing, "SCRIPT", tmp_path / "dies.py")
    solid = trimesh.creation.box((0.05, 0.05, 0.05))
    with pytest.raises(BadObject, match="cannot be split into convex parts .status -6."):
        importing.convex_parts(np.asarray(solid.vertices), np.asarray(solid.faces, np.int64))
