"""Train the embedded stack's heads: render generic objects, fit detector, segmenter and look head on frozen features, test on unseen instances.

    python -m vap_core train perception --out data/runs/weights --scenes 6480 --seed 0

Everything lands in data/cache/perception and is found again after an interruption: stages, features, and each head after every epoch.
"""

import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from vap_core.base.files import DATA
from vap_core.evaluation.processes import results
from vap_core.perception.embedded.weights import save_weights
from vap_core.simulation.assets import objects
from vap_core.training.films.scenes import VIEWS, Shots, cached, only_generic
from vap_core.training.perception import detector, segmenter
from vap_core.training.perception import instance_head as looks
from vap_core.training.perception.fitting import Run, checkpoint

CACHE = DATA / "cache" / "perception"
FILE = "perception.safetensors"
HELD_OUT_STAGES = 30
EPOCHS = {"detector": 6, "segmenter": 6, "looks": 40}
CROPS_PER_EPOCH = 8000


def train(
    out: Path,
    *,
    scenes: int = 6480,
    seed: int = 0,
    minutes: float | None = None,
    resume: bool = True,
    cache: Path = CACHE,
    jobs: int | None = None,
) -> dict[str, Any]:
    """Train the heads on about `scenes` rendered views, write `out`/perception.safetensors and its manifest entry, return the entry.

    `minutes` stops training after the epoch that runs then; `resume` off forgets earlier epochs but keeps the rendered stages. `jobs`
    processes (all cores) render.
    """
    from vap_core.training.perception.evaluation import evaluate

    started = time.monotonic()

    def run(name: str, rate: float, decay: float) -> Run:
        def expired() -> bool:
            return minutes is not None and time.monotonic() - started > 60 * minutes

        return Run(
            name,
            seed,
            EPOCHS[name],
            rate,
            decay,
            *checkpoint(cache / f"{name}-{seed}-{n}.pt", resume),
            expired,
        )

    n = -(-scenes // VIEWS)
    stages = prepare(cache, seed, n, jobs=jobs)
    views = [
        view
        for number, shots in enumerate(stages)
        for view in detector_views(cache, seed, number, shots)
    ]
    kept = [looks_of(cache, seed, number, shots) for number, shots in enumerate(stages)]
    detect = detector.fit_detector(
        views, objects.CATEGORIES + objects.CLUTTER, run("detector", 2e-3, 1e-3)
    )
    look = looks.fit_looks(kept, run("looks", 2e-3, 1e-2))
    segment = segmenter.fit_segmenter(stages, CROPS_PER_EPOCH, run("segmenter", 2e-3, 1e-4))
    unseen = prepare(cache, seed, min(HELD_OUT_STAGES, max(1, n // 10)), held_out=True, jobs=jobs)
    about = {
        "command": f"python -m vap_core train perception --scenes {scenes} --seed {seed}",
        "trained_on": f"{sum(len(s.rgb) for s in stages)} views of generic objects in {n} rendered scenes, and portraits; no evaluation object",
        "seed": seed,
        "views": sum(len(s.rgb) for s in stages),
        "measured": evaluate(detect, segment, look, unseen),
    }
    heads = {"detect": detect, "look": look, "segment": segment}
    save_weights(
        FILE,
        {
            f"{part}.{key}": value
            for part, head in heads.items()
            for key, value in head.state_dict().items()
        },
        about,
        out,
    )
    return about


def prepare(
    cache: Path, seed: int, n: int, *, held_out: bool = False, jobs: int | None = None
) -> list[Shots]:
    """The first n stages with their features, rendered where they are missing; refuses any that shows an object of the evaluation."""
    todo = [number for number in range(n) if not _ready(cache, seed, number, held_out)]
    if todo:
        work = results(
            partial(_prepare, cache, seed, held_out), todo, jobs or os.cpu_count() or 1, "jobs"
        )
        list(tqdm(work, "held-out scenes" if held_out else "scenes", len(todo), mininterval=10))
    stages = [cached(cache, seed, number, held_out=held_out) for number in range(n)]
    for shots in stages:
        only_generic([objects.get_object(name) for name in shots.names])
    return stages


def _ready(cache: Path, seed: int, number: int, held_out: bool) -> bool:
    name = f"{'held' if held_out else 'train'}-{seed}-{number:05d}"
    return all(
        (cache / f"{name}{kind}").exists()
        for kind in (
            (".npz",) if held_out else (".npz", ".detector.npy", ".looks.npy", ".pixels.npy")
        )
    )


def _prepare(cache: Path, seed: int, held_out: bool, number: int) -> None:
    torch.set_num_threads(1)
    shots = cached(cache, seed, number, held_out=held_out)
    if not held_out:
        detector_views(cache, seed, number, shots)
        looks_of(cache, seed, number, shots)


def detector_views(
    cache: Path, seed: int, number: int, shots: Shots
) -> Sequence[tuple[np.ndarray, detector.Objects]]:
    """Per picture of a stage, its frozen features and its objects."""
    rows, seen = detector.featurise(
        cache, f"train-{seed}-{number:05d}", shots, stream(seed, number, "detector")
    )
    return list(zip(rows, seen, strict=True))


def looks_of(cache: Path, seed: int, number: int, shots: Shots) -> looks.Looks:
    """The crops of a stage, with their frozen features."""
    return looks.featurise(
        cache, f"train-{seed}-{number:05d}", shots, stream(seed, number, "looks")
    )


def stream(seed: int, number: int, part: str) -> np.random.Generator:
    """The randomness of one part of one stage."""
    return np.random.default_rng([seed, *part.encode(), number])
