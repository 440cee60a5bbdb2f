"""The prompting proxy: between any client and any policy server, no line changed on either side.

Pictures and the command are prompted by the same `attend.py` as everywhere; everything else passes
bit for bit. Every client has a connection to the server and a state of its own. What cannot be
prompted is refused to the client by name, and never passed on as it is: only a command without a
personal object passes untouched.
"""

import asyncio
import re
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from vap_core.attend import Attender, AttendState
from vap_core.base.errors import BadMessage, NothingPersonal, first_line
from vap_core.base.types import Attended, Event, Rgb, Track, Views
from vap_core.policies.wires import (
    ARRAY,
    IMAGE,
    LARGEST_MESSAGE,
    UPSTREAM_TOKEN,
    Frame,
    Message,
    Path,
    Wire,
    array_of,
    at,
    authorization,
    leaves,
    like,
    marked,
    put,
)
from vap_core.serve.server import AWAY, BROKEN, WAITING, cores, fault

TEXTS = ("prompt", "task", "task_description", "language_instruction", "instruction")
"""Where clients put the command; the first that is there."""
TRIES_S = (0.5, 1.0, 2.0)
"""The waits between attempts to reach the server behind."""
SMALLEST_PX = 16
"""A smaller array of three channels is no picture."""
MOST_SESSIONS = 64
MOST_NUMBERS = 64
"""Longer vectors of numbers are no robot's state."""
NEARER = 6.0
"""A robot that is so many times nearer to its first state than one call before is back there."""
JUMP = 2.0
"""Views that change so many times as much as ever before are of another scene."""
NO_STATE = (
    "; there is no robot state in the messages, so that with the same command on the same "
    "connection another episode shows only where every view jumps"
)
THUMBNAIL_PX = 32
type NewEpisode = Literal["auto", "prompt", "connection", "never"]


@dataclass(frozen=True)
class Prompted:
    """What one observation became, and what is kept of it for a recording."""

    episode: int
    call: int
    instruction: str
    views: Views
    attended: Attended
    state: np.ndarray
    starts: str
    """Why an episode starts here; "" where none does."""
    seconds: Mapping[str, float]


@dataclass
class Ongoing:
    """One episode of one stream of observations."""

    number: int
    text: str
    attending: AttendState | None
    """None where the command names nothing personal."""
    vectors: list[np.ndarray] = field(default_factory=list)
    """The first state, and the last."""
    longest: np.ndarray | None = None
    """The longest move of every number of the state between two calls."""
    thumbnails: list[np.ndarray] = field(default_factory=list)
    largest_change: float = 0.0
    call: int = 0
    before: tuple[Views, Attended] | None = None


@dataclass(frozen=True)
class Options:
    """Which pictures are prompted (all), when an episode starts, which objects are meant."""

    cameras: tuple[str, ...] = ()
    new_episode: NewEpisode = "auto"
    objects: tuple[str, ...] | None = None


AS_USUAL = Options()


class Stream:
    """Prompts the observations of one client, or of one session of a client that has several.

    Without an attender nothing is prompted. An episode starts with the stream, at a message that
    says so, and by `new_episode`: "auto" at another command, and where the robot is back where it
    began, or every view changes, at once;
    "prompt" at another command; with "connection" another command is refused, and with "never" it
    is tracked on under the first one.
    """

    def __init__(
        self,
        attender: Attender | None,
        number: Callable[[], int],
        options: Options = AS_USUAL,
    ) -> None:
        self._attender = attender
        self._number = number
        self._options = options
        self._ongoing: Ongoing | None = None
        self._asked = "the first observation of the connection"

    def reset(self, why: str) -> None:
        """The next observation starts an episode."""
        self._ongoing = None
        self._asked = why

    def prompt(self, payload: dict[Any, Any]) -> tuple[dict[Any, Any], Prompted]:
        """The payload with prompted pictures and command; the given one stays as it is.

        Raises: BadMessage: a picture or the command is not as it must be; as `Attender.start` and
            `Attender.step`.
        """
        began = time.perf_counter()
        pictures = find_pictures(payload, self._options.cameras)
        names = _camera_names(list(pictures))
        views = {names[path]: picture.rgb for path, picture in pictures.items()}
        text_path, text = find_text(payload)
        vector = state_vector(payload)
        read = time.perf_counter()
        thumbnails = _thumbnails(views)
        why = self._starts(text, vector, thumbnails)
        if why and not vector.size and self._options.new_episode == "auto":
            why += NO_STATE
        episode = self._ongoing
        if why or episode is None:
            self._ongoing = None  # a start that fails leaves no episode behind
            attending, attended = self._start(views, text)
            episode = Ongoing(self._number(), text, attending)
        elif episode.before is not None and _same(views, episode.before[0]):
            attended = episode.before[1]  # a request that is repeated
        elif episode.attending is not None and self._attender is not None:
            episode.attending, attended = self._attender.step(episode.attending, views)
        else:
            attended = _untouched(views, text)
        self._ongoing = episode
        episode.before = views, attended
        _remember(episode, vector, thumbnails)
        prompted = time.perf_counter()
        if attended.text != text:
            payload = put(payload, text_path, attended.text)
        for path, picture in pictures.items():
            shown = attended.images[names[path]]
            if shown is not picture.rgb and (shown != picture.rgb).any():
                payload = put(payload, path, picture.showing(shown))
        done = time.perf_counter()
        seconds = {"decode": read - began, "attend": prompted - read, "encode": done - prompted}
        kept = Prompted(episode.number, episode.call, text, views, attended, vector, why, seconds)
        episode.call += 1
        return payload, kept

    def _start(self, views: Views, text: str) -> tuple[AttendState | None, Attended]:
        if self._attender is None:
            return None, _untouched(views, text)
        try:
            return self._attender.start(views, text, objects=self._options.objects)
        except NothingPersonal:
            return None, _untouched(views, text)

    def _starts(self, text: str, vector: np.ndarray, thumbnails: list[np.ndarray]) -> str:
        """Why an episode starts with this observation; "" where it goes on."""
        episode, mode = self._ongoing, self._options.new_episode
        if episode is None:
            return self._asked
        if text != episode.text:
            if mode in ("auto", "prompt"):
                return "another command"
            if mode == "connection":
                raise BadMessage(
                    f"proxy: the command changed to {text!r:.80} within a connection; connect "
                    "anew, or serve with --new-episode prompt."
                )
        if mode != "auto":
            return ""
        if put_back(episode, vector):
            return "the robot is back where the episode began, in one call"
        change = _change(episode, thumbnails)
        if episode.call > 2 and change > JUMP * episode.largest_change:
            return f"every view changes at once ({change:.0f} levels)"
        return ""


def _remember(episode: Ongoing, vector: np.ndarray, thumbnails: list[np.ndarray]) -> None:
    """Keep what `_starts` compares the next observation with."""
    if episode.call:
        episode.largest_change = max(episode.largest_change, _change(episode, thumbnails))
        if _fits(episode, vector):
            moved = np.abs(vector - episode.vectors[-1])
            longest = episode.longest
            episode.longest = moved if longest is None else np.maximum(longest, moved)
    episode.vectors = [*episode.vectors[:1], vector]
    episode.thumbnails = thumbnails


@dataclass(frozen=True)
class Picture:
    """A colour picture: the map that stands for it, its array as it came, and its pixels."""

    node: Any
    array: np.ndarray
    rgb: Rgb

    def showing(self, rgb: Rgb) -> Any:
        """The map for other pixels, in the form in which the client sent these."""
        in_order = rgb if self.array.shape[-1] == 3 else rgb.transpose(2, 0, 1)
        return like(self.node, np.ascontiguousarray(in_order).reshape(self.array.shape))


def find_pictures(payload: Mapping[Any, Any], cameras: tuple[str, ...] = ()) -> dict[Path, Picture]:
    """Every colour picture of a payload, by its path.

    Those are arrays of uint8 with three channels, first or last, and encoded pictures; `cameras`
    names the paths (a/b) of those that are meant, where that is not all.

    Raises: BadMessage: there is none; one is not of uint8, or is of several moments.
    """
    found: dict[Path, Picture] = {}
    for path, part in leaves(payload):
        name = "/".join(path)
        if cameras and name not in cameras:
            continue
        nodes = part if isinstance(part, list) else [part]
        if not any(marked(node) in (ARRAY, IMAGE) for node in nodes):
            continue
        arrays = [array_of(node) for node in nodes if marked(node)]
        pixels = [array for array in arrays if _looks_coloured(array)]
        if not pixels:
            continue
        if isinstance(part, list) or (pixels[0].ndim == 4 and len(pixels[0]) != 1):
            raise BadMessage(
                f"proxy: {name} holds pictures of several moments; send the present one alone."
            )
        if pixels[0].dtype != np.uint8:
            raise BadMessage(
                f"proxy: {name} is a picture of {pixels[0].dtype}; send uint8, or name the "
                "cameras that are meant (--camera KEY)."
            )
        found[path] = Picture(part, pixels[0], _upright(pixels[0]))
    for name in cameras:
        if name not in {"/".join(path) for path in found}:
            raise BadMessage(f"proxy: there is no picture {name} in this message (--camera).")
    if not found:
        raise BadMessage(
            f"proxy: no picture of uint8 with three channels among "
            f"{', '.join('/'.join(path) for path, _ in leaves(payload))!r:.200}."
        )
    return found


def _looks_coloured(array: np.ndarray) -> bool:
    shape = array.shape[1:] if array.ndim == 4 else array.shape
    if len(shape) != 3 or 3 not in (shape[0], shape[2]):
        return False
    return min(sorted(shape)[1:]) >= SMALLEST_PX


def _upright(array: np.ndarray) -> np.ndarray:
    """The pixels, height x width x 3."""
    one = array[0] if array.ndim == 4 else array
    return one if one.shape[2] == 3 else np.ascontiguousarray(one.transpose(1, 2, 0))


def find_text(payload: Mapping[Any, Any]) -> tuple[Path, str]:
    """Where the command is, and what it is. Raises: BadMessage."""
    for name in TEXTS:
        text = at(payload, (name,))
        if isinstance(text, str):
            return (name,), text
    raise BadMessage(
        f"proxy: no command among {sorted(map(str, payload))!r:.200}; it is looked for in "
        f"{', '.join(TEXTS)}."
    )


def state_vector(payload: Mapping[Any, Any]) -> np.ndarray:
    """The floats of a payload that can be the robot's state, in the order of their paths."""
    parts = []
    for _, part in sorted(leaves(payload), key=lambda leaf: leaf[0]):
        if marked(part) == ARRAY:
            array = array_of(part)
            if array.dtype.kind == "f" and array.size <= MOST_NUMBERS and array.ndim <= 2:
                parts.append(array.astype(np.float64).reshape(-1))
    return np.concatenate(parts) if parts else np.zeros(0)


def put_back(episode: Ongoing, vector: np.ndarray) -> bool:
    """Whether the state has come back to the first one in one call, from farther than its longest
    move before in at least two of its numbers, and in all that were so far."""
    if episode.longest is None or not _fits(episode, vector) or episode.call < 3:
        return False
    first, last = episode.vectors[0], episode.vectors[-1]
    far = np.abs(last - first) > np.maximum(episode.longest, 1e-4)
    near = np.abs(vector - first) < np.abs(last - first) / NEARER
    return int(far.sum()) >= 2 and bool(near[far].all())


def _fits(episode: Ongoing, vector: np.ndarray) -> bool:
    return bool(vector.size) and vector.shape == episode.vectors[-1].shape


def _thumbnails(views: Views) -> list[np.ndarray]:
    size = (THUMBNAIL_PX, THUMBNAIL_PX)
    small = [cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) for rgb in views.values()]
    return [picture.astype(np.int16) for picture in small]


def _change(episode: Ongoing, thumbnails: list[np.ndarray]) -> float:
    """The mean change of levels since the last call, of the view that changes least."""
    pairs = zip(thumbnails, episode.thumbnails, strict=False)
    return min((float(np.abs(now - before).mean()) for now, before in pairs), default=0.0)


def _same(views: Views, before: Views) -> bool:
    return views.keys() == before.keys() and all(
        np.array_equal(rgb, before[name]) for name, rgb in views.items()
    )


def _untouched(views: Views, text: str) -> Attended:
    nothing = {camera: (Track(None, 0.0),) for camera in views}
    return Attended(dict(views), text, (), nothing, {}, ())


def _camera_names(paths: list[Path]) -> dict[Path, str]:
    """A name of every picture for logs and recordings: the end of its path, where that is a name
    of its own; of letters, digits, points and dashes."""
    last = [path[-1].rpartition("/")[2].removeprefix("observation.images.") for path in paths]
    last = [re.sub(r"[^\w.-]+", "-", name) or "camera" for name in last]
    whole = [f"{n}-{name}" for n, name in enumerate(last)]
    unique = len(set(last)) == len(last)
    return dict(zip(paths, last if unique else whole, strict=True))


class Keeper:
    """What a proxy tells of its episodes; a subclass records them. Calls come from threads."""

    def observed(self, stream: object, found: Prompted) -> None: ...

    def answered(self, stream: object, actions: np.ndarray | None, seconds: float) -> None: ...

    def ended(self, stream: object) -> None: ...


class Proxy:
    """Relays every client to the server behind, and prompts what it observes."""

    def __init__(
        self, upstream: str, attender: Attender | None, options: Options, keeper: Keeper
    ) -> None:
        self.upstream = upstream
        self.keeper = keeper
        self._attender = attender
        self._options = options
        self._episodes = 0
        self._threads = ThreadPoolExecutor(cores(), "attend")

    def _number(self) -> int:
        self._episodes += 1
        return self._episodes - 1

    async def __call__(self, client: ServerConnection, wire: Wire) -> None:
        """One client, until it or the server behind closes."""
        try:
            server = await self._reach(client)
        except (OSError, InvalidHandshake, TimeoutError) as error:
            reason = f"upstream {self.upstream} cannot be reached: {first_line(error)}"
            await client.close(AWAY, reason[:120])
            return
        relay = Relay(self, client, server, wire)
        async with server:
            down = asyncio.create_task(relay.down())
            try:
                await relay.up()
            finally:
                down.cancel()
                with suppress(asyncio.CancelledError, ConnectionClosed):
                    await down
                await self.run(relay.end)

    async def _reach(self, client: ServerConnection) -> ClientConnection:
        """A connection to the server behind. Raises: OSError, InvalidHandshake, TimeoutError."""
        headers = authorization(UPSTREAM_TOKEN)
        given = client.request.headers.get("Authorization") if client.request else None
        if given and not headers and not authorization():
            headers = {"Authorization": given}
        for wait_s in (*TRIES_S, None):
            try:
                return await connect(
                    self.upstream,
                    additional_headers=headers,
                    compression=None,
                    max_size=LARGEST_MESSAGE,
                    max_queue=WAITING,
                    ping_interval=None,
                    close_timeout=1,
                    proxy=None,
                )
            except OSError:
                if wait_s is None:
                    raise
                await asyncio.sleep(wait_s)
        raise AssertionError

    def stream(self) -> Stream:
        return Stream(self._attender, self._number, self._options)

    async def run[T](self, work: Callable[..., T], *given: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, work, *given)


class Relay:
    """One client and its connection to the server behind."""

    def __init__(
        self, proxy: Proxy, client: ServerConnection, server: ClientConnection, wire: Wire
    ) -> None:
        self._proxy, self._client, self._server, self._wire = proxy, client, server, wire
        self._streams: dict[str, Stream] = {}
        self._asked: list[tuple[Stream, float]] = []
        """The streams whose replies are due, and when they were asked for."""

    async def up(self) -> None:
        """From the client to the server behind."""
        with suppress(ConnectionClosed):
            async for frame in self._client:
                sent, stream, found = await self._passed(frame)
                if sent is not None:
                    await self._server.send(sent)
                if stream is not None and found is not None:
                    await self._proxy.run(self._proxy.keeper.observed, stream, found)

    async def down(self) -> None:
        """From the server behind to the client, as it comes."""
        first = True
        try:
            async for frame in self._server:
                await self._client.send(frame)
                await self._proxy.run(self._note, frame, first)
                first = False
        finally:
            code, reason = self._server.close_code, self._server.close_reason
            said = f"upstream closed ({code}{': ' if reason else ''}{reason or ''})"
            with suppress(ConnectionClosed):
                await self._client.close(code if code in (1000, 1001) else BROKEN, said[:120])

    async def _passed(self, frame: Frame) -> tuple[Frame | None, Stream | None, Prompted | None]:
        """What goes on of a client's message, None where the client was told of a fault; and what
        was prompted in it."""
        around: dict[str, Any] = {}
        try:
            message = self._wire.read(frame, of_client=True)
            around = {"seq": message.seq}
            if message.kind in ("start", "end"):
                await self._proxy.run(self._bounds, message)
            if message.kind != "observation":
                return frame, None, None
            return await self._proxy.run(self._observed, frame, message)
        except ConnectionClosed:
            raise
        except Exception as error:
            await self._client.send(fault(self._wire, error, around))
            return None, None, None

    def _stream(self, message: Message) -> Stream:
        session = str(message.payload.get("session_id", ""))
        if session not in self._streams:
            if len(self._streams) == MOST_SESSIONS:
                raise BadMessage(
                    f"proxy: a connection has over {MOST_SESSIONS} sessions; connect anew."
                )
            self._streams[session] = self._proxy.stream()
        return self._streams[session]

    def _bounds(self, message: Message) -> None:
        stream = self._stream(message)
        self._proxy.keeper.ended(stream)
        stream.reset("the client says so")

    def _observed(self, frame: Frame, message: Message) -> tuple[Frame, Stream, Prompted]:
        stream = self._stream(message)
        payload, found = stream.prompt(message.payload)
        if payload is not message.payload:
            began = time.perf_counter()
            frame = self._wire.write(Message("observation", payload, message.around))
            encode = found.seconds["encode"] + time.perf_counter() - began
            found = replace(found, seconds={**found.seconds, "encode": encode})
        self._asked.append((stream, time.perf_counter()))
        return frame, stream, found

    def _note(self, frame: Frame, first: bool) -> None:
        """Keep what was answered; what cannot be read is the client's to find out."""
        if not self._asked:
            return
        actions = None
        with suppress(BadMessage):
            message = self._wire.read(frame, of_client=False, first=first)
            if message.kind not in ("action", "error"):
                return
            for _, part in leaves(message.payload):
                if actions is None and marked(part) == ARRAY:
                    actions = np.atleast_2d(array_of(part))
        stream, asked = self._asked.pop(0)
        self._proxy.keeper.answered(stream, actions, time.perf_counter() - asked)

    def end(self) -> None:
        for stream in self._streams.values():
            self._proxy.keeper.ended(stream)


def events_of(found: Prompted) -> list[Event]:
    """What a recording says of an observation: the prompt's events, and why an episode starts."""
    events = [Event(found.call, "INFO", f"episode starts: {found.starts}")] if found.starts else []
    return [*events, *found.attended.events]
