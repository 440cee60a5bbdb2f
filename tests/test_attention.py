"""Where a policy looks: told while somebody watches, changing nothing, and recorded over what it saw."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from tests import tiny_lerobot as tiny
from tests.command import vap
from tests.drawn import SUCCESS, columns, entities, frame, opening, rerun
from tests.test_why import tabs
from vap_core.evaluation.methods import METHODS
from vap_core.evaluation.policy_names import shipped
from vap_core.evaluation.study import Study, make_trial, register_personal
from vap_core.policies.hooks import attention_observed, observe_attention, report_attention
from vap_core.policies.lerobot.adapter import LeRobot, load_policy
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.policies.protocol import PolicyInput
from vap_core.recording import Recorder
from vap_core.recording.entities.attention import attention_overlay
from vap_core.rollout.loop import rollout
from vap_core.rollout.types import Episode, EpisodeHeader
from vap_core.simulation.types import Outcome

CAMERAS = ("front", "side")
BRIDGE = shipped("simpler-bridge")


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LeRobot]:
    root = tmp_path_factory.mktemp("checkpoints")
    with toy_sizes(tiny.TOY):
        return {
            "pi0": load_policy(tiny.pi0(root / "pi0", CAMERAS)),
            "pi05": load_policy(tiny.pi05(root / "pi05")),
            "act": load_policy(tiny.act(root / "act")),
        }


def look(i: int, cameras: tuple[str, ...] = CAMERAS) -> PolicyInput:
    rng = np.random.default_rng(i)
    pictures = {name: rng.integers(0, 256, (64, 64, 3), np.uint8) for name in cameras}
    return PolicyInput(
        pictures, "put my camera on the plate", rng.standard_normal(tiny.STATE).astype(np.float32)
    )


def plan(policy: LeRobot, looks: list[PolicyInput]) -> list[np.ndarray]:
    states = [policy.start(np.random.default_rng([7, i])) for i in range(len(looks))]
    return policy.plan(states, looks)[1]


@pytest.mark.parametrize(("name", "cameras"), [("pi0", CAMERAS), ("pi05", ("front",))])
def test_every_patch_of_every_view_gets_a_share_and_watching_changes_nothing(
    toys: dict[str, LeRobot], name: str, cameras: tuple[str, ...]
) -> None:
    looks = [look(i, cameras) for i in range(3)]
    plain = plan(toys[name], looks)
    with observe_attention() as seen:
        chunks = plan(toys[name], looks)
    assert all((one == other).all() for one, other in zip(chunks, plain, strict=True))
    assert {i: set(heats) for i, heats in seen.items()} == {i: set(cameras) for i in range(3)}
    for heats in seen.values():
        assert all(
            heat.shape == (4, 4) and heat.dtype == np.float32 and (heat >= 0).all()
            for heat in heats.values()
        )
        assert 0 < sum(float(heat.sum()) for heat in heats.values()) < 1, (
            "words, state and actions get theirs, too"
        )
    with observe_attention() as alone:
        plan(toys[name], [looks[0]])
    assert all(np.allclose(alone[0][cam], seen[0][cam], atol=1e-6) for cam in cameras)


def test_who_asks_nothing_in_particular_looks_everywhere_alike(toys: dict[str, LeRobot]) -> None:
    """Without queries attention is uniform over 2 x 16 patches, the words, the state and a chunk of two."""
    policy = toys["pi0"]
    query = policy.policy.model.paligemma_with_expert.gemma_expert.model.layers[
        -1
    ].self_attn.q_proj.weight
    kept = query.detach().clone()
    words = int(
        policy.preprocessor(policy._observation([look(0)]))[
            "observation.language.attention_mask"
        ].sum()
    )
    try:
        with torch.no_grad():
            query.zero_()
        with observe_attention() as seen:
            plan(policy, [look(0)])
    finally:
        with torch.no_grad():
            query.copy_(kept)
    for heat in seen[0].values():
        assert np.allclose(heat, 1 / (32 + words + 1 + 2), atol=1e-6)


def test_a_policy_without_patches_tells_nothing_and_nobody_hears_outside(
    toys: dict[str, LeRobot],
) -> None:
    with observe_attention() as seen:
        plan(toys["act"], [look(0, ("front",))])
        assert attention_observed()
    report_attention(0, "front", np.zeros((2, 2), np.float32))
    assert seen == {}
    assert not toys["act"].attends
    assert toys["pi0"].attends
    assert not attention_observed()
    with observe_attention() as first:
        report_attention(0, "front", np.zeros((2, 2), np.float32))
        report_attention(0, "front", np.ones((2, 2), np.float32))
    assert not first[0]["front"].any(), "what is told first stands"


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
    watching_it = list(rollout(replace(trial, attention=True), rows, sink, batch=6))
    assert METHODS["oracle-mask"] is not None
    hits = 0
    for row, sink_of, one, other in zip(rows, sinks, watching_it, plain, strict=True):
        assert all(
            np.array_equal(a.action, b.action)
            for a, b in zip(one.frames, other.frames, strict=True)
        )
        frames = sink_of.frames
        assert [bool(kept.attention) for kept in frames] == [True, False, False, False, True, False]  # type: ignore[attr-defined]
        assert not any(kept.attention for kept in one.frames), "light frames carry none"
        heat, mask = frames[0].attention["front"], frames[0].truth.masks["front"][row.target]  # type: ignore[attr-defined]
        patches = cv2.resize(
            mask.astype(np.float32), heat.shape[::-1], interpolation=cv2.INTER_AREA
        )
        hits += patches[np.unravel_index(heat.argmax(), heat.shape)] > 0
    assert hits >= 4, f"{hits} of 6"


def test_a_recording_shows_it_and_keeps_the_numbers(tmp_path: Path) -> None:
    start = opening(2)
    heat = np.zeros((4, 4), np.float32)
    heat[1, 2] = 0.5
    with Recorder(tmp_path / "one.rrd", start, flush_every=5) as recorder:
        for step in range(8):
            one = frame(step, start)
            recorder.frame(
                replace(one, attention={"front": heat, "side": heat / 2}) if step % 4 == 0 else one
            )
        recorder.close(SUCCESS)
    path = tmp_path / "one.rrd"
    assert rerun("rrd", "verify", path).returncode == 0
    numbers = columns(path, "/vap/attention/side", "Tensor:data")
    assert sorted(numbers) == [0, 4]  # type: ignore[type-var]
    assert max(numbers[0][0]["buffer"]) == 0.25  # type: ignore[index]
    assert sorted(columns(path, "/observation.images.front/attention", "EncodedImage:blob")) == [
        0,
        4,
    ]
    assert "attention" in tabs(path)
    blob = columns(path, "/observation.images.front/attention", "EncodedImage:blob")[0]
    glow = cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_COLOR).astype(int)  # type: ignore[index]
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
               "--record", "all", "--attention", "--workers", "1", "--out", tmp_path / "run")  # fmt: skip
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "run" / "recordings").glob("*.rrd")
    assert "/vap/attention/front" in {chunk.entity_path for chunk in RrdReader(path).stream()}


def test_who_cannot_tell_is_refused_in_one_line(tmp_path: Path) -> None:
    words = (
        "rollout",
        "--suite",
        "widowx-pick",
        "--task",
        "pick-bottle",
        "--episodes",
        "1",
        "--attention",
        "--out",
        tmp_path / "run",
    )
    done = vap(*words)
    assert done.returncode == 2
    assert "gives no attention maps" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "run").rglob("*.rrd"))
    done = vap(*words, "--record", "none")
    assert done.returncode == 2
    assert "with --record none leave them out" in done.stderr
