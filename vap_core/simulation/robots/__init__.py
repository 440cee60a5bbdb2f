"""The robots: MJCF with the real kinematics and plain geometry, and the parameters of each."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vap_core.base.errors import one_of
from vap_core.base.types import value
from vap_core.simulation.types import Pose

HERE = Path(__file__).parent
FASTEST_RAD_S = 30.0
"""A joint that is faster has its speed in degrees."""
ORIGIN = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@value
class Robot:
    """One arm with a parallel gripper.

    Every joint has a position actuator of the same name, and a site `tcp` lies between the
    fingertips. The site's z points out of the gripper and its y along the opening axis. `home` and
    `speed_rad_s` follow `joints`; `fingers_open` and `fingers_closed` follow `fingers`, metres or
    radians of travel (so101: one jaw that swings); `opening_m` is the clear width between open
    pads, and `palm_m` how far an object between them may reach above the tcp before it meets the
    palm (narrow necks and straws may go deeper).
    `down_base` is the tcp's rotation in the robot base frame when the gripper points straight down,
    its opening axis across the table: the state's rotation vector is counted from it, so that a
    turn about the vertical reads (0, 0, yaw).
    `fixed_jaw_m` is where, along the tcp's y, the pad of a jaw that does not move stands; 0 when
    both fingers close alike. `hand_m` is half the palm's length along the opening axis and half its
    width across it, for the clearance of a grasp. `turn_cost` is the cost in the inverse kinematics
    of one radian of error beside that of one metre: where both cannot be met, a small value makes
    the hand lean and keep its place. `lean_rad` is how far the hand of an arm of five joints may
    lean before a pose counts as out of reach.
    `table_m` is the table top's (x0, y0, x1, y1) and `floor_z_m` the floor below it, metres in the
    world frame.
    Raises: ValueError when joints, home angles and speeds differ in number, or fingers and their
        two lists of travel; when there is no finger or no link; for an `hz` or a speed that is not
        above 0 or too fast for radians, or a finger whose two travels are equal.
    """

    name: str
    xml: Path
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    home: Float64[np.ndarray, " n"]
    speed_rad_s: Float64[np.ndarray, " n"]
    fingers_open: tuple[float, ...]
    fingers_closed: tuple[float, ...]
    opening_m: float
    palm_m: float
    hz: float
    base_world: Pose
    links: tuple[str, ...]
    down_base: Float64[np.ndarray, "3 3"]
    fixed_jaw_m: float = 0.0
    hand_m: tuple[float, float] = (0.055, 0.035)
    table_m: tuple[float, float, float, float] = (-0.27, -0.65, 0.83, 0.65)
    floor_z_m: float = -0.75
    turn_cost: float = 0.3
    lean_rad: float = 0.0

    def __post_init__(self) -> None:
        if not len(self.joints) == len(self.home) == len(self.speed_rad_s):
            raise ValueError(
                f"Robot {self.name!r}: {len(self.joints)} joints, {len(self.home)} home angles, "
                f"{len(self.speed_rad_s)} speeds; one each"
            )
        n = len(self.fingers)
        if not n == len(self.fingers_open) == len(self.fingers_closed) or n == 0:
            raise ValueError(
                f"Robot {self.name!r}: {n} fingers, {len(self.fingers_open)} open, "
                f"{len(self.fingers_closed)} closed; one each, and at least one finger"
            )
        if not self.hz > 0:
            raise ValueError(f"Robot {self.name!r}: hz is {self.hz:g}; give more than 0")
        if not ((self.speed_rad_s > 0) & (self.speed_rad_s <= FASTEST_RAD_S)).all():
            raise ValueError(
                f"Robot {self.name!r}: speed_rad_s is {self.speed_rad_s.tolist()}; give radians a "
                f"second, above 0 and at most {FASTEST_RAD_S:g}"
            )
        for finger, opened, closed in zip(
            self.fingers, self.fingers_open, self.fingers_closed, strict=True
        ):
            if opened == closed:
                raise ValueError(
                    f"Robot {self.name!r}: finger {finger!r} is at {opened:g} both open and closed"
                )
        if not self.links:
            raise ValueError(
                f"Robot {self.name!r}: links is empty; name the bodies from the base to the fingers"
            )


ROBOTS: dict[str, Robot] = {
    "wx250s": Robot(
        name="wx250s",
        xml=HERE / "wx250s.xml",
        joints=("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
        fingers=("left_finger", "right_finger"),
        home=np.array([0.0, -0.32482, -0.05009, 0.0, 1.9457, 0.0]),
        speed_rad_s=np.full(6, np.pi),
        fingers_open=(0.037, -0.037),
        fingers_closed=(0.015, -0.015),
        opening_m=0.054,
        palm_m=0.028,
        hz=5.0,
        base_world=ORIGIN,
        links=(
            "base_link",
            "shoulder_link",
            "upper_arm_link",
            "upper_forearm_link",
            "lower_forearm_link",
            "wrist_link",
            "gripper_link",
            "left_finger_link",
            "right_finger_link",
        ),
        down_base=np.diag([-1.0, 1.0, -1.0]),
    ),
    "panda": Robot(
        name="panda",
        xml=HERE / "panda.xml",
        joints=("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7"),
        fingers=("finger_joint1", "finger_joint2"),
        home=np.array([0.0, -0.49901, 0.0, -2.61756, 0.0, 2.11855, 0.7853982]),
        speed_rad_s=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
        fingers_open=(0.04, 0.04),
        fingers_closed=(0.0, 0.0),
        opening_m=0.080,
        palm_m=0.041,
        hz=10.0,
        base_world=ORIGIN,
        links=(
            "link0",
            "link1",
            "link2",
            "link3",
            "link4",
            "link5",
            "link6",
            "link7",
            "hand",
            "left_finger",
            "right_finger",
        ),
        down_base=np.diag([1.0, -1.0, -1.0]),
        hand_m=(0.105, 0.035),
    ),
    "so101": Robot(
        name="so101",
        xml=HERE / "so101.xml",
        joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
        fingers=("gripper",),
        home=np.array([0.0, -1.65, 0.75, 1.6, -1.5221]),
        speed_rad_s=np.full(5, 3.5),
        fingers_open=(1.25,),
        fingers_closed=(-0.17,),
        opening_m=0.070,
        palm_m=0.042,
        hz=30.0,
        base_world=ORIGIN,
        links=(
            "base",
            "shoulder",
            "upper_arm",
            "lower_arm",
            "wrist",
            "gripper",
            "moving_jaw_so101_v1",
        ),
        down_base=np.diag([1.0, -1.0, -1.0]),
        fixed_jaw_m=-0.0335,
        hand_m=(0.06, 0.03),
        table_m=(-0.2, -0.45, 0.6, 0.45),
        turn_cost=0.01,
        lean_rad=0.65,
    ),
    "google": Robot(
        name="google",
        xml=HERE / "google.xml",
        joints=(
            "joint_torso",
            "joint_shoulder",
            "joint_bicep",
            "joint_elbow",
            "joint_forearm",
            "joint_wrist",
            "joint_gripper",
        ),
        fingers=("joint_finger_right", "joint_finger_left"),
        home=np.array([-0.8, 0.0656416, 0.9061483, 1.4976823, -0.051682, 1.6033443, -3.0381746]),
        speed_rad_s=np.array([1.5, 1.5, 1.5, 1.5, 2.0, 2.0, 2.0]),
        fingers_open=(0.35, 0.35),
        fingers_closed=(0.96, 0.96),
        opening_m=0.102,
        palm_m=0.040,
        hz=3.0,
        base_world=np.array([0.0, 0.0, -0.58795, 1.0, 0.0, 0.0, 0.0]),
        links=(
            "base_link",
            "link_torso",
            "link_shoulder",
            "link_bicep",
            "link_elbow",
            "link_forearm",
            "link_wrist",
            "link_gripper",
            "link_finger_right",
            "link_finger_tip_right",
            "link_finger_left",
            "link_finger_tip_left",
        ),
        down_base=np.diag([1.0, -1.0, -1.0]),
        hand_m=(0.085, 0.045),
        table_m=(0.30, -0.60, 1.05, 0.60),
        floor_z_m=-0.65,
    ),
}


def get(name: str) -> Robot:
    """The robot called `name`. Raises: UnknownName."""
    if name not in ROBOTS:
        raise one_of("robots.get: robot", name, ROBOTS)
    return ROBOTS[name]
