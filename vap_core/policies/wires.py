"""The messages of policy servers: openpi's wire and vla-eval's, msgpack over a WebSocket.

Messages come from outside: they are parsed, never executed, within one limit of size. `read` leaves
arrays as the maps of bytes that the wire has, so that what nobody changes goes on bit for bit;
`array_of` builds one, after its shape, its type and its bytes were found to agree.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from math import prod
from typing import Any, Literal, Protocol, runtime_checkable

import msgpack
import numpy as np

from vap_core import __version__
from vap_core.base.errors import BadMessage, BadPhoto, first_line, one_of
from vap_core.base.media import decode_picture

LARGEST_MESSAGE = 64 * 2**20
"""Bytes; six views of 1080 x 1920 pixels are 36 MiB."""
DEEPEST = 16
"""Maps and lists of a message inside each other."""
DTYPES = tuple(
    np.dtype(name).str
    for name in ("?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8")
)
"""The types of numbers that are read. Objects, records, texts and complex numbers are not."""
ARRAY, IMAGE, SCALAR = "__ndarray__", "__image__", "__npgeneric__"
"""What marks a map that stands for an array, an encoded picture, or a NumPy number."""
TOKEN = "VAP_TOKEN"
"""The environment variable with the token that servers here want and clients here send."""
UPSTREAM_TOKEN = "VAP_UPSTREAM_TOKEN"
"""That of the token for the server behind the proxy; without it the client's header goes on."""
type Frame = bytes | str
type Kind = Literal["hello", "start", "observation", "action", "end", "error"]
type Path = tuple[str, ...]
"""Where something lies in a payload: the keys of its maps, from the outermost."""


@dataclass(frozen=True)
class Message:
    """One message: what it is, its payload, and the map around it on the wire, if there is one."""

    kind: Kind
    payload: dict[Any, Any]
    around: Mapping[str, Any] = field(default_factory=dict)

    @property
    def seq(self) -> int:
        """The number that a reply repeats; 0 on a wire without numbers."""
        return int(self.around.get("seq", 0))


@runtime_checkable
class Wire(Protocol):
    """How one kind of policy server talks. `health` is the path that says whether it is up.

    `by_step`: the server plays its chunks out itself, and answers every observation with one
    action. `marks_episodes`: the client says where an episode starts and ends.
    """

    name: str
    health: str
    by_step: bool
    marks_episodes: bool

    def read(self, frame: Frame, *, of_client: bool, first: bool = False) -> Message:
        """Parse a message; `first` on its connection in this direction. Raises: BadMessage."""
        ...

    def write(self, message: Message) -> Frame: ...


class OpenPi:
    """openpi's: the server's metadata first, then a map for a map; a text is an error.

    RoboArena's variant of it has `endpoint` ("reset" or "infer") and `session_id` in the map.
    """

    name, health, by_step, marks_episodes = "openpi", "/healthz", False, False

    def read(self, frame: Frame, *, of_client: bool, first: bool = False) -> Message:
        if isinstance(frame, str):
            return Message("error", {"error": frame})
        payload = unpack(frame)
        if not of_client:
            return Message("hello" if first else "action", payload)
        return Message("start" if payload.get("endpoint") == "reset" else "observation", payload)

    def write(self, message: Message) -> Frame:
        if message.kind == "error":
            return str(message.payload["error"])
        return pack(message.payload, str.encode)


class VlaEval:
    """vla-eval's: type, payload, seq and timestamp; hello first, and messages around an episode."""

    name, health, by_step, marks_episodes = "vla-eval", "/health", True, True
    KINDS: Mapping[str, Kind] = {
        **{kind: kind for kind in ("hello", "observation", "action", "error")},
        "episode_start": "start",
        "episode_end": "end",
    }
    VERSION = 1

    def read(self, frame: Frame, *, of_client: bool, first: bool = False) -> Message:
        if isinstance(frame, str):
            raise BadMessage("wire: a text came where vla-eval's wire has bytes; is it openpi's?")
        tree = unpack(frame)
        payload, seq = tree.get("payload"), tree.get("seq")
        if tree.get("type") not in self.KINDS or not isinstance(payload, dict):
            raise BadMessage(
                f"wire: a message has the keys {sorted(map(str, tree))[:8]}; vla-eval's has a type "
                f"({', '.join(self.KINDS)}) and a payload. Is it openpi's wire?"
            )
        if type(seq) is not int:
            raise BadMessage(f"wire: seq is {seq!r:.40}; give the number of the message.")
        return Message(self.KINDS[tree["type"]], payload, tree)

    def write(self, message: Message) -> Frame:
        names = {kind: name for name, kind in self.KINDS.items()}
        written = {"seq": 0, "timestamp": time.time(), **message.around}
        written |= {"type": names[message.kind], "payload": message.payload}
        if message.kind == "hello":
            about = {"harness_version": f"vap-core {__version__}", "protocol_version": self.VERSION}
            written["payload"] = about | message.payload
        return pack(written, str)


WIRES: dict[str, Wire] = {"openpi": OpenPi(), "vla-eval": VlaEval()}


def wire_of(name: str) -> Wire:
    """Raises: UnknownName."""
    if name not in WIRES:
        raise one_of("wire", name, WIRES)
    return WIRES[name]


def unpack(data: bytes) -> dict[Any, Any]:
    """Parse a map, arrays left as the wire has them. Raises: BadMessage."""
    if len(data) > LARGEST_MESSAGE:
        raise BadMessage(
            f"wire: a message of {len(data) / 2**20:.0f} MiB; at most "
            f"{LARGEST_MESSAGE // 2**20} are read. Send smaller pictures."
        )
    try:
        tree = msgpack.unpackb(data, strict_map_key=False, unicode_errors="surrogateescape")
        _check_depth(tree)
    except Exception as error:  # msgpack raises many kinds for damaged bytes
        raise BadMessage(
            f"wire: {len(data)} bytes are no message in msgpack ({type(error).__name__}: "
            f"{first_line(error):.80}); is a policy server of this wire there?"
        ) from error
    if not isinstance(tree, dict):
        raise BadMessage(f"wire: a message is {type(tree).__name__}; the wire sends a map.")
    return tree


def _check_depth(tree: Any, left: int = DEEPEST) -> None:
    if left < 0:
        raise ValueError(f"more than {DEEPEST} maps or lists inside each other")
    if isinstance(tree, dict | list):
        for part in tree.values() if isinstance(tree, dict) else tree:
            _check_depth(part, left - 1)


def pack(tree: Mapping[Any, Any], key: Callable[[str], Any]) -> bytes:
    """The bytes of a map; its arrays become maps whose keys are `key` of their names."""

    def map_of(part: Any) -> Any:
        if isinstance(part, np.ndarray):
            return node_of(part, key)
        if isinstance(part, np.generic):
            return part.item()
        raise TypeError(f"pack: {type(part).__name__} is neither a number, a text nor an array")

    packed = msgpack.packb(tree, default=map_of, unicode_errors="surrogateescape")
    return bytes(packed)


def node_of(array: np.ndarray, key: Callable[[str], Any]) -> dict[Any, Any]:
    """The map that stands for an array on the wire."""
    about = {"data": array.tobytes(), "dtype": array.dtype.str, "shape": list(array.shape)}
    return {key(ARRAY): True, **{key(name): part for name, part in about.items()}}


def marked(part: Any) -> str | None:
    """ARRAY, IMAGE or SCALAR for a map that stands for one; else None."""
    if isinstance(part, dict):
        for mark in (ARRAY, IMAGE, SCALAR):
            if mark in part or mark.encode() in part:
                return mark
    return None


def array_of(node: Mapping[Any, Any]) -> np.ndarray:
    """The array that a map stands for.

    Raises: BadMessage: its type is not read here, or shape, type and bytes do not agree.
    """
    about = {k.decode(errors="replace") if isinstance(k, bytes) else k: v for k, v in node.items()}
    shape, dtype, data = about.get("shape"), about.get("dtype"), about.get("data")
    if isinstance(dtype, bytes):
        dtype = dtype.decode(errors="replace")
    if SCALAR in about and dtype in DTYPES and isinstance(data, bool | int | float):
        return np.asarray(data, dtype)
    sized = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not sized or not isinstance(data, bytes):
        raise BadMessage(f"wire: an array has the keys {sorted(about)!r:.100}, or no sizes.")
    assert isinstance(shape, list)
    if about.get("format") in ("jpeg", "png"):
        try:
            found = decode_picture(BytesIO(data), "wire: a picture", convert=False)
        except BadPhoto as error:
            raise BadMessage(str(error)) from error
        if list(found.shape) != shape:
            raise BadMessage(f"wire: a picture of {found.shape} says that it is {shape}.")
        return found
    if dtype not in DTYPES:
        raise BadMessage(f"wire: an array of type {dtype!r:.40}; read are {', '.join(DTYPES)}.")
    if prod(shape) * np.dtype(dtype).itemsize != len(data):
        raise BadMessage(f"wire: {len(data)} bytes say that they are {shape} numbers of {dtype}.")
    return np.frombuffer(data, dtype).reshape(shape)


def like(node: Mapping[Any, Any], array: np.ndarray) -> dict[Any, Any]:
    """An array in the form of the one that it takes the place of; a picture without loss."""
    if marked(node) == IMAGE and node.get("format") != "raw":
        from PIL import Image

        png = BytesIO()
        Image.fromarray(array).save(png, "PNG", compress_level=1)
        return {**node, "format": "png", "data": png.getvalue(), "shape": list(array.shape)}
    name: Any = "data" if "data" in node else b"data"
    return {**node, name: array.tobytes()}


def decoded(tree: Any) -> Any:
    """A message with its arrays built. Raises: BadMessage."""
    if marked(tree):
        return array_of(tree)
    if isinstance(tree, dict):
        return {key: decoded(part) for key, part in tree.items()}
    return [decoded(part) for part in tree] if isinstance(tree, list) else tree


def leaves(tree: Mapping[Any, Any], above: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Everything in a payload that is no map, and every array, with its path of texts."""
    for key, part in tree.items():
        if not isinstance(key, str):
            continue
        if isinstance(part, dict) and not marked(part):
            yield from leaves(part, (*above, key))
        else:
            yield (*above, key), part


def at(tree: Any, path: Path) -> Any:
    """What lies at a path; None where nothing does."""
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def put(tree: Mapping[Any, Any], path: Path, part: Any) -> dict[Any, Any]:
    """The map with something else at a path."""
    first, *rest = path
    inner = part if not rest else put(tree.get(first) or {}, tuple(rest), part)
    return {**tree, first: inner}


def authorization(variable: str = TOKEN) -> dict[str, str]:
    """The header that openpi's clients send, with the token of a variable; none without one."""
    token = os.environ.get(variable, "").strip()
    return {"Authorization": f"Api-Key {token}"} if token else {}
