"""Where a policy looks: reported while somebody observes it, changing nothing, and recorded over what it saw."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from tests import tiny_lerobot as tiny
from tests.command import vap
from tests.drawn import SUCCESS, columns, entities, frame, opening, rerun
from tests.test_why import tabs
from vap_core.base.errors import BadPolicy, UnknownName
from vap_core.policies.lerobot import hooks, toy_pi0
from vap_core.policies.lerobot.adapter import LeRobot, load_policy
from vap_core.policies.lerobot.attribution import layer_effects
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.policies.protocol import (
    ACTION,
    PolicyInput,
    attention_observed,
    heat_map,
    layer_shown,
    observe_attention,
    report_attention,
)
from vap_core.recording import Recorder
from vap_core.recording.entities.pictures import attention_overlay
from vap_core.rollout.calls import QUERIES, named_queries, only_queries
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation.types import Outcome
from vap_core.study.trials import Study, make_trial, register_personal, shipped

CAMERAS = ("front", "side")
TOY = replace(tiny.TOY, layers=2)
PHRASES = {"category": ("camera",), "colour": ("red", "blue"), "token": ("<my_0>",)}


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LeRobot]:
    root = tmp_path_factory.mktemp("checkpoints")
    with toy_sizes(TOY):
        one = {
            "pi0": load_policy(
                toy_pi0.save_toy(root / "pi0", CAMERAS, tiny.STATE, tiny.ACTION, TOY)
            ),
            "pi05": load_policy(
                toy_pi0.save_toy(root / "pi05", ("front",), tiny.STATE, tiny.ACTION, TOY, "pi05")
            ),
        }
    return {
        **one,
        "smolvla": load_policy(tiny.smolvla(root / "smolvla")),
        "act": load_policy(tiny.act(root / "act")),
        "mini-pi0": load_policy(shipped("simpler-bridge")),
    }


def look(
    i: int, cameras: tuple[str, ...] = CAMERAS, text: str = "put my camera on the plate"
) -> PolicyInput:
    rng = np.random.default_rng(i)
    pictures = {name: rng.integers(0, 256, (64, 64, 3), np.uint8) for name in cameras}
    return PolicyInput(pictures, text, rng.standard_normal(tiny.STATE).astype(np.float32))


def plan(policy: LeRobot, looks: list[PolicyInput]) -> list[np.ndarray]:
    states = [policy.start(np.random.default_rng([7, i])) for i in range(len(looks))]
    return policy.plan(states, looks)[1]


def observed(policy: LeRobot, looks: list[PolicyInput]) -> tuple[Any, list[np.ndarray]]:
    with observe_attention([PHRASES] * len(looks)) as maps:
        chunks = plan(policy, looks)
    return maps, chunks


CASES = {
    # policy: cameras, side in patches, layers of the model, layers of the expert, heads
    "pi0": (CAMERAS, 4, 2, 2, 8),
    "pi05": (("front",), 4, 2, 2, 8),
    "smolvla": (("front",), 2, 2, 2, 4),
    "mini-pi0": (("front",), 7, 4, 4, 8),
}


@pytest.mark.parametrize("name", CASES)
def test_every_patch_of_every_view_gets_a_share_and_observing_changes_nothing(
    toys: dict[str, LeRobot], name: str
) -> None:
    cameras, side, n_layers, n_expert, heads = CASES[name]
    policy = toys[name]
    texts = ("put my camera on the plate", "put the red camera on the plate", "put my owl on it")
    looks = [look(i, cameras, text) for i, text in enumerate(texts)]
    hooks = _hooks(policy)
    plain = plan(policy, looks)
    seen, chunks = observed(policy, looks)
    assert all((one == other).all() for one, other in zip(chunks, plain, strict=True))
    assert _hooks(policy) == hooks, "what was set on the policy is removed"
    assert {i: set(maps) for i, maps in seen.items()} == {i: set(cameras) for i in range(3)}
    wanted = [{ACTION, "category"}, {ACTION, "category", "colour"}, {ACTION}]
    for i, maps in seen.items():
        for of_queries in maps.values():
            assert set(of_queries) == wanted[i]
        for query in wanted[i]:
            layers = n_expert if query == ACTION else n_layers
            total = np.zeros((layers, heads))
            for camera in cameras:
                weights = maps[camera][query]
                assert weights.shape == (layers, heads, side, side)
                assert weights.dtype == np.float32
                assert (weights >= 0).all()
                total += weights.sum((2, 3))
            assert (total > 0).all()
            assert (total < 1).all(), "words, state and actions get theirs, too"
    alone, _ = observed(policy, looks[:1])
    for camera in cameras:
        for query in wanted[0]:
            assert np.allclose(alone[0][camera][query], seen[0][camera][query], atol=1e-6)


def _hooks(policy: LeRobot) -> int:
    """Everything that is set on the modules of a policy for a while."""
    count = 0
    for module in policy.policy.modules():
        count += len(module._forward_hooks) + len(module._forward_pre_hooks)
        count += "eager_attention_forward" in vars(module)
    return count


@contextmanager
def _without_queries(policy: LeRobot, tower: str, layer: int) -> Iterator[None]:
    """Inside, the projection of a layer's queries is zero."""
    model = policy.policy.model
    if tower == "vlm":
        if hasattr(model, "vlm_with_expert"):
            decoder = model.vlm_with_expert.get_vlm_model().text_model
        else:
            decoder = model.paligemma_with_expert.paligemma.model.language_model
    elif hasattr(model, "vlm_with_expert"):
        decoder = model.vlm_with_expert.lm_expert
    else:
        decoder = model.paligemma_with_expert.gemma_expert.model
    weight = decoder.layers[layer].self_attn.q_proj.weight
    kept = weight.detach().clone()
    with torch.no_grad():
        weight.zero_()
    try:
        yield
    finally:
        with torch.no_grad():
            weight.copy_(kept)


@pytest.mark.parametrize("name", CASES)
def test_a_query_of_zeros_looks_everywhere_alike(toys: dict[str, LeRobot], name: str) -> None:
    """Without queries attention is uniform over all that may be attended to: a layer is the layer that it is called."""
    cameras, _, n_layers, n_expert, _ = CASES[name]
    policy = toys[name]
    for tower, layers, query in (("vlm", n_layers, "category"), ("expert", n_expert, ACTION)):
        for layer in range(layers):
            with _without_queries(policy, tower, layer):
                seen, _ = observed(policy, [look(0, cameras)])
            for maps in seen[0].values():
                even = [np.ptp(weights, axis=(1, 2)).max() < 1e-6 for weights in maps[query]]
                assert even == [i == layer for i in range(layers)]


@pytest.mark.parametrize("name", CASES)
def test_what_the_words_of_the_last_layer_look_at_reaches_no_action(
    toys: dict[str, LeRobot], name: str
) -> None:
    """The paper reads its maps from the last layer; the layer shown is the last whose queries change an action."""
    cameras, _, n_layers, n_expert, _ = CASES[name]
    policy = toys[name]
    looks = [look(0, cameras)]
    plain = plan(policy, looks)[0]

    def changes(tower: str, layer: int) -> bool:
        with _without_queries(policy, tower, layer), observe_attention():  # not a traced call
            return not np.array_equal(plan(policy, looks)[0], plain)

    assert not changes("vlm", n_layers - 1)
    assert changes("vlm", layer_shown("token", n_layers))
    assert changes("expert", layer_shown(ACTION, n_expert))


def test_maps_are_those_of_the_words_that_are_named(toys: dict[str, LeRobot]) -> None:
    """A word's map is the row of its token, wherever it stands; of two words the mean."""
    policy = toys["mini-pi0"]
    text = "put the camera on the red plate"
    looks = [look(0, ("front",), text)]
    rows = {}
    for words in (("camera",), ("red",), ("camera", "red"), ("camera on the red",)):
        with observe_attention([{"category": words}]) as maps:
            plan(policy, looks)
        rows[words] = maps[0]["front"]["category"]
    assert not np.allclose(rows["camera",], rows["red",])
    mean = (rows["camera",] + rows["red",]) / 2
    assert np.allclose(rows["camera", "red"], mean, atol=1e-6)
    assert not np.allclose(rows["camera on the red",], mean, atol=1e-6)
    with observe_attention([{"category": ("zeppelin",)}]) as maps:
        plan(policy, [look(0, ("front",), "put the zeppelin on the plate")])
    assert set(maps[0]["front"]) == {ACTION}, "a word that the vocabulary lacks is no query"


def test_layers_and_heads_that_are_shown() -> None:
    weights = np.zeros((3, 2, 2, 2), np.float32)
    weights[1, :, 0, 0] = [0.2, 0.4]
    weights[2, :, 1, 1] = [0.6, 0.8]
    assert np.allclose(heat_map(weights, "token"), [[0.3, 0], [0, 0]])
    assert np.allclose(heat_map(weights, ACTION), [[0, 0], [0, 0.7]])
    assert layer_shown("token", 1) == 0


def test_a_policy_without_patches_reports_nothing_and_nothing_is_kept_outside(
    toys: dict[str, LeRobot],
) -> None:
    with observe_attention() as seen:
        plan(toys["act"], [look(0, ("front",))])
        assert attention_observed()
    one = {ACTION: np.zeros((1, 1, 2, 2), np.float32)}
    report_attention(0, "front", one)
    assert seen == {}
    assert not toys["act"].attends
    assert toys["pi0"].attends
    assert not attention_observed()
    with observe_attention() as first:
        report_attention(0, "front", one)
        report_attention(0, "front", {ACTION: np.ones((1, 1, 2, 2), np.float32)})
    assert not first[0]["front"][ACTION].any(), "what is reported first stands"


def test_layers_are_known_of_a_pi0_alone(tmp_path: Path) -> None:
    pi05 = tmp_path / "pi05"
    toy_pi0.save_toy(pi05, ("front",), tiny.STATE, tiny.ACTION, TOY, "pi05")
    with toy_sizes(TOY):
        effects = layer_effects(pi05)
    assert list(effects.index) == ["vision-language model", "action expert"]
    for folder in (tiny.smolvla(tmp_path / "smolvla"), tiny.act(tmp_path / "act")):
        with pytest.raises(BadPolicy, match="is no pi0, .*; give the folder of a pi0, pi0.5 or"):
            layer_effects(folder)


def test_pictures_that_are_padded_are_not_read(toys: dict[str, LeRobot]) -> None:
    """Of a picture that is padded to a square, some patches show no picture."""
    pi0, smolvla = toys["pi0"].policy, toys["smolvla"].policy
    square, wide = torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 48, 64)
    for policy in (pi0, smolvla):
        assert hooks.can_watch(policy, [square])
        feature = policy.config.image_features["observation.images.front"]
        with patch.object(feature, "shape", (3, 48, 64)):  # declared, not given
            assert hooks.can_watch(policy, [square])
        assert not hooks.can_watch(policy, [wide])
        assert not hooks.can_watch(policy, [square, wide])
    with patch.object(smolvla.config, "resize_imgs_with_padding", None):
        assert hooks.can_watch(smolvla, [square])
        assert not hooks.can_watch(smolvla, [square, square[..., :32, :32]])
        assert hooks.layout(smolvla, ["front"], 128).side == 4
    with patch.object(smolvla.config, "resize_imgs_with_padding", (64, 32)):
        assert not hooks.can_watch(smolvla, [square])


def test_only_the_queries_asked_for_are_kept() -> None:
    heat = np.zeros((1, 1, 2, 2), np.float32)
    maps = {"front": {"token": heat, ACTION: heat}, "side": {ACTION: heat}}
    assert only_queries(maps, ("token",)) == {"front": {"token": heat}}
    assert only_queries(maps, ("colour",)) == {}, "a step without them has no attention"


def test_queries_are_named() -> None:
    assert named_queries(["all"]) == QUERIES
    assert named_queries(["action", "token"]) == ("token", "action")
    assert named_queries([]) == ()
    with pytest.raises(UnknownName, match="gaze.*known: action, all, category, colour, token|gaze"):
        named_queries(["gaze"])


class Keeps:
    """A sink that keeps frames as they come."""

    def __init__(self, opening: EpisodeHeader) -> None:
        self.frames: list[object] = []

    def frame(self, frame: object) -> None:
        self.frames.append(frame)

    def close(self, outcome: Outcome) -> None: ...


@pytest.mark.slow
def test_the_policy_that_ships_looks_at_what_is_tinted(tmp_path: Path) -> None:
    """At its first call the most attended patch lies on the target in most scenes; and an observed episode goes as any other."""
    study = Study(
        (("simpler-bridge", "pick-shaver"),),
        ("oracle-mask",),
        episodes=6,
        policy="mini-pi0",
        follow="call",
    )
    rows = [replace(row, max_steps=5) for row in study.rows("simpler-bridge", "pick-shaver")]
    register_personal(study, tmp_path)
    trial = make_trial(study, rows, "oracle-mask", tmp_path)
    sinks: list[Keeps] = []

    def sink(start: EpisodeHeader) -> Keeps:
        sinks.append(Keeps(start))
        return sinks[-1]

    plain: list[Episode] = list(rollout(trial, rows, batch=6))
    watching_it = list(rollout(replace(trial, attention=("action",)), rows, sink, batch=6))
    hits = 0
    for row, sink_of, one, other in zip(rows, sinks, watching_it, plain, strict=True):
        assert all(
            np.array_equal(a.action, b.action)
            for a, b in zip(one.frames, other.frames, strict=True)
        )
        frames = sink_of.frames
        assert [bool(kept.attention) for kept in frames] == [True, False, False, False, True, False]  # type: ignore[attr-defined]
        assert not any(kept.attention for kept in one.frames), "light frames carry none"
        (heat,) = [heat_map(w, q) for q, w in frames[0].attention["front"].items()]  # type: ignore[attr-defined]
        mask = frames[0].truth.masks["front"][row.target]  # type: ignore[attr-defined]
        patches = cv2.resize(
            mask.astype(np.float32), heat.shape[::-1], interpolation=cv2.INTER_AREA
        )
        hits += patches[np.unravel_index(heat.argmax(), heat.shape)] > 0
    assert hits >= 4, f"{hits} of 6"


def test_a_recording_shows_it_and_keeps_the_numbers(tmp_path: Path) -> None:
    start = opening(2)
    weights = np.zeros((2, 1, 4, 4), np.float32)
    weights[0, 0, 1, 2] = 0.5
    weights[1, 0, 3, 3] = 0.5
    with Recorder(tmp_path / "one.rrd", start, flush_every=5) as recorder:
        for step in range(8):
            one = frame(step, start)
            recorder.frame(
                replace(
                    one,
                    attention={
                        "front": {"token": weights, ACTION: weights},
                        "side": {"token": weights / 2, ACTION: weights},
                    },
                )
                if step % 4 == 0
                else one
            )
        recorder.close(SUCCESS)
    path = tmp_path / "one.rrd"
    assert rerun("rrd", "verify", path).returncode == 0
    numbers = columns(path, "/vap/attention/side/token", "Tensor:data")
    assert sorted(numbers) == [0, 4]  # type: ignore[type-var]
    assert max(numbers[0][0]["buffer"]) == 0.25  # type: ignore[index]
    overlays = columns(path, "/observation.images.front/attention/token", "EncodedImage:blob")
    assert sorted(overlays) == [0, 4]  # type: ignore[type-var]
    expert = columns(path, "/observation.images.front/attention/action", "EncodedImage:blob")
    assert bytes(expert[0][0]) != bytes(overlays[0][0]), "each shows its own layer"  # type: ignore[index]
    assert "attention" in tabs(path)
    glow = cv2.imdecode(np.frombuffer(bytes(overlays[0][0]), np.uint8), cv2.IMREAD_COLOR).astype(
        int
    )  # type: ignore[index]
    side = glow.shape[0]
    lit = glow[side // 4 : side // 2, side // 2 : 3 * side // 4].mean()
    assert lit > 1.3 * glow[3 * side // 4 :, : side // 4].mean()


def test_without_attention_a_recording_has_no_such_tab(tmp_path: Path) -> None:
    start = opening(1)
    with Recorder(tmp_path / "one.rrd", start) as recorder:
        recorder.frame(frame(0, start))
        recorder.close(SUCCESS)
    assert "attention" not in tabs(tmp_path / "one.rrd")
    assert not any("attention" in entity for entity in entities(tmp_path / "one.rrd"))


def test_a_glow_is_brightest_where_attention_is_most_and_never_leaves_the_picture() -> None:
    rgb = np.full((64, 64, 3), 90, np.uint8)
    heat = np.zeros((4, 4), np.float32)
    heat[3, 0] = 1e-4
    glow = attention_overlay(rgb, heat)
    assert glow.shape == rgb.shape
    assert glow[60, 4].sum() > glow[4, 60].sum()
    assert (attention_overlay(rgb, 10 * heat) == glow).all(), (
        "shares of the view's most attended patch"
    )
    assert (attention_overlay(rgb, np.zeros((4, 4), np.float32)) <= 90).all()


@pytest.mark.slow
def test_the_real_command_records_it(tmp_path: Path) -> None:
    done = vap("rollout", "--suite", "simpler-bridge", "--task", "pick-shaver", "--policy", "mini-pi0", "--methods", "generic", "--episodes", "1",
               "--record", "all", "--attention", "action,category", "--workers", "1", "--out", tmp_path / "run")  # fmt: skip
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "run" / "recordings").glob("*.rrd")
    found = {chunk.entity_path for chunk in RrdReader(path).stream()}
    assert {"/vap/attention/front/action", "/vap/attention/front/category"} <= found
    assert "/vap/attention/front/token" not in found


def test_who_cannot_tell_is_refused_in_one_line(tmp_path: Path) -> None:
    words = "rollout --suite widowx-pick --task pick-bottle --episodes 1 --attention all".split()
    words += ["--out", str(tmp_path / "run")]
    done = vap(*words)
    assert done.returncode == 2
    assert "gives no attention maps" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "run").rglob("*.rrd"))
    done = vap(*words, "--record", "none")
    assert done.returncode == 2
    assert "with --record none leave them out" in done.stderr
