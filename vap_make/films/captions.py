"""Generic objects in the captioner's words: what described commands say of them.

A description is that of `AttributeCaptioner`, from reference photos as a user takes them; the
object's outline is the simulator's.
"""

import json
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vap_core.base.files import parse_json, write_atomic, writing
from vap_core.base.types import Boxes, Description, Mask, Rgb
from vap_core.perception.boxes import crop
from vap_core.perception.describe import CropAttributes, measure_crop, phrase_attributes
from vap_core.simulation.assets.objects import ObjectModel, get_object
from vap_core.simulation.studio import Stage, reference_shots
from vap_core.study.workers import results_here
from vap_make.films.scenes import only_generic
from vap_make.folder import reading_kept

VIEWS = 5
"""Photos of an object, as a user takes them."""
SIZE = 320
"""Pixels of a photo, square."""
CLAUSES = re.compile(r" with | and |, ")
"""What stands between the clauses of a description."""
AT_ONCE = 16
"""Objects that are photographed, and then kept, at a time."""


def captions(
    names: Iterable[str], file: Path, jobs: int = 1
) -> tuple[dict[str, Description], float]:
    """The descriptions of generic objects, and the CPU seconds that they took.

    Those that `file` lacks are made, in `jobs` processes, and kept there, so that an earlier call
    goes on.

    Raises: BadOutput when `file` is damaged or cannot be written.
    """
    from tqdm import tqdm

    kept: dict[str, Any] = {"cpu_s": 0.0, "captions": {}}
    if file.exists():
        with reading_kept(file, "train"):
            found = parse_json(file.read_bytes())
            kept = {"cpu_s": float(found["cpu_s"]), "captions": dict(found["captions"])}
    missing = sorted(set(names) - set(kept["captions"]))
    batches = [tuple(missing[i : i + AT_ONCE]) for i in range(0, len(missing), AT_ONCE)]
    work = results_here(_describe_some, batches, workers=jobs, remedy="jobs")
    for _, (made, cpu_s) in tqdm(work, desc="descriptions", total=len(batches), mininterval=10):
        kept["captions"].update(made)
        kept["cpu_s"] += cpu_s
        with writing(file, "train"):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, json.dumps(kept, indent=0).encode())
    described = {}
    for name in names:
        short, long = kept["captions"][name]
        described[name] = Description(short, long)
    return described, kept["cpu_s"]


def describe(models: Sequence[ObjectModel]) -> dict[str, Description]:
    """The captioner's description of every object, by name."""
    described = {}
    with Stage(models, SIZE) as studio:
        for model in models:
            measured = []
            for shot in reference_shots(model, VIEWS, 0):
                rgb = studio.picture(model.name, shot)
                measured.append(_measure(rgb, studio.mask(model.name, shot)))
            described[model.name] = phrase_attributes(measured, model.category)
    return described


def distinguishes(described: Mapping[str, Description], names: Sequence[str], length: str) -> bool:
    """Whether the description of names[0] has a clause that each other's description lacks.

    `length` is "short" or "long".
    """
    clauses = [set(CLAUSES.split(getattr(described[name], length))) for name in names]
    return all(clauses[0] - others for others in clauses[1:])


def _describe_some(names: Sequence[str]) -> tuple[dict[str, tuple[str, str]], float]:
    """The short and long descriptions of objects, and the CPU seconds that they took."""
    started = time.process_time()
    models = [get_object(name) for name in names]
    only_generic(models)
    made = {}
    for name, described in describe(models).items():
        made[name] = (described.short, described.long)
    return made, time.process_time() - started


def _measure(rgb: Rgb, mask: Mask) -> CropAttributes:
    """The attributes of a photo's object, whose outline is known."""
    rows, columns = np.nonzero(mask)
    box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
    outline = crop(np.repeat(mask[..., None].astype(np.uint8), 3, axis=2), box)

    def known(image: Rgb, boxes: Boxes) -> np.ndarray:
        height, width = image.shape[:2]
        scaled = cv2.resize(outline, (width, height), interpolation=cv2.INTER_NEAREST)
        return scaled[None, ..., 0] > 0

    return measure_crop(crop(rgb, box), known)
