"""Other forms of a prompt than the method's tint (P tab:ablation_prompt), each a few lines.

A form is called with the picture, the target's mask, the colour, and the masks of the other
candidates, which are none unless its `marks_others` is true; it returns a marked copy.
`prompt.PromptForm` is the protocol.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import cv2
import numpy as np
from jaxtyping import Float64

from vap_core.attend import Attender, AttendState, are_shown
from vap_core.base.types import Attended, Camera, Colour, Mask, Rgb
from vap_core.perception.boxes import mask_box
from vap_core.prompt import ALPHA
from vap_core.rollout.prompters import PromptContext, TintPrompter
from vap_core.simulation.cameras import project
from vap_core.simulation.control import pose_transform
from vap_core.simulation.types import Observation, Pose

LINE_PX = 2.0
"""Width of lines in a picture of 224 pixels; wider ones in larger pictures."""
MARKER_PX = 8.0
"""Radius of a numbered marker, likewise."""
POINT_PX = 4.0
SHADE = 0.35
"""What is left of the light outside the target, where the background is dimmed."""
ARROW_TIP = 0.12
"""The head of an arrow, as a share of its length."""
GROW_PX = 9
"""Side, an odd number, of the square by which a mask is grown before what it covers is erased."""


@dataclass(frozen=True)
class FilledBox:
    """The target's bounding box, tinted whole."""

    alpha: float = ALPHA

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        corners = _corners(mask)
        if corners is None:
            return out
        (x0, y0), (x1, y1) = corners
        mixed = (1.0 - self.alpha) * out[y0:y1, x0:x1] + self.alpha * np.asarray(colour.rgb)
        out[y0:y1, x0:x1] = np.rint(mixed).astype(np.uint8)
        return out


@dataclass(frozen=True)
class Contour:
    """The outline of the target's mask."""

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        outlines, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(out, outlines, -1, colour.rgb, _scaled(rgb, LINE_PX))
        return out


@dataclass(frozen=True)
class Point:
    """A dot in the middle of the target."""

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        centre = _centre(mask)
        if centre is not None:
            cv2.circle(out, centre, _scaled(rgb, POINT_PX), colour.rgb, cv2.FILLED)
        return out


@dataclass(frozen=True)
class Circle:
    """A circle round the target."""

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        if mask.any():
            pixels = np.argwhere(mask)[:, ::-1].astype(np.float32)
            centre, radius = cv2.minEnclosingCircle(pixels)
            whole = (round(centre[0]), round(centre[1]))
            line = _scaled(rgb, LINE_PX)
            cv2.circle(out, whole, round(radius) + line, colour.rgb, line)
        return out


@dataclass(frozen=True)
class NumberedMarker:
    """A numbered disc on every object that is followed; 1, in the colour, is the target's."""

    marks_others: ClassVar[bool] = True

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        for number, other in enumerate(others, start=2):
            _draw_marker(out, other, str(number), (96, 96, 96))
        _draw_marker(out, mask, "1", colour.rgb)
        return out


@dataclass(frozen=True)
class DimmedBackground:
    """All but the target is darker; the target has its own colours."""

    shade: float = SHADE

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        out = rgb.copy()
        if mask.any():
            out[~mask] = np.rint(self.shade * rgb[~mask]).astype(np.uint8)
        return out


@dataclass(frozen=True)
class OthersErased:
    """What else is followed is painted over from its surroundings; the target stays as it is."""

    marks_others: ClassVar[bool] = True

    def __call__(self, rgb: Rgb, mask: Mask, colour: Colour, others: Sequence[Mask]) -> Rgb:
        if not others:
            return rgb.copy()
        grown = np.ones((GROW_PX, GROW_PX), np.uint8)
        erased = cv2.dilate(np.any(others, axis=0).astype(np.uint8), grown)
        erased[mask] = 0
        return cv2.inpaint(rgb, erased, 3, cv2.INPAINT_TELEA)


def draw_arrow(rgb: Rgb, mask: Mask, colour: Colour, start_xy: tuple[int, int]) -> Rgb:
    """A copy with an arrow from a pixel, which may lie outside the picture, to the target."""
    out = rgb.copy()
    centre = _centre(mask)
    if centre is not None:
        line = _scaled(rgb, LINE_PX)
        cv2.arrowedLine(out, start_xy, centre, colour.rgb, line, tipLength=ARROW_TIP)
    return out


def _corners(mask: Mask) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The near and the far corner of a mask's box, the far one exclusive."""
    box = mask_box(mask)
    if box is None:
        return None
    x0, y0, x1, y1 = box.astype(int).tolist()
    return (x0, y0), (x1, y1)


def _centre(mask: Mask) -> tuple[int, int] | None:
    """The pixel of a mask that is farthest from its edge."""
    if not mask.any():
        return None
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return int(x), int(y)


def _draw_marker(out: Rgb, mask: Mask, text: str, rgb: tuple[int, int, int]) -> None:
    centre = _centre(mask)
    if centre is None:
        return
    radius = _scaled(out, MARKER_PX)
    cv2.circle(out, centre, radius, rgb, cv2.FILLED, cv2.LINE_AA)
    scale = radius / 16
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    origin = (centre[0] - width // 2, centre[1] + height // 2)
    cv2.putText(out, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)


def _scaled(rgb: Rgb, pixels: float) -> int:
    """A width for a picture of 224 pixels, in this picture."""
    return max(1, round(pixels * min(rgb.shape[:2]) / 224))


FARTHEST_PX = 4096.0
"""A hand that is not in the picture is drawn from at most so far outside it."""


@dataclass(frozen=True)
class Arrow:
    """An arrow from the gripper to the middle of the target, in every view at every step."""


class ArrowPrompter:
    """Grounds and tracks by an `Attender` that tints nothing, and draws the arrow.

    `base_world` is the pose of the robot's base.
    """

    needs_truth: Literal["never", "start", "always"] = "never"
    highlights = True

    def __init__(self, attender: Attender, base_world: Pose) -> None:
        self.follower = TintPrompter(attender)
        self.world_from_base = pose_transform(base_world)

    @property
    def references(self) -> Mapping[str, tuple[Rgb, ...]]:
        return self.follower.references

    def start(
        self, observation: Observation, context: PromptContext
    ) -> tuple[AttendState, Attended]:
        state, attended = self.follower.start(observation, context)
        return state, self._draw(attended, observation, context)

    def steps(
        self,
        states: Sequence[AttendState],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[AttendState, Attended]]:
        followed = self.follower.steps(states, observations, contexts)
        return [
            (state, self._draw(attended, observation, context))
            for (state, attended), observation, context in zip(
                followed, observations, contexts, strict=True
            )
        ]

    def _draw(
        self, attended: Attended, observation: Observation, context: PromptContext
    ) -> Attended:
        """The attended images with an arrow to every target that is followed, one to a place."""
        images = dict(attended.images)
        hand_world = self.world_from_base.apply(observation.state[:3].astype(np.float64))
        for camera, tracks in attended.tracks.items():
            start = hand_pixel(context.cameras[camera], hand_world)
            shown = are_shown(tracks)
            for track, is_shown, colour in zip(tracks, shown, attended.colours, strict=True):
                if is_shown and track.mask is not None and start is not None:
                    images[camera] = draw_arrow(images[camera], track.mask, colour, start)
        return replace(attended, images=images)


def hand_pixel(camera: Camera, hand_world: Float64[np.ndarray, "3"]) -> tuple[int, int] | None:
    """The pixel of the gripper's tcp; None behind the camera, where nothing is drawn."""
    xy = project(camera, hand_world[None])[0]
    if not np.isfinite(xy).all():
        return None
    x, y = np.clip(xy, -FARTHEST_PX, FARTHEST_PX)
    return round(float(x)), round(float(y))
