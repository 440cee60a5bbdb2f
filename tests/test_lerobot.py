"""lerobot both ways: its policies drive our rollouts, and VAP personalises its own loop. The real classes, tiny and random."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests import tiny_lerobot as tiny
from vap_core.base.errors import BadPolicy
from vap_core.policies.lerobot import traced
from vap_core.policies.lerobot.adapter import LeRobot, load_for_suite, load_policy
from vap_core.policies.lerobot.checkpoints import (
    fingerprint,
    is_checkpoint_name,
    local_folder,
)
from vap_core.policies.lerobot.loading import compare
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.policies.names import SHIPPED, checkpoint_of, label_of
from vap_core.policies.protocol import TEXT, Policy, PolicyInput
from vap_core.rollout import calls
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.scenes import build

SUITE, TASK = "simpler-bridge", "put-camera"
EVERY = ("pi0", "pi05", "smolvla", "act", "ensemble")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("checkpoints")
    ensemble = tiny.act(root / "ensemble", n_action_steps=1, temporal_ensemble_coeff=0.01)
    made = {
        make.__name__: make(root / make.__name__)
        for make in (tiny.pi0, tiny.pi05, tiny.smolvla, tiny.act, tiny.vqbet)
    }
    return {**made, "ensemble": ensemble}


@pytest.fixture(scope="module")
def policies(folders):
    with toy_sizes(tiny.TOY):
        return {name: load_policy(folder) for name, folder in folders.items()}


def test_a_checkpoint_is_called_by_its_folder_from_inside_it_too(folders, monkeypatch):
    outside = label_of(folders["act"])
    assert checkpoint_of(outside) == "act"
    monkeypatch.chdir(folders["act"])
    assert label_of(".") == outside


def test_a_policy_without_a_temperature_is_given_none(folders):
    with toy_sizes(tiny.TOY), pytest.raises(BadPolicy, match="has no temperature; leave it out"):
        load_policy(folders["act"], temperature=0.5)


def look(i, text="put my camera on the plate", side=64):
    rng = np.random.default_rng(i)
    return PolicyInput(
        {"front": rng.integers(0, 256, (side, side, 3), np.uint8)},
        text,
        rng.standard_normal(tiny.STATE).astype(np.float32),
    )


def begin(policy, n):
    return [policy.start(np.random.default_rng([7, i])) for i in range(n)]


def run(policy, states, looks):
    states, chunks = policy.plan(states, looks)
    return np.stack(chunks)


@pytest.mark.parametrize("name", EVERY)
def test_the_contract_of_a_policy(policies, name):
    policy = policies[name]
    assert isinstance(policy, Policy)
    assert re.fullmatch(rf"{name.replace('ensemble', 'act')}:{name}@[0-9a-f]{{8}}", policy.label)
    assert checkpoint_of(policy.label) == name
    before = policy.sha256()
    states, chunks = policy.plan(begin(policy, 3), [look(i) for i in range(3)])
    assert len(states) == len(chunks) == 3
    for chunk in chunks:
        assert chunk.dtype == np.float32
        assert chunk.shape == (policy.execute, tiny.ACTION)
    assert policy.execute == {"pi0": 2, "pi05": 2, "smolvla": 2, "act": 3, "ensemble": 1}[name]
    assert policy.sha256() == before
    assert not policy.policy.training
    assert not any(weight.requires_grad for weight in policy.policy.parameters())


@pytest.mark.parametrize("name", EVERY)
def test_a_batch_equals_one_by_one_whatever_the_global_seed(policies, name):
    policy, looks = (
        policies[name],
        [
            look(i, text)
            for i, text in enumerate(
                ("put my camera on the plate", "pick up the red shaver", "select my cup")
            )
        ],
    )
    torch.manual_seed(1)
    together = run(policy, begin(policy, 3), looks)
    torch.manual_seed(2)
    drawn = torch.get_rng_state()
    alone = np.concatenate(
        [run(policy, [state], [seen]) for state, seen in zip(begin(policy, 3), looks, strict=True)]
    )
    assert np.allclose(together, alone, atol=1e-6)
    assert np.abs(together[0] - together[1]).max() > 1e-4  # what is seen matters
    assert torch.equal(torch.get_rng_state(), drawn)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("pi0", ""),
        ("pi05", ""),
        ("act", ""),
        ("smolvla", "tracing failed"),
        ("ensemble", "it has a memory"),
    ],
)
def test_a_policy_is_traced_or_says_that_it_stays_eager(folders, monkeypatch, capsys, name, reason):
    monkeypatch.setattr(traced, "CALLS_BEFORE_TRACE", 2)
    with toy_sizes(tiny.TOY):
        policy, plain = load_policy(folders[name]), load_policy(folders[name])
    plain.predict.stays_eager = True
    state, others = begin(policy, 3), begin(plain, 3)
    capsys.readouterr()
    for i, batch in enumerate((3, 3, 3, 2, 2, 1, 1)):
        looks = [look(10 * i + j) for j in range(batch)]
        chunks = run(policy, state[:batch], looks)
        assert np.array_equal(chunks, run(plain, others[:batch], looks))
    said = [line for line in capsys.readouterr().err.splitlines() if "traced graph" in line]
    if reason:
        (line,) = said
        assert reason in line
    else:
        assert said == []
        assert len(policy.predict._graphs) == 3


@pytest.mark.parametrize("name", ["pi0", "smolvla"])
def test_sampling_noise_is_fixed_within_an_episode_and_differs_between_episodes(policies, name):
    policy = policies[name]
    states, first = policy.plan(begin(policy, 2), [look(0), look(0)])
    _, again = policy.plan(states, [look(0), look(0)])
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert np.abs(first[0] - first[1]).max() > 1e-4


@pytest.mark.parametrize("name", ["pi0", "smolvla"])
def test_text_and_picture_reach_the_policy(policies, name):
    policy, (state,) = policies[name], begin(policies[name], 1)
    seen = look(0)
    red = PolicyInput({"front": seen.images["front"] // 2}, seen.text, seen.state)
    plain, worded, tinted = (
        run(policy, [state], [one])
        for one in (seen, look(0, "put the red camera on the plate"), red)
    )
    assert np.abs(plain - worded).max() > 1e-6
    assert np.abs(plain - tinted).max() > 1e-6


@pytest.mark.parametrize("name", EVERY)
def test_it_tells_what_its_tensors_hold(policies, name):
    """The audit hears the image and token tensors themselves, after the checkpoint's own preprocessing."""
    policy, plain = policies[name], [look(0), look(1)]
    tinted = plain[1].images["front"].copy()
    tinted[:20, :20] = (255, 0, 0)
    prompted = [
        plain[0],
        replace(plain[1], images={"front": tinted}, text="put the red camera on the plate"),
    ]
    _, _, (first, second) = calls.plan(policy, begin(policy, 2), prompted, plain)
    assert first[0] == first[1]
    heard, raw = second
    assert heard.keys() == ({"front", TEXT} if name in ("pi0", "pi05", "smolvla") else {"front"})
    assert all(heard[part] != raw[part] for part in heard)


def test_chunks_are_those_of_lerobots_own_loop(policies):
    """Selected one by one through lerobot's queue and postprocessor, they are the same actions."""
    policy, seen = policies["act"], look(3)
    chunk = run(policy, begin(policy, 1), [seen])[0]
    policy.policy.reset()
    pixels = torch.from_numpy(seen.images["front"]).permute(2, 0, 1)[None].float() / 255
    for row in chunk:
        batch = policy.preprocessor(
            {
                "observation.images.front": pixels,
                "observation.state": torch.from_numpy(seen.state)[None],
                "task": [seen.text],
            }
        )
        with torch.inference_mode():
            action = policy.postprocessor(policy.policy.select_action(batch))
        assert np.allclose(action[0].numpy(), row, atol=1e-7)


def remembered(policy, states, looks):
    """The chunks of several calls, each with the states of the one before, and the states after."""
    called = []
    for seen in looks:
        states, chunks = policy.plan(states, seen)
        called.append(np.stack(chunks))
    return states, np.stack(called)


@pytest.mark.parametrize("name", ["ensemble", "vqbet"])
def test_a_policy_with_a_memory_keeps_one_per_episode(policies, name):
    """Averages over calls, and queues of observations: two interleaved are each as if alone."""
    policy = policies[name]
    assert not policy.batched
    interleaved = remembered(policy, begin(policy, 2), [[look(t), look(10 + t)] for t in range(3)])
    for i, first in enumerate((0, 10)):
        state = begin(policy, 2)[i : i + 1]
        alone = remembered(policy, state, [[look(first + t)] for t in range(3)])
        assert np.allclose(interleaved[1][:, i], alone[1][:, 0], atol=1e-6)
    fresh = run(policy, begin(policy, 1), [look(2)])[0]
    assert np.abs(fresh - alone[1][-1, 0]).max() > 1e-6


@pytest.mark.parametrize("name", ["ensemble", "vqbet"])
def test_a_call_that_is_made_again_or_audited_leaves_the_memory_as_it_was(policies, name):
    policy = policies[name]
    looks = [[look(t)] for t in range(4)]
    _, plain = remembered(policy, begin(policy, 1), looks)
    states = begin(policy, 1)
    audited = []
    for seen in looks:
        policy.plan(states, [look(99)])  # as of a batch that another episode failed
        states, chunks, _ = calls.plan(policy, states, seen, [look(50)])
        audited.append(np.stack(chunks))
    assert np.array_equal(np.stack(audited), plain)


def test_what_does_not_fit_is_one_line(policies):
    policy, seen = policies["act"], look(0)
    wants = r"act:act@\w{8} wants observation.images.front, observation.state \(13\); there is observation.images."
    with pytest.raises(BadPolicy, match=wants + r"head, observation.state \(13\).*rename_map"):
        policy.plan(begin(policy, 1), [replace(seen, images={"head": seen.images["front"]})])
    with pytest.raises(BadPolicy, match=wants + r"front, observation.state \(14\)"):
        policy.plan(begin(policy, 1), [replace(seen, state=np.zeros(14, np.float32))])
    policy.check(["wrist", "front"], 13, 7)
    with pytest.raises(BadPolicy, match=r"have 7 numbers, the suite takes 6"):
        policy.check(["front"], 13, 6)


def copy_of(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def test_names_are_mapped_by_the_checkpoints_own_rename_map(folders, tmp_path):
    folder = copy_of(folders["act"], tmp_path)
    file = folder / "policy_preprocessor.json"
    pipeline = json.loads(file.read_text())
    pipeline["steps"][0]["config"]["rename_map"] = {
        "observation.images.head": "observation.images.front"
    }
    file.write_text(json.dumps(pipeline))
    policy, seen = load_policy(folder), look(0)
    assert set(policy.wanted) == {"observation.images.head", "observation.state"}
    headed = replace(seen, images={"head": seen.images["front"]})
    assert (
        run(policy, begin(policy, 1), [headed])
        == run(load_policy(folders["act"]), begin(policy, 1), [seen])
    ).all()


@pytest.mark.parametrize("name", ["pi0", "smolvla", "act"])
@pytest.mark.parametrize("fault", ["missing", "extra", "shape"])
def test_weights_that_are_not_the_files_are_refused(folders, tmp_path, name, fault):
    folder = copy_of(folders[name], tmp_path)
    tensors = load_file(folder / "model.safetensors")
    key = next(key for key, tensor in tensors.items() if tensor.ndim == 2)
    if fault == "missing":
        del tensors[key]
    elif fault == "extra":
        tensors["model.no.such.weight"] = torch.zeros(2)
    elif fault == "shape":
        tensors[key] = tensors[key][:-1].contiguous()
    save_file(tensors, folder / "model.safetensors")
    with (
        toy_sizes(tiny.TOY),
        pytest.raises(BadPolicy, match=r"load: \d+ of \d+ tensors differ|cannot become a policy"),
    ):
        load_policy(folder)


def test_one_number_that_differs_is_found(folders, policies, tmp_path):
    tensors = load_file(folders["pi0"] / "model.safetensors")
    save_file(tensors, tmp_path / "same.safetensors")
    compare(policies["pi0"].policy, tmp_path / "same.safetensors")
    name = sorted(tensors)[3]
    tensors[name].view(-1)[-1] += 1
    save_file(tensors, tmp_path / "other.safetensors")
    with pytest.raises(
        BadPolicy, match=rf"load: 1 of \d+ tensors differ from .*other.safetensors, {name} for one"
    ):
        compare(policies["pi0"].policy, tmp_path / "other.safetensors")


def test_a_toy_without_its_sizes_is_refused_not_random(folders):
    """The file's architecture is another one: lerobot prints a warning and would go on."""
    from lerobot.policies.pi0 import modeling_pi0

    with (
        toy_sizes(replace(tiny.TOY, expert=64)),
        pytest.raises(
            BadPolicy, match=r"load: \d+ of \d+ tensors differ from .*another architecture"
        ),
    ):
        load_policy(folders["pi0"])
    assert modeling_pi0.get_gemma_config("gemma_2b").width == 2048  # nothing small is left behind


@pytest.mark.parametrize(
    "step",
    [
        "subprocess.Popen",
        "lerobot.processor.pipeline.importlib",
        "os.system",
        3,
        "lerobot.processor.nonesuch.Step",
        "lerobot.processors.Step",
        "vap_core.policies.lerobot.adapter.load_policy",
    ],
)
def test_files_are_parsed_never_executed(folders, tmp_path, step):
    folder = copy_of(folders["act"], tmp_path)
    file = folder / "policy_preprocessor.json"
    pipeline = json.loads(file.read_text())
    pipeline["steps"].append(
        {"class": step, "config": {"args": ["touch", str(tmp_path / "owned")]}}
    )
    file.write_text(json.dumps(pipeline))
    with pytest.raises(
        BadPolicy, match="which is no step of lerobot; files are parsed here, never executed"
    ):
        load_policy(folder)
    assert not (tmp_path / "owned").exists()


def test_what_is_missing_or_damaged_is_one_line(folders, tmp_path):
    with pytest.raises(
        BadPolicy,
        match=r"no/such-model is no folder and no model on this machine; download it with `hf download no/such-model`",
    ):
        load_policy("no/such-model")
    with pytest.raises(
        BadPolicy, match=r"lacks config.json, model.safetensors, policy_preprocessor.json"
    ):
        load_policy(tmp_path)
    for name, text, said in (
        ("policy_preprocessor.json", "[", "is no processor pipeline"),
        ("policy_preprocessor.json", "[" * 100_000, "is no processor pipeline"),
        ("policy_preprocessor.json", '{"steps": [1]}', "is no processor pipeline"),
        ("policy_preprocessor.json", '{"steps": ["abc"]}', "is no processor pipeline"),
        ("config.json", "{}", r"cannot become a policy \(ValueError: Missing 'type'"),
        ("config.json", '{"type": "nonesuch"}', "'nonesuch'"),
        ("model.safetensors", "x", "cannot become a policy"),
    ):
        folder = copy_of(folders["act"], tmp_path / f"{name}-{len(text)}")
        (folder / name).write_text(text)
        with pytest.raises(BadPolicy, match=said):
            load_policy(folder)


@pytest.mark.parametrize(
    ("name", "file", "part"),
    [
        ("smolvla", "config.json", "smolvla-backbone"),
        ("pi0", "policy_preprocessor.json", "pi0/tokenizer"),
    ],
)
def test_a_backbone_that_was_not_downloaded_is_named(
    folders, tmp_path, monkeypatch, name, file, part
):
    asked: list[object] = []
    monkeypatch.setattr("socket.getaddrinfo", lambda *words, **options: asked.append(words) or [])
    folder, here = copy_of(folders[name], tmp_path), str(folders["pi0"].parent / part)
    told = (folder / file).read_text()
    assert here in told
    (folder / file).write_text(told.replace(here, "owner/backbone"))
    with (
        toy_sizes(tiny.TOY),
        pytest.raises(
            BadPolicy,
            match=r"cannot become a policy \(.*get what it builds on: `hf download owner/backbone`\.$",
        ),
    ):
        load_policy(folder)
    assert not asked, "a file's name of a model was looked up"


def test_a_fingerprint_tells_checkpoints_apart(folders, tmp_path):
    folder = copy_of(folders["act"], tmp_path)
    assert fingerprint(folder) == fingerprint(folders["act"]) != fingerprint(folders["ensemble"])
    (folder / "words").mkdir()
    for left in ("training.json", "recipe.json", "captions.json", "words/mug.token.safetensors"):
        (folder / left).write_text("{}")
    assert fingerprint(folder) == fingerprint(folders["act"]), "what a training leaves beside it"
    (folder / "config.json").write_text((folder / "config.json").read_text() + " ")
    assert fingerprint(folder) != fingerprint(folders["act"])


@pytest.fixture(scope="module")
def rows():
    return [replace(row, max_steps=3) for row in suites.rows(SUITE, TASK, 2)]


@pytest.fixture(scope="module")
def scene(rows):
    models = dict.fromkeys(place.model for row in rows for place in row.placements)
    with build(suites.suite(SUITE).robot, tuple(models)) as built:
        yield built


@pytest.mark.parametrize("name", EVERY)
def test_a_rollout_in_a_real_suite(policies, rows, scene, name):
    policy: LeRobot = policies[name]
    before = policy.sha256()
    trial = Trial(method="generic", scene=scene, policy=policy, prompter=generic())
    policy.check(suites.suite(SUITE).cameras, tiny.STATE, tiny.ACTION)
    together, alone = (list(rollout(trial, rows, batch=batch)) for batch in (2, 1))
    assert [episode.outcome.status for episode in together] == ["failure", "failure"], together[
        0
    ].outcome.detail
    assert policy.sha256() == before
    for a, b in zip(together, alone, strict=True):
        assert len(a.frames) == 4
        actions, others = (np.stack([frame.action for frame in one.frames[:-1]]) for one in (a, b))
        assert np.allclose(actions, others, atol=1e-6)
        assert np.abs(actions[:3]).max() > 1e-4
        assert a.header.policy == policy.label


def test_a_shipped_policy_is_found_from_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Published tables name it from the repository, and notebooks run in a folder of their own."""
    monkeypatch.chdir(tmp_path)
    name = "data/policies/mini-pi0-simpler-bridge-wide-seed-0"
    assert is_checkpoint_name(name)
    assert local_folder(name) == SHIPPED / "mini-pi0-simpler-bridge-wide-seed-0"
    assert fingerprint(name) == fingerprint(SHIPPED / "mini-pi0-simpler-bridge-wide-seed-0")
    assert local_folder("data/policies/no-such") is None
    assert not is_checkpoint_name("data/policies/no-such")
    own = tmp_path / name
    own.mkdir(parents=True)
    assert local_folder(name) == Path(name), "a folder that is there comes first"


def test_a_name_that_means_a_checkpoint_is_fitted_to_the_suite(folders, scene):
    assert all(map(is_checkpoint_name, (str(folders["act"]), "lerobot/pi0_base")))
    assert not any(map(is_checkpoint_name, ("scripted", "expert", "a/b/c", "/no/such/folder")))
    name = str(folders["act"])
    policy = load_for_suite(name, scene, suites.suite(SUITE))
    assert load_for_suite(name, scene, suites.suite(SUITE)) is policy
    with pytest.raises(
        BadPolicy, match=r"there is observation.images.head, observation.state \(13\)"
    ):
        load_for_suite(name, scene, replace(suites.suite(SUITE), cameras=("head",)))
