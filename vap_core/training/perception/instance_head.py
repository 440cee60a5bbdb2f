"""Training the encoder's look head: reference photos of an object must find it among its look-alikes, as in the vote (P 3.3)."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb, value
from vap_core.perception.boxes import crop
from vap_core.perception.embedded.backbone import CHANNELS, features, normalise
from vap_core.perception.embedded.encoder import (
    HISTOGRAM_LENGTH,
    INSTANCE_SIDE,
    INSTANCE_TAPS,
    InstanceHead,
    gem,
    halve_b4,
    lab_histogram,
    pad_to_square,
)
from vap_core.training.films.scenes import POSES, Shots, boxes_of
from vap_core.training.perception.detector import disturb, keep
from vap_core.training.perception.fitting import Run, fit, halved
from vap_core.training.perception.segmenter import jitter

STAGES_PER_BATCH, TEMPERATURE = 16, 0.07
MIXED, DROPPED = 0.5, 0.1
"""Share of crops whose features take on another's style (MixStyle, Zhou et al. 2021), and of channels left out: no renderer's look is learned."""
MOST, FEWEST_PX = 5, 60
"""Crops of one object that one stage gives, from its views, and the visible pixels of each."""
GRIDS = {"b4": 14, "b10": 14, "b14": 7}
COLOURS = HISTOGRAM_LENGTH
MAPS = sum(CHANNELS[tap] * GRIDS[tap] ** 2 for tap in INSTANCE_TAPS)


@value
class Looks:
    """Crops of one stage: `rows` are features (the look head's maps, colours, GeM; half precision), `pixels` what the head sees of each.

    `who` is the object, `portrait` whether the crop is from a reference photo. Arrays may lie on disk.
    """

    rows: Float[np.ndarray, "n f"]
    pixels: UInt8[np.ndarray, "n s s 3"]
    who: Int64[np.ndarray, " n"]
    portrait: Int64[np.ndarray, " n"]


def crops(shots: Shots, rng: np.random.Generator) -> tuple[list[Rgb], list[int], list[int]]:
    """Crops of the crew's portraits and of every object in the views, from boxes that are a little off; who, and whether it is a portrait."""
    found: list[tuple[Rgb, int, int]] = []
    for rgb, ids in zip(shots.portraits, shots.portrait_ids, strict=True):
        found += [(_cut(rgb, box, rng), i, 1) for i, box in boxes_of(ids, len(shots.names))]
    seen = [
        (v, i, box)
        for v, ids in enumerate(shots.ids)
        for i, box in boxes_of(ids, len(shots.names), FEWEST_PX)
    ]
    taken = dict.fromkeys(range(len(shots.names)), 0)
    crew = len(shots.portraits) // POSES
    for n in rng.permutation(len(seen)):
        v, i, box = seen[n]
        if taken[i] < (MOST if i < crew else 2):
            taken[i] += 1
            found.append((_cut(shots.rgb[v], box, rng), i, 0))
    pictures, who, portrait = zip(*found, strict=True)
    return list(pictures), list(who), list(portrait)


def featurise(folder: Path, name: str, shots: Shots, rng: np.random.Generator) -> Looks:
    """The crops of a stage with their frozen features, kept in `folder` under `name`."""
    pictures, who, portrait = crops(shots, rng)
    path, seen = folder / f"{name}.looks.npy", folder / f"{name}.pixels.npy"
    if not path.exists() or not seen.exists():
        squares = [pad_to_square(rgb) for rgb in pictures]
        keep(
            seen,
            np.stack(
                [
                    cv2.resize(
                        picture, (INSTANCE_SIDE, INSTANCE_SIDE), interpolation=cv2.INTER_AREA
                    )
                    for picture in squares
                ]
            ),
        )
        keep(
            path,
            np.stack(
                [_row(picture, whole) for picture, whole in zip(pictures, squares, strict=True)]
            ),
        )
    return Looks(
        np.load(path, mmap_mode="r"),
        np.load(seen, mmap_mode="r"),
        np.array(who, np.int64),
        np.array(portrait, np.int64),
    )


def _row(rgb: Rgb, whole: Rgb) -> np.ndarray:
    taps = features([whole], [*INSTANCE_TAPS, "head"])
    colour = lab_histogram(rgb)
    parts = [
        *(maps[0].numpy().ravel() for maps in halve_b4(taps).values()),
        colour / np.linalg.norm(colour),
        gem(taps["head"][0].numpy()),
    ]
    return np.concatenate(parts).astype(np.float16)


def look(
    head: InstanceHead, rows: np.ndarray, pixels: np.ndarray, rng: np.random.Generator | None = None
) -> Float[Tensor, "n d"]:
    """The head's answer to crops as `featurise` keeps them; with `rng`, restyled as in training."""
    flat, start, maps = torch.from_numpy(np.asarray(rows[:, : MAPS + COLOURS])).float(), 0, {}
    for tap in INSTANCE_TAPS:
        shape = (CHANNELS[tap], GRIDS[tap], GRIDS[tap])
        seen = flat[:, start : start + int(np.prod(shape))].unflatten(1, shape)
        maps[tap] = seen if rng is None else _restyled(rng, seen)
        start += int(np.prod(shape))
    return head(maps, normalise(torch.from_numpy(np.asarray(pixels))), flat[:, start:])


def contrast(cosine: Float[Tensor, "a k"], same: Bool[Tensor, "a k"]) -> Tensor:
    """Mean over every pair that is the same of -log exp(c/t) / (exp(c/t) + the sum of exp over the anchor's others)."""
    logits = cosine / TEMPERATURE
    others = logits.masked_fill(same, -torch.inf).logsumexp(1, keepdim=True)
    return ((torch.logaddexp(logits, others) - logits) * same).sum() / same.sum().clamp(min=1)


def fit_looks(stages: Sequence[Looks], run: Run) -> InstanceHead:
    """Train the head: portraits find the views' crops of their object, and the crops their portraits."""
    torch.manual_seed(
        run.seed
    )  # initial weights only; every other draw comes from the epoch's stream
    head = InstanceHead()

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        order = rng.permutation(len(stages))
        for batch in range(0, len(order), STAGES_PER_BATCH):
            picked = [(s, *_pick(rng, stages[s])) for s in order[batch : batch + STAGES_PER_BATCH]]
            where = [(s, np.concatenate([portraits, views])) for s, portraits, views in picked]
            frozen = np.concatenate([stages[s].rows[at] for s, at in where])
            pixels = np.concatenate([_turned(rng, stages[s].pixels[at]) for s, at in where])
            with halved():
                rows = look(head, frozen, pixels, rng)
            rows = F.normalize(rows.float(), dim=1)
            who = torch.from_numpy(np.concatenate([stages[s].who[at] + 100 * s for s, at in where]))
            portrait = (
                torch.from_numpy(np.concatenate([stages[s].portrait[at] for s, at in where])) > 0
            )
            cosine, same = (
                rows[portrait] @ rows[~portrait].T,
                who[portrait][:, None] == who[~portrait],
            )
            yield contrast(cosine, same) + contrast(cosine.T, same.T)

    fit(head, losses, -(-len(stages) // STAGES_PER_BATCH), run)
    return head


def _pick(rng: np.random.Generator, looks: Looks) -> tuple[np.ndarray, np.ndarray]:
    """Two portraits of every object that has some, and up to three crops of every object."""
    portraits: list[int] = []
    views: list[int] = []
    for who in np.unique(looks.who):
        for kind, most, into in ((1, 2, portraits), (0, 3, views)):
            mine = np.flatnonzero((looks.who == who) & (looks.portrait == kind))
            into += rng.permutation(mine)[:most].tolist()
    return np.array(portraits, np.int64), np.array(views, np.int64)


def _restyled(rng: np.random.Generator, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """Some crops get the channels' means and deviations of a mixture with another crop; some channels of each are left out."""
    n, channels = maps.shape[:2]
    mean, deviation = maps.mean((2, 3), keepdim=True), maps.std((2, 3), keepdim=True) + 1e-5
    other, drawn = rng.permutation(n), rng.beta(0.3, 0.3, (n, 1, 1, 1))
    share = torch.from_numpy(
        np.where(rng.random((n, 1, 1, 1)) < MIXED, np.maximum(drawn, 1 - drawn), 1.0)
    ).float()
    styled = (
        (maps - mean) / deviation * (share * deviation + (1 - share) * deviation[other])
        + share * mean
        + (1 - share) * mean[other]
    )
    return styled * torch.from_numpy(rng.random((n, channels, 1, 1)) > DROPPED) / (1 - DROPPED)


def _turned(
    rng: np.random.Generator, pixels: UInt8[np.ndarray, "n s s 3"]
) -> UInt8[np.ndarray, "n s s 3"]:
    """Other contrast, exposure and tint; some blurred, half with a rectangle painted over. The frozen features stay."""
    n, side = len(pixels), pixels.shape[1]
    x = np.asarray(pixels, np.float32)
    mean = x.mean((1, 2, 3), keepdims=True)
    x = (x - mean) * rng.uniform(0.6, 1.4, (n, 1, 1, 1)) + mean * rng.uniform(
        0.7, 1.3, (n, 1, 1, 1)
    )
    x = x * rng.uniform(0.85, 1.15, (n, 1, 1, 3))
    for picture in x:
        if rng.random() < 0.3:
            picture[:] = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.4, 1.6)))
        if rng.random() < 0.5:
            high, wide = rng.integers(10, 50, 2)
            top, left = rng.integers(0, side - high), rng.integers(0, side - wide)
            picture[top : top + high, left : left + wide] = rng.uniform(0, 255, 3)
    return np.clip(x, 0, 255).astype(np.uint8)


def _cut(rgb: Rgb, box: tuple[int, int, int, int], rng: np.random.Generator) -> Rgb:
    off = jitter(rng, np.array(box, np.float64), 0.06)
    low, high = np.maximum(off[:2], 0), np.maximum(off[2:], off[:2] + 2)
    return disturb(rng, crop(rgb, np.concatenate([low, high])))
