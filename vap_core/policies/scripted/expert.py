"""The scripted expert: it reads the simulator's state, and proves that a task can be done.

It makes demonstrations, too. A plan is a list of waypoints of the gripper. The expert moves the
commanded pose along them within the speed limits, in whichever control the suite has, and plans
anew when a grasp came up empty. Poses are of the tcp in the robot's base frame, in metres.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import OutOfReach
from vap_core.base.types import value
from vap_core.policies.protocol import Chunk
from vap_core.simulation.control import MotionLimits, action_towards, arm, rotation, rotation_vector
from vap_core.simulation.env import Env
from vap_core.simulation.grasps import Grasp, grasps, points_world
from vap_core.simulation.types import Action, Truth

SPEED_M_S = 0.22
TURN_RAD_S = 1.4
LIMITS = MotionLimits(SPEED_M_S, TURN_RAD_S)
GRIP_S = 3.0
"""Share of the gripper's travel in a second: a jaw that slams knocks light things over."""
ABOVE_M = 0.04
"""Clearance over whatever stands lower than the path."""
ARRIVED_M = 0.006
ARRIVED_RAD = 0.06
PATIENCE_S = 1.2
"""Longest wait at a waypoint that is not quite reached."""
JAW_GAP_M = 0.003
"""Room between an object and the jaw that does not move."""
GRASP_STRIDE = 5
"""After an empty grasp the next one is tried so many places down the list, as neighbours differ too
little."""
MISS_M = (0.015, 0.04)
MISS_RAD = 1.2
"""How far beside the target a grasp goes that is to miss, and how far it is turned, either way."""
BESIDE_M = 0.035
"""How far inside the limit of the near rule a thing is set down."""
NEARER_M = (0.0, 0.02, 0.035, 0.05)
"""By how much nearer to its goal a thing is set down, in this order, where that is needed."""
LIFT_STEP_M = 0.015
"""By how much less a pose is raised in every further attempt, when the arm cannot follow."""
PUT_DOWN_YAWS_DEG = (0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180)
"""Turns of the held object in which its goal is tried, in this order."""

TcpPose = Float64[np.ndarray, "4 4"]


@value
class Waypoint:
    """A pose of the tcp (robot base frame), the gripper on the way there, and seconds to stay.

    The gripper is 0 closed .. 1 open.
    """

    tcp_base: TcpPose
    gripper: float
    stay_s: float = 0.0


@value
class ExpertState:
    """What is left of the plan, seconds spent at its first waypoint, and the phase planned for."""

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

    def start_with_miss(self, env: Env, rng: np.random.Generator) -> ExpertState:
        """The state before a first grasp that goes beside the target, open or closed.

        What the expert does once its phase is no longer "miss" shows how to begin again.

        Raises: OutOfReach.
        """
        return ExpertState("miss", _plan_miss(env, env.truth(), rng))

    def plan_from_simulation(
        self, states: Sequence[ExpertState], envs: Sequence[Env]
    ) -> tuple[list[ExpertState], list[Chunk]]:
        """One action of every episode, towards its next waypoint.

        Raises: OutOfReach when the next phase cannot be planned.
        """
        pairs = list(zip(states, envs, strict=True))
        after = [self._advance(state, env) for state, env in pairs]
        return after, [
            _step_towards(state.plan[0], env)[None] for state, env in zip(after, envs, strict=True)
        ]

    def _advance(self, state: ExpertState, env: Env) -> ExpertState:
        """Drop the waypoints that are reached; when none is left, plan the next phase."""
        plan, waited, attempt = state.plan, state.waited_s, state.attempt
        if plan and _reached(plan[0], env, waited):
            plan, waited = plan[1:], 0.0
        elif plan:
            # Seconds count in full once the command is there, and less before, so that nothing
            # waits for ever.
            distance, angle = _pose_error(plan[0].tcp_base, env.command.tcp_base)
            there = distance < 0.003 and angle < 0.02 and _gripper_there(plan[0], env)
            waited += (1.0 if there else 0.1) / env.hz
        if plan:
            return ExpertState(state.phase, plan, waited, attempt)
        row, truth = env.row, env.truth()
        if row.rule == "selected":
            return ExpertState("touch", _plan_touch(env, truth, attempt), attempt=attempt + 1)
        if state.phase == "carry" and row.target in truth.held:
            if row.rule != "picked":
                return ExpertState("leave", _plan_set_down(env, truth), attempt=attempt)
            phase, pause = "carry", Waypoint(_raised_within_reach(env, None, 0.02), 0.0, 0.5)
        elif state.phase == "grasp":
            return ExpertState("carry", _plan_take(env, truth, attempt), attempt=attempt + 1)
        else:
            phase, pause = "grasp", Waypoint(_raised_within_reach(env, None, 0.06), 1.0, 0.1)
        return ExpertState(phase, (pause,), attempt=attempt)


def _step_towards(waypoint: Waypoint, env: Env) -> Action:
    """One step from the commanded pose to the waypoint, as fast as allowed."""
    seconds = 1.0 / env.hz
    command = env.command
    grip = float(np.clip(waypoint.gripper - command.gripper, -GRIP_S * seconds, GRIP_S * seconds))
    return action_towards(
        arm(env.robot.name),
        command,
        waypoint.tcp_base,
        command.gripper + grip,
        control=env.control,
        seconds=seconds,
        limits=LIMITS,
    )


def _reached(waypoint: Waypoint, env: Env, waited_s: float) -> bool:
    """Whether the arm is at a waypoint and has stayed, or has waited too long."""
    distance, angle = _pose_error(waypoint.tcp_base, env.tcp_base())
    if waited_s > PATIENCE_S + waypoint.stay_s:
        return True
    close = distance < ARRIVED_M and angle < ARRIVED_RAD
    return close and waited_s >= waypoint.stay_s and _gripper_there(waypoint, env)


def _gripper_there(waypoint: Waypoint, env: Env) -> bool:
    return abs(env.command.gripper - waypoint.gripper) < 0.01


def _pose_error(pose: TcpPose, reference: TcpPose) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    distance = np.linalg.norm(pose[:3, 3] - reference[:3, 3])
    turn = rotation_vector(pose[:3, :3] @ reference[:3, :3].T)
    return float(distance), float(np.linalg.norm(turn))


def _plan_take(env: Env, truth: Truth, attempt: int) -> tuple[Waypoint, ...]:
    """Over the target, down, close, and up until it is clear of everything."""
    low = _grasp_pose(env, truth, attempt)
    foot = float(_points(env, truth)[:, 2].min())
    lift = _raised_within_reach(env, low, max(0.09, _height_of_others(env, truth) - foot + 0.015))
    return (
        Waypoint(_clear_pose(env, truth, low), 1.0),
        Waypoint(low, 1.0),
        Waypoint(low, 0.0, 0.3),
        Waypoint(lift, 0.0),
    )


def _points(env: Env, truth: Truth) -> Float64[np.ndarray, "n 3"]:
    """The points of the target's surface in the world."""
    return points_world(env.row.target, truth.objects_world[env.row.target])


def _plan_miss(env: Env, truth: Truth, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """Over a place beside the best grasp and turned away from it, and down.

    The gripper is then closed as often as not.
    """
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(*MISS_M)
    low = _grasp_pose(env, truth, 0)
    height = rng.uniform(0.0, 0.02)
    shift = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
    low[:3, 3] += _base_from_world(env) @ shift
    yaw = rng.uniform(-MISS_RAD, MISS_RAD)
    low[:3, :3] = rotation(np.array([0.0, 0.0, yaw])) @ low[:3, :3]
    above = _clear_pose(env, truth, low)
    plan = (Waypoint(above, 1.0), Waypoint(low, 1.0), Waypoint(low, 0.0, 0.2))
    return plan[: int(rng.integers(2, 4))]


def _plan_set_down(env: Env, truth: Truth) -> tuple[Waypoint, ...]:
    """Carry the held target to its goal, lower it, let go, and draw back."""
    points = _points(env, truth)
    centre = (points.min(axis=0) + points.max(axis=0))[:2] / 2
    foot = float(points[:, 2].min())
    spots, floor = _put_down_spots(env, truth)
    base = _base_from_world(env)
    about = base @ np.array([*centre, 0.0]) - base @ env.robot.base_world[:3]
    now = env.tcp_base()
    shifts = [base @ np.array([*(spot - centre), floor - foot]) for spot in spots]
    yaws = np.deg2rad(PUT_DOWN_YAWS_DEG).tolist()
    poses = [_turned(now, about, shift, yaw) for shift in shifts for yaw in yaws]
    down = _first_within_reach(env, poses, 0.006)
    if down is None:
        raise OutOfReach(
            f"Expert: {env.row.key}: {env.robot.name} cannot reach {env.row.goal} with "
            f"{env.row.target} in its hand; move it closer."
        )
    return (
        Waypoint(_raised_within_reach(env, down, foot - floor), 0.0, 0.1),
        Waypoint(down, 0.0, 0.15),
        Waypoint(down, 1.0, 0.1),
        Waypoint(_raised_within_reach(env, down, 0.08), 1.0, 0.8),
    )


def _plan_touch(env: Env, truth: Truth, attempt: int) -> tuple[Waypoint, ...]:
    """From straight above onto the middle of the target, with the gripper closed.

    Every second attempt goes for its highest part instead.
    """
    points = _points(env, truth)
    top = float(points[:, 2].max())
    place = (points.min(axis=0) + points.max(axis=0)) / 2
    if attempt % 2:
        place = points[points[:, 2] > top - 0.006].mean(axis=0)
    tip = np.array([place[0], place[1], top - 0.025])
    yaws = np.deg2rad(np.arange(0.0, 360.0, 30.0)).tolist()
    poses = [_pointing_down(env, tip, yaw) for yaw in yaws]
    pose = _first_within_reach(env, _nearest_turn_first(env, poses), 0.02)
    if pose is None:
        raise OutOfReach(
            f"Expert: {env.row.key}: {env.robot.name} cannot reach {env.row.target}; move it "
            "closer."
        )
    height = _height_of_others(env, truth) + ABOVE_M - (top - 0.025)
    above = _raised_within_reach(env, pose, height)
    return Waypoint(above, 0.0), Waypoint(pose, 0.0, 0.2), Waypoint(above, 0.0)


def _grasp_pose(env: Env, truth: Truth, attempt: int) -> TcpPose:
    """Where the hand closes. Raises: OutOfReach."""
    found = grasps(env.robot, env.row.target, truth.objects_world)
    if not found:
        raise OutOfReach(
            f"Expert: {env.row.target} is too wide for {1000 * env.robot.opening_m:.0f} mm of "
            f"{env.robot.name}; choose another object or robot."
        )
    first = GRASP_STRIDE * attempt % len(found)
    for grasp in found[first:] + found:
        pose = _pose_of_grasp(env, grasp)
        if pose is not None:
            return pose
    raise OutOfReach(
        f"Expert: {env.row.key}: no grasp of {env.row.target} can be reached by {env.robot.name}; "
        "move it closer."
    )


def _pose_of_grasp(env: Env, grasp: Grasp) -> TcpPose | None:
    """The tcp's pose for a grasp, as the arm takes it; None when it is out of reach.

    The hand turns the shorter way.
    """
    poses = [_pointing_down(env, grasp.tcp_world, grasp.axis_rad + turn) for turn in (0.0, np.pi)]
    # So far along the opening axis that a fixed jaw stands close by: what the other jaw pushes far
    # topples.
    jaw = env.robot.fixed_jaw_m
    shift = float(np.sign(jaw) * max(abs(jaw) - grasp.span_m / 2 - JAW_GAP_M, 0.0))
    for pose in _nearest_turn_first(env, poses):
        pose[:3, 3] -= pose[:3, 1] * shift
        reached = _within_reach(env, pose, 0.003)
        if reached is not None and _within_reach(env, _raised(pose, 0.04), 0.006) is not None:
            return reached
    return None


def _clear_pose(env: Env, truth: Truth, low: TcpPose) -> TcpPose:
    """Straight over a pose, clear of everything."""
    height = float(low[2, 3] + env.robot.base_world[2])
    return _raised_within_reach(env, low, _height_of_others(env, truth) + ABOVE_M - height)


def _within_reach(env: Env, pose: TcpPose, tolerance_m: float) -> TcpPose | None:
    """The pose that the arm really takes for `pose`, or None when it is out of reach.

    An arm of five joints may lean a little.
    """
    kinematics = arm(env.robot.name)
    try:
        joints = kinematics.reach(pose, tolerance_m)
    except OutOfReach:
        return None
    return kinematics.forward(joints)


def _first_within_reach(env: Env, poses: Iterable[TcpPose], tolerance_m: float) -> TcpPose | None:
    """The first of several poses that the arm can take, as it takes it."""
    reached = (_within_reach(env, pose, tolerance_m) for pose in poses)
    return next((pose for pose in reached if pose is not None), None)


def _raised_within_reach(env: Env, pose: TcpPose | None, height_m: float) -> TcpPose:
    """`pose` (None: the commanded one) raised by `height_m`, or by as much as the arm can do."""
    start = env.command.tcp_base if pose is None else pose
    less = np.arange(0.0, max(height_m, 0.0), LIFT_STEP_M).tolist()
    reached = _first_within_reach(env, (_raised(start, height_m - m) for m in less), 0.006)
    return start if reached is None else reached


def _nearest_turn_first(env: Env, poses: Sequence[TcpPose]) -> list[TcpPose]:
    """Poses in the order of the turn that leads to them from the commanded one."""
    now = env.command.tcp_base
    return sorted(poses, key=lambda pose: _pose_error(pose, now)[1])


def _turned(
    pose: TcpPose, about: Float64[np.ndarray, "3"], shift: Float64[np.ndarray, "3"], yaw: float
) -> TcpPose:
    """`pose` turned by `yaw` about the vertical through `about`, then moved by `shift`."""
    turn = rotation(np.array([0.0, 0.0, yaw]))
    axis = np.array([*about[:2], 0.0])
    turned = np.eye(4)
    turned[:3, :3] = turn @ pose[:3, :3]
    turned[:3, 3] = axis + turn @ (pose[:3, 3] - axis) + shift
    return turned


def _put_down_spots(env: Env, truth: Truth) -> tuple[list[Float64[np.ndarray, "2"]], float]:
    """Where the target's centre goes, the best spot first, and the height at which it is let go.

    Beside a goal it goes as far away as the rule lets it, for room; nearer where something else
    would be nearer to it than the goal, or where the arm cannot reach.
    """
    row = env.row
    goal = truth.objects_world[row.goal]
    if row.rule == "put":
        return [goal[:2].copy()], float(goal[2]) + 0.016
    target = truth.objects_world[row.target]
    diagonals = [
        np.hypot(*np.ptp(points_world(name, pose), axis=0)[:2])
        for name, pose in ((row.goal, goal), (row.target, target))
    ]
    reach = 0.5 * (diagonals[0] + diagonals[1]) + 0.10 - BESIDE_M
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    others = [
        pose for name, pose in truth.objects_world.items() if name not in (row.target, row.goal)
    ]
    fitting = []
    farthest = None
    for nearer in NEARER_M:
        distance = reach - nearer
        spots = goal[:2] + distance * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # The least distance from an object other than target and goal; 1 m without any.
        apart = [np.hypot(*(spots - pose[:2]).T) for pose in others]
        room = np.min(apart, axis=0) if apart else np.ones(len(spots))
        way = np.hypot(*(spots - target[:2]).T)
        worth = np.minimum(room, 0.13) - 0.1 * way
        order = np.argsort(-worth, kind="stable").tolist()
        if farthest is None:
            farthest = spots[order[0]]
        fitting += [spots[i] for i in order if room[i] > distance]
    return fitting or [farthest], float(goal[2]) + 0.004


def _height_of_others(env: Env, truth: Truth) -> float:
    """The height of the tallest object on the table, metres in the world.

    The target counts as long as it is not in the hand.
    """
    return max(
        float(points_world(name, pose)[:, 2].max())
        for name, pose in truth.objects_world.items()
        if name != env.row.target or name not in truth.held
    )


def _pointing_down(env: Env, tcp_world: Float64[np.ndarray, "3"], axis_rad: float) -> TcpPose:
    """The tcp's pose pointing straight down, its opening axis at `axis_rad` in the world."""
    base = _base_from_world(env)
    opening = base.T @ env.robot.down_base[:, 1]
    yaw = axis_rad - float(np.arctan2(opening[1], opening[0]))
    pose = np.eye(4)
    pose[:3, :3] = base @ rotation(np.array([0.0, 0.0, yaw])) @ base.T @ env.robot.down_base
    pose[:3, 3] = base @ (tcp_world - env.robot.base_world[:3])
    return pose


def _base_from_world(env: Env) -> Float64[np.ndarray, "3 3"]:
    """The rotation from world to robot base axes."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(env.robot.base_world[3:], scalar_first=True).as_matrix().T


def _raised(pose: TcpPose, height_m: float) -> TcpPose:
    raised = pose.copy()
    raised[2, 3] += height_m
    return raised
