"""The benchmark commands from end to end: a suite evaluated, resumed, judged again and recorded; what they refuse, in one line."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.command import process, refused, vap
from vap_core.base.errors import BadOutput, VapError
from vap_core.cli.command import names
from vap_core.simulation.suites import BENCHMARKS
from vap_core.study.report import rescore
from vap_core.study.store import read
from vap_core.study.trials import shipped

SUITE = "simpler-bridge"
TASKS = [task.name for task in BENCHMARKS[SUITE].tasks]


def words(out: Path) -> tuple[str | Path, ...]:
    return ("eval", "--suite", SUITE, "--policy", "expert", "--episodes", "2", "--out", out)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished evaluation and what it printed."""
    out = tmp_path_factory.mktemp("eval") / "run"
    done = process(*words(out), cwd=out.parent)
    assert done.returncode == 0, done.stderr
    return out, done.stdout


@pytest.fixture
def copied(run: tuple[Path, str], tmp_path: Path) -> Path:
    return Path(shutil.copytree(run[0], tmp_path / "run"))


def files(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("given", ["", ",", " , "])
@pytest.mark.parametrize("command", [("eval",), ("rollout", "--task", TASKS[0])])
def test_methods_that_name_none_are_refused(
    tmp_path: Path, command: tuple[str, ...], given: str
) -> None:
    """An unset variable of the shell ran generic and vap over the whole list."""
    shared = ("--suite", SUITE, "--policy", "expert", "--episodes", "1", "--out", tmp_path / "run")
    said = refused(*command, *shared, "--methods", given)
    assert f"--methods: {given!r} names no method; name one, or leave the option out" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_it_prints_every_task_with_its_rates(run: tuple[Path, str]) -> None:
    out, printed = run
    assert printed.startswith(f"{SUITE}: generic succeeds in 100.0 % of 8 (expert)")
    assert len(printed.splitlines()) <= 20
    assert "SR % [95 %]" in printed
    words = [line.split() for line in printed.splitlines()]
    assert [one[1:5] for one in words if one and one[0] in TASKS] == [
        ["generic", "(bound)", "2", "of"] for _ in TASKS
    ]
    told = json.loads((out / "summary.json").read_text())
    assert [(one["task"], one["n"], one["sr"], one["errors"]) for one in told] == [
        (task, 2, 1.0, 0) for task in TASKS
    ]
    table = read(out)
    assert sorted(table[table.task == TASKS[0]].episode) == [0, 23], "spread over the list"
    assert (out / "figure.png").stat().st_size > 5_000
    assert not (out / "recordings").exists()


@pytest.mark.slow
def test_a_second_call_runs_nothing_more(run: tuple[Path, str]) -> None:
    out, printed = run
    before = files(out)
    again = vap(*words(out))
    assert (again.returncode, again.stdout) == (0, printed)
    assert "0/8" not in again.stderr
    after = files(out)
    assert after.keys() == before.keys()
    assert all(
        after[name] == data
        for name, data in before.items()
        if name.endswith((".parquet", "run.json", "summary.json"))
    )


@pytest.mark.slow
def test_judged_again_nothing_changes(run: tuple[Path, str]) -> None:
    done = vap("report", "--rescore", run[0])
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout.splitlines()[-1]
        == "0 of 8 episodes judged differently; 0 without a saved state or in error kept as they were."
    )
    assert done.stdout.count("100 % [34, 100]") == 8


@pytest.mark.slow
def test_another_number_of_episodes_is_another_run(run: tuple[Path, str]) -> None:
    done = vap("eval", "--suite", SUITE, "--policy", "expert", "--episodes", "3", "--out", run[0])
    assert done.returncode == 2
    assert "holds another run" in done.stderr


@pytest.mark.slow
def test_episodes_without_a_saved_state_keep_their_outcome(copied: Path) -> None:
    shutil.rmtree(copied / "traces")
    assert rescore(copied).endswith(
        "0 of 0 episodes judged differently; 8 without a saved state or in error kept as they were."
    )


@pytest.mark.slow
def test_a_damaged_trace_is_named(copied: Path) -> None:
    part = next((copied / "traces").iterdir())
    part.write_bytes(part.read_bytes()[:300])
    with pytest.raises(BadOutput, match=f"{part.name} is damaged; delete it"):
        rescore(copied)


@pytest.mark.slow
def test_a_run_that_lost_its_configuration_is_refused(copied: Path) -> None:
    (copied / "run.json").unlink()
    with pytest.raises(BadOutput, match="run.json"):
        rescore(copied)


@pytest.mark.slow
def test_a_run_of_another_episode_list_is_refused(copied: Path) -> None:
    """Its states belong to rows that are not there any more; judged by today's they would say anything."""
    held = json.loads((copied / "run.json").read_text())
    held["configuration"]["lists"][SUITE] = "0" * 64
    (copied / "run.json").write_text(json.dumps(held))
    with pytest.raises(VapError, match=SUITE):
        rescore(copied)


@pytest.mark.slow
def test_the_table_judged_again_has_the_order_of_the_suite(copied: Path) -> None:
    for part in list((copied / "traces").iterdir()):
        (task,) = set(pd.read_parquet(part).task)
        part.rename(part.with_name(f"{len(TASKS) - TASKS.index(task)}.parquet"))
    told = [
        line.split()[1] for line in rescore(copied).splitlines() if line.startswith(f"{SUITE}  ")
    ]
    assert told == TASKS


@pytest.mark.slow
def test_a_recording_of_joint_control_through_three_cameras_is_sound(tmp_path: Path) -> None:
    words = "rollout --suite vlabench --task select-cup --policy expert --episodes 1 --workers 1"
    done = vap(*words.split(), "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    (recording,) = (tmp_path / "recordings").glob("*.rrd")
    verified = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)],
        capture_output=True,
        text=True,
    )
    assert verified.returncode == 0, verified.stdout + verified.stderr


def test_suites_lists_every_track_and_task() -> None:
    done = vap("suites")
    assert done.returncode == 0, done.stderr
    words = [line.split() for line in done.stdout.splitlines()]
    for count in ("460", "1225", "96", "250", "160"):
        assert any(count in line for line in words)
    assert all(
        any(line[:2] == [name, task.name] for line in words)
        for name, suite in BENCHMARKS.items()
        for task in suite.tasks
    )
    assert "protocol-matched" in done.stdout


EXPERT = ("--suite", SUITE, "--policy", "expert")
REFUSED = {
    "unknown suite": (
        ("eval", "--suite", "nowhere", "--policy", "expert"),
        "suite .*'nowhere' is unknown; known: .*simpler-bridge",
    ),
    "vap with expert": (
        ("eval", *EXPERT, "--method", "vap"),
        "policy 'expert' reads the simulator.*--method generic",
    ),
    "audited expert": (
        ("eval", *EXPERT, "--audit"),
        "policy 'expert' consumes no prompt; there is nothing to audit",
    ),
    "no episodes": (("eval", *EXPERT, "--episodes", "0"), "Invalid value for '--episodes'.*1"),
    "unknown policy": (
        ("eval", "--suite", SUITE, "--policy", "magic"),
        "policy .*'magic' is unknown; known: expert, mini-pi0, random, scripted",
    ),
    "unknown method": (
        ("eval", *EXPERT, "--method", "luck"),
        "method .*'luck' is unknown; known: generic, hard-long, hard-short, mask-only",
    ),
    "unknown task": (
        ("rollout", *EXPERT, "--task", "fly"),
        "task 'fly' is unknown; known: pick-shaver",
    ),
    "no run": (
        ("report", "--rescore", "nowhere"),
        "rescore: nowhere holds no results; name the folder",
    ),
}


def test_names_in_an_option_may_stand_apart() -> None:
    assert names(" generic, vap,, generic") == ["generic", "vap"]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "said"), REFUSED.values(), ids=REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(
    words: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    done = vap(*words, *(() if words[0] == "report" else ("--out", tmp_path / "out")))
    assert (done.returncode, done.stdout) == (2, "")
    last = done.stderr.strip().splitlines()[-1]
    assert re.search(f"(?i)^error: .*{said}", last), done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists(), "nothing begun, nothing left behind"


def test_a_run_of_errors_alone_is_no_success(tmp_path: Path) -> None:
    """It said how many errors there were, and exited with 0."""
    policy = shutil.copytree(shipped("simpler-bridge"), tmp_path / "policy")
    weights = load_file(policy / "model.safetensors")
    name = next(name for name in weights if name.endswith("action_out_proj.weight"))
    weights[name] = torch.full_like(weights[name], torch.finfo(weights[name].dtype).max)
    save_file(weights, policy / "model.safetensors")
    row = ("--suite", "simpler-bridge", "--task", "put-camera", "--episodes", "1")
    words = ("eval", *row, "--policy", policy, "--retries", "0", "--out", tmp_path / "run")
    done = vap(*words)
    assert done.returncode == 2
    *_, line = done.stderr.strip().splitlines()
    assert "note: 2 episodes ended in an error; when the cause is mended, the same" in done.stderr
    assert "--retries 1 tries again" in done.stderr
    assert "every one of the 2 episodes" in line
    assert "of 2 of them: " in line
    assert "finite" in line
