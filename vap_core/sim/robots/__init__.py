"""The robots of the workspace: MJCF with the real kinematics and plain geometry, and what a controller must know of each."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vap_core.errors import one_of
from vap_core.values import Pose, value

HERE = Path(__file__).parent
ORIGIN = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@value
class Robot:
    """One arm with a parallel gripper. Every joint has a position actuator of the same name and a site `tcp` lies between the fingertips.

    The site's z points out of the gripper and its y along the opening axis. `home` and `speed_rad_s` follow `joints`;
    `fingers_open` and `fingers_closed` follow `fingers`, metres of travel; `opening_m` is the clear width between open pads, and
    `palm_m` how far an object between them may reach above the tcp before it meets the palm (narrow necks and straws may go deeper).
    `down_base` is the tcp's rotation in the robot base frame when the gripper points straight down, its opening axis across the table:
    the state's rotation vector is counted from it, so that a turn about the vertical reads (0, 0, yaw).
    `table_m` is the table top's (x0, y0, x1, y1) and `floor_z_m` the floor below it, metres in the world frame.
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
    table_m: tuple[float, float, float, float] = (-0.27, -0.65, 0.83, 0.65)
    floor_z_m: float = -0.75

    def __post_init__(self) -> None:
        if not len(self.joints) == len(self.home) == len(self.speed_rad_s):
            raise ValueError(
                f"Robot {self.name!r}: {len(self.joints)} joints, {len(self.home)} home angles, {len(self.speed_rad_s)} speeds; one each"
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
        links=("link0", "link1", "link2", "link3", "link4", "link5", "link6", "link7", "hand", "left_finger", "right_finger"),
        down_base=np.diag([1.0, -1.0, -1.0]),
    ),
}


def get(name: str) -> Robot:
    """The robot called `name`. Raises: UnknownName."""
    if name not in ROBOTS:
        raise one_of("robots.get: robot", name, ROBOTS)
    return ROBOTS[name]
