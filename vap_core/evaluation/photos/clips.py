"""Whether the tracker keeps an object apart from its twin, in clips that are made of photos.

A photo beside its own copy holds every object twice, to the pixel. A window of 1.2 times its width
pans over both and back, so that the object leaves the view while its twin stays in it, and
returns: only where things are, and when, tells them apart. It is real texture and light, but no
real motion: nothing blurs, turns or is hidden by a hand. The tracker starts from the true boxes.
"""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64

from vap_core.base.photos import load_photo
from vap_core.base.types import Boxes, Mask, Rgb, value
from vap_core.evaluation.photos.folder import PhotoSet, Scene
from vap_core.evaluation.photos.measure import clip_boxes, judge
from vap_core.perception.protocols import Stack, TargetTracker

FRAMES = 48
"""Of one clip, there and back."""
WINDOW = 1.2
"""The window's width, in widths of the photo."""
SIDE = 640
"""The longer side of a frame."""
IN_VIEW = 0.5
"""Share of the object's box inside the frame from which on it is in view."""
Row = dict[str, Any]


@value
class Pan:
    """The frames' left edges in pixels of the doubled photo, and the scale of frames."""

    left: Float64[np.ndarray, " f"]
    scale: float
    width: int
    photo_width: int

    def boxes(self, frame: int, boxes: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
        """Boxes of the doubled photo in a frame's pixels; they may reach beyond it."""
        moved = boxes - self.left[frame] * np.array([1.0, 0.0, 1.0, 0.0])
        return moved * self.scale


def pan_over(rgb: Rgb) -> Pan:
    """The path of the window over a photo and its copy: all of the photo, all of the copy, back."""
    height, width = rgb.shape[:2]
    window = round(WINDOW * width)
    phase = 2 * np.pi * np.arange(FRAMES) / (FRAMES - 1)
    left = np.round((2 * width - window) * (1 - np.cos(phase)) / 2)
    scale = min(1.0, SIDE / max(window, height))
    return Pan(left=left, scale=scale, width=window, photo_width=width)


def frames_of(rgb: Rgb, pan: Pan) -> Iterator[Rgb]:
    """The frames of a clip."""
    doubled = np.concatenate([rgb, rgb], axis=1)
    size = (round(pan.scale * pan.width), round(pan.scale * rgb.shape[0]))
    for left in pan.left.astype(int).tolist():
        part = doubled[:, left : left + pan.width]
        yield cv2.resize(part, size, interpolation=cv2.INTER_AREA)


def follow_scene(scene: Scene, photo_set: PhotoSet, stack: Stack) -> list[Row]:
    """A row for every object that is in view and has references.

    `end` is what the mask lies on when the window is back: object, twin, other, or "" for no mask.
    `on_object` counts frames, of the `in_view` ones, `on_twin` of all `frames`.

    Raises: BadPhoto when the scene's photo cannot be read; BadPhotoSet, as `clip_boxes`.
    """
    rgb = load_photo(scene.path, long_side=None)
    scene = clip_boxes(scene, rgb)
    pan = pan_over(rgb)
    subjects = {subject.name for subject in photo_set.subjects}
    rows = []
    for name, boxes in scene.boxes.items():
        if name in subjects and len(boxes):
            rows.append(
                {"scene": scene.name, "object": name, **_follow(rgb, pan, scene, name, stack)}
            )
    return rows


def _follow(rgb: Rgb, pan: Pan, scene: Scene, name: str, stack: Stack) -> Row:
    """Track one object through the clip."""
    own = scene.boxes[name][0].astype(np.float64)
    twin = own + np.array([pan.photo_width, 0.0, pan.photo_width, 0.0])
    pair = np.stack([own, twin])
    counts = {"frames": FRAMES, "in_view": 0, "on_object": 0, "on_twin": 0}
    end = ""
    states: list[Any] = []
    for number, frame in enumerate(frames_of(rgb, pan)):
        if number == 0:
            states, mask = _start(frame, pan, scene, name, stack)
        else:
            states, tracks = stack.tracker.step(states, [frame])
            mask = tracks[0][0].mask
        here = pan.boxes(number, pair)
        end = lies_on(mask, here)
        if visible_share(here[0], frame) >= IN_VIEW:
            counts["in_view"] += 1
            counts["on_object"] += end == "object"
        counts["on_twin"] += end == "twin"
    return {**counts, "end": end}


def _start(
    frame: Rgb, pan: Pan, scene: Scene, name: str, stack: Stack
) -> tuple[list[Any], Mask | None]:
    """The tracker of the first frame, and the object's mask there; the object is identity 0."""
    order = [name, *(other for other in scene.boxes if other != name)]
    known: list[np.ndarray] = []
    for other in order:
        for box in scene.boxes[other][:1].astype(np.float64):
            twin = box + np.array([pan.photo_width, 0.0, pan.photo_width, 0.0])
            known += [box, twin]
    here = pan.boxes(0, np.stack(known))
    kept = [i for i, box in enumerate(here) if i == 0 or visible_share(box, frame) >= IN_VIEW]
    height, width = frame.shape[:2]
    xyxy = np.clip(here[kept], 0, (width, height, width, height)).astype(np.float32)
    boxes = Boxes(xyxy, np.ones(len(xyxy), np.float32), "true boxes")
    masks = stack.segmenter(frame, judge(frame, boxes, stack))
    tracker = stack.tracker
    if isinstance(tracker, TargetTracker):
        return tracker.start_targets([frame], [masks], [[0]]), masks[0]
    return tracker.start([frame], [masks]), masks[0]


def visible_share(box: Float64[np.ndarray, "4"], frame: Rgb) -> float:
    """The share of a box that lies inside of the frame."""
    height, width = frame.shape[:2]
    inside = np.clip(box, 0, (width, height, width, height))
    sides = np.maximum(inside[2:] - inside[:2], 0)
    return float(sides.prod() / (box[2:] - box[:2]).prod())


def lies_on(mask: Mask | None, pair: Float64[np.ndarray, "2 4"]) -> str:
    """Where most of a mask lies: in the object's box, its twin's, or neither; "" for no mask."""
    if mask is None or not mask.any():
        return ""
    for name, box in zip(("object", "twin"), pair, strict=True):
        x0, y0, x1, y1 = np.maximum(np.round(box), 0).astype(int).tolist()
        if mask[y0:y1, x0:x1].sum() > 0.5 * mask.sum():
            return name
    return "other"
