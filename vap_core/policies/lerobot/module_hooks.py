"""A hook on the table of words of a pi0 while it is called, for learned tokens."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch


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

    table = policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens
    hook = table.register_forward_hook(replace_embeddings)
    try:
        yield
    finally:
        hook.remove()
