"""GrabCut on photos: it starts from the segmenter, and leaves familiar views and small boxes alone."""

from dataclasses import replace

import cv2
import numpy as np

from vap_core.base.types import Boxes
from vap_core.perception.boxes import mask_iou
from vap_core.perception.embedded import segmenter
from vap_core.perception.embedded.segmenter import refine

BOX = np.array([60, 40, 180, 160], np.float32)
TRUE = np.zeros((240, 320), np.uint8)
cv2.circle(TRUE, (120, 100), 58, 1, -1)
DISC = TRUE > 0


def picture(disc: np.ndarray = DISC):
    """A noisy red disc on a noisy green ground."""
    rgb = np.full((240, 320, 3), (60, 120, 60), np.uint8)
    rgb[disc] = (190, 60, 50)
    noise = np.random.default_rng(0).normal(0, 8, rgb.shape)
    return np.clip(rgb + noise, 0, 255).astype(np.uint8)


def guess(inner: float) -> np.ndarray:
    """A vague guess: sure of the middle alone."""
    likely = np.full(DISC.shape, 0.5, np.float32)
    likely[90:110, 110:130] = inner
    return likely


def test_colours_decide_where_the_guess_is_vague():
    mask = refine(picture(), BOX, guess(0.95))
    assert mask_iou(mask, DISC) > 0.97
    assert not mask[: int(BOX[1])].any()


def test_the_same_picture_gives_the_same_mask():
    cv2.setRNGSeed(7)
    one = refine(picture(), BOX, guess(0.95))
    cv2.setRNGSeed(8)
    assert (refine(picture(), BOX, guess(0.95)) == one).all()


def test_nothing_to_tell_apart_is_none():
    """A box of the whole picture leaves no background."""
    whole = np.array([0, 0, 320, 240], np.float32)
    assert refine(picture(), whole, guess(0.95)) is None


def test_a_mask_of_nearly_nothing_is_none():
    """In one colour GrabCut may give all to the background."""
    assert refine(picture(), BOX, np.zeros(DISC.shape, np.float32)) is None


def test_boxes_beyond_the_edge():
    corner = np.array([-20, -30, 180, 160], np.float32)
    mask = refine(picture(), corner, guess(0.95))
    assert mask is None or mask_iou(mask, DISC) > 0.9


def test_familiar_views_and_small_boxes_stay_with_the_segmenter():
    segment = segmenter.load_cut()
    xyxy = np.array([BOX, [100, 80, 130, 110]], np.float32)
    boxes = Boxes(xyxy, np.ones(2, np.float32), "disc")
    rgb = picture()
    plain = segment.lite(rgb, boxes)
    assert (segment(rgb, boxes) == plain).all()
    cut = segment(rgb, replace(boxes, familiar=False))
    assert (cut[1] == plain[1]).all()
    assert mask_iou(cut[0], DISC) > 0.97
    assert not len(segment(rgb, replace(Boxes.empty("disc"), familiar=False)))


def test_an_object_that_a_corner_cuts_is_outlined():
    disc = np.zeros_like(DISC)
    disc[:170, :220] = DISC[70:, 100:]
    likely = np.full(disc.shape, 0.5, np.float32)
    likely[20:40, 10:30] = 0.95
    mask = refine(picture(disc), np.array([0, 0, 80, 90], np.float32), likely)
    assert mask is not None
    assert mask_iou(mask, disc) > 0.95
