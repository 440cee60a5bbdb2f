"""Photos that cannot be used, in both commands of README: one clear line each; odd ones that can be used are."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command import refused, vap
from tests.scanned import EPS
from vap_core.base.errors import BadPhoto
from vap_core.base.media import photos_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photos that are cut out already, remembered as a mug, and what is wrong with others."""
    folder = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    for i in range(2):
        pixels = rng.integers(0, 255, (90, 70, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"good-{i}.png")
    words = ("--category", "cup", "--whole", "--memory", folder / "bank")
    done = vap("register", "mug", folder / "good-0.png", folder / "good-1.png", *words)
    assert done.returncode == 0, done.stderr
    (folder / "eps.jpg").write_bytes(EPS)
    (folder / "none.jpg").write_bytes(b"")
    (folder / "text.jpg").write_text("a shopping list")
    whole = (folder / "good-0.png").read_bytes()
    (folder / "half.png").write_bytes(whole[: len(whole) // 2])
    (folder / "sub").mkdir()
    (folder / "sub" / "notes.txt").write_text("no photo")
    Image.fromarray(np.full((300, 400), 700, np.uint16)).save(folder / "deep.png")
    return folder


BAD = [
    ("missing.jpg", "missing.jpg is not a file; check the path"),
    ("eps.jpg", "eps.jpg cannot be read as an image"),
    ("none.jpg", "none.jpg is empty; export the photo again"),
    ("text.jpg", "text.jpg cannot be read as an image"),
    ("half.png", "half.png cannot be read as an image"),
    ("deep.png", "8-bit JPEG or PNG"),
    ("sub", "sub holds no picture"),
]


@pytest.mark.parametrize(("name", "message"), BAD)
def test_a_photo_that_cannot_be_used_is_one_line(folder: Path, name: str, message: str) -> None:
    bank = ("--memory", folder / "bank")
    line = refused("register", "new", "--category", "cup", *bank, folder / name)
    assert message in line
    assert len(line.replace(str(folder), "")) <= 200
    line = refused("ground", folder / name, "bring my cup", *bank, "--out", folder / "out")
    assert message in line
    assert not (folder / "out").exists()
    assert not (folder / "bank" / "new.object.safetensors").exists()


@pytest.mark.parametrize(
    "address", ["https://a.example/cup.jpg", "file:///cup.jpg", "s3://b/c.png"]
)
def test_an_address_is_no_photo(address: str, folder: Path) -> None:
    line = refused("ground", address, "bring my cup", "--memory", folder / "bank")
    assert "is an address, and nothing is fetched here; download it" in line


def test_a_damaged_neighbour_is_named_before_anything_is_saved(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "old.object.safetensors").write_bytes(b"damaged")
    words = ("--category", "cup", "--whole", "--memory", tmp_path)
    line = refused("register", "new", folder / "good-0.png", *words)
    assert "old.object.safetensors" in line
    assert [path.name for path in tmp_path.iterdir()] == ["old.object.safetensors"]


@pytest.mark.parametrize("name", ["none", "file.png"])
def test_what_is_no_folder_of_photos_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.png").touch()
    with pytest.raises(BadPhoto, match=f"{name} cannot be read as a folder .*; name a folder of"):
        photos_in(tmp_path / name)


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (2000, 4)])
def test_a_tiny_photo_is_an_answer_or_one_line(folder: Path, tmp_path: Path, size) -> None:
    photo = tmp_path / "tiny.png"
    Image.new("RGB", size, (200, 30, 40)).save(photo)
    bank = ("--memory", folder / "bank")
    done = vap("ground", photo, "bring my cup", *bank, "--out", tmp_path / "out")
    assert "Traceback" not in done.stderr
    assert done.returncode in (0, 2), done.stderr
    if not done.returncode:
        assert "nothing is highlighted" in done.stdout
    line = refused("register", "new", "--category", "cup", *bank, photo)
    assert "tiny.png" in line


def test_printers_colours_and_grey_are_photos(folder: Path, tmp_path: Path) -> None:
    rgb = np.random.default_rng(1).integers(0, 255, (200, 260, 3), np.uint8)
    bank = ("--memory", folder / "bank")
    for mode in ("CMYK", "L"):
        photo = tmp_path / f"{mode}.jpg"
        Image.fromarray(rgb).convert(mode).save(photo)
        done = vap("ground", photo, "bring my cup", *bank, "--out", tmp_path / "out")
        assert done.returncode == 0, done.stderr
        whole = ("--whole", "--replace", "--memory", tmp_path / "bank")
        done = vap("register", "new", "--category", "cup", *whole, photo)
        assert done.returncode == 0, done.stderr
