"""The contract of a detector: boxes inside the image, best first, independent of each other."""

import numpy as np

from vap_core.base.types import Boxes
from vap_core.contracts.given import RenderedScene, noise
from vap_core.perception.boxes import box_iou
from vap_core.perception.candidates import detect
from vap_core.perception.protocols import Detector

PHRASES = ("cup", "owl statue", "something nobody has named")


def assert_same(boxes: Boxes, others: Boxes) -> None:
    """The same corners and scores, bit for bit."""
    assert np.array_equal(boxes.xyxy, others.xyxy)
    assert np.array_equal(boxes.score, others.score)


def test_every_image_has_its_boxes_inside_it_best_first(
    detector: Detector, scene: RenderedScene
) -> None:
    images = [scene.rgb, noise(0)]
    for phrase in PHRASES:
        for image, boxes in zip(images, detect(detector, images, phrase), strict=True):
            h, w = image.shape[:2]
            assert boxes.phrase == phrase
            assert (np.diff(boxes.score) <= 0).all()
            assert (boxes.xyxy >= 0).all()
            assert (boxes.xyxy <= (w, h, w, h)).all()


def test_no_image_gives_no_boxes(detector: Detector) -> None:
    assert detector([], "cup") == []


def test_a_batch_equals_one_by_one_and_repeats_its_bits(
    detector: Detector, scene: RenderedScene
) -> None:
    images = [scene.rgb, scene.rgb[:, ::-1].copy(), scene.rgb]
    together = detector(images, "bottle")
    np.random.seed(5)  # noqa: NPY002  (global seeding must change nothing)
    for image, boxes in zip(images, together, strict=True):
        (alone,) = detector([image], "bottle")
        assert len(boxes) == len(alone)
        assert np.allclose(boxes.xyxy, alone.xyxy, atol=1e-2)
        assert np.allclose(boxes.score, alone.score, atol=1e-4)
    assert_same(together[0], together[2])
    for boxes, again in zip(together, detector(images, "bottle"), strict=True):
        assert_same(boxes, again)


def test_a_higher_threshold_gives_no_more_boxes(detector: Detector, scene: RenderedScene) -> None:
    (few,) = detector([scene.rgb], "cup", 0.9)
    (many,) = detector([scene.rgb], "cup", 0.05)
    assert len(few) <= len(many)
    assert (few.score >= 0.9).all()


def test_sanity_most_objects_of_a_rendered_table_have_a_box(
    detector: Detector, scene: RenderedScene
) -> None:
    (boxes,) = detector([scene.rgb], "object on a table", 0.0)
    overlap = box_iou(scene.boxes.xyxy, boxes.xyxy).max(axis=1, initial=0.0)
    assert (overlap >= 0.5).mean() >= 0.5
