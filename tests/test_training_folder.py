"""What a training leaves in folders: never lost to another training, told when it is damaged."""

import errno
import json
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.command import refused
from tests.full_disk import full_disk
from tests.test_policy_ahead import frames_of
from tests.test_policy_training import SUITE, TINY, known, vlm_inputs
from vap_core.base.errors import BadOutput, VapError
from vap_core.base.files import DATA, SHIPPED, sha256_of, writing
from vap_core.base.types import Description
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.learned_token import Token
from vap_core.policies.mini_pi0.vlm import MiniVlm, load_vlm
from vap_core.simulation.suites import suite
from vap_make.films import demonstrations, scenes
from vap_make.films.captions import captions
from vap_make.films.demonstrations import Film, draw_objects, row
from vap_make.films.looks import draw_look
from vap_make.folder import checkpoint
from vap_make.perception.detector import save_array
from vap_make.perception.fitting import Run, fit
from vap_make.policy import taught
from vap_make.policy import train as policy
from vap_make.policy.ahead import Ahead
from vap_make.policy.batches import Frames
from vap_make.policy.losses import Learner
from vap_make.recipe import FILMED, RECIPES, filmed_tasks
from vap_make.step import Schedule, train_steps
from vap_make.vlm import train as vlm


def test_a_model_that_ships_is_not_trained_over(tmp_path: Path) -> None:
    grown = copytree(SHIPPED / "mini-pi0-simpler-bridge-wide-seed-0", tmp_path / "mini-pi0")
    root = copytree(SHIPPED / "mini-paligemma", tmp_path / "mini-paligemma")
    weights = [grown / "model.safetensors", root / "vlm.safetensors"]
    before = [sha256_of(path) for path in weights]
    with pytest.raises(BadOutput, match=r"holds a model without training\.pt.*another --out"):
        policy.train(RECIPES[SUITE], grown, cache=tmp_path, minutes=0.0)
    with pytest.raises(BadOutput, match=r"holds a model without training\.pt.*another --out"):
        vlm.train(vlm.Recipe(), root, cache=tmp_path)
    assert [sha256_of(path) for path in weights] == before


def test_another_recipe_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = []

    def load_films(*args: object) -> policy.Films:
        began.append(args)
        return policy.Films([], [])

    monkeypatch.setattr(policy, "load_films", load_films)
    out = tmp_path / "out"
    with pytest.raises(BadOutput, match="holds no film"):
        policy.train(replace(TINY, seed=2), out, cache=tmp_path)  # of which nothing is kept
    (out / "captions.json").write_text("{}")
    (out / "recipe.json").unlink()
    for recipe, message in (
        (TINY, "holds no film"),
        (replace(TINY, seed=1), "another recipe .seed 0 there, 1 now."),
        (TINY, "holds no film"),
    ):
        with pytest.raises(BadOutput, match=message):
            policy.train(recipe, out, cache=tmp_path)
    assert len(began) == 3


HOLD = """
import fcntl, pathlib, sys
from vap_core.study.store import locked
with locked(pathlib.Path(sys.argv[1]), fcntl.lockf):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("train", [lambda out: policy.train(TINY, out), vlm.make])
def test_one_process_trains_in_a_folder(train: Callable[[Path], object], tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(BadOutput, match="another process is working in"):
            train(tmp_path)
        other.kill()
    assert not list(tmp_path.glob("[!.]*"))


def _half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _bit(data: bytes) -> bytes:
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]


@pytest.mark.parametrize("damage", [lambda data: b"", _half, _bit])
def test_damaged_films_are_told(
    damage: Callable[[bytes], bytes], stage: tuple[Path, list[Film]], tmp_path: Path
) -> None:
    whole = demonstrations.stage_file(stage[0], SUITE, 0, 1).read_bytes()
    film = demonstrations.stage_file(tmp_path, SUITE, 0, 0)
    film.write_bytes(damage(whole))
    with pytest.raises(BadOutput, match=f"{film} is damaged .*; delete it and run the same"):
        demonstrations.cached(tmp_path, SUITE, 0, 0)


@pytest.mark.parametrize("content", [b"", b"\x00\xff", b"{", b"[]", b"{}", b"PK\x03\x04half"])
def test_other_damaged_files_of_a_training_are_told(content: bytes, tmp_path: Path) -> None:
    scene = scenes.stage_file(tmp_path, 0, 0, False)
    state = tmp_path / "training.pt"
    described = tmp_path / "captions.json"
    words = tmp_path / "words.json"
    readers: dict[Path, Callable[[], object]] = {
        scene: lambda: scenes.cached(tmp_path, 0, 0),
        state: lambda: checkpoint(state, resume=True),
        described: lambda: captions(["camera-0"], described),
        words: lambda: taught.learn_words(tmp_path, [], 1, tmp_path),
    }
    for path, read in readers.items():
        path.write_bytes(content)
        with pytest.raises(BadOutput, match=f"{path} is damaged"):
            read()
        path.unlink()


@pytest.mark.parametrize("at", ["films", "recipe", "weights"])
def test_a_full_disk_is_one_line(
    at: str, stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    recipe = replace(TINY, stages=2, steps=1, batch=3, draws=2)
    place = {
        "films": "vap_make.films.demonstrations.write_atomic",
        "recipe": "vap_make.folder.write_atomic",
        "weights": "vap_make.policy.train.store_in_bfloat16",
    }[at]
    monkeypatch.setattr(place, full)
    if at == "films":
        with pytest.raises(BadOutput, match="cannot be written .No space left on device"):
            demonstrations.cached(tmp_path, SUITE, 0, 0)
        return
    with pytest.raises(BadOutput, match="cannot be written .No space left on device"):
        policy.train(recipe, tmp_path / "out", cache=stage[0].parent, jobs=1)


def test_a_disk_that_is_full_while_weights_are_written_is_one_line(tmp_path: Path) -> None:
    """Of a real limit of the file system: torch and safetensors raise errors of their own."""
    _, save = checkpoint(tmp_path / "training.pt", resume=False)
    save({"step": 1})
    message = "cannot be written .File too large"
    with pytest.raises(BadOutput, match=message), full_disk(30_000), writing(tmp_path, "train"):
        save({"step": 2, "model": torch.zeros(100_000)})
    assert checkpoint(tmp_path / "training.pt", resume=True)[0] == {"step": 1}

    config: Any = load_policy(SHIPPED / "mini-pi0-simpler-bridge-wide-seed-0").policy.config
    learner, held = Learner(config), object.__new__(Frames)
    out = tmp_path / "out"
    out.mkdir()
    message = r"^train policy: .*out cannot be written .*; make room"
    with pytest.raises(BadOutput, match=message), full_disk(30_000):
        policy.save(learner=learner, stats=None, held=held, card={}, out=out)
    assert not list(out.iterdir())

    with pytest.raises(BadOutput, match="cannot be written"), full_disk(30_000):
        save_array(tmp_path / "detector.npy", np.zeros(100_000))
    assert [path.name for path in tmp_path.glob("*.npy")] == []


def test_a_model_does_not_go_on_with_other_views(
    stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool, recipe = vlm_inputs(stage, monkeypatch)
    vlm.train(recipe, tmp_path, minutes=0.0)
    monkeypatch.setattr(vlm, "views", lambda *args, **kwargs: (pool[1:], 0.0))
    with pytest.raises(BadOutput, match="another recipe or other data"):
        vlm.train(recipe, tmp_path)
    looks = known(stage[1]).captions
    assert vlm.data_sha256(pool, looks) != vlm.data_sha256(pool[::-1], looks)


Trained = Callable[..., dict[str, Any]]
"""Begins or goes on with a tiny training in tmp_path / out for one step, `--vlm` by its name."""


@pytest.fixture
def train_one(
    stage: tuple[Path, list[Film]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Trained:
    short = replace(TINY, stages=1, steps=9, batch=2, draws=1)
    first = stage[1][0]
    config = policy.configuration(short, first.state.shape[1], first.action.shape[1])
    for name in ("one", "another"):
        MiniVlm(config).save(tmp_path / name)

    def captions(names: Iterable[str], *where: object) -> tuple[dict[str, Description], float]:
        return {name: Description("white", "a tall thing, mostly white") for name in names}, 0.0

    def learn(vlm: Path, folder: Path, *how: object) -> tuple[float, float]:
        embedding = np.zeros(short.width, np.float32)
        learned_token.save(folder, Token(how[-1][0], embedding, 0.5, load_vlm(vlm).sha256()))
        return 0.5, 0.0

    monkeypatch.setattr(demonstrations, "EPISODES", 2)
    monkeypatch.setattr(policy, "captions", captions)
    monkeypatch.setattr(taught, "_learn", learn)

    def train(out: str, vlm: str = "", **changes: object) -> dict[str, Any]:
        return policy.train(
            replace(short, **changes),
            tmp_path / out,
            vlm=tmp_path / vlm if vlm else None,
            cache=stage[0].parent,
            minutes=0.0,
            jobs=1,
        )

    return train


OTHER = "holds a training with another mini-PaliGemma, or with none; go on with the same --vlm"


@pytest.mark.parametrize(("first", "then"), [("one", ""), ("", "one")])
def test_a_training_goes_on_with_the_words_that_it_began_with(
    first: str, then: str, train_one: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = train_one("out", first)
    assert begun["taught_in"] == (load_vlm(tmp_path / "one").sha256() if first else "")
    assert train_one("out", first)["trained_steps"] == 2
    with monkeypatch.context() as stopped:
        stopped.setattr(policy, "load_films", lambda *asked: pytest.fail("films were asked for"))
        with pytest.raises(BadOutput, match=OTHER):
            train_one("out", then)
    # As earlier code left it.
    state = torch.load(tmp_path / "out" / "training.pt", weights_only=True)
    made_of = json.loads(state["made_of"])
    del made_of["taught_in"]
    torch.save({**state, "made_of": json.dumps(made_of)}, tmp_path / "out" / "training.pt")
    assert train_one("out", first)["trained_steps"] == 3
    with pytest.raises(BadOutput, match=OTHER):
        train_one("out", then)


def test_words_of_another_model_are_found_before_the_work(
    train_one: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = tmp_path / "out" / "words" / "words.json"
    with monkeypatch.context() as stopped:
        stopped.setattr(policy, "train_steps", lambda *asked: pytest.fail("killed after words"))
        with pytest.raises(pytest.fail.Exception):
            train_one("out", "one")
    kept = json.loads(words.read_text())
    assert kept["model"] == load_vlm(tmp_path / "one").sha256()
    before = {path.name: path.read_bytes() for path in words.parent.iterdir()}
    with monkeypatch.context() as stopped:
        stopped.setattr(policy, "load_films", lambda *asked: pytest.fail("films were asked for"))
        with pytest.raises(BadOutput, match="words were learned in another mini-PaliGemma"):
            train_one("out", "another")
    assert {path.name: path.read_bytes() for path in words.parent.iterdir()} == before
    words.write_text(json.dumps({name: kept[name] for name in ("cpu_s", "accuracy")}))
    assert train_one("out", "one")["taught"]["objects"] == len(kept["accuracy"])
    with pytest.raises(BadOutput, match=OTHER):
        train_one("out", "another")


def test_the_remedy_for_a_damaged_checkpoint_works(train_one: Trained, tmp_path: Path) -> None:
    """Beside the model that the training has written, too, and beside what a killed save left."""
    train_one("out")
    state = tmp_path / "out" / "training.pt"
    model = tmp_path / "out" / "model.safetensors"
    (tmp_path / "out" / ".saving-abc").mkdir()
    (tmp_path / "out" / ".saving-abc" / model.name).write_bytes(b"half")
    state.write_bytes(_half(state.read_bytes()))
    remedy = r"training\.pt is damaged .*; delete it, with model\.safetensors beside it, and run"
    with pytest.raises(BadOutput, match=remedy):
        train_one("out")
    state.unlink()
    model.unlink()
    assert train_one("out")["trained_steps"] == 1
    assert model.exists()
    assert not list(state.parent.glob(".saving-*"))


def test_what_is_refused_is_told_before_a_model_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`train policy` without --vlm trains the mini-PaliGemma first, for half an hour of CPU."""
    monkeypatch.setattr(vlm, "make", lambda *asked, **how: pytest.fail("a model was made"))
    (tmp_path / "file").write_text("no folder")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "recipe.json").write_text("{}")
    (tmp_path / "other" / "captions.json").write_text("{}")
    begun = tmp_path / "begun" / "out"
    begun.mkdir(parents=True)
    (begun / "recipe.json").write_text(json.dumps(RECIPES[SUITE].as_json()))
    torch.save({"made_of": json.dumps({"vlm": "aa"})}, begun / "training.pt")
    shown = DATA / "demonstrations" / SUITE
    for words, told in (
        (("--suite", SUITE, "--out", begun), OTHER),
        (("--suite", SUITE, "--device", "tpu"), "tpu"),
        (("--suite", "vlabench", "--demonstrations", shown), f"shows {SUITE}, not vlabench"),
        (("--suite", SUITE, "--demonstrations", tmp_path), "holds no demonstrations"),
        (("--suite", SUITE, "--out", tmp_path / "file" / "in"), "choose another folder with --out"),
        (("--suite", SUITE, "--cache", tmp_path / "file" / "in"), "another folder with --cache"),
        (("--suite", SUITE, "--out", tmp_path / "other"), "holds a training with another recipe"),
    ):
        folder = () if "--out" in words else ("--out", tmp_path / "out")
        assert told in refused("train", "policy", *words, *folder)


def test_films_of_another_rate_are_not_taken(
    stage: tuple[Path, list[Film]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their pictures would stand beside states of other moments."""
    monkeypatch.setattr(demonstrations, "every", lambda suite_name: 2)
    message = (
        r"films of another recipe \(\d+ pictures of \d+ steps, one is wanted every 2\); choose"
    )
    with pytest.raises(BadOutput, match=message):
        demonstrations.cached(stage[0], SUITE, 0, 0)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"cpu_hours": []}', '{"cpu_hours": {"total": "long"}}']
)
def test_a_damaged_card_of_a_model_leaves_its_cost_unknown(content: str, tmp_path: Path) -> None:
    (tmp_path / "training.json").write_text(content)
    assert policy._vlm_cost_s(tmp_path) is None


@pytest.mark.parametrize("fault", ["loss", "gradient"])
def test_a_training_that_diverges_is_said_and_not_kept(fault: str, tmp_path: Path) -> None:
    """A finite loss of which a gradient is not, before the last step, is found as it is saved."""

    def losses(model: nn.Linear, step: int) -> tuple[Tensor, dict[str, float]]:
        loss = model(torch.ones(1, 2)).square().sum()
        if step == 4:
            loss = loss * torch.nan if fault == "loss" else (loss * 0).sqrt()
        return loss, {"flow": float(loss.detach())}

    def run(steps: int) -> Schedule:
        return Schedule(name="x", steps=steps, rate=0.1, every=2, slower="lower --rate")

    told = {"loss": "the loss is", "gradient": "the weights are"}[fault]
    message = f"{told} not finite at step 5; lower --rate, with another --out"
    with pytest.raises(BadOutput, match=message):
        train_steps(nn.Linear(2, 1), losses, run(5), tmp_path)
    kept = torch.load(tmp_path / "training.pt", weights_only=True)
    assert kept["step"] == 4
    for part in ("model", "mean"):
        assert all(weight.isfinite().all() for weight in kept[part].values())
    with pytest.raises(BadOutput, match="loss is not finite at step [56]; lower --rate"):
        train_steps(nn.Linear(2, 1), losses, run(6), tmp_path)


def of_looks(folder: Path, rate: float, epochs: int = 1) -> Run:
    about = {"name": "looks", "seed": 0, "decay": 0.0, "file": folder / "looks.pt"}
    return Run(**about, rate=rate, epochs=epochs, resume=True, expired=lambda: False)


@pytest.mark.parametrize("fault", ["loss", "gradient"])
def test_a_head_that_diverges_is_said_and_not_kept(fault: str, tmp_path: Path) -> None:
    epochs = []

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        epochs.append(rng)
        loss = head(torch.ones(1, 2)).square().sum()
        if len(epochs) == 2:
            loss = loss * torch.nan if fault == "loss" else (loss * 0).sqrt()
        yield loss

    head = nn.Linear(2, 1)
    run = of_looks(tmp_path, 0.1, epochs=3)
    told = {"loss": "loss is not finite at batch 1 of", "gradient": "weights are not finite after"}
    message = f"looks head's {told[fault]} epoch 2; run it again with another --seed"
    with pytest.raises(BadOutput, match=message):
        fit(head, losses, 1, run)
    kept = torch.load(tmp_path / "looks.pt", weights_only=True)
    assert kept["epoch"] == 1
    assert all(weight.isfinite().all() for weight in kept["head"].values())


def test_a_head_that_was_trained_otherwise_is_not_taken(tmp_path: Path) -> None:
    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        yield head(torch.ones(1, 2)).sum()

    head = nn.Linear(2, 1)
    fit(head, losses, 1, of_looks(tmp_path, 0.1))
    fit(head, losses, 1, of_looks(tmp_path, 0.1))
    with pytest.raises(BadOutput, match=r"looks\.pt is of a looks head that was trained otherwise"):
        fit(head, losses, 1, of_looks(tmp_path, 0.2))
    head = nn.Linear(2, 2)
    with pytest.raises(BadOutput, match="trained otherwise"):
        fit(head, losses, 1, of_looks(tmp_path, 0.1))


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_drawing_is_no_lack_of_memory(
    jobs: int, stage: tuple[Path, list[Film]]
) -> None:
    frames = frames_of(stage[1], steps=4)

    def draw(size: int, rng: np.random.Generator) -> None:
        raise RuntimeError("sizes do not match")

    object.__setattr__(frames, "draw", draw)
    ahead = Ahead(frames, jobs)
    with pytest.raises(RuntimeError, match="sizes do not match") as caught:
        ahead.take(0)
    assert not isinstance(caught.value, VapError)
    ahead.close()


SHOT = {
    "simpler-bridge": 2554692062,
    "simpler-fractal": 3119909856,
    "vlabench": 962462400,
    "tabletop": 3782247233,
    "shared-pair": 1580424473,
}
"""A checksum of the first stage's look, objects and places, by suite."""


@pytest.mark.parametrize("name", sorted(FILMED))
def test_films_that_change_are_kept_elsewhere(name: str) -> None:
    """A cache holds films of older code: where films change, `FILMS` needs another name, too."""
    rng = np.random.default_rng([71, 0, *name.encode(), 0])
    task = filmed_tasks(name)[0]
    look = draw_look(rng)
    names = draw_objects(suite(name), task, rng)
    start = row(suite(name), task, names, 0, rng)
    shown = json.dumps([repr(look), names, repr(start.placements)])
    assert (policy.FILMS, zlib.crc32(shown.encode())) == ("dyed-films", SHOT[name])
