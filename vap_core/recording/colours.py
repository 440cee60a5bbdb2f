"""The palette as rerun wants it, and the styles of curves and state lanes."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from vap_core.base import pictures
from vap_core.base.pictures import Rgb8, rgb8

TARGET = rgb8(pictures.TARGET)
ELECTED = rgb8(pictures.ELECTED)
GOAL = rgb8(pictures.on_dark(pictures.GOAL))
LOOKALIKES = tuple(rgb8(colour) for colour in pictures.LOOKALIKES)
CAMERAS = tuple(rgb8(colour) for colour in pictures.CAMERAS)
MUTED = rgb8(pictures.FRAME)
"""What has no part of its own: candidates that were not elected, the robot."""
BACKGROUND = (24, 28, 36)
SERIES = (*CAMERAS[:2], *LOOKALIKES)
"""Curves of actions and states, which mean nothing by their colour."""


def camera_colour(i: int) -> Rgb8:
    """The grey of the i-th camera; greys repeat."""
    return CAMERAS[i % len(CAMERAS)]


def object_colours(names: Sequence[str], target: str, goal: str) -> dict[str, Rgb8]:
    """The colour of every object of a scene, by its part in the task."""
    colours = pictures.object_colours(names, target, goal)
    return {name: rgb8(colour) for name, colour in colours.items()}


def series_style(names: Sequence[str]) -> rr.SeriesLines:
    """Names, widths and visible colours for the curves of one entity."""
    colours = [SERIES[i % len(SERIES)] for i in range(len(names))]
    return rr.SeriesLines(names=list(names), colors=colours, widths=[1.5] * len(names))


def pack_rgba(rgb: Rgb8) -> np.uint32:
    """0xRRGGBBAA, opaque."""
    return np.uint32(rgb[0] << 24 | rgb[1] << 16 | rgb[2] << 8 | 0xFF)


def state_style(colours: Mapping[str, Rgb8]) -> rr.StateConfiguration:
    """One colour for each state of a lane."""
    return rr.StateConfiguration(
        values=list(colours),
        labels=list(colours),
        colors=[pack_rgba(rgb) for rgb in colours.values()],
    )


def image_root(camera: str) -> str:
    """The entity of a camera's pictures."""
    return f"/observation.images.{camera}"


def target_suffix(j: int) -> str:
    """What a further target's entities end in; nothing for the first target."""
    return f"_{j}" if j else ""
