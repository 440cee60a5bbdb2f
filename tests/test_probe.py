"""The probe of a policy: every way says or shows what it should, on objects that no film has; its table is kept suite by suite."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vap_core.base.errors import BadPolicy, BadStudy, UnknownName
from vap_core.cli.measure import eval_policy
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.names import label_of, shipped_checkpoint
from vap_core.policies.protocol import PolicyInput
from vap_core.prompt import PALETTE
from vap_core.rollout.prompters import PromptContext, SceneTruth
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import ObjectModel
from vap_make.colours import stands_out
from vap_make.films.demonstrations import draw_models, row
from vap_make.objects import material_colours
from vap_make.policy import probe
from vap_make.policy.probe import WAYS, ProbePrompter, conclude, keep, of_shipped

from .command import refused
from .test_soft_prompt import SUITE, grown  # noqa: F401
from .toys import observation


def grey_scene(level: int) -> tuple[np.ndarray, np.ndarray, SceneTruth]:
    """A grey picture, the mask of the target in it, and the truth of an unseen object's scene."""
    known = suites.suite(SUITE)
    task = known.task("put-camera")
    models = draw_models(known, task, np.random.default_rng(3), held_out=True)
    names = [*(model.name for model in models), task.goal]
    start = row(known, task, names, 0, np.random.default_rng(0))
    rgb, mask = np.full((8, 8, 3), level, np.uint8), np.zeros((8, 8), bool)
    mask[2:5, 2:5] = True
    return rgb, mask, SceneTruth(start, {"front": {start.target: mask}})


def test_the_ways_differ_in_what_is_shown_and_said() -> None:
    rgb, mask, truth = grey_scene(120)
    start = truth.row
    seen, shown = observation({"front": rgb}), {}
    context = PromptContext(start.instruction, truth=truth)
    dyed = probe._with_dyed_target(start)
    word, _ = material_colours(dyed.target)
    for way in WAYS:
        if way == "coloured":
            masks = {"front": {dyed.target: mask}}
            context = replace(context, truth=SceneTruth(dyed, masks))
        state, attended = ProbePrompter(way).start(seen, context)
        ((again, later),) = ProbePrompter(way).steps([state], [seen], [context])
        assert again == state
        assert np.array_equal(later.images["front"], attended.images["front"])
        assert np.array_equal(attended.images["front"][~mask], rgb[~mask])
        assert (attended.images["front"][mask] != rgb[mask]).any() == (way == "tinted")
        shown[way] = attended
        context = PromptContext(start.instruction, truth=truth)
    assert shown["plain"].text == "put the camera on the plate"
    assert any(
        shown["tinted"].text
        in (
            f"put the {colour.name} camera on the plate",
            f"put my camera on the plate. My camera is {colour.name}.",
        )
        for colour in PALETTE
    )
    assert f" {word}" in shown["coloured"].text
    assert dyed.target.startswith(start.target)
    assert stands_out(word, [material_colours(name)[1] for name in probe._same_kind(start)[1:]])
    unseen = replace(context, truth=SceneTruth(start, {"front": {}}))
    _, hidden = ProbePrompter("tinted").start(seen, unseen)
    assert np.array_equal(hidden.images["front"], rgb)


def test_held_out_objects_are_in_no_film() -> None:
    known = suites.suite(SUITE)
    task = known.tasks[0]

    def drawn(held_out: bool) -> list[ObjectModel]:
        models = (draw_models(known, task, np.random.default_rng(i), held_out) for i in range(20))
        return list(itertools.chain(*models))

    assert not {model.name for model in drawn(False)} & {model.name for model in drawn(True)}
    assert {model.split for model in drawn(True)} == {"generic"}


def test_a_scene_is_played_in_every_way(
    grown: tuple[Path, Path],  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(probe, "EACH", 1)
    table = pd.DataFrame(probe._scene(str(grown[1]), SUITE, ("tinted", "plain"), None, 0, 0))
    assert table["method"].tolist() == ["tinted", "plain"]
    assert set(table["outcome"]) <= {"success", "failure"}
    assert "touches something" in conclude(table)
    keep(table, tmp_path / "probe.parquet")
    keep(table.assign(suite="vlabench"), tmp_path / "probe.parquet")
    keep(table, tmp_path / "probe.parquet")
    held = pd.read_parquet(tmp_path / "probe.parquet")
    assert held["suite"].tolist() == ["vlabench"] * 2 + [SUITE] * 2
    assert "detail" not in held
    (shorter,) = probe._scene(str(grown[1]), SUITE, ("plain",), 1, 0, 0)
    assert shorter["policy"] == f"{table['policy'][0]}, 1 of 4"


def test_another_way_to_ask_is_kept_beside_those_of_before(tmp_path: Path) -> None:
    """Only what was asked again, by suite, policy and way, takes the place of what was kept."""

    def asked(way: str, steps: int) -> pd.DataFrame:
        said = {"suite": SUITE, "policy": "mini_pi0:one", "method": way, "steps": steps}
        return pd.DataFrame([said])

    path = tmp_path / "probe.parquet"
    keep(asked("tinted", 5), path)
    keep(asked("plain", 6), path)
    keep(asked("tinted", 7).assign(policy="mini_pi0:other"), path)
    keep(asked("tinted", 8), path)
    held = pd.read_parquet(path)[["policy", "method", "steps"]]
    assert list(held.itertuples(index=False, name=None)) == [
        ("mini_pi0:one", "plain", 6),
        ("mini_pi0:other", "tinted", 7),
        ("mini_pi0:one", "tinted", 8),
    ]


def test_what_another_run_adds_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So the table is read before the work, to refuse it early, and again after it."""
    path = tmp_path / "probe.parquet"
    said = {"policy": "mini_pi0:one", "method": "plain", "task": "t", "success": True}
    said |= {"wrong_object": False, "touched": True}
    keep(pd.DataFrame([said | {"suite": "one"}]), path)

    def work(*args: object, **asked: object) -> pd.DataFrame:
        keep(pd.DataFrame([said | {"suite": "two"}]), path)
        return pd.DataFrame([said | {"suite": SUITE}])

    monkeypatch.setattr(probe, "probe", work)
    eval_policy(SUITE, out=path)
    assert pd.read_parquet(path)["suite"].tolist() == ["one", "two", SUITE]


def test_a_table_that_cannot_be_added_to_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe, "_scene", lambda *asked: pytest.fail("an episode was played"))
    monkeypatch.setattr(probe, "results", lambda **asked: pytest.fail("scenes were begun"))
    damaged, foreign, file = tmp_path / "bad.parquet", tmp_path / "other.parquet", tmp_path / "file"
    damaged.write_bytes(b"PAR1")
    pd.DataFrame({"suite": ["one"]}).to_parquet(foreign)
    file.touch()
    for out in (damaged, foreign, file / "probe.parquet"):
        before = out.read_bytes() if out.exists() else None
        told = refused("measure", "policy", "--suite", SUITE, "--out", out)
        assert told.startswith("error: probe: ")
        assert "--out" in told
        assert (out.read_bytes() if out.exists() else None) == before


def test_episodes_of_the_policy_that_ships_go_before_those_of_others() -> None:
    ships, other = label_of(shipped_checkpoint(SUITE)), "mini_pi0:mini-pi0-older@00c47015"
    table = pd.DataFrame({"suite": [SUITE, SUITE, "vlabench"], "policy": [other, ships, other]})
    chosen = of_shipped(table)
    assert list(chosen.itertuples(index=False, name=None)) == [
        (SUITE, ships, ""),
        ("vlabench", other, other),
    ]


def test_what_cannot_be_asked_for_is_told_in_a_line(grown: tuple[Path, Path]) -> None:  # noqa: F811
    with pytest.raises(UnknownName, match="way 'shouted' is unknown"):
        probe.probe(str(grown[1]), SUITE, ways=("shouted",))
    with pytest.raises(UnknownName, match="suite 'simpler-bridge-dev' is unknown"):
        probe.probe(str(grown[1]), "simpler-bridge-dev")
    with pytest.raises(BadStudy, match="shared-pair name two personal objects.*with eval"):
        probe.probe(str(grown[1]), "shared-pair")
    with pytest.raises(BadStudy, match="name one by --ways"):
        probe.probe(str(grown[1]), SUITE, ways=())
    with pytest.raises(BadPolicy, match="decides on 4 actions at a time; ask for 1 to 4"):
        load_policy(str(grown[1])).with_execute(5)


def test_fewer_actions_of_a_chunk_are_its_first(grown: tuple[Path, Path]) -> None:  # noqa: F811
    policy = load_policy(str(grown[1]))
    seen = PolicyInput(
        {"front": np.full((224, 224, 3), 90, np.uint8)},
        "pick up the red shaver",
        np.zeros(13, np.float32),
    )
    chunks = {
        n: one.plan([one.start(np.random.default_rng(0))], [seen])[1][0]
        for n, one in ((n, policy.with_execute(n)) for n in (1, 4))
    }
    assert np.array_equal(chunks[1], chunks[4][:1])
    assert policy.execute == 4
