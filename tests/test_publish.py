"""Results are published whole, once, and never over something else."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from vap_core.base.errors import BadOutput
from vap_core.study.results import publish, read_runs
from vap_core.study.store import KEY, append, open_run

ROW = {
    "suite": "widowx-pick",
    "task": "pick-cup",
    "method": "generic",
    "policy": "scripted",
    "attempt": 1,
    "success": True,
}


def run(
    folder: Path,
    seed: int,
    episodes: int = 2,
    done: int = 2,
    methods: tuple[str, ...] = ("generic",),
    version: str = "1",
    first: int = 0,
    policy: str = ROW["policy"],
    **changes: str,
) -> Path:
    study = {
        "tasks": [["widowx-pick", "pick-cup"]],
        "methods": list(methods),
        "version": version,
        "episodes": episodes,
        "seed": seed,
        "seeds": 1,
        "policy": policy,
        **changes,
    }
    open_run(folder, study)
    append(
        folder,
        [
            {**ROW, "method": method, "episode": i, "seed": seed, "detail": "Traceback ..."}
            | {"policy": policy}
            | {"seconds_ik": 0.1, "steps": int(version)}
            for i in range(first, first + done)
            for method in methods
        ],
    )
    return folder


def test_published_results_keep_their_configurations_and_leave_tracebacks_behind(
    tmp_path: Path,
) -> None:
    target = tmp_path / "results" / "both.parquet"
    assert publish([run(tmp_path / "one", 0), run(tmp_path / "two", 1)], target) == 4
    table = pq.read_table(target)
    assert set(table.column_names) == {*ROW, *KEY, "steps", "configuration"}
    notes = json.loads(table.schema.metadata[b"runs"])
    assert [note["configuration"]["seed"] for note in notes] == [0, 1]
    assert sorted(set(table["configuration"].to_pylist())) == sorted(
        note["digest"] for note in notes
    )


def test_of_two_that_publish_one_table_at_once_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, target = run(tmp_path / "one", 0), tmp_path / "t.parquet"
    write = pq.write_table

    def write_late(*args: object, **kwargs: object) -> None:
        target.write_text("of another process")
        write(*args, **kwargs)

    monkeypatch.setattr(pq, "write_table", write_late)
    with pytest.raises(BadOutput, match="exists; choose another name with --to, or pass --replace"):
        publish([folder], target)
    assert target.read_text() == "of another process"
    publish([folder], target, replace=True)
    assert pq.read_table(target).num_rows == 2


def test_what_is_there_is_left_alone(tmp_path: Path) -> None:
    folder, target = run(tmp_path / "one", 0), tmp_path / "t.parquet"
    publish([folder], target)
    with pytest.raises(BadOutput, match="exists; choose another name with --to, or pass --replace"):
        publish([folder], target)
    assert publish([folder], target, replace=True) == 2
    with pytest.raises(BadOutput, match="end it with .parquet"):
        publish([folder], tmp_path / "README.md")
    with pytest.raises(BadOutput, match="cannot be written"):
        publish([folder], Path("/proc/a.parquet"))
    assert not list(tmp_path.glob(".*tmp"))


def test_methods_that_are_finished_need_not_wait_for_the_others(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", 0, methods=("generic", "vap"), done=1)
    append(folder, [{**ROW, "method": "vap", "episode": 1, "seed": 0, "steps": 1}])
    target = tmp_path / "vap.parquet"
    assert publish([folder], target, methods=["vap"]) == 2
    ((manifest, episodes),) = read_runs(target)
    assert set(episodes.method) == {"vap"}
    assert manifest["left_out"] == ["generic"]
    for methods in ((), ("generic",), ("generic", "vap")):
        with pytest.raises(
            BadOutput, match="of 2 episodes of generic|3 of 4 episodes of generic, vap"
        ):
            publish([folder], tmp_path / "other.parquet", methods=methods)
    assert not (tmp_path / "other.parquet").exists()


def test_only_finished_runs_and_each_once(tmp_path: Path) -> None:
    whole, half = run(tmp_path / "one", 0), run(tmp_path / "half", 1, episodes=5, done=3)
    with pytest.raises(
        BadOutput,
        match="half holds 3 of 5 episodes of generic; run the same command again to finish it",
    ):
        publish([half], tmp_path / "t.parquet")
    with pytest.raises(BadOutput, match="hold the same episodes; name each run once"):
        publish([whole, whole], tmp_path / "t.parquet")
    with pytest.raises(BadOutput, match="run.json is absent"):
        publish([tmp_path / "nothing"], tmp_path / "t.parquet")


def test_the_folder_of_another_command_is_refused(tmp_path: Path) -> None:
    other = open_run(tmp_path / "perception", {"suites": ["widowx-pick"]})
    append(other, [{**ROW, "episode": 0, "seed": 0}])
    with pytest.raises(BadOutput, match="perception holds no run of eval, rollout or demo; name"):
        publish([other], tmp_path / "table.parquet")


def test_runs_of_other_scenes_make_no_table(tmp_path: Path) -> None:
    one, other = run(tmp_path / "one", 0), run(tmp_path / "two", 1, robots="menagerie")
    with pytest.raises(BadOutput, match="menagerie robots in .*two: .*in tables of their own"):
        publish([one, other], tmp_path / "t.parquet")


def test_a_published_table_and_a_new_run_become_one_table(tmp_path: Path) -> None:
    old, both = tmp_path / "old.parquet", tmp_path / "both.parquet"
    publish([run(tmp_path / "one", 0)], old)
    at_once = publish([tmp_path / "one", run(tmp_path / "two", 1)], both)
    assert publish([old, tmp_path / "two"], old, replace=True) == at_once == 4
    one, other = pq.read_table(old), pq.read_table(both)
    assert one.schema.metadata[b"runs"] == other.schema.metadata[b"runs"]
    assert one.to_pylist() == other.to_pylist()
    with pytest.raises(BadOutput, match="hold the same episodes"):
        publish([old, tmp_path / "one"], both, replace=True)


def test_of_a_run_only_the_methods_that_are_named_are_taken(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", 0, methods=("generic", "vap", "soft"))
    target = tmp_path / "part.parquet"
    assert publish([folder], target, methods=["vap", "generic"]) == 4
    table = pq.read_table(target)
    assert set(table["method"].to_pylist()) == {"generic", "vap"}
    (note,) = json.loads(table.schema.metadata[b"runs"])
    assert note["configuration"]["methods"] == ["generic", "vap"]
    assert note["left_out"] == ["soft"]
    rest = tmp_path / "rest.parquet"
    assert publish([folder], rest, methods=["soft"]) == 2
    whole = tmp_path / "whole.parquet"
    assert publish([target, rest], whole) == 6, "parts of one run fit together"
    assert [len(episodes) for _, episodes in read_runs(whole)] == [4, 2]
    with pytest.raises(BadOutput, match="lack tap; they have generic, soft, vap"):
        publish([folder], tmp_path / "t.parquet", methods=["vap", "tap"])
    assert not (tmp_path / "t.parquet").exists()
