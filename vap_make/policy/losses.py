"""What a mini-pi0 is trained by (P 5.1).

Flow matching as in pi0, and, while training only, questions about what is meant. The middle of the
decoder is asked, besides, which image patches show the object that is meant, where it stands, and,
under end-effector control, how the hand will close on it; the first two of what it goes to, too, if
anything. So is every later layer but the last, which in pi0 gives its keys and values alone. What
the middle knows, the action expert has half its layers left to act upon. The answers' heads are not
part of the policy.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.policies.mini_pi0.configuration_mini_pi0 import MiniPI0Config
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.policies.mini_pi0.modeling_mini_pi0 import MiniPI0Policy
from vap_core.policies.mini_pi0.vlm import MiniVlm
from vap_make.patches import PatchScores, patch_loss
from vap_make.policy.batches import Batch

CLOSE_M = 0.005
"""Error of a place up to which it is squared."""
SEEN = 0.5
"""Weight, beside the flow, of the question which patches show an object."""
PLACED = 1.0
"""Weight of the question where it stands."""
TURNED = 1.0
"""Weight of the question how the hand will close on it."""


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
            answers["turn"] = hidden.new_zeros(())
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
            heat = hidden.new_zeros(())
            where = hidden.new_zeros(())
            hit = hidden.new_tensor(torch.nan)
        return {"heat": heat, "where": where, "hit": hit}, seen


class Learner(nn.Module):
    """What is trained: the policy, and the questions beside it.

    The embeddings of words are not: a word means the same to a policy that begins with a
    mini-PaliGemma and to that model, in which a soft prompt learns its word. Trainings of before
    the recipe moved them (docs/policies.md); what goes on from such a policy keeps them.
    """

    def __init__(self, config: MiniPI0Config) -> None:
        super().__init__()
        self.policy = MiniPI0Policy(config)
        embeddings(self.policy).requires_grad_(False)
        self.asked = Questions(config.width)


def embeddings(policy: MiniPI0Policy) -> Tensor:
    """The policy's table of words' embeddings (w x d)."""
    decoder: Any = policy.model.paligemma_with_expert.paligemma.model.language_model
    return decoder.embed_tokens.weight


def embedding_cosine(policy: MiniPI0Policy, vlm: MiniVlm | None) -> dict[str, float]:
    """How alike the embeddings of words are in the policy and in the model that it grew from.

    The mean and the least cosine over words; nothing without a model.
    """
    if vlm is None:
        return {}
    table: Any = vlm.towers.paligemma.model.language_model
    cosine = F.cosine_similarity(embeddings(policy), table.embed_tokens.weight, dim=1)
    # The word that pads has no direction.
    cosine = cosine[1:]
    return {"mean": float(cosine.mean()), "least": float(cosine.min())}


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


def _look(policy: MiniPI0Policy, batch: Batch) -> tuple[list[Tensor], Tensor, Any]:
    """Hidden states of the asked layers, where the prefix is padded, and its keys and values."""
    from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

    model = policy.model
    views = {}
    for i, name in enumerate(policy.config.image_features):
        views[name] = batch.images[:, i].float() / 255
    images, there = policy._preprocess_images(views)
    decoder = model.paligemma_with_expert.paligemma.model.language_model
    with _speaking_learned_words(policy, batch):
        prefix, pad, attend = model.embed_prefix(images, there, batch.tokens, batch.there)
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


@contextmanager
def _speaking_learned_words(policy: MiniPI0Policy, batch: Batch) -> Iterator[None]:
    """Inside, the learned word of every command has the embedding of that command."""
    word = policy.config.words.index(WORD)

    def replace_embeddings(module: nn.Module, args: Any, out: Tensor) -> Tensor:
        return torch.where((args[0] == word)[..., None], batch.learned[:, None], out)

    decoder: Any = policy.model.paligemma_with_expert.paligemma.model.language_model
    hook = decoder.embed_tokens.register_forward_hook(replace_embeddings)
    try:
        yield
    finally:
        hook.remove()


def _flow_loss(
    policy: MiniPI0Policy,
    batch: Batch,
    pad: Tensor,
    cache: Any,
    draws: int,
    generator: torch.Generator,
) -> Tensor:
    """The mean error of the flow over `draws` noises and times, all of them in one pass."""
    noises = []
    times = []
    for _ in range(draws):
        noises.append(torch.randn(batch.actions.shape, generator=generator))
        times.append(_times(len(batch.actions), policy.config, generator))
    # Drawn on the CPU: the same noise on every device. The draws of a row follow each other.
    device = batch.actions.device
    noise = torch.stack(noises, 1).flatten(0, 1).to(device)
    time = torch.stack(times, 1).flatten(0, 1).to(device)
    cache.batch_repeat_interleave(draws)
    state, seen, actions = (
        part.repeat_interleave(draws, 0) for part in (batch.state, pad, batch.actions)
    )
    share = time[:, None, None]
    noisy = share * noise + (1 - share) * actions
    velocity = policy.model.denoise_step(state, seen, cache, noisy, time)
    return F.mse_loss(velocity, noise - actions)


def _times(n: int, config: MiniPI0Config, generator: torch.Generator) -> Float[Tensor, " n"]:
    """pi0's times: a Beta(1.5, 1) of lerobot's scale and offset, by inversion."""
    drawn = torch.rand(n, generator=generator) ** (1 / config.time_sampling_beta_alpha)
    return drawn * config.time_sampling_scale + config.time_sampling_offset
