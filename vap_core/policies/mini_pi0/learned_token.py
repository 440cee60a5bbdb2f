"""The learned word of a personal object: value, file, training and use (P appendix)."""

import hashlib
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import batched, chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Float64

from vap_core.base.errors import BadMemory, BadStudy
from vap_core.base.files import DATA, encode_tensors, parse_json, read_file, write_atomic, writing
from vap_core.base.types import Rgb, value
from vap_core.policies.lerobot.checkpoints import config_field
from vap_core.policies.tables import check_width, open_table
from vap_core.simulation.assets import objects
from vap_core.simulation.studio import reference_views
from vap_core.simulation.suites.open_row import models_of
from vap_core.simulation.types import EpisodeRow

if TYPE_CHECKING:
    import torch

    from vap_core.policies.mini_pi0.vlm import MiniVlm


SUFFIX = ".token.safetensors"
"""Of a word that was learned in the model that policies are initialised from."""
OWN_SUFFIX = ".own.token.safetensors"
"""Of a word that was learned in a policy's own weights."""


@value
class Token:
    """A learned word: its embedding in the model's space, and its accuracy on held-out photos.

    In `accuracy` positives and negatives have equal weight. `model` is the SHA-256 of the model in
    which it was learned: it means nothing in another.
    """

    object: str
    embedding: Float32[np.ndarray, " d"]
    accuracy: float
    model: str


def save(folder: Path, token: Token, suffix: str = SUFFIX) -> Path:
    """Write the object's name and `suffix`. Raises: OSError."""
    header = {"object": token.object, "accuracy": repr(token.accuracy), "model": token.model}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{token.object}{suffix}"
    write_atomic(path, encode_tensors({"embedding": token.embedding}, header))
    return path


def load(folder: Path, name: str, model: str, suffix: str = SUFFIX) -> Token:
    """The word of that object.

    Raises: BadMemory when it is absent, damaged, of another object, or was learned in another
        model.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load as decode

    path = folder / f"{name}{suffix}"
    try:
        data = read_file(path)
        (length,) = struct.unpack("<Q", data[:8])
        header = parse_json(data[8 : 8 + length])["__metadata__"]
        accuracy = float(header["accuracy"])
        token = Token(header["object"], decode(data)["embedding"], accuracy, header["model"])
    except (OSError, SafetensorError, struct.error, ValueError, KeyError, TypeError) as error:
        raise BadMemory(
            f"tokens.load: {path} holds no learned word ({type(error).__name__}); learn it again."
        ) from error
    fault = ""
    if token.object != name:
        fault = f"is the word of {token.object!r}, not of {name!r}"
    elif not np.isfinite(token.embedding).all():
        fault = "has numbers that are not finite"
    elif not 0 <= token.accuracy <= 1:
        fault = f"has an accuracy of {token.accuracy:g}, not from 0 to 1"
    elif token.model != model:
        fault = f"was learned in model {token.model[:8]}, this is {model[:8]}"
    if fault:
        raise BadMemory(f"tokens.load: {path} {fault}; learn it again.")
    return token


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
    return Token(name, embedding, accuracy(vlm, embedding, unseen), vlm.sha256())


def lessons(
    vlm: "MiniVlm", name: str, taught: Photos, training: TokenTraining | None = None
) -> Iterator[tuple[int, Float32[np.ndarray, " d"]]]:
    """The embedding as it is learned: before the first step, then after each epoch, and its step.

    Raises: BadMemory when a kind of photo is missing.
    """
    import torch
    from torch.nn.functional import binary_cross_entropy_with_logits

    options = training or TokenTraining()
    rng = np.random.default_rng([77, options.seed, *name.encode()])
    _check_kinds(name, taught)
    question = _Question(vlm)
    patches = []
    for kind in filter(None, (taught.own, taught.rivals, taught.others)):
        many = [photo for photo in kind for _ in range(options.augmentations)]
        patches.append(question.embed([augment(photo, rng) for photo in many]))
    yield 0, question.learned()
    optimiser = torch.optim.AdamW([question.embedding], options.rate, weight_decay=0.0)
    shares = np.array(SHARES if len(patches) == len(SHARES) else (0.5, 0.5))
    n_steps = max(1, sum(map(len, patches)) // options.batch)
    for epoch in range(options.epochs):
        for group in optimiser.param_groups:
            cosine = float(np.cos(np.pi * epoch / options.epochs))
            group["lr"] = options.rate * 0.5 * (1 + cosine)
        for _ in range(n_steps):
            kinds = rng.choice(len(patches), options.batch, p=shares)
            drawn = [patches[kind][rng.integers(len(patches[kind]))] for kind in kinds]
            right = torch.from_numpy((kinds == 0).astype(np.float32))  # the object comes first
            loss = binary_cross_entropy_with_logits(question.ask(torch.stack(drawn)), right)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        yield (epoch + 1) * n_steps, question.learned()


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
        """The patch features of photos of any sizes."""
        import torch
        from torch.nn.functional import interpolate

        side = self.vlm.config.image_resolution

        def resized(photo: Rgb) -> torch.Tensor:
            image = torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255
            return interpolate(image, side, mode="bilinear", antialias=True)

        with torch.no_grad():
            parts = batched(map(resized, photos), EMBEDDED_AT_ONCE)
            return torch.cat([self.vlm.embed_images(torch.cat(part)) for part in parts])

    def ask(self, patches: "torch.Tensor") -> "torch.Tensor":
        """By how much "yes" scores higher than "no", for every photo."""
        import torch

        n = len(patches)
        words = torch.where(self.is_word[:, None], self.embedding, self.words).expand(n, -1, -1)
        mask, answer = self.mask.expand(n, -1), self.answer.expand(n, -1)
        scores, _ = self.vlm.read(patches, words, mask, answer)
        vocabulary = self.vlm.vocabulary
        return scores[:, 0, vocabulary["yes"]] - scores[:, 0, vocabulary["no"]]


def _check_kinds(name: str, photos: Photos) -> None:
    """Raises: BadMemory when a kind of photo is missing."""
    if not photos.own or not (photos.rivals or photos.others):
        raise BadMemory(
            f"tokens.learn: {name}: photos of the object and of others are both needed, to "
            "learn from and to measure by."
        )


MODEL = DATA / "policies" / "mini-paligemma"
"""The shipped vision-language model of today's recipe.

That of earlier policies lies beside it (`model_of`).
"""
K = 5
"""Photos of the object to learn from."""
VIEWS = 12
"""Photos of every look-alike (the paper: more than ten), and of the object to measure by."""
OTHERS = 4
"""The number of objects of other categories."""
LEAST_ACCURACY = 0.95
"""Share of right answers that the paper asks of a token."""


def photographs(rows: Iterable[EpisodeRow], seed: int, k: int) -> Photos:
    """Photos of the rows' target, of every look-alike beside it, and of other objects.

    There are `k` of the target, as its owner takes them.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    rows = list(rows)
    own = reference_views(objects.get_object(rows[0].target), k, seed)
    views = [reference_views(objects.get_object(name), VIEWS, seed) for name in lookalikes(rows)]
    return Photos(tuple(own), tuple(chain.from_iterable(views)), other_objects(rows, seed))


def lookalikes(rows: Iterable[EpisodeRow]) -> list[str]:
    """The objects of the target's category that the rows place beside it, sorted.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    rows = list(rows)
    target = objects.get_object(rows[0].target)
    placed = set(models_of(rows)) - {row.goal for row in rows}
    return [
        name
        for name in sorted(placed - {target.name})
        if objects.get_object(name).category == target.category
    ]


def file_suffix(rows: Iterable[EpisodeRow], model: str, suffix: str = SUFFIX) -> str:
    """What a token's file is called after its object's name: `suffix`, and before it a digest.

    The digest is of what one object's tokens differ by: the SHA-256 of the model, and the
    look-alikes beside the object.
    """
    differ_by = "\n".join([model, *lookalikes(rows)])
    return f".{hashlib.sha256(differ_by.encode()).hexdigest()[:12]}{suffix}"


def other_objects(rows: Sequence[EpisodeRow], seed: int) -> tuple[Rgb, ...]:
    """Photos of personal objects of other categories than the rows' target.

    Raises: UnknownName, BadObject, as `get_object`.
    """
    category = objects.get_object(rows[0].target).category
    kinds = [kind for kind in objects.CATEGORIES if kind != category]
    first = objects.CATEGORIES.index(category)
    drawn = [kinds[(first + 5 * i) % len(kinds)] for i in range(OTHERS)]
    views = [reference_views(objects.personal_instance(kind), seed=seed) for kind in drawn]
    return tuple(chain.from_iterable(views))


def model_of(initialised_from: str) -> Path:
    """The folder of the shipped model with this SHA-256; that of MODEL where none has it.

    Raises: BadPolicy when a shipped model is damaged.
    """
    folders = sorted(MODEL.parent.glob("mini-paligemma*"))
    return next((each for each in folders if _sha256(each) == initialised_from), MODEL)


def model_of_policy(policy: Path) -> Path:
    """The folder of the shipped model that the policy in a folder grew from. Raises: BadPolicy."""
    return model_of(config_field(policy, "vlm"))


@lru_cache
def _sha256(model: Path) -> str:
    """Of the model in a folder; every trial of a method asks for it."""
    from vap_core.policies.mini_pi0.vlm import load_vlm

    return load_vlm(model).sha256()


def teach(
    rows: Iterable[EpisodeRow], folder: Path, initialised_from: str, model: Path | None = None
) -> Token:
    """Learn the token of the rows' target from K photos, and keep it in `folder`.

    It is measured on other photos. A token that is there already stays. `initialised_from` is the
    SHA-256 of the model that the policy was initialised from; `model` is its folder, by default the
    shipped one's. A token that is not learned well is noted on stderr.

    Raises: BadPolicy without the model; BadStudy when the policy was initialised from another one;
        BadOutput when the folder cannot be written.
    """
    from vap_core.policies.mini_pi0 import vlm

    model = model or model_of(initialised_from)
    teacher = vlm.load_vlm(model)
    if teacher.sha256() != initialised_from:
        known = f"mini-PaliGemma {initialised_from[:8]}" if initialised_from else "none"
        raise BadStudy(
            f"soft prompt: the policy was initialised from {known}, but the model in {model} is "
            f"{teacher.sha256()[:8]}; leave soft out, or put the right one there."
        )
    return _teach(teacher, list(rows), folder, SUFFIX)


def teach_own(rows: Iterable[EpisodeRow], folder: Path, policy: Path) -> Token:
    """The same in the weights of the policy whose checkpoint is given, not in those it came from.

    Raises: BadPolicy when the checkpoint is no mini-pi0; BadOutput when the folder cannot be
        written.
    """
    from vap_core.policies.mini_pi0 import vlm

    return _teach(vlm.load_from_policy(policy), list(rows), folder, OWN_SUFFIX)


def _teach(teacher: "MiniVlm", rows: Sequence[EpisodeRow], folder: Path, suffix: str) -> Token:
    """Learn the target's token in `teacher` unless the folder has it."""
    from vap_core.policies.mini_pi0.modeling_mini_pi0 import fused_attention

    name = rows[0].target
    suffix = file_suffix(rows, teacher.sha256(), suffix)
    if (folder / f"{name}{suffix}").exists():
        return load(folder, name, teacher.sha256(), suffix)
    with fused_attention():  # a third less time
        token = learn(teacher, name, photographs(rows, 0, K), photographs(rows, 1, VIEWS))
    if token.accuracy < LEAST_ACCURACY:
        print(
            f"note: the learned token of {name} is right in {100 * token.accuracy:.0f} % of unseen "
            f"photos, less than {100 * LEAST_ACCURACY:.0f} %.",
            file=sys.stderr,
        )
    with writing(folder, "tokens"):
        save(folder, token, suffix)
    return token


PRIOR = 1e-3
"""Weight of the identity, in squared lengths of a mean row.

It decides only what the words leave open: a small vocabulary has fewer words than features.
"""


def orthogonal_map(
    source: Float32[np.ndarray, "v d"], target: Float32[np.ndarray, "v d"]
) -> Float64[np.ndarray, "d d"]:
    """The orthogonal R for which source @ R is nearest to target (Procrustes)."""
    from scipy.linalg import orthogonal_procrustes

    width = source.shape[1]
    mean_square = np.square(source, dtype=np.float64).sum() / len(source)
    identity = np.sqrt(PRIOR * mean_square / width) * np.eye(width)
    rotation, _ = orthogonal_procrustes(
        np.concatenate([source, identity]), np.concatenate([target, identity])
    )
    return rotation


def align(
    embedding: Float32[np.ndarray, " d"], model: Path, policy: Path
) -> Float32[np.ndarray, " d"]:
    """The embedding, learned in `model`, rotated into the space of the policy; both are folders.

    Raises: BadPolicy.
    """
    ours, theirs = open_table(model), open_table(policy)
    check_width(ours, len(embedding), "the embedding")
    check_width(theirs, ours.shape[1], str(model))
    n = min(ours.shape[0], theirs.shape[0])  # the tokens that both have
    rotation = orthogonal_map(ours.block(0, n), theirs.block(0, n))
    return (embedding @ rotation).astype(np.float32)
