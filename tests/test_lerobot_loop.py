"""VAP inside lerobot: the step alone on exact parts, then lerobot's own evaluation against our rollout."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.envs.utils import preprocess_observation
from lerobot.lerobot_types import TransitionKey
from lerobot.policies import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts import lerobot_eval

from tests import tiny_lerobot as tiny
from tests.toys import TOYS, personal, scene
from vap_core import memory
from vap_core.attend import GROUNDING_PX, Attender
from vap_core.base.errors import BadMemory, BadOutput, BadPolicy, BadSuite, BadViews, UnknownName
from vap_core.perception.stacks import STACKS, load_stack
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.lerobot.step import LeRobotEnv, VapEnvConfig, VapPrompt, attach
from vap_core.prompt import PALETTE, tint
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import TintPrompter, generic
from vap_core.simulation import suites
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.scenes import build
from vap_core.simulation.studio import reference_views

SUITE, TASK = "simpler-bridge", "put-camera"
BLUE, GREEN = (0, 0, 255), (0, 255, 0)


@pytest.fixture
def bank(tmp_path, monkeypatch):
    """My mug is the blue square."""
    monkeypatch.setitem(STACKS, "toys", lambda: TOYS)
    memory.save(tmp_path / "memory", personal("mug", "mug", BLUE))
    return tmp_path / "memory"


def at(x):
    return scene([(x, 30, BLUE), (40, 10, GREEN)])


def batch(pictures, steps=None, text="bring my mug"):
    """What lerobot-eval hands to a preprocessor."""
    seen = {
        "pixels": {"top": np.stack(pictures)},
        "agent_pos": np.zeros((len(pictures), 2), np.float32),
    }
    if steps is not None:
        seen["vap_step"] = np.array(steps, np.float32)[:, None]
    out = preprocess_observation(seen)
    return {**out, "task": [text] * len(pictures)}


def pipeline(bank, **how):
    return PolicyProcessorPipeline(steps=[VapPrompt(str(bank), stack="toys", **how)])


def rgb(out, i=0):
    return (out["observation.images.top"][i].permute(1, 2, 0) * 255).round().byte().numpy()


def direct(bank, pictures):
    """The same episode by the Attender itself."""
    attender, shown = Attender(TOYS, memory.load_bank(bank)), []
    state, attended = attender.start({"top": pictures[0]}, "bring my mug")
    shown.append(attended)
    for picture in pictures[1:]:
        state, attended = attender.step(state, {"top": picture})
        shown.append(attended)
    return shown


def test_the_step_does_what_the_attender_does_at_every_phase_of_every_environment(bank):
    """Two environments, the second a step behind the first and starting again in the middle."""
    first, second = [at(x) for x in (2, 4, 6, 8)], [at(x) for x in (20, 22)]
    step = pipeline(bank)
    expected = direct(bank, first)
    other = direct(bank, second)
    for t, (a, i) in enumerate(zip(first, (0, 1, 0, 1), strict=True)):
        out = step(batch([a, second[i]], [t, i]))
        for k, wanted in enumerate((expected[t], other[i])):
            assert (rgb(out, k) == wanted.images["top"]).all()
            assert out["task"][k] == wanted.text != "bring my mug"
        assert (rgb(out) != a).any()
        assert "observation.vap_step" not in out


def test_an_episode_that_is_over_stands_still(bank):
    step, pictures = pipeline(bank), [at(2), at(4)]
    step(batch(pictures, [0, 0]))
    moved = step(batch([at(6), at(8)], [1, 1]))
    still = step(batch([at(6), at(10)], [1, 2]))
    assert torch.equal(moved["observation.images.top"][0], still["observation.images.top"][0])


def test_one_step_does_not_serve_two_tasks_at_a_time(bank):
    memory.save(bank, personal("jar", "jar", GREEN))
    step = pipeline(bank)
    step(batch([at(4)], [0], text="bring my mug"))
    step(batch([at(20)], [0], text="bring my jar"))
    with pytest.raises(BadViews, match="'bring my mug' at step 1, and had 'bring my jar'"):
        step(batch([at(6)], [1], text="bring my mug"))
    step(batch([at(22)], [1], text="bring my jar"))
    with pytest.raises(BadViews, match="at step 1 twice, with another picture"):
        step(batch([at(6)], [1], text="bring my jar"))


def test_pixels_beside_the_mask_stay_bit_for_bit(bank):
    given = batch([at(4)], [0])
    given["observation.images.top"] *= 0.9999  # not whole numbers of 255ths
    out = pipeline(bank)(given)["observation.images.top"][0]
    stay = torch.from_numpy(~(at(4) == BLUE).all(-1))
    assert torch.equal(out[:, stay], given["observation.images.top"][0][:, stay])
    assert not torch.equal(out, given["observation.images.top"][0])


def test_an_object_is_meant_by_its_owner_or_its_name_and_tinted_as_strongly_as_wanted(bank):
    memory.save(bank, replace(personal("annas", "mug", GREEN), owner="anna"))
    tinted = tint(at(4), (at(4) == GREEN).all(-1), PALETTE[0], 0.25)
    for how in ({"speaker": "anna"}, {"objects": ["annas"]}):
        assert (rgb(pipeline(bank, alpha=0.25, **how)(batch([at(4)], [0]))) == tinted).all()


def test_views_without_the_object_and_a_batch_in_hand_pass_bit_for_bit(bank):
    empty = scene([])
    given = batch([empty, at(4)], [0, 0])
    given["observation.images.top"] += 1e-4  # not a whole number of 255ths
    before = given["observation.images.top"].clone()
    out = pipeline(bank)(given)
    assert torch.equal(out["observation.images.top"][0], before[0])
    assert torch.equal(given["observation.images.top"], before)
    assert out["task"][0] == "bring my mug"
    assert torch.equal(out["observation.state"], given["observation.state"])


def test_switches_and_resets(bank):
    only_words = pipeline(bank, highlight=False)(batch([at(4)], [0]))
    assert (rgb(only_words) == at(4)).all()
    assert only_words["task"] != ["bring my mug"]
    step = pipeline(bank, episodes="reset", rewrite=False)
    step.reset()
    shown = [step(batch([at(x)])) for x in (4, 6)]
    assert shown[0]["task"] == ["bring my mug"]
    assert (rgb(shown[1]) == direct(bank, [at(4), at(6)])[1].images["top"]).all()
    step.reset()
    single = {
        "observation.images.top": batch([at(8)])["observation.images.top"][0],
        "task": "bring my mug",
    }
    assert torch.equal(
        step(single)["observation.images.top"],
        pipeline(bank)(batch([at(8)], [0]))["observation.images.top"][0],
    )


def test_what_cannot_be_known_fails_loudly(bank, tmp_path):
    with pytest.raises(BadViews, match=r"observation.vap_step is missing.*episodes='reset'"):
        pipeline(bank, episodes="vap_step")(batch([at(4)]))
    with pytest.raises(BadViews, match="2 environments, of which a reset .* names none"):
        pipeline(bank)(batch([at(4), at(6)]))
    for episodes in ("auto", "reset"):
        with pytest.raises(
            BadViews, match=r"lerobot-eval never does.*give the observation vap_step"
        ):
            pipeline(bank, episodes=episodes)(batch([at(4)]))
    careless = pipeline(bank, episodes="reset")
    careless.reset()
    careless(batch([at(4)], [0]))
    with pytest.raises(BadViews, match="at step 0 where the resets count 1; .*episodes='auto'"):
        careless(batch([at(4)], [0]))
    step = pipeline(bank)
    with pytest.raises(BadViews, match="environment 0 is at step 3 after nothing"):
        step(batch([at(4)], [3]))
    step(batch([at(4)], [0]))
    with pytest.raises(
        BadViews, match="environment 0 is at step 2 after 0; give every picture, in order"
    ):
        step(batch([at(6)], [2]))
    with pytest.raises(BadViews, match="holds actions, so it is for training"):
        step({**batch([at(6)], [1]), "action": torch.zeros(1, 2)})
    with pytest.raises(BadViews, match=r"no observation.images.\* among"):
        step({"observation.state": torch.zeros(1, 2), "task": ["bring my mug"]})
    with pytest.raises(UnknownName, match="stack 'nonesuch' is unknown; known: embedded"):
        VapPrompt(str(bank), stack="nonesuch")
    with pytest.raises(BadMemory, match="is no folder of remembered objects"):
        VapPrompt(str(tmp_path / "none"))


def test_a_camera_that_fails_is_named_and_nothing_reaches_the_policy(bank):
    """A frame of NaN, a camera that is gone from one step to the next, one that is new."""
    step = pipeline(bank)
    step(batch([at(4)], [0]))
    for wrong in (float("nan"), float("inf")):
        shown = batch([at(6)], [1])
        shown["observation.images.top"][0, 1, 5, 5] = wrong
        with pytest.raises(
            BadViews, match=r"observation.images.top has numbers that are not finite; mend the cam"
        ):
            step(shown)
    gone = batch([at(6)], [1])
    side = gone.pop("observation.images.top")
    with pytest.raises(BadViews, match=r"no observation.images.\* among"):
        step(gone)
    with pytest.raises(
        BadViews,
        match=r"views of \['side'\], but the episode started with \['top'\]; give the same",
    ):
        step({**gone, "observation.images.side": side})
    later = step(batch([at(6)], [1]))
    assert (rgb(later) == direct(bank, [at(4), at(6)])[1].images["top"]).all(), "it goes on"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda rgb: (255 * rgb).byte(),
            r"top is Tensor torch.uint8 of \(1, 3, 64, 64\); give a ten",
        ),
        (lambda rgb: 255 * rgb, "top has numbers from 0 to 255; give floats in 0..1"),
        (lambda rgb: 2 * rgb - 1, "top has numbers from -1 to 1; give floats in 0..1"),
        (lambda rgb: torch.cat([rgb, rgb[:, :1]], 1), r"of \(1, 4, 64, 64\)"),
        (lambda rgb: rgb[:, :1], r"of \(1, 1, 64, 64\)"),
        (lambda rgb: rgb.permute(0, 2, 3, 1), r"of \(1, 64, 64, 3\)"),
        (lambda rgb: rgb[None], r"of \(1, 1, 3, 64, 64\)"),
        (lambda rgb: rgb[..., :0], r"of \(1, 3, 64, 0\)"),
        (lambda rgb: rgb.numpy(), r"top is ndarray float32 of \(1, 3, 64, 64\)"),
        (lambda rgb: None, r"top is NoneType of \(\)"),
        (lambda rgb: rgb.repeat(2, 1, 1, 1), "of 2 environments, but there are 1 tasks and 1 step"),
    ],
)
def test_a_picture_that_is_not_lerobots_is_refused(bank, change, said):
    shown = batch([at(4)], [0])
    shown["observation.images.top"] = change(shown["observation.images.top"])
    with pytest.raises(BadViews, match=said):
        pipeline(bank)(shown)


@pytest.mark.parametrize("key", ["observation.image", "observation.image2", "observation.wrist"])
def test_a_colour_picture_that_would_stay_without_a_tint_is_refused(bank, key):
    """The task names the tint, and the policy reads the picture without it."""
    shown = batch([at(4)], [0])
    said = rf"{key} is a colour picture, and observation.images.\* alone .* by rename_map in the"
    with pytest.raises(BadViews, match=said):
        pipeline(bank)({**shown, key: torch.zeros(1, 3, 64, 64)})
    with pytest.raises(BadViews, match=said):
        pipeline(bank)(
            {
                "observation.images.top": shown["observation.images.top"][0],
                "observation.vap_step": shown["observation.vap_step"],
                key: torch.zeros(3, 64, 64),
                "task": "bring my mug",
            }
        )
    with pytest.raises(BadViews, match=said):
        pipeline(bank)({key: torch.zeros(1, 3, 64, 64), "task": ["bring my mug"]})


def test_what_is_no_colour_picture_passes_under_any_name(bank):
    shown = batch([at(4)] * 3, [0, 0, 0])
    others = {
        "observation.history": torch.zeros(3, 5, 2),
        "observation.image_tokens": torch.zeros(3, 8, 2),
        "observation.depth": torch.zeros(3, 1, 64, 64),
        "observation.image_is_pad": torch.zeros(3, 2, dtype=torch.bool),
        "observation.points": torch.zeros(3, 2, 9, 3),
    }
    out = pipeline(bank)({**shown, **others})
    for key, tensor in others.items():
        assert torch.equal(out[key], tensor)


@pytest.mark.parametrize("step", [float("nan"), float("inf"), 1.5, -1.0])
def test_a_step_that_is_no_whole_number_is_refused(bank, step):
    ongoing = pipeline(bank)
    ongoing(batch([at(4)], [0]))
    with pytest.raises(BadViews, match=rf"vap_step is {step:g}; give the whole number of steps"):
        ongoing(batch([at(6)], [step]))


@pytest.mark.parametrize("step", [0.0, 1.0])
def test_a_repeated_step_and_the_next_have_the_cameras_of_the_start(bank, step):
    """An episode that is over stands still with all of them."""
    ongoing = pipeline(bank)
    ongoing(batch([at(4)], [0]))
    ongoing(batch([at(4)], [1]))
    shown = batch([at(4)], [1 + step])
    side = {"observation.images.side": shown["observation.images.top"]}
    said = r"views of \[.*'side'.*\], but the episode started with \['top'\]; give the same cameras"
    with pytest.raises(BadViews, match=said):
        ongoing({**shown, **side})
    del shown["observation.images.top"]
    with pytest.raises(BadViews, match=said):
        ongoing({**shown, **side})


def test_two_environments_need_a_task_each(bank):
    shown = {**batch([at(4), at(6)], [0, 0]), "task": "bring my mug"}
    with pytest.raises(BadViews, match="of 2 environments, but there are 1 tasks and 2 steps"):
        pipeline(bank)(shown)


def test_depth_passes_and_half_precision_is_prompted(bank):
    shown = batch([at(4)], [0])
    depth = 5 * torch.ones(1, 1, 64, 64)
    shown["observation.images.top"] = shown["observation.images.top"].half()
    out = pipeline(bank)({**shown, "observation.images.top_depth": depth})
    assert torch.equal(out["observation.images.top_depth"], depth)
    wanted = direct(bank, [at(4)])[0].images["top"].astype(int)
    assert abs(rgb(out).astype(int) - wanted).max() <= 1


def test_the_configuration_is_json_and_comes_back(bank, tmp_path):
    step = VapPrompt(str(bank), stack="toys", objects=["mug"], rewrite=False, alpha=0.3)
    assert VapPrompt(**json.loads(json.dumps(step.get_config()))).get_config() == step.get_config()
    PolicyProcessorPipeline(steps=[step], name="p").save_pretrained(tmp_path / "p")
    again = PolicyProcessorPipeline.from_pretrained(tmp_path / "p", config_filename="p.json")
    assert again.steps[0].get_config() == step.get_config()
    assert step.transform_features({}) == {}
    assert step(
        {
            TransitionKey.OBSERVATION: batch([at(4)], [0]),
            TransitionKey.COMPLEMENTARY_DATA: {"task": "bring my mug"},
        }
    )


def test_the_environment_numbers_its_steps_and_ends_like_ours():
    env = LeRobotEnv(SUITE, TASK, image_size=64, max_steps=2)
    rows = suites.rows(SUITE, TASK)
    for seed in (1, 1 + len(rows)):
        seen, info = env.reset(seed=seed)
        assert info["episode"] == rows[1].episode
        assert seen["vap_step"] == [0]
        assert env.observation_space.contains(seen)
    assert env._max_episode_steps == 2
    ends = [env.step(env.action_space.low * 0)[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    assert env.render().shape == (64, 64, 3)
    env.close()
    config = VapEnvConfig(task=SUITE, image_size=64)
    assert config.tasks == tuple(task.name for task in suites.suite(SUITE).tasks)
    assert config.fps == 5
    with pytest.raises(UnknownName, match="task 'nonesuch' is unknown; known: pick-shaver"):
        VapEnvConfig(task=f"{SUITE}/nonesuch")


@pytest.mark.parametrize("max_steps", [0, -1])
def test_a_limit_of_no_steps_is_refused(max_steps):
    """It was the whole limit of the suite."""
    said = f"max_steps is {max_steps}; give 1 or more, or leave it out"
    with pytest.raises(BadSuite, match=said):
        VapEnvConfig(task=f"{SUITE}/{TASK}", max_steps=max_steps)
    with pytest.raises(BadSuite, match=said):
        LeRobotEnv(SUITE, TASK, image_size=64, max_steps=max_steps)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A checkpoint, the memory of the personal camera, and the checkpoint with VAP attached."""
    root = tmp_path_factory.mktemp("loop")
    stack, row = load_stack("embedded"), suites.rows(SUITE, TASK, 1)[0]
    obj, _ = memory.register(
        row.target,
        row.category,
        reference_views(get_object(row.target)),
        stack.detector,
        stack.encoder,
    )
    memory.save(root / "memory", obj)
    tiny.act(root / "act", side=224)
    attach(root / "act", root / "personal", root / "memory")
    return root


def test_attaching_links_the_frozen_files_and_adds_one_step(whole):
    kept = {file.name: file for file in (whole / "act").iterdir()}
    for file in (whole / "personal").iterdir():
        if file.name == "policy_preprocessor.json":
            before, after = (
                json.loads(one.read_text())["steps"] for one in (kept[file.name], file)
            )
            assert [*after[:1], *after[2:]] == before
            assert after[1]["class"] == "vap_core.policies.lerobot.step.VapPrompt"
        else:
            assert file.resolve() == kept[file.name].resolve()
    with pytest.raises(BadOutput, match="personal exists; choose another folder"):
        attach(whole / "act", whole / "personal", whole / "memory")
    with pytest.raises(BadPolicy, match="has VAP attached; give the checkpoint without it"):
        attach(whole / "personal", whole / "twice", whole / "memory")
    assert not (whole / "twice").exists()
    with pytest.raises(BadPolicy, match="has VAP attached for lerobot's own loops"):
        load_policy(whole / "personal")


def test_lerobots_own_loop_and_our_rollout_do_the_same(whole):
    """Same frozen policy, episodes, pictures and per-step VAP: every action is the same in both."""
    policy = load_policy(whole / "act")
    config = VapEnvConfig(task=f"{SUITE}/{TASK}", max_steps=3, image_size=GROUNDING_PX)
    before = policy.sha256()
    env = config.create_envs(2)[SUITE][0]
    pipelines = (
        *config.get_env_processors(),
        *make_pre_post_processors(policy.policy.config, str(whole / "personal")),
    )
    theirs = lerobot_eval.eval_policy(
        env, policy.policy, *pipelines, n_episodes=2, start_seed=0, return_episode_data=True
    )["episodes"]
    env.close()

    rows = [replace(row, max_steps=3) for row in suites.rows(SUITE, TASK)[:2]]
    models = dict.fromkeys(
        place.model for row in suites.rows(SUITE, TASK) for place in row.placements
    )
    attender = Attender(load_stack("embedded"), memory.load_bank(whole / "memory"))
    with build(suites.suite(SUITE).robot, tuple(models)) as built:
        ours = {}
        for name, prompter in (("vap", TintPrompter(attender)), ("generic", generic())):
            trial = Trial(
                method=name,
                scene=built,
                policy=policy,
                prompter=prompter,
                sensor=suites.suite(SUITE).sensor,
                image_size=GROUNDING_PX,
            )
            ours[name] = [
                np.stack([frame.action for frame in episode.frames[:3]])
                for episode in rollout(trial, rows)
            ]
    for i in range(2):
        actions = theirs["action"][theirs["episode_index"] == i][:3].numpy()
        assert np.allclose(actions, ours["vap"][i], atol=1e-6)
        assert np.abs(actions - ours["generic"][i]).max() > 1e-5  # the tint reached it
    assert policy.sha256() == before


def test_lerobot_eval_runs_it_from_the_command_line(whole, tmp_path, monkeypatch):
    arguments = f"""--policy.path={whole / "personal"} --env.type=vap --env.task={SUITE}/{TASK} --env.max_steps=2 --policy.device=cpu
        --env.discover_packages_path=vap_core.policies.lerobot --eval.n_episodes=1 --seed=0 --output_dir={tmp_path / "out"}"""
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *arguments.split()])
    lerobot_eval.eval_main()
    said = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert said["per_task"][0]["task_group"] == SUITE
    assert list((tmp_path / "out" / "videos").rglob("*.mp4"))
