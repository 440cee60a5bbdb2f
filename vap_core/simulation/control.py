"""From actions to joint targets, by mink's differential inverse kinematics.

It runs on a model of the robot alone, whose base frame is the world frame.
"""

from functools import cache

import mink
import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.errors import BadAction, OutOfReach
from vap_core.base.types import value
from vap_core.simulation import robots
from vap_core.simulation.robots import Robot, mjcf
from vap_core.simulation.types import Action, Pose

ROUNDS = 12
"""Most iterations of one solution; it stops as soon as the pose is met."""
NEAR_M = 2e-5
NEAR_RAD = 2e-4
"""A pose is met within these errors."""
TWIST_RAD = 0.05
"""Largest turn of a leaning hand about its own axis."""
LEAD_M = 0.05
LEAD_RAD = 0.5
"""Largest lead of the commanded pose over the measured one."""
LEAD_JOINT_RAD = 0.25
"""Largest lead of a commanded joint over the measured one under joint control."""
BEYOND = 10
"""An action of more than so many times the largest speed is noted: its units must be wrong."""


@value
class Setpoint:
    """The commanded state of the arm and its gripper.

    `tcp_base` (4 x 4, metres, robot base frame), the joint angles (rad) of that pose, and the
    gripper's opening 0..1.
    """

    tcp_base: Float64[np.ndarray, "4 4"]
    joints: Float64[np.ndarray, " n"]
    gripper: float


@value
class MotionLimits:
    """How fast an action may move the gripper: metres and radians per second."""

    speed_m_s: float = 0.25
    turn_rad_s: float = 1.5


MOTION_LIMITS = MotionLimits()


class Arm:
    """The kinematics of one robot.

    It holds mink's buffers and nothing of an episode: every answer depends on the arguments alone.
    Raises: BadRobot for a robot whose MJCF is absent or lacks a part.
    """

    def __init__(self, robot: Robot) -> None:
        spec = mjcf.load(robot)
        for finger in robot.fingers:
            spec.delete(spec.actuator(finger))
        for equality in list(spec.equalities):
            spec.delete(equality)
        for finger in robot.fingers:
            spec.delete(spec.joint(finger))
        self.robot = robot
        self.model = spec.compile()
        self.configuration = mink.Configuration(self.model)
        self.task = mink.FrameTask(
            "tcp",
            "site",
            position_cost=1.0,
            orientation_cost=robot.turn_cost,
            gain=1.0,
            lm_damping=1e-6,
        )
        self.posture = mink.PostureTask(self.model, cost=1e-4)
        self.posture.set_target(robot.home)
        speeds = dict(zip(robot.joints, robot.speed_rad_s.tolist(), strict=True))
        self.limits = [mink.ConfigurationLimit(self.model), mink.VelocityLimit(self.model, speeds)]

    def forward(self, joints: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "4 4"]:
        """The tcp's pose in the robot base frame at `joints` (rad)."""
        self.configuration.update(joints)
        pose = self.configuration.get_transform_frame_to_world("tcp", "site")
        return np.asarray(pose.as_matrix())

    def solve(
        self,
        joints: Float64[np.ndarray, " n"],
        tcp_base: Float64[np.ndarray, "4 4"],
        seconds: float,
    ) -> Float64[np.ndarray, " n"]:
        """Joint angles nearest to `tcp_base` that are reached from `joints` within `seconds`.

        The joints move at their rated speeds at most.
        """
        self.configuration.update(joints)
        self.task.set_target(mink.SE3.from_matrix(tcp_base))
        for _ in range(ROUNDS):
            error = self.task.compute_error(self.configuration)
            if np.linalg.norm(error[:3]) < NEAR_M and np.linalg.norm(error[3:]) < NEAR_RAD:
                break
            dt = seconds / ROUNDS
            velocity = mink.solve_ik(
                self.configuration,
                [self.task, self.posture],
                dt,
                solver="daqp",
                damping=1e-9,
                limits=self.limits,
            )
            self.configuration.integrate_inplace(velocity, dt)
        return self.configuration.q.copy()

    def reach(
        self, tcp_base: Float64[np.ndarray, "4 4"], tolerance_m: float = 1e-3
    ) -> Float64[np.ndarray, " n"]:
        """Joint angles for a pose, from home, without a limit of time.

        The hand may lean by the robot's `lean_rad`. Raises: OutOfReach.
        """
        joints = self.robot.home
        for _ in range(8):
            joints = self.solve(joints, tcp_base, 2.0)
        found = self.forward(joints)
        off = float(np.linalg.norm(found[:3, 3] - tcp_base[:3, 3]))
        turn = float(np.linalg.norm(rotation_vector(found[:3, :3] @ tcp_base[:3, :3].T)))
        lean, twist = _lean_and_twist(tcp_base[:3, :3], found[:3, :3])
        leans = self.robot.lean_rad > 0.0 and lean <= self.robot.lean_rad and twist <= TWIST_RAD
        if off > tolerance_m or (turn > 10 * tolerance_m and not leans):
            where = tcp_base[:3, 3].round(3).tolist()
            raise OutOfReach(
                f"Arm.reach: {self.robot.name} stays {1000 * off:.0f} mm and {turn:.2f} rad away "
                f"from {where} m; move it closer."
            )
        return joints


@cache
def arm(robot: str) -> Arm:
    """The kinematics of the robot called `robot`, built once per process."""
    return Arm(robots.get(robot))


def follow(
    arm: Arm,
    command: Setpoint,
    measured_base: Float64[np.ndarray, "4 4"],
    action: Float32[np.ndarray, "7"],
    seconds: float,
    limits: MotionLimits = MOTION_LIMITS,
) -> Setpoint:
    """The command after one action (a row of policies.protocol.Chunk) that lasts `seconds`.

    The delta applies to the *commanded* pose, so that the arm's droop does not add up; the command
    is first limited to within 5 cm and 0.5 rad of the measured pose, so that it does not run away
    from an arm that is blocked.
    """
    start = _limit_lead(command.tcp_base, measured_base)
    delta = action.astype(np.float64)
    goal = start.copy()
    goal[:3, 3] += capped(delta[:3], limits.speed_m_s * seconds)
    goal[:3, :3] = rotation(capped(delta[3:6], limits.turn_rad_s * seconds)) @ start[:3, :3]
    joints = arm.solve(command.joints, goal, seconds)
    reached = arm.forward(joints)
    off = np.linalg.norm(reached[:3, 3] - goal[:3, 3])
    turn = np.linalg.norm(rotation_vector(reached[:3, :3] @ goal[:3, :3].T))
    met = off < 1e-3 and turn < 1e-2
    return Setpoint(
        tcp_base=goal if met else reached,
        joints=joints,
        gripper=float(np.clip(delta[6], 0.0, 1.0)),
    )


def follow_joints(
    arm: Arm,
    command: Setpoint,
    measured: Float64[np.ndarray, " n"],
    action: Float32[np.ndarray, " m"],
    seconds: float,
) -> Setpoint:
    """The command after one action of joint deltas and the gripper that lasts `seconds`.

    The deltas (rad, in the order of Robot.joints) apply to the *commanded* joints, no faster than
    their rated speeds; the gripper is 0..1. The result stays within the joints' limits and leads
    the `measured` joints (rad) by at most LEAD_JOINT_RAD. Raises: BadAction.
    """
    if len(action) != len(arm.robot.joints) + 1:
        raise BadAction(
            f"follow_joints: {len(action)} numbers, but {arm.robot.name} takes "
            f"{len(arm.robot.joints)} joint deltas and the gripper."
        )
    fastest = arm.robot.speed_rad_s * seconds
    delta = action.astype(np.float64)
    asked = command.joints + np.clip(delta[:-1], -fastest, fastest)
    low, high = arm.model.jnt_range.T
    near = np.clip(asked, measured - LEAD_JOINT_RAD, measured + LEAD_JOINT_RAD)
    allowed = np.clip(near, low, high)
    joints = command.joints + np.clip(allowed - command.joints, -fastest, fastest)
    return Setpoint(arm.forward(joints), joints, float(np.clip(delta[-1], 0.0, 1.0)))


def action_towards(
    arm: Arm,
    command: Setpoint,
    goal: Float64[np.ndarray, "4 4"],
    gripper: float,
    *,
    control: str,
    seconds: float,
    limits: MotionLimits,
) -> Action:
    """One step from the commanded pose of the tcp towards `goal` (robot base frame).

    It lasts `seconds`, is as fast as `limits` allow, and is in the `control` that the suite has,
    "ee" or "joint". `gripper` is 0..1 at its end.
    """
    now = command.tcp_base
    move = capped(goal[:3, 3] - now[:3, 3], limits.speed_m_s * seconds)
    turn = capped(rotation_vector(goal[:3, :3] @ now[:3, :3].T), limits.turn_rad_s * seconds)
    if control == "ee":
        return np.array([*move, *turn, gripper], np.float32)
    step = np.eye(4)
    step[:3, :3] = rotation(turn) @ now[:3, :3]
    step[:3, 3] = now[:3, 3] + move
    joints = arm.solve(command.joints, step, seconds)
    return np.array([*(joints - command.joints), gripper], np.float32)


def is_beyond(
    action: Float32[np.ndarray, " m"],
    robot: Robot,
    control: str,
    seconds: float,
    limits: MotionLimits = MOTION_LIMITS,
) -> bool:
    """Whether a pose delta ("ee") or joint deltas ask for over BEYOND times the largest speed."""
    delta = action.astype(np.float64)
    if control == "ee":
        shift, turn = np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:6])
        return bool(
            shift > BEYOND * limits.speed_m_s * seconds
            or turn > BEYOND * limits.turn_rad_s * seconds
        )
    return bool((np.abs(delta[:-1]) > BEYOND * robot.speed_rad_s * seconds).any())


def rotation(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation matrix of a rotation vector, rad."""
    return np.asarray(mink.SO3.exp(vector).as_matrix())


def rotation_vector(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """The rotation vector, rad, of a rotation matrix; its length is at most pi."""
    return np.asarray(mink.SO3.from_matrix(np.ascontiguousarray(matrix)).log())


def pose_transform(pose: Pose) -> mink.SE3:
    """World from body, for a pose `x y z qw qx qy qz`."""
    return mink.SE3.from_rotation_and_translation(mink.SO3(pose[3:]), pose[:3])


def _lean_and_twist(
    asked: Float64[np.ndarray, "3 3"], found: Float64[np.ndarray, "3 3"]
) -> tuple[float, float]:
    """The angle between the hand's z axis and the one asked for, and its turn about it, rad."""
    axis = np.cross(asked[:, 2], found[:, 2])
    sine = float(np.linalg.norm(axis))
    lean = float(np.arctan2(sine, asked[:, 2] @ found[:, 2]))
    leant = rotation(axis * (lean / sine)) @ asked if sine > 1e-9 else asked
    return lean, float(np.linalg.norm(rotation_vector(found @ leant.T)))


def capped(vector: Float64[np.ndarray, "3"], longest: float) -> Float64[np.ndarray, "3"]:
    """The vector, shortened to `longest` where it is longer."""
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)


def _limit_lead(
    commanded: Float64[np.ndarray, "4 4"], measured: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "4 4"]:
    """The commanded pose, at most LEAD_M and LEAD_RAD from the measured one."""
    ahead = commanded[:3, 3] - measured[:3, 3]
    turn = rotation_vector(commanded[:3, :3] @ measured[:3, :3].T)
    limited = commanded.copy()
    limited[:3, 3] = measured[:3, 3] + capped(ahead, LEAD_M)
    if np.linalg.norm(turn) > LEAD_RAD:
        limited[:3, :3] = rotation(capped(turn, LEAD_RAD)) @ measured[:3, :3]
    return limited
