"""A controlled occluder (P tab:occlusion_sweep) hides the target from a camera for some steps.

It is drawn into that camera's picture alone, between the camera and the target: it makes no
contacts, does not show in other views, and does not change the physics. Camera axes here are
OpenGL's: x right, y up, looking along -z.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value

import mujoco  # isort: skip  (cameras has chosen a GL back end)

CLOSER = 0.8
"""The occluder stands at this share of the distance to the target's nearest point."""
MARGIN = 1.08
"""The half extents of a plate, as a share of the target's outline."""
HAND = 1.25
"""The half extents of a hand, as a share of the target's outline."""
NEAREST_M = 0.0125
"""No occluder stands closer to the camera: nothing within 10 mm is drawn."""
TILT_RAD = 0.6
"""An arm reaches into the picture from above, tilted at most so far to the left or right."""
GREY = (0.42, 0.43, 0.45)
Rgb01 = tuple[float, float, float]
"""A colour, linear 0..1."""


@value
class Occlusion:
    """Hide the target from control step `start` on for `frames` steps.

    In `cameras` (None: all), with an occluder for each camera. A "plate" leaves no pixel of the
    target; an "arm" in the robot's colours, forearm, hand and fingers, covers 80 % of it and more.
    """

    start: int
    frames: int
    kind: Literal["plate", "arm"] = "plate"
    cameras: tuple[str, ...] | None = None

    def covers(self, camera: str, step: int) -> bool:
        """Whether `camera` is to see nothing of the target at control step `step`."""
        if self.cameras is not None and camera not in self.cameras:
            return False
        return self.start <= step < self.start + self.frames


@value
class Screen:
    """One drawn solid.

    A MuJoCo geom type, its sizes (metres), place and axes in the world, and its colour.
    """

    kind: int
    size_m: Float64[np.ndarray, "3"]
    pos_world_m: Float64[np.ndarray, "3"]
    axes_world: Float64[np.ndarray, "3 3"]
    rgb: Rgb01


def occluder_screens(
    kind: Literal["plate", "arm"],
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: str,
    target: str,
    links: Sequence[str],
    tilt: float,
    size: tuple[int, int],
) -> tuple[Screen, ...]:
    """The solids between `camera` and body `target`; none when the target is out of the picture.

    `links` are the robot's bodies, whose colours an arm takes; `tilt`, -1 .. 1, says from which
    side it reaches in. `size` is the picture's (height, width) in pixels.
    """
    eye = data.camera(camera)
    axes = eye.xmat.reshape(3, 3)
    fovy_rad = np.deg2rad(model.camera(camera).fovy[0])
    height, width = size
    slopes = np.tan(0.5 * fovy_rad) * np.array([width / height, 1.0])
    outline = _outline((_points_world(model, data, target) - eye.xpos) @ axes, slopes)
    if outline is None:
        return ()
    centre, half = outline
    away = -centre[2]
    thin = min(0.2 * away, 0.5 * (away - 0.8 * NEAREST_M))
    if kind == "plate":
        wide, tall = MARGIN * half + 0.01 * away
        extents = (wide, 0.1 * thin, tall)
        box = mujoco.mjtGeom.mjGEOM_BOX
        parts = [_Part(shape=box, size_m=extents, centre_m=centre, turn_rad=0.0, rgb=GREY)]
    else:
        sleeve, skin = _colours(model, links)
        parts = _arm_parts(centre, half, thin, lean=TILT_RAD * tilt, sleeve=sleeve, skin=skin)
    return tuple(part.in_world(eye.xpos, axes) for part in parts)


def draw_screens(scene: mujoco.MjvScene, screens: Sequence[Screen]) -> None:
    """Add solids to a picture before it is rendered; in its masks they belong to no object."""
    for screen in screens:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            screen.kind,
            screen.size_m,
            screen.pos_world_m,
            screen.axes_world.ravel(),
            np.array([*screen.rgb, 1.0], np.float32),
        )
        geom.size[:] = screen.size_m  # mjv_initGeom makes capsules round
        geom.specular = 0.2
        geom.shininess = 0.3
        geom.segid = scene.ngeom
        scene.ngeom += 1


@value
class _Part:
    """A solid in the camera's frame; `turn_rad` leans its upright long axis to the left."""

    shape: Any
    size_m: Sequence[float]
    centre_m: Float64[np.ndarray, "3"]
    turn_rad: float
    rgb: Rgb01

    def in_world(self, eye_m: Float64[np.ndarray, "3"], axes: Float64[np.ndarray, "3 3"]) -> Screen:
        """The solid before a camera at `eye_m` with `axes`."""
        cosine = np.cos(self.turn_rad)
        sine = np.sin(self.turn_rad)
        right = np.array([cosine, sine, 0.0])
        up = np.array([-sine, cosine, 0.0])
        local = np.stack([right, np.cross(up, right), up], axis=1)
        return Screen(
            kind=int(self.shape),
            size_m=np.asarray(self.size_m, np.float64),
            pos_world_m=eye_m + axes @ self.centre_m,
            axes_world=axes @ local,
            rgb=self.rgb,
        )


def _arm_parts(
    centre: Float64[np.ndarray, "3"],
    half: Float64[np.ndarray, "2"],
    thin: float,
    *,
    lean: float,
    sleeve: Rgb01,
    skin: Rgb01,
) -> list[_Part]:
    """A forearm, a hand and two fingers in front of the rectangle `centre`, `half` (metres)."""
    up = np.array([-np.sin(lean), np.cos(lean), 0.0])
    right = np.array([up[1], -up[0], 0.0])
    narrow = float(half.min())
    radius = 0.8 * narrow
    thick = min(thin, 0.5 * narrow)
    reach = 3.0 * -centre[2]
    parts = [
        _Part(
            shape=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size_m=(radius, thick, 0.5 * reach),
            centre_m=centre + 0.5 * reach * up,
            turn_rad=lean,
            rgb=sleeve,
        ),
        _Part(
            shape=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size_m=(HAND * half[0], thick, HAND * half[1]),
            centre_m=centre,
            turn_rad=0.0,
            rgb=skin,
        ),
    ]
    for side in (-0.45, 0.45):
        finger = _Part(
            shape=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size_m=(0.3 * radius, 0.3 * thick, 0.5 * narrow),
            centre_m=centre - float(half[1]) * up + side * float(half[0]) * right,
            turn_rad=lean,
            rgb=skin,
        )
        parts.append(finger)
    return parts


def _points_world(
    model: mujoco.MjModel, data: mujoco.MjData, body: str
) -> Float64[np.ndarray, "n 3"]:
    """The vertices of the body's visual mesh, metres."""
    geom = model.geom(f"{body}/visual")
    mesh = model.mesh(int(geom.dataid[0]))
    first = int(mesh.vertadr[0])
    local = model.mesh_vert[first : first + int(mesh.vertnum[0])].astype(np.float64)
    drawn = data.geom(geom.id)
    return local @ drawn.xmat.reshape(3, 3).T + drawn.xpos


def _outline(
    local: Float64[np.ndarray, "n 3"], slopes: Float64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "2"]] | None:
    """The upright rectangle, facing the camera, that hides the points.

    Its middle (camera frame, metres) and half extents (metres); None when all points are outside
    the picture. `slopes` are the tangents of half the field of view across and down.
    """
    depth = -local[:, 2]
    if depth.max() <= 0:
        return None
    edge = 1.05 * slopes
    if depth.min() < 1.6 * NEAREST_M:  # it reaches past the camera, where it has no outline
        return np.array([0.0, 0.0, -NEAREST_M]), edge * NEAREST_M
    points = local[:, :2] / depth[:, None]
    low = np.maximum(points.min(axis=0), -edge)
    high = np.minimum(points.max(axis=0), edge)
    if (low >= high).any():
        return None
    away = CLOSER * float(depth.min())
    return np.array([*(low + high) / 2, -1.0]) * away, (high - low) / 2 * away


def _colours(model: mujoco.MjModel, links: Sequence[str]) -> tuple[Rgb01, Rgb01]:
    """The robot's colours at its middle link and at its hand."""
    return _body_colour(model, links[len(links) // 2]), _body_colour(model, links[-1])


def _body_colour(model: mujoco.MjModel, name: str) -> Rgb01:
    """The colour of the first drawn geom of a body."""
    body = model.body(name)
    first = int(body.geomadr[0])
    for i in range(first, first + int(body.geomnum[0])):
        if model.geom_group[i] >= 3:
            continue
        material = model.geom_matid[i]
        rgba = model.geom_rgba[i] if material < 0 else model.mat_rgba[material]
        return float(rgba[0]), float(rgba[1]), float(rgba[2])
    return GREY
