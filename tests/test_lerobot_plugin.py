"""The distribution that lerobot's commands discover, and their own lerobot-eval with it, on the shipped policy."""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot.envs.utils import _call_make_env, _import_hub_module, _normalize_hub_result
from lerobot.processor import ProcessorStepRegistry
from torch.nn.functional import interpolate

from tests.command import refused, vap
from tests.toys import personal
from vap_core.base.errors import BadMemory, UnknownName
from vap_core.base.files import SHIPPED
from vap_core.cli.own import _task_to_try
from vap_core.memory import save
from vap_core.perception.stacks import load_stack
from vap_core.policies.lerobot.adapter import IMAGE, load_policy
from vap_core.policies.lerobot.checkpoints import trained_for
from vap_core.policies.lerobot.step import VapEnvConfig, attach
from vap_core.policies.protocol import PolicyInput
from vap_core.rollout.loop import rollout
from vap_core.simulation import suites
from vap_core.study.trials import Study, make_trial, register_personal, shipped

ROOT = Path(__file__).resolve().parents[1]
PLUGIN = ROOT / "plugins" / "lerobot_env_vap"
SUITE, TASK = "simpler-bridge", "put-camera"
EPISODES = 4
"""Rows of one command."""


def test_its_name_is_one_that_lerobot_imports_and_its_module_registers_everything() -> None:
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    name = project["name"]
    assert name.startswith("lerobot_env_")
    spec = importlib.util.spec_from_file_location(name, PLUGIN / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    assert "vap" in EnvConfig.get_known_choices()
    assert "mini_pi0" in PreTrainedConfig.get_known_choices()
    assert {"vap_prompt", "mini_pi0_words"} <= set(ProcessorStepRegistry.list())


def test_the_hubs_file_makes_the_same_environments() -> None:
    module = _import_hub_module(str(ROOT / "plugins" / "envhub" / "env.py"), "you/vap-core")
    made = _normalize_hub_result(_call_make_env(module, n_envs=2, use_async_envs=False, cfg=None))
    env = made["simpler-bridge"][0]
    seen, _ = env.reset(seed=[0, 1])
    assert seen["pixels"]["front"].shape == (2, 224, 224, 3)
    assert seen["vap_step"].tolist() == [[0.0], [0.0]]
    env.close()


@dataclass
class MyHubEnv(HubEnvConfig):
    """A user's configuration of an environment from the hub."""

    task: str | None = "widowx-pick/pick-straw-cup"
    image_size: int = 96
    robots: str = "menagerie"
    max_steps: int | None = 7


def hub_environments(config: EnvConfig) -> Any:
    module = _import_hub_module(str(ROOT / "plugins" / "envhub" / "env.py"), "you/vap-core")
    return _call_make_env(module, n_envs=1, use_async_envs=False, cfg=config)


def test_the_hubs_file_heeds_the_size_and_the_length_of_a_configuration() -> None:
    env = hub_environments(MyHubEnv(robots="plain"))["widowx-pick"][0]
    seen, _ = env.reset(seed=0)
    assert {picture.shape for picture in seen["pixels"].values()} == {(1, 96, 96, 3)}
    assert env.call("_max_episode_steps") == (7,)
    env.close()


def test_the_hubs_file_heeds_every_option_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without building a scene: Menagerie's meshes are not on every machine."""
    options = set(VapEnvConfig().gym_kwargs)
    asked: list[dict[str, Any]] = []

    class Asked:
        def __init__(self, **settings: Any) -> None:
            asked.append(settings)

        def create_envs(self, *_: Any) -> dict[str, Any]:
            return {}

    monkeypatch.setattr("vap_core.policies.lerobot.step.VapEnvConfig", Asked)
    hub_environments(MyHubEnv())
    task = "widowx-pick/pick-straw-cup"
    assert asked == [{"task": task, "image_size": 96, "robots": "menagerie", "max_steps": 7}]
    assert set(asked[0]) == {"task", *options}
    hub_environments(HubEnvConfig(task=task))
    assert asked[1:] == [{"task": task}]


def test_a_mini_pi0_scales_its_images_as_our_loop_does() -> None:
    """Then lerobot's loop, which gives them as they come, gets the same actions."""
    policy = load_policy(shipped(SUITE)).policy
    rgb = torch.rand((2, 3, 224, 224), generator=torch.Generator().manual_seed(0))
    key = "observation.images.front"
    (whole,), _ = policy._preprocess_images({key: rgb})
    (scaled,), _ = policy._preprocess_images(
        {key: interpolate(rgb, (112, 112), mode="bilinear", antialias=True)}
    )
    assert torch.equal(whole, scaled)


def test_weights_that_ask_for_a_gradient_change_no_bit_of_an_action() -> None:
    """lerobot-eval does not freeze the policy that it loads; our adapter does."""
    policy = load_policy(shipped(SUITE))
    sides = {name: shape for name, shape in policy.wanted.items() if name.startswith(IMAGE)}
    rng = np.random.default_rng(0)
    views = {
        key.removeprefix(IMAGE): rng.integers(0, 256, (*shape[1:], 3), np.uint8)
        for key, shape in sides.items()
    }
    state = np.zeros(policy.wanted["observation.state"], np.float32)
    inputs = [PolicyInput(views, "put my camera on the plate", state)] * 2
    batch, noise = policy.prepare([policy.start(np.random.default_rng(0)) for _ in inputs], inputs)
    chunks = []
    for asks in (False, True):
        policy.policy.requires_grad_(asks)
        with torch.inference_mode():
            chunks.append(policy.policy.predict_action_chunk(batch, noise=noise))
        assert all(weight.requires_grad is asks for weight in policy.policy.parameters())
    assert torch.equal(*chunks)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the plugin installed."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation",
               "--python", sys.executable, "--target", folder, PLUGIN]  # fmt: skip
    subprocess.run(command, check=True)
    return folder


def lerobot_eval(site: Path, policy: Path, out: Path, first: int) -> list[bool]:
    """The successes that `lerobot-eval` writes, one per episode from that row of the list on."""
    command = [Path(sys.executable).with_name("lerobot-eval"), f"--policy.path={policy}",
               "--env.type=vap", f"--env.task={SUITE}/{TASK}", f"--eval.n_episodes={EPISODES}",
               "--eval.batch_size=2", "--eval.use_async_envs=false", f"--seed={first}", f"--output_dir={out}"]  # fmt: skip
    paths = os.pathsep.join([str(site), str(ROOT)])
    done = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"},
        cwd=out.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    (task,) = json.loads((out / "eval_info.json").read_text())["per_task"]
    return task["metrics"]["successes"]


@pytest.mark.sweep
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("method", ["generic", "vap"])
@pytest.mark.parametrize("first", range(0, 24, EPISODES))
def test_lerobots_own_command_gives_the_successes_of_our_engine(
    site: Path,
    tmp_path: Path,
    method: str,
    first: int,
    record_property: Callable[[str, object], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The shipped checkpoint as it is, and with VAP attached by our command; every row of a task.

    lerobot's loop has the policy's pictures alone, so that ours looks no closer either.
    """
    monkeypatch.setattr("vap_core.rollout.prompters.GROUNDING_PX", 224)
    study = Study(((SUITE, TASK),), (method,), policy="mini-pi0", follow="step")
    assert len(suites.rows(SUITE, TASK)) == 24
    rows = study.rows(SUITE, TASK)[first : first + EPISODES]
    bank = tmp_path / "memory"
    register_personal(study, bank)
    policy = shipped(SUITE)
    if method == "vap":
        policy = tmp_path / "prompted"
        done = vap("attach", shipped(SUITE), policy, "--memory", bank)
        assert done.returncode == 0, done.stderr
    episodes = rollout(make_trial(study, rows, method, bank), rows, batch=2)
    ours = [episode.outcome.success for episode in episodes]
    theirs = lerobot_eval(site, policy, tmp_path / "out", first)
    different = int(np.sum(np.array(ours) != theirs))
    record_property("cases", EPISODES)
    record_property(f"{method}_successes_here", sum(ours))
    record_property(f"{method}_successes_of_lerobot-eval", sum(theirs))
    record_property("other_outcomes", different)
    assert different == 0


@pytest.mark.parametrize(
    ("checkpoint", "task"),
    [
        (shipped("tabletop"), "tabletop/select-cup"),
        (shipped("vlabench"), "vlabench/select-cup"),
        (SHIPPED / "mini-pi0-shared-pair", "shared-pair/put-pouch-near-vase"),
    ],
)
def test_the_command_after_attach_is_of_the_checkpoints_suite(
    tmp_path: Path, checkpoint: Path, task: str
) -> None:
    """It named a task of another robot for all but one, and broke at a folder with a space."""
    out = tmp_path / "a b'c"
    study = Study((("tabletop", "select-cup"),), ("vap",), policy="mini-pi0")
    register_personal(study, tmp_path / "memory")
    done = vap("attach", checkpoint, out, "--memory", tmp_path / "memory")
    (line,) = re.findall(r"^next: (.*)$", done.stdout, re.MULTILINE)
    words = shlex.split(line)
    assert words[:3] == ["lerobot-eval", f"--policy.path={out}", "--env.type=vap"]
    assert f"--env.task={task}" in words


def test_the_command_after_attach_leaves_the_suite_open_where_nothing_says_it(
    tmp_path: Path,
) -> None:
    for file in shipped(SUITE).iterdir():
        if file.name != "training.json":
            (tmp_path / file.name).symlink_to(file.resolve())
    assert trained_for(shipped(SUITE)) == SUITE
    assert trained_for(tmp_path) == ""
    assert _task_to_try(str(shipped(SUITE)), tmp_path) == f"{SUITE}/pick-shaver"
    assert _task_to_try(str(tmp_path), tmp_path) == "SUITE/TASK"


def test_attach_says_what_it_wrote_and_refuses_a_second_time(tmp_path: Path) -> None:
    mug = personal("mug", "cup", (40, 120, 110))
    save(tmp_path / "memory", replace(mug, encoder=load_stack("embedded").encoder.name))
    words = ("attach", shipped(SUITE), tmp_path / "out", "--memory", tmp_path / "memory")
    done = vap(*words)
    assert done.returncode == 0, done.stderr
    assert "next: lerobot-eval --policy.path=" in done.stdout
    steps = json.loads((tmp_path / "out" / "policy_preprocessor.json").read_text())["steps"]
    assert steps[1]["config"]["episodes"] == "auto"
    again = vap(*words)
    assert again.returncode == 2
    assert "exists; choose another folder" in again.stderr
    (tmp_path / "empty").mkdir()
    words_of_empty = (*words[:2], tmp_path / "late", "--memory", tmp_path / "empty")
    assert f"{tmp_path / 'empty'} holds no object" in refused(*words_of_empty)
    assert not (tmp_path / "late").exists()
    (tmp_path / "file").write_text("")
    inside = refused("attach", shipped(SUITE), tmp_path / "file" / "out", "--memory", words[4])
    assert "cannot be written" in inside


def test_attach_refuses_what_would_fail_at_the_first_picture(tmp_path: Path) -> None:
    bank, out = tmp_path / "memory", tmp_path / "out"
    mug = personal("mug", "cup", (40, 120, 110))
    save(bank, mug)
    with pytest.raises(BadMemory, match=f"mug.* was embedded by '{mug.encoder}', this stack uses"):
        attach(shipped(SUITE), out, bank)
    with pytest.raises(UnknownName, match="^attach: object 'cup' is unknown; known: mug"):
        attach(shipped(SUITE), out, bank, objects=["cup"])
    assert not out.exists()
