"""Train the embedded detector and segmenter: render generic objects, fit both heads on frozen features, test on unseen instances.

    python -m vap_core train perception --out data/runs/weights --scenes 4000 --seed 0

Everything lands in data/cache/perception and is found again after an interruption: stages, features, and both heads after each epoch.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from vap_core.sim import objects
from vap_core.training import detector, segmenter
from vap_core.training.scenes import VIEWS, Shots, cached, only_generic
from vap_core.weights import save_weights

CACHE = Path(__file__).resolve().parents[2] / "data" / "cache" / "perception"
FILE = "perception.safetensors"
HELD_OUT_STAGES = 30
DETECTOR_EPOCHS, SEGMENTER_EPOCHS, CROPS_PER_EPOCH = 8, 6, 8000


def train(out: Path, *, scenes: int = 4000, seed: int = 0, minutes: float | None = None, resume: bool = True, cache: Path = CACHE) -> dict[str, Any]:
    """Train both heads on about `scenes` rendered views, write `out`/perception.safetensors and its manifest entry, return the entry.

    `minutes` stops training after the epoch that runs then; `resume` off forgets earlier epochs but keeps the rendered stages.
    """
    from vap_core.training.evaluation import evaluate

    started = time.monotonic()

    def expired() -> bool:
        return minutes is not None and time.monotonic() - started > 60 * minutes

    stages = list(load_stages(cache, seed, -(-scenes // VIEWS)))
    detect = detector.fit_detector(
        load_features(cache, seed, stages), objects.CATEGORIES + objects.CLUTTER, seed=seed, epochs=DETECTOR_EPOCHS, expired=expired,
        **checkpoint(cache / f"detector-{seed}-{len(stages)}.pt", resume),
    )  # fmt: skip
    segment = segmenter.fit_segmenter(
        stages, seed=seed, epochs=SEGMENTER_EPOCHS, crops_per_epoch=CROPS_PER_EPOCH, expired=expired,
        **checkpoint(cache / f"segmenter-{seed}-{len(stages)}.pt", resume),
    )  # fmt: skip
    unseen = list(load_stages(cache, seed, min(HELD_OUT_STAGES, max(1, len(stages) // 10)), held_out=True))
    tensors = {f"detect.{key}": value for key, value in detect.state_dict().items()} | {
        f"segment.{key}": value for key, value in segment.state_dict().items()
    }
    about = {
        "command": f"python -m vap_core train perception --scenes {scenes} --seed {seed}",
        "trained_on": f"{sum(len(s.rgb) for s in stages)} views of generic objects in {len(stages)} rendered scenes; no evaluation object",
        "seed": seed,
        "views": sum(len(s.rgb) for s in stages),
        "measured": evaluate(detect, segment, unseen),
    }
    save_weights(FILE, tensors, about, out)
    return about


def load_stages(cache: Path, seed: int, n: int, *, held_out: bool = False) -> Iterator[Shots]:
    """The first n stages, rendered where they are missing; refuses any that shows an object of the evaluation."""
    for number in tqdm(range(n), desc="held-out scenes" if held_out else "scenes", mininterval=10):
        shots = cached(cache, seed, number, held_out=held_out)
        only_generic([objects.get(name) for name in shots.names])
        yield shots


def load_features(cache: Path, seed: int, stages: Sequence[Shots]) -> list[tuple[dict[str, np.ndarray], detector.Objects]]:
    """Per view, its frozen features and its objects."""
    views = []
    for number, shots in enumerate(tqdm(stages, desc="features", mininterval=10)):
        taps, seen = detector.featurise(cache, f"train-{seed}-{number:05d}", shots, np.random.default_rng([seed, 3, number]))
        views += [({tap: maps[v] for tap, maps in taps.items()}, seen[v]) for v in range(len(seen))]
    return views


def checkpoint(path: Path, resume: bool) -> dict[str, Any]:
    """`state`, what an interrupted run left at `path` or nothing, and `save`, which replaces it atomically."""

    def save(state: dict[str, Any]) -> None:
        part = path.with_suffix(".part")
        torch.save(state, part)
        os.replace(part, path)

    keep: Callable[[dict[str, Any]], None] = save
    return {"state": torch.load(path, weights_only=True) if resume and path.exists() else {}, "save": keep}
