"""A hook on the table of words of a pi0 while it is called, for learned tokens."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch


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
