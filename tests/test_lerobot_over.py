"""Any environment of lerobot with numbered steps and another command: exact, refused, and on LIBERO."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.scripts import lerobot_eval
from numpy.testing import assert_array_equal

from vap_core.base.errors import BadSuite, UnknownName
from vap_core.policies.lerobot import step
from vap_core.policies.lerobot.over import NumberedEnvs, VapOverConfig
from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, toy_sizes


class TwoEnvs:
    """Two environments that count; the first is over after two steps and begins anew by itself."""

    num_envs = 2
    metadata: dict[str, Any] = {"render_fps": 5}  # noqa: RUF012

    def __init__(self) -> None:
        self.n = 0

    def _seen(self) -> dict[str, Any]:
        first = self.n if self.n <= 2 else 100 + self.n
        return {"pixels": {"top": np.array([[first], [self.n]])}, "agent_pos": np.zeros((2, 3))}

    def reset(self, **how: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        self.n = 0
        return self._seen(), how

    def step(self, action: Any) -> tuple[Any, ...]:
        self.n += 1
        return self._seen(), np.zeros(2), np.array([self.n == 2, False]), np.zeros(2, bool), {}

    def call(self, name: str) -> list[str]:
        return [name, name]


def test_steps_are_numbered_and_what_is_over_stands_still() -> None:
    envs = NumberedEnvs(TwoEnvs(), "put my mug on the plate")
    for _ in range(2):
        seen, info = envs.reset(seed=[1, 2])
        assert info == {"seed": [1, 2]}
        found = [seen] + [envs.step(None)[0] for _ in range(4)]
        numbers = np.stack([each["vap_step"][:, 0] for each in found])
        tops = np.stack([each["pixels"]["top"][:, 0] for each in found])
        assert_array_equal(numbers, [[0, 0], [1, 1], [2, 2], [2, 3], [2, 4]])
        assert_array_equal(tops, numbers)
    assert envs.call("task_description") == ["put my mug on the plate"] * 2
    assert envs.call("_max_episode_steps") == ["_max_episode_steps"] * 2
    assert envs.metadata == {"render_fps": 5}
    assert NumberedEnvs(TwoEnvs(), "").call("task") == ["task", "task"]


def test_what_is_below_is_as_it_was() -> None:
    over = VapOverConfig(over="vap", options={"task": "simpler-bridge/put-camera"})
    inner = EnvConfig.get_choice_class("vap")(task="simpler-bridge/put-camera")
    assert (over.features, over.features_map, over.fps) == (
        inner.features, inner.features_map, inner.fps,
    )  # fmt: skip
    assert over.gym_kwargs == inner.gym_kwargs


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({}, UnknownName, "--env.over '' is unknown; known: .*libero"),
        ({"over": "vap_over"}, UnknownName, "is unknown"),
        ({"over": "libero", "options": {"tusk": 1}}, BadSuite, "does not take .*'tusk'"),
    ],
)
def test_what_is_refused(given: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        VapOverConfig(**given)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_lerobot_eval_on_lerobots_own_libero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tiny random PI0 of LIBERO's shapes, attached: its own command, our prompt in every step."""
    pytest.importorskip("libero", reason="LIBERO is not installed: make libero")
    from vap_core.simulation.suites import tasks_of
    from vap_core.study.trials import Study, register_personal

    task = tasks_of(["libero-personal"], "")[0]
    register_personal(Study((task,), ("vap",), episodes=1), tmp_path / "memory")
    toy = Toy(image=32, layers=1, denoise=2)
    save_toy(tmp_path / "pi0", ("image", "image2"), 8, 7, toy)
    step.attach(tmp_path / "pi0", tmp_path / "personalised", tmp_path / "memory")
    texts: list[str] = []
    prompt = step.VapPrompt._prompt

    def kept(self: Any, views: Any, given: Any, steps: Any) -> Any:
        tensors, said = prompt(self, views, given, steps)
        tinted = any((tensors[key] != views[key]).any() for key in views)
        texts.append(f"{steps} {given[0]} -> {said[0]}: {'tinted' if tinted else 'as it was'}")
        return tensors, said

    monkeypatch.setattr(step.VapPrompt, "_prompt", kept)
    options = '{"task": "libero_90", "task_ids": [65], "episode_length": 4}'
    command = "put my mug on the left plate"
    words = [
        *("lerobot-eval", f"--policy.path={tmp_path / 'personalised'}", "--policy.device=cpu"),
        *("--env.type=vap_over", "--env.over=libero", f"--env.options={options}"),
        *(f"--env.instruction={command}", "--eval.n_episodes=1", "--eval.batch_size=1"),
        *(f"--output_dir={tmp_path / 'out'}", "--seed=0"),
    ]
    monkeypatch.setattr(sys, "argv", words)
    with toy_sizes(toy):
        lerobot_eval.main()
    assert (tmp_path / "out" / "eval_info.json").is_file()
    assert [text.split("]")[0] for text in texts] == [f"[{n}" for n in range(len(texts))]
    assert f"[0] {command} -> put the " in texts[0]
    assert texts[0].endswith(" mug on the left plate: tinted")
