"""Writes the graphs of the embedded networks, which ONNX Runtime computes.

A graph holds no weights, so a network's graph is some kilobytes. It belongs to the weight file
that lies beside it, whose SHA-256 is in its metadata.
"""

import io
import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from vap_core.base.errors import MissingWeights
from vap_core.base.types import value
from vap_core.perception.embedded import detector, encoder, segmenter
from vap_core.perception.embedded.detect_network import DetectHead, DetectNetwork
from vap_core.perception.embedded.encode_network import EncodeNetwork, InstanceHead
from vap_core.perception.embedded.mask_network import MaskHead, MaskNetwork
from vap_core.perception.embedded.runtime import WEIGHTS_KEY
from vap_core.perception.embedded.tracker import cells
from vap_core.perception.embedded.tracker.cell_network import CellNetwork
from vap_core.perception.embedded.weights import PERCEPTION, read_checked, write_entry
from vap_core.perception.text_encoder import WIDTH as TEXT_WIDTH

OPSET = 18
INLINE = "handed over"
"""In the place of the path of external data, of which there is none."""


@value
class Graph:
    """A network to be exported: its inputs by name, and the names of the sides that vary."""

    module: nn.Module
    inputs: Mapping[str, np.ndarray]
    outputs: tuple[str, ...]
    varying: Mapping[str, Mapping[int, str]]


def graphs() -> dict[str, Graph]:
    """Every graph by the name of its file, with weights that do not matter."""
    image = {1: "height", 2: "width"}
    cell = {2: "rows", 3: "columns"}
    crop = encoder.SIDE
    small = encoder.INSTANCE_SIDE
    window = segmenter.SIDE
    return {
        cells.GRAPH: Graph(
            module=CellNetwork(),
            inputs={"rgb": _pixels(cells.SIDE)},
            outputs=("keys",),
            varying={"rgb": image, "keys": {0: "cells"}},
        ),
        segmenter.GRAPH: Graph(
            module=MaskNetwork(_with_distinct_weights(MaskHead())),
            inputs={
                "rgb": _pixels(window),
                "planes": np.zeros((1, 2, window, window), np.uint8),
            },
            outputs=("probability",),
            varying={},
        ),
        encoder.GRAPH: Graph(
            module=EncodeNetwork(_with_distinct_weights(InstanceHead())),
            inputs={
                "rgb": _pixels(crop),
                "small": _pixels(small),
                "colour": np.zeros((1, encoder.HISTOGRAM_LENGTH), np.float32),
            },
            outputs=("deepest", "instance"),
            varying={},
        ),
        detector.GRAPH: Graph(
            module=DetectNetwork(_with_distinct_weights(DetectHead(1))),
            inputs={
                "rgb": _pixels(detector.SIDE),
                "text": np.zeros((1, TEXT_WIDTH), np.float32),
            },
            outputs=("logits", "edges"),
            varying={
                "rgb": image,
                "text": {0: "phrases"},
                "logits": {1: "phrases", **cell},
                "edges": cell,
            },
        ),
    }


def export_graphs(folder: Path) -> list[Path]:
    """Write every graph beside the perception weights of `folder`, and its manifest entry.

    Raises: MissingWeights: there are no weights, or `onnx` is not installed.
    """
    require_onnx()
    _, entry = read_checked(PERCEPTION, folder)
    paths: list[Path] = []
    for name, graph in graphs().items():
        data = _structure(graph, {WEIGHTS_KEY: entry["sha256"]})
        paths.append(write_entry(name, data, {WEIGHTS_KEY: entry["sha256"]}, folder))
    return paths


def require_onnx() -> None:
    """Raises: MissingWeights: graphs cannot be written here."""
    if find_spec("onnx") is None:
        raise MissingWeights("export: onnx is not installed; run: pip install 'vap-core[export]'")


def _structure(graph: Graph, metadata: Mapping[str, str]) -> bytes:
    """The graph without the values of its weights."""
    import onnx

    sink = io.BytesIO()
    with warnings.catch_warnings():
        # torch's newer exporter needs another package. ONNX Runtime folds what this one does not.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.filterwarnings("ignore", "Constant folding", UserWarning)
        torch.onnx.export(
            graph.module.requires_grad_(False).eval(),
            tuple(torch.from_numpy(array) for array in graph.inputs.values()),
            sink,  # type: ignore[arg-type]
            dynamo=False,
            opset_version=OPSET,
            do_constant_folding=False,  # it would rename weights
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            dynamic_axes={name: dict(axes) for name, axes in graph.varying.items()},
        )
    model = onnx.load_from_string(sink.getvalue())
    weights = {tensor.name for tensor in model.graph.initializer}
    expected = {name for name, _ in graph.module.named_parameters()}
    assert weights == expected, weights ^ expected
    for tensor in model.graph.initializer:
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=INLINE)
    for node in model.graph.node:
        node.ClearField("doc_string")  # where in the source it comes from, on this machine
    onnx.helper.set_model_props(model, dict(metadata))
    data: bytes = model.SerializeToString(deterministic=True)
    return data


def _with_distinct_weights[M: nn.Module](head: M) -> M:
    """The head with random weights: the exporter merges weights of equal values."""
    rng = torch.Generator().manual_seed(0)
    for weight in head.parameters():
        nn.init.normal_(weight, generator=rng)
    return head


def _pixels(side: int) -> Any:
    return np.zeros((1, side, side, 3), np.uint8)
