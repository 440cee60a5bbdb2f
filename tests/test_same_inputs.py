"""Our loop hands a policy's preprocessor what lerobot's own loop hands it, equal to the bit."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.scripts.lerobot_eval import rollout as lerobot_rollout

from tests import tiny_lerobot as tiny
from vap_core.policies.lerobot.adapter import LeRobot, load_policy
from vap_core.policies.lerobot.step import VapEnvConfig
from vap_core.policies.lerobot.toy_pi0 import toy_sizes
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.simulation import suites
from vap_core.simulation.suites.open_row import build_scene, models_of

STEPS, EPISODE = 3, 1
MAKERS: dict[str, Callable[[Path], Path]] = {
    "act": tiny.act,
    "act-without-state": tiny.act_without_state,
    "smolvla": tiny.smolvla,
    "pi0": tiny.pi0,
}


class Recording:
    """A preprocessor that keeps what it is given."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.given: list[dict[str, Any]] = []

    def __call__(self, observation: dict[str, Any]) -> Any:
        self.given.append(dict(observation))
        return self.inner(observation)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


def ours(policy: LeRobot, name: str, task: str, side: int) -> list[dict[str, Any]]:
    suite = suites.suite(name)
    row = replace(suites.rows(name, task)[EPISODE], max_steps=STEPS)
    heard = Recording(policy.preprocessor)
    policy.preprocessor = heard
    trial = Trial(
        method="generic",
        scene=build_scene(name, models_of([row])),
        policy=policy.with_execute(1) if policy.batched else policy,
        prompter=generic(),
        control=suite.control,
        sensor=suite.sensor,
        image_size=side,
    )
    (episode,) = rollout(trial, [row])
    assert episode.outcome.status != "error", episode.outcome.detail
    return heard.given


def lerobots(policy: LeRobot, name: str, task: str, side: int) -> list[dict[str, Any]]:
    config = VapEnvConfig(task=f"{name}/{task}", image_size=side, max_steps=STEPS)
    env: Any = config.create_envs(1)[name][0]
    before, after = config.get_env_processors()
    heard = Recording(policy.preprocessor)
    policy.policy.config.n_action_steps = 1
    policy.policy.reset()
    with torch.inference_mode():
        lerobot_rollout(env, policy.policy, before, after, heard, policy.postprocessor, [EPISODE])
    env.close()
    return heard.given


WIDE = (480, 640)
GIVEN = [*((kind, 224, WIDE) for kind in MAKERS), ("act", 96, WIDE), ("act", 224, (640, 480)),
         ("smolvla", 224, (640, 480)), ("pi0", 224, (720, 1280)), ("act", 224, (512, 512))]  # fmt: skip


@pytest.mark.parametrize(("kind", "side", "declared"), GIVEN)
def test_the_preprocessor_gets_the_same(
    tmp_path: Path, kind: str, side: int, declared: tuple[int, int]
) -> None:
    """It got stretched frames of the size that a checkpoint declares, and no undeclared state."""
    folder = MAKERS[kind](tmp_path / "policy")
    config = json.loads((folder / "config.json").read_text())
    for feature in config["input_features"].values():
        if feature["type"] == "VISUAL":
            feature["shape"] = [3, *declared]
    (folder / "config.json").write_text(json.dumps(config))
    with toy_sizes(tiny.TOY):
        asked = ("simpler-bridge", "put-camera", side)
        here, there = ours(load_policy(folder), *asked), lerobots(load_policy(folder), *asked)
    # The others draw noise of their own, so that their second frames differ.
    steps = STEPS if kind.startswith("act") else 1
    assert len(here[:steps]) == len(there[:steps]) == steps
    for one, other in zip(here[:steps], there[:steps], strict=True):
        assert one.pop("task") == other.pop("task")
        other.pop("observation.vap_step")  # for VAP as a step of the pipeline
        given = {key: value for key, value in other.items() if key.startswith("observation.")}
        assert one.keys() == given.keys()
        for key, value in one.items():
            assert torch.equal(value, given[key]), key
            assert value.dtype == given[key].dtype


@pytest.mark.parametrize("read", [slice(1), slice(None, None, -1), slice(1, None)])
def test_every_camera_and_the_state_are_handed_over(tmp_path: Path, read: slice) -> None:
    """The tiny policy declares one of the three cameras of vlabench, all in another order, two."""
    suite, task = "vlabench", "select-cup"
    cameras = suites.suite(suite).cameras
    folder = tiny.act_of(tmp_path / "policy", cameras[read], 64, 14, 8)
    here = ours(load_policy(folder), suite, task, 224)
    there = lerobots(load_policy(folder), suite, task, 224)
    assert {f"observation.images.{camera}" for camera in cameras} < here[0].keys()
    for key in here[0].keys() - {"task"}:
        assert torch.equal(here[0][key], there[0][key]), key
