"""The cameras: where they stand, their pinhole geometry, and how they render."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from vap_core.base.errors import BadRobot, UnknownName
from vap_core.base.types import Camera, Mask, Rgb, value
from vap_core.simulation.gl import ensure_gl, keep_contexts

ensure_gl()
import mujoco  # noqa: E402

from vap_core.simulation.looks import PLAIN_LIGHT, Light, dim  # noqa: E402
from vap_core.simulation.occluder import Screen, draw_screens  # noqa: E402

keep_contexts()

HIDDEN_GROUP = 5
"""Geom group that is never drawn."""
HAND = -2
"""The owner of the gripper's geoms, beside the objects by their index."""
_FLIP = np.diag([1.0, -1.0, -1.0])
"""OpenGL camera axes (y up, looking along -z) to OpenCV's (y down, looking along +z)."""

LEAST_SINE = 1e-6
"""Of the angle between a camera's view and its up."""


@value
class Rig:
    """A camera fixed to `body`.

    It stands at `pos_m` and looks at `aim_m`, both in the body's frame; `up` points up in the
    picture. Raises: BadRobot when `aim_m` is where it stands, or `up` is along its view.
    """

    name: str
    body: str
    pos_m: tuple[float, float, float]
    aim_m: tuple[float, float, float]
    fovy_rad: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        back = np.subtract(self.pos_m, self.aim_m)
        distance = np.linalg.norm(back)
        if not distance > 0.0:
            raise BadRobot(
                f"camera {self.name!r} stands where it aims, at {self.pos_m}; give another aim_m."
            )
        right = np.cross(self.up, back / distance)
        if not np.linalg.norm(right) > LEAST_SINE * np.linalg.norm(self.up):
            upright = abs(back[2]) > LEAST_SINE * distance
            other = "(1, 0, 0)" if upright else "(0, 0, 1)"
            raise BadRobot(f"camera {self.name!r} looks along its up; give up={other}.")

    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """Body from camera, OpenGL axes."""
        back = np.subtract(self.pos_m, self.aim_m)
        back /= np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back], axis=1)


RIGS: dict[str, tuple[Rig, ...]] = {
    "wx250s": (Rig("front", "world", (0.76, 0.0, 0.35), (0.24, 0.0, 0.105), np.deg2rad(44.0)),),
    "panda": (
        Rig("front", "world", (0.98, 0.0, 0.37), (0.44, 0.0, 0.12), np.deg2rad(44.0)),
        Rig("side", "world", (0.68, -0.46, 0.42), (0.47, -0.01, 0.05), np.deg2rad(44.0)),
        Rig(
            name="wrist",
            body="hand",
            pos_m=(0.09, 0.0, 0.045),
            aim_m=(0.03, 0.0, 0.20),
            fovy_rad=np.deg2rad(72.0),
            up=(-1.0, 0.0, 0.0),
        ),
    ),
    "so101": (
        Rig("front", "world", (0.66, 0.0, 0.38), (0.20, 0.0, 0.055), np.deg2rad(49.0)),
        Rig("side", "world", (0.30, -0.46, 0.33), (0.18, 0.0, 0.06), np.deg2rad(48.0)),
        Rig(
            name="wrist",
            body="gripper",
            pos_m=(0.0, 0.055, -0.045),
            aim_m=(0.008, -0.006, -0.118),
            fovy_rad=np.deg2rad(80.0),
            up=(0.0, 1.0, 0.0),
        ),
    ),
    "google": (Rig("head", "base_link", (0.165, 0.0, 1.195), (0.50, 0.0, 0.61), np.deg2rad(50.0)),),
}


SHIPPED_RIGS: Mapping[str, tuple[Rig, ...]] = MappingProxyType(dict(RIGS))
"""The cameras of the robots that ship, whatever the file of an own suite enters in RIGS."""


def add_rigs(
    spec: mujoco.MjSpec, robot: str, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[str, ...]:
    """Mount the cameras of `robot` in `spec`, and return their names.

    All but a wrist camera are moved by `shift_m`.
    Raises: UnknownName for a robot without cameras; BadRobot where its MJCF lacks a camera's body.
    """
    if robot not in RIGS:
        raise UnknownName(
            f"cameras.add_rigs: robot {robot!r} has no cameras; enter them in RIGS, which has "
            f"those of {', '.join(sorted(RIGS))}."
        )
    for rig in RIGS[robot]:
        if rig.name != "wrist":
            x, y, z = rig.pos_m
            dx, dy, dz = shift_m
            rig = replace(rig, pos_m=(x + dx, y + dy, z + dz))
        body = spec.body(rig.body)
        if body is None:
            raise BadRobot(
                f"camera {rig.name!r} of {robot} is fixed to the body {rig.body!r}, which the "
                "robot's MJCF lacks; correct Rig.body."
            )
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, rig.rotation().ravel())
        body.add_camera(name=rig.name, pos=rig.pos_m, quat=quat, fovy=np.rad2deg(rig.fovy_rad))
    return tuple(rig.name for rig in RIGS[robot])


def intrinsics(
    model: mujoco.MjModel, name: str, size: tuple[int, int]
) -> Float64[np.ndarray, "3 3"]:
    """K in pixels for a picture of `size` = (height, width).

    Pixel (u, v) covers u..u+1, v..v+1, so the centre is (width/2, height/2).
    """
    height, width = size
    fovy_rad = np.deg2rad(float(model.camera(name).fovy[0]))
    focal = 0.5 * height / np.tan(0.5 * fovy_rad)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def pose_of(part: Any) -> Float64[np.ndarray, "4 4"]:
    """The pose in the world of a body, site or camera, as MjData names it."""
    pose = np.eye(4)
    pose[:3, :3] = part.xmat.reshape(3, 3)
    pose[:3, 3] = part.xpos
    return pose


def camera(model: mujoco.MjModel, data: mujoco.MjData, name: str, size: tuple[int, int]) -> Camera:
    """The calibrated camera `name` where it is now; `size` = (height, width) in pixels."""
    pose = pose_of(data.camera(name))
    pose[:3, :3] = pose[:3, :3] @ _FLIP
    height, width = size
    return Camera(
        name=name, width=width, height=height, k=intrinsics(model, name, size), pose_world=pose
    )


def project(cam: Camera, points_world: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """Pixels (u right, v down) of world points, metres; NaN for points behind the camera."""
    local = (points_world - cam.pose_world[:3, 3]) @ cam.pose_world[:3, :3]
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    return (local @ cam.k.T)[:, :2] / depth[:, None]


class Renderer:
    """Renders a model's cameras: colours, and object masks on demand.

    One renderer per picture size and number of samples a pixel. `objects` names the bodies whose
    masks can be asked for; a hidden object is not drawn at all.
    """

    def __init__(
        self, model: mujoco.MjModel, objects: Sequence[str], shadows: bool = False
    ) -> None:
        self.model = model
        self.objects = tuple(objects)
        self.shadows = shadows
        if not shadows:
            model.vis.quality.shadowsize = 0  # a map that nothing is drawn from takes 64 MB
        self._renderers: dict[tuple[int, int, int], mujoco.Renderer] = {}
        self._groups = model.geom_group.copy()
        self._owner = np.where(hand_geoms(model), HAND, object_of_geoms(model, self.objects))

    def close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def rgb(
        self,
        data: mujoco.MjData,
        name: str,
        size: tuple[int, int],
        hidden: frozenset[str] = frozenset(),
        before: Sequence[Screen] = (),
        light: Light = PLAIN_LIGHT,
        samples: int = 0,
    ) -> Rgb:
        """The picture of camera `name`, with `before` in front of it.

        `size` is its height and width in pixels; without `samples` a pixel is drawn once.
        """
        renderer = self._updated(data, name, (*size, samples), hidden, before, ids=False)
        dim(renderer.scene, light)
        return renderer.render()

    def masks_and_hand(
        self,
        data: mujoco.MjData,
        name: str,
        size: tuple[int, int],
        hidden: frozenset[str] = frozenset(),
        before: Sequence[Screen] = (),
    ) -> tuple[Mapping[str, Mask], Mask]:
        """Visible pixels of every object that is not hidden, and those of the gripper.

        `before` is in front of the camera.
        """
        renderer = self._updated(data, name, (*size, 0), hidden, before, ids=True)
        owners = np.full(renderer.scene.ngeom + 1, -1)  # of the ids that are drawn as colours
        for drawn in renderer.scene.geoms[: renderer.scene.ngeom]:
            if drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                owners[drawn.segid + 1] = self._owner[drawn.objid]
        colours = renderer.render()
        owner = owners[colours[..., 0] + 256 * colours[..., 1].astype(np.uint16)]
        masks = {each: owner == i for i, each in enumerate(self.objects) if each not in hidden}
        return masks, owner == HAND

    def _updated(
        self,
        data: mujoco.MjData,
        name: str,
        size: tuple[int, int, int],
        hidden: frozenset[str],
        before: Sequence[Screen],
        *,
        ids: bool,
    ) -> mujoco.Renderer:
        """The renderer of this size, for what camera `name` sees now in colours or in ids."""
        renderer = self._renderers.get(size)
        if renderer is None:
            height, width, self.model.vis.quality.offsamples = size
            buffer = self.model.vis.global_  # MuJoCo draws into 640 x 480 unless told
            buffer.offheight = max(buffer.offheight, height)
            buffer.offwidth = max(buffer.offwidth, width)
            max_geom = self.model.ngeom + 64
            renderer = mujoco.Renderer(self.model, height, width, max_geom=max_geom)
            self._renderers[size] = renderer
        hidden_geoms = np.isin(self._owner, [self.objects.index(each) for each in hidden])
        self.model.geom_group[:] = np.where(hidden_geoms, HIDDEN_GROUP, self._groups)
        renderer.update_scene(data, camera=name)
        draw_screens(renderer.scene, before)
        flags = renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        flags[mujoco.mjtRndFlag.mjRND_HAZE] = 0
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self.shadows
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = ids
        return renderer


def object_of_geoms(model: mujoco.MjModel, objects: Sequence[str]) -> Int64[np.ndarray, " g"]:
    """Of each geom the index into `objects` of its object, -1 for the rest of the scene."""
    owners = np.full(model.nbody, -1, np.int64)
    for i, name in enumerate(objects):
        owners[model.body(name).id] = i
    return owners[model.body_rootid[model.geom_bodyid]]


def hand_geoms(model: mujoco.MjModel) -> Bool[np.ndarray, " g"]:
    """Whether a geom is of the gripper: of the body that bears the tcp, or of one below it."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tcp")
    of_hand = np.zeros(model.nbody, bool)
    if site >= 0:
        of_hand[model.site_bodyid[site]] = True
    for body in range(1, model.nbody):  # a parent comes before its children
        of_hand[body] |= of_hand[model.body_parentid[body]]
    return of_hand[model.geom_bodyid]
