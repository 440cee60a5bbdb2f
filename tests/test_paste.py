"""paste-photos: what is pasted lies in its box, references are held out, and bad folders are one line."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command import refused, vap
from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.base.photos import load_photo
from vap_core.evaluation.photos.folder import read_photo_set
from vap_core.evaluation.photos.paste import absent, split
from vap_core.perception import stacks
from vap_core.perception.protocols import Stack

COLOURS = {"mug": (250, 0, 0), "old_mug": (0, 250, 0), "plant": (0, 0, 250), "ball": (200, 200, 0)}


@pytest.fixture
def things(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three photos of each of four objects, and a grey place."""
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    monkeypatch.setattr(stacks, "load_stack", lambda name: stack)
    for name, colour in COLOURS.items():
        (tmp_path / "things" / name).mkdir(parents=True)
        for i in range(3):
            picture = scene([(20 + i, 20, colour)], side=24)
            Image.fromarray(picture).save(tmp_path / "things" / name / f"{i}.png")
    (tmp_path / "things" / "objects.csv").write_text("object,category\nmug,cup\nold_mug,cup\n")
    (tmp_path / "place").mkdir()
    Image.fromarray(np.full((50, 90, 3), 90, np.uint8)).save(tmp_path / "place" / "desk.png")
    return tmp_path


def paste(folder: Path, out: str, *more: str) -> str:
    words = ("--scenes", folder / "place", "--pictures", "4", "--objects", "2", "--stack", "toy")
    done = vap("paste-photos", folder / "things", folder / out, *words, *more)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_boxes_hold_what_was_pasted_and_references_were_not_cut(things):
    text = paste(things, "set")
    assert "4 objects in 4 pictures" in text
    assert (things / "set" / "cuts.png").exists()
    photo_set = read_photo_set(things / "set")
    assert photo_set.categories == {
        "mug": "cup",
        "old_mug": "cup",
        "plant": "plant",
        "ball": "ball",
    }
    for subject in photo_set.subjects:
        assert [photo.path.name for photo in subject.photos] == ["0.png", "1.png"]
    for one in photo_set.scenes:
        rgb = load_photo(one.path, long_side=None)
        assert rgb.shape == (480, 640, 3)
        lit = np.zeros(rgb.shape[:2], bool)
        for name, boxes in one.boxes.items():
            for x0, y0, x1, y1 in boxes.astype(int).tolist():
                lit[y0:y1, x0:x1] = True
                assert 0.15 * 640 - 1 <= max(x1 - x0, y1 - y0) <= 0.35 * 640 + 1
                middle = rgb[(y0 + y1) // 2, (x0 + x1) // 2].astype(float)
                colour = np.array(COLOURS[name], float)
                assert middle @ colour > 0.999 * np.linalg.norm(middle) * np.linalg.norm(colour)
        assert (rgb[~lit] == 90).all()
        assert sum(len(boxes) > 0 for boxes in one.boxes.values()) == 2
        assert sum(len(boxes) == 0 for boxes in one.boxes.values()) >= 1


def test_given_boxes_and_masks_are_taken(things):
    (things / "things" / "boxes.csv").write_text("photo,x0,y0,x1,y1\nmug/0.png,20,20,44,44\n")
    mask = np.zeros((64, 64), np.uint8)
    mask[20:32, 22:34] = 255
    (things / "things" / "masks" / "mug").mkdir(parents=True)
    Image.fromarray(mask).save(things / "things" / "masks" / "mug" / "2.png")
    assert "4 objects" in paste(things, "set")
    photo_set = read_photo_set(things / "set")
    (mug,) = (subject for subject in photo_set.subjects if subject.name == "mug")
    assert mug.photos[0].box is not None
    assert mug.photos[0].box.tolist() == [20, 20, 44, 44]
    assert mug.photos[1].box is None
    Image.fromarray(mask[:30]).save(things / "things" / "masks" / "mug" / "2.png")
    words = ("--scenes", things / "place", "--stack", "toy")
    line = refused("paste-photos", things / "things", things / "bad", *words)
    assert "is not as large as its photo" in line


def test_a_comma_or_a_quote_in_a_photos_name_is_no_end_of_a_cell(things):
    name = 'left, "near".png'
    (things / "things" / "mug" / "0.png").rename(things / "things" / "mug" / name)
    quoted = name.replace('"', '""')
    (things / "things" / "boxes.csv").write_text(f'photo,x0,y0,x1,y1\n"mug/{quoted}",20,20,44,44\n')
    for i in (1, 2):
        (things / "things" / "mug" / f"{i}.png").rename(things / "things" / "mug" / f"z{i}.png")
    assert "4 objects" in paste(things, "set")
    photo_set = read_photo_set(things / "set")
    (mug,) = (subject for subject in photo_set.subjects if subject.name == "mug")
    assert mug.photos[0].path.name == name
    assert mug.photos[0].box is not None
    assert mug.photos[0].box.tolist() == [20, 20, 44, 44]


def test_a_folder_that_cannot_name_an_object_is_named_before_anything_is_cut(things):
    (things / "things" / "plant").rename(things / "things" / "grün")
    words = ("paste-photos", things / "things", things / "set", "--scenes", things / "place")
    line = refused(*words, "--stack", "toy")
    assert f"paste-photos: {things / 'things' / 'grün'} cannot name an object" in line
    assert not (things / "set").exists()


@pytest.mark.parametrize(
    ("file", "said"),
    [
        (
            "boxes.csv",
            "boxes.csv names 'mug/9.png', which is not there; name photos as OBJECT/FILE",
        ),
        ("masks/mug/9.png", "masks/mug/9.png is the mask of no photo"),
        ("masks/mugs/2.png", "masks/mugs/2.png is the mask of no photo"),
        ("masks/2.png", "masks/2.png is the mask of no photo"),
        ("masks/mug/2.jpg", "masks/mug/2.jpg is the mask of no photo"),
        ("masks/mug/2.png", "masks/mug/2.png is not as large as its photo"),
    ],
)
def test_boxes_and_masks_of_no_photo_are_refused_and_the_command_can_be_repeated(
    things, file, said
):
    wrong = things / "things" / file
    wrong.parent.mkdir(parents=True, exist_ok=True)
    if file == "boxes.csv":
        wrong.write_text("photo,x0,y0,x1,y1\nmug/9.png,20,20,44,44\n")
    else:
        Image.fromarray(np.full((60, 64), 255, np.uint8)).save(wrong)
    words = ("paste-photos", things / "things", things / "set", "--scenes", things / "place")
    assert said in refused(*words, "--stack", "toy")
    wrong.unlink()
    assert "4 objects" in paste(things, "set")


def test_a_background_that_cannot_be_read_leaves_nothing(things):
    (things / "place" / "desk.png").write_bytes(b"no picture")
    words = ("paste-photos", things / "things", things / "set", "--scenes", things / "place")
    refused(*words, "--stack", "toy")
    assert not (things / "set").exists()


def test_the_same_seed_is_the_same_set_and_no_set_is_written_over(things):
    paste(things, "one")
    paste(things, "two")
    paste(things, "three", "--seed", "1")
    first = read_photo_set(things / "one").sha256
    assert first == read_photo_set(things / "two").sha256
    assert first != read_photo_set(things / "three").sha256
    line = refused("paste-photos", things / "things", things / "one", "--scenes", things / "place")
    assert "is there already" in line


def test_absent_objects_are_one_beside_its_look_alikes_and_one_alone():
    kinds = {"mug": "cup", "old_mug": "cup", "plant": "plant", "ball": "ball"}
    drawn = absent(["mug", "ball"], list(kinds), kinds, np.random.default_rng(0))
    assert drawn == ["old_mug", "plant"]
    assert absent(list(kinds), list(kinds), kinds, np.random.default_rng(0)) == []


def test_five_references_at_most_and_a_photo_to_cut_at_least():
    paths = [Path(str(i)) for i in range(12)]
    assert split(paths) == (paths[:5], paths[5:8])
    assert split(paths[:2]) == (paths[:1], paths[1:2])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--size", "640"), "give for example 640x480"),
        (("--size", "10x10"), "64x64 to 8000x6000"),
        (("--share", "40,20"), "the lesser first"),
    ],
)
def test_bad_wishes_are_one_line(things, words, message):
    place = ("--scenes", things / "place")
    line = refused("paste-photos", things / "things", things / "out", *place, *words)
    assert message in line
    assert not (things / "out").exists()


def test_bad_folders_are_one_line(things):
    place = ("--scenes", things / "place")
    assert "is no folder" in refused("paste-photos", things / "none", things / "out", *place)
    assert "holds no folder" in refused("paste-photos", things / "place", things / "out", *place)
    nowhere = ("--scenes", things / "things")
    assert "no picture" in refused("paste-photos", things / "things", things / "out", *nowhere)
    (things / "things" / "ball" / "1.png").unlink()
    (things / "things" / "ball" / "2.png").unlink()
    assert "holds one photo" in refused("paste-photos", things / "things", things / "out", *place)
