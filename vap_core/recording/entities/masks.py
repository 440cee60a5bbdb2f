"""Track and ground truth of every target, as class images."""

from collections.abc import Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.base.types import Camera, Mask
from vap_core.recording.colours import ELECTED, TARGET
from vap_core.recording.entities.images import send_class_images
from vap_core.recording.entities.paths import image_root, target_suffix
from vap_core.rollout.types import EpisodeHeader, Frame

TRACK_CLASS, TRUTH_CLASS = 1, 3
"""Class of a mask's inside; the class of its edge is the next number."""
TRACK_EDGE_PX, TRUTH_EDGE_PX = 2, 1
CLASSES = [
    rr.AnnotationInfo(id=0, label="", color=(0, 0, 0, 0)),
    rr.AnnotationInfo(id=TRACK_CLASS, label="track", color=(*ELECTED, 90)),
    rr.AnnotationInfo(id=TRACK_CLASS + 1, label="track, edge", color=(*ELECTED, 255)),
    rr.AnnotationInfo(id=TRUTH_CLASS, label="truth", color=(*TARGET, 1)),
    rr.AnnotationInfo(id=TRUTH_CLASS + 1, label="truth, edge", color=(*TARGET, 255)),
]
"""The edge has its own class so that track and truth stay apart where they agree."""


def class_image(mask: Mask, inside: int, edge_px: int) -> np.ndarray:
    """Class image of a mask: `inside`, and `inside + 1` on its outermost `edge_px` pixels."""
    raw = np.ascontiguousarray(mask).view(np.uint8)
    kernel = np.ones((2 * edge_px + 1, 2 * edge_px + 1), np.uint8)
    eroded = cv2.erode(raw, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return raw * np.uint8(inside + 1) - eroded


def track_image(mask: Mask) -> np.ndarray:
    """Class image of a tracked mask."""
    return class_image(mask, TRACK_CLASS, TRACK_EDGE_PX)


def send_masks(
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    index: Sequence[rr.TimeColumn],
    frames: Sequence[Frame],
) -> None:
    """The track and the truth of every target; a lost track is an empty mask."""
    for camera in frames[0].cameras:
        groundings = header.groundings.get(camera.name, ())
        root = f"{image_root(camera.name)}/mask"
        for j in range(max(1, len(groundings))):
            suffix = target_suffix(j)
            if j < len(groundings):
                tracks = _track_images(camera, j, frames)
                send_class_images(
                    rec, f"{root}/target{suffix}", index, tracks, draw_order=float(TRACK_CLASS)
                )
            model = header.row.target if j == 0 else groundings[j].object
            truths = _truth_images(camera, model, frames)
            if truths is not None:
                send_class_images(
                    rec, f"{root}/gt{suffix}", index, truths, draw_order=float(TRUTH_CLASS)
                )


def _track_images(camera: Camera, j: int, frames: Sequence[Frame]) -> list[np.ndarray]:
    images = []
    for frame in frames:
        tracks = frame.tracks.get(camera.name, ())
        mask = tracks[j].mask if j < len(tracks) else None
        if mask is None:
            images.append(_empty_image(camera))
        else:
            images.append(track_image(mask))
    return images


def _truth_images(camera: Camera, model: str, frames: Sequence[Frame]) -> list[np.ndarray] | None:
    """None, when no frame has a true mask of the object."""
    images = []
    has_truth = False
    for frame in frames:
        mask = frame.truth.masks.get(camera.name, {}).get(model)
        if mask is None:
            images.append(_empty_image(camera))
        else:
            has_truth = True
            images.append(class_image(mask, TRUTH_CLASS, TRUTH_EDGE_PX))
    return images if has_truth else None


def _empty_image(camera: Camera) -> np.ndarray:
    return np.zeros((camera.height, camera.width), np.uint8)
