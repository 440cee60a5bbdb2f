"""A scene: a room, a table, one robot, the objects and the cameras.

The world frame stands on the table top
(z = 0) at the robot's base: x away from the robot, y to its left, z up; metres.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Literal, get_args

import numpy as np
from jaxtyping import UInt8

from vap_core.base.errors import one_of
from vap_core.base.types import value
from vap_core.simulation import robots
from vap_core.simulation.assets import objects
from vap_core.simulation.assets.mujoco_object import add_object
from vap_core.simulation.cameras import Renderer, add_rigs
from vap_core.simulation.looks import DEFAULT_STYLE, Colour3, SceneStyle
from vap_core.simulation.robots import Robot, mjcf

import mujoco  # isort: skip  (cameras has chosen a GL back end)


Meshes = Literal["plain", "menagerie"]
Point = tuple[float, float, float]


@value
class Scene:
    """A compiled scene.

    `objects` are body names, each free to move by its joint `<name>/free`; `sizes_m` are their full
    extents. `models`, `style` and `meshes` are what it was built of.
    """

    robot: Robot
    models: "Mapping[str, objects.ObjectModel]"
    style: SceneStyle
    meshes: Meshes
    model: mujoco.MjModel
    sizes_m: Mapping[str, tuple[float, float, float]]
    cameras: tuple[str, ...]
    renderer: Renderer

    @property
    def objects(self) -> tuple[str, ...]:
        return tuple(self.sizes_m)

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def only(self, names: Iterable[str]) -> "Scene":
        """A scene like this one with those of its objects that are named, in the order of names."""
        models = [self.models[name] for name in names if name in self.models]
        return build(self.robot.name, models, style=self.style, meshes=self.meshes)

    def close(self) -> None:
        """Release the GL contexts; the scene may be used again and makes new ones."""
        self.renderer.close()


def build(
    robot: str,
    models: "Sequence[str | objects.ObjectModel]",
    *,
    style: SceneStyle = DEFAULT_STYLE,
    meshes: Meshes = "plain",
) -> Scene:
    """Compile a scene of `robot` and `models` (names in the object registry, or models themselves).

    `meshes` "menagerie" draws the robot with MuJoCo Menagerie's meshes; only its look changes.

    Raises: UnknownName for a robot or an object that no registry holds, a robot without cameras, or
        other `meshes`; BadRobot for a robot whose MJCF is absent or lacks a part.
    """
    meshes = meshes_called(meshes)
    arm = robots.get(robot)
    spec = mjcf.load(arm)
    physics(spec, arm.hz)
    if meshes == "menagerie":
        from vap_core.simulation.robots.mjcf import replace_visuals

        replace_visuals(spec, arm)
    _tint(spec, style.robot)
    base = spec.body(arm.links[0])
    base.pos = arm.base_world[:3]
    base.quat = arm.base_world[3:]
    _add_room(spec, arm, style)
    held: dict[str, objects.ObjectModel] = {}
    for i, model in enumerate(models):
        if isinstance(model, str):
            model = objects.get_object(model)
        add_object(spec, model, parked(arm, i))
        held[model.name] = model
    cameras = add_rigs(spec, robot, style.camera_shift_m)
    compiled = spec.compile()
    renderer = Renderer(compiled, tuple(held), style.shadows)
    return Scene(
        robot=arm,
        models=held,
        style=style,
        meshes=meshes,
        model=compiled,
        sizes_m={name: objects.extent_m(model) for name, model in held.items()},
        cameras=cameras,
        renderer=renderer,
    )


def meshes_called(name: str) -> Meshes:
    """The meshes of that name. Raises: UnknownName."""
    for known in get_args(Meshes):
        if name == known:
            return known
    raise one_of("build: robots", name, get_args(Meshes))


def parked(arm: Robot, number: int) -> tuple[float, float, float]:
    """Where object `number` of a scene is while no episode uses it.

    Above the floor, far from the robot and from the other objects.
    """
    return -3.0, -2.0 + 0.4 * number, arm.floor_z_m + 0.5


def physics(spec: mujoco.MjSpec, hz: float) -> None:
    """Set the solver settings with which grasps hold.

    Measured: they reduce the creep of a grasped mug to 0.2 mm. The timestep is the one nearest to
    2 ms of which a whole number makes one control step.
    """
    option = spec.option
    option.timestep = 1.0 / (hz * round(500.0 / hz))
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.noslip_iterations = 4
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP


def planks(
    side: int, light: Colour3, dark: Colour3, grain: int = DEFAULT_STYLE.grain
) -> UInt8[np.ndarray, "{side} {side} 3"]:
    """A wooden table top: five boards with grain along them, the same on every machine."""
    rng = np.random.default_rng([grain, side])
    rows, columns = np.mgrid[0:side, 0:side] / side
    board = np.minimum((rows * 5).astype(int), 4)
    tone = rng.random(5)[board]
    shift = rng.random(5)[board] * 40
    warp = 0.9 * np.sin(2 * np.pi * (columns * 1.5 + shift))
    wave = np.sin(2 * np.pi * (rows * 46 + warp + shift))
    fine = rng.standard_normal((side, 1)) * 0.5 + rng.standard_normal((side, side)) * 0.12
    mix = np.clip(0.15 + 0.35 * tone + 0.14 * wave + 0.10 * fine, 0, 1)[..., None]
    wood = (1 - mix) * np.array(light) + mix * np.array(dark)
    seam = (np.abs(rows * 5 - np.rint(rows * 5)) < 0.012) & (rows > 0.1) & (rows < 0.9)
    wood[seam] *= 0.72
    return np.clip(wood * 255, 0, 255).astype(np.uint8)


def _tint(spec: mujoco.MjSpec, colour: Colour3) -> None:
    """Multiply the colours of everything in the spec."""
    for material in spec.materials:
        material.rgba[:3] = np.asarray(material.rgba[:3]) * colour
    for geom in spec.geoms:
        if not geom.material:
            geom.rgba[:3] = np.asarray(geom.rgba[:3]) * colour


def _add_room(spec: mujoco.MjSpec, arm: Robot, style: SceneStyle) -> None:
    """Add floor, back and side walls, table, and the one lamp.

    Only the table and the floor can be touched.
    """
    _set_rendering(spec, style)
    _add_lamp(spec, style)
    _add_materials(spec, style)
    _add_solids(spec, arm)


def _set_rendering(spec: mujoco.MjSpec, style: SceneStyle) -> None:
    spec.visual.headlight.ambient = [style.ambient] * 3
    spec.visual.headlight.diffuse = [0.22] * 3
    spec.visual.headlight.specular = [0.05] * 3
    spec.visual.quality.numslices = 24
    spec.visual.quality.numstacks = 12
    spec.visual.quality.numquads = 1
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 20.0
    spec.stat.extent = 1.0
    spec.stat.center = [0.3, 0.0, 0.2]


def _add_lamp(spec: mujoco.MjSpec, style: SceneStyle) -> None:
    direction = np.subtract((0.35, 0.0, 0.0), style.lamp_pos_m)
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=style.lamp_pos_m,
        dir=direction / np.linalg.norm(direction),
        diffuse=[style.lamp] * 3,
        specular=[0.25] * 3,
        castshadow=style.shadows,
    )


def _add_materials(spec: mujoco.MjSpec, style: SceneStyle) -> None:
    """The materials "planks", "wall", "floor" and "legs"."""
    side = 256
    texture = spec.add_texture(
        name="planks", type=mujoco.mjtTexture.mjTEXTURE_2D, width=side, height=side, nchannel=3
    )
    light, dark = style.planks
    texture.data = planks(side, light, dark, style.grain).tobytes()
    wood = spec.add_material(name="planks", specular=0.08, shininess=0.1, texrepeat=[1, 1])
    wood.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "planks"
    red, green, blue = dark
    legs = (0.55 * red, 0.55 * green, 0.55 * blue)
    for name, rgb in {"wall": style.wall, "floor": style.floor, "legs": legs}.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=0.0, shininess=0.0)


def _add_solids(spec: mujoco.MjSpec, arm: Robot) -> None:
    """Floor, walls, and the table top with its legs down to the floor."""
    world, z = spec.worldbody, arm.floor_z_m
    box = mujoco.mjtGeom.mjGEOM_BOX

    def out_of_touch(name: str, size: Point, pos: Point, material: str) -> None:
        world.add_geom(
            name=name, type=box, size=size, pos=pos, material=material, contype=0, conaffinity=0
        )

    plane = mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(name="floor", type=plane, size=[4, 4, 1], pos=[0, 0, z], material="floor")
    out_of_touch("wall_back", (0.05, 4.0, 2.0), (-1.15, 0.0, z + 2), "wall")
    out_of_touch("wall_left", (4.0, 0.05, 2.0), (0.0, 1.6, z + 2), "wall")
    x0, y0, x1, y1 = arm.table_m
    world.add_geom(
        name="table",
        type=box,
        size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.02],
        pos=[(x0 + x1) / 2, (y0 + y1) / 2, -0.02],
        material="planks",
        condim=4,
        friction=[1.0, 0.01, 0.0001],
    )
    half = -0.5 * (z + 0.04)
    for i, (x, y) in enumerate(product((x0 + 0.07, x1 - 0.07), (y0 + 0.07, y1 - 0.07))):
        out_of_touch(f"leg{i}", (0.03, 0.03, half), (x, y, -0.04 - half), "legs")
