"""A scan imported by the command is an object like any other; its files are checked on loading."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command import refused, vap
from tests.scanned import mug, put
from vap_core.base.errors import BadObject, BadOutput, UnknownName
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.scans import import_scan as importing
from vap_core.simulation.assets.scans import storage
from vap_core.simulation.assets.scans.import_scan import default_name, import_scan
from vap_core.simulation.gl import ensure_gl
from vap_core.simulation.scenes import build
from vap_core.simulation.studio import reference_views, write_views

ensure_gl()
import mujoco  # noqa: E402


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """A folder of objects that holds one scanned mug, brought in by the command; all lookups go there."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("shelf")
        patch.setenv("VAP_OBJECTS", str(folder / "objects"))
        file = put(folder, "mug.glb", mug())
        words = ("objects", "import", file, "--category", "Cup", "--name", "my-mug")
        done = vap(*words, "--licence", "CC-BY 4.0, Jane Doe")
        assert done.returncode == 0, done.stderr
        assert "convex parts" in done.stderr
        assert "too wide for the gripper of wx250s" in done.stderr
        assert "too wide for the gripper of wx250s, so101, panda" not in done.stderr
        with Image.open(folder / "objects" / "my-mug.preview.png") as preview:
            assert preview.size == (1280, 320)
        assert "my-mug: a cup, 7.0 x 7.0 x 9.0 cm" in done.stdout
        assert "next: ./vap eval --suite SUITE --object my-mug " in done.stdout
        yield folder


def test_an_imported_mug_is_an_object_like_any_other(shelf):
    model = objects.get_object("my-mug")
    assert (model.category, model.split) == ("cup", "personal")
    assert objects.extent_m(model) == pytest.approx((0.07, 0.07, 0.09), abs=1e-6)
    assert objects.mesh_of(model).vertex[:, 2].min() == pytest.approx(0, abs=1e-9)
    solids = model.form.solids()
    assert 4 <= len(solids) <= importing.HULLS
    assert model.mass_kg == pytest.approx(
        np.clip(400 * sum(hull.volume for hull in solids), 0.03, 0.5), abs=1e-4
    )
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
        assert scene.model.body("my-mug").mass[0] == pytest.approx(
            objects.get_object("my-mug").mass_kg
        )
        mask = scene.renderer.masks_and_hand(data, "front", (224, 224))[0]["my-mug"]
        seen = scene.renderer.rgb(data, "front", (224, 224))[mask].astype(int)
    assert mask.sum() > 300
    assert (seen[:, 0] > 1.8 * seen[:, 2]).mean() > 0.25
    assert (seen[:, 2] > 1.8 * seen[:, 0]).mean() > 0.25


def test_its_photos_show_the_texture_the_right_way_up(shelf):
    for photo in reference_views(objects.get_object("my-mug"), n=3, size=160):
        rows = np.arange(160)[:, None]
        red, blue = (
            (photo[..., a] > 2.0 * photo[..., b]) & (photo[..., a] > 40)
            for a, b in ((0, 2), (2, 0))
        )
        assert min(red.sum(), blue.sum()) > 300
        assert (rows * red).sum() / red.sum() + 10 < (rows * blue).sum() / blue.sum()


def test_list_shows_it_beside_the_workspaces_own(shelf):
    done = vap("objects", "list")
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("my-mug"))
    assert line.split()[1:4] == ["cup", "personal", "-"]
    assert "7.0 x 7.0 x 9.0" in line
    assert "cup-lookalike-1" in done.stdout
    with pytest.raises(UnknownName, match="known: .*my-mug"):
        objects.get_object("my-jug")


def test_a_name_that_is_taken_needs_replace(shelf):
    file = shelf / "mug.glb"
    again = vap("objects", "import", file, "--category", "cup", "--name", "my-mug")
    assert again.returncode == 2
    assert again.stderr.strip().endswith("choose another --name or pass --replace.")
    with pytest.raises(
        BadObject, match="one of the workspace's own objects; choose another --name"
    ):
        import_scan(file, "cup-personal", "cup")
    for part in ("floor", "gripper", "base", "hand", "robot", "rest", "world"):
        with pytest.raises(BadObject, match="part of the room or of a robot is called"):
            import_scan(file, part, "cup")
    with pytest.raises(BadObject, match="ends in -red"):
        import_scan(file, "cup-personal-red", "cup")
    assert default_name(Path("杯子.glb")) == "my-object"
    with pytest.raises(
        BadObject, match="cannot name an object; use a letter a to z or a digit, .* 64 char"
    ):
        import_scan(file, "../mug", "cup")
    with pytest.raises(BadObject, match="cannot be a category"):
        import_scan(file, "mug", "cup!")
    with pytest.raises(BadObject, match="'my cup' cannot be a category; .* --category cup"):
        import_scan(file, "mug", "my cup")


@pytest.mark.parametrize("name", storage.FILES)
def test_a_damaged_file_is_named(shelf, tmp_path, name):
    metadata, scan = storage.load_scan(shelf / "objects" / "my-mug")
    place = storage.save_scan(tmp_path, metadata, scan)
    whole = (place / name).read_bytes()
    (place / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        BadObject, match=rf"{name} is damaged .*import the object again with --replace"
    ):
        storage.load_scan(place)
    (place / name).unlink()
    with pytest.raises(BadObject, match=rf"{name} is missing"):
        storage.load_scan(place)


def test_damaged_metadata_is_named(shelf, tmp_path):
    metadata, scan = storage.load_scan(shelf / "objects" / "my-mug")
    path = storage.save_scan(tmp_path, metadata, scan) / "object.json"
    about = json.loads(path.read_text())
    for change, message in (
        ({"version": 9}, "another version"),
        ({"mass_kg": -1.0}, "is damaged"),
        ({"name": "x"}, "is damaged"),
        ({"boo": 1}, "is damaged"),
    ):
        path.write_text(json.dumps(about | change) + " " * len(message))
        with pytest.raises(BadObject, match=f"object.json is .*{message.removeprefix('is ')}"):
            storage._read_metadata(path.parent)
    path.write_text("{")
    with pytest.raises(BadObject, match="object.json is damaged"):
        storage._read_metadata(path.parent)


def test_what_was_saved_is_what_is_loaded(shelf, tmp_path):
    metadata, scan = storage.load_scan(shelf / "objects" / "my-mug")
    _, again = storage.load_scan(storage.save_scan(tmp_path, metadata, scan))
    assert np.array_equal(again.form.vertex, scan.form.vertex)
    assert np.array_equal(again.image, scan.image)
    assert all(
        np.array_equal(a.vertex, b.vertex) for a, b in zip(again.hulls, scan.hulls, strict=True)
    )
    with pytest.raises(BadOutput, match="--replace"):
        storage.save_scan(tmp_path, metadata, scan)
    storage.save_scan(tmp_path, metadata, scan, replace=True)
    assert [path.name for path in tmp_path.iterdir()] == ["my-mug"]


def test_photograph_writes_the_reference_views(shelf):
    done = vap("objects", "photograph", "my-mug", "--out", shelf / "photos", "--views", "2")
    assert done.returncode == 0, done.stderr
    assert "register my-mug --category cup" in done.stdout
    for i in range(2):
        with Image.open(shelf / "photos" / f"my-mug-{i}.png") as photo:
            assert photo.size == (320, 320)


def test_photographing_replaces_no_picture_of_anothers(shelf, tmp_path):
    """The same views again are no error: nothing is lost."""
    (tmp_path / "my-mug-1.png").write_bytes(b"a photo of mine")
    line = refused("objects", "photograph", "my-mug", "--out", tmp_path, "--views", "2")
    assert "my-mug-1.png exists with other contents; choose another folder with --out" in line
    assert [path.name for path in tmp_path.iterdir()] == ["my-mug-1.png"]
    assert (tmp_path / "my-mug-1.png").read_bytes() == b"a photo of mine"
    model = objects.get_object("my-mug")
    assert write_views(model, tmp_path / "new", 2) == write_views(model, tmp_path / "new", 2)
    write_views(model, tmp_path, 2, replace=True)
    with Image.open(tmp_path / "my-mug-1.png") as photo:
        assert photo.size == (320, 320)
