"""mini-pi0 is lerobot's PI0 through lerobot's own doors: factory, save, load, processors; its words are its own."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy, fused_attention
from vap_core.policies.mini_pi0.processor_mini_pi0 import encode
from vap_core.policies.names import checkpoint_of
from vap_core.policies.protocol import PolicyInput
from vap_make.words import vocabulary

STATE, ACTION = 13, 7


def config(**sizes: object) -> MiniPI0Config:
    return MiniPI0Config(
        words=vocabulary(), device="cpu", max_state_dim=STATE, max_action_dim=ACTION, vision_depth=1, depth=2, vision_width=32, width=32, head_dim=8,
        expert_width=32, image_resolution=(64, 64),
        input_features={"observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
                        "observation.state": PolicyFeature(FeatureType.STATE, (STATE,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))}, **sizes,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mini")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        MiniPI0Policy(config()).save_pretrained(folder)
    stats = {
        name: {"mean": torch.zeros(n), "std": torch.ones(n)}
        for name, n in (("observation.state", STATE), ("action", ACTION))
    }
    for pipeline in make_pre_post_processors(config(), dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


def look(text: str) -> PolicyInput:
    return PolicyInput(
        {"front": np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)},
        text,
        np.zeros(STATE, np.float32),
    )


def test_it_comes_back_through_lerobots_factory(checkpoint: Path) -> None:
    held = PreTrainedConfig.from_pretrained(checkpoint)
    assert isinstance(held, MiniPI0Config)
    assert held.words == vocabulary()
    kind = get_policy_class("mini_pi0")
    assert kind is MiniPI0Policy
    assert issubclass(kind, PI0Policy)
    loaded, built = kind.from_pretrained(checkpoint), MiniPI0Policy(config())
    assert loaded.state_dict().keys() == built.state_dict().keys()
    again = MiniPI0Policy.from_pretrained(checkpoint)
    assert all(
        torch.equal(a, b)
        for a, b in zip(loaded.state_dict().values(), again.state_dict().values(), strict=True)
    )


def test_weights_of_another_size_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    for file in checkpoint.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    about = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**about, "expert_width": 64}))
    with pytest.raises(RuntimeError, match="size mismatch"):
        MiniPI0Policy.from_pretrained(tmp_path)


def test_it_drives_our_rollouts_and_hears_words_and_pictures(checkpoint: Path) -> None:
    policy = load_policy(checkpoint)
    assert policy.label.startswith(f"mini_pi0:{checkpoint.name}@")
    states = [policy.start(np.random.default_rng(i)) for i in range(3)]
    said = [
        look("put my camera on the plate"),
        look("put the red camera on the plate"),
        look("put the red camera on the plate"),
    ]
    said[2].images["front"][:] = 0
    _, chunks = policy.plan([states[0]] * 3, said)
    assert chunks[0].shape == (4, ACTION)
    assert not np.allclose(chunks[0], chunks[1], atol=1e-6)
    assert not np.allclose(chunks[1], chunks[2], atol=1e-6)


def test_cooler_noise_is_less_noise(checkpoint: Path) -> None:
    warm, cool, cold = (MiniPI0Policy.from_pretrained(checkpoint) for _ in range(3))
    cool.config.temperature, cold.config.temperature = 0.5, 0.0
    before, _ = make_pre_post_processors(config(), str(checkpoint))
    batch = before(
        {
            "observation.images.front": torch.rand(2, 3, 64, 64),
            "observation.state": torch.rand(2, STATE),
            "task": ["pick it up"] * 2,
        }
    )
    noise = torch.randn(2, 4, ACTION)
    assert torch.equal(
        cool.predict_action_chunk(batch, noise=noise),
        warm.predict_action_chunk(batch, noise=0.5 * noise),
    )
    assert torch.equal(
        cold.predict_action_chunk(batch), cold.predict_action_chunk(batch, noise=noise)
    )
    assert not torch.equal(
        cool.predict_action_chunk(batch, noise=noise), warm.predict_action_chunk(batch, noise=noise)
    )


def test_a_temperature_that_is_asked_for_is_the_one_that_samples(checkpoint: Path) -> None:
    seen = look("put my camera on the plate")
    chunks = {}
    for temperature in (None, 0.0, 1.0):
        policy = load_policy(checkpoint, temperature=temperature)
        own = policy.policy.config.temperature
        assert own == (1.0 if temperature is None else temperature)
        assert policy.label.endswith(", temperature 0") == (temperature == 0.0)
        assert checkpoint_of(policy.label) == checkpoint_of(policy.label.partition(",")[0]) != ""
        for seed in (1, 2):
            states = [policy.start(np.random.default_rng(seed))]
            chunks[temperature, seed] = policy.plan(states, [seen])[1][0]
    assert np.array_equal(chunks[0.0, 1], chunks[0.0, 2])
    assert not np.array_equal(chunks[1.0, 1], chunks[1.0, 2])
    assert np.array_equal(chunks[None, 1], chunks[1.0, 1])


def test_words_become_the_tokens_that_they_are() -> None:
    words = vocabulary()
    assert len(set(words)) == len(words)
    number = {word: i for i, word in enumerate(words)}
    tokens, there = encode(["put the red camera on the plate", "Find <my_0>, zebra"], number, 10)
    assert [words[i] for i in tokens[0]] == [
        "put",
        "the",
        "red",
        "camera",
        "on",
        "the",
        "plate",
        "\n",
    ]
    assert [words[i] for i in tokens[1]][:4] == ["<unk>", "<my_0>", "<unk>", "\n"]
    assert there.sum(1).tolist() == [8, 4]


def test_sizes_that_do_not_fit_are_said() -> None:
    with pytest.raises(ValueError, match="do not part into patches of 15"):
        config(patch=15)


def test_a_step_of_training_reaches_every_part(checkpoint: Path) -> None:
    """Vision, language and expert all get a gradient; the decoder's last layer gives its keys and values alone, as in PI0."""
    policy = MiniPI0Policy(config())
    before, _ = make_pre_post_processors(config(), str(checkpoint))
    batch = before({"observation.images.front": torch.rand(2, 3, 64, 64), "observation.state": torch.rand(2, STATE),
                    "action": torch.rand(2, 4, ACTION), "task": ["pick up the red shaver"] * 2})  # fmt: skip
    loss, _ = policy.forward(batch)
    loss.backward()
    felt = {
        name
        for name, weight in policy.named_parameters()
        if weight.grad is not None and weight.grad.abs().sum() > 0
    }
    for part in ("vision_tower", "multi_modal_projector", "language_model.layers.0.self_attn.q_proj", "layers.1.self_attn.k_proj", "embed_tokens",
                 "gemma_expert.model.layers.1", "action_out_proj", "state_proj"):  # fmt: skip
        assert any(part in name for name in felt), part


def test_an_oblong_resolution_is_refused() -> None:
    with pytest.raises(ValueError, match="image_resolution is 112x100; the tower reads squares"):
        MiniPI0Config(words=vocabulary(), image_resolution=(112, 100))


def test_the_fused_attention_can_be_entered_again() -> None:
    before = ALL_ATTENTION_FUNCTIONS.get("eager")
    with fused_attention():
        fused = ALL_ATTENTION_FUNCTIONS["eager"]
        with fused_attention():
            pass
        assert ALL_ATTENTION_FUNCTIONS["eager"] is fused
    assert ALL_ATTENTION_FUNCTIONS.get("eager") is before
