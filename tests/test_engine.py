"""The engine loses nothing: killed in the middle, with workers that die and episodes that break, it ends with the table of an undisturbed run."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tqdm import tqdm

from tests.command import here, vap
from vap_core.base.files import DATA
from vap_core.policies.scripted.expert import Expert
from vap_core.recording import read_summary
from vap_core.study import engine, store, trials
from vap_core.study.engine import Job, Record, missing_jobs, result_key, row_of_dead_worker
from vap_core.study.logs import read_states as read_traces
from vap_core.study.store import append, open_run, read, read_manifest
from vap_core.study.trials import Study

STUDY = Study(
    (("simpler-bridge", "pick-shaver"), ("simpler-bridge", "put-camera")),
    ("generic",),
    policy="random",
    episodes=3,
    seeds=2,
)
ENV = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path.cwd())}


def command(out: Path, episodes: int, several: bool = False) -> list[str]:
    asked = f"eval --suite simpler-bridge {'--suite tabletop' if several else ''} --methods generic"
    more = f"--policy random --episodes {episodes} --seeds 2 --workers 2 --out"
    return [sys.executable, "-m", "vap_core", *asked.split(), *more.split(), str(out)]


def told(out: Path) -> pd.DataFrame:
    table = read(out)
    return table[
        [name for name in table.columns if name != "peak_mb" and not name.startswith("seconds_")]
    ]


def rows_of(out: Path) -> int:
    return len(read(out)) if (out / "run.json").exists() else 0


def kill_once_rows_are_kept(words: list[str], out: Path) -> int:
    """Start the command and kill its whole process group when it has kept its first rows.

    Returns: the rows that were there after the kill.
    """
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    with subprocess.Popen(words, env=ENV, cwd=out.parent, **quiet) as run:
        while not rows_of(out):
            assert run.poll() is None, f"ended with status {run.returncode} and no row"
            time.sleep(0.1)
        os.killpg(run.pid, signal.SIGKILL)
    return rows_of(out)


def kills(
    words: list[str], out: Path, times: int, longest_s: float, rng: random.Random
) -> tuple[int, list[int]]:
    """Start the same command again and again and kill it after `longest_s` at most.

    Returns: the kills done, and the rows that were there after each.
    """
    done, rows = 0, []
    while done < times:
        quiet = {
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
            "start_new_session": True,
        }
        with subprocess.Popen(
            words, env=ENV, cwd=out.parent, preexec_fn=hear_interrupts, **quiet
        ) as run:
            try:
                run.wait(rng.uniform(0.5, longest_s))
                assert run.returncode == 0, f"status {run.returncode}"
                break
            except subprocess.TimeoutExpired:
                how = rng.choice(["interrupt", "kill", "parent"])
                if how == "interrupt":
                    run.send_signal(signal.SIGINT)
                elif how == "kill":
                    os.killpg(run.pid, signal.SIGKILL)
                else:
                    run.kill()
                run.wait(20)
        done += 1
        rows.append(rows_of(out))
        time.sleep(0.5)  # orphans end with their parent
    return done, rows


def hear_interrupts() -> None:
    """A shell's background jobs ignore SIGINT, and so would their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def check(torn: Path, whole: Path, episodes: int, several: bool = False) -> None:
    """A run that was killed and goes on ends with the rows of an undisturbed one."""
    for out in (torn, whole):
        done = vap(*command(out, episodes, several)[3:])
        assert done.returncode == 0, done.stderr
    pd.testing.assert_frame_equal(told(torn), told(whole))
    assert told(whole).key.is_unique
    assert {k for k, _ in read_traces(torn)} == {k for k, _ in read_traces(whole)}


@pytest.mark.slow
def test_killed_in_the_middle_it_ends_with_the_rows_of_an_undisturbed_run(tmp_path: Path) -> None:
    torn = tmp_path / "torn"
    kept = kill_once_rows_are_kept(command(torn, episodes=1), torn)
    done = read(torn).key.tolist()
    check(torn, tmp_path / "whole", episodes=1)
    assert 0 < kept < len(read(torn)), "the kill came in the middle"
    assert set(done) <= set(read(torn).key), "rows were lost"


@pytest.mark.sweep
@pytest.mark.timeout(3600)
def test_killed_twenty_times_it_ends_with_the_rows_of_an_undisturbed_run(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    torn = tmp_path / "torn"
    words = command(torn, episodes=12, several=True)
    done, rows = kills(words, torn, times=20, longest_s=15.0, rng=random.Random(0))
    check(torn, tmp_path / "whole", episodes=12, several=True)
    assert done == 20, "the run ended before it was killed so often; give it more episodes"
    assert rows == sorted(rows), "rows were lost"
    record_property("cases", done)
    record_property("rows", len(read(torn)))


def test_keys_tell_row_method_and_run_apart() -> None:
    (row, other), *_ = STUDY.rows(*STUDY.tasks[0])[:2], None
    assert result_key(row, "vap", "a") == result_key(replace(row), "vap", "a")
    assert (
        len(
            {
                result_key(row, "vap", "a"),
                result_key(other, "vap", "a"),
                result_key(row, "generic", "a"),
                result_key(row, "vap", "b"),
                result_key(replace(row, seed=9), "vap", "a"),
            }
        )
        == 5
    )


def stored(out: Path, names: list[str], **cells: object) -> None:
    """Rows as if they had been run."""
    jobs = list(missing_jobs(STUDY, out, retries=9))
    found = {name: (job, row) for job in jobs for name, row in zip(job.keys, job.rows, strict=True)}
    rows = []
    for job, row, name in ((*found[name], name) for name in names):
        about = {
            "suite": row.suite,
            "task": row.task,
            "method": job.method,
            "seed": row.seed,
            "episode": row.episode,
        }
        rows.append({"key": name, "attempt": job.attempt, **about, **cells})
    append(out, rows)


def test_a_second_attempt_is_no_further_episode() -> None:
    bar = tqdm(total=3, disable=False, file=StringIO())
    counts: dict[str, Counter[str]] = {}
    counted: set[tuple[Any, ...]] = set()
    row = {"suite": "s", "task": "t", "method": "vap", "seed": 0, "success": False}
    for episode, success in ((0, True), (1, False), (1, True), (2, False)):
        rows = [{**row, "episode": episode, "success": success}]
        engine._show_progress(bar, counts, counted, "vap", rows)
    assert bar.n == 3
    assert counts == {"vap": Counter(success=2, n=3)}


def test_only_what_is_missing_runs_and_errors_run_again_recorded(tmp_path: Path) -> None:
    out = open_run(tmp_path / "run", STUDY.configuration())
    jobs = list(missing_jobs(STUDY, out))
    names = [name for job in jobs for name in job.keys]
    assert len(names) == len(set(names)) == 12
    assert {(job.attempt, job.record) for job in jobs} == {(1, "none")}
    stored(out, names[:3], outcome="success")
    stored(out, names[3:5], outcome="error")
    assert [name for job in missing_jobs(STUDY, out) for name in job.keys] == names[5:]
    again = [job for job in missing_jobs(STUDY, out, retries=1) if job.attempt == 2]
    assert [name for job in again for name in job.keys] == names[3:5]
    assert {job.record for job in again} == {"all"}
    assert {job.record for job in missing_jobs(STUDY, out, "all", retries=1)} == {"all"}
    stored(out, names[3:4], outcome="failure")
    stored(out, names[4:5], outcome="error")
    assert [name for job in missing_jobs(STUDY, out, retries=1) for name in job.keys] == names[5:]
    table = read(out).set_index("key")
    assert table.attempt[names[3:5]].tolist() == [2, 2]
    assert table.outcome[names[3:5]].tolist() == ["failure", "error"]
    assert 3 in {job.attempt for job in missing_jobs(STUDY, out, retries=2)}


def test_a_run_that_goes_on_begins_with_short_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed again and again before a job of five ends, it would never get on."""
    sizes: list[list[int]] = []

    def killed(work, jobs, workers, mend):  # type: ignore[no-untyped-def]
        sizes.append([len(job.rows) for job in jobs])
        raise KeyboardInterrupt
        yield

    study = replace(STUDY, tasks=STUDY.tasks[:1], episodes=13, seeds=1)
    monkeypatch.setattr(engine, "register_personal", lambda *_: None)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            engine.run(study, tmp_path / "run", executor=killed, progress=False)
    assert sizes == [[5, 5, 3], [1, 1, 5, 5, 1]]


def test_leftovers_of_killed_writes_are_removed_but_no_recording(tmp_path: Path) -> None:
    out = open_run(tmp_path / "run", STUDY.configuration())
    kept = out / "recordings" / ".a.rrd.tmp"
    gone = [out / "parts" / ".b.1.tmp", out / "recordings" / ".index-2" / ".c.9.rrd.tmp"]
    for path in (kept, *gone):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
        os.utime(path, (0, 0))
    store.sweep(out)
    assert kept.exists()
    assert not [path for path in gone if path.exists()]


def test_how_numbers_are_printed_changes_no_configuration() -> None:
    before = STUDY.configuration()
    with np.printoptions(precision=2, threshold=3):
        assert STUDY.configuration() == before
    assert replace(STUDY, tasks=STUDY.tasks[:1]).configuration()["world"] != before["world"]


def test_another_configuration_shares_no_key(tmp_path: Path) -> None:
    one, other = (
        open_run(tmp_path / policy, replace(STUDY, policy=policy).configuration())
        for policy in ("random", "expert")
    )
    keys = [{name for job in missing_jobs(STUDY, out) for name in job.keys} for out in (one, other)]
    assert not keys[0] & keys[1]


def test_a_worker_that_dies_once_is_forgiven_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fell: list[int] = []

    def spread(work, jobs, workers, mend):  # type: ignore[no-untyped-def]
        for i, job in enumerate(jobs):
            if i == 1 and not fell:
                fell.append(len(jobs))
                raise engine.WorkerDied("a worker process died")
            yield job, work(job)

    study = replace(STUDY, episodes=1)
    table = engine.run(study, tmp_path / "run", record="none", executor=spread)
    assert fell == [2]
    assert len(table) == 4
    assert table.attempt.tolist() == [1] * 4
    assert "a worker process died" in capsys.readouterr().err


def test_an_episode_that_ends_its_workers_is_an_error_and_the_others_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = replace(STUDY, tasks=STUDY.tasks[:1], episodes=3, seeds=1)
    first, bad, last = (row.episode for row in study.rows(*study.tasks[0]))

    def deadly(work, jobs, workers, mend):  # type: ignore[no-untyped-def]
        for job in jobs:
            if bad in [row.episode for row in job.rows]:
                raise engine.WorkerDied("a worker process died, killed")
            yield job, work(job)

    table = engine.run(study, tmp_path / "run", record="none", executor=deadly).set_index("episode")
    assert table.outcome[bad] == "error"
    assert table.detail[bad] == "a worker process died, killed"
    assert table.attempt[bad] == 2, "it is not tried again"
    assert (table.outcome[[first, last]] != "error").all()
    assert table.policy_sha256.nunique() <= 1
    assert "one episode at a time (2 of 2 deaths)" in capsys.readouterr().err
    again = engine.run(study, tmp_path / "run", record="none", executor=deadly, progress=False)
    assert len(again) == 3


def test_an_episode_whose_worker_died_counts_with_the_others_of_its_policy(tmp_path: Path) -> None:
    published = pd.read_parquet(DATA / "results" / "mini_pi0.parquet", columns=["suite", "policy"])
    (known,) = set(published[published.suite == "simpler-bridge"].policy)
    study = Study((("simpler-bridge", "pick-shaver"),), ("vap",), policy="mini-pi0")
    row = study.rows("simpler-bridge", "pick-shaver")[0]
    job = Job(study, "vap", (row,), ("key",), 2, tmp_path, "none")
    assert row_of_dead_worker(job, "died")["policy"] == known
    hot = replace(study, temperature=0.5)
    assert hot.policy_label("simpler-bridge") == f"{known}, temperature 0.5"
    assert STUDY.policy_label(STUDY.tasks[0][0]) == STUDY.policy


def test_where_every_worker_dies_the_run_ends_and_blames_no_episode(tmp_path: Path) -> None:
    tried: list[int] = []

    def deadly(work, jobs, workers, mend):  # type: ignore[no-untyped-def]
        tried.append(sum(len(job.rows) for job in jobs))
        raise engine.WorkerDied("a worker process died")
        yield

    with pytest.raises(engine.WorkerDied):
        engine.run(STUDY, tmp_path / "run", record="none", executor=deadly, progress=False)
    assert tried == [12, 12, 1, 1, 1]
    assert read(tmp_path / "run").empty


def test_an_episode_that_always_breaks_is_an_error_with_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vap_core.policies.scripted.scripted import Random

    class Breaks(Random):
        def plan_from_simulation(self, states, envs):  # type: ignore[no-untyped-def]
            if any(env.row.episode == 0 for env in envs):
                raise RuntimeError("the policy fell over")
            return super().plan_from_simulation(states, envs)

    monkeypatch.setattr(trials, "make_policy", lambda name, scene, suite, stack: Breaks())
    study = replace(STUDY, tasks=STUDY.tasks[:1], episodes=2, seeds=1)

    table = engine.run(study, tmp_path / "run", record="none", executor=here, progress=False)
    assert table.outcome.tolist()[0] == "error"
    assert table.attempt.tolist() == [2, 1]
    assert "the policy fell over" in table.detail[0]
    assert [path.name for path in (tmp_path / "run" / "recordings").glob("*.rrd")] == [
        "simpler-bridge.pick-shaver.000.s0.generic.rrd"
    ]
    assert read_manifest(tmp_path / "run")["configuration"]["seeds"] == 1
    assert not table.success[0]


@pytest.mark.parametrize("record", ["none", "failures", 2])
def test_an_error_that_succeeds_when_it_is_tried_again_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: Record
) -> None:
    class BreaksOnce(Expert):
        broken = False

        def plan_from_simulation(self, states, envs):  # type: ignore[no-untyped-def]
            if not self.broken:
                self.broken = True
                raise RuntimeError("the policy fell over")
            return super().plan_from_simulation(states, envs)

    policy = BreaksOnce()
    monkeypatch.setattr(trials, "make_policy", lambda *_: policy)
    study = replace(STUDY, tasks=STUDY.tasks[:1], policy="expert", episodes=1, seeds=1)

    out = tmp_path / "run"
    table = engine.run(study, out, record=record, executor=here, progress=False)
    assert (table.outcome.tolist(), table.attempt.tolist()) == (["success"], [2])
    (path,) = (out / "recordings").glob("*.rrd")
    assert read_summary(path)["outcome"] == "success"
