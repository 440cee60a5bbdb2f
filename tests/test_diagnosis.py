"""From a run's table to the frame: failures listed, narrowed down, run again and opened; what is refused, in one line."""

import errno
import json
import os
import shutil
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.command import here, refused, vap
from tests.test_breakdown import TABLE
from vap_core.base.errors import BadOutput, BadRecording, BadStudy, UnknownName
from vap_core.base.files import DATA
from vap_core.recording import Recorder, read_summary, recover
from vap_core.simulation.types import Outcome
from vap_core.study import engine
from vap_core.study import failures as failures_of
from vap_core.study.failures import (
    Failures,
    breakdown,
    correct_failure,
    deciding_frame,
    failures_text,
    list_failures,
    recording_of,
    study_of,
    why_other,
)
from vap_core.study.results import publish, read_published
from vap_core.study.store import read_manifest
from vap_core.study.trials import Study

pytestmark = pytest.mark.usefixtures("short_episodes")
STUDY = Study((("widowx-pick", "pick-straw-cup"),), ("generic",), episodes=3, policy="random")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, short_episodes: None) -> Path:
    folder = tmp_path_factory.mktemp("diagnosed") / "run"
    engine.run(STUDY, folder, record="none", executor=here, progress=False)
    return folder


def test_a_run_lists_its_failures_with_their_reasons(run: Path) -> None:
    failures = list_failures(run)
    assert len(failures.table) == 3
    told = failures_text(failures, limit=2)
    assert "unprompted" in told
    assert "and 1 more; --limit shows them" in told
    assert set(failures.table["case"]) == {"unprompted"}
    assert failures.table["deciding_frame"].between(0, 60).all()


@pytest.mark.parametrize(
    ("asked", "n", "n_failures"),
    [({}, 2191, 2), ({"suite": "simpler-bridge"}, 96, 0)],
)
def test_what_is_older_than_the_diagnosis_is_counted(
    asked: dict[str, str], n: int, n_failures: int
) -> None:
    failures = list_failures(DATA / "results" / "bounds.parquet", **asked)
    kept = len(failures.episodes)
    whole = pd.concat(part for _, part in read_published(DATA / "results" / "bounds.parquet"))
    for column, wanted in asked.items():
        whole = whole[whole[column] == wanted]
    assert (kept + n, breakdown(failures.episodes)["n"].sum()) == (len(whole), kept)
    said = f"{n} more of runs older than the diagnosis are left out; {n_failures} of them failed."
    assert said in failures_text(failures)


def test_an_older_episode_that_another_source_has_diagnosed_is_not_left_out(
    run: Path, tmp_path: Path
) -> None:
    """The older run comes first, and with other episodes of its own."""
    shutil.copytree(run, tmp_path / "older")
    for part in (tmp_path / "older" / "parts").iterdir():
        table = pd.read_parquet(part)
        texts = dict.fromkeys(("case", "sub_case", "case_sentence"))
        table.assign(**texts, deciding_frame=float("nan")).to_parquet(part)
    alone = list_failures(tmp_path / "older")
    assert "3 more of runs older than the diagnosis" in failures_text(alone)
    both = list_failures(tmp_path / "older", run)
    assert len(both.table) == 3
    assert "older than the diagnosis" not in failures_text(both)
    mixed = list_failures(DATA / "results" / "bounds.parquet", run)
    assert mixed.all_episodes["deciding_frame"].dtype == int


def test_several_places_are_one_list_of_every_episode_once(run: Path, tmp_path: Path) -> None:
    mine, other = tmp_path / "mine.parquet", tmp_path / "other"
    publish([run], mine)
    study = replace(STUDY, policy="scripted", episodes=1)
    engine.run(study, other, record="none", executor=here, progress=False)
    listed = list_failures(run, run, mine, other)
    assert listed.all_episodes["source"].tolist() == [str(run)] * 3 + [str(other)]
    assert breakdown(listed.episodes)["n"].tolist() == [3, 1]
    assert set(listed.all_episodes.index) == {0, 1, 2, 3}


def test_an_episode_with_another_object_or_stack_is_another(run: Path, tmp_path: Path) -> None:
    for name, changed in (("robots", "menagerie"), ("object", "mug"), ("stack", "foundation")):
        shutil.copytree(run, tmp_path / name)
        path = tmp_path / name / "run.json"
        manifest = json.loads(path.read_text())
        manifest["configuration"][name] = changed
        path.write_text(json.dumps({**manifest, "digest": name}))
        assert len(list_failures(run, tmp_path / name).table) == 6


def test_a_condition_narrows_them_down(run: Path) -> None:
    whole = list_failures(run).table
    some = list_failures(
        run, where=f"success = false and episode < {sorted(whole.episode)[2]}"
    ).table
    assert sorted(some.episode) == sorted(whole.episode)[:2]
    assert list_failures(run, where="steps < 0").table.empty
    assert "no failure is left" in failures_text(list_failures(run, where="steps < 0"))


def test_an_episode_that_was_not_recorded_is_run_again_alike(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failures = list_failures(run)
    path = recording_of(failures, 1)
    line = failures.table.iloc[1]
    said = read_summary(path)
    assert (
        path == run / "recordings" / f"widowx-pick.pick-straw-cup.{line.episode:03d}.s0.generic.rrd"
    )
    assert (said["steps"], said["case"], said["sub_case"]) == (
        line.steps,
        line.case,
        line.sub_case,
    )
    assert said["deciding_frame"] == deciding_frame(failures, 1) == line.deciding_frame
    before = path.stat().st_mtime_ns
    assert recording_of(failures, 1) == path
    assert path.stat().st_mtime_ns == before, "what is recorded is not run again"
    assert capsys.readouterr().out == ""


def test_a_damaged_recording_is_made_again_where_that_can_be_written(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = list_failures(run)
    path = recording_of(failures, 2)
    frames = read_summary(path)["frames"]
    path.write_bytes(path.read_bytes()[:5000])
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", read_only)
        with pytest.raises(BadOutput, match=r"cannot be written \(Read-only file system\)"):
            recording_of(failures, 2)
    assert read_summary(recording_of(failures, 2))["frames"] == frames


def read_only(path: Path, missing_ok: bool = False) -> None:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def opened(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Failures:
    """The failures of the run as a published table, whose recordings lie below `tmp_path`."""
    publish([run], tmp_path / "mine.parquet")
    monkeypatch.chdir(tmp_path)
    return list_failures(tmp_path / "mine.parquet")


def kept_beside(path: Path) -> list[str]:
    return sorted(each.name for each in path.parent.glob(f"{path.name}.*"))


def test_a_recording_of_another_episode_is_neither_shown_nor_lost(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    failures = opened(run, tmp_path, monkeypatch)
    first, second = failures.table.episode[:2]
    path = recording_of(failures, 1)
    capsys.readouterr()
    for number in (1, 2):
        other = recording_of(failures, 0)
        shutil.copy(other, path)
        foreign = path.read_bytes()
        assert read_summary(recording_of(failures, 1))["episode"] == second
        kept = path.with_name(f"{path.name}.replaced-{number}")
        assert kept.read_bytes() == foreign
        said = capsys.readouterr().out
        assert said == (
            f"note: {path} is of episode {first}, not {second}; it is kept as {kept.name}, "
            "and the episode is run again.\n"
        )
    assert len(kept_beside(path)) == 2
    assert {*path.parent.glob("*.rrd")} == {other, path}


def test_what_a_killed_process_recorded_is_not_the_whole_episode(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Killed(Recorder):
        def close(self, outcome: Outcome) -> None:
            raise KeyboardInterrupt

    failures = opened(run, tmp_path, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr("vap_core.recording.Recorder", Killed)
        with pytest.raises(KeyboardInterrupt):
            recording_of(failures, 0)
    (leftover,) = tmp_path.glob("data/runs/mine-diagnosed/**/.*.tmp")
    recovered = recover(leftover)
    assert "outcome" not in read_summary(recovered)
    assert recording_of(failures, 0).name == recovered.name
    assert "is unfinished; it is kept as" in capsys.readouterr().out
    assert read_summary(recovered)["outcome"] == "failure"
    assert len(kept_beside(recovered)) == 1


@pytest.mark.parametrize("name", ["suite", "task", "episode", "seed", "method", "policy"])
def test_a_recording_is_that_of_a_row_in_all_that_names_it(name: str) -> None:
    row = {"suite": "s", "task": "t", "episode": 1, "seed": 0, "method": "vap", "policy": "p"}
    recorded = {**row, "outcome": "failure", "steps": 9}
    assert why_other(recorded, row) == ""
    assert f"is of {name} 7, not {row[name]}" == why_other({**recorded, name: 7}, row)
    del recorded[name]
    assert why_other(recorded, row)


def test_a_recording_that_ended_otherwise_than_its_row_says_so(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failures = list_failures(run)
    path = recording_of(failures, 1)
    steps = failures.table.steps[1]
    failures.table.loc[1, "steps"] = steps - 1
    assert recording_of(failures, 1) == path
    assert capsys.readouterr().out == (
        f"note: recorded, it is a failure after {steps} steps (was failure after {steps - 1}).\n"
    )


def test_a_recording_without_rights_stays_and_a_damaged_one_is_kept(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    failures = opened(run, tmp_path, monkeypatch)
    path = recording_of(failures, 0)
    damaged = path.read_bytes()[:5000]
    path.write_bytes(damaged)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", no_rights)
        with pytest.raises(BadRecording, match="give yourself the right to read it") as caught:
            recording_of(failures, 0)
    assert str(caught.value).startswith(f"diagnose: {path} cannot be read (Permission denied);")
    assert kept_beside(path) == []
    recording_of(failures, 0)
    assert f"note: {path} is damaged; it is kept as" in capsys.readouterr().out
    assert path.with_name(f"{path.name}.replaced-1").read_bytes() == damaged
    assert read_summary(path)["outcome"] == "failure"


def no_rights(path: Path, mode: str) -> None:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def test_a_misspelt_correction_is_said_before_the_episode_is_run_again(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: object) -> None:
        raise AssertionError("run again")

    monkeypatch.setattr(failures_of, "recording_to_show", never)
    with pytest.raises(UnknownName, match="case 33"):
        correct_failure(list_failures(run), 0, "case 33: slip")


def test_a_published_table_opens_too(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish([run], tmp_path / "mine.parquet")
    failures = list_failures(tmp_path / "mine.parquet", suite="widowx-pick", case="unprompted")
    monkeypatch.chdir(tmp_path)
    path = recording_of(failures, 0)
    digest = read_manifest(run)["digest"]
    assert path.parent == Path("data/runs/mine-diagnosed", digest, "random/recordings")
    assert path.exists()


def test_a_correction_is_of_the_policy_that_was_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Policies of one table that play the same rows name their recordings alike."""
    runs = []
    for policy in ("random", "scripted"):
        runs.append(tmp_path / policy)
        study = replace(STUDY, policy=policy, episodes=2)
        engine.run(study, runs[-1], record="none", executor=here, progress=False)
    publish(runs, tmp_path / "mine.parquet")
    monkeypatch.chdir(tmp_path)
    listed = partial(list_failures, tmp_path / "mine.parquet", where="policy = 'random'")
    table = correct_failure(listed(), 0, "unprompted: slip")
    digest = read_manifest(runs[0])["digest"]
    assert table == Path("data/runs/mine-diagnosed", digest, "random/corrections.csv")
    assert listed().table.corrected.tolist() == [True, False]
    everything = list_failures(tmp_path / "mine.parquet").all_episodes
    assert everything.corrected.sum() == 1
    for policies in (runs[:1], runs, runs[1:]):
        publish(policies, tmp_path / "mine.parquet", replace=True)
        found = list_failures(tmp_path / "mine.parquet").all_episodes
        of_random = found.policy.eq("random")
        assert found.corrected[of_random].sum() == of_random.any(), "found where it was written"
        assert not found.corrected[~of_random].any(), "it is of the other policy"


def test_tables_of_one_name_share_what_is_of_one_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other, ignore=shutil.ignore_patterns("recordings"))
    manifest = read_manifest(run)
    manifest["configuration"]["follow"] = "call"
    (other / "run.json").write_text(json.dumps({**manifest, "digest": "of-call"}))
    tables = {}
    for name, source in (("a", run), ("b", other), ("copy", run)):
        tables[name] = tmp_path / name / "t.parquet"
        publish([source], tables[name])
    monkeypatch.chdir(tmp_path)
    table = correct_failure(list_failures(tables["a"]), 0, "unprompted: slip")
    corrected = {name: list_failures(table).table.corrected.sum() for name, table in tables.items()}
    assert corrected == {"a": 1, "b": 0, "copy": 1}
    folders = {name: set(list_failures(table).table.folder) for name, table in tables.items()}
    assert folders["a"] == folders["copy"] == {str(table.parent)}
    assert folders["b"] == {"data/runs/t-diagnosed/of-call/random"}


def test_the_digest_of_a_published_table_leads_out_of_no_folder(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    changed = {**read_manifest(run), "digest": "../.."}
    (tmp_path / "run" / "run.json").write_text(json.dumps(changed))
    publish([tmp_path / "run"], tmp_path / "t.parquet")
    (folder,) = set(list_failures(tmp_path / "t.parquet").table.folder)
    assert ".." not in Path(folder).parts
    assert len(Path(folder).parts) == 5


def test_a_recording_of_older_weights_is_made_anew(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish([run], tmp_path / "mine.parquet")
    failures = list_failures(tmp_path / "mine.parquet")
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as before:
        before.setattr(
            "vap_core.recording.Recorder",
            lambda path, header, explain: Recorder(
                path, replace(header, policy="random@older"), explain=explain
            ),
        )
        assert read_summary(recording_of(failures, 0))["policy"] == "random@older"
    path = recording_of(failures, 0)
    assert read_summary(path)["policy"] == failures.table.policy[0]
    made = path.stat().st_mtime_ns
    assert recording_of(failures, 0).stat().st_mtime_ns == made


def test_a_run_of_a_policy_that_has_moved_is_run_again_with_the_shipped_one() -> None:
    """Manifests name the folder of their day; the label's digest is checked before it is run."""
    moved = 0
    for manifest, episodes in read_published(DATA / "results" / "mini_pi0.parquet"):
        row = episodes.iloc[0].to_dict()
        moved += manifest["configuration"]["policy"].startswith("data/runs/")
        study = study_of(manifest, row)
        assert study.policy_label(row["suite"]) == row["policy"]
        assert study.policy == "mini-pi0" or study.policy.startswith("data/policies/")
    assert moved


@pytest.mark.parametrize(
    ("asked", "match"),
    [
        ({"suite": "vlabench"}, "no suite 'vlabench' here; there is widowx-pick"),
        ({"case": 2}, "no case 'case 2' here; there is unprompted"),
        ({"where": "margin <"}, "is none on this table"),
        ({"where": "colour = 'red'"}, "columns: "),
        ({"where": "1 = 1; drop table episodes"}, "is none on this table"),
    ],
)
def test_what_fits_nothing_is_refused_in_one_line(
    run: Path, asked: dict[str, Any], match: str
) -> None:
    with pytest.raises(BadStudy, match=match) as caught:
        list_failures(run, **asked)
    assert "\n" not in str(caught.value)


def test_other_refusals(run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadStudy, match="no failure #3; they are #0 to #2"):
        recording_of(list_failures(run), 3)
    with pytest.raises(BadOutput, match=r"run\.json is absent or damaged"):
        list_failures(tmp_path)
    with pytest.raises(BadOutput, match=rf"holds no run; did you mean .*{run.name}"):
        list_failures(run.with_name(f"{run.name}s"))
    with pytest.raises(BadOutput, match="no table of finished runs .No such file or directory"):
        list_failures(tmp_path / "none.parquet")
    with pytest.raises(BadOutput, match="is no table of finished runs"):
        list_failures(Path("data/results/perception_views.parquet"))
    with pytest.raises(BadOutput, match="before failures were diagnosed"):
        breakdown(TABLE.drop(columns="case"))
    failures = list_failures(run)
    failures.table.loc[0, "policy"] = "another"
    (
        run
        / "recordings"
        / f"widowx-pick.pick-straw-cup.{failures.table.episode[0]:03d}.s0.generic.rrd"
    ).unlink(missing_ok=True)
    with pytest.raises(BadStudy, match="run with another, and random is here now"):
        recording_of(failures, 0)


def test_an_episode_of_a_list_that_has_changed_is_not_run_again() -> None:
    manifest, rows = read_published(DATA / "results" / "bounds.parquet")[0]
    row = rows.iloc[0].to_dict()
    assert study_of(manifest, row).tasks == ((row["suite"], row["task"]),)
    manifest["configuration"]["lists"][row["suite"]] = "0" * 64
    with pytest.raises(
        BadStudy, match=f"the list of {row['suite']} has changed since this was run"
    ):
        study_of(manifest, row)


def test_the_command_lists_and_refuses(run: Path) -> None:
    done = vap("diagnose", run, "--limit", 1)
    assert done.returncode == 0, done.stderr
    assert "fail % [95 %]" in done.stdout
    refused = vap("diagnose", run, "--case", 7)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    refused = vap(
        "eval", "--suite", "widowx-pick", "--record", "some", "--out", run.parent / "other"
    )
    assert (refused.returncode, refused.stderr) == (
        2,
        "error: --record some: say all, failures, none, or how many per task and method.\n",
    )


def test_without_a_display_the_viewer_says_what_to_do(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vap_core.base.errors import MissingGL
    from vap_core.recording import open_viewer

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(MissingGL, match="add --png FILE"):
        open_viewer(recording_of(list_failures(run), 1))


def test_so_many_recordings_are_spread_over_a_task(tmp_path: Path) -> None:
    from dataclasses import replace

    study = replace(STUDY, episodes=4)
    engine.run(study, tmp_path / "run", record=2, executor=here, progress=False)
    assert sorted(
        path.name.split(".")[2] for path in (tmp_path / "run" / "recordings").glob("*.rrd")
    ) == ["000", "002"]
    assert list_failures(tmp_path / "run").table.shape[0] == 4


def test_a_correction_changes_the_table_and_nothing_else(run: Path) -> None:
    failures = list_failures(run)
    file = correct_failure(failures, 1, "unprompted: slip", "it held for a moment")
    again = list_failures(run)
    assert (
        again.table.sub_case[1],
        again.table.case_sentence[1],
        again.table.corrected.tolist(),
    ) == (
        "slip",
        "it held for a moment",
        [False, True, False],
    )
    assert "* as corrected by hand" in failures_text(again)
    with pytest.raises(UnknownName, match="sub-case of unprompted 'drop' is unknown; known: "):
        correct_failure(failures, 1, "unprompted: drop")
    file.write_text("suite,task")
    with pytest.raises(BadOutput, match="corrections.csv is damaged .*; mend it, or delete it"):
        list_failures(run)
    file.unlink()
    assert not list_failures(run).table.corrected.any()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ("diagnose R --open 0 --note x", "--note is of a correction; leave --note out"),
        ("diagnose R --against vap", "--against is of one failure; name it by --open"),
        ("diagnose R --open 0 --correct c --png a", "--correct shows nothing; leave --png out"),
        ("diagnose R --open 0 --correct c --mp4 a", "--correct shows nothing; leave --mp4 out"),
        ("diagnose R --open 0 --correct c --against vap", "shows nothing; leave --against out"),
        ("view R --attention", "--attention is a picture; name its file by --png"),
        ("view R --mp4 a.mp4 --frame 0", "--mp4 films every step; leave --frame out"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(words: str, match: str) -> None:
    assert match in refused(*words.split())


def test_a_picture_and_a_film_are_both_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = []
    monkeypatch.setattr("vap_core.recording.read_summary", lambda _: None)
    monkeypatch.setattr("vap_core.recording.write_film", lambda _, mp4: made.append(mp4) or 1)
    monkeypatch.setattr("vap_core.recording.screenshot", lambda _, png, **__: made.append(png))
    done = vap("view", "a.rrd", "--png", tmp_path / "a.png", "--mp4", tmp_path / "a.mp4")
    assert (done.returncode, done.stdout.count("wrote")) == (0, 2)
    assert made == [tmp_path / "a.mp4", tmp_path / "a.png"]


def test_the_other_method_is_of_the_same_episode_policy_and_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifests = {
        "menagerie": {"configuration": {"robots": "menagerie"}},
        "plain": {"configuration": {}},
    }
    rows = []
    for of_run, policy, episode, method in product(
        manifests, ("a", "b"), (0, 1), ("generic", "vap")
    ):
        about = {"suite": "s", "task": "t", "seed": 0, "folder": str(tmp_path)}
        played = {"episode": episode, "policy": policy, "method": method}
        rows.append({**about, **played, "configuration": of_run})
    table = pd.DataFrame(rows)
    generic = table[table["method"] == "generic"].reset_index(drop=True)
    failures = Failures(manifests, table, table, generic)
    opened: list[dict[str, Any]] = []

    def recorded(_: Failures, row: dict[str, Any]) -> Path:
        opened.append(row)
        return tmp_path / f"{row['method']}.rrd"

    combined = []
    monkeypatch.setattr(failures_of, "_recording_of_row", recorded)
    monkeypatch.setattr("vap_core.recording.combine_recordings", lambda *of: combined.append(of))
    last = len(generic) - 1
    out = failures_of.side_by_side_recording(failures, last, "vap")
    assert opened == [rows[-2], rows[-1]]
    paths = {"generic": tmp_path / "generic.rrd", "vap": tmp_path / "vap.rrd"}
    assert combined == [(paths, out)]
    with pytest.raises(
        BadStudy, match="'soft' did not run this episode here; there is generic, vap[.]$"
    ):
        failures_of.side_by_side_recording(failures, last, "soft")


def test_a_failure_is_not_laid_beside_itself(run: Path, tmp_path: Path) -> None:
    """Before anything is run or written; the message names the methods that there are."""
    failures = list_failures(run)
    with pytest.raises(BadStudy, match="'generic' is that failure's own method; there is no other"):
        failures_of.side_by_side_recording(failures, 0, "generic")
    everything = failures.all_episodes
    both = pd.concat([everything, everything.assign(method="vap")], ignore_index=True)
    with pytest.raises(BadStudy, match="own method; there is vap[.]$"):
        failures_of.side_by_side_recording(replace(failures, all_episodes=both), 0, "generic")
    picture = tmp_path / "same.png"
    words = ("diagnose", run, "--open", 0, "--against", "generic", "--png", picture)
    assert "is that failure's own method" in refused(*words)
    assert not picture.exists()
