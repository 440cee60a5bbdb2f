"""The commands that are printed, to be run next: a shell reads back what was meant."""

import ast
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from tests.command import refused, vap
from tests.scanned import put
from vap_core import cli
from vap_core.__main__ import absent_packages
from vap_core.base.errors import an, command, number_of, one_of

ROOT = Path(__file__).resolve().parents[1]
ODD = "a b'c $x"
"""A folder's name that a shell takes apart, unless it is quoted."""


def next_words(said: str) -> list[str]:
    """What a shell makes of the command that was printed."""
    (line,) = re.findall(r"^next: (.*)$", said, re.MULTILINE)
    return shlex.split(line, comments=True)


def test_every_word_and_variable_is_read_back() -> None:
    line = command("view", Path(ODD), "it's", environment={"VAP_SUITES": f"{ODD}/desk.py"})
    words = [f"VAP_SUITES={ODD}/desk.py", "./vap", "view", ODD, "it's"]
    assert shlex.split(line) == words
    assert line.startswith("VAP_SUITES='"), "a quoted name would not be a variable"
    assert command("eval", "--episodes", "4") == "./vap eval --episodes 4"


def test_the_command_after_photographs_is_read_back(tmp_path: Path) -> None:
    out = tmp_path / ODD
    done = vap("objects", "photograph", "cup-personal", "--out", out, "--views", "2")
    photos = [str(path) for path in sorted(out.glob("*.png"))]
    assert next_words(done.stdout) == [
        *("./vap", "register"),
        *("cup-personal", "--category", "cup", *photos),
    ]


def test_the_command_after_an_import_is_read_back(tmp_path: Path) -> None:
    file = put(tmp_path, "mug.stl", trimesh.creation.box((0.05, 0.05, 0.09)))
    words = ("--category", "cup", "--colour", "#aa3322", "--out", tmp_path / ODD)
    done = vap("objects", "import", file, *words)
    assert next_words(done.stdout) == [
        f"VAP_OBJECTS={tmp_path / ODD}",
        *("./vap", "eval", "--suite", "SUITE"),
        *("--object", "mug", "--out", "data/runs/mug"),
    ]


def test_no_command_is_printed_with_a_value_that_is_not_quoted() -> None:
    """`command` writes them; a line of a module's own making left its values unquoted."""
    for path in sorted(Path(cli.__file__).parent.rglob("*.py")):
        found = re.findall(r"""f["'].*\./vap [^"]*\{.*""", path.read_text())
        assert not found, path.name


@pytest.mark.parametrize("words", [("doctor",), ("eval", "--suite", "tabletop")])
def test_another_python_is_told_the_set_up_in_one_line(words: tuple[str, ...]) -> None:
    """It was a traceback about lazy_loader; `doctor` printed that line alone."""
    isolated = [sys.executable, "-S", "-m", "vap_core", *words]
    done = subprocess.run(isolated, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: vap_core's packages are not installed for ")
    assert line.endswith("./vap")
    found = {row.split()[1]: row for row in done.stdout.splitlines()}
    assert set(found) == (
        {"python", "environment", "packages", "pictures", "display"}
        if words == ("doctor",)
        else set()
    )
    if found:
        assert "absent: av, beartype, coacd" in found["packages"]
        assert found["python"].startswith("ok ")


def test_what_runs_without_the_environment_is_python_3_9(tmp_path: Path) -> None:
    for name in ("__init__", "__main__"):
        ast.parse((ROOT / "vap_core" / f"{name}.py").read_text(), feature_version=(3, 9))
    (tmp_path / "pyproject.toml").write_text(
        'dependencies = [\n    "pytest>=1",\n    "no-such>=2",\n]\n'
    )
    assert absent_packages(tmp_path / "pyproject.toml") == ["no-such"]


def test_an_unknown_name_shows_the_nearest_first() -> None:
    """It listed 140 names in the order of the alphabet."""
    objects = [f"object-{i}" for i in range(140)]
    error = str(one_of("eval: object", "camra-personal", [*objects, "camera-personal"]))
    assert error.startswith("eval: object 'camra-personal' is unknown; known: camera-personal, ")
    assert all(name in error for name in objects)
    assert str(one_of("m:", "vpa", ["generic", "vap", "hard"])).endswith(
        "known: vap, generic, hard."
    )
    assert str(one_of("m:", "VPA", ["generic", "vap", "hard"])).endswith("vap, generic, hard.")
    assert str(one_of("m:", "cam", ["a-cam-b", "zzz"])).endswith("known: a-cam-b, zzz.")


@pytest.mark.parametrize(
    ("word", "left"),
    [("~/x.png", "~"), ("--out=~/runs", "~"), ("$HOME/x.png", "$HOME"), ("${PHOTOS}", "${PHOTOS}")],
)
def test_a_word_that_the_shell_did_not_expand_is_refused(word: str, left: str) -> None:
    """--out=~/runs made a folder of that name in silence."""
    said = f"{word}: the shell left {left} as it is; write the path without quotes"
    assert said in refused("ground", word, "bring my cup")
    assert "x.png is not a file" in refused("ground", "x.png", "bring my $5 cup, ~ the red one")


def test_numbers_and_articles_agree_with_their_noun() -> None:
    """ "1 candidates", "a espresso cup"."""
    assert [number_of(n, "photo") for n in (0, 1, 2)] == ["0 photos", "1 photo", "2 photos"]
    assert [an(word) for word in ("espresso cup", "Owl", "cup")] == [
        "an espresso cup",
        "an Owl",
        "a cup",
    ]


def test_the_launcher_runs_from_anywhere_and_says_what_is_absent(tmp_path: Path) -> None:
    """It names the environment of its own folder, also through a link."""
    (tmp_path / "linked").symlink_to(ROOT / "vap")
    done = subprocess.run(
        [tmp_path / "linked", "ablate", "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Usage: ./vap ablate")
    bare = tmp_path / "bare"
    bare.mkdir()
    copied = shutil.copy(ROOT / "vap", bare)
    done = subprocess.run([copied], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == f"error: there is no environment in {bare} yet; run: make setup\n"
