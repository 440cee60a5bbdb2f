"""measure photos: the folder form, what is wrong with bad folders, the figures, and resuming."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tests.command import refused, vap
from tests.toys import MeanColour, SameColour, detector, personal, scene, segmenter
from vap_core.attend import Attender
from vap_core.base.errors import BadPhotoSet
from vap_core.base.files import DATA
from vap_core.perception.protocols import Stack
from vap_core.study import photos
from vap_core.study.photos import (
    evidence,
    follow_scene,
    mask_rows,
    measure_scene,
    object_table,
    read_photo_set,
    scene_table,
    single_report,
    single_rows,
    vote_table,
)
from vap_core.study.register import fit_line, join_tiles, labelled
from vap_core.study.stats import clustered_share, mean_by, rate

RED, GREEN, BLUE, DARK = (250, 0, 0), (0, 250, 0), (0, 0, 250), (120, 10, 0)
HEADER = "scene,object,x0,y0,x1,y1\n"
TOY = Stack("toy", detector, MeanColour(), segmenter, SameColour())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A red mug, a dark red one, and a green plant, in two scenes."""
    for name, colour in (("mug", RED), ("old_mug", DARK), ("plant", GREEN)):
        place = tmp_path / "set" / "references" / name
        place.mkdir(parents=True)
        for i in range(2):
            Image.fromarray(scene([(20 + i, 20, colour)])).save(place / f"{i}.png")
    scenes = tmp_path / "set" / "scenes"
    scenes.mkdir()
    Image.fromarray(scene([(4, 4, RED), (40, 4, DARK), (4, 40, BLUE)])).save(scenes / "a.png")
    Image.fromarray(scene([(4, 4, DARK), (40, 40, GREEN)])).save(scenes / "b.png")
    (tmp_path / "set" / "objects.csv").write_text("object,category\nmug,cup\nold_mug,cup\n")
    (tmp_path / "set" / "scenes.csv").write_text(
        HEADER + "a.png,mug,4,4,16,16\na.png,old_mug,40,4,52,16\na.png,ball,4,40,16,52\n"
        "a.png,plant,,,,\nb.png,mug,,,,\nb.png,old_mug,4,4,16,16\nb.png,plant,43,43,55,55\n"
    )
    return tmp_path / "set"


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos, "load_stack", lambda name: TOY)


def test_the_form_is_read(folder):
    photo_set = read_photo_set(folder)
    assert [subject.name for subject in photo_set.subjects] == ["mug", "old_mug", "plant"]
    assert photo_set.categories == {
        "mug": "cup",
        "old_mug": "cup",
        "plant": "plant",
        "ball": "ball",
    }
    first, second = photo_set.scenes
    assert first.boxes["mug"].tolist() == [[4, 4, 16, 16]]
    assert len(second.boxes["mug"]) == 0
    assert read_photo_set(folder).sha256 == photo_set.sha256
    (folder / "objects.csv").write_text("object,category\nmug,cup\nold_mug,mug\n")
    assert read_photo_set(folder).sha256 != photo_set.sha256


def test_kinds_are_told_apart_as_they_are_remembered(folder):
    """A capital or a space more would make look-alikes things of other kinds."""
    (folder / "objects.csv").write_text("object,category\nmug,Coffee  Cup\nold_mug,coffee cup\n")
    categories = read_photo_set(folder).categories
    assert categories["mug"] == categories["old_mug"] == "coffee cup"


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("scenes.csv", None, "scenes.csv is not there"),
        ("scenes.csv", "scene,object\n", "lacks the column 'x0'"),
        ("scenes.csv", HEADER + "c.png,mug,1,2,3,4\n", "line 2 names the scene 'c.png'"),
        ("scenes.csv", HEADER + "a.png,mug,1,2,3\n", "line 2 .* is not x0,y0,x1,y1"),
        ("scenes.csv", HEADER + "a.png,mug,9,2,3,4\n", "has no area"),
        ("scenes.csv", HEADER + "a.png,mug,0.1,0.1,0.9,0.9\n", "line 2 .* pixels, not fractions"),
        ("scenes.csv", HEADER + "a.png,mug,4,4,4.5,16\n", "line 2 .* pixels, not fractions"),
        ("scenes.csv", HEADER + "a.png,ghost,,,,\n", "no references of 'ghost'"),
        ("scenes.csv", HEADER + "a.png,mug,1,2,3,4\n", "no line for b.png"),
        (
            "scenes.csv",
            HEADER + "a.png,mugg,1,2,9,9\nb.png,mugg,1,2,9,9\n",
            "names mugg, references are there of mug, .*; name an object alike",
        ),
        ("objects.csv", "object,category\nmgu,cup\n", "line 2 names 'mgu'"),
        ("objects.csv", "object,category\nmug,3!\n", "'3!' cannot be a category"),
        ("objects.csv", "object,category\nmug,my cup\n", "'my cup' cannot be a category"),
        ("references/boxes.csv", "photo,x0,y0,x1,y1\nmug/7.png,1,2,3,4\n", "names 'mug/7.png'"),
        (
            "references/boxes.csv",
            "photo,x0,y0,x1,y1\nmug/0.png,0.1,0.1,0.9,0.9\n",
            "boxes.csv line 2 .* pixels, not fractions",
        ),
        ("references/boxes.csv", "photo,x0,y0,x1,y1\nmug/0.png,0,0,1,1\n", "not fractions"),
        ("scenes.csv", "\xff\xfe", "lacks the column|cannot be read"),
    ],
)
def test_what_is_wrong_with_a_folder_is_one_line(folder, file, text, message):
    if text is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(text)
    with pytest.raises(BadPhotoSet, match=message) as error:
        read_photo_set(folder)
    assert len(str(error.value).replace(str(folder), "")) <= 300


@pytest.mark.parametrize("name", ["grün", "mug!", "m" * 65])
def test_a_folder_that_cannot_name_an_object_is_named(folder, name):
    """Before anything is embedded."""
    (folder / "references" / "mug").rename(folder / "references" / name)
    with pytest.raises(
        BadPhotoSet, match="cannot name an object; call it by a letter a to z"
    ) as error:
        read_photo_set(folder)
    assert str(folder / "references" / name) in str(error.value)


def test_the_set_that_ships_is_in_this_form():
    photo_set = read_photo_set(DATA / "photo-set")
    assert [subject.name for subject in photo_set.subjects] == ["cookies"]
    assert [len(scene.boxes["cookies"]) for scene in photo_set.scenes] == [0, 1, 0]
    assert photo_set.categories == {"cookies": "box", "rice": "box", "book": "book"}


def test_missing_parts_are_named(tmp_path):
    assert "is no folder" in refused(
        "measure", "photos", tmp_path / "none", "--out", tmp_path / "out"
    )
    with pytest.raises(BadPhotoSet, match="references holds no folder"):
        read_photo_set(tmp_path)
    (tmp_path / "references" / "mug").mkdir(parents=True)
    with pytest.raises(BadPhotoSet, match="mug holds no picture"):
        read_photo_set(tmp_path)


def test_the_command_measures_writes_and_resumes(folder, toy, tmp_path):
    out = tmp_path / "out"
    done = vap("measure", "photos", folder, "--stack", "toy", "--out", out)
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(out / "questions.parquet").set_index(["scene", "object"])
    assert len(table) == 6
    mug = table.loc[("a.png", "mug")]
    assert (mug.present, mug.tinted, mug.iou, mug.lookalikes) == (True, True, 1.0, 1)
    assert (mug.all_boxes, mug.all_one, mug.all_every) == (3, 1.0, True)
    assert (mug.kind_boxes, mug.kind_one) == (2, 1.0)
    plant = table.loc[("b.png", "plant")]
    assert 0.2 < plant.iou < 0.5  # its true box is shifted
    absent = table.loc[("b.png", "mug")]
    assert (absent.present, absent.tinted, absent.iou) == (False, True, 0.0)
    assert "object in view" in done.stdout
    assert "vote among" in done.stdout
    assert "note: scenes.csv names ball without references: taken as rivals" in done.stderr
    assert (out / "sheet-01.png").stat().st_size > 1000
    assert (out / "memory" / "mug.references.png").exists()
    assert len(pd.read_csv(out / "questions.csv")) == 6
    assert "photos of one object" not in done.stdout  # two references each
    part = (out / "parts" / "a.png.json").stat().st_mtime_ns
    (out / "parts" / "b.png.json").unlink()
    again = vap("measure", "photos", folder, "--stack", "toy", "--out", out)
    assert again.returncode == 0
    assert (out / "parts" / "a.png.json").stat().st_mtime_ns == part
    assert again.stdout.split("ms a photo")[0] == done.stdout.split("ms a photo")[0]
    (folder / "scenes.csv").write_text(HEADER + "a.png,mug,4,4,16,16\nb.png,mug,,,,\n")
    assert "holds another run" in refused(
        "measure", "photos", folder, "--stack", "toy", "--out", out
    )


def test_a_name_that_is_misspelt_in_one_line_is_told(folder, toy, tmp_path):
    """Its object is asked for once less, and the table does not show that."""
    text = (folder / "scenes.csv").read_text()
    (folder / "scenes.csv").write_text(text.replace("a.png,mug", "a.png,mugg"))
    done = vap("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("note:")]
    assert lines == [
        "note: scenes.csv names ball, mugg without references: taken as rivals, not asked for; "
        "where one is misspelt, mend it and measure anew"
    ]
    assert read_photo_set(DATA / "photo-set").rivals == ("book", "rice")


def test_a_box_outside_its_photo_is_named(folder, toy, tmp_path):
    (folder / "scenes.csv").write_text(HEADER + "a.png,mug,70,4,90,16\nb.png,mug,,,,\n")
    line = refused("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "out")
    assert "lies outside" in line
    assert "64x64" in line


def test_a_box_that_reaches_far_beyond_its_photo_is_named(folder, toy, tmp_path):
    """Of a digit too many the overlap would be near 0, whatever is found."""
    (folder / "scenes.csv").write_text(HEADER + "a.png,mug,4,4,160,16\nb.png,mug,,,,\n")
    line = refused("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "out")
    assert "'mug' reaches beyond" in line
    assert "64x64" in line
    photo_set = read_photo_set(folder)
    far = replace(photo_set.scenes[0], masks={"mug": folder / "scenes" / "a.png"})
    with pytest.raises(BadPhotoSet, match="reaches beyond"):
        mask_rows(far, TOY)
    with pytest.raises(BadPhotoSet, match="reaches beyond"):
        follow_scene(far, photo_set, TOY)


def test_a_box_that_reaches_a_pixel_beyond_its_photo_is_clipped(folder, toy):
    at_the_edge = np.array([[52, 4, 64, 16]], np.float32)
    Image.fromarray(scene([(52, 4, RED)])).save(folder / "scenes" / "a.png")
    memory = {"mug": personal("mug", "cup", RED)}
    photo_set = read_photo_set(folder)
    ious = []
    for beyond in (0, 1):
        boxes = {"mug": at_the_edge + np.array([0, 0, beyond, 0], np.float32)}
        first = replace(photo_set.scenes[0], boxes=boxes)
        (answer,) = measure_scene(first, photo_set, memory, Attender(TOY, memory))
        ious.append(answer["iou"])
    assert ious == [1.0, 1.0]


def row(**changed: object) -> dict[str, object]:
    usual: dict[str, object] = {
        "scene": "a", "object": "mug", "category": "cup", "present": True, "lookalikes": 0,
        "proposed_iou": 0.9, "iou": 0.9, "chosen_iou": 0.9, "tinted": True, "ms": 10.0,
        "all_boxes": None, "all_one": None, "all_every": None,
    }  # fmt: skip
    return usual | changed


def test_rows_count_what_they_say():
    table = pd.DataFrame(
        [
            row(),
            row(scene="b", iou=0.3, chosen_iou=0.3, lookalikes=1),
            row(scene="c", iou=0.0, tinted=False, proposed_iou=0.2, chosen_iou=0.6),
            row(scene="d", present=False, iou=0.0, lookalikes=2),
            row(scene="e", present=False, iou=0.0, chosen_iou=None, tinted=False, object="plant"),
        ]
    )
    assert object_table(table).to_numpy().tolist() == [
        ["mug", "cup", 3, 1, 2, 1, 1, 1, 1],
        ["plant", "cup", 0, 0, 0, 0, 0, 1, 0],
        ["all", "", 3, 1, 2, 1, 1, 2, 1],
    ]
    found = scene_table(table)
    by_name = found.assign(scenes=found["scenes"].str.strip("- ")).set_index("scenes")
    assert by_name.loc["object in view", "proposed"].startswith("67 ")
    assert by_name.loc["object in view", "right"].startswith("33 ")
    not_in_view = by_name.loc["object in view", "not in view"]
    assert not_in_view.startswith("50 ")
    assert not_in_view.endswith(" 2")
    assert by_name.loc["object absent", "not in view"] == ""
    assert by_name.loc["beside look-alikes", "wrong tinted"].startswith("100 ")
    assert by_name.loc["look-alikes in view", "wrong tinted"].startswith("100 ")
    assert by_name.loc["none of its kind", "silent"].startswith("100 ")
    assert vote_table(table).iloc[0].tolist() == ["all true boxes", "-", "-", "-", "-"]
    votes = table.assign(all_boxes=[4, 2, None, None, None], all_one=[0.5, 1, None, None, None])
    votes["all_every"] = [True, False, None, None, None]
    _, boxes, chance, one, _ = vote_table(votes).iloc[0]
    assert (boxes, chance) == ("3.0", "38")
    assert one.startswith("75 ")


def test_the_interval_of_independent_cases_is_wilsons_and_clusters_widen_it():
    hits = np.array([1.0, 0, 1, 1, 0, 1, 1, 0])
    alone = clustered_share(hits, list("abcdefgh"))
    exact = rate(5, 8)
    assert (alone.value, alone.n) == (0.625, 8)
    assert alone.low == pytest.approx(exact.low, abs=0.02)
    pairs = np.array([1.0, 1, 0, 0, 1, 1, 1, 1])
    paired = clustered_share(pairs, list("aabbccdd"))
    assert paired.high - paired.low > alone.high - alone.low
    same = clustered_share(np.ones(8), list("aabbccdd"))
    assert same.low == pytest.approx(rate(4, 4).low)
    assert clustered_share(np.zeros(0), []).n == 0


def masked(folder: Path) -> Path:
    """Gives the scenes masks: the mug's exactly, the old mug's left half in scene b."""
    for scene_name, name, box in (
        ("a.png", "mug", (4, 4, 16, 16)),
        ("b.png", "old_mug", (4, 4, 10, 16)),
    ):
        mask = np.zeros((64, 64), np.uint8)
        x0, y0, x1, y1 = box
        mask[y0:y1, x0:x1] = 255
        place = folder / "masks" / scene_name
        place.mkdir(parents=True)
        Image.fromarray(mask).save(place / f"{name}.png")
    return folder


def test_masks_are_measured_from_true_boxes_with_references_and_without(folder, toy, tmp_path):
    without_masks = read_photo_set(folder).sha256
    masked(folder)
    assert read_photo_set(folder).sha256 != without_masks
    done = vap("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(tmp_path / "out" / "masks.parquet").set_index("object")
    assert table.mask_iou.to_dict() == {"mug": 1.0, "old_mug": 0.5}
    assert "masks from true boxes: mean IoU 0.75 [0.50, 1.00] 2" in done.stdout
    shutil.rmtree(folder / "references")
    (folder / "scenes.csv").write_text(HEADER + "a.png,mug,4,4,16,16\nb.png,old_mug,4,4,16,16\n")
    (folder / "objects.csv").unlink()
    alone = vap("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "alone")
    assert alone.returncode == 0, alone.stderr
    assert "mean IoU 0.75" in alone.stdout
    assert "object in view" not in alone.stdout


def test_masks_that_do_not_fit_are_named(folder, toy, tmp_path):
    masked(folder)
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(folder / "masks" / "a.png" / "mug.png")
    line = refused("measure", "photos", folder, "--stack", "toy", "--out", tmp_path / "out")
    assert "has 8x8 pixels, its scene 64x64" in line
    (folder / "masks" / "a.png" / "mug.png").rename(folder / "masks" / "a.png" / "plant.png")
    with pytest.raises(BadPhotoSet, match="no single box of 'plant' in a.png"):
        read_photo_set(folder)
    shutil.rmtree(folder / "masks" / "a.png")
    (folder / "masks" / "c.png").mkdir()
    with pytest.raises(BadPhotoSet, match="masks of no scene"):
        read_photo_set(folder)


def test_the_mean_of_clusters_has_the_interval_of_drawing_them_again():
    def mean(values, scenes):
        return mean_by(pd.DataFrame({"iou": values, "scene": list(scenes)}), "iou", ["scene"])

    spread, alike = mean([0.0, 1.0, 0.0, 1.0], "abcd"), mean([0.0, 1.0, 0.0, 1.0], "aabb")
    assert (spread.value, spread.n) == (0.5, 4)
    assert spread.low < 0.5 < spread.high
    assert (alike.low, alike.high) == (0.5, 0.5)
    assert np.isnan(mean(np.ones(3), "aaa").low)


def test_left_out_photos_are_elected_against_two_others():
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    red = [(250, 0, i) for i in range(4)]
    memory = {
        "mug": personal("mug", "cup", *red),
        "plant": personal("plant", "plant", GREEN),
        "ball": personal("ball", "ball", BLUE),
    }
    rows = pd.DataFrame(single_rows(memory, stack))
    assert set(rows.object) == {"mug"}  # the others have one reference
    assert rows.right.all()
    twins = {**memory, "twin": personal("twin", "cup", *red), "copy": personal("copy", "cup", *red)}
    confused = pd.DataFrame(single_rows(twins, stack))
    assert 0 < confused[confused.object == "mug"].right.mean() < 1
    text = single_report(confused)
    assert "3 objects" in text
    assert single_rows({"mug": memory["mug"]}, stack) == []


def test_a_label_says_why_a_box_is_not_tinted():
    refused_one = row(tinted=False, iou=0.0, chosen_iou=0.76, likeness=0.44)
    assert evidence(refused_one) == ", IoU 0.76, likeness 0.44"
    assert evidence(row(present=False, likeness=0.3)) == ", likeness 0.30"
    assert evidence(row(likeness=None)) == evidence(row(likeness=float("nan"))) == ""


def test_the_pictures_of_a_sheet_do_not_touch() -> None:
    tile = np.zeros((4, 6, 3), np.uint8)
    sheet = join_tiles([tile] * 3, columns=2, gap_px=2)
    assert sheet.shape == (10, 14, 3)
    assert (sheet[:, 6:8] == 255).all()
    assert (sheet[4:6] == 255).all()
    assert (sheet[:4, 8:] == 0).all()
    assert join_tiles([tile] * 3, columns=2).shape == (8, 12, 3)


@pytest.mark.parametrize("line", ["mug", "what was found is unlike the other photos (cosine 0.43)"])
def test_labels_are_whole_in_a_tile_of_a_contact_sheet(line):
    assert fit_line(line, 352)[0] == line


def test_labels_of_any_length_and_alphabet_fit():
    text, size = fit_line("grey_sloth_plushie (in view) in " + "a-long-name-" * 20 + "7.jpg", 352)
    assert text.startswith("grey_sloth")
    assert text.endswith("7.jpg")
    assert "..." in text
    assert size == 10
    tile = labelled(np.zeros((20, 352, 3), np.uint8), ["Grüße", text])
    assert tile.shape == (54, 352, 3)
    assert (tile[20:, 349:] == 255).all()  # nothing runs out of the tile
    assert (labelled(tile, ["ü"])[54:] != labelled(tile, ["u"])[54:]).any()
