"""Where the phrases of an instruction stand among its tokens."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Bool, Float

from vap_core.base.types import value
from vap_core.policies.protocol import ACTION, Phrases, report_attention

Positions = dict[str, list[int]]
"""The places of every query's tokens, by query."""


def positions(preprocessor: Any, tokens: torch.Tensor, phrases: Phrases) -> Positions:
    """The places of every query's phrases in one row of tokens; a query that is not there is out.

    `preprocessor` is the policy's, which has the tokenizer.
    """
    row = tokens.tolist()
    found: Positions = {}
    for query, alternatives in phrases.items():
        places = {
            start + i
            for phrase in alternatives
            for spelled in _spellings(preprocessor, phrase)
            for start in range(len(row) - len(spelled) + 1)
            if row[start : start + len(spelled)] == spelled
            for i in range(len(spelled))
        }
        if places:
            found[query] = sorted(places)
    return found


def _spellings(preprocessor: Any, phrase: str) -> list[list[int]]:
    """The tokens of a phrase, at the beginning of a text and after a blank.

    A phrase that the vocabulary lacks has none.
    """
    from vap_core.policies.mini_pi0.processor_mini_pi0 import SPLIT, UNKNOWN, Words  # lerobot's

    for step in preprocessor.steps:
        if isinstance(step, Words):
            known = step._vocabulary
            spelled = [known.get(word, known[UNKNOWN]) for word in SPLIT.findall(phrase.lower())]
            return [] if known[UNKNOWN] in spelled else [spelled]
        tokenizer = getattr(step, "input_tokenizer", None)
        if tokenizer is not None:
            spellings = []
            for text in (phrase, f" {phrase}"):
                spelled = list(tokenizer.encode(text, add_special_tokens=False))
                known_all = tokenizer.unk_token_id not in spelled
                if spelled and known_all and spelled not in spellings:
                    spellings.append(spelled)
            return spellings
    return []


def word_width(policy: Any) -> int:
    """How many numbers the embedding of a word of a pi0 has."""
    return int(_words(policy).weight.shape[1])


@contextmanager
def overriding_tokens(policy: Any, learned: Mapping[int, torch.Tensor]) -> Iterator[None]:
    """Inside, the embeddings of learned words are the learned ones, by their tokens."""
    if not learned:
        yield
        return

    def replace_embeddings(module: Any, args: Any, embeddings: torch.Tensor) -> torch.Tensor:
        for token, embedding in learned.items():
            is_token = (args[0] == token)[..., None]
            embeddings = torch.where(is_token, embedding.to(embeddings), embeddings)
        return embeddings

    hook = _words(policy).register_forward_hook(replace_embeddings)
    try:
        yield
    finally:
        hook.remove()


def _words(policy: Any) -> torch.nn.Embedding:
    """The table of words of a pi0."""
    return policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens


Weights = Float[torch.Tensor, "b heads queries keys"]
Take = Callable[[int, Weights], None]
MARKS = 3
"""Tokens that SmolVLA sets around the patches of a view, two before and one behind, if it does."""


@value
class Layout:
    """Where a policy's prefix holds its views and its text.

    `starts` is the first patch of every camera, `side` the number of patches along both edges,
    `text` the first token of the text, `chunk` the number of the expert's action tokens.
    """

    cameras: tuple[str, ...]
    starts: tuple[int, ...]
    side: int
    text: int
    chunk: int


def can_watch(policy: Any, pictures: Sequence[torch.Tensor]) -> bool:
    """Whether the attention can be read: a pi0 or SmolVLA that does not pad these pictures.

    It pads those that are given, whatever sizes it declares.
    """
    model = getattr(policy, "model", None)
    if hasattr(model, "paligemma_with_expert"):
        target = policy.config.image_resolution
    elif hasattr(model, "vlm_with_expert"):
        target = policy.config.resize_imgs_with_padding
    else:
        return False
    shapes = [tuple(picture.shape[-2:]) for picture in pictures]
    if target is None:  # as they are
        return all(height == width == shapes[0][0] for height, width in shapes)
    return target[0] == target[1] and all(height == width for height, width in shapes)


@contextmanager
def reporting_attention(
    policy: Any, cameras: Sequence[str], side_px: int, positions: Sequence[Positions]
) -> Iterator[None]:
    """Inside, a policy that `can_watch` reports its attention to the image patches of its cameras.

    `side_px` is that of the pictures which it is given, `positions` are those of the queries that
    are words, by episode.
    """
    watch = Watch(layout(policy, cameras, side_px), positions)
    with _watching_smolvla(policy, watch) if _is_smolvla(policy) else _watching_pi0(policy, watch):
        yield
    watch.report()


def layout(policy: Any, cameras: Sequence[str], side_px: int) -> Layout:
    """Where a policy that `can_watch` holds the views of these cameras.

    The views come first, behind them empty cameras, then the text. SmolVLA sets marks around every
    view where its configuration asks for them.
    """
    config = policy.config
    marks = 0
    if _is_smolvla(policy):
        vlm = policy.model.vlm_with_expert.config
        pixels, _ = config.resize_imgs_with_padding or (side_px, side_px)
        side = pixels // vlm.vision_config.patch_size // vlm.scale_factor
        marks = MARKS if config.add_image_special_tokens else 0
    else:
        vision = policy.model.paligemma_with_expert.paligemma.config.vision_config
        side = config.image_resolution[0] // vision.patch_size
    width = side**2 + marks
    starts = tuple(i * width + max(marks - 1, 0) for i in range(len(cameras)))
    text = len(config.image_features) * width
    return Layout(tuple(cameras), starts, side, text, config.chunk_size)


def _is_smolvla(policy: Any) -> bool:
    return hasattr(policy.model, "vlm_with_expert")


class Watch:
    """Collects attention to the patches, layer by layer, during one call."""

    def __init__(self, layout: Layout, positions: Sequence[Positions]) -> None:
        self.layout = layout
        self.positions = positions
        patches = [start + torch.arange(layout.side**2) for start in layout.starts]
        self._patches = torch.cat(patches)
        self._words: dict[tuple[int, str], dict[int, torch.Tensor]] = {}
        self._actions: dict[int, list[torch.Tensor]] = {}

    def words(self, layer: int, weights: Weights) -> None:
        """Take what the prefix attends to in a layer of the vision-language model."""
        for episode, positions in enumerate(self.positions):
            for query, places in positions.items():
                rows = self.layout.text + torch.tensor(places)
                attended = weights[episode][:, rows].mean(1)[:, self._patches]
                self._words.setdefault((episode, query), {})[layer] = attended

    def actions(self, layer: int, weights: Weights) -> None:
        """Take what the action tokens attend to in a layer of the expert."""
        attended = weights[:, :, -self.layout.chunk :].mean(2)[..., self._patches]
        self._actions.setdefault(layer, []).append(attended)

    def report(self) -> None:
        """Report the maps of every episode and camera."""
        of_actions = [torch.stack(self._actions[layer]).mean(0) for layer in sorted(self._actions)]
        for episode, positions in enumerate(self.positions):
            queries = {}
            for query in positions:
                layers = self._words[episode, query]
                queries[query] = torch.stack([layers[layer] for layer in sorted(layers)])
            queries[ACTION] = torch.stack(of_actions)[:, episode]
            cameras, side = self.layout.cameras, self.layout.side
            maps = {
                query: attended.unflatten(2, (len(cameras), side, side)).float().cpu().numpy()
                for query, attended in queries.items()
            }
            for i, camera in enumerate(cameras):
                of_camera = {query: np.ascontiguousarray(m[:, :, i]) for query, m in maps.items()}
                report_attention(episode, camera, of_camera)


@contextmanager
def _watching_pi0(policy: Any, watch: Watch) -> Iterator[None]:
    """Inside, every layer's self-attention, which PI0 computes eagerly, is taken."""
    towers = policy.model.paligemma_with_expert
    decoders = towers.paligemma.model.language_model, towers.gemma_expert.model
    with ExitStack() as hooks:
        for take, decoder in zip((watch.words, watch.actions), decoders, strict=True):
            for i, layer in enumerate(decoder.layers):

                def hook(_: Any, __: Any, output: Any, take: Take = take, i: int = i) -> None:
                    take(i, output[1])

                hooks.callback(layer.self_attn.register_forward_hook(hook).remove)
        yield


@contextmanager
def _watching_smolvla(policy: Any, watch: Watch) -> Iterator[None]:
    """Inside, every attention is taken.

    SmolVLA calls no attention module: the projection of the queries tells which layer is running,
    and the weights are computed a second time beside its own function.
    """
    towers = policy.model.vlm_with_expert
    decoders = towers.get_vlm_model().text_model, towers.lm_expert
    running: list[tuple[Take, int]] = []
    attend = towers.eager_attention_forward

    def observed(mask: Any, batch: int, head_dim: int, query: Any, key: Any, values: Any) -> Any:
        take, layer = running[0]
        take(layer, _weights(mask, query, key))
        return attend(mask, batch, head_dim, query, key, values)

    with ExitStack() as hooks:
        for take, decoder in zip((watch.words, watch.actions), decoders, strict=True):
            for i, layer in enumerate(decoder.layers):

                def hook(_: Any, __: Any, output: Any, now: tuple[Take, int] = (take, i)) -> None:
                    running[:] = [now]

                hooks.callback(layer.self_attn.q_proj.register_forward_hook(hook).remove)
        hooks.enter_context(patch.object(towers, "eager_attention_forward", observed))
        yield


def _weights(
    mask: Bool[torch.Tensor, "b queries keys"],
    query: Float[torch.Tensor, "b queries heads d"],
    key: Float[torch.Tensor, "b keys groups d"],
) -> Weights:
    """The weights that SmolVLA's attention gives its values."""
    n_heads = query.shape[2] // key.shape[2]
    keys = key.float().repeat_interleave(n_heads, dim=2).transpose(1, 2)
    scores = query.float().transpose(1, 2) @ keys.transpose(2, 3) * query.shape[-1] ** -0.5
    return torch.where(mask[:, None], scores, torch.finfo(scores.dtype).min).softmax(-1)
