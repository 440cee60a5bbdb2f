"""A photo in a notebook with a box to drag: the hand's way to say where an object is."""

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from vap_core.base.errors import require
from vap_core.base.types import Rgb
from vap_core.perception.references import Box

if TYPE_CHECKING:
    from jupyter_bbox_widget import BBoxWidget

SIDE_PX = 800
"""The longer side of the photo that is shown."""


def drag_box(photo: Rgb, box: Box, label: str) -> "BBoxWidget":
    """The photo with `box` on it; drag its corners or draw another one, then ask `dragged_box`.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """
    require("notebooks", "a box to drag")
    from jupyter_bbox_widget import BBoxWidget

    image = Image.fromarray(photo)
    image.thumbnail((SIDE_PX, SIDE_PX))
    shown = BytesIO()
    image.save(shown, "JPEG", quality=90)
    x0, y0, x1, y1 = (box * _scale(photo)).tolist()
    drawn = {"x": x0, "y": y0, "width": x1 - x0, "height": y1 - y0, "label": label}
    widget = BBoxWidget(classes=[label], bboxes=[drawn], hide_buttons=True)
    widget.image_bytes = shown.getvalue()
    return widget


def dragged_box(widget: "BBoxWidget", photo: Rgb) -> Box | None:
    """The last box of the widget, in the photo's pixels and inside it.

    None where none is left, or a side is less than a pixel: a click drags no box.
    """
    if not widget.bboxes:
        return None
    drawn = widget.bboxes[-1]
    x, y = drawn["x"], drawn["y"]
    box = np.array([x, y, x + drawn["width"], y + drawn["height"]]) / _scale(photo)
    height, width = photo.shape[:2]
    inside = np.clip(box, 0, (width, height, width, height)).astype(np.float32)
    return inside if (inside[2:] - inside[:2] >= 1).all() else None


def _scale(photo: Rgb) -> float:
    """Shown pixels per pixel of the photo."""
    return min(1.0, SIDE_PX / max(photo.shape[:2]))
