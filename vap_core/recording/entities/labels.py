"""Where the labels of boxes go in a picture, so that none covers another."""

from collections.abc import Sequence

import numpy as np

type Rect = tuple[float, float, float, float]
"""`x0 y0 x1 y1`, pixels."""
VIEW_POINTS = 170
"""Height of the smallest view among the layouts; text keeps its size on the screen."""
CHARACTER_POINTS, PADDING_POINTS, LINE_POINTS = 6.6, 12, 21


def are_disjoint(a: Rect, b: Rect) -> bool:
    """Whether two rectangles share no area."""
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def place_labels(
    xyxy: np.ndarray, labels: Sequence[str], shape: tuple[int, ...]
) -> dict[int, tuple[float, float]]:
    """The top centre of each label, pixels; labels without room are left out.

    The last label is the winner's: it takes the freer of the picture's top and bottom edges.
    """
    height, width = shape
    pixels_per_point = max(height, width) / VIEW_POINTS
    sizes = []
    for label in labels:
        label_width = (CHARACTER_POINTS * len(label) + PADDING_POINTS) * pixels_per_point
        sizes.append((label_width, LINE_POINTS * pixels_per_point))
    winner_height = sizes[-1][1]
    winner_top = 0.0
    if xyxy[:, 1].min() <= height - xyxy[:, 3].max():
        winner_top = height - winner_height
    occupied: list[Rect] = [
        (0.0, winner_top, float(width), winner_top + winner_height),
        tuple(xyxy[-1].tolist()),
    ]
    spots = {len(labels) - 1: (width / 2, winner_top)}
    for i, (box, size) in enumerate(zip(xyxy[:-1].tolist(), sizes[:-1], strict=True)):
        spot = _free_spot(box, size, occupied, width, height)
        if spot is not None:
            spots[i] = spot
            occupied.append(_label_rect(spot, size))
    return spots


def _free_spot(
    box: Sequence[float],
    size: tuple[float, float],
    occupied: Sequence[Rect],
    width: int,
    height: int,
) -> tuple[float, float] | None:
    """Below the box, above it, left or right of it: the first that covers nothing."""
    x0, y0, x1, y1 = box
    label_width, label_height = size
    centre = (x0 + x1) / 2
    level = (y0 + y1 - label_height) / 2
    places = (
        (centre, y1),
        (centre, y0 - label_height),
        (x0 - label_width / 2, level),
        (x1 + label_width / 2, level),
    )
    for x, y in places:
        x = min(max(x, label_width / 2), width - label_width / 2)
        rect = _label_rect((x, y), size)
        inside = y >= 0 and y + label_height <= height
        if inside and _covers_nothing(rect, occupied):
            return x, y
    return None


def _label_rect(spot: tuple[float, float], size: tuple[float, float]) -> Rect:
    x, y = spot
    width, height = size
    return (x - width / 2, y, x + width / 2, y + height)


def _covers_nothing(rect: Rect, occupied: Sequence[Rect]) -> bool:
    return all(are_disjoint(rect, other) for other in occupied)
