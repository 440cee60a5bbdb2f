"""How the scripted policy reads its inputs: text and pixels in, places on the table out.

Everything here is what a VLA reads, and nothing more. Its camera is calibrated once, as a trained
VLA is bound to one camera set-up.
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

COLOUR_NAMES = "|".join(colour.name for colour in PALETTE)
OWNER = r"(?:my|his|her)(?:\s+[\w-]+['’]s)?"
"""A possessive, with an owner beside the speaker: "my brother's"."""
SPAN = re.compile(rf"\b(?:the\s+(?P<colour>{COLOUR_NAMES})|{OWNER}|the|a|an)\s+", re.IGNORECASE)
"""The words before a category: an article, a possessive, or "the" with a colour."""
PLACE = re.compile(
    r"\b(?P<how>near|next to|beside|on|onto|in|into|inside)\s+"
    rf"(?:(?:the\s+(?P<colour>{COLOUR_NAMES})|{OWNER}|the|a|an)\s+)?",
    re.IGNORECASE,
)
NEAR = ("near", "next to", "beside")
TOUCH = re.compile(r"\b(?:select|touch|point)\b", re.IGNORECASE)
COLOURED = 0.25
"""A candidate has a colour when at least this share of its box does."""
CONFIDENT = 0.2
"""Candidates with at least this share of the best one's score may be meant: a detector likes some
instances better, which must not decide."""
STAYED_M = 0.05
"""An object that is farther away than this from where the chosen one was is another object."""
WIDEST_M = 0.15
"""Radius of the widest thing that something is put on, metres."""
_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)
RING = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Points of the unit circle."""

Place = Float64[np.ndarray, "4"]
"""Where an upright object stands: x, y of its axis in the robot's base frame, radius, height."""


@value
class Command:
    """What an instruction asks for: a verb, the target's colour and category, and a goal.

    `verb` is pick, put, near or touch; a colour None and `goal` "" where the text names none.
    """

    verb: str
    colour: Colour | None
    category: str
    goal: str = ""
    goal_colour: Colour | None = None


def read(text: str) -> Command:
    """The command in a text: "put the red camera on the plate" is put, red, camera, plate."""
    span = _target_span(text)
    if span is None:
        return Command("pick", None, text.strip().lower())
    colour = _colour_named(span["colour"])
    category, _ = leading_category(text[span.end() :])
    place = PLACE.search(text, span.end())
    if place:
        goal, _ = leading_category(text[place.end() :])
        if goal and goal != "table":
            verb = "near" if place["how"].lower() in NEAR else "put"
            return Command(verb, colour, category, goal, _colour_named(place["colour"]))
    verb = "touch" if TOUCH.search(text) else "pick"
    return Command(verb, colour, category)


@dataclass(frozen=True)
class MonocularLocalizer:
    """Finds objects on the table by one calibrated fixed camera.

    `thick_m`: what the hand can grasp is no thicker than this around its axis; a wider box has a
    handle.
    """

    detector: Detector
    camera: Camera
    base_world: Pose
    thick_m: float

    @property
    def table_z(self) -> float:
        """Of the table's top, in the robot's base frame, metres."""
        return -float(self.base_world[2])

    def choose(self, rgb: Rgb, command: Command, draw: float, before: Place | None) -> Place | None:
        """Where the object that is meant stands; None when nothing of the category is seen.

        A colour that is named and seen decides. Without one, any of the category is taken, by
        `draw` (0..1), and kept: the one nearest to `before`, if it is still there.
        """
        boxes = self.detector([rgb], command.category)[0]
        if not len(boxes):
            return None
        if command.colour is not None:
            shares = coloured(rgb, boxes, command.colour)
            if shares.max() >= COLOURED:
                best = int(shares.argmax())
                return self.place(boxes.xyxy[best], self.thick_m)
        if before is not None:
            return self._nearest(boxes, before)
        confident = boxes.xyxy[boxes.score >= CONFIDENT * boxes.score[0]]
        drawn = int(draw * len(confident))
        return self.place(confident[drawn], self.thick_m)

    def find(self, rgb: Rgb, category: str, colour: Colour | None = None) -> Place | None:
        """Where the most confident box of a category stands; None when there is none.

        A colour that is named and seen decides.
        """
        boxes = self.detector([rgb], category)[0]
        if not len(boxes):
            return None
        chosen = 0
        if colour is not None:
            shares = coloured(rgb, boxes, colour)
            if shares.max() >= COLOURED:
                chosen = int(shares.argmax())
        return self.place(boxes.xyxy[chosen], WIDEST_M)

    def place(self, box: Float32[np.ndarray, "4"], thick_m: float) -> Place:
        """The place of an upright object by its box: that of the cylinder whose outline fills it.

        The cylinder stands on the table; its radius is `thick_m` at most.
        """
        from scipy.optimize import least_squares

        x0, _, x1, y1 = box.astype(np.float64)
        turn, eye = self._base_from_camera()
        foot = turn @ np.linalg.inv(self.camera.k) @ np.array([(x0 + x1) / 2, y1, 1.0])
        on_table = eye + foot * (self.table_z - eye[2]) / min(foot[2], -0.05)
        guess = np.array([on_table[0], on_table[1], 0.8 * thick_m, 0.08])
        low = np.array([-2.0, -2.0, 0.5 * min(thick_m, 0.03), 0.02])
        high = np.array([2.0, 2.0, thick_m, 0.25])

        def residual(cylinder: Place) -> Float64[np.ndarray, "4"]:
            return self._outline(cylinder) - box

        start = np.clip(guess, low + 1e-6, high - 1e-6)
        fit = least_squares(residual, start, bounds=(low, high), max_nfev=20)
        return fit.x

    def _nearest(self, boxes: Boxes, before: Place) -> Place | None:
        """The place nearest to `before`; None when it is too far away."""
        places = []
        distances = []
        for box in boxes.xyxy:
            place = self.place(box, self.thick_m)
            places.append(place)
            distance = np.hypot(*(place - before)[:2])
            distances.append(float(distance))
        nearest = int(np.argmin(distances))
        if distances[nearest] < STAYED_M:
            return places[nearest]
        return None

    def _outline(self, cylinder: Place) -> Float64[np.ndarray, "4"]:
        """The box (pixels) around the picture of a cylinder on the table."""
        x, y, radius, height = cylinder
        rim = radius * RING + (x, y)
        bottom = np.c_[rim, np.full(len(rim), self.table_z)]
        top = np.c_[rim, np.full(len(rim), self.table_z + height)]
        turn, eye = self._base_from_camera()
        points = (np.concatenate([bottom, top]) - eye) @ turn
        k = self.camera.k
        pixels = (points[:, :2] / points[:, 2:]) * (k[0, 0], k[1, 1]) + k[:2, 2]
        return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])

    def _base_from_camera(self) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
        """Rotation from camera to robot base axes, and the camera's position in the base frame."""
        pose = np.linalg.inv(_matrix(self.base_world)) @ self.camera.pose_world
        return pose[:3, :3], pose[:3, 3]


def coloured(rgb: Rgb, boxes: Boxes, colour: Colour) -> Float64[np.ndarray, " n"]:
    """The share of each box's pixels that have `colour`."""
    shares = np.zeros(len(boxes))
    for i, (x0, y0, x1, y1) in enumerate(np.rint(boxes.xyxy).astype(int)):
        inside = rgb[max(y0, 0) : y1, max(x0, 0) : x1]
        if inside.size:
            shares[i] = has_colour(inside, colour).mean()
    return shares


def _target_span(text: str) -> re.Match[str] | None:
    """The first span that names a colour, else the first one; of those before a place, if any."""
    spans = list(SPAN.finditer(text))
    place = PLACE.search(text)
    if place and spans and spans[0].start() < place.start():
        spans = [span for span in spans if span.start() < place.start()]
    for span in spans:
        if span["colour"]:
            return span
    return spans[0] if spans else None


def _colour_named(name: str | None) -> Colour | None:
    if name is None:
        return None
    for colour in PALETTE:
        if colour.name == name.lower():
            return colour
    return None


def _matrix(pose: Pose) -> Float64[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix
