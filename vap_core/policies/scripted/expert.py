"""The scripted expert: it reads the simulator's state, not pictures, and proves that a task can be done; later it makes demonstrations.

A plan is a list of waypoints of the gripper. It moves the commanded pose along them within the speed limits, in whichever control the
suite has, and plans anew when a grasp came up empty.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import OutOfReach
from vap_core.base.types import value
from vap_core.policies.protocol import Chunk
from vap_core.simulation.control import arm, rotation, rotation_vector
from vap_core.simulation.env import Env
from vap_core.simulation.grasps import Grasp, grasps, points_world
from vap_core.simulation.types import Action, Truth

SPEED_M_S, TURN_RAD_S = 0.22, 1.4
GRIP_S = 3.0
"""Share of the gripper's travel in a second: a jaw that slams knocks light things over."""
ABOVE_M = 0.04
"""Clearance over whatever stands lower than the path."""
ARRIVED_M, ARRIVED_RAD = 0.006, 0.06
PATIENCE_S = 1.2
"""Longest wait at a waypoint that is not quite reached."""
JAW_GAP_M = 0.003
"""Room between an object and the jaw that does not move."""
ELSEWHERE = 5
"""After an empty grasp the next one is tried so many places down the list: its neighbours differ too little."""
MISS_M, MISS_RAD = (0.015, 0.04), 1.2
"""How far beside the target a grasp goes that is to miss, and how far it is turned, either way."""
BESIDE_M = 0.035
"""How far inside the limit of the near rule a thing is set down."""


@value
class Waypoint:
    """A pose of the tcp (robot base frame), the gripper on the way there (0 closed .. 1 open), and seconds to stay."""

    tcp_base: Float64[np.ndarray, "4 4"]
    gripper: float
    stay_s: float = 0.0


@value
class ExpertState:
    """What is left of the plan, seconds spent at its first waypoint, and whether the plan was to grasp or to carry."""

    phase: str = "grasp"
    plan: tuple[Waypoint, ...] = ()
    waited_s: float = 0.0
    attempt: int = 0


class Expert:
    """Solves every rule of every suite, on every robot."""

    label = "expert"
    execute = 1

    def start(self, rng: np.random.Generator) -> ExpertState:
        return ExpertState()

    def astray(self, env: Env, rng: np.random.Generator) -> ExpertState:
        """As if its first grasp went beside the target, open or closed; what it does once its phase is no longer "miss" shows how to begin again.

        Raises: OutOfReach.
        """
        return ExpertState("miss", tuple(_miss(env, env.truth(), rng)))

    def plan_from_simulation(
        self, states: Sequence[ExpertState], envs: Sequence[Env]
    ) -> tuple[list[ExpertState], list[Chunk]]:
        after = [self._advance(state, env) for state, env in zip(states, envs, strict=True)]
        return after, [
            _towards(state.plan[0], env)[None] for state, env in zip(after, envs, strict=True)
        ]

    def _advance(self, state: ExpertState, env: Env) -> ExpertState:
        """Drop the waypoints that are reached; when none is left, plan the next phase."""
        plan, waited = state.plan, state.waited_s
        if plan and _reached(plan[0], env, waited):
            plan, waited = plan[1:], 0.0
        elif plan:
            waited += _dwell(plan[0], env)
        if plan:
            return ExpertState(state.phase, plan, waited, state.attempt)
        return self._next(state, env)

    def _next(self, state: ExpertState, env: Env) -> ExpertState:
        truth, row = env.truth(), env.row
        if row.rule == "selected":
            return ExpertState(
                "touch", tuple(_touch(env, truth, state.attempt)), 0.0, state.attempt + 1
            )
        if state.phase == "carry" and row.target in truth.held:
            if row.rule == "picked":
                return ExpertState("carry", (_hold(env),), 0.0, state.attempt)
            return ExpertState("leave", tuple(_set_down(env, truth)), 0.0, state.attempt)
        if state.phase == "grasp":
            return ExpertState(
                "carry", tuple(_take(env, truth, state.attempt)), 0.0, state.attempt + 1
            )
        return ExpertState("grasp", (_retreat(env),), 0.0, state.attempt)


def _towards(waypoint: Waypoint, env: Env) -> Action:
    """One step from the commanded pose to the waypoint, as fast as allowed, in the control that the suite has."""
    seconds, now, goal = 1.0 / env.hz, env.command.tcp_base, waypoint.tcp_base
    move, turn = goal[:3, 3] - now[:3, 3], rotation_vector(goal[:3, :3] @ now[:3, :3].T)
    move *= min(1.0, SPEED_M_S * seconds / max(float(np.linalg.norm(move)), 1e-9))
    turn *= min(1.0, TURN_RAD_S * seconds / max(float(np.linalg.norm(turn)), 1e-9))
    squeeze = env.command.gripper + float(
        np.clip(waypoint.gripper - env.command.gripper, -GRIP_S * seconds, GRIP_S * seconds)
    )
    if env.control == "ee":
        return np.array([*move, *turn, squeeze], np.float32)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = rotation(turn) @ now[:3, :3], now[:3, 3] + move
    joints = arm(env.robot.name).solve(env.command.joints, step, seconds)
    return np.array([*(joints - env.command.joints), squeeze], np.float32)


def _reached(waypoint: Waypoint, env: Env, waited_s: float) -> bool:
    off, turned = _off(waypoint.tcp_base, env.tcp_base())
    if waited_s > PATIENCE_S + waypoint.stay_s:
        return True
    return (
        off < ARRIVED_M
        and turned < ARRIVED_RAD
        and waited_s >= waypoint.stay_s
        and abs(env.command.gripper - waypoint.gripper) < 0.01
    )


def _dwell(waypoint: Waypoint, env: Env) -> float:
    """Time counts at a waypoint once the command is there, and slowly before, so that nothing waits for ever."""
    off, turned = _off(waypoint.tcp_base, env.command.tcp_base)
    there = off < 0.003 and turned < 0.02 and abs(env.command.gripper - waypoint.gripper) < 0.01
    return (1.0 if there else 0.1) / env.hz


def _off(one: Float64[np.ndarray, "4 4"], other: Float64[np.ndarray, "4 4"]) -> tuple[float, float]:
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(
        np.linalg.norm(rotation_vector(one[:3, :3] @ other[:3, :3].T))
    )


def _take(env: Env, truth: Truth, attempt: int) -> list[Waypoint]:
    """Over the target, down, close, and up until it is clear of everything."""
    low = _low(env, truth, attempt)
    above = _over(env, truth, low)
    lift = _above(env, low, max(0.09, _ceiling(env, truth) - _foot(truth, env.row.target) + 0.015))
    return [Waypoint(above, 1.0), Waypoint(low, 1.0), Waypoint(low, 0.0, 0.3), Waypoint(lift, 0.0)]


def _miss(env: Env, truth: Truth, rng: np.random.Generator) -> list[Waypoint]:
    """Over a place beside the best grasp and turned away from it, down, and as often as not closed."""
    angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(*MISS_M)
    low = _low(env, truth, 0)
    low[:3, 3] += _into_base(env) @ np.array(
        [away * np.cos(angle), away * np.sin(angle), rng.uniform(0.0, 0.02)]
    )
    low[:3, :3] = rotation(np.array([0.0, 0.0, rng.uniform(-MISS_RAD, MISS_RAD)])) @ low[:3, :3]
    plan = [Waypoint(_over(env, truth, low), 1.0), Waypoint(low, 1.0), Waypoint(low, 0.0, 0.2)]
    return plan[: int(rng.integers(2, 4))]


def _low(env: Env, truth: Truth, attempt: int) -> Float64[np.ndarray, "4 4"]:
    """Where the hand closes. Raises: OutOfReach."""
    found = grasps(env.robot, env.row.target, truth.objects_world)
    if not found:
        raise OutOfReach(
            f"Expert: {env.row.target} is too wide for {1000 * env.robot.opening_m:.0f} mm of {env.robot.name}; choose another object or robot."
        )
    order = found[ELSEWHERE * attempt % len(found) :] + found
    low = next((pose for grasp in order if (pose := _reachable(env, grasp)) is not None), None)
    if low is None:
        raise OutOfReach(
            f"Expert: {env.row.key}: no grasp of {env.row.target} can be reached by {env.robot.name}; move it closer."
        )
    return low


def _over(env: Env, truth: Truth, low: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Straight over a pose, clear of everything."""
    return _above(
        env, low, _ceiling(env, truth) + ABOVE_M - float(low[2, 3] + env.robot.base_world[2])
    )


def _reachable(env: Env, grasp: Grasp) -> Float64[np.ndarray, "4 4"] | None:
    """The tcp's pose for a grasp, the hand turned the shorter way, as the arm gets there; None when it does not."""
    now = env.command.tcp_base
    poses = [_pose(env, grasp.tcp_world, grasp.axis_rad + turn) for turn in (0.0, np.pi)]
    for pose in sorted(poses, key=lambda pose: _off(pose, now)[1]):
        pose[:3, 3] -= pose[:3, 1] * _beside_jaw(env, grasp)
        if (reached := _try(env, pose, 0.003)) is not None and _try(
            env, _raised(pose, 0.04), 0.006
        ) is not None:
            return reached
    return None


def _beside_jaw(env: Env, grasp: Grasp) -> float:
    """How far along the opening axis the hand moves so that a jaw that does not move stands close by: what is swept far topples."""
    jaw = env.robot.fixed_jaw_m
    return float(np.sign(jaw) * max(abs(jaw) - grasp.span_m / 2 - JAW_GAP_M, 0.0))


def _try(
    env: Env, pose: Float64[np.ndarray, "4 4"], tolerance_m: float
) -> Float64[np.ndarray, "4 4"] | None:
    """The pose that the arm really takes for `pose` (an arm of five joints may lean a little), or None when it is out of reach."""
    kinematics = arm(env.robot.name)
    try:
        return kinematics.forward(kinematics.reach(pose, tolerance_m))
    except OutOfReach:
        return None


def _above(
    env: Env, pose: Float64[np.ndarray, "4 4"], height_m: float
) -> Float64[np.ndarray, "4 4"]:
    """`pose` raised by `height_m`, or by as much of it as the arm can do."""
    tries = (
        _try(env, _raised(pose, height_m - float(less)), 0.006)
        for less in np.arange(0.0, max(height_m, 0.0), 0.015)
    )
    return next((met for met in tries if met is not None), pose)


def _set_down(env: Env, truth: Truth) -> list[Waypoint]:
    """Carry the held target to its goal, lower it, let go, and draw back."""
    now, low = env.tcp_base(), points_world(env.row.target, truth.objects_world[env.row.target])
    centre, foot = (low.min(axis=0) + low.max(axis=0))[:2] / 2, float(low[:, 2].min())
    spot, floor = _spot(env, truth)
    shift = _into_base(env) @ np.array([*(spot - centre), floor - foot])
    about = _into_base(env) @ np.array([*centre, 0.0]) - _into_base(env) @ env.robot.base_world[:3]
    turns = [
        _turned(now, about, shift, float(yaw))
        for yaw in np.deg2rad([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
    ]
    down = next((met for pose in turns if (met := _try(env, pose, 0.006)) is not None), None)
    if down is None:
        raise OutOfReach(
            f"Expert: {env.row.key}: {env.robot.name} cannot reach {env.row.goal} with {env.row.target} in its hand; move it closer."
        )
    over = _above(env, down, foot - floor)
    return [
        Waypoint(over, 0.0, 0.1),
        Waypoint(down, 0.0, 0.15),
        Waypoint(down, 1.0, 0.1),
        Waypoint(_above(env, down, 0.08), 1.0, 0.8),
    ]


def _turned(
    pose: Float64[np.ndarray, "4 4"],
    about: Float64[np.ndarray, "3"],
    shift: Float64[np.ndarray, "3"],
    yaw: float,
) -> Float64[np.ndarray, "4 4"]:
    """`pose` turned by `yaw` about the vertical through `about`, then moved by `shift` (base frame)."""
    turn, out = rotation(np.array([0.0, 0.0, yaw])), np.eye(4)
    out[:3, :3] = turn @ pose[:3, :3]
    out[:3, 3] = np.array([*about[:2], 0.0]) + turn @ (pose[:3, 3] - [*about[:2], 0.0]) + shift
    return out


def _spot(env: Env, truth: Truth) -> tuple[Float64[np.ndarray, "2"], float]:
    """Where the target's centre goes, and the height at which it is let go."""
    row, goal = env.row, truth.objects_world[env.row.goal]
    points = points_world(row.goal, goal)
    if row.rule == "put":
        return goal[:2].copy(), float(goal[2]) + 0.016
    mine = points_world(row.target, truth.objects_world[row.target])
    reach = (
        0.5 * (np.hypot(*np.ptp(points, axis=0)[:2]) + np.hypot(*np.ptp(mine, axis=0)[:2]))
        + 0.10
        - BESIDE_M
    )
    others = [
        pose[:2] for name, pose in truth.objects_world.items() if name not in (row.target, row.goal)
    ]
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    spots = goal[:2] + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    room = np.array(
        [min([float(np.hypot(*(spot - other))) for other in others], default=1.0) for spot in spots]
    )
    here = np.hypot(*(spots - truth.objects_world[row.target][:2]).T)
    return spots[int(np.argmax(np.minimum(room, 0.13) - 0.1 * here))], float(goal[2]) + 0.004


def _touch(env: Env, truth: Truth, attempt: int) -> list[Waypoint]:
    """From straight above onto the middle of the target, with the gripper closed."""
    points = points_world(env.row.target, truth.objects_world[env.row.target])
    top, middle = float(points[:, 2].max()), (points.min(axis=0) + points.max(axis=0)) / 2
    highest = points[points[:, 2] > top - 0.006].mean(axis=0)
    x, y = (highest if attempt % 2 else middle)[:2]
    now = env.command.tcp_base
    turns = [
        _pose(env, np.array([x, y, top - 0.025]), yaw)
        for yaw in np.deg2rad(np.arange(0.0, 360.0, 30.0)).tolist()
    ]
    pose = next(
        (
            met
            for turn in sorted(turns, key=lambda turn: _off(turn, now)[1])
            if (met := _try(env, turn, 0.02)) is not None
        ),
        None,
    )
    if pose is None:
        raise OutOfReach(
            f"Expert: {env.row.key}: {env.robot.name} cannot reach {env.row.target}; move it closer."
        )
    over = _above(env, pose, _ceiling(env, truth) + ABOVE_M - (top - 0.025))
    return [Waypoint(over, 0.0), Waypoint(pose, 0.0, 0.2), Waypoint(over, 0.0)]


def _hold(env: Env) -> Waypoint:
    return Waypoint(_above(env, env.command.tcp_base, 0.02), 0.0, 0.5)


def _retreat(env: Env) -> Waypoint:
    return Waypoint(_above(env, env.command.tcp_base, 0.06), 1.0, 0.1)


def _ceiling(env: Env, truth: Truth) -> float:
    """The height of the tallest thing on the table that is not the target or in the hand, metres in the world."""
    names = [name for name in truth.objects_world if name != env.row.target] + [env.row.target] * (
        env.row.target not in truth.held
    )
    return max(float(points_world(name, truth.objects_world[name])[:, 2].max()) for name in names)


def _foot(truth: Truth, name: str) -> float:
    return float(points_world(name, truth.objects_world[name])[:, 2].min())


def _pose(
    env: Env, tcp_world: Float64[np.ndarray, "3"], axis_rad: float
) -> Float64[np.ndarray, "4 4"]:
    """The tcp's pose (base frame) pointing straight down with its opening axis at `axis_rad` in the world."""
    base = _into_base(env)
    opening = base.T @ env.robot.down_base[:, 1]
    yaw = axis_rad - float(np.arctan2(opening[1], opening[0]))
    pose = np.eye(4)
    pose[:3, :3] = base @ rotation(np.array([0.0, 0.0, yaw])) @ base.T @ env.robot.down_base
    pose[:3, 3] = base @ (tcp_world - env.robot.base_world[:3])
    return pose


def _into_base(env: Env) -> Float64[np.ndarray, "3 3"]:
    """The rotation from world to robot base axes."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(env.robot.base_world[3:], scalar_first=True).as_matrix().T


def _raised(pose: Float64[np.ndarray, "4 4"], height_m: float) -> Float64[np.ndarray, "4 4"]:
    up = pose.copy()
    up[2, 3] += height_m
    return up
