"""A scripted baseline that reads only what a VLA reads: prompted images, text and proprioception.

It grounds a colour word in pixels ("the red cup" -> the cup whose pixels look red) and otherwise takes any object of the category; then it
picks, puts down or touches through the same chunked actions as a learned policy, in either control. It never sees simulator state.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import Camera, value
from vap_core.perception.protocols import Detector
from vap_core.policies.hooks import TEXT, report_input
from vap_core.policies.protocol import Chunk, PolicyInput
from vap_core.policies.scripted.localizer import Command, MonocularLocalizer, read
from vap_core.simulation.control import LEASH, arm
from vap_core.simulation.robots import Robot

SPEED_M_S = 0.20
"""Of the hand."""
GAIN = 0.7
"""Share of the remaining way that one action asks for; below 1 so that a lagging arm does not overshoot."""
THINK_S = 0.4
"""Between two looks at the picture; what is planned in between is carried out."""
LOOKING = ("seek", "above")
Phase = Literal["seek", "above", "descend", "close", "lift", "carry", "lower", "open", "leave"]


@dataclass(frozen=True)
class Manner:
    """How one robot is moved: heights above the table in metres, durations in seconds."""

    thick_m: float = 0.021
    """MonocularLocalizer.thick_m: about half of what fits between the fingers."""
    hover_m: float = 0.17
    lift_m: float = 0.20
    arrived_m: float = 0.012
    close_s: float = 0.8
    grasp_share: float = 0.62
    """Grasp height as a share of the object's height."""
    patience_s: float = 2.0
    """Longest wait for an aim that is not quite reached."""
    empty: float = 0.08
    """A closed gripper that reads less than this holds nothing: try again."""


MANNERS = {
    "wx250s": Manner(),
    "panda": Manner(),
    "google": Manner(thick_m=0.035, hover_m=0.20, close_s=1.4, arrived_m=0.02),
    "so101": Manner(thick_m=0.028, hover_m=0.13, lift_m=0.09, close_s=0.6),
}
BESIDE_M = 0.075
"""Room between a thing and what it is put near to: inside the rule's 10 cm."""


@value
class ScriptedState:
    """Memory of one episode: where the chosen object and its goal stand (x, y, radius, height; base frame, m), what the hand is doing and for how
    long (s), and the joints that were last asked for."""

    draw: float
    goal: Float64[np.ndarray, "4"] | None
    phase: Phase
    waited_s: float
    spot: Float64[np.ndarray, "3"] | None = None
    joints: Float64[np.ndarray, " n"] | None = None


class Scripted:
    """The scripted policy for one robot, one calibrated fixed camera and one control."""

    label = "scripted"

    def __init__(
        self,
        detector: Detector,
        camera: Camera,
        robot: Robot,
        hz: float,
        control: Literal["ee", "joint"] = "ee",
    ) -> None:
        self.robot = robot
        self.manner = MANNERS[robot.name]
        self.eye = MonocularLocalizer(detector, camera, robot.base_world, self.manner.thick_m)
        self.control = control
        self.hz = hz
        self.execute = max(1, round(THINK_S * hz))

    def start(self, rng: np.random.Generator) -> ScriptedState:
        return ScriptedState(float(rng.random()), None, "seek", 0.0)

    def plan(
        self, states: Sequence[ScriptedState], inputs: Sequence[PolicyInput]
    ) -> tuple[list[ScriptedState], list[Chunk]]:
        for i, (state, seen) in enumerate(zip(states, inputs, strict=True)):
            report_input(i, TEXT, seen.text)
            if state.phase in LOOKING:
                report_input(i, self.eye.camera.name, seen.images[self.eye.camera.name])
        pairs = [self._plan(state, seen) for state, seen in zip(states, inputs, strict=True)]
        return [state for state, _ in pairs], [chunk for _, chunk in pairs]

    def _plan(self, state: ScriptedState, seen: PolicyInput) -> tuple[ScriptedState, Chunk]:
        wish, rgb = read(seen.text), seen.images[self.eye.camera.name]
        if state.phase in LOOKING:
            found = self.eye.choose(rgb, wish, state.draw, state.goal)
            state = replace(state, goal=state.goal if found is None else found)
        if wish.goal and state.goal is not None and state.spot is None:
            state = replace(state, spot=self._spot(self.eye.find(rgb, wish.goal), state.goal, wish))
        hand, joints = seen.state[:3].astype(np.float64), seen.state[7:].astype(np.float64)
        state = self._advance(state, wish, hand, float(seen.state[6]))
        if state.joints is None or np.abs(state.joints - joints).max() > LEASH:
            state = replace(state, joints=joints)
        return self._act(state, wish, hand)

    def _act(
        self, state: ScriptedState, wish: Command, hand: Float64[np.ndarray, "3"]
    ) -> tuple[ScriptedState, Chunk]:
        """A chunk towards the aim: deltas of the hand, or of the joints that carry it there."""
        aim, open_ = self._aim(state, wish) if state.goal is not None else (hand, 1.0)
        rows: list[list[float]] = []
        joints, longest = state.joints, SPEED_M_S / self.hz
        assert joints is not None
        for _ in range(self.execute):
            delta = GAIN * (aim - hand)
            delta *= min(1.0, longest / max(float(np.linalg.norm(delta)), 1e-9))
            hand = hand + delta
            if self.control == "ee":
                rows.append([*delta, 0.0, 0.0, 0.0, open_])
            elif state.goal is None:
                rows.append([*np.zeros(len(joints)), open_])
            else:
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = self.robot.down_base, hand
                after = arm(self.robot.name).solve(joints, pose, 1.0 / self.hz)
                rows.append([*(after - joints), open_])
                joints = after
        return replace(state, joints=joints), np.asarray(rows, np.float32)

    def _advance(
        self, state: ScriptedState, wish: Command, hand: Float64[np.ndarray, "3"], opening: float
    ) -> ScriptedState:
        """Move on to the next phase when this one's aim is reached."""
        if state.goal is None:
            return state
        if state.phase == "seek":
            return replace(state, phase="above", waited_s=0.0)
        off = np.abs(self._aim(state, wish)[0] - hand)
        level, late = (
            bool(np.hypot(off[0], off[1]) < self.manner.arrived_m),
            state.waited_s >= self.manner.patience_s,
        )
        there = (level and bool(off[2] < self.manner.arrived_m)) or late
        after: Phase = state.phase
        if state.phase == "above" and level and off[2] < 0.03:
            after = "descend"
        elif state.phase == "descend" and there and wish.verb != "touch":
            after = "close"
        elif state.phase == "close" and state.waited_s >= self.manner.close_s:
            after = "lift"
        elif state.phase in ("lift", "carry") and opening < self.manner.empty:
            after = "above"
        elif state.phase == "lift" and there and state.spot is not None:
            after = "carry"
        elif state.phase == "carry" and level:
            after = "lower"
        elif state.phase == "lower" and there:
            after = "open"
        elif state.phase == "open" and state.waited_s >= self.manner.close_s:
            after = "leave"
        if after != state.phase:
            return replace(state, phase=after, waited_s=0.0)
        return replace(state, waited_s=state.waited_s + self.execute / self.hz)

    def _aim(self, state: ScriptedState, wish: Command) -> tuple[np.ndarray, float]:
        """Where the hand should be (base frame, metres) and how far open."""
        assert state.goal is not None
        x, y, _, height = state.goal
        manner, over = self.manner, max(self.manner.hover_m, height + 0.05)
        if wish.verb == "touch":
            z = over if state.phase in LOOKING else max(height - 0.03, 0.01)
            return np.array([x, y, self.eye.table_z + z]), 0.0
        grasp = max(
            manner.grasp_share * height, height - 0.8 * self.robot.palm_m, min(0.03, 0.8 * height)
        )
        if state.phase in ("carry", "lower", "open", "leave"):
            assert state.spot is not None
            x, y, floor = state.spot
            low = floor + grasp + 0.008
            z = {"carry": over + 0.02, "lower": low, "open": low, "leave": low + 0.10}[state.phase]
            return np.array([x, y, self.eye.table_z + z]), float(state.phase in ("open", "leave"))
        z, open_ = {
            "descend": (grasp, 1.0),
            "close": (grasp, 0.0),
            "lift": (grasp + manner.lift_m, 0.0),
        }.get(state.phase, (over, 1.0))
        return np.array([x, y, self.eye.table_z + z]), open_

    @staticmethod
    def _spot(
        place: Float64[np.ndarray, "4"] | None, target: Float64[np.ndarray, "4"], wish: Command
    ) -> Float64[np.ndarray, "3"] | None:  # fmt: skip
        """Where the target goes: x, y and the height of what it stands on there; None when the goal is not seen."""
        if place is None:
            return None
        if wish.verb == "put":
            return np.array([*place[:2], 0.015])
        towards = target[:2] - place[:2]
        towards /= max(float(np.linalg.norm(towards)), 1e-9)
        return np.array([*(place[:2] + (place[2] + target[2] + BESIDE_M) * towards), 0.0])
