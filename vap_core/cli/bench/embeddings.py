"""What comparing two tables of word embeddings of PaliGemma's size costs, on random numbers.

The tables are written as a checkpoint holds them, in bfloat16, and read in blocks. The second is
the first with noise, so that the cosines are about the paper's: pi0's, or pi0.5's.
"""

import json
import resource
import struct
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vap_core.analysis.embedding_search import BLOCK
from vap_core.analysis.embedding_space import compare
from vap_core.cli.bench.measurement import Measurement, Table, provenance
from vap_core.evaluation import processes
from vap_core.policies.embedding_table import open_table

SIZE = (257_152, 2_048)
QUICK = (9_000, 128)
NAME = "language_model.embed_tokens.weight"
NOISE = {"as pi0": 0.0014, "as pi0.5": 0.344}
"""Noise over signal: cosines of 0.999999 and 0.9456."""
LIMIT_GB = 4.0
"""Target of the peak memory."""


def measure(quick: bool = False) -> Measurement:
    """Compare random tables; about ten minutes of one core and 2 GB of disk, `quick` seconds.

    Raises: WorkerDied.
    """
    size = QUICK if quick else SIZE
    found = []
    for label, noise in NOISE.items():
        # A fresh process, so that its peak is the comparison's.
        plan = (size, noise)
        _, values = next(processes.results(_compare, [plan], workers=1, remedy="--quick"))
        found.append({"label": label, "noise": noise, **values})
    about = provenance(
        "python -m vap_core bench embeddings",
        n="one comparison a row",
        seed=0,
        clock="CPU time of one process, one thread",
    )
    return Measurement("embeddings", about, {"size": list(size), "tables": found})


def tables(measurement: Measurement) -> list[Table]:
    """What every comparison takes, and what it finds."""
    rows = [["tables", "size", "CPU s", "peak GB", "cosine", "CKA", "kNN@1"]]
    size = " x ".join(map(str, measurement.values["size"]))
    for each in measurement.values["tables"]:
        numbers = [f"{each['cpu_s']:.0f}", f"{each['peak_gb']:.2f}", f"{each['cosine_mean']:.6f}"]
        numbers += [f"{each['cka']:.6f}", f"{each['nearest']:.4f}"]
        rows.append([each["label"], size, *numbers])
    note = (
        "Random rows in bfloat16, the second table is the first with noise. The peak is all of the "
        f"process's memory, the files' pages that it has read included; target: {LIMIT_GB:g} GB at "
        "most."
    )
    return [Table("Comparing two tables of word embeddings", rows, note)]


def _compare(plan: tuple[tuple[int, int], float]) -> dict[str, Any]:
    """The comparison's figures, its CPU seconds, and the most gigabytes that the process took."""
    size, noise = plan
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / "vlm", Path(scratch) / "policy"]
        _write(folders, size, noise)
        start = time.process_time()
        found = compare(
            open_table(folders[0]),
            open_table(folders[1]),
            lambda starts, label: tqdm(starts, label),
        )
        seconds = time.process_time() - start
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {**asdict(found), "cpu_s": seconds, "peak_gb": peak_gb}


def _write(folders: list[Path], size: tuple[int, int], noise: float) -> None:
    """Two tables of random rows as safetensors files, block by block."""
    rng = np.random.default_rng(0)
    rows, width = size
    about = {"dtype": "BF16", "shape": [rows, width], "data_offsets": [0, 2 * rows * width]}
    header = json.dumps({NAME: about}).encode()
    files = []
    for folder in folders:
        folder.mkdir(parents=True)
        file = (folder / "model.safetensors").open("wb")
        file.write(struct.pack("<Q", len(header)) + header)
        files.append(file)
    for start in range(0, rows, BLOCK):
        shape = (min(BLOCK, rows - start), width)
        one = rng.standard_normal(shape, np.float32)
        other = one + np.float32(noise) * rng.standard_normal(shape, np.float32)
        for file, block in zip(files, (one, other), strict=True):
            file.write((block.view(np.uint32) >> 16).astype("<u2").tobytes())
    for file in files:
        file.close()
