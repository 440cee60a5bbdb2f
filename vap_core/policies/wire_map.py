"""How what we see and do is called, ordered and measured by a policy server (`served`, `serve`).

    {"about": "...", "wire": "openpi", "execute": 5, "text": ["prompt"],
     "pictures": [{"key": ["observation/image"], "camera": 0, "size": 224}],
     "state": [{"key": ["observation/state"], "parts": ["position", "axis-angle"]}],
     "actions": ["delta-position*0.05", "delta-axis-angle*0.5", "closing-sign"]}

A key is the path of maps to a value. `part*factor` multiplies: what is sent in the state, and what
is received in the actions. Units without a factor are metres and radians.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path as File
from typing import Annotated, Any, Literal, TypeGuard

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from scipy.spatial.transform import Rotation

from vap_core.base.errors import BadMessage, BadPolicy, first_line, one_of
from vap_core.base.files import read_file
from vap_core.base.types import Rgb, kind_of
from vap_core.policies.protocol import Chunk, PolicyInput
from vap_core.policies.wires import Path, at, put
from vap_core.simulation.types import EE_ACTION

STATE_PARTS: dict[str, int | None] = {
    "all": None,
    "position": 3,
    "world-position": 3,
    "axis-angle": 3,
    "axis-angle-positive-x": 3,
    "euler-xyz": 3,
    "quaternion-xyzw": 4,
    "quaternion-wxyz": 4,
    "opening": 1,
    "closing": 1,
    "fingers": 2,
    "joints": None,
}
"""Numbers of every part of a state. `all` is our own state (simulation.types.Observation); turns
and the position are the gripper's in the robot's base frame, `world-position` in the environment's
own. Of the two axes of one turn, LIBERO's data has the one with a positive x, whose angle may
exceed pi. `opening` is 0 closed to 1 open, `closing` the reverse, and `fingers` the travel of two,
one of them negative."""
ACTION_PARTS: dict[str, int | None] = {
    "all": None,
    "delta-position": 3,
    "delta-axis-angle": 3,
    "delta-euler-xyz": 3,
    "delta-joints": None,
    "joints": None,
    "opening": 1,
    "closing": 1,
    "opening-sign": 1,
    "closing-sign": 1,
    "ignored": 1,
}
"""Numbers of every part of an action. `all` is our own; those of joints take what the others leave.
`joints` are targets, `-sign` runs from -1 to 1."""
FORMATS = {
    "delta-position": "delta_xyz",
    "delta-axis-angle": "axis_angle",
    "delta-euler-xyz": "euler_xyz",
    "opening": "continuous_01",
    "closing": "binary_close_01",
    "closing-sign": "binary_close_positive",
    "opening-sign": "binary_close_negative",
}
"""What vla-eval's specifications call a part."""
UNSPECIFIED = "raw"
"""vla-eval's format that says nothing."""


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Picture(Strict):
    """A camera's picture: RGB, uint8. `camera` is its name, names of which one is there, or its
    number among the suite's.

    `{camera}` in the key stands for every camera's name. `size` is the side of a square, into which
    the picture is scaled and padded with black; None leaves it. `turned`: by 180 degrees. `first`:
    channels come first.
    """

    key: Path
    camera: int | str | tuple[str, ...] = 0
    size: Annotated[int, Field(ge=16, le=2048)] | None = None
    turned: bool = False
    first: bool = False


class Numbers(Strict):
    """A vector of the state: its parts in order."""

    key: Path
    parts: tuple[str, ...]

    @field_validator("parts")
    @classmethod
    def _known(cls, parts: tuple[str, ...]) -> tuple[str, ...]:
        return _checked(parts, STATE_PARTS)


class WireMap(Strict):
    """One convention. `execute` actions of a chunk are done before the next call."""

    about: str = ""
    wire: Literal["openpi", "vla-eval"] = "openpi"
    pictures: tuple[Picture, ...]
    state: tuple[Numbers, ...] = ()
    text: Path = ("prompt",)
    reply: Path = ("actions",)
    actions: tuple[str, ...] = ("all",)
    execute: Annotated[int, Field(ge=1, le=1000)] = 1

    @field_validator("actions")
    @classmethod
    def _known(cls, parts: tuple[str, ...]) -> tuple[str, ...]:
        return _checked(parts, ACTION_PARTS)

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:8]

    def by_camera(self, cameras: Sequence[str]) -> dict[str, tuple[Path, Picture]]:
        """The path and the form of the picture of each of these cameras that is sent.

        Raises: BadPolicy: it wants a camera that is not there.
        """
        found: dict[str, tuple[Path, Picture]] = {}
        for picture in self.pictures:
            if any("{camera}" in key for key in picture.key):
                for name in cameras:
                    path = tuple(key.replace("{camera}", name) for key in picture.key)
                    found[name] = path, picture
                continue
            wanted = picture.camera
            if isinstance(wanted, int):
                there = [*cameras[wanted:][:1]]
            else:
                there = [name for name in _alternatives(wanted) if name in cameras]
            if not there:
                raise BadPolicy(
                    f"wire map: {'/'.join(picture.key)} is the picture of camera "
                    f"{_camera(picture)}; there is {', '.join(cameras)}. Take a suite that has it, "
                    "or map another."
                )
            found[there[0]] = picture.key, picture
        return found

    def request(
        self,
        given: PolicyInput,
        down: np.ndarray,
        origin_m: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> dict[Any, Any]:
        """What is sent for an observation; `down` (3 x 3) turns a gripper to point down, `origin_m`
        is where the environment's own frame has the origin of the state's."""
        sent: dict[Any, Any] = put({}, self.text, given.text)
        for name, (path, picture) in self.by_camera(list(given.images)).items():
            sent = put(sent, path, _formed(given.images[name], picture))
        for numbers in self.state:
            parts = [_state_part(part, given.state, down, origin_m) for part in numbers.parts]
            sent = put(sent, numbers.key, np.concatenate(parts).astype(np.float32))
        return sent

    def observation(self, received: Mapping[Any, Any], cameras: Sequence[str]) -> PolicyInput:
        """What a policy gets from a request of this convention; numbers stay as they came.

        Raises: BadMessage: it lacks a picture, the state or the text.
        """
        images: dict[str, Rgb] = {}
        for name, (path, picture) in self.by_camera(cameras).items():
            rgb = at(received, path)
            if picture.first and isinstance(rgb, np.ndarray) and rgb.ndim == 3:
                rgb = np.ascontiguousarray(rgb.transpose(1, 2, 0))
            if not is_picture(rgb):
                raise _lacks(path, "a picture of uint8, height x width x 3", rgb)
            images[name] = np.ascontiguousarray(rgb[::-1, ::-1] if picture.turned else rgb)
        vectors = []
        for numbers in self.state:
            vector = at(received, numbers.key)
            if not isinstance(vector, np.ndarray | list) or not _finite(vector):
                raise _lacks(numbers.key, "numbers that are finite", vector)
            vectors.append(np.asarray(vector, np.float32).reshape(-1))
        text = at(received, self.text)
        if not isinstance(text, str):
            raise _lacks(self.text, "a text", text)
        state = np.concatenate(vectors) if vectors else np.zeros(0, np.float32)
        return PolicyInput(images, text, state)

    def chunk(self, reply: Any, given: PolicyInput, names: Sequence[str]) -> Chunk:
        """Our actions (`names`) of a reply, one row each.

        Raises: BadMessage: it has another number of columns, or numbers that are not finite.
        """
        if not isinstance(reply, np.ndarray | list) or not _finite(reply):
            raise _lacks(self.reply, "actions that are finite numbers", reply)
        rows = np.atleast_2d(np.asarray(reply, np.float64))
        widths = _widths(self.actions, len(names))
        if rows.ndim != 2 or not len(rows) or rows.shape[1] != sum(widths):
            raise BadMessage(
                f"served: {'/'.join(self.reply)} is of {np.shape(reply)}; by the wire map an "
                f"action is {sum(widths)} numbers ({', '.join(self.actions)})."
            )
        ours = np.zeros((len(rows), len(names)))
        columns = np.split(rows, np.cumsum(widths)[:-1], axis=1)
        for part, numbers in zip(self.actions, columns, strict=True):
            name, factor = _named(part)
            _enter(ours, name, numbers * factor, given.state[7:])
        return ours.astype(np.float32)

    def check(
        self, cameras: Sequence[str], names: Sequence[str], metadata: Mapping[str, Any]
    ) -> None:
        """That it fits a suite's cameras and actions, and what the server says of itself.

        Raises: BadPolicy.
        """
        self.by_camera(cameras)
        _widths(self.actions, len(names))
        kinds = {_named(part)[0] for part in self.actions}
        by_joint = tuple(names) != EE_ACTION
        if kinds != {"all"} and by_joint != bool(kinds & {"joints", "delta-joints"}):
            raise BadPolicy(
                f"wire map: its actions are {', '.join(self.actions)}; this suite's are "
                f"{', '.join(names)}. Take a suite with the other control, or another map."
            )
        said = metadata.get("action_spec")
        for spec in said.values() if isinstance(said, dict) else ():
            form = spec.get("format") if isinstance(spec, dict) else None
            ours = {FORMATS[kind] for kind in kinds if kind in FORMATS}
            same = form in ours or form not in FORMATS.values()
            if not same and form != UNSPECIFIED and ours:
                raise BadPolicy(
                    f"wire map: the server's actions have {form!r}, and the map has "
                    f"{', '.join(sorted(ours))}; take the map of that server."
                )

    def lines(self) -> list[str]:
        """The convention in words, a line each."""
        shown = [f"{'/'.join(p.key)} <- camera {_camera(p)}" + _form(p) for p in self.pictures]
        shown += [f"{'/'.join(n.key)} <- {', '.join(n.parts)}" for n in self.state]
        shown += [f"{'/'.join(self.text)} <- the command"]
        return [
            *shown,
            f"{'/'.join(self.reply)} -> {', '.join(self.actions)}; {self.execute} a call",
        ]


def is_picture(found: object) -> TypeGuard[np.ndarray]:
    """Whether it is an RGB picture, height x width x 3, uint8."""
    if not isinstance(found, np.ndarray) or found.dtype != np.uint8 or found.ndim != 3:
        return False
    return found.shape[2] == 3 and bool(found.size)


def _named(part: str) -> tuple[str, float]:
    name, _, factor = part.partition("*")
    return name, float(factor or 1)


def _checked(parts: tuple[str, ...], known: Mapping[str, int | None]) -> tuple[str, ...]:
    for part in parts:
        name, factor = _named(part)
        if name not in known or not np.isfinite(factor) or not factor:
            raise ValueError(f"{part!r} is no part; known: {', '.join(known)}, and PART*FACTOR")
    return parts


def _widths(parts: Sequence[str], total: int) -> list[int]:
    """The numbers of every part of an action of `total` numbers of ours."""
    known = [ACTION_PARTS[_named(part)[0]] for part in parts]
    rest = total - (1 if len(parts) > 1 else 0)  # joints, beside the gripper
    return [rest if width is None else width for width in known]


def _state_part(
    part: str, state: np.ndarray, down: np.ndarray, origin_m: np.ndarray | tuple[float, ...]
) -> np.ndarray:
    name, factor = _named(part)
    opening = float(state[6])
    turn = Rotation.from_matrix(Rotation.from_rotvec(state[3:6]).as_matrix() @ down)
    parts = {
        "all": lambda: state,
        "position": lambda: state[:3],
        "world-position": lambda: state[:3] + origin_m,
        "axis-angle": turn.as_rotvec,
        "axis-angle-positive-x": lambda: _positive_x(turn.as_quat()),
        "euler-xyz": lambda: turn.as_euler("xyz"),
        "quaternion-xyzw": turn.as_quat,
        "quaternion-wxyz": lambda: turn.as_quat(scalar_first=True),
        "opening": lambda: [opening],
        "closing": lambda: [1 - opening],
        "fingers": lambda: [opening, -opening],
        "joints": lambda: state[7:],
    }
    return np.asarray(parts[name](), np.float64) * factor


def _positive_x(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion if quaternion[0] >= 0 else -quaternion
    angle = 2 * np.arccos(np.clip(w, -1.0, 1.0))
    return np.array([x, y, z]) * angle / max(float(np.sqrt(1 - min(w * w, 1.0))), 1e-9)


def _enter(ours: np.ndarray, name: str, numbers: np.ndarray, joints: np.ndarray) -> None:
    """Enter one part of the received actions into ours."""
    match name:
        case "all":
            ours[:] = numbers
        case "delta-position":
            ours[:, :3] = numbers
        case "delta-axis-angle":
            ours[:, 3:6] = numbers
        case "delta-euler-xyz":
            ours[:, 3:6] = Rotation.from_euler("xyz", numbers).as_rotvec()
        case "delta-joints":
            ours[:, :-1] = numbers
        case "joints":
            ours[:, :-1] = np.diff(np.vstack([joints, numbers]), axis=0)
        case "opening" | "closing" | "opening-sign" | "closing-sign":
            level = (numbers[:, 0] + 1) / 2 if name.endswith("-sign") else numbers[:, 0]
            level = np.clip(level, 0, 1)
            ours[:, -1] = level if name.startswith("opening") else 1 - level


def _formed(rgb: Rgb, picture: Picture) -> np.ndarray:
    """A picture as the server wants it."""
    import cv2

    if picture.size is not None and rgb.shape[:2] != (picture.size, picture.size):
        h, w = rgb.shape[:2]
        scale = picture.size / max(h, w)
        height, width = max(round(h * scale), 1), max(round(w * scale), 1)
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = cv2.resize(rgb, (width, height), interpolation=way)
        rgb = np.zeros((picture.size, picture.size, 3), np.uint8)
        y, x = (picture.size - height) // 2, (picture.size - width) // 2
        rgb[y : y + height, x : x + width] = small
    rgb = rgb[::-1, ::-1] if picture.turned else rgb
    return np.ascontiguousarray(rgb.transpose(2, 0, 1) if picture.first else rgb)


def _alternatives(camera: str | tuple[str, ...]) -> tuple[str, ...]:
    return (camera,) if isinstance(camera, str) else camera


def _camera(picture: Picture) -> str:
    camera = picture.camera
    return str(camera) if isinstance(camera, int) else " or ".join(_alternatives(camera))


def _form(picture: Picture) -> str:
    size = "" if picture.size is None else f", {picture.size} x {picture.size}"
    return f"{size}{', turned by 180 degrees' if picture.turned else ''}"


def _finite(numbers: Any) -> bool:
    try:
        found = np.asarray(numbers, np.float64)
    except (TypeError, ValueError):
        return False
    return bool(found.size) and bool(np.isfinite(found).all())


def _lacks(path: Path, wanted: str, found: object) -> BadMessage:
    what = "nothing" if found is None else kind_of(found)
    return BadMessage(f"wire map: {'/'.join(path)} has {what} where {wanted} should be.")


MAPS: dict[str, WireMap] = {
    "ours": WireMap(
        about="a policy of this workspace behind openpi's wire (serve --policy)",
        pictures=(Picture(key=("observation.images.{camera}",)),),
        state=(Numbers(key=("observation.state",), parts=("all",)),),
        execute=4,
    ),
    "ours-vla-eval": WireMap(
        about="the same behind vla-eval's wire",
        wire="vla-eval",
        pictures=(Picture(key=("images", "{camera}")),),
        state=(Numbers(key=("state",), parts=("all",)),),
        text=("task_description",),
    ),
    "libero": WireMap(
        about="openpi's LIBERO policies: OSC_POSE of a Panda at 20 Hz",
        pictures=(
            Picture(key=("observation/image",), size=224),
            Picture(
                key=("observation/wrist_image",),
                camera=("wrist", "robot0_eye_in_hand", "image2"),
                size=224,
            ),
        ),
        state=(
            Numbers(
                key=("observation/state",),
                parts=("world-position", "axis-angle-positive-x", "fingers*0.04"),
            ),
        ),
        actions=("delta-position*0.05", "delta-axis-angle*0.5", "closing-sign"),
        execute=5,
    ),
    "droid": WireMap(
        about="openpi's DROID policies: joint velocities of a Panda at 15 Hz, 0.2 rad a step",
        pictures=(
            Picture(key=("observation/exterior_image_1_left",), size=224),
            Picture(key=("observation/wrist_image_left",), camera="wrist", size=224),
        ),
        state=(
            Numbers(key=("observation/joint_position",), parts=("joints",)),
            Numbers(key=("observation/gripper_position",), parts=("closing",)),
        ),
        actions=("delta-joints*0.2", "closing"),
        execute=8,
    ),
    "bridge": WireMap(
        about="vla-eval's SIMPLER servers, WidowX at 5 Hz",
        wire="vla-eval",
        pictures=(Picture(key=("images", "primary")),),
        state=(Numbers(key=("states",), parts=("position", "quaternion-wxyz", "opening")),),
        text=("task_description",),
        actions=("delta-position", "delta-axis-angle", "opening"),
    ),
}
MAPS["fractal"] = MAPS["bridge"].model_copy(
    update={"about": "vla-eval's SIMPLER servers, Google robot at 3 Hz"}
)
OURS = {"openpi": "ours", "vla-eval": "ours-vla-eval"}
"""The map of our own policies behind each wire."""


def load_map(name: str) -> WireMap:
    """One of MAPS, or that of a JSON file. Raises: UnknownName; BadPolicy for a damaged file."""
    if not name.endswith(".json"):
        if name not in MAPS:
            raise one_of("wire map (or a .json file)", name, MAPS)
        return MAPS[name]
    try:
        return WireMap.model_validate_json(read_file(File(name)))
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, fault["loc"]))
        raise BadPolicy(
            f"wire map: {name}: {where}: {first_line(fault['msg']):.200}; see the maps that ship: "
            "docs/policies.md."
        ) from error
    except OSError as error:
        raise BadPolicy(f"wire map: {name} cannot be read ({error.strerror}).") from error
