"""A scene: a room, a table, one robot, the objects and the cameras, compiled once and shared by every episode that uses them.

The world frame stands on the table top (z = 0) at the robot's base: x away from the robot, y to its left, z up; metres.
"""

from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from vap_core.base.types import value
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.mujoco_object import add_object
from vap_core.simulation.cameras import Renderer, add_rigs
from vap_core.simulation.robots import Robot
from vap_core.simulation.scene_style import DEFAULT_STYLE, Colour3, SceneStyle

import mujoco  # isort: skip  (cameras has chosen a GL back end)


Meshes = Literal["plain", "menagerie"]


@value
class Scene:
    """A compiled scene. `objects` are body names, each free to move by its joint `<name>/free`; `sizes_m` are their full extents."""

    robot: Robot
    model: mujoco.MjModel
    sizes_m: Mapping[str, tuple[float, float, float]]
    cameras: tuple[str, ...]
    renderer: Renderer

    @property
    def objects(self) -> tuple[str, ...]:
        return tuple(self.sizes_m)

    def __enter__(self) -> "Scene":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the GL contexts back; the scene may be used again and makes new ones."""
        self.renderer.close()


def build(
    robot: str,
    models: "Sequence[str | objects.ObjectModel]",
    *,
    style: SceneStyle = DEFAULT_STYLE,
    meshes: Meshes = "plain",
) -> Scene:
    """Compile a scene of `robot` and `models` (names in the object registry, or models themselves).

    `meshes` "menagerie" draws the robot with MuJoCo Menagerie's meshes; nothing but its look changes.

    Raises: UnknownName for a robot or an object that no registry holds.
    """
    arm = robots.get(robot)
    spec = mujoco.MjSpec.from_file(str(arm.xml))
    physics(spec, arm.hz)
    if meshes == "menagerie":
        from vap_core.simulation.robots.menagerie import dress

        dress(spec, arm)
    _tint(spec, style.robot)
    spec.body(arm.links[0]).pos, spec.body(arm.links[0]).quat = (
        arm.base_world[:3],
        arm.base_world[3:],
    )
    _room(spec, arm, style)
    chosen = [objects.get_object(model) if isinstance(model, str) else model for model in models]
    for i, model in enumerate(chosen):
        add_object(spec, model, parked(arm, i))
    cameras = add_rigs(spec, robot, style.camera_shift_m)
    compiled = spec.compile()
    sizes_m = {model.name: objects.extent_m(model) for model in chosen}
    renderer = Renderer(compiled, tuple(sizes_m), style.shadows)
    return Scene(arm, compiled, sizes_m, cameras, renderer)


def _tint(spec: mujoco.MjSpec, colour: Colour3) -> None:
    """Multiply the colours of whatever the spec holds so far."""
    for part in (*spec.materials, *(geom for geom in spec.geoms if not geom.material)):
        part.rgba[:3] = np.asarray(part.rgba[:3]) * colour


def parked(arm: Robot, number: int) -> tuple[float, float, float]:
    """Where object `number` of a scene waits while no episode uses it: above the floor, far from the robot and from the others."""
    return -3.0, -2.0 + 0.4 * number, arm.floor_z_m + 0.5


def physics(spec: mujoco.MjSpec, hz: float) -> None:
    """The solver settings with which grasps hold (measured: they cut the creep of a held mug to 0.2 mm).

    The timestep is the one nearest to 2 ms of which a whole number makes one control step.
    """
    option = spec.option
    option.timestep = 1.0 / (hz * round(500.0 / hz))
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.noslip_iterations = 4


def _room(spec: mujoco.MjSpec, arm: Robot, style: SceneStyle) -> None:
    """Floor, back and side walls, table, and the one lamp. Only the table and the floor can be touched."""
    world = spec.worldbody
    spec.visual.headlight.ambient = [style.ambient] * 3
    spec.visual.headlight.diffuse = [0.22] * 3
    spec.visual.headlight.specular = [0.05] * 3
    spec.visual.quality.numslices, spec.visual.quality.numstacks, spec.visual.quality.numquads = (
        24,
        12,
        1,
    )
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 20.0
    spec.stat.extent, spec.stat.center = 1.0, [0.3, 0.0, 0.2]
    target = np.subtract((0.35, 0.0, 0.0), style.lamp_pos_m)
    world.add_light(
        name="lamp", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=style.lamp_pos_m, dir=target / np.linalg.norm(target),
        diffuse=[style.lamp] * 3, specular=[0.25] * 3, castshadow=style.shadows,
    )  # fmt: skip
    side = 256
    texture = spec.add_texture(
        name="planks", type=mujoco.mjtTexture.mjTEXTURE_2D, width=side, height=side, nchannel=3
    )
    texture.data = planks(side, *style.planks).tobytes()
    wood = spec.add_material(name="planks", specular=0.08, shininess=0.1, texrepeat=[1, 1])
    wood.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "planks"
    plain = {
        "wall": style.wall,
        "floor": style.floor,
        "legs": tuple(0.55 * c for c in style.planks[1]),
    }
    for name, rgb in plain.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=0.0, shininess=0.0)
    box, ghost = mujoco.mjtGeom.mjGEOM_BOX, {"contype": 0, "conaffinity": 0}
    floor, (x0, y0, x1, y1) = arm.floor_z_m, arm.table_m
    half, centre = [(x1 - x0) / 2, (y1 - y0) / 2, 0.02], [(x0 + x1) / 2, (y0 + y1) / 2, -0.02]
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[4, 4, 1],
        pos=[0, 0, floor],
        material="floor",
    )
    world.add_geom(
        name="wall_back",
        type=box,
        size=[0.05, 4, 2],
        pos=[-1.15, 0, floor + 2],
        material="wall",
        **ghost,
    )
    world.add_geom(
        name="wall_left",
        type=box,
        size=[4, 0.05, 2],
        pos=[0, 1.6, floor + 2],
        material="wall",
        **ghost,
    )
    world.add_geom(
        name="table",
        type=box,
        size=half,
        pos=centre,
        material="planks",
        condim=4,
        friction=[1.0, 0.01, 0.0001],
    )
    leg = [0.03, 0.03, -0.5 * (floor + 0.04)]
    for i, (x, y) in enumerate(
        (x, y) for x in (x0 + 0.07, x1 - 0.07) for y in (y0 + 0.07, y1 - 0.07)
    ):
        world.add_geom(
            name=f"leg{i}", type=box, size=leg, pos=[x, y, -0.04 - leg[2]], material="legs", **ghost
        )


def planks(side: int, light: Colour3, dark: Colour3) -> UInt8[np.ndarray, "{side} {side} 3"]:
    """A wooden table top: five boards with grain along them, the same on every machine."""
    rng = np.random.default_rng([7, side])
    rows, cols = np.mgrid[0:side, 0:side] / side
    board = np.minimum((rows * 5).astype(int), 4)
    tone, shift = rng.random(5)[board], rng.random(5)[board] * 40
    wave = np.sin(2 * np.pi * (rows * 46 + 0.9 * np.sin(2 * np.pi * (cols * 1.5 + shift)) + shift))
    fine = rng.standard_normal((side, 1)) * 0.5 + rng.standard_normal((side, side)) * 0.12
    mix = np.clip(0.15 + 0.35 * tone + 0.14 * wave + 0.10 * fine, 0, 1)[..., None]
    wood = (1 - mix) * np.array(light) + mix * np.array(dark)
    seam = (np.abs(rows * 5 - np.rint(rows * 5)) < 0.012) & (rows > 0.1) & (rows < 0.9)
    wood[seam] *= 0.72
    return np.clip(wood * 255, 0, 255).astype(np.uint8)
