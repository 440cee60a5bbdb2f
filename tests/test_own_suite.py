"""A suite of one's own from a Python file: the documented one runs; what is wrong in a file is one line."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import pytest
from gymnasium.envs import registration

from tests.command import process, refused, vap
from vap_core.base.errors import BadSuite, UnknownName
from vap_core.rollout.loop import rollout
from vap_core.simulation import gym_env, robots, suites
from vap_core.simulation.suites import own
from vap_core.simulation.suites.open_row import open_row
from vap_core.simulation.types import EpisodeRow
from vap_core.study.report import rescore
from vap_core.study.results import command_line, load_runs, provenance
from vap_core.study.store import read, read_manifest
from vap_core.study.trials import Study, feasible, make_trial

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs/extend.md").read_text(), re.DOTALL)
(DOCUMENTED,) = (block for block in BLOCKS if "SUITE = Suite(" in block)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The documented suite as a file; what is opened in a test is forgotten after it."""
    monkeypatch.setattr(own, "OPENED", {})
    suites._seeded.cache_clear()
    suites.benchmark.cache_clear()
    path = tmp_path / "desk.py"
    path.write_text(DOCUMENTED)
    return path


def test_the_documented_suite_is_a_suite_like_any_other(file: Path) -> None:
    suite = suites.open_file(file)
    assert suites.suite(suite.name) is suite
    (task,) = suite.tasks
    rows = suites.rows(suite.name, task.name)
    assert len(rows) == 6
    assert suites.rows(suite.name, task.name, 2) == (rows[0], rows[5])
    moved = suites.rows(suite.name, task.name, seed=1)[0]
    assert moved.start.offsets, "a seed moves the start, as in the benchmarks"
    assert len(suites.digest(suite.name)) == 64
    assert feasible(rows[:1]) == (True,)


def test_a_file_is_executed_once(file: Path) -> None:
    assert suites.open_file(file) is suites.open_file(file)


def test_other_commands_find_it_by_the_environment(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UnknownName, match="your own by its file or VAP_SUITES"):
        suites.suite("my-desk")
    monkeypatch.setenv("VAP_SUITES", str(file))
    assert suites.suite("my-desk").robot == "wx250s"


def test_gymnasium_finds_it_by_the_environment(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its instruction has a letter that is not English, which ended the workers."""
    told = "hebe die Tüte auf, pick up my bottle"
    file.write_text(DOCUMENTED.replace("pick up my bottle", told))
    monkeypatch.setenv("VAP_SUITES", str(file))
    monkeypatch.setattr(registration, "registry", dict(registration.registry))
    name = gym_env.env_id("my-desk", "pick-bottle")
    assert name not in registration.registry
    gym_env.register()
    # Spawned: a fork of this process, whose other threads may hold a lock, can wait for ever.
    makers = [partial(gymnasium.make, f"{gym_env.__name__}:{name}", image_size=32)]
    for shared in (True, False):
        both = gymnasium.vector.AsyncVectorEnv(makers, shared_memory=shared, context="spawn")
        seen, _ = both.reset(seed=0)
        assert seen["images"]["front"].any()
        assert shared or seen["instruction"] == (told,)
        assert seen in both.observation_space
        both.close()


def test_a_damaged_suite_of_the_environment_is_said_at_registration(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text("SUITE = 3\n")
    monkeypatch.setenv("VAP_SUITES", str(file))
    with pytest.raises(BadSuite, match=r"desk\.py must define SUITE"):
        gym_env.register()
    imports = [sys.executable, "-c", "import vap_core.simulation.gym_env"]
    done = subprocess.run(imports, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "desk.py must define SUITE" in done.stderr
    assert "Its tasks are no environments." in done.stderr


def test_a_run_of_a_suite_that_is_not_open_names_the_remedy(file: Path) -> None:
    with pytest.raises(UnknownName, match="your own by its file or VAP_SUITES"):
        suites.digest("my-desk")


@pytest.mark.slow
def test_the_commands_told_at_the_end_find_the_suite_and_are_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own, "OPENED", {})
    suites.benchmark.cache_clear()
    (tmp_path / "my desk").mkdir()
    file = tmp_path / "my desk" / "desk.py"
    file.write_text(DOCUMENTED.replace("max_steps=60", "max_steps=4"))
    words = ("eval", "--suite", file, "--policy", "expert", "--episodes", 1, "--record", "none")
    out = tmp_path / "my desk" / "run"
    done = process(*words, "--workers", 1, "--out", out, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (command,) = re.findall("tables, paired tests, a page: (.*)", done.stdout)
    setting, *rest = shlex.split(command)
    assert (setting, rest) == (
        f"VAP_SUITES={file}",
        ["./vap", "report", str(out)],
    )
    told = run_as_told(command, tmp_path)
    assert told.returncode == 0, told.stderr
    without = vap("report", out)
    assert without.returncode == 2
    assert without.stderr.endswith(f"An own suite is found by its file: {command}\n")
    monkeypatch.setenv("VAP_SUITES", str(file))
    (line,) = provenance(load_runs([out])).command
    assert line.startswith(f"VAP_SUITES={shlex.quote(str(file))} ./vap eval --suite ")
    again = run_as_told(f"{line} --record none --workers 1 --out again", tmp_path)
    assert again.returncode == 0, again.stderr
    assert read_manifest(tmp_path / "again")["digest"] == read_manifest(out)["digest"]


def run_as_told(command: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    """A printed command, run by a shell in a folder."""
    return subprocess.run(
        command.replace(" ./vap ", f" {shlex.quote(sys.executable)} -m vap_core "),
        shell=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


def test_the_reports_command_finds_the_suite(file: Path) -> None:
    """It could not be run: a run keeps no file of its suites."""
    suites.open_file(file)
    study = {
        "tasks": [["my-desk", "pick-bottle"]],
        "methods": ["vap"],
        "policy": "expert",
        "episodes": None,
        "seed": 0,
    }
    assert shlex.split(command_line(study))[:4] == [
        f"VAP_SUITES={file}",
        *("./vap", "eval", "--suite"),
    ]
    several = {**study, "tasks": [*study["tasks"], ["simpler-bridge", "pick-shaver"]]}
    assert f"suite_files=({str(file)!r},)" in command_line(several), "told in code"
    other = {**study, "tasks": [["simpler-bridge", "pick-shaver"]], "episodes": 2}
    assert command_line(other).startswith("./vap rollout")


@pytest.mark.parametrize("name", ["simpler-bridge", "my-absent"])
def test_the_environment_takes_no_name_that_is_another_suites(
    file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A list of one's own was run under the benchmark's name."""
    file.write_text(DOCUMENTED.replace('"my-desk"', f'"{name}"'))
    monkeypatch.setenv("VAP_SUITES", str(file))
    with pytest.raises(BadSuite, match=f"another suite '{name}'|the name '{name}' will not do"):
        suites.digest("simpler-bridge")


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("import numpy as np", "import nothing"), r"desk\.py, line \d+: ModuleNotFoundError"),
        (("import numpy as np", "def"), r"desk\.py, line \d+: SyntaxError"),
        (("SUITE = Suite(", "DESK = Suite("), r"desk\.py.*NameError|must define SUITE"),
        (("def rows", "def episodes"), "must define SUITE"),
        (('"wx250s"', '"wx25"'), r"no robot 'wx25'|robot.*'wx25'"),
        (('("front",)', '("back",)'), "camera 'back'"),
        (("hz=5.0", "hz=10.0"), "wx250s is controlled at hz=5, and not 10"),
        (('"my-desk"', '"tabletop"'), "another suite 'tabletop'"),
        (('"my-desk"', '"my-absent"'), "the name 'my-absent' will not do"),
        (('"my-desk"', '"../desk"'), "the name '../desk' will not do"),
        (("bottle-lookalike-1", "bottle-lookalike-99"), "bottle-lookalike-99"),
        (("PICK, episode,", "PICK, 0,"), "is there twice"),
        (('("front",)', "()"), r"desk\.py: cameras is empty; wx250s has front\.$"),
        (
            ('category="bottle"', 'category="botle"'),
            r"task pick-bottle: the instruction 'pick up my bottle' asks for my bottle, and the "
            r"category is 'botle'; write \"my botle\" in it once, or correct the category\.$",
        ),
        (("up my bottle", "up the bottle"), "task pick-bottle: .* names no personal object; write"),
        (("up my bottle", "up my cup"), "asks for my cup, and the category is 'bottle'; write"),
        (
            ("up my bottle", "up my bottle and my cup"),
            "asks for my bottle and my cup, and the category is 'bottle'; write",
        ),
        (
            ('"bottle-personal", "bottle-lookalike-1"', '"cup-personal", "bottle-lookalike-1"'),
            r"row my-desk\.pick-bottle\.000: its first object, the target, is cup-personal, a cup, "
            "and the task's category is 'bottle'; place the target first, or correct",
        ),
        (
            ("tuple(places))", "tuple(places), seed=3)"),
            r"row my-desk\.pick-bottle\.000 has seed=3; leave it 0: seeds come from --seed\.",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_that_names_the_file(
    file: Path, edit: tuple[str, str], words: str
) -> None:
    assert edit[0] in DOCUMENTED
    file.write_text(DOCUMENTED.replace(*edit))
    with pytest.raises(BadSuite, match=words) as refusal:
        suites.open_file(file)
    assert "desk.py" in str(refusal.value)
    assert "\n" not in str(refusal.value)


RETURNS = "return episodes made by SUITE.row(task, episode, placements)."


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("import sys; sys.exit(0)", "let the file end by itself, with SUITE and rows()."),
        ("import sys; yield sys.exit()", "let the file end by itself, with SUITE and rows()."),
        ("return None", f"rows() returned NoneType; {RETURNS}"),
        ("return [1, 2]", f"rows() returned int as an episode; {RETURNS}"),
        ("pass", f"rows() returned NoneType; {RETURNS}"),
        ("return 'ab'", f"rows() returned str as an episode; {RETURNS}"),
    ],
)
def test_rows_that_are_no_episodes_are_one_line(file: Path, body: str, words: str) -> None:
    file.write_text(f"{DOCUMENTED}\n\ndef rows():\n    {body}\n")
    with pytest.raises(BadSuite) as refusal:
        suites.open_file(file)
    said = str(refusal.value)
    assert said.endswith(words)
    assert "\n" not in said
    if "exit" in body:
        line = len(file.read_text().splitlines())
        assert f"desk.py, line {line}: sys.exit(" in said


def test_a_task_of_a_name_that_is_there_is_refused(file: Path) -> None:
    """Each episode of it would be run twice."""
    file.write_text(DOCUMENTED.replace("(PICK,)", "(PICK, PICK)"))
    with pytest.raises(
        BadSuite, match="two tasks of pick-bottle, pick-bottle have one name; rename one"
    ) as refusal:
        suites.open_file(file)
    assert "desk.py" in str(refusal.value)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("hz=5.0", "hz=5"), "hz is 5; it must be a float, as in 5.0."),
        (("y0=-0.15", "y0=0"), "y0 is 0; it must be a float, as in 0.0."),
        (("y0=-0.15", 'y0="a"'), "y0 is 'a'; it must be a float."),
        (
            ('("front",)', '["front"]'),
            "cameras is ['front']; it must be a tuple, in round brackets.",
        ),
        (("(PICK,)", "[PICK]"), "...; it must be a tuple, in round brackets."),
        (
            ("(PICK,)", '(PICK,), control="hand"'),
            "control is 'hand'; it must be of type Literal['ee', 'joint'].",
        ),
        (("max_steps=60", "max_steps=60.0"), "max_steps is 60.0; it must be of type int."),
    ],
)
def test_a_field_of_another_type_is_one_short_line(
    file: Path, edit: tuple[str, str], words: str
) -> None:
    assert edit[0] in DOCUMENTED
    file.write_text(DOCUMENTED.replace(*edit))
    with pytest.raises(BadSuite) as refusal:
        suites.open_file(file)
    said = str(refusal.value).removeprefix(f"suites: {file}, line ")
    assert said.endswith(words)
    assert "\n" not in said
    assert len(said) < 150


def test_a_row_without_cameras_has_its_suites_everywhere(file: Path, tmp_path: Path) -> None:
    text = DOCUMENTED.replace('"wx250s", hz=5.0', '"panda", hz=10.0')
    text = text.replace("x0=0.20, x1=0.32", "x0=0.40, x1=0.52")
    text = text.replace("SUITE.row(", "without_cameras(")
    text += """

def without_cameras(*of_row):
    from dataclasses import replace

    return replace(SUITE.row(*of_row), cameras=())
"""
    file.write_text(text)
    study = Study(
        (("my-desk", "pick-bottle"),), ("generic",), policy="random", suite_files=(str(file),)
    )
    row = replace(study.rows("my-desk", "pick-bottle")[0], max_steps=1)
    assert row.cameras == ()
    trial = make_trial(study, [row], "generic", tmp_path / "bank")
    (episode,) = rollout(trial, [row])
    with open_row(row) as env:
        opened = [camera.name for camera in env.cameras()]
    assert [camera.name for camera in episode.header.cameras] == opened == ["front"]


def listed_rows(robot: str) -> list[EpisodeRow]:
    """Every row of every list for a robot; 200 of each task of the warm-up suites."""
    found: list[EpisodeRow] = []
    for name in (*suites.BENCHMARKS, *suites.SHARED, *(f"{n}-dev" for n in suites.BENCHMARKS)):
        if suites.suite(name).robot == robot:
            found.extend(suites.benchmark(name))
    for name, suite in suites.WARM_UPS.items():
        if suite.robot == robot:
            for task in suite.tasks:
                found.extend(suites.rows(name, task.name, 200))
    return found


@pytest.mark.parametrize("robot", sorted(robots.ROBOTS))
def test_the_documented_table_is_that_of_the_lists(robot: str) -> None:
    page = (ROOT / "docs/extend.md").read_text()
    (line,) = re.findall(rf"^\| {robot} \| (.*) \|$", page, re.MULTILINE)
    hz, cameras, places, steps, control = line.split(" | ")
    known = [suite for suite in suites.SUITES.values() if suite.robot == robot]
    rows = listed_rows(robot)
    spots = [place for row in rows for place in row.placements]
    xs = [place.x for place in spots]
    widest = max(abs(place.y) for place in spots)
    least, most = (limit(row.max_steps for row in rows) for limit in (min, max))
    assert {f"{suite.hz:g}" for suite in known} == {hz}
    assert {", ".join(suite.cameras) for suite in known} == {cameras}
    assert ", ".join(sorted({suite.control for suite in known})) == control
    written = f"{min(xs):.3f} to {max(xs):.3f}, ±{widest:.3f}"
    assert written.replace("0.", ".") == places
    assert (f"{least} to {most}" if least < most else f"{least}") == steps


@pytest.mark.slow
def test_the_command_runs_and_judges_it_again(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = vap(
        *("eval", "--suite", file, "--policy", "expert", "--episodes", 2),
        *("--workers", 1, "--out", out),
    )
    assert done.returncode == 0, done.stderr
    assert read(out)[["suite", "outcome"]].values.tolist() == [["my-desk", "success"]] * 2
    assert read_manifest(out)["configuration"]["lists"] == {"my-desk": suites.digest("my-desk")}
    assert "suite_files" not in read_manifest(out)["configuration"]
    rescore(out)
    assert vap("report", out).returncode == 0


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    said = refused("eval", "--suite", tmp_path / "none.py", "--out", tmp_path / "run")
    assert "none.py is no Python file" in said
