"""One running episode: reset from a row, observe, step, and the ground truth.

Many episodes may share one Scene; each has its own MjData.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from vap_core.attend import GROUNDING_PX
from vap_core.base.errors import BadAction, BadViews, UnknownName, one_of
from vap_core.base.types import Camera, Mask, Rgb, Views, value
from vap_core.simulation import cameras as optics
from vap_core.simulation.cameras import hand_geoms
from vap_core.simulation.contacts import ContactWatch, Touch, contact_partners, geom_roles
from vap_core.simulation.control import (
    Setpoint,
    arm,
    follow,
    follow_joints,
    is_beyond,
    rotation_vector,
)
from vap_core.simulation.looks import (
    PERFECT,
    Disturbance,
    Light,
    Sensor,
    apply_sensor,
    draw_disturbance,
)
from vap_core.simulation.occluder import Occlusion, Screen, occluder_screens
from vap_core.simulation.scenes import Scene, parked
from vap_core.simulation.types import EE_ACTION, Action, EpisodeRow, Observation, Truth

import mujoco  # isort: skip  (cameras has chosen a GL back end)

SETTLE_S = 0.3
DROP_M = 0.0005
"""Objects start this far above the table and settle."""
SAMPLES = 4
"""A pixel, of views in which objects are looked for; all others are drawn with one."""
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
SLEEP_M_S = 1e-3
"""An object that stays slower falls asleep, after ten physics steps."""
SLEEPERS = (
    *("tree_asleep", "tree_awake", "body_awake", "dof_awake_ind", "body_awake_ind"),
    *("parent_awake_ind", "ntree_awake", "nbody_awake", "nparent_awake", "nv_awake"),
)
"""What MjData knows of who is asleep, which is no part of its state."""


Control = Literal["ee", "joint"]


@value
class Snapshot:
    """Everything that decides how an episode goes on.

    MuJoCo's full integration state and who is asleep, the command, and the last step's contacts.
    """

    state: Float64[np.ndarray, " n"]
    sleepers: Mapping[str, Any]
    command: Setpoint
    row: EpisodeRow
    touch: Touch


class Env:
    """One running episode in `scene`.

    The same row in the same scene gives bit-identical states and images, whatever else runs.
    `image_size` is the side of the views, or their height and width, in pixels.
    `control` says what an action is (types.Action); `sensor` how the cameras change their images;
    `occlusion` what hides the target from them, and when. `seconds` sums wall time by part:
    "physics", "ik", "render", "truth". Raises: UnknownName for a camera that the scene lacks;
    BadViews for an `image_size` below 1.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        image_size: int | tuple[int, int] = 224,
        cameras: Sequence[str] | None = None,
        control: Control = "ee",
        sensor: Sensor = PERFECT,
        occlusion: Occlusion | None = None,
    ) -> None:
        self.scene = scene
        self.robot = scene.robot
        self.hz = scene.robot.hz
        self.image_hw = (image_size, image_size) if isinstance(image_size, int) else image_size
        if min(self.image_hw) < 1:
            height, width = self.image_hw
            raise BadViews(
                f"Env: image_size asks for pictures of {height} x {width} pixels; give 1 or more."
            )
        self.control = control
        self.sensor = sensor
        self.occlusion = occlusion
        self.camera_names = tuple(scene.cameras if cameras is None else cameras)
        for name in self.camera_names:
            if name not in scene.cameras:
                raise one_of("Env: camera", name, scene.cameras)
        if occlusion is not None and occlusion.cameras is not None:
            for name in occlusion.cameras:
                if name not in self.camera_names:
                    raise one_of("Env: camera of the occlusion", name, self.camera_names)
        self.seconds = dict.fromkeys(("physics", "ik", "render", "truth"), 0.0)
        self._model = scene.model
        self._data = mujoco.MjData(self._model)
        self._arm = arm(scene.robot.name)
        timestep = self._model.opt.timestep
        self._substeps = max(1, round(1.0 / self.hz / timestep))
        self._settle = round(SETTLE_S / timestep)
        self._qpos = _qpos_addresses(self._model, self.robot.joints)
        self._fingers = _qpos_addresses(self._model, self.robot.fingers)
        moved = (*self.robot.joints, *self.robot.fingers)
        self._ctrl = np.array([self._model.actuator(name).id for name in moved])
        self._roles = geom_roles(scene)
        self._gripper = hand_geoms(scene.model)
        names = (*scene.objects, *self.robot.links)
        self._body_ids = {name: self._model.body(name).id for name in names}
        mujoco.mj_forward(self._model, self._data)
        base = optics.pose_of(self._data.body(self.robot.links[0]))
        self._base_from_world = np.linalg.inv(base)
        self._row: EpisodeRow | None = None
        self._placed: tuple[str, ...] = ()
        self._parked = set(scene.objects)
        self._disturbances: Mapping[str, Disturbance] = {}
        self._touch = Touch()
        self._cameras: tuple[Camera, ...] | None = None
        self._drawn: dict[tuple[str, tuple[int, int], int], Rgb] = {}
        """The calibrated cameras and their pictures, until the poses change."""
        self._command = self._first_command(self.robot.home)

    @property
    def row(self) -> EpisodeRow:
        """The episode under way."""
        assert self._row is not None, "no episode yet: call reset first"
        return self._row

    @property
    def command(self) -> Setpoint:
        """The setpoint of the robot."""
        return self._command

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of an action's numbers."""
        return EE_ACTION if self.control == "ee" else (*self.robot.joints, "gripper")

    @property
    def action_size(self) -> int:
        """The length of an action."""
        return len(self.action_names)

    @property
    def time_s(self) -> float:
        """Seconds since the episode's first observation."""
        return round(float(self._data.time) - self._settle * float(self._model.opt.timestep), 9)

    def reset(self, row: EpisodeRow) -> None:
        """Start the episode of `row`: objects in place, robot at home, gripper open.

        Everything settles for 0.3 s. Objects of the scene that the row does not name are parked,
        weightless and invisible; so is an absent target.
        Raises: UnknownName when the row places an object that the scene lacks, or one twice.
        """
        names = [place.model for place in row.placements]
        for name in names:
            if name not in self.scene.objects:
                raise one_of(f"Env.reset({row.key}): object", name, self.scene.objects)
        if len(set(names)) < len(names):
            raise UnknownName(
                f"Env.reset({row.key}): an object is placed twice in {names}; name each model once."
            )
        data = self._data
        mujoco.mj_resetData(self._model, data)
        joints = self.robot.home
        if row.start.joints_rad:
            ids = [self._model.joint(name).id for name in self.robot.joints]
            joints = np.clip(joints + row.start.joints_rad, *self._model.jnt_range[ids].T)
        data.qpos[self._qpos] = joints
        data.qpos[self._fingers] = self.robot.fingers_open
        data.ctrl[self._ctrl] = self._targets(joints, 1.0)
        self._begin(row)
        self._place_objects(row)
        self._touch = Touch()
        self._command = self._first_command(joints)
        self._model.opt.sleep_tolerance = 0  # while it settles, what is placed stays awake
        self._advance(np.tile(data.ctrl[self._ctrl], (self._settle, 1)))
        self._model.opt.sleep_tolerance = SLEEP_M_S
        self._touch = Touch(contacts=self._touch.contacts)

    def pursue(self, row: EpisodeRow) -> None:
        """Go on with `row`, a sub-goal of the episode under way; the scene stays as it is."""
        assert {place.model for place in row.placements} == set(self._placed)
        self._row = row

    def observe(self) -> Observation:
        """The raw views and the proprioception.

        The first views are drawn as those in which objects are looked for, and averaged down.
        The latter is the tcp's position (m) and rotation vector from straight down (rad), the
        gripper's opening 0..1, and the joint angles (rad).
        """
        return Observation(self._views(self.image_hw), self.state())

    def look(self, longer_px: int) -> Views:
        """The views of this moment once more, with `longer_px` pixels on their longer side."""
        return self._views(self._scaled(longer_px), SAMPLES)

    def _scaled(self, longer_px: int) -> tuple[int, int]:
        height, width = self.image_hw
        scale = longer_px / max(height, width)
        return max(1, round(height * scale)), max(1, round(width * scale))

    def _views(self, hw: tuple[int, int], samples: int = 0) -> Views:
        with timed(self.seconds, "render"):
            light = Light(self.row.start.lamp, self.row.start.ambient)
            size = hw
            if self._step() == 0:
                size, samples = self._scaled(max(GROUNDING_PX, *hw)), SAMPLES
            images = {}
            for name in self.camera_names:
                key = name, size, samples
                if key not in self._drawn:
                    self._drawn[key] = self.scene.renderer.rgb(
                        self._data, name, size, light=light, samples=samples, **self._shown(name)
                    )
                rgb = cv2.resize(self._drawn[key], hw[::-1], interpolation=cv2.INTER_AREA)
                if name in self._disturbances:
                    errors = self._disturbances[name]
                    rgb = apply_sensor(self.sensor, rgb, errors, self.row, name, self._step())
                images[name] = rgb
        return images

    def state(self) -> Float32[np.ndarray, " s"]:
        """The proprioception alone, as in `observe`."""
        tcp = self.tcp_base()
        turn = rotation_vector(tcp[:3, :3] @ self.robot.down_base.T)
        travel = self._data.qpos[self._fingers]
        closed = np.array(self.robot.fingers_closed)
        open_ = np.array(self.robot.fingers_open)
        opening = np.mean((travel - closed) / (open_ - closed))
        joints = self._data.qpos[self._qpos]
        clipped = float(np.clip(opening, 0.0, 1.0))
        return np.concatenate([tcp[:3, 3], turn, [clipped], joints]).astype(np.float32)

    def step(self, action: Action) -> None:
        """Do one action for 1 / hz seconds; contacts are watched in every physics step."""
        if len(action) != self.action_size:
            raise BadAction(
                f"Env.step: {len(action)} numbers, but {self.control} control of "
                f"{self.robot.name} takes {self.action_size}."
            )
        if not np.isfinite(action).all():
            raise BadAction(
                f"Env.step: {action.tolist()} holds numbers that are not finite; fix the policy."
            )
        with timed(self.seconds, "ik"):
            before = self._targets(self._command.joints, self._command.gripper)
            self._command = self.commanded(self._command, action)
        after = self._targets(self._command.joints, self._command.gripper)
        with timed(self.seconds, "physics"):
            ramp = np.linspace(0.0, 1.0, self._substeps + 1)[1:, None]
            self._advance(before + ramp * (after - before))

    def is_beyond_limits(self, action: Action) -> bool:
        """Whether an action is far beyond the robot's speed; `step` cuts it to that."""
        return is_beyond(action, self.robot, self.control, 1.0 / self.hz)

    def commanded(self, command: Setpoint, action: Action) -> Setpoint:
        """The command after `action`, given `command` and the present state; changes nothing."""
        seconds = 1.0 / self.hz
        if self.control == "ee":
            return follow(self._arm, command, self.tcp_base(), action, seconds)
        measured = self._data.qpos[self._qpos].copy()
        return follow_joints(self._arm, command, measured, action, seconds)

    def truth(self, masks: bool = False) -> Truth:
        """Ground truth after the last step, on demand with every camera's visible object masks."""
        with timed(self.seconds, "truth"):
            masks_by_camera: dict[str, Mapping[str, Mask]] = {}
            hand: dict[str, Mask] = {}
            for name in self.camera_names if masks else ():
                masks_by_camera[name], hand[name] = self.scene.renderer.masks_and_hand(
                    self._data, name, self.image_hw, **self._shown(name)
                )
            return Truth(
                objects_world=self._poses(self._placed),
                links_world=self._poses(self.robot.links),
                touched=self._touch.touched,
                pressed_s=self._touch.pressed_s,
                contacts=self._touch.contacts,
                masks=masks_by_camera,
                hand=hand,
            )

    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras where they are now; a wrist camera moves."""
        if self._cameras is None:
            self._cameras = tuple(
                optics.camera(self._model, self._data, name, self.image_hw)
                for name in self.camera_names
            )
        return self._cameras

    def tcp_base(self) -> Float64[np.ndarray, "4 4"]:
        """The gripper's measured pose in the robot base frame."""
        return self._base_from_world @ optics.pose_of(self._data.site("tcp"))

    def snapshot(self) -> Snapshot:
        """The present state of the episode."""
        state = np.zeros(mujoco.mj_stateSize(self._model, STATE))
        mujoco.mj_getState(self._model, self._data, state, STATE)
        sleepers = {name: np.copy(getattr(self._data, name)) for name in SLEEPERS}
        return Snapshot(state, sleepers, self._command, self.row, self._touch)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot of any Env of the same scene."""
        mujoco.mj_resetData(self._model, self._data)
        mujoco.mj_setState(self._model, self._data, snapshot.state, STATE)
        mujoco.mj_forward(self._model, self._data)  # of all: nothing is computed for who sleeps
        for name, sleepers in snapshot.sleepers.items():
            setattr(self._data, name, sleepers)
        self._command = snapshot.command
        self._touch = snapshot.touch
        self._begin(snapshot.row)
        self._update_poses()

    def _first_command(self, joints: Float64[np.ndarray, " n"]) -> Setpoint:
        """The setpoint that holds the arm at `joints`, with an open gripper."""
        return Setpoint(self._arm.forward(joints), joints, 1.0)

    def _begin(self, row: EpisodeRow) -> None:
        """Take `row` as the episode, and draw the errors of its cameras."""
        self._row = row
        self._placed = tuple(place.model for place in row.placements)
        self._parked = set(self.scene.objects) - set(self._placed)
        if row.start.absent:
            self._parked.add(row.target)
        names = self.camera_names if self.sensor != PERFECT else ()
        self._disturbances = {name: draw_disturbance(self.sensor, row, name) for name in names}

    def _place_objects(self, row: EpisodeRow) -> None:
        """Put the objects of `row` in their places, and park the others, asleep."""
        model = self._model
        data = self._data
        offsets = row.start.offsets or [(0.0, 0.0, 0.0)] * len(row.placements)
        for place, (dx, dy, turn) in zip(row.placements, offsets, strict=True):
            half = 0.5 * (place.yaw + turn)
            quat = (np.cos(half), 0.0, 0.0, np.sin(half))
            position = (place.x + dx, place.y + dy, DROP_M)
            data.joint(f"{place.model}/free").qpos[:] = (*position, *quat)
        for i, name in enumerate(name for name in self.scene.objects if name in self._parked):
            data.joint(f"{name}/free").qpos[:] = (*parked(self.robot, i), 1.0, 0.0, 0.0, 0.0)
            data.tree_asleep[model.body_treeid[self._body_ids[name]]] = -1  # from the next step on

    def _advance(self, ctrl: Float64[np.ndarray, "n m"]) -> None:
        """Advance physics with a row of `ctrl` a step, and note the contacts."""
        model = self._model
        data = self._data
        watch = ContactWatch(self._roles, self._gripper, self._touch.running_s)
        for row in ctrl:
            data.ctrl[self._ctrl] = row
            mujoco.mj_step(model, data)
            watch.update(data.contact.geom, model.opt.timestep)
        awake = data.contact.geom.copy()
        self._update_poses()
        asleep = data.contact.geom
        asleep = asleep[(data.body_awake[model.geom_bodyid[asleep]] <= 0).all(axis=1)]
        contacts = contact_partners(self._roles[np.concatenate([awake, asleep])])
        self._touch = Touch(tuple(watch.touched), watch.pressed_s, contacts, watch.running_s)

    def _update_poses(self) -> None:
        """Bring poses up to date with the state, and displace the cameras.

        The contacts are of all objects then: a physics step leaves those among sleepers out. The
        solver's warm start stays as it is.
        """
        self._cameras = None
        self._drawn.clear()
        mujoco.mj_kinematics(self._model, self._data)
        flags, self._model.opt.enableflags = self._model.opt.enableflags, 0
        mujoco.mj_camlight(self._model, self._data)  # of cameras that stand still, too
        mujoco.mj_collision(self._model, self._data)
        self._model.opt.enableflags = flags
        for name, disturbance in self._disturbances.items():
            camera = self._data.camera(name)
            facing = camera.xmat.reshape(3, 3)
            camera.xpos[:] += facing @ disturbance.shift_m
            camera.xmat[:] = (facing @ disturbance.turn).ravel()

    def _screens(self, camera: str) -> tuple[Screen, ...]:
        """The occluder in front of `camera` now; the episode decides the side of an arm."""
        if self._row is None or self.occlusion is None:
            return ()
        if not self.occlusion.covers(camera, self._step()):
            return ()
        rng = np.random.default_rng([self._row.episode, self.camera_names.index(camera)])
        return occluder_screens(
            kind=self.occlusion.kind,
            model=self._model,
            data=self._data,
            camera=camera,
            target=self._row.target,
            links=self.robot.links,
            tilt=float(rng.uniform(-1.0, 1.0)),
            size=self.image_hw,
        )

    def _step(self) -> int:
        """Control steps since the first observation."""
        return round(self.time_s * self.hz)

    def _targets(
        self, joints: Float64[np.ndarray, " n"], gripper: float
    ) -> Float64[np.ndarray, " m"]:
        """The positions of the actuators: joint angles, then fingers."""
        closed = np.array(self.robot.fingers_closed)
        open_ = np.array(self.robot.fingers_open)
        return np.concatenate([joints, closed + gripper * (open_ - closed)])

    def _poses(self, bodies: Sequence[str]) -> dict[str, Float64[np.ndarray, "7"]]:
        """The poses of bodies in the world, by their names."""
        ids = [self._body_ids[body] for body in bodies]
        poses = np.concatenate([self._data.xpos[ids], self._data.xquat[ids]], axis=1)
        return dict(zip(bodies, poses, strict=True))

    def _shown(self, camera: str) -> dict[str, Any]:
        """What a picture lacks and has: objects that are not on the table, and the occluder."""
        return {"hidden": frozenset(self._parked), "before": self._screens(camera)}


def _qpos_addresses(model: mujoco.MjModel, joints: Sequence[str]) -> np.ndarray:
    return np.array([model.joint(name).qposadr[0] for name in joints])


@contextmanager
def timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Add the wall time of the block to `seconds[part]`, also where the block raises."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[part] += time.perf_counter() - start
