"""Train a mini-pi0 on filmed demonstrations (P 5.1): flow matching as in pi0, and, while training only, questions about what is meant.

    python -m vap_core train policy --suite simpler-bridge --stages 400

The middle of the decoder is asked, besides, which image patches show the object that is meant, where it stands, and, under end-effector control, how
the hand will close on it; the first two of what it goes to, too, if anything. So is every later layer but the last, which in pi0 gives its keys and
values alone. What the middle knows, the action expert has half its layers left to act upon. The answers' heads are not part of the policy.
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
from vap_core.base.files import DATA
from vap_core.base.version import code_version
from vap_core.policies.lerobot.adapter import load as load_policy
from vap_core.policies.lerobot.checkpoints import fingerprint
from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy, fused
from vap_core.policies.mini_pi0.vlm import grow, halve
from vap_core.policies.mini_pi0.vlm import load as load_vlm
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.suites import suite
from vap_core.training.films.dataset import about, data_sha256, read
from vap_core.training.films.dataset import film as shoot
from vap_core.training.films.demonstrations import SIDE, Film, cached
from vap_core.training.films.scenes import only_generic
from vap_core.training.looking import Shown, Sizes, looking
from vap_core.training.policy.batches import Batch, Frames, statistics
from vap_core.training.step import Descent, Told, average_of, descend

CACHE = DATA / "cache" / "demonstrations"
CHUNKS = {
    "simpler-fractal": (4, 2),
    "simpler-bridge": (4, 4),
    "vlabench": (4, 4),
    "tabletop": (32, 10),
}
"""Actions in one chunk, and how many of them are carried out before the policy is asked again."""
HELD_OUT = 19
"""Every so many stages one is kept from training, to see what was learned: a prime, as tasks take turns."""
CLOSE_M = 0.005
"""Error of a place up to which it is squared."""
SEEN, PLACED, TURNED = 0.5, 1.0, 1.0
"""Weights of the questions beside the flow."""
TEMPERATURE = 0.0
"""Of the trained policy's sampling noise: without any, three in five generic objects are grasped where with all of it two in five are."""


@dataclass(frozen=True)
class Recipe(Sizes):
    """How long, how fast, how large. `draws` flow samples share one look at the pictures; frames close to the start, a grasp,
    a release or the end come `focus` times as often as others."""

    suite: str
    stages: int = 400
    steps: int = 12_000
    batch: int = 64
    draws: int = 4
    rate: float = 1e-3
    seed: int = 0
    focus: float = 3.0


class Place(Shown):
    """Which patches show an object, and where it stands: asked of hidden states, in training only."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.place = nn.Linear(width, 3)

    def forward(
        self, hidden: Float[Tensor, "b p d"]
    ) -> tuple[Float[Tensor, "b p"], Float[Tensor, "b 3"], Float[Tensor, "b d"]]:
        """Scores of patches, the place in decimetres, and what was seen where it was looked."""
        x = self.norm(hidden)
        chance = self.patch(x).squeeze(-1)
        seen = torch.einsum("bp,bpd->bd", chance.softmax(-1), x)
        return chance, self.place(seen), seen


class Questions(nn.Module):
    """About the object that is meant, how a hand will close on it, and about its goal."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.target, self.goal, self.turn = Place(width), Place(width), nn.Linear(width, 2)

    def forward(self, hidden: Float[Tensor, "b p d"], batch: Batch) -> dict[str, Tensor]:
        """What looking, placing and turning cost, and the share of looks that hit; 0, and that share nan, where nothing is asked."""
        told, seen = self._place(self.target, hidden, batch, 0)
        goal, _ = self._place(self.goal, hidden, batch, 1)
        closes = ~batch.turn[:, 0].isnan()
        told["turn"] = (
            F.smooth_l1_loss(self.turn(seen[closes]), batch.turn[closes])
            if closes.any()
            else torch.zeros(())
        )
        return told | {f"goal_{name}": part for name, part in goal.items()}

    @staticmethod
    def _place(
        ask: Place, hidden: Tensor, batch: Batch, i: int
    ) -> tuple[dict[str, Tensor], Tensor]:
        there = ~batch.place[:, i, 0].isnan()
        chance, guess, seen = ask(hidden)
        if not there.any():
            return {
                "heat": torch.zeros(()),
                "where": torch.zeros(()),
                "hit": torch.tensor(torch.nan),
            }, seen
        heat, hit = looking(chance[there], batch.patches[there, i])
        where = F.smooth_l1_loss(guess[there] * 0.1, batch.place[there, i], beta=CLOSE_M) / 0.02
        return {"heat": heat, "where": where, "hit": hit}, seen


def configuration(recipe: Recipe, state_size: int, action_size: int) -> MiniPI0Config:
    from lerobot.configs import FeatureType, PolicyFeature

    chunk, execute = CHUNKS[recipe.suite]
    views = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
        for name in suite(recipe.suite).cameras
    }
    return MiniPI0Config(
        **recipe.configuration(), chunk_size=chunk, n_action_steps=execute, max_state_dim=state_size, max_action_dim=action_size,
        temperature=TEMPERATURE,
        input_features={**views, "observation.state": PolicyFeature(FeatureType.STATE, (state_size,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action_size,))},
    )  # fmt: skip


def losses(
    policy: MiniPI0Policy, asked: Questions, batch: Batch, draws: int, generator: torch.Generator
) -> tuple[Tensor, dict[str, float]]:
    """Flow matching, `draws` times over one look; and what hidden states know about the object that is meant, in the mean over layers."""
    from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

    model, cameras = policy.model, list(policy.config.image_features)
    images, there = policy._preprocess_images(
        {name: batch.images[:, i] for i, name in enumerate(cameras)}
    )
    prefix, pad, attend = model.embed_prefix(images, there, batch.tokens, batch.there)
    seen: list[Tensor] = []
    decoder = model.paligemma_with_expert.paligemma.model.language_model
    decoder.config._attn_implementation = "eager"
    middle = decoder.layers[max(0, len(decoder.layers) // 2 - 1) : max(1, len(decoder.layers) - 1)]
    hooks = [
        layer.register_forward_hook(
            lambda module, args, out: seen.append(out[0] if isinstance(out, tuple) else out)
        )
        for layer in middle
    ]
    try:
        _, cache = model.paligemma_with_expert.forward(
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(pad, attend)), position_ids=torch.cumsum(pad, dim=1) - 1,
            past_key_values=None, inputs_embeds=[prefix, None], use_cache=True,
        )  # fmt: skip
    finally:
        for hook in hooks:
            hook.remove()
    flow = torch.zeros(())
    for _ in range(draws):
        noise = torch.randn(batch.actions.shape, generator=generator)
        at = _times(len(noise), policy.config, generator)
        noisy = at[:, None, None] * noise + (1 - at[:, None, None]) * batch.actions
        flow = (
            flow
            + F.mse_loss(
                model.denoise_step(batch.state, pad, cache, noisy, at), noise - batch.actions
            )
            / draws
        )
    found = [asked(hidden[:, : batch.patches.shape[2]], batch) for hidden in seen]
    mean = {name: torch.stack([one[name] for one in found]).mean() for name in found[0]}
    loss = (
        flow
        + SEEN * (mean["heat"] + mean["goal_heat"])
        + PLACED * (mean["where"] + mean["goal_where"])
        + TURNED * mean["turn"]
    )
    if mean["goal_hit"].isnan():  # nothing has a goal
        mean["goal_where"] = mean["goal_hit"]
    return loss, {"flow": float(flow.detach())} | {
        name: float(part.detach()) for name, part in mean.items()
    }


def _times(n: int, config: MiniPI0Config, generator: torch.Generator) -> Float[Tensor, " n"]:
    """pi0's times: a Beta(1.5, 1) of lerobot's scale and offset, by inversion."""
    drawn = torch.rand(n, generator=generator) ** (1 / config.time_sampling_beta_alpha)
    return drawn * config.time_sampling_scale + config.time_sampling_offset


def load_films(
    recipe: Recipe, cache: Path = CACHE, demonstrations: Path | None = None
) -> tuple[list[Film], list[Film]]:
    """Films to train on and to look at: of a dataset, or of the cache, shot where they are missing there."""
    both: tuple[list[Film], list[Film]] = ([], [])
    if demonstrations is not None:
        if (shown := about(demonstrations)["suite"]) != recipe.suite:
            raise BadOutput(
                f"train policy: {demonstrations} shows {shown}, not {recipe.suite}; name its suite, or another dataset."
            )
        return read(demonstrations, lambda n: not _held_out(n)), read(demonstrations, _held_out)
    shoot(recipe.suite, recipe.stages, cache, seed=recipe.seed)
    for n in range(recipe.stages):
        both[_held_out(n)].extend(cached(cache, recipe.suite, recipe.seed, n))
    return both


def _held_out(stage: int) -> bool:
    return stage % HELD_OUT == HELD_OUT - 1


class Learner(nn.Module):
    """What is trained: the policy, and the questions beside it."""

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.policy, self.asked = MiniPI0Policy(config), Questions(config.width)


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
    """Train, or go on where an earlier call stopped, and write a checkpoint that lerobot loads; returns what was measured on the films held out.

    The policy goes on from the mini-pi0 in `start`, or grows from the mini-PaliGemma in `vlm`, or, both None, begins with nothing. `demonstrations`
    is a dataset of train demonstrations; None: the cache. Raises: BadOutput when `out` holds another training; BadPolicy when `start` is no mini-pi0.
    """
    films, held = load_films(recipe, cache, demonstrations)
    if not films:
        raise BadOutput(
            f"train policy: {demonstrations or recipe.suite} holds no film to learn from; make more stages."
        )
    only_generic(
        [
            get_object(name)
            for film in (*films, *held)
            for i, name in enumerate(film.names)
            if i != film.goal
        ]
    )
    stats = statistics(films)
    config = configuration(recipe, films[0].state.shape[1], films[0].action.shape[1])
    torch.manual_seed(
        recipe.seed
    )  # initial weights only; every other draw comes from the step's stream
    learner = Learner(config)
    made_of = {"recipe": vars(recipe), "data_sha256": data_sha256([*films, *held])}
    if start is not None:
        go_on(start, learner.policy)
        made_of["start"] = {"sha256": fingerprint(start), **_card(start)}
    elif vlm is not None:
        teacher = load_vlm(vlm)
        config.vlm = teacher.sha256()
        grow(teacher, learner.policy)
    made_of["vlm"] = config.vlm
    frames = Frames(recipe.suite, films, stats, config, recipe.focus)

    def step(model: Learner, at: int) -> tuple[Tensor, Told]:
        batch = frames.draw(recipe.batch, np.random.default_rng([73, recipe.seed, at]))
        with fused():
            return losses(
                model.policy,
                model.asked,
                batch,
                recipe.draws,
                torch.Generator().manual_seed(recipe.seed * 1_000_003 + at),
            )

    mean, log = descend(
        learner,
        step,
        Descent(recipe.suite, recipe.steps, recipe.rate, minutes, every, made_of),
        out,
    )
    return save(mean, stats, held, {**made_of, "log": log}, out)


def go_on(start: Path, policy: MiniPI0Policy) -> None:
    """Give a policy what fits of another's weights: all of them for the same suite; other states and actions stay as they are. Raises: BadPolicy."""
    held: Any = load_policy(start).policy
    if held.config.type != policy.config.type or held.config.words != policy.config.words:
        raise BadPolicy(
            f"train policy: {start} is no mini-pi0 with the same words; start from one that train policy wrote, or leave --start out."
        )
    theirs = held.state_dict()
    policy.load_state_dict(
        {
            name: theirs[name] if theirs[name].shape == mine.shape else mine
            for name, mine in policy.state_dict().items()
        }
    )
    policy.config.vlm = held.config.vlm


def _card(checkpoint: Path) -> dict[str, Any]:
    """How a checkpoint was made, as its training.json tells; the measurements left out. Raises: BadPolicy."""
    file = checkpoint / "training.json"
    try:
        return (
            {
                name: part
                for name, part in json.loads(file.read_text()).items()
                if name not in ("log", "held_out")
            }
            if file.is_file()
            else {}
        )
    except (ValueError, AttributeError) as error:
        raise BadPolicy(
            f"train policy: {file} is damaged ({type(error).__name__}); restore it, or remove it and its card stays empty."
        ) from error


def save(
    learner: Learner, stats: Any, held: Sequence[Film], made_of: dict[str, Any], out: Path
) -> dict[str, Any]:
    """Weights, configuration and processors as lerobot keeps them, and what was measured."""
    from lerobot.policies import make_pre_post_processors

    policy, recipe = learner.policy, Recipe(**made_of["recipe"])
    policy.save_pretrained(out)
    halve(out / "model.safetensors")
    policy.load_state_dict(
        load_file(out / "model.safetensors")
    )  # what is measured is what was saved
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats):
        pipeline.save_pretrained(out)
    told = []
    if held:
        frames = Frames(recipe.suite, held, stats, policy.config, recipe.focus)
        with torch.no_grad():
            for i in range(8):
                batch = frames.draw(recipe.batch, np.random.default_rng([74, i]))
                told.append(
                    losses(policy, learner.asked, batch, 4, torch.Generator().manual_seed(i))[1]
                )
    card = {
        **made_of,
        "trained_steps": made_of["log"][-1]["step"],
        "written_by": code_version(),
        "held_out": average_of(told),
    }
    (out / "training.json").write_text(json.dumps(card, indent=1))
    return card
