"""The contract of a segmenter: a mask for every box, in the boxes' order."""

import numpy as np

from vap_core.base.types import Boxes
from vap_core.contracts.given import RenderedScene, noise
from vap_core.perception.boxes import mask_iou
from vap_core.perception.candidates import draw_masks
from vap_core.perception.protocols import Segmenter


def test_every_box_has_a_mask_of_the_images_size(
    segmenter: Segmenter, scene: RenderedScene
) -> None:
    found = draw_masks(segmenter, scene.rgb, scene.boxes)
    assert np.array_equal(found, segmenter(scene.rgb, scene.boxes))


def test_no_box_gives_no_mask(segmenter: Segmenter) -> None:
    assert segmenter(noise(0, 60, 80), Boxes.empty("cup")).shape == (0, 60, 80)


def test_a_box_always_has_a_mask(segmenter: Segmenter) -> None:
    corners = np.array([[70, 50, 80, 60], [0, 0, 80, 60]], np.float32)
    boxes = Boxes(corners, np.ones(2, np.float32), "cup")
    assert segmenter(noise(0, 60, 80), boxes).any(axis=(1, 2)).all()


def test_sanity_masks_are_of_the_objects(segmenter: Segmenter, scene: RenderedScene) -> None:
    found = segmenter(scene.rgb, scene.boxes)
    assert np.mean([mask_iou(a, b) for a, b in zip(found, scene.masks, strict=True)]) >= 0.7
