"""Training the segmenter's head on windows around rendered objects.

Each window is prompted by a box, or by a box and a coarse guess of the mask.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.perception.boxes import mask_box
from vap_core.perception.embedded.segmenter import MASK_TAPS, SIDE, box_plane, cut, window_around
from vap_make.films.scenes import Shots, boxes_of
from vap_make.perception.backbone import load_backbone, normalise
from vap_make.perception.detector import augment
from vap_make.perception.fitting import Run, fit, half_precision
from vap_make.perception.graphs import MaskHead

BATCH = 16
LEAST_PX = 80
GRID = 28
"""Cells of the tracker's grid along the longer side."""


def crops_of(shots: Shots) -> list[tuple[int, int]]:
    """View and object of everything with at least LEAST_PX visible pixels."""
    crops = []
    for v, ids in enumerate(shots.ids):
        for i, _ in boxes_of(ids, len(shots.names), LEAST_PX):
            crops.append((v, i))
    return crops


def jitter(
    rng: np.random.Generator, box: Float[np.ndarray, "4"], amount: float = 0.08
) -> Float[np.ndarray, "4"]:
    """Each edge moved by up to `amount` of the box's extent along it."""
    size = np.array([box[2] - box[0], box[3] - box[1]] * 2)
    return box + rng.uniform(-amount, amount, 4) * size


def coarsen(rng: np.random.Generator, mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """What a tracker at stride 8 would know of a mask, 0..1.

    The mask is shifted by up to half a cell, averaged over cells, made noisy and smooth.
    """
    h, w = mask.shape
    cell = max(h, w) / GRID
    dx, dy = rng.uniform(-0.5, 0.5, 2) * cell
    shift = np.array([[1, 0, dx], [0, 1, dy]], np.float32)
    moved = cv2.warpAffine(mask.astype(np.float32), shift, (w, h))
    grid = (round(w / cell), round(h / cell))
    cells = cv2.resize(moved, grid, interpolation=cv2.INTER_AREA)
    gain = rng.uniform(0.7, 1.2)
    noise = rng.normal(0, 0.08, cells.shape)
    near = cv2.dilate(cells, np.ones((3, 3))) > 0.05
    cells = cells * gain + noise * near
    chance = np.clip(cells, 0, 1).astype(np.float32)
    return cv2.resize(chance, (w, h), interpolation=cv2.INTER_LINEAR)


def sample(
    rng: np.random.Generator, rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One training window: pixels, prompt planes, wanted mask."""
    box = mask_box(mask)
    coarse = None
    assert box is not None
    if rng.random() < 0.5:
        coarse = coarsen(rng, mask)
        likely = coarse > 0.4
        if likely.any():
            box = mask_box(likely)
    assert box is not None
    if rng.random() < 0.6:
        box = jitter(rng, box)
    window = window_around(box)
    planes = np.zeros((2, SIDE, SIDE), np.uint8)
    planes[0] = cut(box_plane(box, mask.shape), window, 0)
    if coarse is not None:
        planes[1] = cut((coarse * 255).astype(np.uint8), window, 0)
    pixels = augment(rng, cut(rgb, window))
    wanted = cut(mask.astype(np.uint8) * 255, window, 0)
    if rng.random() < 0.5:
        return pixels[:, ::-1].copy(), planes[:, :, ::-1].copy(), wanted[:, ::-1].copy()
    return pixels, planes, wanted


def mask_loss(logits: Float[Tensor, "n h w"], wanted: Float[Tensor, "n h w"]) -> Tensor:
    """Cross-entropy plus a soft Dice loss.

    The latter does not depend on how much of the window the object fills.
    """
    chance = logits.sigmoid()
    shared = (chance * wanted).sum((1, 2))
    both = chance.sum((1, 2)) + wanted.sum((1, 2))
    dice = 1 - (2 * shared + 1) / (both + 1)
    return F.binary_cross_entropy_with_logits(logits, wanted) + dice.mean()


def fit_segmenter(stages: Sequence[Shots], crops_per_epoch: int, run: Run) -> MaskHead:
    """Train the head on windows around the objects of the stages' views.

    Raises: BadOutput, as `fit`; MissingWeights when the backbone's package is not installed.
    """
    # Initial weights only; every other draw comes from the epoch's stream.
    torch.manual_seed(run.seed)
    head = MaskHead()
    pool = []
    for s, shots in enumerate(stages):
        for v, i in crops_of(shots):
            pool.append((s, v, i))
    per_epoch = min(crops_per_epoch, len(pool)) // BATCH

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        order = rng.permutation(len(pool))
        for batch in range(per_epoch):
            samples = []
            for at in order[batch * BATCH : (batch + 1) * BATCH]:
                s, v, i = pool[at]
                samples.append(sample(rng, stages[s].rgb[v], stages[s].ids[v] == i + 1))
            rgb, planes, masks = _stack_samples(samples)
            pixels = normalise(rgb)
            with half_precision():
                with torch.no_grad():
                    taps = load_backbone()(pixels, MASK_TAPS)
                logits = head(pixels, taps, planes.float() / 255)
            yield mask_loss(logits.float(), masks.float() / 255)

    fit(head, losses, per_epoch, run)
    return head


def _stack_samples(
    samples: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, prompt planes and wanted masks of many windows, each in one array of bytes."""
    pixels, planes, wanted = zip(*samples, strict=True)
    return (
        torch.from_numpy(np.stack(pixels)),
        torch.from_numpy(np.stack(planes)),
        torch.from_numpy(np.stack(wanted)),
    )
