"""A controlled occluder (P tab:occlusion_sweep): something that hides the target from a camera for some control steps.

It is drawn into that camera's picture alone, between the eye and the target, and exists nowhere else: no contacts, no clutter in other
views, and not a bit of the episode's physics changes. Camera axes here are OpenGL's: x right, y up, looking along -z.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from vap_core.base.types import value

import mujoco  # isort: skip  (cameras has chosen a GL back end)

CLOSER = 0.8
"""The occluder stands at this share of the distance to the target's nearest point."""
MARGIN, HAND = 1.08, 1.25
"""How far a plate, and the round of a hand, reach beyond the target's outline, as a share of its half extents."""
NEAREST_M = 0.0125
"""No occluder stands closer to the eye: nothing within 10 mm is drawn."""
TILT_RAD = 0.6
"""An arm reaches into the picture from above, so far to the left or right at most."""
GREY = (0.42, 0.43, 0.45)


@value
class Occlusion:
    """Hide the target from control step `start` on for `frames` steps, in `cameras` (None: all), each camera by an occluder of its own.

    A "plate" leaves no pixel of the target; an "arm" in the robot's colours, forearm, hand and fingers, covers most of it (80 % and more).
    """

    start: int
    frames: int
    kind: Literal["plate", "arm"] = "plate"
    cameras: tuple[str, ...] | None = None

    def covers(self, camera: str, step: int) -> bool:
        """Whether `camera` is to see nothing of the target at control step `step`."""
        return self.start <= step < self.start + self.frames and (
            self.cameras is None or camera in self.cameras
        )


@value
class Screen:
    """One drawn solid: a MuJoCo geom type, its sizes (metres), place and axes in the world, and its colour, linear 0..1."""

    kind: int
    size_m: Float64[np.ndarray, "3"]
    pos_world_m: Float64[np.ndarray, "3"]
    axes_world: Float64[np.ndarray, "3 3"]
    rgb: tuple[float, float, float]


def screens(
    kind: Literal["plate", "arm"],
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: str,
    target: str,
    links: Sequence[str],
    tilt: float,
) -> tuple[Screen, ...]:
    """What stands between `camera` and body `target` now; nothing when the target is out of the picture.

    `links` are the robot's bodies, whose colours an arm wears; `tilt`, -1 .. 1, says from which side it reaches in.
    """
    eye = data.camera(camera)
    axes, place = eye.xmat.reshape(3, 3), eye.xpos
    found = _outline(
        (_points_world(model, data, target) - place) @ axes,
        float(np.tan(0.5 * np.deg2rad(model.camera(camera).fovy[0]))),
    )
    if found is None:
        return ()
    centre, half = found
    away = -centre[2]

    def solid(
        shape: Any,
        size: Sequence[float],
        at: Float64[np.ndarray, "3"],
        turn: float,
        rgb: tuple[float, float, float],
    ) -> Screen:
        """`turn` leans the solid's long axis, upright in the picture, to the left."""
        right, up = (
            np.array([np.cos(turn), np.sin(turn), 0.0]),
            np.array([-np.sin(turn), np.cos(turn), 0.0]),
        )
        local = np.stack([right, np.cross(up, right), up], axis=1)
        return Screen(
            int(shape), np.asarray(size, np.float64), place + axes @ at, axes @ local, rgb
        )

    wide, tall = MARGIN * half + 0.01 * away
    thin = min(0.2 * away, 0.5 * (away - 0.8 * NEAREST_M))
    if kind == "plate":
        return (solid(mujoco.mjtGeom.mjGEOM_BOX, (wide, 0.1 * thin, tall), centre, 0.0, GREY),)
    sleeve, skin = _colours(model, links)
    capsule, lean = mujoco.mjtGeom.mjGEOM_CAPSULE, TILT_RAD * tilt
    up = np.array([-np.sin(lean), np.cos(lean), 0.0])
    radius, thick = 0.8 * float(half.min()), min(thin, 0.5 * float(half.min()))
    reach = 3.0 * away
    parts = [
        solid(capsule, (radius, thick, 0.5 * reach), centre + 0.5 * reach * up, lean, sleeve),
        solid(
            mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            (HAND * half[0], thick, HAND * half[1]),
            centre,
            0.0,
            skin,
        ),
    ]
    for side in (-0.45, 0.45):  # two fingers that point on
        root = centre - float(half[1]) * up + side * float(half[0]) * np.array([up[1], -up[0], 0.0])
        parts.append(
            solid(capsule, (0.3 * radius, 0.3 * thick, 0.5 * float(half.min())), root, lean, skin)
        )
    return tuple(parts)


def draw(scene: mujoco.MjvScene, solids: Sequence[Screen]) -> None:
    """Add them to a picture about to be rendered. Its masks show them as nobody's pixels."""
    for each in solids:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            each.kind,
            each.size_m,
            each.pos_world_m,
            each.axes_world.ravel(),
            np.array([*each.rgb, 1.0], np.float32),
        )
        geom.size[:] = each.size_m  # mjv_initGeom makes capsules round
        geom.specular, geom.shininess, geom.segid = 0.2, 0.3, scene.ngeom
        scene.ngeom += 1


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
    local: Float64[np.ndarray, "n 3"], slope: float
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "2"]] | None:
    """Middle (camera frame, metres) and half extents (metres) of the upright rectangle, facing the eye, that hides the points.

    `slope` is the tangent of half the field of view of a square picture. None when they are all outside it.
    """
    depth = -local[:, 2]
    if depth.max() <= 0:
        return None
    edge = 1.05 * slope
    if depth.min() < 1.6 * NEAREST_M:  # it reaches past the eye, where no outline can be drawn
        return np.array([0.0, 0.0, -NEAREST_M]), np.full(2, edge * NEAREST_M)
    seen = local[:, :2] / depth[:, None]
    low, high = np.maximum(seen.min(axis=0), -edge), np.minimum(seen.max(axis=0), edge)
    if (low >= high).any():
        return None
    away = CLOSER * float(depth.min())
    return np.array([*(low + high) / 2, -1.0]) * away, (high - low) / 2 * away


def _colours(
    model: mujoco.MjModel, links: Sequence[str]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The robot's colours at its middle and at its hand: of the first drawn geom of these links."""
    found = []
    for link in (links[len(links) // 2], links[-1]):
        body = model.body(link)
        geoms = range(int(body.geomadr[0]), int(body.geomadr[0]) + int(body.geomnum[0]))
        shown = [i for i in geoms if model.geom_group[i] < 3]
        rgba = next(
            (
                model.mat_rgba[model.geom_matid[i]]
                if model.geom_matid[i] >= 0
                else model.geom_rgba[i]
                for i in shown
            ),
            (*GREY, 1.0),
        )
        found.append((float(rgba[0]), float(rgba[1]), float(rgba[2])))
    return found[0], found[1]
