"""A scripted baseline that reads only what a VLA reads: prompted images, text and proprioception.

It grounds a colour word in pixels ("the red cup" -> the cup whose pixels are red) and otherwise
takes any object of the category; then it picks, puts down or touches through the same chunked
actions as a learned policy, in either control. It never sees simulator state.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import one_of
from vap_core.base.types import Camera, value
from vap_core.perception.protocols import Detector
from vap_core.policies.hooks import TEXT, report_input
from vap_core.policies.protocol import Chunk, PolicyInput
from vap_core.policies.scripted.localizer import Command, MonocularLocalizer, Place, read
from vap_core.simulation.control import LEAD_JOINT_RAD, arm
from vap_core.simulation.robots import Robot

SPEED_M_S = 0.20
"""Of the hand."""
GAIN = 0.7
"""Share of the remaining way that one action asks for; below 1 so that a lagging arm does not
overshoot."""
REPLAN_S = 0.4
"""Between two calls; what is planned in between is carried out."""
Phase = Literal["seek", "above", "descend", "close", "lift", "carry", "lower", "open", "leave"]
LOCALIZING: tuple[Phase, ...] = ("seek", "above")
"""The phases in which the object is localized in the image."""
RELEASING: tuple[Phase, ...] = ("carry", "lower", "open", "leave")
"""The phases in which the aim is the goal, not the target."""

Point = Float64[np.ndarray, "3"]


@dataclass(frozen=True)
class Motion:
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
    beside_m: float = 0.075
    """Room between a thing and what it is put near to: inside the rule's 10 cm, and on a narrow
    desk nearer than anything else."""
    empty: float = 0.08
    """A closed gripper that reads less than this holds nothing: try again."""


MOTIONS = {
    "wx250s": Motion(),
    "panda": Motion(),
    "google": Motion(thick_m=0.035, hover_m=0.20, close_s=1.4, arrived_m=0.02),
    "so101": Motion(thick_m=0.028, hover_m=0.13, lift_m=0.09, close_s=0.6, beside_m=0.04),
}
SHIPPED_MOTIONS: Mapping[str, Motion] = MappingProxyType(dict(MOTIONS))
"""The motions of the robots that ship, whatever the file of an own suite enters in MOTIONS."""


@value
class ScriptedState:
    """Memory of one episode.

    `draw` (0..1) chooses among candidates that nothing else tells apart. `goal` is where the chosen
    object stands, `spot` where it is put down (x, y, height; base frame, m). `phase` is what the
    hand is doing, and `waited_s` for how long. `joints` are those that were last asked for.
    """

    draw: float
    goal: Place | None
    phase: Phase
    waited_s: float
    spot: Point | None = None
    joints: Float64[np.ndarray, " n"] | None = None


class Scripted:
    """The scripted policy for one robot, one calibrated fixed camera and one control.

    Raises: UnknownName for a robot that MOTIONS does not hold.
    """

    label = "scripted"

    def __init__(
        self,
        detector: Detector,
        camera: Camera,
        robot: Robot,
        hz: float,
        control: Literal["ee", "joint"] = "ee",
    ) -> None:
        if robot.name not in MOTIONS:
            raise one_of("scripted: motion of robot", robot.name, MOTIONS)
        self.robot = robot
        self.motion = MOTIONS[robot.name]
        self.localizer = MonocularLocalizer(
            detector=detector,
            camera=camera,
            base_world=robot.base_world,
            thick_m=self.motion.thick_m,
        )
        self.control = control
        self.hz = hz
        self.execute = max(1, round(REPLAN_S * hz))

    def start(self, rng: np.random.Generator) -> ScriptedState:
        draw = float(rng.random())
        return ScriptedState(draw=draw, goal=None, phase="seek", waited_s=0.0)

    def plan(
        self, states: Sequence[ScriptedState], inputs: Sequence[PolicyInput]
    ) -> tuple[list[ScriptedState], list[Chunk]]:
        camera = self.localizer.camera.name
        for i, (state, policy_input) in enumerate(zip(states, inputs, strict=True)):
            report_input(i, TEXT, policy_input.text)
            looks_for_goal = state.spot is None and bool(read(policy_input.text).goal)
            if state.phase in LOCALIZING or looks_for_goal:
                report_input(i, camera, policy_input.images[camera])
        next_states = []
        chunks = []
        for state, policy_input in zip(states, inputs, strict=True):
            next_state, chunk = self._plan_episode(state, policy_input)
            next_states.append(next_state)
            chunks.append(chunk)
        return next_states, chunks

    def _plan_episode(
        self, state: ScriptedState, policy_input: PolicyInput
    ) -> tuple[ScriptedState, Chunk]:
        command = read(policy_input.text)
        rgb = policy_input.images[self.localizer.camera.name]
        if state.phase in LOCALIZING:
            found = self.localizer.choose(rgb, command, state.draw, state.goal)
            if found is not None:
                state = replace(state, goal=found)
        if command.goal and state.goal is not None and state.spot is None:
            place = self.localizer.find(rgb, command.goal, command.goal_colour)
            state = replace(
                state, spot=_put_down_spot(place, state.goal, command, self.motion.beside_m)
            )
        hand = policy_input.state[:3].astype(np.float64)
        opening = float(policy_input.state[6])
        joints = policy_input.state[7:].astype(np.float64)
        state = self._advance(state, command, hand, opening)
        if state.joints is None or np.abs(state.joints - joints).max() > LEAD_JOINT_RAD:
            state = replace(state, joints=joints)
        return self._act(state, command, hand)

    def _act(
        self, state: ScriptedState, command: Command, hand: Point
    ) -> tuple[ScriptedState, Chunk]:
        """A chunk towards the aim: deltas of the hand, or of the joints that carry it there."""
        aim = hand
        opening = 1.0
        if state.goal is not None:
            aim, opening = self._aim(state, command)
        joints = state.joints
        assert joints is not None
        longest = SPEED_M_S / self.hz
        rows: list[list[float]] = []
        for _ in range(self.execute):
            delta = GAIN * (aim - hand)
            length = float(np.linalg.norm(delta))
            delta *= min(1.0, longest / max(length, 1e-9))
            hand = hand + delta
            if self.control == "ee":
                rows.append([*delta, 0.0, 0.0, 0.0, opening])
            elif state.goal is None:
                rows.append([*np.zeros(len(joints)), opening])
            else:
                solved = self._joints_at(hand, joints)
                rows.append([*(solved - joints), opening])
                joints = solved
        return replace(state, joints=joints), np.asarray(rows, np.float32)

    def _joints_at(
        self, hand: Point, joints: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, " n"]:
        """The joints one step from `joints` that bring the hand there, pointing down."""
        pose = np.eye(4)
        pose[:3, :3] = self.robot.down_base
        pose[:3, 3] = hand
        return arm(self.robot.name).solve(joints, pose, 1.0 / self.hz)

    def _advance(
        self, state: ScriptedState, command: Command, hand: Point, opening: float
    ) -> ScriptedState:
        """Move on to the next phase when this one's aim is reached."""
        if state.goal is None:
            return state
        phase = self._next_phase(state, command, hand, opening)
        if phase != state.phase:
            return replace(state, phase=phase, waited_s=0.0)
        return replace(state, waited_s=state.waited_s + self.execute / self.hz)

    def _next_phase(
        self, state: ScriptedState, command: Command, hand: Point, opening: float
    ) -> Phase:
        """The phase of the next chunk."""
        phase = state.phase
        if phase == "seek":
            return "above"
        aim, _ = self._aim(state, command)
        off = np.abs(aim - hand)
        level = bool(np.hypot(off[0], off[1]) < self.motion.arrived_m)
        late = state.waited_s >= self.motion.patience_s
        there = (level and bool(off[2] < self.motion.arrived_m)) or late
        settled = state.waited_s >= self.motion.close_s
        if phase == "above" and level and off[2] < 0.03:
            return "descend"
        if phase == "descend" and there and command.verb != "touch":
            return "close"
        if phase == "close" and settled:
            return "lift"
        if phase in ("lift", "carry") and opening < self.motion.empty:
            return "above"
        if phase == "lift" and there and state.spot is not None:
            return "carry"
        if phase == "carry" and level:
            return "lower"
        if phase == "lower" and there:
            return "open"
        if phase == "open" and settled:
            return "leave"
        return phase

    def _aim(self, state: ScriptedState, command: Command) -> tuple[Point, float]:
        """Where the hand should be (base frame, metres) and how far open."""
        assert state.goal is not None
        x, y, _, height = state.goal
        hover = max(self.motion.hover_m, height + 0.05)
        if command.verb == "touch":
            z = hover if state.phase in LOCALIZING else max(height - 0.03, 0.01)
            opening = 0.0
        elif state.phase in RELEASING:
            assert state.spot is not None
            x, y, floor = state.spot
            z = self._release_height(state.phase, floor + self._grasp_height(height), hover)
            opening = float(state.phase in ("open", "leave"))
        else:
            z = self._grasping_height(state.phase, self._grasp_height(height), hover)
            opening = float(state.phase not in ("close", "lift"))
        return np.array([x, y, self.localizer.table_z + z]), opening

    def _grasp_height(self, height: float) -> float:
        """The height of the grasp of an object of this height, over its foot."""
        return max(
            self.motion.grasp_share * height,
            height - 0.8 * self.robot.palm_m,
            min(0.03, 0.8 * height),
        )

    def _grasping_height(self, phase: Phase, grasp: float, hover: float) -> float:
        """The hand's height over the table until the target is lifted."""
        if phase in ("descend", "close"):
            return grasp
        if phase == "lift":
            return grasp + self.motion.lift_m
        return hover

    def _release_height(self, phase: Phase, grasp: float, hover: float) -> float:
        """The hand's height over the table from the way to the goal on."""
        low = grasp + 0.008
        if phase == "carry":
            return hover + 0.02
        if phase == "leave":
            return low + 0.10
        return low


def _put_down_spot(
    place: Place | None, target: Place, command: Command, beside_m: float
) -> Point | None:
    """Where the target goes: x, y and the height of what it stands on there.

    None when the goal is not seen.
    """
    if place is None:
        return None
    if command.verb == "put":
        return np.array([*place[:2], 0.015])
    towards = target[:2] - place[:2]
    length = float(np.linalg.norm(towards))
    towards /= max(length, 1e-9)
    distance = place[2] + target[2] + beside_m
    return np.array([*(place[:2] + distance * towards), 0.0])
