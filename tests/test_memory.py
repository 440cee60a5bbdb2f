"""Photos in, objects out and back; every damaged input is one clear line and loses nothing."""

import errno
import json
import os
import struct
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.scanned import EPS, fake_ghostscript
from tests.toys import TOYS, MeanColour, personal, scene
from vap_core.base.errors import BadEncoder, BadMemory, BadOutput, BadPhoto
from vap_core.base.media import photos_in
from vap_core.base.types import Description, Rgb
from vap_core.memory import (
    kind_instead,
    load,
    load_bank,
    load_photo,
    reference_rows,
    register,
    remember,
    save,
)

TEAL = (40, 120, 110)


@given(
    st.lists(st.tuples(*[st.integers(1, 255)] * 3), min_size=1, max_size=6),
    st.sampled_from(["mug", "my owl.2", "a_b-c"]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20)
def test_save_then_load_is_the_same_object(
    tmp_path: Path, colours: list[tuple[int, int, int]], name: str
) -> None:
    obj = personal(name, "cup", *colours)
    back = load(save(tmp_path, obj, replace=True), obj.encoder)
    assert (back.name, back.category, back.encoder) == (obj.name, obj.category, obj.encoder)
    assert (back.embeddings == obj.embeddings).all()
    assert all((a == b).all() for a, b in zip(back.crops, obj.crops, strict=True))


def test_register_crops_with_the_detector() -> None:
    obj, whole = register(
        "mug",
        " Cup ",
        [scene([(4, 8, TEAL)]), scene([(30, 30, TEAL)])],
        TOYS.detector,
        TOYS.encoder,
    )
    assert (obj.category, len(obj.crops), whole) == ("cup", 2, ())
    assert all(crop.shape[0] < 40 for crop in obj.crops)


def test_register_uses_the_whole_photo_where_nothing_is_found() -> None:
    photo = scene([(4, 8, TEAL)])
    obj, whole = register("mug", "nothing", [photo], TOYS.detector, TOYS.encoder)
    assert whole == (0,)
    assert (obj.crops[0] == photo).all()


@pytest.mark.parametrize(
    ("name", "category", "photos", "error"),
    [
        ("../escape", "cup", 1, "cannot name an object"),
        ("mug", " ", 1, "cannot be a category"),
        ("mug", "my cup", 1, "'my cup' cannot be a category; .* alone, .* --category cup\\."),
        ("mug", "The  Coffee cup", 1, "alone, .* --category 'coffee cup'"),
        ("mug", "the my cup", 1, "alone, .* --category cup\\."),
        ("mug", "an apple", 1, "alone, .* --category apple"),
        ("mug", "my", 1, "'my' cannot be a category; .* alone, .* --category cup\\."),
        ("mug", "Their", 1, "'Their' cannot be a category; .* --category cup\\."),
        ("mug", "the my", 1, "'the my' cannot be a category; .* --category cup\\."),
        ("mug", "a my", 1, "'a my' cannot be a category; .* --category cup\\."),
        ("grün", "cup", 1, "use a letter a to z or a digit, .* at most 64 characters\\."),
        ("m" * 65, "cup", 1, "use a letter a to z or a digit, .* at most 64 characters\\."),
        ("mug", "cup", 0, "has no photos; give at least one"),
    ],
)
def test_register_says_what_is_missing(name: str, category: str, photos: int, error: str) -> None:
    pictures = [scene([(4, 8, TEAL)])] * photos
    with pytest.raises((BadMemory, BadPhoto), match=error):
        register(name, category, pictures, TOYS.detector, TOYS.encoder)
    with pytest.raises((BadMemory, BadPhoto), match=error):
        remember(name, category, pictures, TOYS.encoder)


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ([[np.nan, 0.0]], "numbers that are not finite"),
        ([[3.0, 4.0]], "a row of length 5, not of length 1"),
        (
            [[1.0, 0.0], [1.0, 0.0]],
            r"ndarray float32 \(2, 2\), not ndarray float32 \(1 crops, width\)",
        ),
    ],
)
def test_bad_rows_are_not_remembered(rows: list[list[float]], fault: str) -> None:
    class Odd:
        name = "odd"

        def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
            return np.array(rows, np.float32)

    with pytest.raises(
        BadEncoder, match=f"remember: encoder 'odd' gave {fault}; test it"
    ) as caught:
        remember("mug", "cup", [scene([(4, 8, TEAL)])], Odd())
    assert "pytest --pyargs vap_core.contracts --encoder MODULE:NAME" in str(caught.value)


@pytest.mark.parametrize("category", ["a", "anorak", "a-frame", "theatre mask", "mylar bag"])
def test_what_only_begins_like_an_article_is_a_category(category: str) -> None:
    assert kind_instead(category) == ""


def test_an_object_is_never_overwritten_unasked(tmp_path: Path) -> None:
    save(tmp_path, personal("mug", "cup", TEAL))
    with pytest.raises(BadOutput, match="--replace"):
        save(tmp_path, personal("mug", "cup", (9, 9, 9)))
    assert (load_bank(tmp_path)["mug"].crops[0] == TEAL).all()


def test_of_two_that_register_one_name_at_once_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encode = safetensors.numpy.save

    def encode_late(*args: object, **kwargs: object) -> bytes:
        monkeypatch.setattr(safetensors.numpy, "save", encode)
        save(tmp_path, personal("mug", "cup", TEAL))  # what another process does meanwhile
        return encode(*args, **kwargs)

    monkeypatch.setattr(safetensors.numpy, "save", encode_late)
    with pytest.raises(BadOutput, match="exists; choose another name or pass --replace"):
        save(tmp_path, personal("mug", "cup", (9, 9, 9)))
    assert (load_bank(tmp_path)["mug"].crops[0] == TEAL).all()
    assert len(list(tmp_path.iterdir())) == 1


def test_equal_objects_are_equal_bytes(tmp_path: Path) -> None:
    mug = remember("mug", "cup", [np.full((4, 4, 3), TEAL, np.uint8)], TOYS.encoder)
    files = {save(tmp_path / str(i), mug).read_bytes() for i in range(6)}
    assert len(files) == 1


@pytest.mark.parametrize("name", ["../../x", "\x1b[31mred", ".hidden", "a/b"])
def test_an_object_of_a_bad_name_is_not_saved(tmp_path: Path, name: str) -> None:
    mug = remember("mug", "cup", [np.full((4, 4, 3), TEAL, np.uint8)], TOYS.encoder)
    with pytest.raises(BadMemory, match="cannot name an object"):
        save(tmp_path / "bank", replace(mug, name=name))
    assert not list(tmp_path.iterdir())


def test_what_a_killed_save_left_is_removed_when_it_is_old(
    tmp_path: Path,
) -> None:
    mug = remember("mug", "cup", [np.full((4, 4, 3), TEAL, np.uint8)], TOYS.encoder)
    old, young = tmp_path / ".a.1.tmp", tmp_path / ".b.2.tmp"
    for scratch in (old, young):
        scratch.write_bytes(b"half")
    os.utime(old, (0, 0))
    save(tmp_path, mug)
    assert not old.exists()
    assert young.exists()


def test_a_bank_may_be_named_by_text(tmp_path: Path) -> None:
    mug = remember("mug", "cup", [np.full((4, 4, 3), TEAL, np.uint8)], TOYS.encoder)
    path = save(str(tmp_path), mug)
    assert load(str(path)).name == "mug"
    assert list(load_bank(str(tmp_path))) == ["mug"]


def test_a_bank_in_a_file_is_no_bank(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadOutput, match="choose another folder"):
        save(tmp_path / "file", personal("mug", "cup", TEAL))


def test_empty_bank_is_empty(tmp_path: Path) -> None:
    assert load_bank(tmp_path / "none") == {}


@given(st.text(min_size=1, max_size=40), st.text(max_size=40))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=10)
def test_what_an_object_looks_like_is_kept_in_words(tmp_path: Path, short: str, long: str) -> None:
    told = Description(short, long)
    back = load(
        save(tmp_path, replace(personal("mug", "cup", TEAL), description=told), replace=True)
    ).description
    assert back is not None
    assert (back.short, back.long) == (short, long)


def test_a_memory_from_before_descriptions_still_loads(tmp_path: Path) -> None:
    path = save(tmp_path, personal("mug", "cup", TEAL))
    assert b"description" not in path.read_bytes()
    assert load(path).description is None


@pytest.mark.parametrize(
    ("field", "value"),
    [("name", "../../x"), ("name", "cup"), ("name", "\x1b[31mmug"), ("category", "a\x1b[2Jb")],
)
def test_a_file_is_not_believed_about_its_name(tmp_path: Path, field: str, value: str) -> None:
    path = save(tmp_path, personal("mug", "cup", TEAL))
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"][field] = value
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    with pytest.raises(BadMemory, match="register the object again") as caught:
        load_bank(tmp_path)
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize("where", ["header", "description"])
def test_json_nested_too_deep_is_said(tmp_path: Path, where: str) -> None:
    deep = "[" * 100_000
    path = save(tmp_path, personal("mug", "cup", TEAL))
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["description"] = deep
    text = (deep if where == "header" else json.dumps(header)).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    with pytest.raises(BadMemory, match="register the object again"):
        load(path)


@pytest.mark.parametrize(
    "odd", ['"[1]"', '"{}"', '"null"', r'"{\"short\": 3, \"long\": \"x\"}"', '"not json"']
)
def test_a_damaged_description_is_said(tmp_path: Path, odd: str) -> None:
    path = save(
        tmp_path, replace(personal("mug", "cup", TEAL), description=Description("red", "all red"))
    )
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["description"] = json.loads(odd)
    told = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(told)) + told + data[8 + size :])
    with pytest.raises(BadMemory, match="lacks what an object needs.*register the object again"):
        load(path)


@pytest.mark.parametrize("cut", [0, 4, 30, -1])
def test_a_damaged_memory_is_said(tmp_path: Path, cut: int) -> None:
    path = save(tmp_path, personal("mug", "cup", TEAL))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(BadMemory, match="damaged.*register the object again"):
        load(path)


def test_another_version_is_said(tmp_path: Path) -> None:
    path = save(tmp_path, personal("mug", "cup", TEAL))
    path.write_bytes(path.read_bytes().replace(b'"version":"1"', b'"version":"9"'))
    with pytest.raises(BadMemory, match="version 9, this program reads version 1"):
        load(path)


def test_a_lying_header_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "x.object.safetensors"
    path.write_bytes(struct.pack("<Q", 2**60) + b"{}")
    with pytest.raises(BadMemory, match="damaged"):
        load(path)


def test_another_encoder_is_said(tmp_path: Path) -> None:
    path = save(tmp_path, personal("mug", "cup", TEAL))
    with pytest.raises(BadMemory, match="mean-colour.*register the object again"):
        load(path, "dinov2")


@pytest.mark.parametrize("call", ["read_bytes", "iterdir"])
def test_a_memory_that_cannot_be_read_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    save(tmp_path, personal("mug", "cup", TEAL))

    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, call, refuse)
    with pytest.raises(BadMemory, match="cannot be read .Permission denied.; check its perm"):
        load_bank(tmp_path)


def write(path: Path, kind: str) -> Path:
    if kind == "missing":
        return path
    if kind == "long":
        return path.with_name("x" * 300)
    if kind == "huge":
        Image.new("1", (9000, 9000)).save(path)
    else:
        path.write_bytes(
            {"empty": b"", "text": b"hello", "cut": b"\x89PNG\r\n\x1a\n" + b"\0" * 30}[kind]
        )
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("long", "cannot be read .File name too long.; check the path"),
        ("missing", "is not a file"),
        ("empty", "is empty"),
        ("text", "cannot be read as an image"),
        ("cut", "cannot be read"),
        ("huge", "scale it down"),
    ],
)
def test_bad_photos(tmp_path: Path, kind: str, message: str) -> None:
    with pytest.raises(BadPhoto, match=message):
        load_photo(write(tmp_path / "photo.png", kind))


@pytest.mark.parametrize("side", [9750, 30_000])
def test_a_photo_that_is_far_too_large_is_one_line(tmp_path: Path, side: int) -> None:
    """Pillow warns above 89 megapixels, and refuses above 178; the file is a header alone."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    header = struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    data = struct.pack(">I", 9) + b"IDAT" + b"x" * 13
    (tmp_path / "photo.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises(BadPhoto, match="over 50 million.*; scale it down"):
            load_photo(tmp_path / "photo.png")
    assert not caught


def test_a_photo_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = fake_ghostscript(tmp_path, monkeypatch)
    (tmp_path / "a.jpg").write_bytes(EPS)
    with pytest.raises(BadPhoto, match="is none of JPEG, PNG, WEBP, .*export it as JPEG"):
        load_photo(tmp_path / "a.jpg")
    assert not marker.exists()


def test_whatever_a_decoder_raises_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")

    def decode(image: Image.Image) -> None:
        raise RuntimeError("decoder failed " * 40)

    monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.load", decode)
    with pytest.raises(BadPhoto, match="cannot be read as an image .decoder failed") as caught:
        load_photo(tmp_path / "a.png")
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF", "AVIF"])
def test_ordinary_formats_are_read(tmp_path: Path, kind: str) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.photo", kind)
    assert load_photo(tmp_path / "a.photo").shape == (6, 8, 3)


@pytest.mark.parametrize(
    ("name", "kind"), [("a.jfif", "JPEG"), ("a.JPE", "JPEG"), ("a.mpo", "MPO"), ("a.jpg", "MPO")]
)
def test_a_jpeg_of_another_suffix_is_a_photo(tmp_path: Path, name: str, kind: str) -> None:
    """Windows saves .jfif, and two-lens cameras .mpo, whose first picture is read."""
    second = Image.new("RGB", (8, 6), (0, 0, 250))
    more = {"save_all": True, "append_images": [second]} if kind == "MPO" else {}
    Image.new("RGB", (8, 6), (250, 0, 0)).save(tmp_path / name, kind, **more)
    (path,) = photos_in(tmp_path)
    rgb = load_photo(path)
    assert rgb.shape == (6, 8, 3)
    assert rgb[..., 0].min() > 240


def test_photos_are_turned_upright_and_shrunk(tmp_path: Path) -> None:
    image = Image.fromarray(np.zeros((20, 4000, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.jpg", exif=exif)
    assert load_photo(tmp_path / "a.jpg").shape == (1024, 5, 3)
    assert load_photo(tmp_path / "a.jpg", long_side=None).shape == (4000, 20, 3)


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK"])
def test_every_colour_mode_becomes_rgb(tmp_path: Path, mode: str) -> None:
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.new(mode, (8, 6)).save(path)
    assert load_photo(path).shape == (6, 8, 3)


def test_grey_stands_where_a_photo_is_transparent(tmp_path: Path) -> None:
    erased = Image.new("RGBA", (4, 2), (10, 200, 30, 0))
    erased.putpixel((0, 0), (10, 200, 30, 255))
    erased.save(tmp_path / "cutout.png")
    rgb = load_photo(tmp_path / "cutout.png")
    assert rgb[0, 0].tolist() == [10, 200, 30]
    assert rgb[1, 3].tolist() == [127, 127, 127]
    indexed = Image.new("P", (4, 2))
    indexed.putpalette([10, 200, 30])
    indexed.save(tmp_path / "indexed.png", transparency=0)
    assert load_photo(tmp_path / "indexed.png")[0, 0].tolist() == [127, 127, 127]


def test_an_encoder_need_not_be_hashable() -> None:
    """A plain dataclass is not; its rows are made once an encoder, not once a name."""

    @dataclass
    class Plain(MeanColour):
        sign: float
        name: str = "plain"

        def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
            return np.float32(self.sign) * super().__call__(crops)

    obj = personal("mug", "cup", TEAL)
    for sign in (1.0, -1.0):
        assert np.array_equal(reference_rows(obj, Plain(sign)), np.float32(sign) * obj.embeddings)


def test_what_macos_writes_beside_a_memory_file_is_no_object(tmp_path: Path) -> None:
    save(tmp_path, personal("mug", "cup", (200, 30, 30)))
    (tmp_path / "._mug.object.safetensors").write_bytes(b"Mac OS X")
    assert list(load_bank(tmp_path)) == ["mug"]
