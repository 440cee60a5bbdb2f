"""How the scripted policy sees: words and pixels in, places on the table out. Everything here is what a VLA reads, and nothing more.

Its camera is calibrated once, as a trained VLA is bound to one camera set-up.
"""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.types import Boxes, Camera, Colour, Rgb, value
from vap_core.instruction import leading_category
from vap_core.perception.protocols import Detector
from vap_core.prompt import PALETTE, has_colour
from vap_core.simulation.types import Pose

SPAN = re.compile(
    rf"\b(?:the\s+(?P<colour>{'|'.join(c.name for c in PALETTE)})|my|the|a|an)\s+", re.IGNORECASE
)
PLACE = re.compile(
    r"\b(?P<how>near|on|onto|in|into|inside)\s+(?:(?:the|a|an|my)\s+)?", re.IGNORECASE
)
TOUCH = re.compile(r"\b(?:select|touch|point)\b", re.IGNORECASE)
COLOURED = 0.25
"""A candidate carries a colour when at least this share of its box looks like it."""
SURE = 0.2
"""Candidates with at least this share of the best one's score may be meant: a detector likes some instances better, which must not decide."""
WIDEST_M = 0.15
"""Radius of the widest thing that something is put on, metres."""
RING = np.stack(
    [
        np.cos(np.linspace(0, 2 * np.pi, 24, endpoint=False)),
        np.sin(np.linspace(0, 2 * np.pi, 24, endpoint=False)),
    ],
    axis=1,
)


@value
class Command:
    """What an instruction asks for: do what (`verb`) with which category, in which colour if one is named, beside or on what ("" nothing)."""

    verb: str
    colour: Colour | None
    category: str
    goal: str = ""


def read(text: str) -> Command:
    """ "put the red camera on the plate" -> put, red, camera, plate. Verbs are pick, put, near and touch."""
    spans = list(SPAN.finditer(text))
    best = next((span for span in spans if span["colour"]), spans[0] if spans else None)
    if best is None:
        return Command("pick", None, text.strip().lower())
    colour = next((c for c in PALETTE if best["colour"] and c.name == best["colour"].lower()), None)
    category, _ = leading_category(text[best.end() :])
    place = PLACE.search(text, best.end())
    goal = leading_category(text[place.end() :])[0] if place else ""
    if place and goal and goal != "table":
        return Command("near" if place["how"].lower() == "near" else "put", colour, category, goal)
    return Command("touch" if TOUCH.search(text) else "pick", colour, category)


@dataclass(frozen=True)
class MonocularLocalizer:
    """One calibrated fixed camera. `thick_m`: what the hand can grasp is no thicker than this around its axis; a wider box has a handle."""

    detector: Detector
    camera: Camera
    base_world: Pose
    thick_m: float

    @property
    def table_z(self) -> float:
        """Of the table's top, in the robot's base frame, metres."""
        return -float(self.base_world[2])

    def choose(
        self, rgb: Rgb, wish: Command, draw: float, before: Float64[np.ndarray, "4"] | None
    ) -> Float64[np.ndarray, "4"] | None:
        """Where the object that is meant stands (`place`); None when nothing of the category is seen.

        A colour that is named and seen decides. Without one, any of the category is taken, by `draw` (0..1), and kept: the one nearest to
        `before`, if it is still there.
        """
        boxes = self.detector([rgb], wish.category)[0]
        shares = (
            coloured(rgb, boxes, wish.colour) if wish.colour is not None else np.zeros(len(boxes))
        )
        if len(boxes) and shares.max() >= COLOURED:
            return self.place(boxes.xyxy[int(shares.argmax())], self.thick_m)
        if not len(boxes):
            return None
        if before is not None:
            places = [self.place(box, self.thick_m) for box in boxes.xyxy]
            nearest = min(places, key=lambda place: float(np.hypot(*(place - before)[:2])))
            return nearest if np.hypot(*(nearest - before)[:2]) < 0.05 else None
        sure = boxes.xyxy[boxes.score >= SURE * boxes.score[0]]
        return self.place(sure[int(draw * len(sure))], self.thick_m)

    def find(self, rgb: Rgb, category: str) -> Float64[np.ndarray, "4"] | None:
        """Where the surest thing of a category stands; None when there is none."""
        boxes = self.detector([rgb], category)[0]
        return self.place(boxes.xyxy[0], WIDEST_M) if len(boxes) else None

    def place(self, box: Float32[np.ndarray, "4"], thick_m: float) -> Float64[np.ndarray, "4"]:
        """Base-frame x, y of an upright object's axis, its radius and height, metres: the cylinder on the table whose outline fills the box."""
        from scipy.optimize import least_squares

        x0, _, x1, y1 = box.astype(np.float64)
        turn, eye = self._base_from_camera()
        foot = turn @ np.linalg.inv(self.camera.k) @ np.array([(x0 + x1) / 2, y1, 1.0])
        near = eye + foot * (self.table_z - eye[2]) / min(foot[2], -0.05)
        guess = np.array([near[0], near[1], 0.8 * thick_m, 0.08])
        low, high = (
            np.array([-2.0, -2.0, 0.5 * min(thick_m, 0.03), 0.02]),
            np.array([2.0, 2.0, thick_m, 0.25]),
        )
        fit = least_squares(
            lambda v: self._outline(v) - box,
            np.clip(guess, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            max_nfev=20,
        )
        return fit.x

    def _outline(self, cylinder: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "4"]:
        """The box around the picture of a cylinder on the table: x, y of its axis, radius and height, metres."""
        x, y, radius, height = cylinder
        rim = radius * RING + (x, y)
        points = np.concatenate(
            [np.c_[rim, np.full(len(rim), self.table_z + z)] for z in (0.0, height)]
        )
        turn, eye = self._base_from_camera()
        local = (points - eye) @ turn
        pixels = (local[:, :2] / local[:, 2:]) * (
            self.camera.k[0, 0],
            self.camera.k[1, 1],
        ) + self.camera.k[:2, 2]
        return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])

    def _base_from_camera(self) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
        found = np.linalg.inv(_matrix(self.base_world)) @ self.camera.pose_world
        return found[:3, :3], found[:3, 3]


def coloured(rgb: Rgb, boxes: Boxes, colour: Colour) -> Float64[np.ndarray, " n"]:
    """The share of each box's pixels that look like `colour`."""
    shares = np.zeros(len(boxes))
    for i, (x0, y0, x1, y1) in enumerate(np.rint(boxes.xyxy).astype(int)):
        inside = rgb[max(y0, 0) : y1, max(x0, 0) : x1]
        shares[i] = has_colour(inside, colour).mean() if inside.size else 0.0
    return shares


def _matrix(pose: Pose) -> Float64[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    out[:3, 3] = pose[:3]
    return out
