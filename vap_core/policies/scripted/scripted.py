"""The scripted policy, which reads what a VLA reads, and the random control."""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from vap_core.base.errors import one_of
from vap_core.base.types import Boxes, Camera, Colour, Rgb, value
from vap_core.instruction import leading_category
from vap_core.perception.protocols import Detector
from vap_core.policies.protocol import TEXT, Chunk, PolicyInput, report_input
from vap_core.prompt import PALETTE, has_colour
from vap_core.simulation import cameras as optics
from vap_core.simulation.assets.objects import get_object
from vap_core.simulation.control import LEAD_JOINT_RAD, arm
from vap_core.simulation.env import Env
from vap_core.simulation.robots import Robot
from vap_core.simulation.types import EE_ACTION, Pose

KEEP = 0.8
"""Share of one action that goes on in the next."""
MOVE_M_S = 0.20
TURN_RAD_S = 0.6
JOINT_RAD_S = 0.6


@value
class RandomState:
    """The episode's own stream, and the last draw, whose mean is zero."""

    rng: np.random.Generator
    last: Float32[np.ndarray, " a"]


class Random:
    """Moves at random at the speed of the expert, the gripper opening and closing."""

    label = "random"
    execute = 1

    def start(self, rng: np.random.Generator) -> RandomState:
        return RandomState(rng, np.zeros(0, np.float32))

    def plan_from_simulation(
        self, states: Sequence[RandomState], envs: Sequence[Any]
    ) -> tuple[list[RandomState], list[Chunk]]:
        after = []
        chunks = []
        for state, env in zip(states, envs, strict=True):
            rng = copy.deepcopy(state.rng)
            # A share of the last draw and fresh noise, by the deviation of every number.
            n = len(env.action_names)
            last = state.last if len(state.last) else np.zeros(n, np.float32)
            scales = np.ones(n)
            if env.action_names == EE_ACTION:
                scales[:-1] = np.repeat([MOVE_M_S, TURN_RAD_S], 3) / env.hz
            elif isinstance(env, Env):
                scales[:-1] = JOINT_RAD_S / env.hz
            fresh = rng.standard_normal(n) * scales
            drawn = (KEEP * last + np.sqrt(1 - KEEP**2) * fresh).astype(np.float32)
            after.append(RandomState(rng, drawn))
            if env.action_names[-1] != "gripper":
                chunks.append(drawn[None])
                continue
            # The gripper is as often nearly closed as nearly open.
            gripper = np.clip(0.5 + drawn[-1], 0.0, 1.0)
            chunks.append(np.array([[*drawn[:-1], gripper]], np.float32))
        return after, chunks


COLOUR_NAMES = "|".join(colour.name for colour in PALETTE)
OWNER = r"(?:my|his|her)(?:\s+[\w-]+['’]s)?"
"""A possessive, with an owner beside the speaker: "my brother's"."""
SPAN = re.compile(rf"\b(?:the\s+(?P<colour>{COLOUR_NAMES})|{OWNER}|the|a|an)\s+", re.IGNORECASE)
"""The words before a category: an article, a possessive, or "the" with a colour."""
PLACE = re.compile(
    r"\b(?P<how>near|next to|beside|on|onto|in|into|inside)\s+"
    rf"(?:(?:the\s+(?P<colour>{COLOUR_NAMES})|{OWNER}|the|a|an)\s+)?(?:(?P<side>left|right)\s+)?",
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
RIMMED = frozenset({"mug", "bowl"})
"""Categories wider than the hand."""
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

    `verb` is pick, put, near or touch; a colour None, `goal` and `goal_side` (left, right: of
    several in the picture) "" where the text names none.
    """

    verb: str
    colour: Colour | None
    category: str
    goal: str = ""
    goal_colour: Colour | None = None
    goal_side: str = ""


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
            of_goal = _colour_named(place["colour"]), (place["side"] or "").lower()
            return Command(verb, colour, category, goal, *of_goal)
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
        best = box_of_colour(rgb, boxes, command.colour)
        if best is not None:
            return self.place(boxes.xyxy[best], self.thick_m)
        if before is None:
            confident = boxes.xyxy[boxes.score >= CONFIDENT * boxes.score[0]]
            return self.place(confident[int(draw * len(confident))], self.thick_m)
        places = [self.place(box, self.thick_m) for box in boxes.xyxy]
        distances = [float(np.hypot(*(place - before)[:2])) for place in places]
        nearest = int(np.argmin(distances))
        return places[nearest] if distances[nearest] < STAYED_M else None

    def find(
        self, rgb: Rgb, category: str, colour: Colour | None = None, side: str = ""
    ) -> Place | None:
        """Where the most confident box of a category stands; None when there is none.

        A side, or a colour that is named and seen, decides.
        """
        boxes = self.detector([rgb], category)[0]
        if not len(boxes):
            return None
        if side:
            confident = boxes.xyxy[boxes.score >= CONFIDENT * boxes.score[0]]
            middle = confident[:, [0, 2]].mean(axis=1)
            at = int(middle.argmin() if side == "left" else middle.argmax())
            return self.place(confident[at], WIDEST_M)
        return self.place(boxes.xyxy[box_of_colour(rgb, boxes, colour) or 0], WIDEST_M)

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
        start = np.clip(guess, low + 1e-6, high - 1e-6)
        fit = least_squares(
            lambda cylinder: self._outline(cylinder) - box, start, bounds=(low, high), max_nfev=20
        )
        return fit.x

    def _outline(self, cylinder: Place) -> Float64[np.ndarray, "4"]:
        """The box (pixels) around the picture of a cylinder on the table."""
        x, y, radius, height = cylinder
        rim = radius * RING + (x, y)
        rims = [np.c_[rim, np.full(len(rim), self.table_z + z)] for z in (0.0, height)]
        turn, eye = self._base_from_camera()
        points = (np.concatenate(rims) - eye) @ turn
        k = self.camera.k
        pixels = (points[:, :2] / points[:, 2:]) * (k[0, 0], k[1, 1]) + k[:2, 2]
        return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])

    def _base_from_camera(self) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
        """Rotation from camera to robot base axes, and the camera's position in the base frame."""

        base = np.eye(4)
        base[:3, :3] = Rotation.from_quat(self.base_world[3:], scalar_first=True).as_matrix()
        base[:3, 3] = self.base_world[:3]
        pose = np.linalg.inv(base) @ self.camera.pose_world
        return pose[:3, :3], pose[:3, 3]


@dataclass(frozen=True)
class TruePlaces:
    """Where things stand, by the simulator. Which of them is meant, the picture says, or `target`.

    `places` are the objects' poses, `sizes_m` their full extents.
    """

    places: Mapping[str, Pose]
    sizes_m: Mapping[str, tuple[float, float, float]]
    camera: Camera
    target: str = ""
    table_z = 0.0

    def choose(self, rgb: Rgb, command: Command, draw: float, before: Place | None) -> Place | None:
        """As MonocularLocalizer.choose."""
        if self.target:
            return self.place(self.target)
        alike = self._of_kind(command.category)
        if not alike:
            return None
        boxes = np.array([self._box(name) for name in alike], np.float32)
        shown = Boxes(boxes, np.ones(len(boxes), np.float32), command.category)
        best = box_of_colour(rgb, shown, command.colour)
        if best is None and before is not None:
            return self.place(self.nearest(command.category, before[:2]))
        return self.place(alike[int(draw * len(alike)) if best is None else best])

    def find(
        self, rgb: Rgb | None, category: str, colour: Colour | None = None, side: str = ""
    ) -> Place | None:
        """The place of the only thing of a category, or of the one on that side of the picture."""
        alike = self._of_kind(category)
        if not alike:
            return None
        points = np.array([self.places[name][:3] for name in alike])
        at = optics.project(self.camera, points)[:, 0]
        return self.place(alike[int(at.argmax() if side == "right" else at.argmin())])

    def nearest(self, category: str, xy: Float64[np.ndarray, "2"]) -> str:
        gaps = {name: np.hypot(*(self.places[name][:2] - xy)) for name in self._of_kind(category)}
        return min(gaps, key=lambda name: gaps[name])

    def _box(self, name: str) -> Float64[np.ndarray, "4"]:
        """Around the picture of an object's bounding box."""
        x, y, z = self.sizes_m[name]
        corners = np.array([*product((-x / 2, x / 2), (-y / 2, y / 2), (0.0, z))])
        turn = Rotation.from_quat(self.places[name][[4, 5, 6, 3]])
        pixels = optics.project(self.camera, turn.apply(corners) + self.places[name][:3])
        return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])

    def place(self, name: str) -> Place:
        x, y = self.places[name][:2]
        width, depth, height = self.sizes_m[name]
        return np.array([x, y, min(width, depth) / 2, height])

    def _of_kind(self, category: str) -> list[str]:
        return [name for name in self.places if get_object(name).category == category]


def box_of_colour(rgb: Rgb, boxes: Boxes, colour: Colour | None) -> int | None:
    """The box that has most of a colour; None where none has enough of it."""
    shares = coloured(rgb, boxes, colour) if colour is not None else np.zeros(1)
    return int(shares.argmax()) if shares.max() >= COLOURED else None


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
    return next((span for span in spans if span["colour"]), spans[0] if spans else None)


def _colour_named(name: str | None) -> Colour | None:
    return next((colour for colour in PALETTE if colour.name == (name or "").lower()), None)


SPEED_M_S = 0.20
"""Of the hand."""
GAIN = 0.7
"""Share of the remaining way that one action asks for; below 1 so that a lagging arm does not
overshoot."""
MOST_RAD = 0.3
"""The most that one action asks the hand to turn."""
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
    rim_m: float = 0.0
    """How far from its axis a RIMMED thing is grasped, on the far side; 0 where it fits between the
    fingers."""
    turn_rad: float = 0.0
    """How far the hand is turned before it grasps."""
    speed_m_s: float = SPEED_M_S
    follow: float = 1.0
    """The share of what one action asks for that the arm does within it."""


MOTIONS = {
    "wx250s": Motion(),
    "panda": Motion(),
    "google": Motion(thick_m=0.035, hover_m=0.20, close_s=1.4, arrived_m=0.02),
    "so101": Motion(thick_m=0.028, hover_m=0.13, lift_m=0.09, close_s=0.6, beside_m=0.04),
    "libero": Motion(
        thick_m=0.05,
        hover_m=0.24,
        lift_m=0.16,
        empty=0.02,
        rim_m=0.042,
        turn_rad=np.pi / 2,
        speed_m_s=1.0,
        follow=0.22,
    ),
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
        self.localizer: MonocularLocalizer | TruePlaces = MonocularLocalizer(
            detector=detector,
            camera=camera,
            base_world=robot.base_world,
            thick_m=self.motion.thick_m,
        )
        self.control = control
        self.hz = hz
        self.execute = max(1, round(REPLAN_S * hz))

    def start(self, rng: np.random.Generator) -> ScriptedState:
        return ScriptedState(float(rng.random()), None, "seek", 0.0)

    def plan(
        self, states: Sequence[ScriptedState], inputs: Sequence[PolicyInput]
    ) -> tuple[list[ScriptedState], list[Chunk]]:
        camera = self.localizer.camera.name
        for i, (state, policy_input) in enumerate(zip(states, inputs, strict=True)):
            report_input(i, TEXT, policy_input.text)
            looks_for_goal = state.spot is None and bool(read(policy_input.text).goal)
            if state.phase in LOCALIZING or looks_for_goal:
                report_input(i, camera, policy_input.images[camera])
        planned = [self._plan_episode(*pair) for pair in zip(states, inputs, strict=True)]
        return [state for state, _ in planned], [chunk for _, chunk in planned]

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
            target = state.goal
            wanted = command.goal, command.goal_colour, command.goal_side
            place = self.localizer.find(rgb, *wanted)
            if place is not None and command.verb == "put":
                state = replace(state, spot=np.array([*place[:2], 0.015]))
            elif place is not None:  # near it, on the side of the target
                towards = target[:2] - place[:2]
                towards /= max(float(np.linalg.norm(towards)), 1e-9)
                distance = place[2] + target[2] + self.motion.beside_m
                state = replace(state, spot=np.array([*(place[:2] + distance * towards), 0.0]))
        hand = policy_input.state[:3].astype(np.float64)
        opening = float(policy_input.state[6])
        joints = policy_input.state[7:].astype(np.float64)
        if state.goal is not None:
            phase = self._next_phase(state, command, hand, opening)
            waited_s = state.waited_s + self.execute / self.hz if phase == state.phase else 0.0
            state = replace(state, phase=phase, waited_s=waited_s)
        if state.joints is None or np.abs(state.joints - joints).max() > LEAD_JOINT_RAD:
            state = replace(state, joints=joints)
        return self._act(state, command, hand, float(policy_input.state[5]))

    def _act(
        self, state: ScriptedState, command: Command, hand: Point, yaw: float
    ) -> tuple[ScriptedState, Chunk]:
        """A chunk towards the aim: deltas of the hand, or of the joints that carry it there."""
        aim = hand
        opening = 1.0
        if state.goal is not None:
            aim, opening = self._aim(state, command)
        joints = state.joints
        assert joints is not None
        longest = self.motion.speed_m_s / self.hz
        rows: list[list[float]] = []
        for _ in range(self.execute):
            delta = GAIN * (aim - hand)
            delta *= min(1.0, longest / max(float(np.linalg.norm(delta)), 1e-9))
            hand = hand + self.motion.follow * delta
            turn = 0.0
            if self.motion.turn_rad:
                turn = float(np.clip(GAIN * (self.motion.turn_rad - yaw), -MOST_RAD, MOST_RAD))
                yaw += self.motion.follow * turn
            if self.control == "ee":
                rows.append([*delta, 0.0, 0.0, turn, opening])
            elif state.goal is None:
                rows.append([*np.zeros(len(joints)), opening])
            else:
                # One step from `joints` towards those that bring the hand there, pointing down.
                pose = np.eye(4)
                pose[:3, :3] = self.robot.down_base
                pose[:3, 3] = hand
                solved = arm(self.robot.name).solve(joints, pose, 1.0 / self.hz)
                rows.append([*(solved - joints), opening])
                joints = solved
        return replace(state, joints=joints), np.asarray(rows, np.float32)

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
        if phase in ("lift", "carry") and opening < self.motion.empty:
            return "above"
        onward: dict[Phase, tuple[bool, Phase]] = {
            "above": (level and off[2] < 0.03, "descend"),
            "descend": (there and command.verb != "touch", "close"),
            "close": (settled, "lift"),
            "lift": (there and state.spot is not None, "carry"),
            "carry": (level, "lower"),
            "lower": (there, "open"),
            "open": (settled, "leave"),
        }
        done, then = onward.get(phase, (False, phase))
        return then if done else phase

    def _aim(self, state: ScriptedState, command: Command) -> tuple[Point, float]:
        """Where the hand should be (base frame, metres) and how far open."""
        assert state.goal is not None
        x, y, _, height = state.goal
        hover = max(self.motion.hover_m, height + 0.05)
        if command.verb == "touch":
            z = hover if state.phase in LOCALIZING else max(height - 0.03, 0.01)
            opening = 0.0
        else:
            # The grasp's height over the object's foot.
            share, palm = self.motion.grasp_share, 0.8 * self.robot.palm_m
            grasp = max(share * height, height - palm, min(0.03, 0.8 * height))
            if state.phase in RELEASING:
                assert state.spot is not None
                x, y, floor = state.spot
                low = floor + grasp + 0.008
                z = {"carry": hover + 0.02, "leave": low + 0.10}.get(state.phase, low)
                opening = float(state.phase in ("open", "leave"))
            else:
                heights = {"descend": grasp, "close": grasp, "lift": grasp + self.motion.lift_m}
                z = heights.get(state.phase, hover)
                opening = float(state.phase not in ("close", "lift"))
        return np.array([x + self._rim_m(command), y, self.localizer.table_z + z]), opening

    def _rim_m(self, command: Command) -> float:
        return self.motion.rim_m if command.category in RIMMED else 0.0


class PlacedScripted(Scripted):
    """The scripted policy in other libraries' environments: it is told where things stand, and the
    picture says only which one is meant."""

    needs_places = True
    replan_s = 0.2

    def __init__(
        self,
        robot: Robot,
        hz: float,
        camera: Camera,
        sizes_m: Mapping[str, tuple[float, float, float]],
    ) -> None:
        self.robot, self.motion, self.hz = robot, MOTIONS[robot.name], hz
        self.control = "ee"
        self.execute = max(1, round(self.replan_s * hz))
        self.localizer = TruePlaces({}, sizes_m, camera)

    def _plan_episode(
        self, state: ScriptedState, policy_input: PolicyInput
    ) -> tuple[ScriptedState, Chunk]:
        assert isinstance(self.localizer, TruePlaces)
        self.localizer = replace(self.localizer, places=policy_input.places)
        command = read(policy_input.text)
        goal = self.localizer.find(None, command.goal, None, command.goal_side)
        if state.phase in ("carry", "lower") and goal is not None:
            # What is held hangs askew: its own middle is brought over the goal's.
            rim = np.array([self._rim_m(command), 0.0])
            hand = policy_input.state[:2] - rim
            held = self.localizer.place(self.localizer.nearest(command.category, hand))
            state = replace(state, spot=np.array([*(goal[:2] + hand - held[:2]), 0.015]))
        return super()._plan_episode(state, policy_input)


class ScriptedExpert(PlacedScripted):
    """The same motion, to the target of the episode."""

    label = "expert"
    replan_s = 0.0

    def plan_from_simulation(
        self, states: Sequence[ScriptedState], envs: Sequence[Any]
    ) -> tuple[list[ScriptedState], list[Chunk]]:
        assert isinstance(self.localizer, TruePlaces)
        planned = []
        for state, env in zip(states, envs, strict=True):
            self.localizer = replace(self.localizer, target=env.row.target)
            images = {self.localizer.camera.name: np.zeros((1, 1, 3), np.uint8)}
            places = env.truth().objects_world
            seen = PolicyInput(images, env.row.instruction, env.state(), places)
            planned.append(self._plan_episode(state, seen))
        return [state for state, _ in planned], [chunk for _, chunk in planned]
