"""The soft prompt: one new word for a personal object, learned in a frozen vision-language model by yes/no questions (SPEC section 4, P appendix).

    token = learn(vlm, "red-mug", photos, unseen)     # "can you recognize <my_0> in this image": only <my_0>'s embedding is trained
    token.accuracy                                                  # on photos that it never saw

Photos of the actual distractors are its hard negatives, in the baseline's favour. The word is then spoken to the policy that grew from the model.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from vap_core.base.errors import BadMemory
from vap_core.base.files import write_atomic
from vap_core.base.types import Rgb, value

if TYPE_CHECKING:
    import torch

    from vap_core.policies.mini_pi0.vlm import MiniVlm

WORD, QUESTION = "<my_0>", "can you recognize <my_0> in this image"
SUFFIX = ".token.safetensors"


@value
class Token:
    """A learned word: its embedding in the model's space, and its share of right answers on held-out photos, positives and negatives alike weighty.

    `model` is the SHA-256 of the model that it was learned in: it means nothing in another.
    """

    object: str
    embedding: Float32[np.ndarray, " d"]
    accuracy: float
    model: str


@value
class Photos:
    """Pictures of the object, of its look-alikes (hard negatives), and of other objects (easy ones)."""

    own: tuple[Rgb, ...]
    rivals: tuple[Rgb, ...]
    others: tuple[Rgb, ...]


@dataclass(frozen=True)
class Lesson:
    """How a token is learned: so many passes over the photos, each photo in `looks` framings."""

    epochs: int = 20
    rate: float = 0.02
    batch: int = 32
    looks: int = 8
    seed: int = 0


def learn(
    vlm: "MiniVlm", name: str, taught: Photos, held: Photos, lesson: Lesson | None = None
) -> Token:
    """Train one embedding on `taught`, as many yes as no, and measure it on `held`. Nothing else changes.

    Raises: BadMemory when a kind of photo is missing.
    """
    import torch
    from torch.nn import functional as F  # noqa: N812

    how = lesson or Lesson()
    rng = np.random.default_rng([77, how.seed, *name.encode()])
    for part in (taught, held):
        if not part.own or not (part.rivals or part.others):
            raise BadMemory(
                f"tokens.learn: {name}: photos of the object and of others are both needed, to learn from and to measure by."
            )
    tokens, there = vlm.ask([QUESTION])
    words = vlm.towers.embed_language_tokens(tokens).detach()[0]
    at = (tokens[0] == vlm.number[WORD])[:, None]
    learned = words[tokens[0] == vlm.number[WORD]][0].clone().requires_grad_(True)
    optimiser = torch.optim.AdamW([learned], how.rate, weight_decay=0.0)
    side, answers = vlm.config.image_resolution[0], [vlm.number["yes"], vlm.number["no"]]

    def patches(photos: Sequence[Rgb]) -> "torch.Tensor":
        with torch.no_grad():
            return torch.cat(
                [vlm.look(_tensor(photos[i : i + 64], side)) for i in range(0, len(photos), 64)]
            )

    def yes(seen: "torch.Tensor") -> "torch.Tensor":
        n = len(seen)
        said, _ = vlm.read(
            seen,
            torch.where(at, learned, words).expand(n, -1, -1),
            there.expand(n, -1),
            torch.zeros((n, 1), dtype=torch.long),
        )
        return said[:, 0, answers[0]] - said[:, 0, answers[1]]

    seen = [
        patches([framed(photo, rng) for photo in part for _ in range(how.looks)])
        for part in (taught.own, taught.rivals, taught.others)
        if part
    ]
    shares = np.array([0.5, 0.35, 0.15])[: len(seen)] if len(seen) == 3 else np.array([0.5, 0.5])
    steps = max(1, sum(len(part) for part in seen) // how.batch)
    for epoch in range(how.epochs):
        for group in optimiser.param_groups:
            group["lr"] = how.rate * 0.5 * (1 + float(np.cos(np.pi * epoch / how.epochs)))
        for _ in range(steps):
            drawn = rng.choice(len(seen), how.batch, p=shares)
            views = torch.stack([seen[kind][rng.integers(len(seen[kind]))] for kind in drawn])
            loss = F.binary_cross_entropy_with_logits(
                yes(views), torch.from_numpy((drawn == 0).astype(np.float32))
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        right = [yes(patches(held.own)) > 0, yes(patches([*held.rivals, *held.others])) <= 0]
    accuracy = float(np.mean([part.float().mean().item() for part in right]))
    return Token(name, learned.detach().numpy().astype(np.float32), accuracy, vlm.sha256())


def framed(photo: Rgb, rng: np.random.Generator) -> Rgb:
    """The photo as another camera might have taken it: nearer or farther, off centre, mirrored never, brighter or darker."""
    import cv2

    size, zoom = photo.shape[0], float(rng.uniform(0.6, 1.3))
    turn = cv2.getRotationMatrix2D((size / 2, size / 2), float(rng.uniform(-12, 12)), zoom)
    turn[:, 2] = turn[:, 2] + rng.uniform(-0.15, 0.15, 2) * size
    moved = cv2.warpAffine(photo, turn, (size, size), borderMode=cv2.BORDER_REPLICATE)
    return np.clip(moved * rng.uniform(0.8, 1.2) * rng.uniform(0.95, 1.05, 3), 0, 255).astype(
        np.uint8
    )


def _tensor(images: Sequence[Rgb], side: int) -> "torch.Tensor":
    import torch

    made = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    return torch.nn.functional.interpolate(made, (side, side), mode="bilinear", antialias=True)


def save(folder: Path, token: Token) -> Path:
    """Write `<object>.token.safetensors`."""
    from safetensors.numpy import save as packed

    about = {"object": token.object, "accuracy": repr(token.accuracy), "model": token.model}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{token.object}{SUFFIX}"
    write_atomic(path, packed({"embedding": token.embedding}, metadata=about))
    return path


def load(folder: Path, name: str, model: str) -> Token:
    """The word of that object. Raises: BadMemory when it is absent, damaged, or was learned in another model."""
    from safetensors import SafetensorError
    from safetensors.numpy import load as unpacked

    path = folder / f"{name}{SUFFIX}"
    try:
        data = path.read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        about = json.loads(data[8 : 8 + length])["__metadata__"]
        token = Token(
            about["object"], unpacked(data)["embedding"], float(about["accuracy"]), about["model"]
        )
    except (OSError, SafetensorError, struct.error, ValueError, KeyError) as error:
        raise BadMemory(
            f"tokens.load: {path} holds no learned word ({type(error).__name__}); learn it again."
        ) from error
    if token.model != model:
        raise BadMemory(
            f"tokens.load: {path} was learned in model {token.model[:8]}, this is {model[:8]}; learn it again."
        )
    return token
