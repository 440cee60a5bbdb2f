"""The soft prompt: a new word for a personal object, learned in a frozen vision-language model.

It is learned by yes/no questions (SPEC section 4, P appendix).

    token = learn(vlm, "red-mug", photos, unseen)
    token.accuracy                                    # on photos that it never saw

The question is "can you recognize <my_0> in this image", and only the embedding of <my_0> is
trained. Photos of the actual distractors are its hard negatives, in the baseline's favour. The word
is then given to the policy that was initialised from the model.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32

from vap_core.base.errors import BadMemory
from vap_core.base.types import Rgb, value
from vap_core.policies.mini_pi0.token_file import Token

if TYPE_CHECKING:
    import torch

    from vap_core.policies.mini_pi0.vlm import MiniVlm

WORD = "<my_0>"
QUESTION = "can you recognize <my_0> in this image"
SHARES = (0.5, 0.35, 0.15)
"""Shares of own photos, look-alikes and other objects in a batch."""
EMBEDDED_AT_ONCE = 64


@value
class Photos:
    """Pictures of the object, of its look-alikes (hard negatives), and of other objects."""

    own: tuple[Rgb, ...]
    rivals: tuple[Rgb, ...]
    others: tuple[Rgb, ...]


@dataclass(frozen=True)
class TokenTraining:
    """How a token is learned: so many passes over so many augmentations of every photo."""

    epochs: int = 20
    rate: float = 0.02
    batch: int = 32
    augmentations: int = 8
    seed: int = 0


def learn(
    vlm: "MiniVlm",
    name: str,
    taught: Photos,
    unseen: Photos,
    training: TokenTraining | None = None,
) -> Token:
    """Train one embedding on `taught`, as many yes as no, and measure it on `unseen`.

    Nothing else changes.

    Raises: BadMemory when a kind of photo is missing.
    """
    _check_kinds(name, unseen)
    *_, (_, embedding) = lessons(vlm, name, taught, training)
    return Token(
        object=name,
        embedding=embedding,
        accuracy=accuracy(vlm, embedding, unseen),
        model=vlm.sha256(),
    )


def lessons(
    vlm: "MiniVlm", name: str, taught: Photos, training: TokenTraining | None = None
) -> Iterator[tuple[int, Float32[np.ndarray, " d"]]]:
    """The embedding as it is learned: before the first step, then after each epoch, and its step.

    Raises: BadMemory when a kind of photo is missing.
    """
    options = training or TokenTraining()
    rng = np.random.default_rng([77, options.seed, *name.encode()])
    _check_kinds(name, taught)
    question = _Question(vlm)
    patches = []
    for kind in (taught.own, taught.rivals, taught.others):
        if kind:
            augmented = _augmentations(kind, options.augmentations, rng)
            patches.append(question.embed(augmented))
    yield 0, question.learned()
    for step in _train(question, patches, options, rng):
        yield step, question.learned()


def recognized(
    vlm: "MiniVlm", embedding: Float32[np.ndarray, " d"], photos: Sequence[Rgb]
) -> Bool[np.ndarray, " n"]:
    """In which photos the model says yes to the word that has this embedding."""
    return answers(vlm, embedding, photos) > 0


def answers(
    vlm: "MiniVlm", embedding: Float32[np.ndarray, " d"], photos: Sequence[Rgb]
) -> Float32[np.ndarray, " n"]:
    """By how much "yes" scores above "no" in every photo, for the word that has this embedding."""
    import torch

    question = _Question(vlm, embedding)
    with torch.no_grad():
        return question.ask(question.embed(photos)).numpy()


def accuracy(vlm: "MiniVlm", embedding: Float32[np.ndarray, " d"], photos: Photos) -> float:
    """The share of right answers, positives and negatives with equal weight."""
    said_yes = recognized(vlm, embedding, photos.own).mean()
    said_no = 1 - recognized(vlm, embedding, [*photos.rivals, *photos.others]).mean()
    return float((said_yes + said_no) / 2)


def augment(photo: Rgb, rng: np.random.Generator) -> Rgb:
    """The photo as another camera might have taken it; it is never mirrored.

    It is nearer or farther, off centre, turned, and brighter or darker.
    """
    import cv2

    size = np.array(photo.shape[1::-1])
    zoom = float(rng.uniform(0.6, 1.3))
    angle_deg = float(rng.uniform(-12, 12))
    turn = cv2.getRotationMatrix2D((size / 2).tolist(), angle_deg, zoom)
    turn[:, 2] = turn[:, 2] + rng.uniform(-0.15, 0.15, 2) * size
    moved = cv2.warpAffine(photo, turn, size.tolist(), borderMode=cv2.BORDER_REPLICATE)
    lit = moved * rng.uniform(0.8, 1.2) * rng.uniform(0.95, 1.05, 3)
    return np.clip(lit, 0, 255).astype(np.uint8)


class _Question:
    """The yes/no question about one object, with a trainable embedding for its word."""

    def __init__(self, vlm: "MiniVlm", embedding: Float32[np.ndarray, " d"] | None = None) -> None:
        import torch

        self.vlm = vlm
        tokens, self.mask = vlm.tokenize([QUESTION])
        self.words = vlm.towers.embed_language_tokens(tokens).detach()[0]
        self.is_word = tokens[0] == vlm.vocabulary[WORD]
        start = self.words[self.is_word][0].clone()
        if embedding is not None:
            start = torch.from_numpy(embedding)
        self.embedding = start.requires_grad_(True)
        self.answer = torch.zeros((1, 1), dtype=torch.long)

    def learned(self) -> Float32[np.ndarray, " d"]:
        """A copy of the embedding as it stands."""
        return self.embedding.detach().numpy().astype(np.float32)

    def embed(self, photos: Sequence[Rgb]) -> "torch.Tensor":
        """The patch features of photos."""
        import torch

        side = self.vlm.config.image_resolution[0]
        parts = []
        with torch.no_grad():
            for first in range(0, len(photos), EMBEDDED_AT_ONCE):
                images = _tensor(photos[first : first + EMBEDDED_AT_ONCE], side)
                parts.append(self.vlm.embed_images(images))
            return torch.cat(parts)

    def ask(self, patches: "torch.Tensor") -> "torch.Tensor":
        """By how much "yes" scores higher than "no", for every photo."""
        import torch

        n = len(patches)
        words = torch.where(self.is_word[:, None], self.embedding, self.words)
        scores, _ = self.vlm.read(
            patches,
            words.expand(n, -1, -1),
            self.mask.expand(n, -1),
            self.answer.expand(n, -1),
        )
        vocabulary = self.vlm.vocabulary
        return scores[:, 0, vocabulary["yes"]] - scores[:, 0, vocabulary["no"]]


def _check_kinds(name: str, photos: Photos) -> None:
    """Raises: BadMemory when a kind of photo is missing."""
    if not photos.own or not (photos.rivals or photos.others):
        raise BadMemory(
            f"tokens.learn: {name}: photos of the object and of others are both needed, to "
            "learn from and to measure by."
        )


def _augmentations(photos: Sequence[Rgb], n: int, rng: np.random.Generator) -> list[Rgb]:
    """`n` augmentations of every photo."""
    augmented = []
    for photo in photos:
        for _ in range(n):
            augmented.append(augment(photo, rng))
    return augmented


def _train(
    question: _Question,
    patches: Sequence["torch.Tensor"],
    options: TokenTraining,
    rng: np.random.Generator,
) -> Iterator[int]:
    """Train the question's embedding, and pass on the number of steps after each epoch.

    The photos of the object come first in `patches`.
    """
    import torch
    from torch.nn import functional as F  # noqa: N812

    optimiser = torch.optim.AdamW([question.embedding], options.rate, weight_decay=0.0)
    shares = np.array([0.5, 0.5])
    if len(patches) == len(SHARES):
        shares = np.array(SHARES)
    n_patches = sum(map(len, patches))
    n_steps = max(1, n_patches // options.batch)
    for epoch in range(options.epochs):
        for group in optimiser.param_groups:
            cosine = float(np.cos(np.pi * epoch / options.epochs))
            group["lr"] = options.rate * 0.5 * (1 + cosine)
        for _ in range(n_steps):
            kinds = rng.choice(len(patches), options.batch, p=shares)
            drawn = [patches[kind][rng.integers(len(patches[kind]))] for kind in kinds]
            right = torch.from_numpy((kinds == 0).astype(np.float32))
            answers = question.ask(torch.stack(drawn))
            loss = F.binary_cross_entropy_with_logits(answers, right)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        yield (epoch + 1) * n_steps


def _tensor(images: Sequence[Rgb], side: int) -> "torch.Tensor":
    """Images, of any sizes, with values in 0..1: B x 3 x side x side."""
    import torch

    resized = []
    for image in images:
        tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        resized.append(
            torch.nn.functional.interpolate(tensor, (side, side), mode="bilinear", antialias=True)
        )
    return torch.cat(resized)
