"""Episodes that are run again for their attention maps: the command, its tables, and which episodes and calls are named."""

import json
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.command import refused, vap
from vap_core.analysis.attention import examples, replay, tables
from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA
from vap_core.study import store
from vap_core.study.results import read_published
from vap_core.study.trials import Study, make_trial


def test_tables_are_published_beside_those_of_other_suites(tmp_path: Path) -> None:
    def rows(suite: str, n: int) -> dict[str, list[dict[str, Any]]]:
        line = {"suite": suite, "method": "soft", "number": 1.5}
        return {name: [dict(line) for _ in range(n)] for name in tables.TABLES}

    for folder, suite, n in (("a", "one", 2), ("b", "other", 3), ("c", "one", 4)):
        (tmp_path / folder).mkdir()
        tables.write(tmp_path / folder, rows(suite, n), [{"digest": folder}])
        tables.publish(tmp_path / folder, tmp_path / "kept")
    found = tables.read(tmp_path / "kept")["calls"]
    assert list(found.suite) == ["other"] * 3 + ["one"] * 4
    metadata = pq.read_schema(tmp_path / "kept" / "attention_calls.parquet").metadata
    about = json.loads(metadata[tables.ABOUT])
    assert [each["runs"][0]["digest"] for each in about] == ["a", "b", "c"]


def test_publishing_leaves_no_row_of_an_older_replay_of_the_suite_and_method(
    tmp_path: Path,
) -> None:
    """A replay without causal measures takes those of the policy before it away."""

    def publish(policy: str, suite: str, tables_with_rows: Sequence[str]) -> None:
        line = {"suite": suite, "method": "soft", "policy": policy, "number": 1}
        rows = {name: [dict(line)] if name in tables_with_rows else [] for name in tables.TABLES}
        tables.write(tmp_path, rows, [{"digest": policy}])
        tables.publish(tmp_path, tmp_path / "kept")

    kept = tmp_path / "kept"
    publish("first", "one", ["episodes", "calls", "layers"])
    assert tables.read(kept)["causal"].empty, "a folder without causal rows can be read"
    publish("old", "one", tables.TABLES)
    publish("other", "another", tables.TABLES)
    publish("new", "one", ["episodes", "calls"])
    found = tables.read(kept)
    policies = {name: list(table.policy) for name, table in found.items()}
    assert policies["episodes"] == policies["calls"] == ["other", "new"]
    assert policies["layers"] == policies["causal"] == ["other"]
    assert {str(table.number.dtype) for table in found.values()} == {"int32"}


def test_a_folder_that_is_no_run_gets_no_folder_of_attention(tmp_path: Path) -> None:
    assert "run.json is absent or damaged" in refused("measure", "attention", tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.sweep
def test_the_command_measures_a_run_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = vap("rollout", "--suite", "simpler-bridge", "--task", "pick-shaver", "--policy", "mini-pi0", "--methods", "generic", "--episodes", "2",
               "--record", "none", "--workers", "1", "--out", run)  # fmt: skip
    assert done.returncode == 0, done.stderr
    words = ("measure", "attention", run, "--workers", "1", "--explain", "1")
    done = vap(*words)
    assert done.returncode == 0, done.stderr
    assert "2 episodes run again, 2 of them end as in the run" in done.stdout
    (part,) = (run / "attention" / "parts").iterdir()
    stamp = part.stat().st_mtime_ns
    assert vap(*words).returncode == 0
    assert part.stat().st_mtime_ns == stamp, "what is there is not run again"
    tables = {
        n: pd.read_parquet(run / "attention" / f"attention_{n}.parquet")
        for n in ("calls", "layers", "causal")
    }
    assert set(tables["calls"]["query"]) == {"action", "category"}
    assert len(tables["layers"]) == 2 * 2 * 4 * 8
    assert set(tables["causal"]["measure"]) == {"gradient", "masking", "action", "category"}
    own = tables["causal"][tables["causal"]["measure"] == "masking"]
    assert (own["rank_masking"] == 1).all()
    done = vap("measure", "attention", run, "--method", "vap")
    assert done.returncode == 2
    assert "holds no episode of what was asked for" in done.stderr


def replayed(study: Study, task: str, memory: Path, policy: str) -> dict[str, Any]:
    """The tables of the first episode of a task, of two calls at most."""
    suite = study.tasks[0][0]
    row = replace(study.rows(suite, task)[0], max_steps=5)
    job = replay.Job(
        name="one",
        study=study,
        method="generic",
        rows=(row,),
        known=(("failure", 5),),
        policy=policy,
        memory=memory,
        explained=(True,),
    )
    return replay.run_job(job)


def test_an_episode_is_run_again_and_measured(tmp_path: Path) -> None:
    study = Study((("simpler-bridge", "pick-shaver"),), ("generic",), episodes=1, policy="mini-pi0")
    label = make_trial(
        study, study.rows("simpler-bridge", "pick-shaver"), "generic", tmp_path
    ).policy.label
    tables = replayed(study, "pick-shaver", tmp_path, label)
    (ending,) = tables["episodes"]
    assert ending["steps"] == 5
    calls = pd.DataFrame(tables["calls"])
    assert set(calls["query"]) == {"action", "category"}
    assert sorted(set(calls["step"])) == [0, 4]
    assert {line["measure"] for line in tables["causal"]} == {"gradient", "masking", "action", "category"}  # fmt: skip
    assert len(tables["layers"]) == 2 * 4 * 8
    with pytest.raises(BadStudy, match="was run with another"):
        replayed(study, "pick-shaver", tmp_path, "another")


def test_a_replay_without_any_observed_call_names_the_errors(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The policy raises at its first call."""
    study = Study((("simpler-bridge", "pick-shaver"),), ("generic",), episodes=1, policy="mini-pi0")
    whole = make_trial(study, study.rows("simpler-bridge", "pick-shaver"), "generic", tmp_path)
    broken = copy(whole.policy)

    def plan(*_: Any) -> None:
        raise RuntimeError("no memory left")

    broken.plan = plan
    job = replay.Job(
        name="one",
        study=study,
        method="generic",
        rows=tuple(study.rows("simpler-bridge", "pick-shaver")),
        known=(("failure", 5),),
        policy=broken.label,
        memory=tmp_path,
        explained=(True,),
    )
    monkeypatch.setattr(replay, "make_trial", lambda *_: replace(whole, policy=broken))
    monkeypatch.setattr(replay, "plan", lambda *_: [job])
    monkeypatch.setattr(replay, "prepare", lambda _: None)
    monkeypatch.setattr(
        replay, "results", lambda work, jobs, **_: ((job, work(job)) for job in jobs)
    )
    says = (
        r"no call of the policy was observed in 1 episodes; 1 ended in an error, the first is "
        r"simpler-bridge/pick-shaver/generic/0: RuntimeError: no memory left\. Mend it, delete .*parts and run"
    )
    with pytest.raises(BadStudy, match=says):
        replay.run_replay(tmp_path, tmp_path / "out", replay.Wanted(), progress=False)


def test_an_episode_that_ended_in_an_error_is_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = DATA / "results" / "token_closed_loop.parquet"
    (suite,) = {suite for manifest, _ in read_published(source) for suite, _ in manifest["configuration"]["tasks"]}  # fmt: skip
    about = [
        {"suite": suite, "task": "put-camera", "method": "soft", "seed": 0, "episode": i}
        for i in range(3)
    ]
    rows = {name: about for name in tables.TABLES}
    rows["errors"] = [about[1] | {"error": "RuntimeError: no memory left"}]
    part = tmp_path / "part.json"
    store.write_json_part(part, rows, caller="attention")
    found = replay._write_tables(source, tmp_path, [part])
    assert {name: table.episode.tolist() for name, table in found.items()} == {
        name: [0, 2] for name in tables.TABLES
    }
    said = capsys.readouterr().err
    assert said.startswith(
        f"attention: of 3 episodes 1 ended in an error, the first is {suite}/put-camera/soft/1: "
        "RuntimeError: no memory left; left out. To run them again delete "
    )


def test_a_policy_without_attention_is_refused(tmp_path: Path) -> None:
    study = Study((("widowx-pick", "pick-bottle"),), ("generic",), episodes=1, policy="random")
    with pytest.raises(BadStudy, match="gives no attention maps.*choose another run"):
        replayed(study, "pick-bottle", tmp_path, "random")


def test_methods_without_a_token_come_first_and_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A command that is ended while tokens are learned has the other methods' episodes."""
    soft, vap_job = (
        SimpleNamespace(name=name, study=name, method=name, rows=(0,)) for name in ("soft", "vap")
    )
    learned: list[str] = []

    def register(study: str, memory: Path) -> None:
        learned.append(study)
        if study == "soft":
            raise KeyboardInterrupt

    monkeypatch.setattr(replay, "plan", lambda *_: [soft, vap_job])
    monkeypatch.setattr(replay, "prepare", lambda _: None)
    monkeypatch.setattr(replay, "register_personal", register)
    monkeypatch.setattr(
        replay, "results", lambda work, jobs, **_: ((job, {"episodes": []}) for job in jobs)
    )
    with pytest.raises(KeyboardInterrupt):
        replay.run_replay(tmp_path, tmp_path, replay.Wanted(), progress=False)
    assert learned == ["vap", "soft"]
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["vap.json"]


def test_of_several_policies_one_is_asked_for_and_sub_goals_are_refused(tmp_path: Path) -> None:
    table = DATA / "results" / "shared.parquet"
    pair = replay.Wanted(suites=("shared-pair",), methods=("vap",))
    with pytest.raises(
        BadStudy, match=r"by mini_pi0:mini-pi0-shared-pair@.* choose one with --pol"
    ):
        replay.plan(table, tmp_path, pair)
    for policy in ("mini-pi0-shared-pair@", "mini-pi0-tabletop-longer@"):
        jobs = replay.plan(table, tmp_path, replace(pair, policy=policy))
        assert {policy in job.policy for job in jobs} == {True}
        assert sum(len(job.rows) for job in jobs) == 100
    with pytest.raises(BadStudy, match=r"shared-sequence in .* have sub-goals"):
        replay.plan(table, tmp_path, replace(pair, suites=("shared-sequence",)))


def test_an_episode_is_named_and_found_in_its_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[tuple[str, str, str, int, Path]] = []

    def run_again(
        manifest: Any, line: Any, memory: Path, recording: Path
    ) -> tuple[None, list[Any]]:
        ran.append((line["suite"], line["task"], line["method"], line["episode"], recording))
        return None, []

    monkeypatch.setattr(examples, "run_again", run_again)
    table = DATA / "results" / "first_policy.parquet"
    name = "simpler-bridge/put-camera/soft/22"
    path, step = examples.record(table, name, tmp_path / "new", tmp_path)
    assert (path, step) == (tmp_path / "new" / "simpler-bridge.put-camera.soft.22.rrd", 0)
    assert ran == [("simpler-bridge", "put-camera", "soft", 22, path)]
    line = {
        "suite": "simpler-bridge",
        "task": "put-camera",
        "method": "soft",
        "episode": 22,
        "seed": 0,
    }
    assert examples.name_of(line) == name
    assert examples.name_of({**line, "seed": 3}) == f"{name}/3"
    with pytest.raises(BadStudy, match="give SUITE/TASK/METHOD/EPISODE"):
        examples.record(table, "put-camera/22", tmp_path, tmp_path)
    with pytest.raises(BadStudy, match="give SUITE/TASK/METHOD/EPISODE"):
        examples.record(table, "simpler-bridge/put-camera/soft/last", tmp_path, tmp_path)
    with pytest.raises(BadStudy, match="give SUITE/TASK/METHOD/EPISODE"):
        examples.record(table, "simpler-bridge/put-camera/soft/²", tmp_path, tmp_path)
    with pytest.raises(BadStudy, match="holds no episode"):
        examples.record(table, "simpler-bridge/put-camera/soft/2200", tmp_path, tmp_path)
