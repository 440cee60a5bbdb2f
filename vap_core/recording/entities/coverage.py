"""The prompt of every view, filled with the colour of the object that it covers."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import rerun as rr

from vap_core.base.types import Camera, Mask
from vap_core.recording.colours import object_colours
from vap_core.recording.entities.images import send_class_images
from vap_core.recording.entities.paths import image_root
from vap_core.rollout.types import EpisodeHeader, Frame

NO_OBJECT_CLASS = 8
"""A prompt that covers no object."""
FIRST_OBJECT_CLASS = 10
"""Class of the first object's inside. An inside is even; its edge is the number after it. Every
sub-goal has classes of its own, for another object is its target."""
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def coverage_classes(header: EpisodeHeader) -> list[rr.AnnotationInfo]:
    """One colour for each object: an inside for the prompt that covers it, an edge for itself."""
    classes = [rr.AnnotationInfo(id=NO_OBJECT_CLASS, label="no object", color=(255, 255, 255, 190))]
    names = list(header.object_sizes_m)
    for stage in range(header.row.stages):
        row = header.row.at(stage)
        for name, colour in object_colours(names, row.target, row.goal).items():
            inside = _inside_class(names, name, stage)
            classes.append(rr.AnnotationInfo(id=inside, label=name, color=(*colour, 170)))
            classes.append(
                rr.AnnotationInfo(id=inside + 1, label=f"{name}, edge", color=(*colour, 255))
            )
    return classes


def send_coverage(
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    index: Sequence[rr.TimeColumn],
    frames: Sequence[Frame],
    stage: int = 0,
) -> None:
    """One class image per view and step; the steps are those with truth and pictures.

    `stage` is the sub-goal of all frames.
    """
    for i, camera in enumerate(frames[0].cameras):
        images = [coverage_image(header, frame, frame.cameras[i], stage) for frame in frames]
        send_class_images(rec, f"{image_root(camera.name)}/identity", index, images)


def coverage_image(
    header: EpisodeHeader, frame: Frame, camera: Camera, stage: int = 0
) -> np.ndarray:
    """Class image of one view: the prompt's inside, and over it the edges of all objects."""
    names = list(header.object_sizes_m)
    image = np.zeros((camera.height, camera.width), np.uint8)
    tracks = frame.tracks.get(camera.name, ())
    covered = _covered_object(frame, camera)
    if tracks and tracks[0].mask is not None and covered is not None:
        image[tracks[0].mask] = NO_OBJECT_CLASS
        if covered in names:
            image[tracks[0].mask] = _inside_class(names, covered, stage)
    edges = _object_edges(frame.truth.masks.get(camera.name, {}), names, image, stage)
    return np.where(edges > 0, edges, image)


def _covered_object(frame: Frame, camera: Camera) -> str | None:
    for view in frame.coverage:
        if view.camera == camera.name:
            return view.object
    return None


def _inside_class(names: Sequence[str], name: str, stage: int) -> int:
    return FIRST_OBJECT_CLASS + 2 * (len(names) * stage + names.index(name))


def _object_edges(
    masks: Mapping[str, Mask], names: Sequence[str], like: np.ndarray, stage: int
) -> np.ndarray:
    """The edge class on the outermost pixels of every object, 0 elsewhere."""
    owner = np.zeros_like(like)
    for name in names:
        if name in masks:  # every visible pixel belongs to one object
            edge = _inside_class(names, name, stage) + 1
            owner |= masks[name].view(np.uint8) * np.uint8(edge)
    interior = cv2.erode(owner, CROSS) == cv2.dilate(owner, CROSS)
    owner[interior] = 0
    return owner
