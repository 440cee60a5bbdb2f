"""register: what it replaces, what a refusal leaves as it was, and what can be run next."""

import errno
import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command import Done, refused, vap
from tests.toys import TOYS, MeanColour, scene
from vap_core import get_object, reference_views
from vap_core.base.errors import BadEncoder
from vap_core.base.types import Rgb
from vap_core.memory import load, load_bank
from vap_core.perception import stacks
from vap_core.study.trials import Study, register_personal

RED, GREEN, BLUE = (250, 0, 0), (0, 250, 0), (0, 0, 250)
LONG = "x" * 300


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: TOYS)


@pytest.fixture
def bank(tmp_path: Path) -> Path:
    return tmp_path / "bank"


def photo(path: Path, *colours: tuple[int, int, int]) -> Path:
    squares = [(4 + 20 * i, 26, colour) for i, colour in enumerate(colours)]
    Image.fromarray(scene(squares)).save(path)
    return path


def words_of(bank: Path, name: str, category: str = "cup") -> tuple[str | Path, ...]:
    return ("register", name, "--category", category, "--stack", "toy", "--memory", bank)


def registered(bank: Path, name: str, path: Path, *more: str, category: str = "cup") -> Done:
    done = vap(*words_of(bank, name, category), photo(path, RED), "--whole", *more)
    assert done.returncode == 0, done.stderr
    return done


def damage(path: Path, how: str) -> bytes:
    data = path.read_bytes()
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    else:
        path.write_bytes(data.replace(b'"version":"1"', b'"version":"0"'))
    return path.read_bytes()


@pytest.mark.parametrize("how", ["truncated", "version 0"])
def test_a_damaged_object_is_registered_again(bank: Path, tmp_path: Path, how: str) -> None:
    registered(bank, "vase", tmp_path / "a.png")
    path = bank / "vase.object.safetensors"
    damage(path, how)
    done = registered(bank, "vase", tmp_path / "a.png", "--replace")
    assert not done.stderr
    assert load(path).name == "vase"


def test_of_several_damaged_objects_each_is_registered_again(bank: Path, tmp_path: Path) -> None:
    names = ("jar", "mug", "vase")
    paths = [bank / f"{name}.object.safetensors" for name in names]
    for name in names:
        registered(bank, name, tmp_path / "a.png")
    before = [damage(path, "version 0") for path in paths]
    new = (*words_of(bank, "new"), tmp_path / "a.png", "--whole")
    assert "jar.object.safetensors is version 0" in refused(*new)
    notes = []
    for name in names:
        assert [path.read_bytes() for path in paths[len(notes) :]] == before[len(notes) :]
        done = registered(bank, name, tmp_path / "a.png", "--replace")
        notes.append(done.stderr.count("note: load: "))
    assert notes == [2, 1, 0]
    assert vap(*new).returncode == 0
    assert sorted(load_bank(bank)) == ["jar", "mug", "new", "vase"]


class Odd(MeanColour):
    """Its rows are spoilt, one way or the other."""

    def __init__(self, factor: float) -> None:
        self.factor = np.float32(factor)

    def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
        return self.factor * super().__call__(crops)


@pytest.mark.parametrize(
    ("factor", "fault"), [(np.nan, "numbers that are not finite"), (3.0, "a row of length 3, not")]
)
def test_bad_rows_of_an_encoder_are_one_line(
    bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float, fault: str
) -> None:
    odd = TOYS.with_parts("odd", encoder=Odd(factor))
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: odd)
    photos = [photo(tmp_path / "a.png", RED), photo(tmp_path / "b.png", RED)]
    line = refused(*words_of(bank, "mug"), *photos, "--accept")
    assert f"remember: encoder 'mean-colour' gave {fault}" in line
    assert "pytest --pyargs vap_core.contracts --encoder" in line
    study = Study((("tabletop", "select-cup"),), ("vap",), episodes=1, stack="toy")
    with pytest.raises(BadEncoder, match=f"remember: encoder 'mean-colour' gave {fault}"):
        register_personal(study, bank)
    assert not bank.exists()


@pytest.mark.parametrize("owner", ["", "anna", "Anna Maria"])
def test_what_is_to_be_run_next_runs(bank: Path, tmp_path: Path, owner: str) -> None:
    """Also beside another object of that category, and one of another person's."""
    whose = ("--owner", owner) if owner else ()
    for name, more in (("jar", whose), ("bens", ("--owner", "ben")), ("jar-2", whose)):
        done = registered(bank, name, tmp_path / "a.png", *more, category="jar")
        (line,) = (line for line in done.stdout.splitlines() if line.startswith("next: "))
        words = shlex.split(line.removeprefix("next: ./vap "))
        words[1] = str(tmp_path / "a.png")
        done = vap(*words, "--out", tmp_path / "out")
        assert done.returncode == 0, done.stderr
        assert f"{name} against 1 candidate;" in done.stdout


def test_a_refused_replacement_leaves_the_sheet_of_the_object_that_stays(
    bank: Path, tmp_path: Path
) -> None:
    registered(bank, "mug", tmp_path / "a.png")
    sheet, doubtful = bank / "mug.references.png", bank / "mug.doubtful.png"
    before = sheet.read_bytes()
    two = photo(tmp_path / "two.png", GREEN, BLUE)
    line = refused(*words_of(bank, "mug"), two, "--replace")
    assert "two things in it could be meant" in line
    assert f"Look at {doubtful}" in line
    assert doubtful.exists()
    assert sheet.read_bytes() == before
    done = vap(*words_of(bank, "mug"), two, "--replace", "--accept")
    assert f"look at the crops: {sheet}" in done.stdout
    assert sheet.read_bytes() != before
    assert not doubtful.exists()


def locked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the system says below a folder without rights; root has them all."""

    def refusing(call):
        def called(path=".", *args, **kwargs):
            if not isinstance(path, int) and Path(os.fsdecode(path)).is_relative_to(folder):
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return call(path, *args, **kwargs)

        return called

    for name in ("stat", "lstat", "listdir", "scandir", "mkdir", "open"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))


def test_what_cannot_be_looked_at_is_one_line(
    bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos, clips and memories: names that are too long, and what is below a locked folder."""
    registered(bank, "mug", tmp_path / "a.png")
    with monkeypatch.context() as patch:
        locked(tmp_path / "locked", patch)
        for where, why in ((LONG, "File name too long"), ("locked/in", "Permission denied")):
            for name in (where, f"{where}.mp4"):
                found = ("ground", tmp_path / name, "bring my cup", "--stack", "toy")
                assert f"cannot be read ({why}); check the path" in refused(*found)
            line = refused(*words_of(bank, "new"), tmp_path / where)
            assert f"cannot be read ({why}); check the path" in line
            memory = tmp_path / where
            for command in (
                (
                    "ground",
                    tmp_path / "a.png",
                    "bring my cup",
                    "--stack",
                    "toy",
                    "--memory",
                    memory,
                ),
                (*words_of(memory, "new"), tmp_path / "a.png", "--whole"),
            ):
                line = refused(*command)
                assert f"cannot be read ({why}); " in line
                assert "choose another folder with --memory" in line


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("becher", "the word 'becher': it proposes any object, .* is it English, spelt right"),
        ("botle", "the word 'botle': .*; did you mean bottle"),
        ("cup", ""),
        ("espresso cup", ""),
    ],
)
def test_a_word_that_the_detector_does_not_know_is_noted(
    word: str, said: str, tmp_path: Path
) -> None:
    """It was remembered, and searched for, without a word; status 0 where nothing was found."""
    photo, empty = tmp_path / "photo.png", tmp_path / "empty.png"
    Image.fromarray(reference_views(get_object("cup-personal"), 1)[0]).save(photo)
    Image.new("RGB", (224, 224), (120, 130, 140)).save(empty)
    memory = ("--memory", tmp_path / "memory")
    done = [vap("register", "mine", "--category", word, photo, "--whole", *memory)]
    told = (f"bring my {word}", *memory, "--out", tmp_path / "out")
    done += [vap("ground", picture, *told) for picture in (photo, empty)]
    assert [each.returncode for each in done] == [0, 0, int(bool(said))]
    for each in done:
        assert ("does not know" in each.stderr) is bool(said)
        assert re.search(said, each.stderr)
