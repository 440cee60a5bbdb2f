"""One running episode: reset from a row, observe, step, and the ground truth. Many may share one Scene; each has its own MjData."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from vap_core.base.errors import BadAction, UnknownName, one_of
from vap_core.base.types import Camera, Rgb, value
from vap_core.simulation import cameras as optics
from vap_core.simulation import control as steering
from vap_core.simulation.contacts import ARM, STILL, Touch, hand, partners, roles
from vap_core.simulation.control import Setpoint, arm, follow, rotation_vector
from vap_core.simulation.occluder import Occlusion, Screen, screens
from vap_core.simulation.scenes import Scene, parked
from vap_core.simulation.sensor import PERFECT, Sensor, Stray, exposed, stray
from vap_core.simulation.types import EE_ACTION, REST, ROBOT, Action, EpisodeRow, Observation, Truth

import mujoco  # isort: skip  (cameras has chosen a GL back end)

SETTLE_S = 0.3
DROP_M = 0.0005
"""Objects start this far above the table and settle."""
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


Control = Literal["ee", "joint"]


@value
class Snapshot:
    """Everything that decides how an episode goes on: MuJoCo's full integration state, the command, and the last step's contacts."""

    state: Float64[np.ndarray, " n"]
    command: Setpoint
    row: EpisodeRow
    touch: Touch


class Env:
    """One running episode in `scene`. The same row in the same scene gives bit-identical states and images, whatever else runs.

    `control` says what an action is (values.Action); `sensor` what the cameras do to what they see; `occlusion` what hides the target from
    them, and when.
    `seconds` sums wall time by part: "physics", "ik", "render", "truth".
    """

    def __init__(
        self,
        scene: Scene,
        *,
        image_size: int = 224,
        cameras: Sequence[str] | None = None,
        control: Control = "ee",
        sensor: Sensor = PERFECT,
        occlusion: Occlusion | None = None,
    ) -> None:
        self.scene = scene
        self.robot = scene.robot
        self.hz = scene.robot.hz
        self.image_size = image_size
        self.control = control
        self.sensor = sensor
        self.occlusion = occlusion
        self.camera_names = tuple(scene.cameras if cameras is None else cameras)
        for name in self.camera_names:
            if name not in scene.cameras:
                raise one_of("Env: camera", name, scene.cameras)
        for name in () if occlusion is None or occlusion.cameras is None else occlusion.cameras:
            if name not in self.camera_names:
                raise one_of("Env: camera of the occlusion", name, self.camera_names)
        self.seconds = dict.fromkeys(("physics", "ik", "render", "truth"), 0.0)
        self._model = model = scene.model
        self._data = mujoco.MjData(model)
        self._arm = arm(scene.robot.name)
        self._substeps = max(1, round(1.0 / self.hz / model.opt.timestep))
        self._settle = round(SETTLE_S / model.opt.timestep)
        self._qpos = np.array([model.joint(name).qposadr[0] for name in self.robot.joints])
        self._fingers = np.array([model.joint(name).qposadr[0] for name in self.robot.fingers])
        self._ctrl = np.array(
            [model.actuator(name).id for name in (*self.robot.joints, *self.robot.fingers)]
        )
        self._roles, self._hand = roles(scene), hand(scene)
        base = np.eye(4)
        base[:3, :3] = _matrix(self.robot.base_world[3:])
        base[:3, 3] = self.robot.base_world[:3]
        self._base_from_world = np.linalg.inv(base)
        self._row: EpisodeRow | None = None
        self._placed: tuple[str, ...] = ()
        self._strays: Mapping[str, Stray] = {}
        self._touch = Touch()
        self._command = Setpoint(self._arm.forward(self.robot.home), self.robot.home, 1.0)
        mujoco.mj_forward(model, self._data)

    @property
    def row(self) -> EpisodeRow:
        """The episode under way."""
        assert self._row is not None, "no episode yet: call reset first"
        return self._row

    @property
    def command(self) -> Setpoint:
        """Where the robot is told to be."""
        return self._command

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the numbers of an action are called."""
        return EE_ACTION if self.control == "ee" else (*self.robot.joints, "gripper")

    @property
    def action_size(self) -> int:
        """Numbers in one action."""
        return len(self.action_names)

    @property
    def time_s(self) -> float:
        """Seconds since the episode's first observation."""
        return round(float(self._data.time) - self._settle * float(self._model.opt.timestep), 9)

    def reset(self, row: EpisodeRow) -> None:
        """Start the episode of `row`: objects in place, robot at home, gripper open, 0.3 s to settle.

        Objects of the scene that the row does not name stand parked on the floor, weightless and undrawn.
        Raises: UnknownName when the row places an object that the scene lacks, or one twice.
        """
        placed = tuple(place.model for place in row.placements)
        for name in placed:
            if name not in self.scene.objects:
                raise one_of(f"Env.reset({row.key}): object", name, self.scene.objects)
        if len(set(placed)) < len(placed):
            raise UnknownName(
                f"Env.reset({row.key}): an object is placed twice in {list(placed)}; name each model once."
            )
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        data.qpos[self._qpos] = self.robot.home
        data.qpos[self._fingers] = self.robot.fingers_open
        data.ctrl[self._ctrl] = self._targets(self.robot.home, 1.0)
        for place in row.placements:
            half = 0.5 * place.yaw
            data.joint(f"{place.model}/free").qpos[:] = (
                place.x,
                place.y,
                DROP_M,
                np.cos(half),
                0.0,
                0.0,
                np.sin(half),
            )
        for i, name in enumerate(n for n in self.scene.objects if n not in placed):
            body = model.body(name)
            data.joint(f"{name}/free").qpos[:] = (*parked(self.robot, i), 1.0, 0.0, 0.0, 0.0)
            data.xfrc_applied[body.id, :3] = -model.opt.gravity * float(body.subtreemass[0])
        self._begin(row)
        self._touch = Touch()
        self._command = Setpoint(self._arm.forward(self.robot.home), self.robot.home, 1.0)
        self._run(self._settle, data.ctrl[self._ctrl].copy())
        self._touch = Touch(contacts=self._touch.contacts)

    def observe(self) -> Observation:
        """The raw views and the proprioception: tcp position (m) and rotation vector from straight down (rad), opening 0..1, joint angles (rad)."""
        with self._timed("render"):
            hidden = self._hidden()
            images = {
                name: self._seen(
                    name,
                    self.scene.renderer.rgb(
                        self._data, name, self.image_size, hidden, self._before(name)
                    ),
                )
                for name in self.camera_names
            }
        return Observation(images, self.state())

    def state(self) -> Float32[np.ndarray, " s"]:
        """The proprioception alone, as in `observe`."""
        tcp = self.tcp_base()
        spin = rotation_vector(tcp[:3, :3] @ self.robot.down_base.T)
        travel = self._data.qpos[self._fingers]
        shut, wide = np.array(self.robot.fingers_closed), np.array(self.robot.fingers_open)
        opening = float(np.clip(np.mean((travel - shut) / (wide - shut)), 0.0, 1.0))
        return np.concatenate([tcp[:3, 3], spin, [opening], self._data.qpos[self._qpos]]).astype(
            np.float32
        )

    def step(self, action: Action) -> None:
        """Do one action for 1 / hz seconds; contacts are watched in every physics step."""
        if len(action) != self.action_size:
            raise BadAction(
                f"Env.step: {len(action)} numbers, but {self.control} control of {self.robot.name} takes {self.action_size}."
            )
        if not np.isfinite(action).all():
            raise BadAction(
                f"Env.step: {action.tolist()} holds numbers that are not finite; mend the policy."
            )
        with self._timed("ik"):
            before = self._targets(self._command.joints, self._command.gripper)
            self._command = self.commanded(self._command, action)
        after = self._targets(self._command.joints, self._command.gripper)
        with self._timed("physics"):
            ramp = np.linspace(0.0, 1.0, self._substeps + 1)[1:, None]
            self._run(self._substeps, before + ramp * (after - before))

    def commanded(self, command: Setpoint, action: Action) -> Setpoint:
        """What `action` makes of `command` now; pure."""
        if self.control == "ee":
            return follow(self._arm, command, self.tcp_base(), action, 1.0 / self.hz)
        return steering.follow_joints(
            self._arm, command, self._data.qpos[self._qpos].copy(), action, 1.0 / self.hz
        )

    def truth(self, masks: bool = False) -> Truth:
        """Ground truth after the last step; `masks` renders every camera's visible object masks as well."""
        with self._timed("truth"):
            poses = {name: self._pose(name) for name in self._placed}
            links = {name: self._pose(name) for name in self.robot.links}
            seen: Mapping[str, Mapping[str, np.ndarray]] = {}
            if masks:
                hidden = self._hidden()
                seen = {
                    name: self.scene.renderer.masks(
                        self._data, name, self.image_size, hidden, self._before(name)
                    )
                    for name in self.camera_names
                }
            return Truth(
                poses, links, self._touch.touched, self._touch.pressed_s, self._touch.contacts, seen
            )

    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras where they are now; a wrist camera moves."""
        return tuple(
            optics.camera(self._model, self._data, name, (self.image_size, self.image_size))
            for name in self.camera_names
        )

    def snapshot(self) -> Snapshot:
        state = np.zeros(mujoco.mj_stateSize(self._model, STATE))
        mujoco.mj_getState(self._model, self._data, state, STATE)
        return Snapshot(state, self._command, self.row, self._touch)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot of any Env of the same scene."""
        mujoco.mj_setState(self._model, self._data, snapshot.state, STATE)
        self._command, self._touch = snapshot.command, snapshot.touch
        self._begin(snapshot.row)
        self._place_bodies()

    def _begin(self, row: EpisodeRow) -> None:
        self._row, self._placed = row, tuple(place.model for place in row.placements)
        self._strays = (
            {}
            if self.sensor == PERFECT
            else {name: stray(self.sensor, row, name) for name in self.camera_names}
        )

    def _run(self, steps: int, ctrl: Float64[np.ndarray, "..."]) -> None:
        """Advance physics with `ctrl`, one row a step or one for all, and note what the robot touches and how long the hand presses."""
        model, data, names = self._model, self._data, self.scene.objects
        touched: dict[int, None] = {}
        running = {names.index(name): seconds for name, seconds in self._touch.running_s.items()}
        pressed: dict[int, float] = {}
        meeting, met, squeezed = None, dict[int, None](), set[int]()
        for row in np.broadcast_to(ctrl, (steps, len(self._ctrl))):
            data.ctrl[self._ctrl] = row
            mujoco.mj_step(model, data)
            geoms = data.contact.geom
            if (
                now := geoms.tobytes()
            ) != meeting:  # else the same touch each other as a moment ago
                meeting, pairs = now, self._roles[geoms]
                by_robot, others = (
                    (pairs.min(axis=1) == ARM) & (pairs.max(axis=1) >= 0),
                    pairs.max(axis=1),
                )
                met = dict.fromkeys(others[by_robot].tolist())
                squeezed = set(others[by_robot & self._hand[geoms].any(axis=1)].tolist())
            touched.update(met)
            running = {one: running.get(one, 0.0) + model.opt.timestep for one in squeezed}
            pressed.update(
                {one: max(seconds, pressed.get(one, 0.0)) for one, seconds in running.items()}
            )
        self._touch = Touch(
            tuple(names[i] for i in touched),
            {names[i]: seconds for i, seconds in pressed.items()},
            {
                names[i]: frozenset(self._partner(j) for j in others)
                for i, others in partners(self._roles[data.contact.geom]).items()
            },
            {names[i]: seconds for i, seconds in running.items()},
        )
        self._place_bodies()

    def _partner(self, role: int) -> str:
        return ROBOT if role == ARM else REST if role == STILL else self.scene.objects[role]

    def _place_bodies(self) -> None:
        """Bring poses up to date with the state, and the cameras to where they stray; contacts and solver warm start stay as they are."""
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        for name, astray in self._strays.items():
            camera = data.camera(name)
            facing = camera.xmat.reshape(3, 3)
            camera.xpos[:] += facing @ astray.shift_m
            camera.xmat[:] = (facing @ astray.turn).ravel()

    def _seen(self, camera: str, rgb: Rgb) -> Rgb:
        if self._row is None or camera not in self._strays:
            return rgb
        return exposed(self.sensor, rgb, self._strays[camera], self._row, camera, self._step())

    def _before(self, camera: str) -> tuple[Screen, ...]:
        """What the occluder puts before `camera` now; the episode decides from which side an arm comes."""
        if (
            self._row is None
            or self.occlusion is None
            or not self.occlusion.covers(camera, self._step())
        ):
            return ()
        tilt = float(
            np.random.default_rng([self._row.episode, self.camera_names.index(camera)]).uniform(
                -1.0, 1.0
            )
        )
        return screens(
            self.occlusion.kind,
            self._model,
            self._data,
            camera,
            self._row.target,
            self.robot.links,
            tilt,
        )

    def _step(self) -> int:
        """Control steps since the first observation."""
        return round(self.time_s * self.hz)

    def _targets(
        self, joints: Float64[np.ndarray, " n"], gripper: float
    ) -> Float64[np.ndarray, " m"]:
        shut, wide = np.array(self.robot.fingers_closed), np.array(self.robot.fingers_open)
        return np.concatenate([joints, shut + gripper * (wide - shut)])

    def tcp_base(self) -> Float64[np.ndarray, "4 4"]:
        """The gripper's measured pose in the robot base frame."""
        site = self._data.site("tcp")
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = site.xmat.reshape(3, 3), site.xpos
        return self._base_from_world @ world

    def _pose(self, body: str) -> Float64[np.ndarray, "7"]:
        found = self._data.body(body)
        return np.concatenate([found.xpos, found.xquat])

    def _hidden(self) -> frozenset[str]:
        return frozenset(self.scene.objects) - frozenset(self._placed)

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] += time.perf_counter() - start


def _matrix(quat: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "3 3"]:
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, quat)
    return flat.reshape(3, 3)
