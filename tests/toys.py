"""A ten-line stack of exact parts: objects are flat squares of one colour on black, so every answer is known."""

from collections.abc import Sequence
from copy import copy

import numpy as np

from vap_core.base.types import Boxes, Camera, PersonalObject, Rgb, Track, Views
from vap_core.perception.protocols import Stack
from vap_core.rollout.types import Frame
from vap_core.simulation.types import Observation, Outcome


def scene(
    squares: Sequence[tuple[int, int, tuple[int, int, int]]], size: int = 64, side: int = 12
) -> Rgb:
    """Squares at (x, y) of an RGB colour on black."""
    rgb = np.zeros((size, size, 3), np.uint8)
    for x, y, colour in squares:
        rgb[y : y + side, x : x + side] = colour
    return rgb


def detector(images: Sequence[Rgb], phrase: str, threshold: float | None = None) -> list[Boxes]:
    """Every connected square, left to right; "nothing" finds nothing."""
    return [Boxes.empty(phrase) if phrase == "nothing" else _squares(rgb, phrase) for rgb in images]


def _squares(rgb: Rgb, phrase: str) -> Boxes:
    from scipy.ndimage import find_objects, label

    found = find_objects(label(rgb.any(axis=2))[0])
    xyxy = sorted([s[1].start, s[0].start, s[1].stop, s[0].stop] for s in found)
    return Boxes(np.array(xyxy, np.float32).reshape(-1, 4), np.ones(len(xyxy), np.float32), phrase)


class MeanColour:
    """Embeds a crop as its normalised mean colour."""

    name = "mean-colour"

    def __call__(self, crops: Sequence[Rgb]) -> np.ndarray:
        if not crops:
            return np.zeros((0, 3), np.float32)
        lit = [crop[crop.any(axis=2)].astype(np.float32).mean(axis=0) for crop in crops]
        return np.stack([v / np.linalg.norm(v) for v in lit]).astype(np.float32)


def segmenter(image: Rgb, boxes: Boxes) -> np.ndarray:
    """The lit pixels inside each box."""
    masks = np.zeros((len(boxes), *image.shape[:2]), bool)
    for i, (x0, y0, x1, y1) in enumerate(boxes.xyxy.astype(int)):
        masks[i, y0:y1, x0:x1] = image[y0:y1, x0:x1].any(axis=2)
    return masks


class SameColour:
    """Follows every identity by its exact colour."""

    def start(self, images: Sequence[Rgb], masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [
            np.array([rgb[m][0] for m in per_view])
            for rgb, per_view in zip(images, masks, strict=True)
        ]

    def step(
        self, states: Sequence[np.ndarray], images: Sequence[Rgb]
    ) -> tuple[list[np.ndarray], list[tuple[Track, ...]]]:
        found = [
            tuple(_track((rgb == colour).all(axis=2)) for colour in state)
            for state, rgb in zip(states, images, strict=True)
        ]
        return list(states), found


def _track(mask: np.ndarray) -> Track:
    return Track(mask, 1.0) if mask.any() else Track(None, 0.0)


TOYS = Stack("toys", detector, MeanColour(), segmenter, SameColour())


def personal(name: str, category: str, *colours: tuple[int, int, int]) -> PersonalObject:
    """An object remembered by flat crops of these colours."""
    crops = tuple(np.full((12, 12, 3), colour, np.uint8) for colour in colours)
    return PersonalObject(name, category, MeanColour()(crops), crops, MeanColour.name)


def observation(views: Views) -> Observation:
    """These views of a robot whose state is zero."""
    return Observation(views, np.zeros(7, np.float32))


class Kept:
    """A sink that keeps every frame whole."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def frame(self, frame: Frame) -> None:
        self.frames.append(frame)

    def close(self, outcome: Outcome) -> None:
        pass


def overhead(name: str, x: float) -> Camera:
    """Looks straight down from 1 m above (x, 0), 64 x 64 pixels of 1 / 64 m."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = x, 0.0, 1.0
    return Camera(name, 64, 64, np.array([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]]), pose)


def unchecked[T](value: T, **fields: object) -> T:
    """A copy with other fields, built as outside of tests: without a check of their types."""
    made = copy(value)
    for name, field in fields.items():
        object.__setattr__(made, name, field)
    return made
