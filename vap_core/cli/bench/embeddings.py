"""What comparing two tables of word embeddings of PaliGemma's size costs, on random numbers.

The tables are written as a checkpoint holds them, in bfloat16, and read in blocks. The second is
the first with noise, so that the cosines are about the paper's: pi0's, or pi0.5's.
"""

import json
import resource
import struct
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from vap_core.analysis.embedding_search import BLOCK
from vap_core.analysis.embedding_space import Comparison, compare
from vap_core.base.tables import align
from vap_core.evaluation import processes
from vap_core.policies.embedding_table import open_table

SIZE = (257_152, 2_048)
QUICK = (9_000, 128)
NAME = "language_model.embed_tokens.weight"
NOISE = {"as pi0": 0.0014, "as pi0.5": 0.344}
"""Noise over signal: cosines of 0.999999 and 0.9456."""
LIMIT_GB = 4.0
"""Target of the peak memory."""


def run(quick: bool = False) -> str:
    """Compare random tables; a quarter of an hour and 2 GB of disk, `quick` a few seconds."""
    size = QUICK if quick else SIZE
    rows = [["tables", "size", "CPU s", "peak GB", "cosine", "CKA", "kNN@1"]]
    for label, noise in NOISE.items():
        # A fresh process, so that its peak is the comparison's.
        plan = (size, noise)
        _, (found, seconds, peak_gb) = next(
            processes.results(_measure, [plan], workers=1, remedy="--quick")
        )
        cosine = f"{found.cosine_mean:.6f}"
        rows.append(
            [
                label,
                f"{size[0]} x {size[1]}",
                f"{seconds:.0f}",
                f"{peak_gb:.2f}",
                cosine,
                f"{found.cka:.6f}",
                f"{found.nearest:.4f}",
            ]
        )
    return f"one thread; target: a peak of {LIMIT_GB:g} GB at most\n\n{align(rows)}"


def _measure(plan: tuple[tuple[int, int], float]) -> tuple[Comparison, float, float]:
    """The comparison, its CPU seconds, and the most gigabytes that the process took."""
    size, noise = plan
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / "vlm", Path(scratch) / "policy"]
        _write(folders, size, noise)
        start = time.process_time()
        found = compare(open_table(folders[0]), open_table(folders[1]), _with_bar)
        seconds = time.process_time() - start
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return found, seconds, peak_gb


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


def _with_bar(starts: Iterable[int], label: str) -> Iterable[int]:
    from tqdm import tqdm

    return tqdm(starts, desc=label, unit="block", disable=None, leave=False)
