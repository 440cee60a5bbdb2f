"""What computes the embedded networks: ONNX Runtime on a CPU; torch on a GPU and in training.

The torch modules define the networks. A graph in data/weights is the structure of one of them: it
names the weights that it needs, as the module does, and gets them when it is loaded.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.base.errors import MissingWeights
from vap_core.perception.embedded.weights import FOLDER, PERCEPTION, read_checked

if TYPE_CHECKING:
    from torch import nn

Network = Callable[..., tuple[np.ndarray, ...]]
"""Arrays in and arrays out, in the order of the module's arguments and results."""
WEIGHTS_KEY = "weights"
"""The key of a graph's metadata that holds the SHA-256 of the weight file it was made with."""
EXPORT = "python -m vap_core weights export"


class TorchNetwork:
    """A module as a network of arrays, computed by torch where the module's weights are."""

    def __init__(self, module: "nn.Module") -> None:
        self.module = module.requires_grad_(False).eval()
        self.device = next(module.parameters()).device

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        import torch

        with torch.inference_mode():
            inputs = [torch.from_numpy(array).to(self.device) for array in arrays]
            outputs = self.module(*inputs)
        return tuple(output.cpu().numpy() for output in outputs)


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
    names: list[str] = []
    values: list[OrtValue] = []
    for key, weight in weights.items():
        names.append(key)
        values.append(OrtValue.ortvalue_from_numpy(np.asarray(weight, order="C")))
    options.add_external_initializers(names, values)
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
