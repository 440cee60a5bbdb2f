"""Training the detector's head on frozen features.

Features are computed once per view. The losses are CenterNet's focal loss and a box loss (GIoU).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8, UInt16
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vap_core.base.files import replacing, writing
from vap_core.base.types import Rgb
from vap_core.perception.embedded.networks import CHANNELS
from vap_core.perception.embedded.networks import STRIDE as STRIDES
from vap_core.perception.embedded.proposer import SIDE, STRIDE, TAPS, resize_for_search
from vap_core.perception.text_encoder import embed_text
from vap_core.simulation.assets.phrases import AMBIGUOUS
from vap_make.films.scenes import POSES, Shots, boxes_of
from vap_make.perception.backbone import features
from vap_make.perception.fitting import Run, fit, half_precision
from vap_make.perception.graphs import DetectHead
from vap_make.perception.phrases import NEGATIVES, training_phrases

BATCH = 16
N_NEGATIVES = 16
Objects = list[tuple[str, np.ndarray]]
"""Category and box, `x0 y0 x1 y1` in cells, of every object in a view."""


def augment(rng: np.random.Generator, rgb: Rgb) -> Rgb:
    """Other exposure, tint, blur and sensor noise, so that no renderer's style is learned."""
    pixels: np.ndarray = rgb.astype(np.float32)
    contrast = rng.uniform(0.75, 1.25)
    brightness = rng.uniform(-25, 25)
    pixels = (pixels - 127) * contrast + 127 + brightness + rng.normal(0, 6, 3)
    if rng.random() < 0.3:
        sigma = float(rng.uniform(0.3, 1.0))
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma)
    if rng.random() < 0.5:
        deviation = rng.uniform(1, 7)
        pixels = pixels + rng.normal(0, deviation, pixels.shape)
    return np.clip(pixels, 0, 255).astype(np.uint8)


def featurise(
    folder: Path, name: str, shots: Shots, rng: np.random.Generator
) -> tuple[UInt16[np.ndarray, "v f"], list[Objects]]:
    """Half-precision features (their bits) and objects of one stage's pictures.

    They are the stage's views, and one portrait of each member of its crew. Pictures are augmented
    and half of them mirrored. Features are kept in `folder` under `name` and read from there as
    they are needed.
    """
    views = zip(shots.rgb, shots.ids, strict=True)
    portraits = zip(shots.portraits[::POSES], shots.portrait_ids[::POSES], strict=True)
    pictures: list[Rgb] = []
    seen: list[Objects] = []
    for rgb, ids in (*views, *portraits):
        if rng.random() < 0.5:
            rgb = rgb[:, ::-1]
            ids = ids[:, ::-1]
        pictures.append(augment(rng, rgb))
        seen.append(objects_of(ids, shots))
    path = folder / f"{name}.detector.npy"
    if not path.exists():
        rows = []
        for picture in pictures:
            rows.append(_flatten_features(picture))
        save_array(path, np.stack(rows).view(np.uint16))
    return np.load(path, mmap_mode="r"), seen


def save_array(path: Path, array: np.ndarray) -> None:
    """Write an array so that an interrupted run never leaves half of it. Raises: BadOutput."""
    with writing(path, "train perception"), replacing(path) as part, part.open("wb") as file:
        np.save(file, array)


def stack_taps(rows: Sequence[UInt16[np.ndarray, " f"]]) -> dict[str, Float[Tensor, "n c h w"]]:
    """The feature maps in rows of `featurise`, by tap."""
    flat = torch.from_numpy(np.stack(rows).view(np.float16)).float()
    start = 0
    maps = {}
    for tap in TAPS:
        side = SIDE // STRIDES[tap]
        size = CHANNELS[tap] * side * side
        maps[tap] = flat[:, start : start + size].unflatten(1, (CHANNELS[tap], side, side))
        start += size
    return maps


def objects_of(ids: UInt8[np.ndarray, "h w"], shots: Shots) -> Objects:
    """The objects of a picture, with their boxes in cells."""
    cells = SIDE / max(ids.shape) / STRIDE
    objects = []
    for i, box in boxes_of(ids, len(shots.names)):
        objects.append((shots.categories[i], np.array(box, np.float32) * cells))
    return objects


def targets(
    views: Sequence[Objects], asked: Sequence[str | None], grid: int
) -> tuple[
    Float[Tensor, "n p h w"],
    Float[Tensor, "n p h w"],
    Float[Tensor, "n h w"],
    Float[Tensor, "n 4 h w"],
]:
    """Heat, its weight, how much each cell must know its box, and that box.

    Heat is 1 at the centres of what is asked for and Gaussian around them; its weight is 0 where
    it is ambiguous. `asked` is a category, or None for a phrase that names nothing.
    """
    n = len(views)
    heat = np.zeros((n, len(asked), grid, grid), np.float32)
    weight = np.ones((n, len(asked), grid, grid), np.float32)
    owns = np.zeros((n, grid, grid), np.float32)
    boxes = np.zeros((n, 4, grid, grid), np.float32)
    rows, cols = np.mgrid[0:grid, 0:grid] + 0.5
    for v, seen in enumerate(views):
        for category, box in seen:
            x0, y0, x1, y1 = box
            gaussian = _draw_gaussian(rows, cols, box)
            own = (gaussian > 0.3) & (gaussian > owns[v])
            owns[v][own] = gaussian[own]
            boxes[v][:, own] = np.array([x0, y0, x1, y1], np.float32)[:, None]
            inside = (cols > x0) & (cols < x1) & (rows > y0) & (rows < y1)
            for q, wanted in enumerate(asked):
                if wanted == category:
                    heat[v, q] = np.maximum(heat[v, q], gaussian)
                elif wanted is not None and category in AMBIGUOUS.get(wanted, ()):
                    weight[v, q][inside] = 0
    weight = np.maximum(weight, heat == 1)
    return (
        torch.from_numpy(heat),
        torch.from_numpy(weight),
        torch.from_numpy(owns),
        torch.from_numpy(boxes),
    )


def focal_loss(
    logits: Float[Tensor, "n p h w"],
    heat: Float[Tensor, "n p h w"],
    weight: Float[Tensor, "n p h w"],
) -> Tensor:
    """CenterNet's penalty-reduced focal loss, per object."""
    chance = logits.sigmoid()
    hit = (heat == 1).float()
    at_centres = hit * (1 - chance) ** 2 * F.logsigmoid(logits)
    elsewhere = (1 - hit) * (1 - heat) ** 4 * chance**2 * F.logsigmoid(-logits)
    loss = at_centres + elsewhere
    return -(loss * weight).sum() / hit.sum().clamp(min=1)


def giou_loss(
    edges: Float[Tensor, "n 4 h w"], owns: Float[Tensor, "n h w"], box: Float[Tensor, "n 4 h w"]
) -> Tensor:
    """1 - generalised IoU between the box a cell predicts and the box it belongs to.

    Cells are weighted by their nearness to the centre of that box.
    """
    owned = owns > 0
    v, r, c = torch.nonzero(owned, as_tuple=True)
    centre = torch.stack([c, r], 1) + 0.5
    reach = edges[v, :, r, c]
    wanted = box[v, :, r, c]
    low = centre - reach[:, :2]
    high = centre + reach[:, 2:]
    wanted_low = wanted[:, :2]
    wanted_high = wanted[:, 2:]
    shared_sides = torch.minimum(high, wanted_high) - torch.maximum(low, wanted_low)
    shared = shared_sides.clamp(min=0).prod(1)
    hull = (torch.maximum(high, wanted_high) - torch.minimum(low, wanted_low)).prod(1)
    union = (high - low).prod(1) + (wanted_high - wanted_low).prod(1) - shared
    giou = shared / union - (hull - union) / hull
    weight = owns[owned]
    return ((1 - giou) * weight).sum() / weight.sum().clamp(min=1)


def sample_phrases(
    rng: np.random.Generator, categories: Sequence[str]
) -> tuple[list[str | None], Float32[np.ndarray, "p 384"]]:
    """One phrase per category and N_NEGATIVES that name nothing.

    What each names, and its embedding, which carries a little noise.

    Raises: MissingWeights, as `embed_text`.
    """
    asked: list[str | None] = [*categories]
    asked += [None] * N_NEGATIVES
    phrases = []
    for category in categories:
        phrases.append(str(rng.choice(training_phrases(category))))
    for phrase in rng.choice(NEGATIVES, N_NEGATIVES, replace=False):
        phrases.append(str(phrase))
    noise = rng.normal(0, 0.01, (len(phrases), 384)).astype(np.float32)
    rows = embed_text(phrases) + noise
    return asked, rows / np.linalg.norm(rows, axis=1, keepdims=True)


def fit_detector(
    views: Sequence[tuple[UInt16[np.ndarray, " f"], Objects]], categories: Sequence[str], run: Run
) -> DetectHead:
    """Train the head on `views`: features, as `featurise` keeps them, and objects.

    Raises: BadOutput, as `fit`; MissingWeights, as `embed_text`.
    """
    phrases: list[str] = []
    for category in categories:
        phrases += training_phrases(category)
    phrases += NEGATIVES
    # Initial weights only; every other draw comes from the epoch's stream.
    torch.manual_seed(run.seed)
    head = DetectHead(len(phrases))
    head.known.copy_(torch.from_numpy(embed_text(phrases)))

    def losses(rng: np.random.Generator) -> Iterator[Tensor]:
        order = rng.permutation(len(views))
        for first in range(0, len(views), BATCH):
            maps: list[np.ndarray] = []
            seen: list[Objects] = []
            for i in order[first : first + BATCH]:
                view_features, view_objects = views[i]
                maps.append(view_features)
                seen.append(view_objects)
            asked, rows = sample_phrases(rng, categories)
            with half_precision():
                logits, edges = head(stack_taps(maps), torch.from_numpy(rows))
            logits = logits.float()
            edges = edges.float()
            heat, weight, owns, box = targets(seen, asked, logits.shape[-1])
            yield focal_loss(logits, heat, weight) + 2 * giou_loss(edges, owns, box)

    batches = -(-len(views) // BATCH)
    fit(head, losses, batches, run)
    return head


def _flatten_features(picture: Rgb) -> np.ndarray:
    """The features of a picture in one row, in half precision."""
    resized, _ = resize_for_search(picture)
    maps = features([resized], TAPS)
    parts = []
    for tap in TAPS:
        parts.append(maps[tap].numpy().astype(np.float16).ravel())
    return np.concatenate(parts)


def _draw_gaussian(rows: np.ndarray, cols: np.ndarray, box: np.ndarray) -> np.ndarray:
    """1 at the cell of a box's centre, falling with the box's size; `rows`, `cols` are cells."""
    x0, y0, x1, y1 = box
    grid = len(rows)
    centre_x = int(min((x0 + x1) / 2, grid - 0.01)) + 0.5
    centre_y = int(min((y0 + y1) / 2, grid - 0.01)) + 0.5
    sigma_x = max((x1 - x0) / 6, 0.5)
    sigma_y = max((y1 - y0) / 6, 0.5)
    across = (cols - centre_x) ** 2 / (2 * sigma_x**2)
    down = (rows - centre_y) ** 2 / (2 * sigma_y**2)
    return np.exp(-(across + down))
