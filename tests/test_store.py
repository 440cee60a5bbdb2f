"""Results are appended, never mixed and never overwritten."""

import errno
import json
import os
from contextlib import ExitStack
from pathlib import Path

import pandas as pd
import pytest

from vap_core.base.errors import BadOutput
from vap_core.base.files import write_atomic
from vap_core.study import store
from vap_core.study.store import KEY, append, compact, digest, locked, open_run, read, read_manifest

ROW = {
    "suite": "s",
    "task": "t",
    "method": "vap",
    "seed": 0,
    "episode": 0,
    "attempt": 1,
    "success": True,
}


def test_digest_ignores_order_and_sees_change() -> None:
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 1, "b": 3})


def test_a_run_is_resumed_by_the_same_configuration_only(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {"seed": 0})
    append(run, [ROW, {**ROW, "episode": 1}])
    assert open_run(run, {"seed": 0}) == run
    with pytest.raises(BadOutput, match="holds another run .* choose another folder"):
        open_run(run, {"seed": 1})
    assert len(read(run)) == 2


def test_the_same_episode_counts_once(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [ROW])
    append(run, [ROW])
    assert read(run)[KEY].to_records(index=False).tolist() == [("s", "t", "vap", 0, 0)]


def test_parts_of_methods_with_and_without_a_margin_join(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [{**ROW, "margin": 0.6, "detail": ""}])
    append(run, [{**ROW, "method": "generic", "margin": float("nan"), "detail": ""}])
    assert read(run).margin.tolist()[1] == 0.6


def test_a_part_cut_short_is_not_seen(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [ROW])
    (run / "parts" / ".half.parquet.tmp").write_bytes(b"PAR1")
    assert len(read(run)) == 1


def test_a_damaged_part_is_named(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [ROW])
    next((run / "parts").glob("*.parquet")).write_bytes(b"PAR1garbage")
    with pytest.raises(BadOutput, match=r"\.parquet is damaged; delete it"):
        read(run)


def test_an_empty_run_is_an_empty_table(tmp_path: Path) -> None:
    assert read(open_run(tmp_path / "run", {})).empty


def test_of_two_that_start_one_run_at_once_one_is_let_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, write, inside = tmp_path / "run", store.write_atomic, []
    with ExitStack() as held:

        def start() -> None:
            try:
                open_run(run, {"seed": 0})
                held.enter_context(locked(run))
                inside.append("let in")
            except BadOutput as error:
                inside.append(str(error))

        def write_late(path: Path, data: bytes) -> None:
            monkeypatch.setattr(store, "write_atomic", write)
            start()  # what another process does meanwhile
            write(path, data)

        monkeypatch.setattr(store, "write_atomic", write_late)
        start()
        assert inside.count("let in") == 1
        assert any("another process is working" in said for said in inside)
    with locked(open_run(run, {"seed": 0})):
        pass


def test_a_run_from_before_the_lock_file_goes_on(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {"seed": 0})
    (run / ".lock").unlink()
    with locked(open_run(run, {"seed": 0})):
        append(run, [ROW])
    assert len(read(run)) == 1


def test_foreign_folders_and_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("keep")
    with pytest.raises(BadOutput, match="is not empty and holds no run"):
        open_run(tmp_path, {})
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]
    with pytest.raises(BadOutput, match="is a file"):
        open_run(tmp_path / "precious.txt", {})
    with pytest.raises(BadOutput, match="cannot be written"):
        open_run(Path("/proc/nowhere"), {})
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{")
    with pytest.raises(BadOutput, match="damaged"):
        open_run(tmp_path / "run", {})


def test_a_manifest_nested_too_deep_is_damaged(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    (run / "run.json").write_bytes(b"[" * 100_000)
    with pytest.raises(BadOutput, match="is absent or damaged"):
        read_manifest(run)


@pytest.mark.parametrize("damaged", [[], "x", None])
def test_a_configuration_that_is_no_object_is_damaged(tmp_path: Path, damaged: object) -> None:
    run = open_run(tmp_path / "run", {})
    (run / "run.json").write_text(json.dumps({"digest": "x", "configuration": damaged}))
    for use in (lambda: read_manifest(run), lambda: open_run(run, {"seed": 0})):
        with pytest.raises(BadOutput, match="is absent or damaged"):
            use()


def test_parts_that_do_not_fit_together_are_named_by_who_reads_and_who_joins(
    tmp_path: Path,
) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [ROW])
    append(run, [{**ROW, "episode": "three"}])
    for use in (read, compact):
        with pytest.raises(BadOutput, match="do not fit together"):
            use(run)
    assert len(list((run / "parts").glob("*.parquet"))) == 2


def test_a_run_of_an_older_version_is_said_to_be_one(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    append(run, [{name: cell for name, cell in ROW.items() if name != "attempt"}])
    with pytest.raises(BadOutput, match="written by an older version"):
        read(run)


def test_many_parts_become_one_and_nothing_is_lost(tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", {})
    for i in range(4):
        append(run, [{**ROW, "episode": i, "success": None if i else True, "outcome": "error"}])
    append(run, [{**ROW, "episode": 1, "attempt": 2, "outcome": "success"}])
    before, whole = read(run), sorted((run / "parts").glob("*.parquet"))
    compact(run)
    assert len(list((run / "parts").glob("*.parquet"))) == 1
    pd.testing.assert_frame_equal(read(run), before)
    held = pd.read_parquet(next((run / "parts").glob("*.parquet")))
    assert sorted(zip(held.episode, held.attempt, strict=True)) == [
        (0, 1),
        (1, 1),
        (1, 2),
        (2, 1),
        (3, 1),
    ]
    append(
        run, [{**ROW, "episode": 0, "success": True, "outcome": "error"}]
    )  # as if cut short before the old parts were gone
    pd.testing.assert_frame_equal(read(run), before)
    assert len(whole) == 5


def test_a_run_can_be_read_while_another_process_makes_one_part_of_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run(tmp_path / "run", {"seed": 0})
    for i in range(3):
        append(run, [{**ROW, "episode": i}])
    before, whole = read(run), Path.glob

    def late(folder: Path, pattern: str) -> list[Path]:
        found = list(whole(folder, pattern))
        if len(found) == 3:
            monkeypatch.setattr(Path, "glob", whole)
            compact(run)
        return found

    monkeypatch.setattr(Path, "glob", late)
    pd.testing.assert_frame_equal(read(run), before)
    (run / "parts" / "lost.parquet").symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadOutput, match="lost.parquet is damaged"):
        read(run)


@pytest.mark.parametrize("links", [True, False])
def test_a_file_takes_its_name_once_where_there_are_no_hard_links_too(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(*paths: Path) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", link)
    write_atomic(tmp_path / "a", b"1", replace=False)
    with pytest.raises(FileExistsError):
        write_atomic(tmp_path / "a", b"2", replace=False)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1"}
