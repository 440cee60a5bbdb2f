"""Training the detector's head: frozen features once per view, then CenterNet's focal loss and a box loss (GIoU) on them."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812
from tqdm import tqdm

from vap_core.detect import SIDE, STRIDE, TAPS, DetectHead, enlarge
from vap_core.features import features
from vap_core.text import embed_text
from vap_core.training.phrases import AMBIGUOUS, NEGATIVES, phrases
from vap_core.training.scenes import Shots, boxes_of
from vap_core.values import Rgb

BATCH, RATE = 16, 2e-3
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


def featurise(folder: Path, name: str, shots: Shots, rng: np.random.Generator) -> tuple[dict[str, np.ndarray], list[Objects]]:
    """Half-precision features of one stage's views, disturbed and half of them mirrored; cached in `folder` under `name`."""
    rgb, ids = [], []
    for view, index in zip(shots.rgb, shots.ids, strict=True):
        mirrored = rng.random() < 0.5
        rgb.append(disturb(rng, view[:, ::-1] if mirrored else view))
        ids.append(index[:, ::-1] if mirrored else index)
    path = folder / f"{name}.features.npz"
    if not path.exists():
        found = features([enlarge(view)[0] for view in rgb], TAPS)
        part = path.with_suffix(".part.npz")
        np.savez(part, **{tap: value.numpy().astype(np.float16) for tap, value in found.items()})  # type: ignore[arg-type]
        os.replace(part, path)
    with np.load(path) as file:
        return {tap: file[tap] for tap in TAPS}, [objects_of(view, shots) for view in ids]


def objects_of(ids: UInt8[np.ndarray, "h w"], shots: Shots) -> Objects:
    cells = SIDE / max(ids.shape) / STRIDE
    return [(shots.categories[i], np.array(box, np.float32) * cells) for i, box in boxes_of(ids, len(shots.names))]


def targets(
    views: Sequence[Objects], asked: Sequence[str | None], grid: int
) -> tuple[Float[Tensor, "n p h w"], Float[Tensor, "n p h w"], Float[Tensor, "n h w"], Float[Tensor, "n 4 h w"]]:
    """Heat (1 at centres, Gaussian around), its weight (0 where ambiguous), how much a cell must know its box, and that box."""
    n, p = len(views), len(asked)
    heat, weight = np.zeros((n, p, grid, grid), np.float32), np.ones((n, p, grid, grid), np.float32)
    owns, box = np.zeros((n, grid, grid), np.float32), np.zeros((n, 4, grid, grid), np.float32)
    rows, cols = np.mgrid[0:grid, 0:grid] + 0.5
    for v, seen in enumerate(views):
        for category, (x0, y0, x1, y1) in seen:
            cx, cy = int(min((x0 + x1) / 2, grid - 0.01)) + 0.5, int(min((y0 + y1) / 2, grid - 0.01)) + 0.5
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
    return heat_t, torch.from_numpy(np.maximum(weight, heat == 1)), torch.from_numpy(owns), torch.from_numpy(box)


def focal(logits: Float[Tensor, "n p h w"], heat: Float[Tensor, "n p h w"], weight: Float[Tensor, "n p h w"]) -> Tensor:
    """CenterNet's penalty-reduced focal loss, per object."""
    chance = logits.sigmoid()
    hit = (heat == 1).float()
    loss = hit * (1 - chance) ** 2 * F.logsigmoid(logits) + (1 - hit) * (1 - heat) ** 4 * chance**2 * F.logsigmoid(-logits)
    return -(loss * weight).sum() / hit.sum().clamp(min=1)


def giou_loss(edges: Float[Tensor, "n 4 h w"], owns: Float[Tensor, "n h w"], box: Float[Tensor, "n 4 h w"]) -> Tensor:
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


def ask(rng: np.random.Generator, categories: Sequence[str], negatives: int = 10) -> tuple[list[str | None], Float32[np.ndarray, "p 384"]]:
    """One phrase per category and some that name nothing, with a little noise on their embeddings."""
    asked: list[str | None] = list(categories) + [None] * negatives
    words = [str(rng.choice(phrases(category))) for category in categories] + [str(word) for word in rng.choice(NEGATIVES, negatives, replace=False)]
    rows = embed_text(words) + rng.normal(0, 0.01, (len(words), 384)).astype(np.float32)
    return asked, rows / np.linalg.norm(rows, axis=1, keepdims=True)


def fit_detector(
    views: list[tuple[dict[str, np.ndarray], Objects]], categories: Sequence[str], *, seed: int, epochs: int,
    state: dict[str, Any], save: Callable[[dict[str, Any]], None], expired: Callable[[], bool],
) -> DetectHead:  # fmt: skip
    """Train the head on `views` (features and objects); `state` holds what an earlier run saved, `save` keeps each epoch."""
    names = [phrase for category in categories for phrase in phrases(category)]
    torch.manual_seed(seed)  # initial weights only; every other draw comes from rng
    head = DetectHead(len(names))
    head.known.copy_(torch.from_numpy(embed_text(names)))
    optimiser = torch.optim.AdamW(head.parameters(), RATE, weight_decay=1e-3)
    start = 0
    if state:
        head.load_state_dict(state["head"])
        optimiser.load_state_dict(state["optimiser"])
        start = state["epoch"]
    per_epoch = -(-len(views) // BATCH)
    for epoch in range(start, epochs):
        if expired():
            break
        rng = np.random.default_rng([seed, 1, epoch])
        total = 0.0
        order = rng.permutation(len(views))
        bar = tqdm(range(per_epoch), desc=f"detector {epoch + 1}/{epochs}", mininterval=10)
        for batch in bar:
            done = (epoch * per_epoch + batch) / (epochs * per_epoch)
            for group in optimiser.param_groups:
                group["lr"] = float(RATE * min(1.0, done * 50 + 0.05) * 0.5 * (1 + np.cos(np.pi * done)))
            chosen = [views[i] for i in order[batch * BATCH : (batch + 1) * BATCH]]
            taps = {tap: torch.from_numpy(np.stack([view[0][tap] for view in chosen])).float() for tap in TAPS}
            asked, rows = ask(rng, categories)
            logits, edges = head(taps, torch.from_numpy(rows))
            heat, weight, owns, box = targets([view[1] for view in chosen], asked, logits.shape[-1])
            loss = focal(logits, heat, weight) + 2 * giou_loss(edges, owns, box)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(head.parameters(), 5.0)
            optimiser.step()
            total += loss.item()
            bar.set_postfix(loss=f"{total / (batch + 1):.3f}", refresh=False)
        save({"head": head.state_dict(), "optimiser": optimiser.state_dict(), "epoch": epoch + 1, "loss": total / per_epoch})
    return head
