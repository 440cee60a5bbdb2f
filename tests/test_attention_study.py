"""Attention of a run measured again: measures of maps against hand counts, patterns by their definitions, tables, and the command that replays episodes."""

import json
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.command import refused, vap
from tests.drawn import frame, opening
from vap_core.base.errors import BadStudy
from vap_core.base.files import DATA
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.types import Truth
from vap_core.study import attention, store
from vap_core.study import attention_figures as figures
from vap_core.study.attention import REGIONS, inside, measure, patch_areas
from vap_core.study.attention_figures import (
    Thresholds,
    example,
    localisation,
    of_pattern,
    over_views,
    per_episode,
    with_localisation,
)
from vap_core.study.results import read_published
from vap_core.study.trials import Study, make_trial


def four_patches() -> dict[str, np.ndarray]:
    """Target in one corner, look-alike in half of the next patch, the hand in the last row."""
    areas = {name: np.zeros((2, 2), np.float32) for name in REGIONS}
    areas["target"][0, 0] = 1
    areas["lookalikes"][0, 1] = 0.5
    areas["background"][0, 1] = 0.5
    areas["hand"][1] = 1
    return areas


def test_shares_are_sums_and_chance_is_area() -> None:
    heat = np.array([[0.4, 0.2], [0.1, 0.1]], np.float32)
    found = measure(heat, four_patches())
    assert found["mass"] == pytest.approx(0.8)
    assert found["share_target"] == pytest.approx(0.5)
    assert found["share_lookalikes"] == pytest.approx(0.125)
    assert found["share_hand"] == pytest.approx(0.25)
    assert sum(float(found[f"share_{name}"]) for name in REGIONS) == pytest.approx(1)
    assert sum(float(found[f"chance_{name}"]) for name in REGIONS) == pytest.approx(1)
    assert found["chance_lookalikes"] == pytest.approx(0.125)
    assert (found["hit"], found["chance_hit"], found["peak_region"]) == (True, 0.25, "target")


def test_even_attention_is_at_chance_and_one_patch_has_no_entropy() -> None:
    even = measure(np.full((2, 2), 0.1, np.float32), four_patches())
    for name in REGIONS:
        assert even[f"share_{name}"] == pytest.approx(even[f"chance_{name}"])
    assert even["entropy"] == pytest.approx(1)
    one = np.zeros((2, 2), np.float32)
    one[0, 1] = 0.3
    found = measure(one, four_patches())
    assert found["entropy"] == 0
    assert (found["hit"], found["peak_region"]) == (False, "lookalikes"), "things before background"


def test_heads_are_measured_as_maps_are() -> None:
    rng = np.random.default_rng(0)
    weights = rng.random((3, 2, 2, 2), dtype=np.float32)
    areas = four_patches()
    for layer, head in np.ndindex(3, 2):
        found = measure(weights[layer, head], areas)
        total, target, rivals = inside(weights, areas)[layer, head]
        assert target / total == pytest.approx(found["share_target"], rel=1e-5)
        assert rivals / total == pytest.approx(found["share_lookalikes"], rel=1e-5)


def test_areas_are_those_of_the_masks_and_the_gripper_has_one() -> None:
    row = suites.rows("simpler-bridge", "pick-shaver", 1)[0]
    names = tuple(place.model for place in row.placements)
    scene = build_scene("simpler-bridge", names, row.variant, "plain")
    env = Env(scene, image_size=224, cameras=row.cameras or None)
    env.reset(row)
    truth = env.truth(masks=True)
    assert env.truth().hand == {}
    (camera,) = truth.masks
    hand = truth.hand[camera]
    assert 0.002 < hand.mean() < 0.3
    for mask in truth.masks[camera].values():
        assert not (mask & hand).any()
    areas = patch_areas(row, truth, camera, 7)
    assert np.allclose(sum(areas.values()), 1, atol=1e-5)
    assert areas["target"].mean() == pytest.approx(truth.masks[camera][row.target].mean(), rel=1e-4)
    assert areas["lookalikes"].sum() > 0
    moved = Truth(**{**{n: getattr(truth, n) for n in Truth.__slots__}, "hand": {camera: ~hand}})
    assert patch_areas(row, moved, camera, 7)["hand"].mean() > 0.7
    scene.close()


def call(
    episode: int, step: int, region: str, camera: str = "front", **more: Any
) -> dict[str, Any]:
    """A row of `calls`: the peak in a region, and attention as dense as the area elsewhere."""
    found: dict[str, Any] = {
        "suite": "s", "task": "t", "method": "soft", "seed": 0, "episode": episode, "step": step, "camera": camera, "query": "token",
        "side": 7, "mass": 0.5, "peak": 0.1, "peak_row": 0, "peak_column": 0, "peak_region": region, "hit": region == "target", "chance_hit": 0.1, "entropy": 0.9,
    }  # fmt: skip
    for name in REGIONS:
        found[f"share_{name}"] = 0.6 if name == region else 0.1
        found[f"chance_{name}"] = 0.2
    return {**found, **more}


def ending(episode: int, success: bool, touch: float = 100.0) -> dict[str, Any]:
    return {
        "suite": "s", "task": "t", "method": "soft", "seed": 0, "episode": episode, "success": success, "outcome": "success" if success else "failure",
        "first_touch": touch, "touched": "target", "margin": 0.1, "layout": f"layout {episode}", "reproduced": True,
    }  # fmt: skip


def localised(calls: list[dict[str, Any]], endings: list[dict[str, Any]]) -> pd.DataFrame:
    return with_localisation(per_episode(pd.DataFrame(calls), pd.DataFrame(endings)))


def test_whole_episodes_count_every_call() -> None:
    calls = pd.DataFrame([call(0, 0, "target"), call(0, 8, "lookalikes")])
    endings = pd.DataFrame([ending(0, True, touch=5)])
    assert list(per_episode(calls, endings).calls) == [1]
    assert list(per_episode(calls, endings, whole=True).calls) == [2]


def test_every_pattern_is_found_by_its_definition() -> None:
    peaks = {
        0: ("target", "target", "target"),
        1: ("target", "target", "target"),
        2: ("target", "background", "target", "hand"),
        3: ("lookalikes", "target", "lookalikes"),
        4: ("background", "background", "background", "target"),
    }
    calls = [call(i, 4 * j, r) for i, regions in peaks.items() for j, r in enumerate(regions)]
    table = localised(calls, [ending(i, i == 0) for i in peaks])
    assert list(table.localisation) == ["stable", "stable", "drifting", "confused", "drifting"]
    assert list(of_pattern(table, "successful").episode) == [0]
    assert list(of_pattern(table, "stable but failed").episode) == [1]
    chosen = {name: example(table, name) for name in figures.PATTERNS}
    assert {name: found.episode for name, found in chosen.items() if found is not None} == {
        "successful": 0,
        "stable but failed": 1,
        "drifting": 2,
        "confused": 3,
    }
    row = table.iloc[4]
    assert localisation(row, Thresholds(switches=0.5)) == "elsewhere"
    assert localisation(table.iloc[0], Thresholds(stable=1.1, switches=0.1)) == "elsewhere"
    counts = figures.pattern_counts(table).iloc[0]
    assert (counts["n"], counts["stable"], counts["stable, success"]) == (5, 2, 1)
    assert example(table[table.episode == 0], "confused") is None


def test_calls_after_the_first_touch_do_not_count() -> None:
    calls = [call(0, 0, "target"), call(0, 4, "target"), call(0, 8, "lookalikes")]
    (row,) = localised(calls, [ending(0, True, touch=5)]).to_dict("records")
    assert (row["calls"], row["on_target"], row["localisation"]) == (2, 1.0, "stable")
    (row,) = localised(calls, [ending(0, True, touch=float("nan"))]).to_dict("records")
    assert row["calls"] == 3


def test_views_are_joined_by_their_attention_and_the_highest_has_the_peak() -> None:
    front = call(0, 0, "background", mass=0.3, peak=0.1)
    side = call(0, 0, "target", camera="side", mass=0.1, peak=0.3)
    (row,) = over_views(pd.DataFrame([front, side])).to_dict("records")
    assert row["share_target"] == pytest.approx((0.3 * 0.1 + 0.1 * 0.6) / 0.4)
    assert (row["camera"], row["hit"], row["mass"]) == ("side", True, pytest.approx(0.4))


def test_the_word_that_means_the_target_is_the_token_then_the_colour() -> None:
    calls = [call(0, 0, "target", query=query) for query in ("action", "category", "colour")]
    calls += [call(1, 0, "target", query=query) for query in ("action", "token")]
    calls += [call(2, 0, "target", query="action")]
    found = figures.main_words(pd.DataFrame(calls))
    assert list(found["query"]) == ["colour", "token", "action"]


def test_densities_by_layer_are_shares_by_areas() -> None:
    rows = []
    for episode in range(2):
        for layer, head in np.ndindex(2, 2):
            share = 0.1 * (1 + layer + head)
            rows.append(
                {
                    "suite": "s", "task": "t", "method": "soft", "seed": 0, "episode": episode, "query": "token", "layer": layer, "head": head,
                    "share_target": share, "chance_target": 0.1, "share_lookalikes": 0.1, "chance_lookalikes": 0.2,
                }
            )  # fmt: skip
    table = figures.layer_table(pd.DataFrame(rows))
    assert list(table["lift"]) == pytest.approx([1.5, 2.5])
    assert list(table["lift_lookalikes"]) == pytest.approx([0.5, 0.5])
    assert list(table["n"]) == [2, 2]


def test_densities_of_causal_measures_are_shares_by_areas() -> None:
    line: dict[str, Any] = {"suite": "s", "method": "soft", "measure": "masking", "hit": True, "chance_hit": 0.1, "rank_gradient": 0.5, "rank_masking": 1.0}  # fmt: skip
    for name in REGIONS:
        line |= {f"share_{name}": 0.4 if name == "hand" else 0.15, f"chance_{name}": 0.2}
    table = figures.causal_table(pd.DataFrame([line, {**line, "rank_gradient": 0.1}])).iloc[0]
    assert (table["n"], table["hand"], table["target"]) == (2, 2.0, 0.75)
    assert table["rank_gradient"] == pytest.approx(0.3)
    with pytest.raises(BadStudy, match="no call of these tables has causal .* --explain 2"):
        figures.causal_table(pd.DataFrame([]))


def test_episodes_without_a_call_before_the_first_touch_are_reported_without_measures() -> None:
    calls = pd.DataFrame([call(0, 0, "target"), call(0, 4, "target"), call(1, 0, "lookalikes")])
    early = pd.DataFrame([ending(0, True, touch=0.0), ending(1, False, touch=0.0)])
    late = pd.DataFrame([ending(0, True), ending(1, False)])
    full = per_episode(calls, late)
    for none in (per_episode(calls, early), per_episode(pd.DataFrame([]), late)):
        assert (len(none), list(none.columns)) == (0, list(full.columns))
        assert with_localisation(none).empty
    said = figures.text({"calls": calls, "episodes": early})
    assert said.endswith("no call came before the first touch")
    assert "over whole episodes" in said
    said = figures.text({"calls": pd.DataFrame([]), "episodes": late})
    assert said.startswith("2 episodes run again, 2 of them end as in the run\n\nno call came")


def test_an_interval_of_a_mean_is_wider_where_episodes_are_copies() -> None:
    values = np.random.default_rng(4).normal(size=40)
    layouts = [str(i) for i in range(40)]
    alone = figures.mean(values, layouts, ["s"] * 40)
    copies = figures.mean(np.tile(values, 4), layouts * 4, ["s"] * 160)
    assert (copies.low, copies.high) == (pytest.approx(alone.low), pytest.approx(alone.high))
    assert alone.low < values.mean() < alone.high
    half = 1.96 * values.std() / np.sqrt(40)
    assert alone.high - values.mean() == pytest.approx(half, rel=0.15)
    assert figures.mean(np.array([]), [], []).n == 0


def test_the_first_call_is_followed_to_the_first_touch() -> None:
    calls = [call(0, 0, "target"), call(0, 4, "lookalikes"), call(1, 0, "lookalikes")]
    endings = [ending(0, True), {**ending(1, False), "touched": "lookalikes"}]
    (row,) = figures.first_look(pd.DataFrame(calls), pd.DataFrame(endings)).to_dict("records")
    assert (row["looks"].value, row["looks"].n) == (0.5, 2)
    assert (row["then_touches"].value, row["else_touches"].value) == (1, 0)


def test_the_clearest_call_is_that_of_a_words_highest_peak() -> None:
    class Steps(list):
        frame = list.append

    def step(i: int, query: str, peak: float) -> Any:
        weights = np.zeros((2, 1, 3, 3), np.float32)
        weights[..., 1, 1] = peak
        return replace(
            frame(0, start),
            frame_index=i,
            timestamp_s=i / 20,
            attention={"front": {query: weights}},
        )

    start = opening(1)
    sink = attention.Clearest(Steps())
    assert sink.step == 0
    for each in (step(0, "token", 0.2), step(4, "token", 0.5), step(8, "action", 0.9)):
        sink.frame(each)
    assert sink.step == 4


def test_a_figure_has_the_suites_in_the_order_of_the_benchmarks() -> None:
    """Tables hold them as they were published."""
    published = [figures.ALL_SUITES, "tabletop", *list(suites.BENCHMARKS)[:3]]
    lines = []
    for suite in published:
        line: dict[str, Any] = {"suite": suite, "method": "vap", "query": "colour", "n": 3}
        for name in ("lift", "lift_lookalikes"):
            line |= {name: 1.0, f"{name}_low": 0.5, f"{name}_high": 2.0}
        lines.append(line)
    panels = figures.where_figure(pd.DataFrame(lines)).axes
    titles = [axes.get_title().removesuffix(", n 3") for axes in panels]
    assert titles == [*suites.BENCHMARKS, figures.ALL_SUITES]


def test_the_figure_over_time_says_how_many_episodes_touch_something_beside_its_curves() -> None:
    calls = [call(episode, step, "target") for episode in range(9) for step in (0, 4)]
    endings = [ending(i, i % 2 == 0, touch=None if i == 1 else 8.0) for i in range(9)]
    figure = figures.time_figure(pd.DataFrame(calls), pd.DataFrame(endings))
    (axes,) = figure.axes
    assert axes.get_title().endswith("5 of 5 successes, 3 of 4 failures")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["success", "chance"], "no point is of three episodes"


def test_tables_have_a_suites_methods_together_in_the_order_of_the_benchmarks() -> None:
    published = [("tabletop", "vap"), ("own", "vap"), ("vlabench", "soft"), ("tabletop", "soft")]
    wanted = [("vlabench", "soft"), ("tabletop", "soft"), ("tabletop", "vap"), ("own", "vap")]
    lines = []
    for suite, method in published:
        for success in (False, True):
            line: dict[str, Any] = {"suite": suite, "method": method, "success": success}
            line |= {"measure": "masking", "hit": True, "chance_hit": 0.1, "layout": "a"}
            line |= {"rank_gradient": 0.5, "rank_masking": 1.0, "localisation": "stable"}
            for name in REGIONS:
                line |= {f"share_{name}": np.float32(0.1), f"chance_{name}": np.float32(0.3)}
            lines.append(line)
    table = pd.DataFrame(lines)
    for found in (figures.pattern_counts(table), figures.causal_table(table)):
        assert list(zip(found.suite, found.method, strict=True)) == wanted
    assert figures.in_order(pd.DataFrame()).empty
    assert "0.330000" not in figures.causal_table(table).to_string()  # as a float32 has it
    assert figures.causal_table(table)["target"].dtype == np.float64


def test_tables_are_published_beside_those_of_other_suites(tmp_path: Path) -> None:
    def rows(suite: str, n: int) -> dict[str, list[dict[str, Any]]]:
        line = {"suite": suite, "method": "soft", "number": 1.5}
        return {name: [dict(line) for _ in range(n)] for name in attention.TABLES}

    for folder, suite, n in (("a", "one", 2), ("b", "other", 3), ("c", "one", 4)):
        (tmp_path / folder).mkdir()
        attention.write(tmp_path / folder, rows(suite, n), [{"digest": folder}])
        attention.publish(tmp_path / folder, tmp_path / "kept")
    found = attention.read(tmp_path / "kept")["calls"]
    assert list(found.suite) == ["other"] * 3 + ["one"] * 4
    metadata = pq.read_schema(tmp_path / "kept" / "attention_calls.parquet").metadata
    about = json.loads(metadata[attention.ABOUT])
    assert [each["runs"][0]["digest"] for each in about] == ["a", "b", "c"]


def test_publishing_leaves_no_row_of_an_older_replay_of_the_suite_and_method(
    tmp_path: Path,
) -> None:
    """A replay without causal measures takes those of the policy before it away."""

    def publish(policy: str, suite: str, tables_with_rows: Sequence[str]) -> None:
        line = {"suite": suite, "method": "soft", "policy": policy, "number": 1}
        rows = {name: [dict(line)] if name in tables_with_rows else [] for name in attention.TABLES}
        attention.write(tmp_path, rows, [{"digest": policy}])
        attention.publish(tmp_path, tmp_path / "kept")

    kept = tmp_path / "kept"
    publish("first", "one", ["episodes", "calls", "layers"])
    assert attention.read(kept)["causal"].empty, "a folder without causal rows can be read"
    publish("old", "one", attention.TABLES)
    publish("other", "another", attention.TABLES)
    publish("new", "one", ["episodes", "calls"])
    found = attention.read(kept)
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
    job = attention.Job(
        name="one",
        study=study,
        method="generic",
        rows=(row,),
        known=(("failure", 5),),
        policy=policy,
        memory=memory,
        explained=(True,),
    )
    return attention.run_job(job)


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
    job = attention.Job(
        name="one",
        study=study,
        method="generic",
        rows=tuple(study.rows("simpler-bridge", "pick-shaver")),
        known=(("failure", 5),),
        policy=broken.label,
        memory=tmp_path,
        explained=(True,),
    )
    monkeypatch.setattr(attention, "make_trial", lambda *_: replace(whole, policy=broken))
    monkeypatch.setattr(attention, "plan", lambda *_: [job])
    monkeypatch.setattr(attention, "prepare", lambda _: None)
    monkeypatch.setattr(
        attention, "results", lambda work, jobs, **_: ((job, work(job)) for job in jobs)
    )
    says = (
        r"no call of the policy was observed in 1 episodes; 1 ended in an error, the first is "
        r"simpler-bridge/pick-shaver/generic/0: RuntimeError: no memory left\. Mend it, delete .*parts and run"
    )
    with pytest.raises(BadStudy, match=says):
        attention.run_replay(tmp_path, tmp_path / "out", attention.Wanted(), progress=False)


def test_an_episode_that_ended_in_an_error_is_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = DATA / "results" / "token_closed_loop.parquet"
    (suite,) = {suite for manifest, _ in read_published(source) for suite, _ in manifest["configuration"]["tasks"]}  # fmt: skip
    about = [
        {"suite": suite, "task": "put-camera", "method": "soft", "seed": 0, "episode": i}
        for i in range(3)
    ]
    rows = {name: about for name in attention.TABLES}
    rows["errors"] = [about[1] | {"error": "RuntimeError: no memory left"}]
    part = tmp_path / "part.json"
    store.write_json_part(part, rows, caller="attention")
    found = attention.write_tables(source, tmp_path, [part])
    assert {name: table.episode.tolist() for name, table in found.items()} == {
        name: [0, 2] for name in attention.TABLES
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

    monkeypatch.setattr(attention, "plan", lambda *_: [soft, vap_job])
    monkeypatch.setattr(attention, "prepare", lambda _: None)
    monkeypatch.setattr(attention, "register_personal", register)
    monkeypatch.setattr(
        attention, "results", lambda work, jobs, **_: ((job, {"episodes": []}) for job in jobs)
    )
    with pytest.raises(KeyboardInterrupt):
        attention.run_replay(tmp_path, tmp_path, attention.Wanted(), progress=False)
    assert learned == ["vap", "soft"]
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["vap.json"]


def test_of_several_policies_one_is_asked_for_and_sub_goals_are_refused(tmp_path: Path) -> None:
    table = DATA / "results" / "shared.parquet"
    pair = attention.Wanted(suites=("shared-pair",), methods=("vap",))
    with pytest.raises(
        BadStudy, match=r"by mini_pi0:mini-pi0-shared-pair@.* choose one with --pol"
    ):
        attention.plan(table, tmp_path, pair)
    for policy in ("mini-pi0-shared-pair@", "mini-pi0-tabletop-longer@"):
        jobs = attention.plan(table, tmp_path, replace(pair, policy=policy))
        assert {policy in job.policy for job in jobs} == {True}
        assert sum(len(job.rows) for job in jobs) == 100
    with pytest.raises(BadStudy, match=r"shared-sequence in .* have sub-goals"):
        attention.plan(table, tmp_path, replace(pair, suites=("shared-sequence",)))


def test_an_episode_is_named_and_found_in_its_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran: list[tuple[str, int]] = []

    def found(study: Any, line: Any) -> None:
        ran.append((line["suite"], line["episode"]))
        raise KeyboardInterrupt

    monkeypatch.setattr(attention, "listed_row", found)
    table = DATA / "results" / "mini_pi0.parquet"
    name = "simpler-bridge/pick-shaver/soft/12"
    line = {
        "suite": "simpler-bridge",
        "task": "pick-shaver",
        "method": "soft",
        "episode": 12,
        "seed": 0,
    }
    assert attention.name_of(line) == name
    assert attention.name_of({**line, "seed": 3}) == f"{name}/3"
    with pytest.raises(KeyboardInterrupt):
        attention.record(table, name, tmp_path / "new", tmp_path)
    assert ran == [("simpler-bridge", 12)]
    for wrong, words in (
        ("put-camera/22", "give SUITE/TASK/METHOD/EPISODE"),
        ("simpler-bridge/put-camera/soft/last", "give SUITE/TASK/METHOD/EPISODE"),
        ("simpler-bridge/put-camera/soft/²", "give SUITE/TASK/METHOD/EPISODE"),
        ("simpler-bridge/put-camera/soft/2200", "holds no episode"),
    ):
        with pytest.raises(BadStudy, match=words):
            attention.record(table, wrong, tmp_path, tmp_path)
