"""What a checkpoint's files hold decides what it does: statistics that are absent, runs and scratch beside them, weights that were replaced."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests import tiny_lerobot as tiny
from tests.toys import personal
from vap_core.base.errors import BadPolicy
from vap_core.memory import save
from vap_core.perception.stacks import load_stack
from vap_core.policies.lerobot.adapter import load_for_suite, load_policy
from vap_core.policies.lerobot.checkpoints import PIPELINES, RUN, fingerprint
from vap_core.policies.lerobot.step import attach
from vap_core.policies.names import label_of
from vap_core.simulation import suites
from vap_core.simulation.scenes import build
from vap_core.study.store import open_run

BEFORE = "policy_preprocessor_step_3_normalizer_processor.safetensors"
AFTER = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
STATE = "observation.state"
Tensors = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.act(tmp_path_factory.mktemp("checkpoints") / "act")


@pytest.fixture
def copy(act: Path, tmp_path: Path) -> Path:
    return shutil.copytree(act, tmp_path / "copy")


def change(file: Path, changed: Callable[[str, torch.Tensor], tuple[str, torch.Tensor]]) -> None:
    kept = load_file(file)
    save_file(dict(changed(key, tensor) for key, tensor in kept.items()), file)


def renamed(key: str, tensor: torch.Tensor) -> tuple[str, torch.Tensor]:
    return key.replace(STATE, "observation.joints").replace("action.", "actions."), tensor


def short(key: str, tensor: torch.Tensor) -> tuple[str, torch.Tensor]:
    return key, tensor[:-1].contiguous() if key.startswith((STATE, "action")) else tensor


@pytest.mark.parametrize(
    ("file", "of"), [(BEFORE, STATE), (AFTER, "action")], ids=["state", "action"]
)
def test_a_checkpoint_without_its_statistics_is_refused(copy: Path, file: str, of: str) -> None:
    """lerobot's normaliser would hand on what it was given, unscaled."""
    assert any(key.startswith(of) for key in load_file(copy / file))
    whole = (copy / file).read_bytes()
    numbers = {STATE: tiny.STATE, "action": tiny.ACTION}[of]
    for changed, fault in (
        (renamed, f"has no statistics of {of}"),
        (short, f"has statistics of {of} for {numbers - 1} numbers, where it has {numbers}"),
    ):
        change(copy / file, changed)
        with pytest.raises(BadPolicy, match=f"{fault}; save it with the dataset's statistics"):
            load_policy(copy)
        (copy / file).write_bytes(whole)
    load_policy(copy)
    name = file.partition("_step")[0] + ".json"
    pipeline = json.loads((copy / name).read_text())
    for step in pipeline["steps"]:
        step.pop("state_file", None)
    (copy / name).write_text(json.dumps(pipeline))
    with pytest.raises(
        BadPolicy, match=r"has no statistics of (observation\.images\.front|action)"
    ):
        load_policy(copy)


@pytest.mark.parametrize("kind", ["STATE", "VISUAL"])
def test_what_is_not_scaled_needs_no_statistics(copy: Path, kind: str) -> None:
    """Where the checkpoint says IDENTITY; statistics of the others are needed still."""
    file = copy / "policy_preprocessor.json"
    pipeline = json.loads(file.read_text())
    (step,) = [step for step in pipeline["steps"] if "norm_map" in step["config"]]
    step["config"]["norm_map"][kind] = "IDENTITY"
    file.write_text(json.dumps(pipeline))
    of = {"STATE": STATE, "VISUAL": "observation.images"}[kind]
    kept = {key: t for key, t in load_file(copy / BEFORE).items() if not key.startswith(of)}
    save_file(kept, copy / BEFORE)
    load_policy(copy)
    save_file({"nothing.mean": torch.zeros(1)}, copy / BEFORE)
    with pytest.raises(BadPolicy, match="has no statistics of"):
        load_policy(copy)


def test_statistics_follow_the_checkpoints_rename_map(copy: Path) -> None:
    """They are of the name that the renaming gives, as the normaliser comes after it."""
    file = copy / "policy_preprocessor.json"
    pipeline = json.loads(file.read_text())
    steps = pipeline["steps"]
    rename = {"observation.images.head": "observation.images.front", "observation.qpos": STATE}
    steps[0]["config"]["rename_map"] = rename
    file.write_text(json.dumps(pipeline))
    assert set(load_policy(copy).wanted) == set(rename)
    (scale,) = [step for step in steps if "norm_map" in step["config"]]
    # Behind the normaliser, which then meets the old names.
    steps.append(steps.pop(0))
    file.write_text(json.dumps(pipeline))
    with pytest.raises(BadPolicy, match=r"no statistics of observation\.(images\.head|qpos)"):
        load_policy(copy)
    old_of = {new: old for old, new in rename.items()}
    features = scale["config"]["features"]
    scale["config"]["features"] = {old_of.get(key, key): value for key, value in features.items()}
    file.write_text(json.dumps(pipeline))

    def to_old(key: str, tensor: torch.Tensor) -> tuple[str, torch.Tensor]:
        name, _, part = key.rpartition(".")
        return f"{old_of.get(name, name)}.{part}", tensor

    change(copy / BEFORE, to_old)
    load_policy(copy)


def test_a_run_or_scratch_in_its_folder_is_no_part_of_a_checkpoint(copy: Path) -> None:
    before = fingerprint(copy), label_of(copy)
    run = open_run(copy / "eval", {"suite": "simpler-bridge"})
    assert (run / RUN).is_file()
    (run / "memory" / "mug").mkdir(parents=True)
    scratch = copy / ".saving-abc"
    scratch.mkdir()
    for file in (run / "memory" / "mug" / "object.json", run / "left.safetensors"):
        file.write_text("{}")
    shutil.copy(copy / "model.safetensors", scratch)
    assert (fingerprint(copy), label_of(copy)) == before
    (copy / "tokenizer").mkdir()
    (copy / "tokenizer" / "tokenizer.json").write_text("{}")
    assert fingerprint(copy) != before[0], "what it reads its commands by"


def test_a_checkpoint_that_was_trained_on_is_loaded_again(copy: Path) -> None:
    """As in a notebook, whose process goes on; a run's table names the weights that acted."""
    known = suites.suite("simpler-bridge")
    (row,) = suites.rows("simpler-bridge", "put-camera", 1)
    with build(known.robot, [place.model for place in row.placements]) as scene:
        first = load_for_suite(str(copy), scene, known)
        (copy / "training.json").write_text("{}")
        assert load_for_suite(str(copy), scene, known) is first
        again = copy / "again.safetensors"
        shutil.copy(copy / "model.safetensors", again)
        change(
            again, lambda key, tensor: (key, tensor + 1 if tensor.is_floating_point() else tensor)
        )
        os.replace(again, copy / "model.safetensors")
        second = load_for_suite(str(copy), scene, known)
    assert second.label == label_of(copy) != first.label
    assert second.sha256() != first.sha256()


CODE = (
    {"class": "subprocess.Popen", "config": {"args": "id"}},
    {"class": "lerobot.processor.pipeline.import_module", "config": {}},
    {"class": "builtins.exec"},
    {"registry_name": None, "class": "os.system"},
)
DOORS = {
    "load": lambda folder, out: load_policy(folder),
    "attach": lambda folder, out: attach(folder, out / "attached", out / "memory"),
}


@pytest.mark.parametrize("pipeline", PIPELINES)
@pytest.mark.parametrize("door", DOORS)
def test_no_door_lets_a_checkpoint_name_code(
    copy: Path, tmp_path: Path, door: str, pipeline: str
) -> None:
    mug = personal("mug", "cup", (40, 120, 110))
    save(tmp_path / "memory", replace(mug, encoder=load_stack("embedded").encoder.name))
    whole = json.loads((copy / pipeline).read_text())
    for step in CODE:
        steps = [*whole["steps"], step]
        (copy / pipeline).write_text(json.dumps({**whole, "steps": steps}))
        with pytest.raises(BadPolicy, match=f"asks to run '{step['class']}', which is no step"):
            DOORS[door](copy, tmp_path)
    assert not (tmp_path / "attached").exists()


def negative(key: str, tensor: torch.Tensor) -> tuple[str, torch.Tensor]:
    return key, -tensor if key.endswith("std") else tensor


def endless(key: str, tensor: torch.Tensor) -> tuple[str, torch.Tensor]:
    return key, tensor * float("nan") if tensor.is_floating_point() else tensor


@pytest.mark.parametrize(
    ("file", "changed", "words"),
    [
        ("model.safetensors", endless, "has numbers that are not finite; copy it again"),
        (BEFORE, endless, "has statistics of observation.* is no number, or negative"),
        (AFTER, endless, "has statistics of action whose .* is no number, or negative"),
        (AFTER, negative, "has statistics of action whose std is no number, or negative"),
    ],
)
def test_numbers_that_are_none_are_refused(
    copy: Path, file: str, changed: Callable[..., tuple[str, torch.Tensor]], words: str
) -> None:
    """They loaded, and every action was NaN."""
    change(copy / file, changed)
    with pytest.raises(BadPolicy, match=words):
        load_policy(copy)


@pytest.mark.parametrize("door", DOORS)
def test_no_door_reads_beyond_the_folder(copy: Path, tmp_path: Path, door: str) -> None:
    """A configuration that is a device once filled the memory."""
    mug = personal("mug", "cup", (40, 120, 110))
    save(tmp_path / "memory", replace(mug, encoder=load_stack("embedded").encoder.name))
    whole = (copy / PIPELINES[0]).read_text()
    (copy / PIPELINES[0]).write_text(whole.replace(BEFORE, f"../act/{BEFORE}"))
    with pytest.raises(BadPolicy, match=f"reads '../act/{BEFORE}', outside of its folder"):
        DOORS[door](copy, tmp_path)
    (copy / "config.json").unlink()
    (copy / "config.json").symlink_to("/dev/zero")
    with pytest.raises(BadPolicy, match=r"lacks config\.json|it is no regular file"):
        DOORS[door](copy, tmp_path)


def test_what_is_no_file_of_a_checkpoint_is_not_attached(copy: Path, tmp_path: Path) -> None:
    mug = personal("mug", "cup", (40, 120, 110))
    save(tmp_path / "memory", replace(mug, encoder=load_stack("embedded").encoder.name))
    for name in ("modeling.py", "state.pkl", "weights.bin"):
        (copy / name).write_bytes(b"x")
    (copy / "tokenizer").mkdir()
    (copy / "tokenizer" / "evil.py").touch()
    (copy / "tokenizer" / "tokenizer.json").write_text("{}")
    attach(copy, tmp_path / "attached", tmp_path / "memory")
    assert [path.name for path in (tmp_path / "attached" / "tokenizer").iterdir()] == [
        "tokenizer.json"
    ]
    kept = {path.name for path in copy.iterdir()} - {"modeling.py", "state.pkl", "weights.bin"}
    assert {path.name for path in (tmp_path / "attached").iterdir()} == kept
