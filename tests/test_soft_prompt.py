"""The soft prompt as a method: the word is learned from photos, said in place of "my cup", and no weight of the policy moves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors

from vap_core.base.errors import BadMemory, BadStudy
from vap_core.contracts import test_suite
from vap_core.policies.lerobot.checkpoints import config_field
from vap_core.policies.mini_pi0 import learned_token
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.learned_token import WORD, TokenTraining, photographs
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy
from vap_core.policies.mini_pi0.vlm import MiniVlm, load_vlm
from vap_core.policies.names import SHIPPED
from vap_core.rollout.prompters import TextPrompter, soft_prompt
from vap_core.simulation import suites
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import Suite, own
from vap_core.simulation.suites.open_row import build_scene
from vap_core.simulation.suites.suite import Task
from vap_core.study import engine, trials
from vap_core.study.engine import run_job
from vap_core.study.methods import make_prompter
from vap_core.study.trials import Study
from vap_make.policy.train import initialise_policy
from vap_make.words import vocabulary

SUITE, TASK, STATE, ACTION = "simpler-bridge", "put-camera", 13, 7
MODEL = "mini-paligemma"


def config(vlm: str = "") -> MiniPI0Config:
    return MiniPI0Config(
        words=vocabulary(), device="cpu", max_state_dim=STATE, max_action_dim=ACTION, vision_depth=1, depth=2, vision_width=16, width=16, head_dim=2,
        expert_width=16, image_resolution=(32, 32), vlm=vlm, num_inference_steps=2,
        input_features={"observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
                        "observation.state": PolicyFeature(FeatureType.STATE, (STATE,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION,))},
    )  # fmt: skip


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tiny model, and a tiny policy that grew from it."""
    home, far = tmp_path_factory.mktemp("vlm"), tmp_path_factory.mktemp("policy")
    grow(home, far, 0)
    return home, far


def grow(home: Path, far: Path, seed: int) -> None:
    """Write a tiny model, and a tiny policy that grew from it."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        MiniVlm(config()).save(home)
        vlm = load_vlm(home)
        policy = MiniPI0Policy(config(vlm.sha256()))
    initialise_policy(vlm, policy)
    policy.save_pretrained(far)
    stats = {
        name: {"mean": torch.zeros(n), "std": torch.ones(n)}
        for name, n in (("observation.state", STATE), ("action", ACTION))
    }
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
        pipeline.save_pretrained(far)


def test_my_cup_becomes_a_word() -> None:
    say = soft_prompt(WORD).rewrite
    assert say("put my camera on the plate") == "put <my_0> on the plate"
    assert say("pick up my straw cup") == "pick up <my_0>"


@pytest.mark.parametrize(
    ("category", "instruction", "read"),
    [
        ("cup", "put my cup gently on the plate", "put <my_0> gently on the plate"),
        ("work of art", "pick up my work of art", "pick up <my_0>"),
    ],
)
def test_the_words_beside_the_object_stay(category: str, instruction: str, read: str) -> None:
    """The methods of one table read the same command of an own suite."""
    task = Task(name="own", category=category, instruction=instruction, max_steps=9)
    own.check_wording(task)
    (row,) = suites.rows("widowx-pick", "pick-straw-cup", 1)
    mine = replace(row, category=category, instruction=instruction)
    scene = build_scene(row.suite, [place.model for place in row.placements])
    prompter = make_prompter("soft", mine, Path("nowhere"), scene, None)
    scene.close()
    assert isinstance(prompter, TextPrompter)
    assert prompter.rewrite(instruction) == read
    suite = Suite(name="own", robot="wx250s", hz=5.0, cameras=("front",), tasks=(task,))
    of_category = test_suite.test_every_instruction_has_one_personal_object_of_the_tasks_category
    of_category(suite)


def test_photos_show_the_target_its_look_alikes_and_others() -> None:
    rows = suites.rows(SUITE, TASK)
    photos = photographs(rows, 0, 5)
    names = {place.model for row in rows for place in row.placements}
    rivals = [name for name in names if "lookalike" in name]
    assert (len(photos.own), len(photos.rivals), len(photos.others)) == (
        5,
        12 * len(rivals),
        5 * learned_token.OTHERS,
    )
    assert {objects.get_object(name).category for name in rivals} == {"camera"}
    unseen = photographs(rows[:1], 1, 5)
    assert not any(np.array_equal(one, two) for one in photos.own for two in unseen.own)


def test_it_runs_as_a_method_and_the_policy_stays(
    grown: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, far = grown
    monkeypatch.setattr(learned_token, "MODEL", home)
    monkeypatch.setattr(learned_token, "VIEWS", 2)
    monkeypatch.setattr(
        learned_token, "TokenTraining", lambda: TokenTraining(epochs=2, augmentations=1)
    )
    study = Study(((SUITE, TASK),), ("generic", "soft"), episodes=1, policy=str(far))
    engine.store.open_run(tmp_path, study.configuration())
    trials.register_personal(study, tmp_path / "memory")
    jobs = list(engine.missing_jobs(study, tmp_path))
    rows = {job.method: run_job(job)[0] for job in jobs}
    assert {row["outcome"] for row in rows.values()} == {"failure"}
    assert rows["soft"]["policy_sha256"] == rows["generic"]["policy_sha256"] != ""
    row, bank = study.rows(SUITE, TASK)[0], tmp_path / "memory"
    soft, plain = (trials.make_trial(study, [row], method, bank) for method in ("soft", "generic"))
    assert isinstance(soft.prompter, TextPrompter)
    assert isinstance(plain.prompter, TextPrompter)
    assert soft.prompter.rewrite(row.instruction) == "put <my_0> on the plate"
    assert plain.prompter.rewrite(row.instruction) == row.instruction
    (token,) = bank.glob("*.token.safetensors")
    token.unlink()
    with pytest.raises(BadMemory, match="no learned word"):
        trials.make_trial(study, [row], "soft", bank)


def test_one_object_has_a_token_for_every_model_and_its_look_alikes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three tasks ask for one camera: two policies grew from one model, the third from another."""
    for name, seed in ((MODEL, 0), (f"{MODEL}-other", 1)):
        home, far = tmp_path / name, tmp_path / f"policy-{name}"
        home.mkdir()
        far.mkdir()
        grow(home, far, seed)
    policies = {SUITE: MODEL, "widowx-pick": f"{MODEL}-other", "franka-pick": MODEL}
    monkeypatch.setattr(
        "vap_core.study.trials.shipped", lambda suite: tmp_path / f"policy-{policies[suite]}"
    )
    monkeypatch.setattr(learned_token, "MODEL", tmp_path / MODEL)
    monkeypatch.setattr(learned_token, "VIEWS", 2)
    monkeypatch.setattr(
        learned_token, "TokenTraining", lambda: TokenTraining(epochs=1, augmentations=1)
    )
    tasks = ((SUITE, TASK), ("widowx-pick", "pick-camera"), ("franka-pick", "pick-camera"))
    study = Study(tasks, ("soft",), policy="mini-pi0", episodes=1)
    assert {study.rows(*task)[0].target for task in tasks} == {"camera-personal"}
    trials.register_personal(study, tmp_path / "memory")
    used = []
    for task in tasks:
        row = study.rows(*task)[0]
        used.append(trials._token_embedding(study, "soft", row, tmp_path / "memory").tolist())
    assert len(list((tmp_path / "memory").glob("camera-personal.*.token.safetensors"))) == 3
    assert len(set(map(tuple, used))) == 3
    alone = replace(study, tasks=tasks[2:])
    trials.register_personal(alone, tmp_path / "alone")
    row = alone.rows(*tasks[2])[0]
    assert trials._token_embedding(alone, "soft", row, tmp_path / "alone").tolist() == used[2]


def test_the_shipped_model_that_a_policy_grew_from_is_found() -> None:
    for name, model in (("simpler-bridge-wide-seed-0", "-tint-free"),):
        grew_from = config_field(SHIPPED / f"mini-pi0-{name}", "vlm")
        assert learned_token.model_of(grew_from) == SHIPPED / f"mini-paligemma{model}"
    assert learned_token.model_of("f" * 64) == learned_token.MODEL, "which is then refused"


def test_a_policy_of_another_model_is_refused(grown: tuple[Path, Path], tmp_path: Path) -> None:
    rows = suites.rows(SUITE, TASK)[:1]
    for sha, told in (("f" * 64, "mini-PaliGemma ffffffff"), ("", "none")):
        with pytest.raises(
            BadStudy,
            match=f"the policy was initialised from {told}, but the model in .* leave soft out",
        ):
            learned_token.teach(rows, tmp_path, sha, grown[0])


def test_a_policy_without_words_is_refused() -> None:
    with pytest.raises(BadStudy, match="no words that could be learned"):
        Study(((SUITE, TASK),), ("soft",), policy="scripted")
