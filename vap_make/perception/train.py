"""Train the embedded stack's heads on rendered generic objects.

    ./vap train perception --out data/runs/weights --scenes 6480 --seed 0

Detector, segmenter and instance head are fitted to frozen features and tested on unseen instances.
Everything is kept in data/cache/perception and found again after an interruption: stages, features,
and each head after every epoch.
"""

import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from vap_core.base.files import kept_folder, make_folder, writing
from vap_core.perception.embedded.networks import PERCEPTION
from vap_core.simulation.assets import objects
from vap_core.study.workers import results
from vap_make.films.scenes import VIEWS, Shots, cached, only_generic, stage_file
from vap_make.perception import detector, instance_head, segmenter
from vap_make.perception.backbone import save_weights
from vap_make.perception.fitting import Run
from vap_make.perception.graphs import export_graphs, require_onnx

CACHE = kept_folder("cache") / "perception"
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
) -> dict[str, Any] | None:
    """Train the heads on about `scenes` rendered views; returns the manifest's entry.

    Writes `out`/perception.safetensors, the networks' graphs, and their manifest entries. `minutes`
    stops training after the epoch that runs then: where that is not the last, nothing is written or
    returned, and the same call goes on. `resume` off forgets earlier epochs but keeps the rendered
    stages. `jobs` processes (all cores) render.

    Raises: MissingWeights: `onnx`, which writes the graphs, is not installed; BadOutput: `out`
        or `cache` cannot be written.
    """
    from vap_make.perception.evaluation import evaluate

    require_onnx()
    make_folder(out, "train perception")
    make_folder(cache, "train perception", "choose another folder with --cache")
    started = time.monotonic()
    halted = False

    def expired() -> bool:
        """Whether to leave out the epochs that are left; asked where there are some."""
        nonlocal halted
        halted = minutes is not None and time.monotonic() - started > 60 * minutes
        return halted

    def run(name: str, rate: float, decay: float) -> Run:
        return Run(
            name=name,
            seed=seed,
            epochs=EPOCHS[name],
            rate=rate,
            decay=decay,
            file=cache / f"{name}-{seed}-{n}.pt",
            resume=resume,
            expired=expired,
        )

    n = -(-scenes // VIEWS)
    stages = prepare(cache, seed, n, jobs=jobs)
    views, crops = _load_features(cache, seed, stages)
    categories = objects.CATEGORIES + objects.CLUTTER
    detect = detector.fit_detector(views, categories, run("detector", 2e-3, 1e-3))
    look = instance_head.fit_instance_head(crops, run("looks", 2e-3, 1e-2))
    segment = segmenter.fit_segmenter(stages, CROPS_PER_EPOCH, run("segmenter", 2e-3, 1e-4))
    if halted:
        return None
    n_held_out = min(HELD_OUT_STAGES, max(1, n // 10))
    unseen = prepare(cache, seed, n_held_out, held_out=True, jobs=jobs)
    about = _describe_training(scenes, seed, stages)
    about["measured"] = evaluate(detect, segment, look, unseen)
    tensors = _name_tensors({"detect": detect, "look": look, "segment": segment})
    with writing(out, "train perception"):
        save_weights(PERCEPTION, tensors, about, out)
        export_graphs(out)
    return about


def prepare(
    cache: Path, seed: int, n: int, *, held_out: bool = False, jobs: int | None = None
) -> list[Shots]:
    """The first n stages with their features, rendered where they are missing.

    Raises: ValueError for a stage that shows an object of the evaluation.
    """
    missing = []
    for number in range(n):
        if not _is_ready(cache, seed, number, held_out):
            missing.append(number)
    if missing:
        work = partial(_prepare, cache, seed, held_out)
        finished = results(work, missing, jobs or os.cpu_count() or 1, "jobs")
        title = "held-out scenes" if held_out else "scenes"
        for _ in tqdm(finished, title, len(missing), mininterval=10):
            pass
    stages = []
    for number in range(n):
        stages.append(cached(cache, seed, number, held_out=held_out))
    for shots in stages:
        only_generic([objects.get_object(name) for name in shots.names])
    return stages


def detector_views(
    cache: Path, seed: int, number: int, shots: Shots
) -> Sequence[tuple[np.ndarray, detector.Objects]]:
    """Per picture of a stage, its frozen features and its objects."""
    rng = stream(seed, number, "detector")
    rows, seen = detector.featurise(cache, _stage_name(seed, number), shots, rng)
    return list(zip(rows, seen, strict=True))


def instance_crops(cache: Path, seed: int, number: int, shots: Shots) -> instance_head.StageCrops:
    """The crops of a stage, with their frozen features."""
    rng = stream(seed, number, "looks")
    return instance_head.featurise(cache, _stage_name(seed, number), shots, rng)


def stream(seed: int, number: int, part: str) -> np.random.Generator:
    """The randomness of one part of one stage."""
    return np.random.default_rng([seed, *part.encode(), number])


def _load_features(
    cache: Path, seed: int, stages: Sequence[Shots]
) -> tuple[list[tuple[np.ndarray, detector.Objects]], list[instance_head.StageCrops]]:
    """The detector's views of all stages, and the crops of each."""
    views: list[tuple[np.ndarray, detector.Objects]] = []
    crops = []
    for number, shots in enumerate(stages):
        views += detector_views(cache, seed, number, shots)
        crops.append(instance_crops(cache, seed, number, shots))
    return views, crops


def _describe_training(scenes: int, seed: int, stages: Sequence[Shots]) -> dict[str, Any]:
    """What the manifest says of the training."""
    n_views = sum(len(shots.rgb) for shots in stages)
    return {
        "command": f"./vap train perception --scenes {scenes} --seed {seed}",
        "trained_on": f"{n_views} views of generic objects in {len(stages)} rendered scenes, "
        "and portraits; no evaluation object",
        "seed": seed,
        "views": n_views,
    }


def _name_tensors(heads: dict[str, nn.Module]) -> dict[str, torch.Tensor]:
    """The tensors of all heads, as the weight file names them."""
    tensors = {}
    for part, head in heads.items():
        for key, tensor in head.state_dict().items():
            tensors[f"{part}.{key}"] = tensor
    return tensors


def _stage_name(seed: int, number: int, held_out: bool = False) -> str:
    """The name of a stage's files, without their endings."""
    return stage_file(Path(), seed, number, held_out).stem


def _is_ready(cache: Path, seed: int, number: int, held_out: bool) -> bool:
    """Whether a stage is rendered; a training stage needs its features as well."""
    name = _stage_name(seed, number, held_out)
    endings = [".npz"]
    if not held_out:
        endings += [".detector.npy", ".looks.npy", ".pixels.npy"]
    return all((cache / f"{name}{ending}").exists() for ending in endings)


def _prepare(cache: Path, seed: int, held_out: bool, number: int) -> None:
    torch.set_num_threads(1)
    shots = cached(cache, seed, number, held_out=held_out)
    if not held_out:
        detector_views(cache, seed, number, shots)
        instance_crops(cache, seed, number, shots)
