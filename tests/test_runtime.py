"""ONNX Runtime and torch compute the same networks; a graph that does not fit its weights is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.command import process
from vap_core.base.errors import MissingWeights
from vap_core.base.types import Boxes
from vap_core.perception.boxes import crop, mask_iou
from vap_core.perception.embedded import cells, encoder, networks, proposer, segmenter, tracker
from vap_core.perception.embedded.networks import FOLDER, MANIFEST, PERCEPTION, load_weights
from vap_make.perception import graphs
from vap_make.perception.backbone import TorchNetwork

BOUNDS = {
    cells.GRAPH: (1e-5,),
    segmenter.GRAPH: (1e-5,),
    encoder.GRAPH: (1e-4, 1e-5),
    proposer.GRAPH: (1e-4, 1e-3),
}
"""The largest difference allowed, by output: unit-length features, probabilities, features of up to
6, a row of length 1, logits of up to 10, and edges of up to 20 cells."""


def modules() -> dict[str, nn.Module]:
    """The torch networks with the shipped weights."""
    heads: list[nn.Module] = []
    for prefix, build in (
        ("segment.", graphs.MaskHead),
        ("look.", graphs.InstanceHead),
        ("detect.", graphs.DetectHead),
    ):
        weights, _ = load_weights(PERCEPTION, prefix)
        head = build(len(weights["known"])) if prefix == "detect." else build()  # type: ignore[call-arg]
        head.load_state_dict({name: torch.from_numpy(part) for name, part in weights.items()})
        heads.append(head)
    mask, look, detect = heads
    return {
        cells.GRAPH: graphs.CellNetwork(),
        segmenter.GRAPH: graphs.MaskNetwork(mask),
        encoder.GRAPH: graphs.EncodeNetwork(look),
        proposer.GRAPH: graphs.DetectNetwork(detect),
    }


@pytest.fixture(scope="module")
def by_torch() -> dict[str, TorchNetwork]:
    return {name: TorchNetwork(module) for name, module in modules().items()}


@pytest.fixture(scope="module")
def by_onnx() -> dict[str, networks.Network]:
    return {
        cells.GRAPH: tracker.load().network,
        segmenter.GRAPH: segmenter.load().network,
        encoder.GRAPH: encoder.load().network,
        proposer.GRAPH: proposer.load().network,
    }


@pytest.fixture(scope="module")
def torch_tracker(by_torch: dict[str, TorchNetwork]) -> tracker.LiteTracker:
    return tracker.LiteTracker(
        by_torch[cells.GRAPH],
        segmenter.LiteSegmenter(by_torch[segmenter.GRAPH]),
        encoder.LiteEncoder(by_torch[encoder.GRAPH]),
    )


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, Boxes]:
    """A rendered table: picture, masks and boxes of its objects."""
    from vap_make.films.scenes import boxes_of, stage

    shots = stage(3, 2, held_out=True, views=1)
    seen = list(boxes_of(shots.ids[0], len(shots.names), 150))
    masks = np.stack([shots.ids[0] == i + 1 for i, _ in seen])
    corners = np.array([box for _, box in seen], np.float32)
    return shots.rgb[0], masks, Boxes(corners, np.ones(len(corners), np.float32), "object")


def noise(seed: int, h: int, w: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (h, w, 3), dtype=np.uint8)


def inputs(name: str, picture: np.ndarray, seed: int) -> list[np.ndarray]:
    """What a network is given for a picture."""
    rng = np.random.default_rng(seed)
    if name == cells.GRAPH:
        return [networks.resize_and_pad(picture, cells.SIDE)[0][None]]
    if name == segmenter.GRAPH:
        planes = rng.integers(0, 256, (1, 2, segmenter.SIDE, segmenter.SIDE), dtype=np.uint8)
        return [segmenter.cut(picture, (0, 0, min(picture.shape[:2])))[None], planes]
    if name == encoder.GRAPH:
        whole = encoder.pad_to_square(picture)
        colour = encoder.lab_histogram(picture).astype(np.float32)
        return [whole[None], whole[None, ::2, ::2].copy(), colour[None] / np.linalg.norm(colour)]
    return [proposer.resize_for_search(picture)[0][None], proposer.load().embed_phrase("cup")]


@pytest.mark.parametrize("name", BOUNDS)
def test_both_runtimes_give_the_same_numbers(
    name: str,
    by_torch: dict[str, TorchNetwork],
    by_onnx: dict[str, networks.Network],
    scene: tuple,
) -> None:
    for seed, picture in enumerate([scene[0], noise(0, 224, 224), noise(1, 90, 160)]):
        given = inputs(name, picture, seed)
        ours, theirs = by_onnx[name](*given), by_torch[name](*given)
        assert len(ours) == len(theirs) == len(BOUNDS[name])
        for mine, reference, bound in zip(ours, theirs, BOUNDS[name], strict=True):
            assert mine.dtype == reference.dtype == np.float32
            assert mine.shape == reference.shape
            assert np.abs(mine - reference).max() <= bound
        for once, again in zip(ours, by_onnx[name](*given), strict=True):
            assert np.array_equal(once, again)


def test_both_runtimes_give_the_same_boxes_masks_and_rows(
    by_torch: dict[str, TorchNetwork], scene: tuple
) -> None:
    rgb, _, boxes = scene
    reference = proposer.LiteDetector(by_torch[proposer.GRAPH], proposer.load().known)
    for found, expected in zip(
        proposer.load()([rgb, rgb[:100]], "bottle"),
        reference([rgb, rgb[:100]], "bottle"),
        strict=True,
    ):
        assert np.allclose(found.xyxy, expected.xyxy, atol=1e-2)
        assert np.allclose(found.score, expected.score, atol=1e-4)
    drawn = segmenter.LiteSegmenter(by_torch[segmenter.GRAPH])(rgb, boxes)
    for mask, expected_mask in zip(segmenter.load()(rgb, boxes), drawn, strict=True):
        assert mask_iou(mask, expected_mask) > 0.999
    crops = [crop(rgb, box) for box in boxes.xyxy]
    rows = encoder.LiteEncoder(by_torch[encoder.GRAPH])(crops)
    assert ((rows * encoder.load()(crops)).sum(axis=1) > 0.99999).all()


def test_both_runtimes_track_a_clip_alike(torch_tracker: tracker.LiteTracker, scene: tuple) -> None:
    """What moves, is lost behind grey for two frames, and is found again."""
    rgb, masks, _ = scene
    frames = [np.roll(rgb, 2 * t, axis=1) for t in range(6)]
    frames[2] = frames[3] = np.full_like(rgb, 127)
    ours = tracker.load()
    states, reference = ours.start([rgb], [masks]), torch_tracker.start([rgb], [masks])
    n_masks = 0
    for frame in frames:
        states, (tracks,) = ours.step(states, [frame])
        reference, (expected,) = torch_tracker.step(reference, [frame])
        for mine, other in zip(tracks, expected, strict=True):
            assert (mine.mask is None) == (other.mask is None)
            if mine.mask is not None and other.mask is not None:
                assert mask_iou(mine.mask, other.mask) >= 0.999
                n_masks += 1
    assert n_masks >= 3 * len(masks)


def test_a_session_takes_one_thread() -> None:
    options = networks.session_options()
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the shipped weights, to be damaged."""
    shutil.copytree(FOLDER, tmp_path / "weights")
    return tmp_path / "weights"


def load_tracker(folder: Path) -> networks.OnnxNetwork:
    entries = json.loads((FOLDER / MANIFEST).read_text())
    return networks.load_network(
        cells.GRAPH, networks.trunk_weights([cells.TAP]), entries[PERCEPTION]["sha256"], folder
    )


def damage(folder: Path) -> None:
    path = folder / cells.GRAPH
    path.write_bytes(path.read_bytes() + b"\0")


def remove(folder: Path) -> None:
    (folder / cells.GRAPH).unlink()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damage, r"tracker\.onnx has SHA-256 .*; restore it with git, or run python .* export"),
        (remove, r"tracker\.onnx is not on this machine .*; restore it with git, or run python"),
    ],
)
def test_a_damaged_graph_is_refused(
    folder: Path, change: Callable[[Path], None], message: str
) -> None:
    load_tracker(folder)
    change(folder)
    with pytest.raises(MissingWeights, match=message) as error:
        load_tracker(folder)
    assert len(str(error.value)) <= 300 + len(str(folder))


def test_a_graph_of_other_weights_is_refused(folder: Path) -> None:
    with pytest.raises(MissingWeights, match=r"was made with e0ec.*; run python .* export"):
        networks.load_network(cells.GRAPH, networks.trunk_weights([cells.TAP]), "0" * 64, folder)


def test_the_shipped_graphs_are_those_of_the_networks(folder: Path) -> None:
    shipped = {name: (folder / name).read_bytes() for name in BOUNDS}
    for name in shipped:
        (folder / name).unlink()
    done = process("weights", "export", "--folder", folder)  # traced code has no shapes to check
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(shipped)
    assert {name: (folder / name).read_bytes() for name in BOUNDS} == shipped
    assert (folder / MANIFEST).read_bytes() == (FOLDER / MANIFEST).read_bytes()
    assert sum(map(len, shipped.values())) < 500_000
    assert not any(str(Path.cwd()).encode() in data for data in shipped.values())
