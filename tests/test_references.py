"""Registering from photos: which box is cropped, when it stops, and what it says of the vote."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.base import media
from vap_core.base.errors import BadPhoto
from vap_core.base.media import load_photo
from vap_core.base.types import Boxes
from vap_core.memory import remember
from vap_core.notebook import drag_box, dragged_box
from vap_core.perception.protocols import Stack
from vap_core.perception.references import choose_references, whole_photos
from vap_core.study import register as registering
from vap_core.study.register import leave_one_out, warnings

RED, GREEN, BLUE, GREY = (250, 0, 0), (0, 250, 0), (0, 0, 250), (90, 90, 90)
STACK = Stack(
    name="toy",
    detector=detector,
    encoder=MeanColour(),
    segmenter=segmenter,
    tracker=SameColour(),
)


def choose(photos, given=None):
    return choose_references(photos, "cup", detector, MeanColour(), given)


def save(folder: Path, photos) -> list[Path]:
    paths = []
    for i, rgb in enumerate(photos):
        paths.append(folder / f"mug-{i}.png")
        Image.fromarray(rgb).save(paths[-1])
    return paths


def test_what_all_photos_share_is_cropped_though_other_things_are_nearer_the_middle():
    photos = [
        scene([(4, 4, RED), (26, 26, GREEN)]),
        scene([(40, 6, RED), (26, 26, BLUE)]),
        scene([(26, 44, RED)]),
    ]
    references = choose(photos)
    assert [reference.box[:2].tolist() for reference in references] == [[4, 4], [40, 6], [26, 44]]
    assert all(reference.agreement > 0.99 for reference in references)
    assert not any(reference.doubt for reference in references)
    assert [len(reference.others) for reference in references] == [1, 1, 0]


def test_doubts_are_said():
    nothing, alone = choose([np.zeros((64, 64, 3), np.uint8), scene([(26, 26, RED)])])
    assert nothing.chosen_by == "whole"
    assert "no cup was found" in nothing.doubt
    assert not alone.doubt
    (either,) = choose([scene([(10, 26, RED), (42, 26, GREEN)])])
    assert "two things" in either.doubt
    unlike = choose([scene([(26, 26, RED)]), scene([(26, 26, RED)]), scene([(26, 26, BLUE)])])
    assert "unlike the other photos" in unlike[2].doubt


def test_a_given_box_is_taken_and_guides_the_other_photos():
    photos = [scene([(6, 6, RED), (26, 26, GREEN)]), scene([(6, 6, RED), (26, 26, GREEN)])]
    box = np.array([6, 6, 18, 18], np.float32)
    first, second = choose(photos, {0: box})
    assert first.chosen_by == "given"
    assert first.box.tolist() == box.tolist()
    assert not first.doubt
    assert second.chosen_by == "proposed"


def test_a_crop_of_only_a_part_is_doubtful():
    """A photo in which a part alone is found says so."""
    whole = scene([(8, 8, RED)], side=40)
    whole[26:34, 26:34] = GREEN
    proposed = np.array([[8, 8, 48, 48], [26, 26, 34, 34]], np.float32)

    def parts(images, phrase, threshold=None):
        alone = [proposed[1:] if image[8, 8, 0] == 0 else proposed for image in images]
        return [Boxes(xyxy, np.full(len(xyxy), 0.5, np.float32), phrase) for xyxy in alone]

    cut = np.zeros_like(whole)
    cut[26:34, 26:34] = (200, 100, 0)
    references = choose_references([whole, whole, whole, cut], "cup", parts, MeanColour())
    assert [r.box.tolist() for r in references[:3]] == [proposed[0].tolist()] * 3
    assert [bool(r.doubt) for r in references] == [False, False, False, True]
    assert "part of it" in references[3].doubt


def test_a_part_of_the_object_is_not_something_else():
    """What the photo shows besides the object are rivals in the check; its parts are not."""

    def parts(images, phrase, threshold=None):
        xyxy = np.array([[20, 20, 60, 60], [25, 25, 32, 32], [2, 2, 12, 12]], np.float32)
        return [Boxes(xyxy, np.array([0.9, 0.5, 0.5], np.float32), phrase) for _ in images]

    photo = scene([(20, 20, RED)], side=40) + scene([(2, 2, GREEN)], side=10)
    (reference,) = choose_references([photo], "cup", parts, MeanColour())
    assert reference.box.tolist() == [20, 20, 60, 60]
    (other,) = reference.others
    assert other[5, 5].tolist() == list(GREEN)


def test_boxes_and_masks_are_read_by_the_photos_name(tmp_path):
    photos = save(tmp_path, [scene([(6, 6, RED)]), scene([(9, 9, RED)])])
    mask = np.zeros((64, 64), np.uint8)
    mask[9:21, 9:21] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    given = registering.parse_given(
        ["mug-0.png=6,6,18,18"], [f"{photos[1]}={tmp_path / 'mask.png'}"], photos
    )
    assert given[0].tolist() == [6, 6, 18, 18]
    assert given[1].tolist() == [9, 9, 21, 21]
    assert registering.parse_given(["1,2,3,4"], [], photos[:1])[0].tolist() == [1, 2, 3, 4]
    for text, message in (
        ("mug-7.png=1,2,3,4", "names no single photo"),
        ("1,2,3,4", "names no single photo"),
        ("mug-0.png=1,2,3", "is not x0,y0,x1,y1"),
        ("mug-0.png=5,5,5,9", "has no area"),
        ("mug-0.png=1,2,inf,9", "has no area"),
    ):
        with pytest.raises(BadPhoto, match=message):
            registering.parse_given([text], [], photos)
    outside = {0: np.array([0, 0, 90, 20], np.float32)}
    with pytest.raises(BadPhoto, match="not inside"):
        registering.choose(photos, "cup", STACK, outside, whole=False)
    with pytest.raises(BadPhoto, match="--whole uses photos as they are; leave --box and --mask"):
        registering.choose(photos, "cup", STACK, {0: given[0]}, whole=True)


def test_a_path_of_a_mask_or_photo_may_hold_an_equals_sign(tmp_path):
    folder = tmp_path / "day=1"
    folder.mkdir()
    photos = [*save(folder, [scene([(6, 6, RED)])]), folder / "mug-0.png=b.png"]
    Image.fromarray(scene([(6, 6, RED)])).save(photos[1], "PNG")
    mask = np.zeros((64, 64), np.uint8)
    mask[9:21, 9:21] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    for number, photo in enumerate(photos):
        for name in (photo.name, str(photo)):
            given = registering.parse_given([], [f"{name}={folder / 'mask.png'}"], photos)
            assert list(given) == [number]
            assert given[number].tolist() == [9, 9, 21, 21]
    with pytest.raises(BadPhoto, match="names no single photo; write --mask PHOTO=MASK.png with"):
        registering.parse_given([], [str(folder / "mask.png")], photos[:1])


def test_a_mask_is_as_large_as_its_photo_and_ends_where_it_is_transparent(tmp_path):
    photos = save(tmp_path, [scene([(6, 6, RED)])])
    small = tmp_path / "small.png"
    Image.fromarray(np.full((32, 32), 255, np.uint8)).save(small)
    with pytest.raises(BadPhoto, match="small.png has 32x32 pixels, its photo 64x64; save it as"):
        registering.parse_given([], [f"mug-0.png={small}"], photos)
    white = np.full((64, 64, 4), 255, np.uint8)
    white[..., 3] = 0
    white[6:18, 6:18, 3] = 255
    Image.fromarray(white).save(tmp_path / "cut.png")
    given = registering.parse_given([], [f"mug-0.png={tmp_path / 'cut.png'}"], photos)
    assert given[0].tolist() == [6, 6, 18, 18]
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(tmp_path / "dark.png")
    with pytest.raises(BadPhoto, match="dark all over"):
        registering.parse_given([], [f"mug-0.png={tmp_path / 'dark.png'}"], photos)


def test_photos_of_the_same_name_are_told_apart_by_their_paths(tmp_path):
    photos = []
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        photos += save(tmp_path / day, [scene([(10, 26, RED), (42, 26, GREEN)])])
    with pytest.raises(BadPhoto, match=rf"with one of {photos[0]}, {photos[1]}\.$"):
        registering.parse_given(["mug-0.png=1,2,3,4"], [], photos)
    references = registering.choose(photos, "cup", STACK, {}, whole=False)
    with pytest.raises(BadPhoto, match=f"give --box {photos[0]}=") as said:
        registering.leave_out_doubtful(references, photos, tmp_path / "sheet.png")
    assert f"{photos[0]}: " in str(said.value)
    assert list(registering.parse_given([f"{photos[1]}=1,2,30,40"], [], photos)) == [1]


def test_a_sheet_says_how_every_box_was_chosen(tmp_path):
    photos = save(tmp_path, [scene([(26, 26, RED)]), scene([(20, 20, RED)])])
    given = {0: np.array([26, 26, 38, 38], np.float32)}
    by_hand, proposed = registering.choose(photos, "cup", STACK, given, whole=False)
    assert registering.describe_choice(by_hand) == "box given by hand"
    said = registering.describe_choice(proposed)
    assert said == "box proposed; cosine 1.00 to the other photos"
    (alone,) = registering.choose(photos[:1], "cup", STACK, {}, whole=False)
    assert registering.describe_choice(alone) == "box proposed; the only photo"
    (whole,) = whole_photos([scene([(6, 6, RED)])])
    assert registering.describe_choice(whole) == "used whole"


def test_a_doubtful_crop_stops_it_with_the_photo_the_sheet_and_the_remedy(tmp_path):
    """The remedy can be pasted, where a name has spaces too, and both boxes are drawn."""
    photo = tmp_path / "my mug.png"
    Image.fromarray(scene([(10, 26, RED), (42, 26, GREEN)])).save(photo)
    references = registering.choose([photo], "cup", STACK, {}, whole=False)
    sheet = tmp_path / "sheet.png"
    with pytest.raises(BadPhoto, match=r"my mug.png: two things.*or pass --accept.*sheet.png") as e:
        registering.leave_out_doubtful(references, [photo], sheet)
    for box in ("10,26,22,38 (box 1)", "42,26,54,38 (box 2)"):
        assert f"--box 'my mug.png'={box}" in str(e.value)
    shown = load_photo(sheet, long_side=None)
    scale = registering.TILE_PX / 64
    for x in (10, 42):
        assert shown[round(32 * scale), round(x * scale)].tolist() == list(registering.DOUBTFUL)
    good = whole_photos([scene([(6, 6, RED)])])
    assert registering.leave_out_doubtful(good, [photo], sheet) == ([0], [])


def test_a_doubtful_photo_is_left_out_where_three_are_good(tmp_path):
    mine = [scene([(26, y, RED)]) for y in (20, 26, 32)]
    photos = save(tmp_path, [*mine, scene([(26, 26, BLUE)])])
    references = registering.choose(photos, "cup", STACK, {}, whole=False)
    good, (line,) = registering.leave_out_doubtful(references, photos, tmp_path / "sheet.png")
    assert good == [0, 1, 2]
    assert line.startswith("mug-3.png: what was found is unlike the other photos")
    assert line.endswith("give --box mug-3.png=26,26,38,38 (box 1)")
    with pytest.raises(BadPhoto, match="unlike the other photos"):
        registering.leave_out_doubtful(references[1:], photos[1:], tmp_path / "sheet.png")


def test_leave_one_out_finds_what_the_references_confuse():
    mine = [scene([(26, 26, RED)]), scene([(20, 20, RED)]), scene([(30, 30, RED)])]
    references = choose(mine)
    obj = remember("mug", "cup", [reference.crop for reference in references], MeanColour())
    other = remember("plant", "plant", [scene([(6, 6, GREEN)])], MeanColour())
    fine = leave_one_out(obj, references, {"plant": other}, MeanColour())
    assert (fine.right, fine.n, fine.others, fine.background, fine.by_name) == (3, 3, 1, 0, ())
    assert fine.margin > 0.9
    assert "3 of 3 are elected" in str(fine)
    mixed = [*mine, *mine[:1], scene([(26, 26, (100, 200, 0))])]
    odd = remember("mug", "cup", mixed, MeanColour())
    olive = remember("plant", "plant", [scene([(6, 6, (120, 200, 0))])], MeanColour())
    wrong = leave_one_out(odd, (), {"plant": olive}, MeanColour())
    assert (wrong.right, wrong.n) == (4, 5)
    assert wrong.margin < 0
    assert wrong.by_name == ("plant",)
    few = remember("mug", "cup", mine[:2], MeanColour())
    assert "give 3 or more" in str(leave_one_out(few, (), {"plant": other}, MeanColour()))
    assert "nothing else" in str(leave_one_out(obj, (), {}, MeanColour()))


def test_small_and_odd_references_are_named():
    mixed = [scene([(26, 26, RED)]), scene([(26, 26, RED)]), scene([(26, 26, BLUE)])]
    references = choose(mixed)
    obj = remember("mug", "cup", [reference.crop for reference in references], MeanColour())
    lines = warnings(obj, references, ["a", "b", "c"])
    assert [line for line in lines if line.startswith("c: unlike")]
    assert sum("only" in line for line in lines) == 3
    assert not warnings(obj, whole_photos([np.zeros((80, 80, 3), np.uint8)] * 2), ["a", "b"])


def test_a_video_gives_sharp_frames_spread_over_it(tmp_path):
    rng = np.random.default_rng(0)
    sharp = rng.integers(0, 255, (64, 96, 3)).astype(np.uint8)
    clip = [np.full((64, 96, 3), 128, np.uint8)] * 12
    for i in (2, 7, 9):
        clip[i] = sharp
    path = tmp_path / "mug.mp4"
    with media.Mp4(path, hz=10.0) as file:
        for rgb in clip:
            file.add(rgb)
    chosen = media.sharp_frames(path, 3)
    assert [frame.std() > 20 for frame in chosen] == [True, True, True]
    found = registering.film_photos(path, tmp_path / "frames", 2)
    assert [photo.name for photo in found] == ["mug-1.png", "mug-2.png"]
    assert load_photo(found[0]).shape == (64, 96, 3)
    with pytest.raises(BadPhoto, match="fewer than the 99"):
        media.sharp_frames(path, 99)
    (tmp_path / "no.mp4").write_bytes(b"no video")
    with pytest.raises(BadPhoto, match="cannot be decoded"):
        media.sharp_frames(tmp_path / "no.mp4", 1)


def test_a_photo_of_a_phone_is_read(tmp_path):
    """HEIC turned by EXIF, CMYK, and 12 megapixels."""
    from pillow_heif import register_heif_opener

    register_heif_opener()
    rgb = np.zeros((40, 80, 3), np.uint8)
    rgb[:, :40] = RED
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise
    Image.fromarray(rgb).save(tmp_path / "a.heic", exif=exif.tobytes(), quality=95)
    upright = load_photo(tmp_path / "a.heic", long_side=None)
    assert upright.shape[:2] == (80, 40)
    assert upright[10, 20, 0] > 150
    assert upright[70, 20].max() < 60
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "b.jpg")
    assert load_photo(tmp_path / "b.jpg")[20, 10, 0] > 150
    Image.fromarray(np.zeros((3000, 4000, 3), np.uint8)).save(tmp_path / "c.jpg")
    assert load_photo(tmp_path / "c.jpg", long_side=None).shape == (3000, 4000, 3)


def test_a_folder_gives_its_pictures(tmp_path):
    photos = save(tmp_path / "..", []) + save(tmp_path, [scene([(6, 6, RED)])] * 2)
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "._mug-0.png").write_bytes(b"what macOS writes beside its files")
    assert registering.gather_photos([tmp_path]) == photos
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadPhoto, match="holds no picture"):
        registering.gather_photos([tmp_path / "empty"])
    with pytest.raises(BadPhoto, match="no photos"):
        registering.choose([], "cup", STACK, {}, whole=False)


def test_a_photo_named_twice_is_one(tmp_path):
    for name in ("my mug.png", "other.png"):
        Image.fromarray(scene([(20, 20, RED)])).save(tmp_path / name)
    photo, other = tmp_path / "my mug.png", tmp_path / "other.png"
    again = tmp_path / "." / ".." / tmp_path.name / "my mug.png"
    paths = registering.gather_photos([photo, again, tmp_path, other])
    assert paths == [photo, other]
    with pytest.raises(BadPhoto, match="with one of 'my mug.png', other.png"):
        registering.parse_given(["mug=1,2,3,4"], [], paths)


def test_a_box_none_is_not_given():
    first, _ = choose([scene([(20, 20, RED)]), scene([(22, 22, RED)])], {0: None})
    assert first.chosen_by == "proposed"


@pytest.mark.filterwarnings(
    "ignore:Traits should be given as instances"
)  # the widget library's own
@pytest.mark.parametrize("size", [200, 1600])
def test_the_box_that_is_dragged_is_the_photos(size):
    photo = scene([(20, 20, RED)], size=size, side=40)
    box = np.array([20, 20, 60, 60], np.float32)
    widget = drag_box(photo, box, "mug")
    shown = Image.open(BytesIO(widget.image_bytes))
    assert max(shown.size) == min(size, 800)
    assert dragged_box(widget, photo) == pytest.approx(box)
    scale = shown.size[0] / size
    moved = {"x": -5, "y": 10 * scale, "width": 5 + 30 * scale, "height": 20 * scale}
    widget.bboxes = [*widget.bboxes, moved | {"label": "mug"}]
    assert dragged_box(widget, photo) == pytest.approx([0, 10, 30, 30])
    for side in ("width", "height"):
        widget.bboxes = [moved | {side: 0.4 * scale, "label": "mug"}]
        assert dragged_box(widget, photo) is None, "a click"
    widget.bboxes = []
    assert dragged_box(widget, photo) is None


def test_the_middle_of_a_wide_photo_is_its_middle():
    photo = np.zeros((64, 200, 3), np.uint8)
    photo[26:38, 94:106] = photo[26:38, 26:38] = RED
    (reference,) = choose([photo])
    assert reference.box[:2].tolist() == [94, 26]
