"""The colours of a recording, and the styles of its curves and state lanes."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

type Rgb8 = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

TARGET = (255, 150, 40)
"""The winner of the vote, the track and the target object: one orange everywhere."""
OTHER = (126, 160, 205)
"""Every other candidate and object."""
TRUTH = (60, 230, 150)
"""Simulator ground truth."""
SERIES = [
    (88, 166, 255),
    (255, 150, 40),
    (60, 210, 140),
    (240, 100, 110),
    (190, 140, 255),
    (235, 205, 90),
    (120, 215, 235),
    (200, 200, 200),
]
"""Curves on a dark plot: no dark colour among them."""
BACKGROUND = (24, 28, 36)


def series_colour(i: int) -> Rgb8:
    """The colour of the i-th curve; colours repeat."""
    return SERIES[i % len(SERIES)]


def series_style(names: Sequence[str]) -> rr.SeriesLines:
    """Names, widths and visible colours for the curves of one entity."""
    colours = []
    for i in range(len(names)):
        colours.append(series_colour(i))
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
