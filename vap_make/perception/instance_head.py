"""Training the encoder's instance head, which distinguishes look-alikes.

As in the vote (P 3.3), reference photos of an object must find it among its look-alikes.
"""

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
from vap_core.perception.embedded.encoder import (
    HISTOGRAM_LENGTH,
    INSTANCE_SIDE,
    INSTANCE_TAPS,
    gem,
    lab_histogram,
    pad_to_square,
)
from vap_core.perception.embedded.networks import CHANNELS
from vap_make.films.scenes import POSES, Shots, boxes_of
from vap_make.perception.backbone import features, normalise
from vap_make.perception.detector import augment, save_array
from vap_make.perception.fitting import Run, fit, half_precision
from vap_make.perception.graphs import InstanceHead, halve_b4
from vap_make.perception.segmenter import jitter

STAGES_PER_BATCH = 16
TEMPERATURE = 0.07
MIXED = 0.5
"""Share of crops whose features take on another's style (MixStyle, Zhou et al. 2021)."""
DROPPED = 0.1
"""Share of channels left out; with MIXED, it keeps the head from learning a renderer's style."""
MOST_OF_CREW = 5
"""Crops of one member of the crew that a stage gives, from its views."""
MOST_OF_OTHERS = 2
"""Crops of any other object."""
MIN_TRAINED_PX = 60
"""Visible pixels of an object that is cropped from a view."""
GRIDS = {"b4": 14, "b10": 14, "b14": 7}
"""Sides of the feature maps."""
MAPS_LENGTH = sum(CHANNELS[tap] * GRIDS[tap] ** 2 for tap in INSTANCE_TAPS)


@value
class StageCrops:
    """Crops of one stage.

    `rows` are features in half precision (the instance head's maps, colours, GeM); `pixels` are
    what the head sees of each crop; `who` is the object, and `portrait` whether the crop is from a
    reference photo. Arrays may lie on disk.
    """

    rows: Float[np.ndarray, "n f"]
    pixels: UInt8[np.ndarray, "n s s 3"]
    who: Int64[np.ndarray, " n"]
    portrait: Int64[np.ndarray, " n"]


def crops(shots: Shots, rng: np.random.Generator) -> tuple[list[Rgb], list[int], list[int]]:
    """Crops of the crew's portraits and of objects in the views, from boxes a little off.

    Also of whom each is, and whether it is of a portrait (1 or 0).
    """
    pictures: list[Rgb] = []
    who: list[int] = []
    portrait: list[int] = []
    n_objects = len(shots.names)
    for rgb, ids in zip(shots.portraits, shots.portrait_ids, strict=True):
        for i, box in boxes_of(ids, n_objects):
            pictures.append(_cut(rgb, box, rng))
            who.append(i)
            portrait.append(1)
    seen = []
    for v, ids in enumerate(shots.ids):
        for i, box in boxes_of(ids, n_objects, MIN_TRAINED_PX):
            seen.append((v, i, box))
    taken = [0] * n_objects
    crew = len(shots.portraits) // POSES
    for n in rng.permutation(len(seen)):
        v, i, box = seen[n]
        most = MOST_OF_CREW if i < crew else MOST_OF_OTHERS
        if taken[i] < most:
            taken[i] += 1
            pictures.append(_cut(shots.rgb[v], box, rng))
            who.append(i)
            portrait.append(0)
    return pictures, who, portrait


def featurise(folder: Path, name: str, shots: Shots, rng: np.random.Generator) -> StageCrops:
    """The crops of a stage with their frozen features, kept in `folder` under `name`."""
    pictures, who, portrait = crops(shots, rng)
    rows_path = folder / f"{name}.looks.npy"
    pixels_path = folder / f"{name}.pixels.npy"
    if not rows_path.exists() or not pixels_path.exists():
        size = (INSTANCE_SIDE, INSTANCE_SIDE)
        pixels = []
        rows = []
        for picture in pictures:
            square = pad_to_square(picture)
            pixels.append(cv2.resize(square, size, interpolation=cv2.INTER_AREA))
            rows.append(_row(picture, square))
        save_array(pixels_path, np.stack(pixels))
        save_array(rows_path, np.stack(rows))
    return StageCrops(
        rows=np.load(rows_path, mmap_mode="r"),
        pixels=np.load(pixels_path, mmap_mode="r"),
        who=np.array(who, np.int64),
        portrait=np.array(portrait, np.int64),
    )


def embed_crops(
    head: InstanceHead, rows: np.ndarray, pixels: np.ndarray, rng: np.random.Generator | None = None
) -> Float[Tensor, "n d"]:
    """The head's rows for crops as `featurise` keeps them; with `rng`, restyled as in training."""
    flat = torch.from_numpy(np.asarray(rows[:, : MAPS_LENGTH + HISTOGRAM_LENGTH])).float()
    start = 0
    maps = {}
    for tap in INSTANCE_TAPS:
        side = GRIDS[tap]
        size = CHANNELS[tap] * side * side
        tap_maps = flat[:, start : start + size].unflatten(1, (CHANNELS[tap], side, side))
        if rng is not None:
            tap_maps = _restyle(rng, tap_maps)
        maps[tap] = tap_maps
        start += size
    images = normalise(torch.from_numpy(np.asarray(pixels)))
    return head(maps, images, flat[:, start:])


def contrastive_loss(cosine: Float[Tensor, "a k"], same: Bool[Tensor, "a k"]) -> Tensor:
    """The mean of -log exp(c/t) / (exp(c/t) + others) over every pair that is the same.

    `others` is the sum of exp(c/t) over those that are not the same as the pair's anchor.
    """
    logits = cosine / TEMPERATURE
    others = logits.masked_fill(same, -torch.inf).logsumexp(1, keepdim=True)
    losses = torch.logaddexp(logits, others) - logits
    return (losses * same).sum() / same.sum().clamp(min=1)


def fit_instance_head(stages: Sequence[StageCrops], run: Run) -> InstanceHead:
    """Train the head: portraits find crops of their object in views, and these find portraits.

    Raises: BadOutput, as `fit`.
    """
    # Initial weights only; every other draw comes from the epoch's stream.
    torch.manual_seed(run.seed)
    head = InstanceHead()

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        order = rng.permutation(len(stages))
        for first in range(0, len(order), STAGES_PER_BATCH):
            batch = _draw_batch(rng, stages, order[first : first + STAGES_PER_BATCH])
            with half_precision():
                rows = embed_crops(head, batch.rows, batch.pixels, rng)
            rows = F.normalize(rows.float(), dim=1)
            who = torch.from_numpy(batch.who)
            portrait = torch.from_numpy(batch.portrait) > 0
            cosine = rows[portrait] @ rows[~portrait].T
            same = who[portrait][:, None] == who[~portrait]
            yield contrastive_loss(cosine, same) + contrastive_loss(cosine.T, same.T)

    batches = -(-len(stages) // STAGES_PER_BATCH)
    fit(head, losses, batches, run)
    return head


def _row(rgb: Rgb, square: Rgb) -> np.ndarray:
    """The features of a crop, `square` the same padded."""
    taps = features([square], [*INSTANCE_TAPS, "head"])
    colour = lab_histogram(rgb)
    parts = []
    for maps in halve_b4(taps).values():
        parts.append(maps[0].numpy().ravel())
    parts.append(colour / np.linalg.norm(colour))
    parts.append(gem(taps["head"][0].numpy()))
    return np.concatenate(parts).astype(np.float16)


def _draw_batch(
    rng: np.random.Generator, stages: Sequence[StageCrops], numbers: Int64[np.ndarray, " k"]
) -> StageCrops:
    """Some crops of the stages of these numbers, augmented; objects are numbered anew."""
    picks = []
    for s in numbers:
        portraits, views = _pick(rng, stages[s])
        picks.append(np.concatenate([portraits, views]))
    rows = []
    pixels = []
    who = []
    portrait = []
    for s, at in zip(numbers, picks, strict=True):
        rows.append(stages[s].rows[at])
        pixels.append(_augment_pixels(rng, stages[s].pixels[at]))
        who.append(stages[s].who[at] + 100 * s)
        portrait.append(stages[s].portrait[at])
    return StageCrops(
        rows=np.concatenate(rows),
        pixels=np.concatenate(pixels),
        who=np.concatenate(who),
        portrait=np.concatenate(portrait),
    )


def _pick(rng: np.random.Generator, crops: StageCrops) -> tuple[np.ndarray, np.ndarray]:
    """Two portraits of every object that has some, and up to three crops of every object."""
    portraits: list[int] = []
    views: list[int] = []
    for who in np.unique(crops.who):
        own = crops.who == who
        own_portraits = np.flatnonzero(own & (crops.portrait == 1))
        own_views = np.flatnonzero(own & (crops.portrait == 0))
        portraits += rng.permutation(own_portraits)[:2].tolist()
        views += rng.permutation(own_views)[:3].tolist()
    return np.array(portraits, np.int64), np.array(views, np.int64)


def _restyle(rng: np.random.Generator, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """MixStyle and dropped channels.

    Some crops get the channels' means and deviations of a mixture with another crop; some channels
    of each are left out.
    """
    n, channels = maps.shape[:2]
    mean = maps.mean((2, 3), keepdim=True)
    deviation = maps.std((2, 3), keepdim=True) + 1e-5
    other = rng.permutation(n)
    drawn = rng.beta(0.3, 0.3, (n, 1, 1, 1))
    mixed = rng.random((n, 1, 1, 1)) < MIXED
    own_share = np.where(mixed, np.maximum(drawn, 1 - drawn), 1.0)
    share = torch.from_numpy(own_share).float()
    mixed_deviation = share * deviation + (1 - share) * deviation[other]
    restyled = (maps - mean) / deviation * mixed_deviation
    restyled = restyled + share * mean + (1 - share) * mean[other]
    kept = torch.from_numpy(rng.random((n, channels, 1, 1)) > DROPPED)
    return restyled * kept / (1 - DROPPED)


def _augment_pixels(
    rng: np.random.Generator, pixels: UInt8[np.ndarray, "n s s 3"]
) -> UInt8[np.ndarray, "n s s 3"]:
    """Other contrast, exposure and tint; some blurred, half with a rectangle painted over.

    The frozen features stay.
    """
    n, side = pixels.shape[:2]
    images = np.asarray(pixels, np.float32)
    mean = images.mean((1, 2, 3), keepdims=True)
    contrast = rng.uniform(0.6, 1.4, (n, 1, 1, 1))
    exposure = rng.uniform(0.7, 1.3, (n, 1, 1, 1))
    images = (images - mean) * contrast + mean * exposure
    images = images * rng.uniform(0.85, 1.15, (n, 1, 1, 3))
    for image in images:
        if rng.random() < 0.3:
            sigma = float(rng.uniform(0.4, 1.6))
            image[:] = cv2.GaussianBlur(image, (0, 0), sigma)
        if rng.random() < 0.5:
            height, width = rng.integers(10, 50, 2)
            top = rng.integers(0, side - height)
            left = rng.integers(0, side - width)
            image[top : top + height, left : left + width] = rng.uniform(0, 255, 3)
    return np.clip(images, 0, 255).astype(np.uint8)


def _cut(rgb: Rgb, box: tuple[int, int, int, int], rng: np.random.Generator) -> Rgb:
    """An augmented crop, from a box that is a little off."""
    jittered = jitter(rng, np.array(box, np.float64), 0.06)
    low = np.maximum(jittered[:2], 0)
    high = np.maximum(jittered[2:], jittered[:2] + 2)
    return augment(rng, crop(rgb, np.concatenate([low, high])))
