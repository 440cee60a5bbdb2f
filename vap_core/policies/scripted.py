"""A scripted baseline that reads only what a VLA reads: prompted images, text and proprioception.

It grounds a colour word in pixels ("the red cup" -> the cup whose pixels look red) and otherwise takes any object of the
category; then it reaches, grasps and lifts through the same chunked end-effector deltas as a learned policy. Like a
trained VLA it is bound to one camera set-up: its calibration is a constant, not an input. It never sees simulator state.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.detect import Detector
from vap_core.instruction import leading_category
from vap_core.prompt import PALETTE, looks_like
from vap_core.values import Boxes, Camera, Chunk, Colour, PolicyInput, Pose, Rgb, value

SPAN = re.compile(rf"\b(?:the\s+(?P<colour>{'|'.join(c.name for c in PALETTE)})|my|the|a|an)\s+", re.IGNORECASE)
COLOURED = 0.25
"""A candidate carries a colour when at least this share of its box looks like it."""
STEP_M = 0.030
"""Furthest travel of one action, metres."""
GAIN = 0.7
"""Share of the remaining way that one action asks for; below 1 so that a lagging arm does not overshoot."""
RING = np.stack([np.cos(np.linspace(0, 2 * np.pi, 24, endpoint=False)), np.sin(np.linspace(0, 2 * np.pi, 24, endpoint=False))], axis=1)


@dataclass(frozen=True)
class Manner:
    """How one robot is moved: heights above the table in metres, durations in control steps."""

    hover_m: float = 0.17
    lift_m: float = 0.20
    arrived_m: float = 0.012
    close_steps: int = 4
    grasp_share: float = 0.62
    """Grasp height as a share of the object's height."""
    radius_m: float = 0.021
    """What it can grasp is no thicker than this around its axis; a wider box has a handle."""
    empty: float = 0.08
    """A closed gripper that reads less than this holds nothing: try again."""


@value
class ScriptedState:
    """Memory of one episode: where the chosen object stands (x, y, height; robot base frame) and what the hand is doing."""

    draw: float
    goal: Float64[np.ndarray, "3"] | None
    phase: Literal["seek", "above", "descend", "close", "lift"]
    wait: int


class Scripted:
    """The scripted policy for one robot and one calibrated fixed camera."""

    label = "scripted"

    def __init__(self, detector: Detector, camera: Camera, base_world: Pose, manner: Manner | None = None, execute: int = 2) -> None:
        self.detector = detector
        self.camera = camera
        self.base_from_camera = np.linalg.inv(_matrix(base_world)) @ camera.pose_world
        self.table_z = -float(base_world[2])
        self.manner = manner or Manner()
        self.execute = execute

    def start(self, rng: np.random.Generator) -> ScriptedState:
        return ScriptedState(float(rng.random()), None, "seek", 0)

    def plan(self, states: Sequence[ScriptedState], inputs: Sequence[PolicyInput]) -> tuple[list[ScriptedState], list[Chunk]]:
        pairs = [self._plan(state, seen) for state, seen in zip(states, inputs, strict=True)]
        return [state for state, _ in pairs], [chunk for _, chunk in pairs]

    def _plan(self, state: ScriptedState, seen: PolicyInput) -> tuple[ScriptedState, Chunk]:
        if state.phase in ("seek", "above"):
            goal = self._look(state, seen)
            state = ScriptedState(state.draw, state.goal if goal is None else goal, state.phase, state.wait)
        hand = seen.state[:3].astype(np.float64)
        state = self._advance(state, hand, float(seen.state[6]))
        if state.goal is None:
            still = np.zeros((self.execute, 7), np.float32)
            still[:, 6] = 1.0
            return state, still
        aim, open_ = self._aim(state)
        rows = []
        for _ in range(self.execute):
            delta = GAIN * (aim - hand)
            delta *= min(1.0, STEP_M / max(float(np.linalg.norm(delta)), 1e-9))
            hand = hand + delta
            rows.append([*delta, 0.0, 0.0, 0.0, open_])
        return state, np.asarray(rows, np.float32)

    def _advance(self, state: ScriptedState, hand: Float64[np.ndarray, "3"], opening: float) -> ScriptedState:
        """Move on to the next phase when this one's aim is reached."""
        if state.goal is None:
            return state
        if state.phase == "seek":
            return ScriptedState(state.draw, state.goal, "above", 0)
        aim, _ = self._aim(state)
        off = np.abs(aim - hand)
        level, near = bool(np.hypot(off[0], off[1]) < self.manner.arrived_m), bool(off[2] < self.manner.arrived_m)
        if state.phase == "above" and level and off[2] < 0.03:
            return ScriptedState(state.draw, state.goal, "descend", 0)
        if state.phase == "descend" and (near or state.wait >= 10):
            return ScriptedState(state.draw, state.goal, "close", 0)
        if state.phase == "close" and state.wait >= self.manner.close_steps:
            return ScriptedState(state.draw, state.goal, "lift", 0)
        if state.phase == "lift" and opening < self.manner.empty:
            return ScriptedState(state.draw, state.goal, "above", 0)
        return ScriptedState(state.draw, state.goal, state.phase, state.wait + self.execute)

    def _aim(self, state: ScriptedState) -> tuple[np.ndarray, float]:
        """Where the hand should be (base frame, metres) and how far open."""
        assert state.goal is not None
        x, y, height = state.goal
        grasp = max(self.manner.grasp_share * height, 0.03)
        z, open_ = {
            "above": (max(self.manner.hover_m, height + 0.05), 1.0),
            "descend": (grasp, 1.0),
            "close": (grasp, 0.0),
            "lift": (grasp + self.manner.lift_m, 0.0),
        }[state.phase]
        return np.array([x, y, self.table_z + z]), open_

    def _look(self, state: ScriptedState, seen: PolicyInput) -> Float64[np.ndarray, "3"] | None:
        """Choose an object in the picture and place it on the table; None when nothing of the category is seen."""
        rgb = seen.images[self.camera.name]
        colour, category = read(seen.text)
        boxes = self.detector([rgb], category)[0]
        places = [self._place(box) for box in boxes.xyxy]
        shares = coloured(rgb, boxes, colour) if colour is not None else np.zeros(len(boxes))
        if len(boxes) and shares.max() >= COLOURED:
            return places[int(shares.argmax())]
        if not len(boxes):
            return None
        if state.goal is not None:
            nearest = min(places, key=lambda place: float(np.hypot(*(place - state.goal)[:2])))
            return nearest if np.hypot(*(nearest - state.goal)[:2]) < 0.05 else None
        sure = [place for place, score in zip(places, boxes.score, strict=True) if score >= 0.5 * boxes.score[0]]
        return sure[int(state.draw * len(sure))]

    def _place(self, box: Float32[np.ndarray, "4"]) -> Float64[np.ndarray, "3"]:
        """Base-frame x, y of an upright object's axis and its height, metres: the cylinder on the table whose outline fills the box."""
        from scipy.optimize import least_squares

        x0, _, x1, y1 = box.astype(np.float64)
        eye, foot = self.base_from_camera[:3, 3], self._ray((x0 + x1) / 2, y1)
        near = eye + foot * (self.table_z - eye[2]) / min(foot[2], -0.05)
        thick = self.manner.radius_m
        guess = np.array([near[0], near[1], 0.8 * thick, 0.08])
        low, high = np.array([-2.0, -2.0, 0.5 * thick, 0.02]), np.array([2.0, 2.0, thick, 0.25])
        fit = least_squares(lambda v: self._outline(v) - box, np.clip(guess, low + 1e-6, high - 1e-6), bounds=(low, high), max_nfev=20)
        return fit.x[[0, 1, 3]]

    def _outline(self, cylinder: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "4"]:
        """The box around the picture of a cylinder on the table: x, y of its axis, radius and height, metres."""
        x, y, radius, height = cylinder
        rim = radius * RING + (x, y)
        points = np.concatenate([np.c_[rim, np.full(len(rim), self.table_z + z)] for z in (0.0, height)])
        local = (points - self.base_from_camera[:3, 3]) @ self.base_from_camera[:3, :3]
        pixels = (local[:, :2] / local[:, 2:]) * (self.camera.k[0, 0], self.camera.k[1, 1]) + self.camera.k[:2, 2]
        return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])

    def _ray(self, u: float, v: float) -> Float64[np.ndarray, "3"]:
        return self.base_from_camera[:3, :3] @ np.linalg.inv(self.camera.k) @ np.array([u, v, 1.0])


def read(text: str) -> tuple[Colour | None, str]:
    """The colour word, if any, and the category noun of an instruction: "pick up the red cup" -> (red, "cup")."""
    spans = list(SPAN.finditer(text))
    best = next((span for span in spans if span["colour"]), spans[0] if spans else None)
    if best is None:
        return None, text.strip().lower()
    colour = next((c for c in PALETTE if best["colour"] and c.name == best["colour"].lower()), None)
    return colour, leading_category(text[best.end() :])[0]


def coloured(rgb: Rgb, boxes: Boxes, colour: Colour) -> Float64[np.ndarray, " n"]:
    """The share of each box's pixels that look like `colour`."""
    shares = np.zeros(len(boxes))
    for i, (x0, y0, x1, y1) in enumerate(np.rint(boxes.xyxy).astype(int)):
        inside = rgb[max(y0, 0) : y1, max(x0, 0) : x1]
        shares[i] = looks_like(inside, colour).mean() if inside.size else 0.0
    return shares


def _matrix(pose: Pose) -> Float64[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    out[:3, 3] = pose[:3]
    return out
