"""Train a mini-pi0 on filmed demonstrations (P 5.1).

    python -m vap_core train policy --suite simpler-bridge --stages 400

Flow matching as in pi0, and, while training only, questions about what is meant. The middle of the
decoder is asked, besides, which image patches show the object that is meant, where it stands, and,
under end-effector control, how the hand will close on it; the first two of what it goes to, too, if
anything. So is every later layer but the last, which in pi0 gives its keys and values alone. What
the middle knows, the action expert has half its layers left to act upon. The answers' heads are not
part of the policy.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.base.errors import BadOutput, BadPolicy
from vap_core.base.files import DATA, write_atomic
from vap_core.base.version import code_version
from vap_core.policies.lerobot.adapter import load_policy
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy, fused_attention
from vap_core.policies.mini_pi0.vlm import initialise_policy, load_vlm, store_in_bfloat16
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import suite
from vap_core.training.films.dataset import about, data_sha256, read, shoot_stages
from vap_core.training.films.demonstrations import SIDE, Film, cached
from vap_core.training.films.scenes import only_generic
from vap_core.training.patches import PatchScores, Sizes, patch_loss
from vap_core.training.policy.batches import Batch, Frames, statistics
from vap_core.training.step import Figures, Schedule, average_of, train_steps

CACHE = DATA / "cache" / "demonstrations"
CHUNKS = {
    "simpler-fractal": (4, 2),
    "simpler-bridge": (4, 4),
    "vlabench": (4, 4),
    "tabletop": (32, 10),
}
"""Actions in one chunk, and how many of them are carried out before the policy is asked again."""
HELD_OUT = 19
"""Every so many stages one is kept from training, to see what was learned.

It is a prime, as tasks take turns.
"""
CLOSE_M = 0.005
"""Error of a place up to which it is squared."""
SEEN = 0.5
"""Weight, beside the flow, of the question which patches show an object."""
PLACED = 1.0
"""Weight of the question where it stands."""
TURNED = 1.0
"""Weight of the question how the hand will close on it."""
TEMPERATURE = 0.0
"""Of the trained policy's sampling noise.

Without any, three in five generic objects are grasped where with all of it two in five are.
"""


@dataclass(frozen=True)
class Recipe(Sizes):
    """How long, how fast, how large.

    `draws` flow samples share one look at the pictures; frames close to the start, a grasp, a
    release or the end come `focus` times as often as others.
    """

    suite: str
    stages: int = 400
    steps: int = 12_000
    batch: int = 64
    draws: int = 4
    rate: float = 1e-3
    seed: int = 0
    focus: float = 3.0


class Place(PatchScores):
    """Scores which patches show an object, and says where it stands; in training only."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.place = nn.Linear(width, 3)

    def forward(
        self, hidden: Float[Tensor, "b p d"]
    ) -> tuple[Float[Tensor, "b p"], Float[Tensor, "b 3"], Float[Tensor, "b d"]]:
        """Scores of patches, the place in decimetres, and the features where attention lay."""
        x = self.norm(hidden)
        scores = self.patch(x).squeeze(-1)
        seen = torch.einsum("bp,bpd->bd", scores.softmax(-1), x)
        return scores, self.place(seen), seen


class Questions(nn.Module):
    """About the object that is meant, how a hand will close on it, and about its goal."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.target = Place(width)
        self.goal = Place(width)
        self.turn = nn.Linear(width, 2)

    def forward(self, hidden: Float[Tensor, "b p d"], batch: Batch) -> dict[str, Tensor]:
        """What looking, placing and turning cost, and the share of looks that hit.

        0, and that share nan, where nothing is asked.
        """
        answers, seen = self._place(self.target, hidden, batch, 0)
        goal_answers, _ = self._place(self.goal, hidden, batch, 1)
        closes = ~batch.turn[:, 0].isnan()
        if closes.any():
            guess = self.turn(seen[closes])
            answers["turn"] = F.smooth_l1_loss(guess, batch.turn[closes])
        else:
            answers["turn"] = torch.zeros(())
        for name, answer in goal_answers.items():
            answers[f"goal_{name}"] = answer
        return answers

    @staticmethod
    def _place(
        ask: Place, hidden: Tensor, batch: Batch, i: int
    ) -> tuple[dict[str, Tensor], Tensor]:
        """The losses and hits of one object, and the features where attention lay.

        `i` is 0 for the target, 1 for the goal.
        """
        there = ~batch.place[:, i, 0].isnan()
        scores, guess, seen = ask(hidden)
        if there.any():
            heat, hit = patch_loss(scores[there], batch.patches[there, i])
            place = batch.place[there, i]
            where = F.smooth_l1_loss(guess[there] * 0.1, place, beta=CLOSE_M) / 0.02
        else:
            heat = torch.zeros(())
            where = torch.zeros(())
            hit = torch.tensor(torch.nan)
        return {"heat": heat, "where": where, "hit": hit}, seen


class Learner(nn.Module):
    """What is trained: the policy, and the questions beside it."""

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.policy = MiniPI0Policy(config)
        self.asked = Questions(config.width)


def configuration(recipe: Recipe, state_size: int, action_size: int) -> MiniPI0Config:
    """The policy's configuration for states and actions of these sizes."""
    from lerobot.configs import FeatureType, PolicyFeature

    chunk, execute = CHUNKS[recipe.suite]
    inputs = {}
    for camera in suite(recipe.suite).cameras:
        view = PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
        inputs[f"observation.images.{camera}"] = view
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (state_size,))
    return MiniPI0Config(
        **recipe.configuration(),
        chunk_size=chunk,
        n_action_steps=execute,
        max_state_dim=state_size,
        max_action_dim=action_size,
        temperature=TEMPERATURE,
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
    )


def losses(
    policy: MiniPI0Policy, asked: Questions, batch: Batch, draws: int, generator: torch.Generator
) -> tuple[Tensor, dict[str, float]]:
    """The loss of one batch, and the figures that it is made of.

    Flow matching, `draws` times over one look; and what hidden states know about the object that is
    meant, in the mean over layers.
    """
    hidden, pad, cache = _look(policy, batch)
    flow = _flow_loss(
        policy=policy, batch=batch, pad=pad, cache=cache, draws=draws, generator=generator
    )
    n_patches = batch.patches.shape[2]
    answers = []
    for layer in hidden:
        answers.append(asked(layer[:, :n_patches], batch))
    mean = {}
    for name in answers[0]:
        mean[name] = torch.stack([answer[name] for answer in answers]).mean()
    loss = (
        flow
        + SEEN * (mean["heat"] + mean["goal_heat"])
        + PLACED * (mean["where"] + mean["goal_where"])
        + TURNED * mean["turn"]
    )
    if mean["goal_hit"].isnan():
        # Nothing has a goal.
        mean["goal_where"] = mean["goal_hit"]
    figures = {"flow": float(flow.detach())}
    for name, value in mean.items():
        figures[name] = float(value.detach())
    return loss, figures


def load_films(
    recipe: Recipe, cache: Path = CACHE, demonstrations: Path | None = None
) -> tuple[list[Film], list[Film]]:
    """Films to train on, and films held out.

    They are of a dataset, or of the cache, shot where they are missing there.

    Raises: BadOutput for a dataset that is damaged or of another suite.
    """
    if demonstrations is not None:
        shown = about(demonstrations)["suite"]
        if shown != recipe.suite:
            raise BadOutput(
                f"train policy: {demonstrations} shows {shown}, not {recipe.suite}; "
                "name its suite, or another dataset."
            )
        kept = read(demonstrations, lambda stage: not _is_held_out(stage))
        return kept, read(demonstrations, _is_held_out)
    shoot_stages(recipe.suite, recipe.stages, cache, seed=recipe.seed)
    films: list[Film] = []
    held_out: list[Film] = []
    for stage in range(recipe.stages):
        part = held_out if _is_held_out(stage) else films
        part += cached(cache, recipe.suite, recipe.seed, stage)
    return films, held_out


def train(
    recipe: Recipe,
    out: Path,
    *,
    vlm: Path | None = None,
    start: Path | None = None,
    demonstrations: Path | None = None,
    minutes: float | None = None,
    cache: Path = CACHE,
    every: int = 250,
) -> dict[str, Any]:
    """Train, or go on where an earlier call stopped, and write a checkpoint that lerobot loads.

    Returns what was measured on the films held out. The policy goes on from the mini-pi0 in
    `start`, or grows from the mini-PaliGemma in `vlm`, or, both None, begins with nothing.
    `demonstrations` is a dataset of train demonstrations; None: the cache.

    Raises: BadOutput when `out` holds another training; BadPolicy when `start` is no mini-pi0.
    """
    films, held_out = load_films(recipe, cache, demonstrations)
    if not films:
        raise BadOutput(
            f"train policy: {demonstrations or recipe.suite} holds no film to learn from; "
            "make more stages."
        )
    _require_generic([*films, *held_out])
    stats = statistics(films)
    config = configuration(recipe, films[0].state.shape[1], films[0].action.shape[1])
    # Of initial weights only; every other draw comes from the step's stream.
    torch.manual_seed(recipe.seed)
    learner = Learner(config)
    made_of = {"recipe": vars(recipe), "data_sha256": data_sha256([*films, *held_out])}
    made_of |= _initialise(learner.policy, config, vlm, start)
    frames = Frames(suite=recipe.suite, films=films, stats=stats, config=config, focus=recipe.focus)

    def step(model: Learner, at: int) -> tuple[Tensor, Figures]:
        batch = frames.draw(recipe.batch, np.random.default_rng([73, recipe.seed, at]))
        generator = torch.Generator().manual_seed(recipe.seed * 1_000_003 + at)
        with fused_attention():
            return losses(
                policy=model.policy,
                asked=model.asked,
                batch=batch,
                draws=recipe.draws,
                generator=generator,
            )

    run = Schedule(
        name=recipe.suite,
        steps=recipe.steps,
        rate=recipe.rate,
        minutes=minutes,
        every=every,
        made_of=made_of,
    )
    mean, log = train_steps(learner, step, run, out)
    return save(learner=mean, stats=stats, held=held_out, made_of={**made_of, "log": log}, out=out)


def go_on(start: Path, policy: MiniPI0Policy) -> None:
    """Give a policy what fits of another's weights: all of them for the same suite.

    Other states and actions stay as they are.

    Raises: BadPolicy when `start` is no mini-pi0 with the same words.
    """
    trained: Any = load_policy(start).policy
    if trained.config.type != policy.config.type or trained.config.words != policy.config.words:
        raise BadPolicy(
            f"train policy: {start} is no mini-pi0 with the same words; "
            "start from one that train policy wrote, or leave --start out."
        )
    weights = trained.state_dict()
    chosen = {}
    for name, weight in policy.state_dict().items():
        fits = weights[name].shape == weight.shape
        chosen[name] = weights[name] if fits else weight
    policy.load_state_dict(chosen)
    policy.config.vlm = trained.config.vlm


def save(
    learner: Learner, stats: Any, held: Sequence[Film], made_of: dict[str, Any], out: Path
) -> dict[str, Any]:
    """Write weights, configuration and processors as lerobot keeps them, and what was measured.

    Returns training.json; its `held_out` are the losses on the films `held`.
    """
    from lerobot.policies import make_pre_post_processors

    policy = learner.policy
    recipe = Recipe(**made_of["recipe"])
    policy.save_pretrained(out)
    store_in_bfloat16(out / "model.safetensors")
    # What is measured is what was saved.
    policy.load_state_dict(load_file(out / "model.safetensors"))
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
        pipeline.save_pretrained(out)
    measured = []
    if held:
        frames = Frames(
            suite=recipe.suite,
            films=held,
            stats=stats,
            config=policy.config,
            focus=recipe.focus,
        )
        with torch.no_grad():
            for i in range(8):
                batch = frames.draw(recipe.batch, np.random.default_rng([74, i]))
                generator = torch.Generator().manual_seed(i)
                _, figures = losses(
                    policy=policy, asked=learner.asked, batch=batch, draws=4, generator=generator
                )
                measured.append(figures)
    card = {
        **made_of,
        "trained_steps": made_of["log"][-1]["step"],
        "written_by": code_version(),
        "held_out": average_of(measured),
    }
    write_atomic(out / "training.json", json.dumps(card, indent=1).encode())
    return card


def _initialise(
    policy: MiniPI0Policy, config: MiniPI0Config, vlm: Path | None, start: Path | None
) -> dict[str, Any]:
    """Give a new policy the weights that it begins with; returns where they come from."""
    origin: dict[str, Any] = {}
    if start is not None:
        go_on(start, policy)
        origin["start"] = {"sha256": fingerprint(start), **_read_card(start)}
    elif vlm is not None:
        teacher = load_vlm(vlm)
        config.vlm = teacher.sha256()
        initialise_policy(teacher, policy)
    origin["vlm"] = config.vlm
    return origin


def _look(policy: MiniPI0Policy, batch: Batch) -> tuple[list[Tensor], Tensor, Any]:
    """Hidden states of the asked layers, where the prefix is padded, and its keys and values."""
    from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

    model = policy.model
    views = {}
    for i, name in enumerate(policy.config.image_features):
        views[name] = batch.images[:, i]
    images, there = policy._preprocess_images(views)
    prefix, pad, attend = model.embed_prefix(images, there, batch.tokens, batch.there)
    decoder = model.paligemma_with_expert.paligemma.model.language_model
    decoder.config._attn_implementation = "eager"
    n_layers = len(decoder.layers)
    hidden: list[Tensor] = []

    def keep_output(module: nn.Module, args: Any, out: Any) -> None:
        hidden.append(out[0] if isinstance(out, tuple) else out)

    hooks = []
    for layer in decoder.layers[max(0, n_layers // 2 - 1) : max(1, n_layers - 1)]:
        hooks.append(layer.register_forward_hook(keep_output))
    try:
        attention = prepare_attention_masks_4d(make_att_2d_masks(pad, attend))
        _, cache = model.paligemma_with_expert.forward(
            attention_mask=attention,
            position_ids=torch.cumsum(pad, dim=1) - 1,
            past_key_values=None,
            inputs_embeds=[prefix, None],
            use_cache=True,
        )
    finally:
        for hook in hooks:
            hook.remove()
    return hidden, pad, cache


def _flow_loss(
    policy: MiniPI0Policy,
    batch: Batch,
    pad: Tensor,
    cache: Any,
    draws: int,
    generator: torch.Generator,
) -> Tensor:
    """The mean error of the flow over `draws` noises and times."""
    flow = torch.zeros(())
    for _ in range(draws):
        noise = torch.randn(batch.actions.shape, generator=generator)
        times = _times(len(noise), policy.config, generator)
        share = times[:, None, None]
        noisy = share * noise + (1 - share) * batch.actions
        velocity = policy.model.denoise_step(batch.state, pad, cache, noisy, times)
        flow = flow + F.mse_loss(velocity, noise - batch.actions) / draws
    return flow


def _times(n: int, config: MiniPI0Config, generator: torch.Generator) -> Float[Tensor, " n"]:
    """pi0's times: a Beta(1.5, 1) of lerobot's scale and offset, by inversion."""
    drawn = torch.rand(n, generator=generator) ** (1 / config.time_sampling_beta_alpha)
    return drawn * config.time_sampling_scale + config.time_sampling_offset


def _is_held_out(stage: int) -> bool:
    return stage % HELD_OUT == HELD_OUT - 1


def _require_generic(films: Sequence[Film]) -> None:
    """Raises: ValueError when a film shows an evaluation object other than its goal."""
    models = []
    for film in films:
        for i, name in enumerate(film.names):
            if i != film.goal:
                models.append(get_object(name))
    only_generic(models)


def _read_card(checkpoint: Path) -> dict[str, Any]:
    """How a checkpoint was made, as its training.json says; the measurements left out.

    Raises: BadPolicy when the file is damaged.
    """
    file = checkpoint / "training.json"
    if not file.is_file():
        return {}
    try:
        card = dict(json.loads(file.read_text()).items())
    except (ValueError, AttributeError) as error:
        raise BadPolicy(
            f"train policy: {file} is damaged ({type(error).__name__}); "
            "restore it, or remove it and its card stays empty."
        ) from error
    card.pop("log", None)
    card.pop("held_out", None)
    return card
