"""The embedded networks as torch modules: fitted in training, exported as ONNX."""

import io
import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from vap_core.base.errors import MissingWeights
from vap_core.base.types import value
from vap_core.perception.embedded import cells, encoder, proposer, segmenter
from vap_core.perception.embedded.cells import TAP
from vap_core.perception.embedded.encoder import HISTOGRAM_LENGTH, INSTANCE_TAPS, INSTANCE_WIDTH
from vap_core.perception.embedded.networks import (
    CHANNELS,
    PERCEPTION,
    WEIGHTS_KEY,
    read_checked,
)
from vap_core.perception.embedded.proposer import TAPS
from vap_core.perception.embedded.segmenter import MASK_TAPS
from vap_core.perception.text_encoder import WIDTH as TEXT_WIDTH
from vap_make.perception.backbone import Trunk, normalise, write_entry

COARSE_WIDTH = 96
FINE_WIDTH = 64
PHRASE_HIDDEN_WIDTH = 128
PHRASE_WIDTH = 96
"""Channels of the head: at stride 16, at stride 8, and of embedded phrases."""


class DetectHead(nn.Module):
    """Feature maps in; one score map per phrase and one box per cell out.

    Stride 16 decides what an object is, stride 8 where its edges are. The attributes' names are the
    tensors' names in the weight file.
    """

    known: Tensor
    """MiniLM embeddings of the trained phrases, those that name nothing too; kept so that loading
    does not compute them again."""

    def __init__(self, n_phrases: int) -> None:
        super().__init__()
        self.register_buffer("known", torch.zeros(n_phrases, TEXT_WIDTH))
        self.lateral = nn.ModuleDict(
            {
                "b4": nn.Conv2d(CHANNELS["b4"], FINE_WIDTH, 1),
                "b10": nn.Conv2d(CHANNELS["b10"], COARSE_WIDTH, 1),
                "b14": nn.Conv2d(CHANNELS["b14"], COARSE_WIDTH, 1),
            }
        )
        self.coarse = ResidualConvolutions(COARSE_WIDTH)
        self.fine = ResidualConvolutions(FINE_WIDTH)
        self.down = nn.Conv2d(COARSE_WIDTH, FINE_WIDTH, 1)
        self.see = nn.Conv2d(FINE_WIDTH, PHRASE_WIDTH, 1)
        self.edges = nn.Conv2d(FINE_WIDTH, 4, 1)
        self.read = nn.Sequential(
            nn.Linear(TEXT_WIDTH, PHRASE_HIDDEN_WIDTH),
            nn.ReLU(),
            nn.Linear(PHRASE_HIDDEN_WIDTH, PHRASE_WIDTH),
        )
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def forward(
        self, taps: Mapping[str, Tensor], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p h w"], Float[Tensor, "n 4 h w"]]:
        """Logits per phrase, and how far the edges are.

        Edges are distances, in cells, from the cell's centre to the left, top, right and bottom.
        """
        b4 = self.lateral["b4"](taps["b4"])
        b10 = self.lateral["b10"](taps["b10"])
        b14 = self.lateral["b14"](taps["b14"])
        x = self.down(self.coarse(b10 + F.interpolate(b14, b10.shape[-2:], mode="nearest")))
        x = self.fine(b4 + F.interpolate(x, b4.shape[-2:], mode="nearest"))
        product = torch.einsum("nchw,pc->nphw", self.see(x), self.read(text))
        logits = product / PHRASE_WIDTH**0.5 + self.bias
        return logits, 4 * F.softplus(self.edges(x))


class ResidualConvolutions(nn.Module):
    """Two residual 3 x 3 convolutions between group norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mix = nn.ModuleList()
        self.norm = nn.ModuleList([nn.GroupNorm(8, width)])
        for _ in range(2):
            self.mix.append(nn.Conv2d(width, width, 3, padding=1))
            self.norm.append(nn.GroupNorm(8, width))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        x = self.norm[0](x)
        for mix, norm in zip(self.mix, list(self.norm)[1:], strict=True):
            x = x + F.relu(norm(mix(F.relu(x))))
        return x


class DetectNetwork(nn.Module):
    """Backbone and head: a view and embedded phrases in, what `DetectHead` gives out."""

    def __init__(self, head: DetectHead) -> None:
        super().__init__()
        self.trunk = Trunk(TAPS)
        self.head = head

    def forward(
        self, rgb: UInt8[Tensor, "n h w 3"], text: Float[Tensor, "p 384"]
    ) -> tuple[Float[Tensor, "n p y x"], Float[Tensor, "n 4 y x"]]:
        return self.head(self.trunk(normalise(rgb)), text)


class InstanceHead(nn.Module):
    """Distinguishes look-alikes: a small network on frozen features and the pixels of a crop.

    Features of three depths and the pixels meet on a 14 x 14 grid; eight attention heads weight its
    cells, so the table can be left out. Trained on generic look-alikes only. The attributes' names
    are the tensors' names in the weight file.
    """

    GRID = 14
    HEADS = 8
    VALUE_WIDTH = 24
    WIDTH = 96
    DIM = INSTANCE_WIDTH

    def __init__(self) -> None:
        super().__init__()
        self.pixels = nn.Sequential(
            nn.Conv2d(3, 16, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(32, 48, 3, 2, 1),
        )
        self.lateral = nn.ModuleDict(
            {
                "b4": nn.Conv2d(CHANNELS["b4"], 32, 1),
                "b10": nn.Conv2d(CHANNELS["b10"], 48, 1),
                "b14": nn.Conv2d(CHANNELS["b14"], 48, 1),
            }
        )
        merged = 48 + 32 + 48 + 48
        self.merge = nn.Conv2d(merged, self.WIDTH, 3, 2, 1)
        self.norm = nn.ModuleList([nn.GroupNorm(8, merged), nn.GroupNorm(8, self.WIDTH)])
        self.place = nn.Parameter(torch.zeros(self.WIDTH, self.GRID // 2, self.GRID // 2))
        self.mix = nn.Conv2d(self.WIDTH, self.WIDTH, 3, padding=1)
        self.where = nn.Conv2d(self.WIDTH, self.HEADS, 1)
        self.what = nn.Conv2d(self.WIDTH, self.HEADS * self.VALUE_WIDTH, 1)
        self.colour = nn.Linear(HISTOGRAM_LENGTH, 64)
        self.out = nn.Sequential(
            nn.Linear(self.HEADS * self.VALUE_WIDTH + self.WIDTH + 64, 256),
            nn.ReLU(),
            nn.Linear(256, self.DIM),
        )

    def forward(
        self,
        taps: Mapping[str, Tensor],
        pixels: Float[Tensor, "n 3 s s"],
        colour: Float[Tensor, "n b"],
    ) -> Float[Tensor, "n d"]:
        """Rows of length 1.

        `taps` are maps of 14, 14 and 7 cells a side; `pixels` are 112 x 112 and normalised as for
        the backbone; `colour` is a normalised Lab histogram.
        """
        size = (self.GRID, self.GRID)
        maps = [self.pixels(pixels)]
        for tap in INSTANCE_TAPS:
            maps.append(F.interpolate(self.lateral[tap](taps[tap]), size, mode="nearest"))
        x = self.norm[1](self.merge(F.relu(self.norm[0](torch.cat(maps, 1))))) + self.place
        x = x + F.relu(self.mix(F.relu(x)))
        attention = self.where(x).flatten(2).softmax(-1)
        values = self.what(x).flatten(2).unflatten(1, (self.HEADS, self.VALUE_WIDTH))
        attended = torch.einsum("nhp,nhcp->nhc", attention, values).flatten(1)
        pooled = F.relu(x).pow(3).mean((2, 3)).clamp(min=1e-6).pow(1 / 3)
        joined = torch.cat([attended, pooled, F.relu(self.colour(colour))], 1)
        return F.normalize(self.out(joined), dim=1)


class EncodeNetwork(nn.Module):
    """Backbone and head: a crop in, its deepest features and the instance head's row out."""

    def __init__(self, head: InstanceHead | None) -> None:
        super().__init__()
        self.trunk = Trunk([*INSTANCE_TAPS, "head"])
        self.head = head

    def forward(
        self,
        rgb: UInt8[Tensor, "n _s _s 3"],
        small: UInt8[Tensor, "n _t _t 3"],
        colour: Float[Tensor, "n b"],
    ) -> tuple[Tensor, ...]:
        """`small` is the same crop, `INSTANCE_SIDE` pixels wide; without a head there is no row."""
        taps = self.trunk(normalise(rgb))
        if self.head is None:
            return (taps["head"],)
        return taps["head"], self.head(halve_b4(taps), normalise(small), colour)


def halve_b4(taps: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The taps that the instance head reads, b4 at half its resolution."""
    return {"b4": F.avg_pool2d(taps["b4"], 2), "b10": taps["b10"], "b14": taps["b14"]}


WIDTHS = (16, 24, 32, 48)
"""Channels of the head at each tap."""
MASK_WIDTH = 12
"""Channels of the head at half the window's resolution."""


class MaskHead(nn.Module):
    """Four feature maps and the prompt in, one logit per pixel of the window out.

    The attributes' names are the tensors' names in the weight file.
    """

    def __init__(self) -> None:
        super().__init__()
        narrower = (MASK_WIDTH, *WIDTHS[:-1])
        self.lateral = nn.ModuleList()
        self.prompt = nn.ModuleList()
        self.mix = nn.ModuleList()
        for tap, width in zip(MASK_TAPS, WIDTHS, strict=True):
            self.lateral.append(nn.Conv2d(CHANNELS[tap], width, 1))
        for width in WIDTHS:
            self.prompt.append(nn.Conv2d(2, width, 3, padding=1))
        for width, narrow in zip(WIDTHS, narrower, strict=True):
            self.mix.append(nn.Conv2d(width, narrow, 3, padding=1))
        self.fine = nn.Sequential(
            nn.Conv2d(MASK_WIDTH + 3 + 2, MASK_WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(MASK_WIDTH, 1, 3, padding=1),
        )

    def forward(
        self,
        pixels: Float[Tensor, "n 3 h w"],
        taps: Mapping[str, Tensor],
        prompt: Float[Tensor, "n 2 h w"],
    ) -> Float[Tensor, "n h w"]:
        """Logits of the mask.

        `pixels` are normalised as for the backbone; `prompt` holds the box and the coarse mask,
        0..1 (all 0 when there is none).
        """
        x = self._level(len(MASK_TAPS) - 1, taps, prompt)
        x = F.relu(self.mix[-1](F.relu(x)))
        for level in reversed(range(len(MASK_TAPS) - 1)):
            larger = F.interpolate(x, scale_factor=2, mode="nearest")
            x = self._level(level, taps, prompt) + larger
            x = F.relu(self.mix[level](F.relu(x)))
        x = F.interpolate(x, scale_factor=2, mode="bilinear")
        return self.fine(torch.cat([x, pixels, prompt], 1))[:, 0]

    def _level(
        self, level: int, taps: Mapping[str, Tensor], prompt: Float[Tensor, "n 2 h w"]
    ) -> Float[Tensor, "n c y x"]:
        """Features and prompt at the resolution of tap `level`."""
        reduced = F.avg_pool2d(prompt, 2 ** (level + 1))
        return self.lateral[level](taps[MASK_TAPS[level]]) + self.prompt[level](reduced)


class MaskNetwork(nn.Module):
    """Backbone and head: a window and its prompt in, the probability of each of its pixels out."""

    def __init__(self, head: MaskHead) -> None:
        super().__init__()
        self.trunk = Trunk(MASK_TAPS)
        self.head = head

    def forward(
        self, rgb: UInt8[Tensor, "n s s 3"], planes: UInt8[Tensor, "n 2 s s"]
    ) -> tuple[Float[Tensor, "n s s"]]:
        """`planes` are those of the prompt, 0..255."""
        pixels = normalise(rgb)
        logits = self.head(pixels, self.trunk(pixels), planes.float() / 255)
        return (logits.sigmoid(),)


class CellNetwork(nn.Module):
    """The shallow backbone: an image in, unit-length features of every cell out, row by row."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Trunk([TAP])

    def forward(self, rgb: UInt8[Tensor, "1 h w 3"]) -> tuple[Float[Tensor, "p c"]]:
        maps = self.trunk(normalise(rgb))[TAP][0]
        keys = maps.reshape(CHANNELS[TAP], -1).T
        return (F.normalize(keys, dim=1).contiguous(),)


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
        proposer.GRAPH: Graph(
            module=DetectNetwork(_with_distinct_weights(DetectHead(1))),
            inputs={
                "rgb": _pixels(proposer.SIDE),
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
