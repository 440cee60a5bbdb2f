"""The commands: what they print, what they refuse, and what they say to do."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from tests.command import process, refused, vap
from vap_core.base.files import DATA
from vap_core.cli import app
from vap_core.instruction.context import read_uses
from vap_core.memory import load_bank
from vap_core.perception.describe import WORDS
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.studio import reference_views


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Reference views of the personal cup as picture files, and one more of it and of two look-alikes."""
    folder, paths = tmp_path_factory.mktemp("photos"), []
    for i, rgb in enumerate(reference_views(get_object("cup-personal"), n=5)):
        paths.append(folder / f"mug-{i}.png")
        Image.fromarray(rgb).save(paths[-1])
    return paths


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """One picture of a look-alike, the personal cup and another look-alike side by side, and a box around each."""
    names = ("cup-lookalike-1", "cup-personal", "cup-lookalike-2")
    tiles = [reference_views(get_object(name), n=1, seed=9)[0] for name in names]
    path = tmp_path_factory.mktemp("line") / "line.png"
    Image.fromarray(np.concatenate(tiles, axis=1)).save(path)
    height, width = tiles[0].shape[:2]
    x, y = width // 6, height // 6
    boxes = [(i * width + x, y, (i + 1) * width - x, height - y) for i in range(3)]
    return path, [",".join(map(str, box)) for box in boxes]


@pytest.fixture(scope="module")
def bank(photos: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bank")
    words = ("register", "mug", "--category", "cup", "--memory", folder)
    done = vap(*words, *photos)
    assert done.returncode == 0, done.stderr
    assert "mug: a cup with 5 references" in done.stdout
    assert f"look at the crops: {folder / 'mug.references.png'}" in done.stdout
    assert "vote: each photo left out in turn" in done.stdout or "vote not checked" in done.stdout
    (mug,) = load_bank(folder).values()
    assert mug.description is not None
    assert set(mug.description.long.replace(",", "").split()) <= {*WORDS, "cup"}
    return folder


def test_what_register_and_ground_say_next_can_be_pasted(
    photos: list[Path], tmp_path: Path
) -> None:
    """Where a folder's name has a space."""
    bank, out = tmp_path / "my memory", tmp_path / "my run"
    words = ("--category", "cup", "--whole", "--memory", bank)
    done = vap("register", "mug", *words, photos[0])
    assert f"--memory '{bank}'" in done.stdout, done.stderr
    done = vap("ground", photos[0], "bring my cup", "--memory", bank, "--out", out)
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("wrote "))
    assert line.split(" view ")[1] == f"'{out / photos[0].stem}.rrd'"


def leaves(command: Any, *above: str) -> list[tuple[str, ...]]:
    """Every command, as the words that one types to run it."""
    inner = getattr(command, "commands", {})
    return [words for name, part in inner.items() for words in leaves(part, *above, name)] or [
        above
    ]


COMMANDS = leaves(typer.main.get_command(app))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_has_examples_to_copy_a_line_each(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, [*words, "--help"])
    lines = [line.strip() for line in done.stdout.splitlines() if line.startswith("  Example:")]
    assert done.exit_code == 0
    assert lines
    assert done.stdout.count("Example:") == len(lines)
    assert all(line.startswith(f"Example: ./vap {' '.join(words)}") for line in lines)


def test_help() -> None:
    done = vap("--help")
    assert done.returncode == 0
    assert all(f"  {words[0]} " in done.stdout for words in COMMANDS)


def test_ground_answers_in_json_with_a_picture_and_a_recording(
    line: tuple[Path, list[str]], bank: Path, tmp_path: Path
) -> None:
    image, boxes = line
    hand = [word for box in boxes for word in ("--box", box)]
    words = ("ground", image, "bring my cup", "--object", "mug", "--memory", bank, "--json")
    done = vap(*words, "--out", tmp_path, *hand)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["winner"], answer["instruction"], sum(answer["votes"])) == (
        1,
        "bring the blue cup",  # a heart is red
        5,
    )
    assert np.array(answer["similarity"]).shape == (3, 5)
    assert 0 <= answer["margin"] <= 1
    assert (tmp_path / "line.png").stat().st_size > 20_000
    assert (
        subprocess.run(
            [sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "line.rrd")],
            capture_output=True,
        ).returncode
        == 0
    )
    again = vap("ground", image, "bring my cup", "--memory", bank, "--out", tmp_path, *hand)
    assert "-> #1" in again.stdout
    assert (tmp_path / "line-2.rrd").exists()
    assert not again.stderr
    implicit = ("bring the one I used last", "--parser", "embedding", "--memory", bank)
    done = vap("ground", image, *implicit, "--out", tmp_path, *hand)
    assert "instruction: bring the blue cup" in done.stdout, done.stderr
    down = ("bring my cup", "--parser", "http://127.0.0.1:9/v1", "--memory", bank)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENAI_MODEL", "reader-1")
        assert "is the server up" in refused("ground", image, *down, "--out", tmp_path, *hand)
        done = vap("ground", image, *down, "--fall-back", "--out", tmp_path, *hand)
    assert "instruction: bring the blue cup" in done.stdout
    assert "The rule parses instead." in done.stderr
    assert len(read_uses(bank)) >= 3
    assert {use.object for use in read_uses(bank)} == {"mug"}


def test_ground_says_not_in_view_unless_it_is_to_tint_always(
    photos: list[Path], bank: Path, tmp_path: Path
) -> None:
    """The mug's own photo shows it; one in which its colours are turned round shows another thing."""
    told = ("bring my cup", "--memory", bank, "--out", tmp_path)
    done = vap("ground", photos[0], *told, "--json")
    assert not done.stderr
    answer = json.loads(done.stdout)
    assert (answer["winner"], answer["rejected"]) == (0, None)
    assert answer["likeness"][0] >= answer["threshold"]
    turned = tmp_path / "turned.png"
    Image.fromarray(255 - np.asarray(Image.open(photos[0]).convert("RGB"))).rotate(90).save(turned)
    answer = json.loads(vap("ground", turned, *told, "--json").stdout)
    assert (answer["winner"], answer["instruction"]) == (None, "bring my cup")
    assert answer["likeness"][answer["rejected"]] < answer["threshold"]
    text = vap("ground", turned, *told).stdout
    assert "mug: not in view, likeness" in text
    assert "--always-tint" in text
    answer = json.loads(vap("ground", turned, *told, "--always-tint", "--json").stdout)
    assert answer["instruction"] == "bring the red cup"
    assert (answer["threshold"], answer["rejected"]) == (None, None)


def test_nothing_found_is_an_answer_and_not_an_error(bank: Path, tmp_path: Path) -> None:
    Image.new("RGB", (224, 224), (120, 130, 140)).save(tmp_path / "empty.png")
    words = ("ground", tmp_path / "empty.png", "bring my cup", "--memory", bank, "--json")
    done = vap(*words, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["winner"], answer["votes"], answer["instruction"]) == (None, [], "bring my cup")
    assert [line for line in done.stderr.splitlines() if not line.startswith("note:")] == []
    assert (tmp_path / "out" / "empty.png").exists()


def test_register_stops_at_a_doubtful_photo_and_goes_on_with_its_box(tmp_path: Path) -> None:
    Image.new("RGB", (224, 224), (120, 130, 140)).save(tmp_path / "wall.png")
    words = ("register", "x", "--category", "cup", "--memory", tmp_path / "bank")
    line = refused(*words, tmp_path / "wall.png")
    assert "wall.png: no cup was found in it" in line
    assert "--box wall.png=x0,y0,x1,y1" in line
    assert [path.name for path in (tmp_path / "bank").iterdir()] == ["x.doubtful.png"]
    done = vap(*words, tmp_path / "wall.png", "--box", "wall.png=20,30,70,90")
    assert done.returncode == 0, done.stderr
    assert "only 53x63 pixels" in done.stderr or "only 54x64 pixels" in done.stderr
    (obj,) = load_bank(tmp_path / "bank").values()
    assert len(obj.crops) == 1
    assert "vote not checked: 1 reference;" in done.stdout


def test_register_refuses_bad_photos_and_loses_nothing(
    bank: Path, photos: list[Path], tmp_path: Path
) -> None:
    (tmp_path / "note.txt").write_text("not a picture")
    assert "cannot be read as an image" in refused(
        "register", "x", "--category", "cup", "--memory", bank, photos[0], tmp_path / "note.txt"
    )
    assert "is not a file" in refused(
        "register", "x", "--category", "cup", "--memory", bank, tmp_path / "missing.jpg"
    )
    assert "--replace" in refused(
        "register", "mug", "--category", "cup", "--memory", bank, photos[0]
    )
    assert {path.name for path in bank.iterdir()} - {"history.jsonl"} == {
        "mug.object.safetensors",
        "mug.references.png",
    }
    assert vap("register", "x", "--category", "cup", "--memory", bank).returncode == 2
    assert "cannot name an object" in refused(
        "register", "../x", "--whole", "--category", "cup", "--memory", bank, photos[0]
    )
    assert "cannot be a category" in refused(
        "register", "x", "--whole", "--category", "cup!", "--memory", bank, photos[0]
    )


def test_ground_refuses_what_it_cannot_match(
    line: tuple[Path, list[str]], bank: Path, tmp_path: Path
) -> None:
    image, boxes = line
    common = ("--memory", bank, "--out", tmp_path, "--box", boxes[0])
    assert 'name one as "my <category>"' in refused("ground", image, "bring the cup", *common)
    assert "no 'shoe' is remembered" in refused("ground", image, "bring my shoe", *common)
    assert "known: mug" in refused("ground", image, "bring my cup", "--object", "jug", *common)
    assert "x0,y0,x1,y1" in refused(
        "ground", image, "bring my cup", "--box", "1,2,3", "--memory", bank, "--out", tmp_path
    )
    assert "has no area" in refused(
        "ground", image, "bring my cup", "--box", "9,9,3,3", "--memory", bank, "--out", tmp_path
    )
    assert "known: embedded" in refused(
        "ground", image, "bring my cup", "--stack", "psychic", *common
    )
    beyond = refused(
        "ground",
        image,
        "bring my cup",
        "--box",
        "10,10,961,40",
        "--memory",
        bank,
        "--out",
        tmp_path,
    )
    assert "'10,10,961,40' is no box inside the picture, which has 960x320 pixels" in beyond


def test_ground_refuses_a_damaged_memory(
    line: tuple[Path, list[str]], bank: Path, tmp_path: Path
) -> None:
    whole = next(bank.iterdir()).read_bytes()
    (tmp_path / "mug.object.safetensors").write_bytes(whole[: len(whole) // 2])
    assert "register the object again" in refused(
        "ground", line[0], "bring my cup", "--memory", tmp_path, "--box", line[1][1]
    )


def test_rollout_refuses_unknown_names_and_foreign_folders(tmp_path: Path) -> None:
    out = ("--out", tmp_path / "run")
    line = refused("rollout", "--suite", "simpler", "--task", "pick-cup", *out)
    nearest, rest = {"simpler-bridge", "simpler-fractal"}, {"franka-pick", "tabletop", "vlabench"}
    assert set(line.rpartition("known: ")[2].split(", ")[:2]) == nearest
    assert all(name in line for name in rest)
    assert "pick-bottle" in refused(
        "rollout", "--suite", "widowx-pick", "--task", "pick-moon", *out
    )
    assert "known: generic" in refused(
        "rollout", "--suite", "widowx-pick", "--task", "pick-cup", "--method", "magic", *out
    )
    assert "known: expert, mini-pi0, random, scripted" in refused(
        "rollout", "--suite", "widowx-pick", "--task", "pick-cup", "--policy", "pi9", *out
    )
    assert not (tmp_path / "run").exists()
    (tmp_path / "thesis.txt").write_text("dear")
    assert "choose another folder" in refused(
        "rollout", "--suite", "widowx-pick", "--task", "pick-cup", "--out", tmp_path
    )
    assert "cannot be written" in refused(
        "rollout", "--suite", "widowx-pick", "--task", "pick-cup", "--out", "/proc/run"
    )


def test_a_picture_in_the_output_folder_is_never_overwritten(
    line: tuple[Path, list[str]], bank: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.png"
    mine.write_bytes(line[0].read_bytes())
    done = vap(
        "ground", mine, "bring my cup", "--memory", bank, "--out", tmp_path, "--box", line[1][1]
    )
    assert done.returncode == 0, done.stderr
    assert "the only candidate" in done.stdout
    assert mine.read_bytes() == line[0].read_bytes()
    assert (tmp_path / "mine-2.png").exists()


def test_show_refuses_what_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "x.rrd").write_bytes(b"RRF2garbage")
    assert "x.rrd" in refused("view", tmp_path / "x.rrd", "--png", tmp_path / "x.png")


def test_doctor_finds_this_machine_able() -> None:
    done = process("doctor")
    assert done.returncode == 0, done.stdout
    assert "MISSING" not in done.stdout
    assert "stack foundation" in done.stdout


def test_doctor_fails_where_nothing_can_be_rendered() -> None:
    code = "import os, sys; os.environ['MUJOCO_GL'] = 'nonsense'; sys.argv = ['vap_core', 'doctor']; from vap_core.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "MISSING" in done.stdout


def test_what_cannot_be_shown_is_said_before_anything_is_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It was said after 25 to 60 seconds, in which the episode was run again."""
    table = DATA / "results" / "mini_pi0.parquet"
    words = ("diagnose", table, "--suite", "simpler-bridge", "--method", "vap", "--open", "0")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    def run_again(*_: object, **__: object) -> None:
        raise AssertionError("the episode is run")

    monkeypatch.setattr("vap_core.study.failures.recording_to_show", run_again)
    assert "there is no display for a window; add --png FILE" in refused(*words)
    monkeypatch.setattr("vap_core.recording.show.has_driver", lambda: False)
    line = refused(*words, "--png", tmp_path / "a.png")
    assert "apt-get install -y mesa-vulkan-drivers" in line


def test_an_empty_memory_names_its_folder(
    line: tuple[Path, tuple[str, ...]], tmp_path: Path
) -> None:
    """It said that "the memory holds nothing", and not which."""
    empty = tmp_path / "nothing-here"
    told = refused("ground", line[0], "bring my cup", "--memory", empty)
    assert f"ground: {empty} holds no object; register one there, or name another folder" in told
