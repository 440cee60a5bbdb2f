"""Training from films: a training goes on where it stopped, or from another, and learns."""

import json
import random
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from shutil import copy, rmtree

import pytest
import torch
from safetensors.torch import load_file

from tests.command import refused, vap
from tests.deaths import die_before_each_rename
from tests.random_kills import kill_in, serving
from vap_core.base.errors import BadOutput
from vap_core.base.files import DATA, SHIPPED
from vap_core.base.types import Description
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.mini_pi0.learned_token import TokenTraining
from vap_core.policies.mini_pi0.vlm import load_vlm
from vap_make.films import demonstrations
from vap_make.films.dataset import data_sha256
from vap_make.films.demonstrations import Film, cached, thinned
from vap_make.policy import losses, taught
from vap_make.policy import train as policy
from vap_make.policy.commands import Known
from vap_make.recipe import RECIPES
from vap_make.vlm import train as vlm

SUITE = "simpler-bridge"
SMALL = {"width": 32, "depth": 2, "vision_width": 32, "vision_depth": 1, "expert_width": 32}
TINY = replace(RECIPES[SUITE], thin=1, **SMALL)


def known(films: list[Film]) -> Known:
    """The objects of the films, put into invented words."""
    names = [name for film in films for name in film.names]
    return Known({name: Description("white", "a tall camera, mostly white") for name in names})


def test_a_training_that_was_stopped_ends_like_one_that_was_not_in_more_processes_too(
    stage: tuple[Path, list[Film]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, _ = stage
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    monkeypatch.setattr(policy, "HELD_OUT", 2)
    recipe = replace(TINY, stages=2, steps=3, batch=3, draws=2, thin=2)
    cache = folder.parent
    whole = policy.train(recipe, tmp_path / "whole", cache=cache, jobs=1)
    first = policy.train(recipe, tmp_path / "torn", cache=cache, minutes=0.0, jobs=2)
    assert [line["step"] for line in first["log"]] == [1]
    policy.train(recipe, tmp_path / "torn", cache=cache, jobs=2)
    one, other = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "torn"))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    measured = "flow heat where hit turn goal_heat goal_where goal_hit"
    assert set(whole["held_out"]) == set(measured.split())
    assert whole["data_sha256"] == data_sha256(
        [film for n in range(2) for film in thinned(cached(folder, SUITE, 0, n), recipe.thin)]
    )
    with pytest.raises(BadOutput, match=r"another recipe \(rate 0.0014 there, 0.1 now\)"):
        policy.train(replace(recipe, rate=0.1), tmp_path / "torn", cache=cache)
    assert whole["recipe"]["held_out_category"] == "owl figurine"
    hours = whole["cpu_hours"]
    assert set(hours) == {"films", "captions", "vlm", "steps", "total"}
    assert hours["total"] == pytest.approx(sum(hours.values()) - hours["total"], abs=0.003)
    assert hours["films"] > 0
    trained = load_policy(tmp_path / "whole")
    assert trained.execute == 4
    assert (trained.action_size, set(trained.wanted)) == (
        7,
        {"observation.images.front", "observation.state"},
    )


def vlm_inputs(
    stage: tuple[Path, list[Film]], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[vlm.View], vlm.Recipe]:
    """Views of the stage, which a tiny recipe then trains on."""
    _, films = stage
    pool = [
        vlm.View(film.images[t, 0], film.ids[t, 0], film.names)
        for film in films
        for t in range(0, len(film.action), 6)
    ]
    monkeypatch.setattr(vlm, "views", lambda *args, **kwargs: (pool, 36.0))
    monkeypatch.setattr(vlm, "captions", lambda names, file, jobs: (known(films).captions, 0.0))
    return pool, vlm.Recipe(stages=1, steps=3, batch=4, **SMALL)


def test_a_vision_language_model_learns_and_resumes(
    stage: tuple[Path, list[Film]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, recipe = vlm_inputs(stage, monkeypatch)
    whole = vlm.train(recipe, tmp_path / "whole", jobs=1)
    vlm.train(recipe, tmp_path / "torn", minutes=0.0)
    vlm.train(recipe, tmp_path / "torn")
    one, other = (load_vlm(tmp_path / name).sha256() for name in ("whole", "torn"))
    assert one == other
    assert {"words", "heat", "hit", "where", "yes", "no"} <= set(whole["held_out"])
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    monkeypatch.setattr(taught, "TRAINING", TokenTraining(epochs=1, augmentations=1))
    monkeypatch.setattr(taught, "LEAST_ACCURACY", 0.0)
    grown = replace(TINY, stages=1, steps=4, batch=4, draws=1, taught=1, learned=1.0)
    options = {"cache": stage[0].parent, "jobs": 1}
    about = policy.train(grown, tmp_path / "policy", vlm=tmp_path / "whole", **options)
    shown = capsys.readouterr().err
    assert "descriptions: 100%" in shown
    assert "learned words: 100%" in shown
    trained = load_policy(tmp_path / "policy").policy
    assert about["vlm"] == one == trained.config.vlm
    assert about["taught"]["used"] == about["taught"]["objects"] > 0
    assert about["embedding_cosine"] == pytest.approx({"mean": 1.0, "least": 1.0})
    words = losses.embeddings(trained)
    taught_in = load_vlm(tmp_path / "whole").towers.paligemma.model.language_model
    assert torch.equal(words, taught_in.embed_tokens.weight), "words keep their meaning"
    begun = policy.train(replace(grown, steps=1), tmp_path / "begun", **options)
    assert about["taught"]
    assert not begun["taught"], "without a model there is nothing to learn a word in"


def test_a_training_that_is_ended_again_and_again_ends_like_one_that_was_not(
    stage: tuple[Path, list[Film]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    record_property: Callable[[str, object], None],
) -> None:
    """Before each of its renames: of a checkpoint, of the weights, of what was measured."""
    folder, _ = stage
    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    monkeypatch.setattr(policy, "HELD_OUT", 9)
    recipe = replace(TINY, stages=1, steps=3, batch=2, draws=1)
    whole, torn = tmp_path / "whole", tmp_path / "torn"

    def weights_are_absent_or_whole() -> None:
        if (torn / "model.safetensors").exists():
            load_file(torn / "model.safetensors")

    def train(out: Path) -> dict[str, object]:
        return policy.train(recipe, out, cache=folder.parent, every=1, jobs=1)

    about = train(whole)
    ends = die_before_each_rename(lambda: train(torn), weights_are_absent_or_whole)
    assert ends > 5
    record_property("cases", ends)
    one, other = (load_file(path / "model.safetensors") for path in (whole, torn))
    assert all(torch.equal(one[name], other[name]) for name in one)
    told = json.loads((torn / "training.json").read_text())
    assert [line["step"] for line in told["log"]] == [line["step"] for line in about["log"]]


@pytest.mark.sweep
@pytest.mark.parametrize(("name", "kills"), [("policy", 2), ("policy", 20), ("vlm", 10)])
def test_a_training_that_is_killed_at_random_moments_ends_the_same(
    stage: tuple[Path, list[Film]],
    tmp_path: Path,
    name: str,
    kills: int,
    record_property: Callable[[str, object], None],
) -> None:
    """It is forked from a process that runs nothing else: the fork of one with threads may hang."""
    cache = stage[0].parent
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    with serving("tests.test_policy_training") as server:
        server.whole(name, cache, tmp_path / "first")  # films, and what later ones have loaded
        seconds = server.whole(name, cache, whole)

        def killed(after_s: float) -> bool:
            if (torn / "training.json").exists():
                assert_same(torn, whole)
                rmtree(torn)
            return server.killed(after_s, name, cache, torn)

        for _ in kill_in(seconds, killed, kills, random.Random(kills)):
            for weights in torn.glob("[!.]*.safetensors"):
                load_file(weights)
        server.whole(name, cache, torn)
    assert_same(torn, whole)
    record_property("cases", kills)


def assert_same(torn: Path, whole: Path) -> None:
    files = {path.name for path in whole.glob("[!.]*.safetensors")}
    assert files
    assert files == {path.name for path in torn.glob("[!.]*.safetensors")}
    for name in files:
        one = load_file(whole / name)
        other = load_file(torn / name)
        assert one.keys() == other.keys()
        assert all(torch.equal(one[part], other[part]) for part in one)


def test_the_card_says_which_demonstrations_were_learned_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a dataset the cost is not known; of two stages none is held out."""

    def captions(names: Iterable[str], *where: object) -> tuple[dict[str, Description], float]:
        return {name: Description("white", "a tall thing, mostly white") for name in names}, 0.0

    monkeypatch.setattr(policy, "captions", captions)
    shown = DATA / "demonstrations" / SUITE
    recipe = replace(TINY, steps=1, batch=2, draws=1, seed=3)
    card = policy.train(recipe, tmp_path / "out", demonstrations=shown, jobs=1)
    assert card["demonstrations"] == {"suite": SUITE, "seed": 7, "stages": 2}
    assert (card["recipe"]["stages"], card["recipe"]["seed"]) == (2, 3)
    kept = json.loads((tmp_path / "out" / "training.json").read_text())
    assert kept == json.loads(json.dumps(card))
    assert set(card["cpu_hours"]) == {"vlm", "captions", "steps", "total"}
    assert card["held_out"] == {}
    with pytest.raises(BadOutput, match=f"shows {SUITE}, not vlabench"):
        policy.train(RECIPES["vlabench"], tmp_path / "other", demonstrations=shown)
    # What ships, as `locate` wants it, and nothing else that a training leaves.
    ships = {file.name for file in (SHIPPED / "mini-pi0-simpler-bridge-wide-seed-0").iterdir()}
    (tmp_path / "copy").mkdir()
    for name in ships:
        copy(tmp_path / "out" / name, tmp_path / "copy" / name)
    assert {file.name for file in (tmp_path / "out").iterdir()} > ships | {"recipe.json"}
    assert fingerprint(tmp_path / "copy") == fingerprint(tmp_path / "out")


def test_the_cost_of_a_model_whose_card_says_none_is_left_out() -> None:
    assert policy._vlm_cost_s(None) == 0.0
    known_s = policy._vlm_cost_s(SHIPPED / "mini-paligemma")
    assert known_s == pytest.approx(0.96 * 3600, rel=0.02)


def test_stages_are_refused_beside_demonstrations(tmp_path: Path) -> None:
    shown = ("--demonstrations", DATA / "demonstrations" / SUITE)
    line = refused("train", "policy", "--suite", SUITE, *shown, "--stages", "2", "--out", tmp_path)
    assert "--stages films scenes, --demonstrations takes all stages" in line
    assert not list(tmp_path.iterdir())


def test_that_no_film_was_held_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    card = {"held_out": {}, "cpu_hours": {"total": 0.1}}
    monkeypatch.setattr(policy, "train", lambda *asked, **how: card)
    words = ("train", "policy", "--suite", SUITE, "--vlm", SHIPPED / "mini-paligemma")
    assert vap(*words).stdout.startswith("no film was held out (every 19th stage is)")
    card["held_out"] = {"flow": 0.5}
    assert vap(*words).stdout.startswith('{\n "flow": 0.5\n}')


def test_films_of_what_is_held_out_are_refused(stage: tuple[Path, list[Film]]) -> None:
    _, films = stage
    policy._require_trainable(TINY, films)
    held_out = replace(films[0], task="put-owl-figurine")
    with pytest.raises(BadOutput, match="the films show put-owl-figurine"):
        policy._require_trainable(TINY, [*films, held_out])
    personal = replace(films[0], names=("camera-personal", *films[0].names[1:]))
    with pytest.raises(ValueError, match="camera-personal belong to evaluation"):
        policy._require_trainable(TINY, [personal])


def test_a_model_that_is_whole_is_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    monkeypatch.setattr(vlm, "train", lambda recipe, *args, **kwargs: calls.append(recipe))
    card = {"recipe": vars(vlm.Recipe()), "trained_steps": vlm.Recipe().steps - 1}
    for steps, trained in ((vlm.Recipe().steps - 1, 1), (vlm.Recipe().steps, 0)):
        calls.clear()
        (tmp_path / "training.json").write_text(json.dumps(card | {"trained_steps": steps}))
        assert vlm.make(tmp_path) == tmp_path
        assert len(calls) == trained


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("perception",), "--out"),
        (("perception",), "--cache"),
        (("vlm",), "--out"),
        (("vlm",), "--cache"),
        (("policy", "--suite", SUITE, "--vlm", SHIPPED / "mini-paligemma"), "--out"),
        (("policy", "--suite", SUITE, "--vlm", SHIPPED / "mini-paligemma"), "--cache"),
        (("demonstrations", "--suite", SUITE), "--out"),
    ],
)
def test_a_folder_that_cannot_be_written_is_said_before_the_work(
    words: tuple[str | Path, ...], option: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    out = () if option == "--out" else ("--out", tmp_path / "out")
    line = refused("train", *words, *out, option, tmp_path / "file" / "in-it")
    told = (
        re.escape(f"{tmp_path}/file/in-it")
        + r"(/perception)? cannot be written \(Not a directory\)"
    )
    assert re.search(told, line)
    assert f"choose another folder with {option}" in line


def test_what_a_training_grows_from_is_read_before_the_films(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "load_films", lambda *asked: pytest.fail("films were asked for"))
    folders = ("--out", tmp_path / "out", "--cache", tmp_path / "cache")
    line = refused("train", "policy", "--suite", SUITE, *folders, "--vlm", "nowhere")
    assert "nowhere holds no mini-paligemma" in line.lower()
