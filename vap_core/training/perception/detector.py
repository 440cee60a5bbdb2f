"""Training the detector's head: frozen features once per view, then CenterNet's focal loss and a box loss (GIoU) on them."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8, UInt16
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.types import Rgb
from vap_core.perception.embedded.backbone import CHANNELS, features
from vap_core.perception.embedded.backbone import STRIDE as STRIDES
from vap_core.perception.embedded.detector import SIDE, STRIDE, TAPS, DetectHead, resize_for_search
from vap_core.perception.text_encoder import embed_text
from vap_core.simulation.assets.phrases import AMBIGUOUS, NEGATIVES, training_phrases
from vap_core.training.films.scenes import POSES, Shots, boxes_of
from vap_core.training.perception.fitting import Run, fit, halved

BATCH = 16
Objects = list[tuple[str, np.ndarray]]
"""Category and box, `x0 y0 x1 y1` in cells, of every object in a view."""


def disturb(rng: np.random.Generator, rgb: Rgb) -> Rgb:
    """Exposure, tint, blur and sensor noise, so that no renderer's look is learned."""
    x: np.ndarray = rgb.astype(np.float32)
    x = (x - 127) * rng.uniform(0.75, 1.25) + 127 + rng.uniform(-25, 25) + rng.normal(0, 6, 3)
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.3, 1.0)))
    if rng.random() < 0.5:
        x = x + rng.normal(0, rng.uniform(1, 7), x.shape)
    return np.clip(x, 0, 255).astype(np.uint8)


def featurise(
    folder: Path, name: str, shots: Shots, rng: np.random.Generator
) -> tuple[UInt16[np.ndarray, "v f"], list[Objects]]:
    """Half-precision features (their bits) and objects of one stage's views, and of one portrait of each of its crew.

    Pictures are disturbed and half of them mirrored. Features are kept in `folder` under `name` and read from there as they are needed.
    """
    pictures = [
        *zip(shots.rgb, shots.ids, strict=True),
        *zip(shots.portraits[::POSES], shots.portrait_ids[::POSES], strict=True),
    ]
    rgb, ids = [], []
    for view, index in pictures:
        mirrored = rng.random() < 0.5
        rgb.append(disturb(rng, view[:, ::-1] if mirrored else view))
        ids.append(index[:, ::-1] if mirrored else index)
    path = folder / f"{name}.detector.npy"
    if not path.exists():
        found = [features([resize_for_search(view)[0]], TAPS) for view in rgb]
        keep(
            path,
            np.stack(
                [
                    np.concatenate([each[tap].numpy().astype(np.float16).ravel() for tap in TAPS])
                    for each in found
                ]
            ).view(np.uint16),
        )
    return np.load(path, mmap_mode="r"), [objects_of(view, shots) for view in ids]


def keep(path: Path, rows: np.ndarray) -> None:
    """Write an array so that an interrupted run never leaves half of it."""
    part = path.with_suffix(".part.npy")
    np.save(part, rows)
    os.replace(part, path)


def taps_of(rows: Sequence[UInt16[np.ndarray, " f"]]) -> dict[str, Float[Tensor, "n c h w"]]:
    """The feature maps in rows of `featurise`."""
    flat, start, maps = torch.from_numpy(np.stack(rows).view(np.float16)).float(), 0, {}
    for tap in TAPS:
        shape = (CHANNELS[tap], SIDE // STRIDES[tap], SIDE // STRIDES[tap])
        maps[tap] = flat[:, start : start + int(np.prod(shape))].unflatten(1, shape)
        start += int(np.prod(shape))
    return maps


def objects_of(ids: UInt8[np.ndarray, "h w"], shots: Shots) -> Objects:
    cells = SIDE / max(ids.shape) / STRIDE
    return [
        (shots.categories[i], np.array(box, np.float32) * cells)
        for i, box in boxes_of(ids, len(shots.names))
    ]


def targets(
    views: Sequence[Objects], asked: Sequence[str | None], grid: int
) -> tuple[
    Float[Tensor, "n p h w"],
    Float[Tensor, "n p h w"],
    Float[Tensor, "n h w"],
    Float[Tensor, "n 4 h w"],
]:
    """Heat (1 at centres, Gaussian around), its weight (0 where ambiguous), how much a cell must know its box, and that box."""
    n, p = len(views), len(asked)
    heat, weight = np.zeros((n, p, grid, grid), np.float32), np.ones((n, p, grid, grid), np.float32)
    owns, box = np.zeros((n, grid, grid), np.float32), np.zeros((n, 4, grid, grid), np.float32)
    rows, cols = np.mgrid[0:grid, 0:grid] + 0.5
    for v, seen in enumerate(views):
        for category, (x0, y0, x1, y1) in seen:
            cx, cy = (
                int(min((x0 + x1) / 2, grid - 0.01)) + 0.5,
                int(min((y0 + y1) / 2, grid - 0.01)) + 0.5,
            )
            sx, sy = max((x1 - x0) / 6, 0.5), max((y1 - y0) / 6, 0.5)
            bump = np.exp(-((cols - cx) ** 2 / (2 * sx**2) + (rows - cy) ** 2 / (2 * sy**2)))
            mine = (bump > 0.3) & (bump > owns[v])
            owns[v][mine] = bump[mine]
            box[v][:, mine] = np.array([x0, y0, x1, y1], np.float32)[:, None]
            for q, wanted in enumerate(asked):
                if wanted == category:
                    heat[v, q] = np.maximum(heat[v, q], bump)
                elif wanted is not None and category in AMBIGUOUS.get(wanted, ()):
                    weight[v, q][(cols > x0) & (cols < x1) & (rows > y0) & (rows < y1)] = 0
    heat_t = torch.from_numpy(heat)
    return (
        heat_t,
        torch.from_numpy(np.maximum(weight, heat == 1)),
        torch.from_numpy(owns),
        torch.from_numpy(box),
    )


def focal(
    logits: Float[Tensor, "n p h w"],
    heat: Float[Tensor, "n p h w"],
    weight: Float[Tensor, "n p h w"],
) -> Tensor:
    """CenterNet's penalty-reduced focal loss, per object."""
    chance = logits.sigmoid()
    hit = (heat == 1).float()
    loss = hit * (1 - chance) ** 2 * F.logsigmoid(logits) + (1 - hit) * (
        1 - heat
    ) ** 4 * chance**2 * F.logsigmoid(-logits)
    return -(loss * weight).sum() / hit.sum().clamp(min=1)


def giou_loss(
    edges: Float[Tensor, "n 4 h w"], owns: Float[Tensor, "n h w"], box: Float[Tensor, "n 4 h w"]
) -> Tensor:
    """1 - generalised IoU between the box a cell predicts and the box it belongs to, weighted by nearness to its centre."""
    at = owns > 0
    v, r, c = torch.nonzero(at, as_tuple=True)
    centre = torch.stack([c, r], 1) + 0.5
    reach, want = edges[v, :, r, c], box[v, :, r, c]
    near, far = centre - reach[:, :2], centre + reach[:, 2:]
    both = (torch.minimum(far, want[:, 2:]) - torch.maximum(near, want[:, :2])).clamp(min=0).prod(1)
    hull = (torch.maximum(far, want[:, 2:]) - torch.minimum(near, want[:, :2])).prod(1)
    union = (far - near).prod(1) + (want[:, 2:] - want[:, :2]).prod(1) - both
    giou = both / union - (hull - union) / hull
    return ((1 - giou) * owns[at]).sum() / owns[at].sum().clamp(min=1)


def ask(
    rng: np.random.Generator, categories: Sequence[str], negatives: int = 16
) -> tuple[list[str | None], Float32[np.ndarray, "p 384"]]:
    """One phrase per category and some that name nothing, with a little noise on their embeddings."""
    asked: list[str | None] = list(categories) + [None] * negatives
    words = [str(rng.choice(training_phrases(category))) for category in categories] + [
        str(word) for word in rng.choice(NEGATIVES, negatives, replace=False)
    ]
    rows = embed_text(words) + rng.normal(0, 0.01, (len(words), 384)).astype(np.float32)
    return asked, rows / np.linalg.norm(rows, axis=1, keepdims=True)


def fit_detector(
    views: Sequence[tuple[UInt16[np.ndarray, " f"], Objects]], categories: Sequence[str], run: Run
) -> DetectHead:
    """Train the head on `views`: features, as `featurise` keeps them, and objects."""
    names = [
        *(phrase for category in categories for phrase in training_phrases(category)),
        *NEGATIVES,
    ]
    torch.manual_seed(
        run.seed
    )  # initial weights only; every other draw comes from the epoch's stream
    head = DetectHead(len(names))
    head.known.copy_(torch.from_numpy(embed_text(names)))

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        order = rng.permutation(len(views))
        for batch in range(0, len(views), BATCH):
            chosen = [views[i] for i in order[batch : batch + BATCH]]
            asked, rows = ask(rng, categories)
            with halved():
                found = head(taps_of([features for features, _ in chosen]), torch.from_numpy(rows))
            logits, edges = (part.float() for part in found)
            heat, weight, owns, box = targets([seen for _, seen in chosen], asked, logits.shape[-1])
            yield focal(logits, heat, weight) + 2 * giou_loss(edges, owns, box)

    fit(head, losses, -(-len(views) // BATCH), run)
    return head
