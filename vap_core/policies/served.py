"""A policy behind a WebSocket, as any other policy: `--policy "ws://gpu:8000?map=libero"`.

The map says what the server calls our cameras, state and actions (wire_map), and which wire it
speaks; `wire` names another. Every episode has a connection of its own, which is how openpi's
servers and the prompting proxy know its beginning. What goes wrong on the wire ends that episode.
"""

import time
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from vap_core.base.errors import BadEndpoint, BadMessage, BadPlan, BadPolicy, first_line, one_of
from vap_core.environments import AnyScene, open_env
from vap_core.policies.names import is_served, policy_label
from vap_core.policies.protocol import TEXT, Chunk, PolicyInput, report_input
from vap_core.policies.wire_map import OURS, WireMap, load_map
from vap_core.policies.wires import (
    LARGEST_MESSAGE,
    TOKEN,
    Kind,
    Message,
    Wire,
    at,
    authorization,
    decoded,
    wire_of,
)
from vap_core.simulation.suites.suite import Suite

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

REPLY_S = 60.0
"""A server that is silent for longer has stalled."""
CONNECT_S = 10.0
TRIES_S = (1.0, 2.0, 4.0)
"""The waits between attempts to connect: a server that is started again is found again."""


@dataclass(frozen=True)
class Address:
    """What a served policy's name says. `url` is without the query."""

    url: str
    wire: Wire
    map: WireMap
    map_name: str

    @property
    def label(self) -> str:
        """Its name in tables: the wire, the server, and what it was asked with."""
        return policy_label(self.wire.name, urlsplit(self.url).netloc, self.map.digest)


def parse_address(name: str) -> Address:
    """Raises: BadPolicy, UnknownName."""
    parts = urlsplit(name)
    options = dict(parse_qsl(parts.query))
    if not is_served(name) or not parts.hostname or parts.username:
        raise BadPolicy(
            f'policy: {name} is no address; write ws://HOST:PORT or "ws://HOST:PORT?map=libero".'
        )
    for option in options:
        if option not in ("map", "wire"):
            raise one_of(f"policy {name}: option", option, ("map", "wire"))
    wire = options.get("wire", "")
    map_name = options.get("map", OURS.get(wire, OURS["openpi"]))
    convention = load_map(map_name)
    url = parts._replace(query="", fragment="").geturl()
    return Address(url, wire_of(wire or convention.wire), convention, map_name)


class Connection:
    """One episode's connection. Requests and replies come in turn; after a fault it is closed.

    Raises: BadEndpoint: the server cannot be reached, or refuses; BadPlan: it greets otherwise than
        its wire says.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self._seq = 0
        self._asked: deque[int] = deque()
        """The numbers of the requests that have no reply yet."""
        self._fault = ""
        self._opened = ExitStack()
        self._socket = _open(address.url, self._opened)
        if address.wire.marks_episodes:
            self._asked.append(self._send("hello", {}))
        self.metadata: Mapping[Any, Any] = self._receive("hello", first=True)

    def start(self, task: str) -> None:
        """Say that an episode begins, where the wire has words for it. Raises: BadPlan."""
        if self.address.wire.marks_episodes:
            self._send("start", {"task": {"name": task}})

    def ask(self, request: Mapping[Any, Any]) -> None:
        """Send an observation. Raises: BadPlan."""
        while self._asked:  # of a batch that failed elsewhere
            self.answer()
        seq = self._send("observation", request)
        self._asked.append(seq)

    def answer(self) -> Mapping[Any, Any]:
        """The reply, its arrays built. Raises: BadPlan."""
        return self._receive("action")

    def close(self) -> None:
        """End the episode and the connection."""
        with suppress(Exception):
            if self.address.wire.marks_episodes and not self._fault:
                self._send("end", {})
            self._opened.close()

    def _send(self, kind: Kind, payload: Mapping[Any, Any]) -> int:
        self._seq += 1
        with self._checked():
            message = Message(kind, dict(payload), {"seq": self._seq})
            self._socket.send(self.address.wire.write(message))
        return self._seq

    def _receive(self, kind: Kind, first: bool = False) -> Mapping[Any, Any]:
        with self._checked():
            frame = self._socket.recv(timeout=REPLY_S)
            message = self.address.wire.read(frame, of_client=False, first=first)
            if message.kind == "error":
                said = str(message.payload.get("error", message.payload)).strip()
                last = said.splitlines()[-1:]  # of a traceback, the cause
                raise BadMessage(f"it answers with an error: {''.join(last):.300}")
            asked = self._asked.popleft() if self._asked else 0
            numbered = self.address.wire.marks_episodes
            if message.kind != kind or (numbered and message.seq != asked):
                raise BadMessage(f"{kind} {asked} was due, and {message.kind} {message.seq} came")
            found: Mapping[Any, Any] = decoded(message.payload)
            return found

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Inside, the wire is used; the first fault stays the cause. Raises: BadPlan."""
        from websockets.exceptions import ConnectionClosed

        try:
            if self._fault:
                raise BadMessage(self._fault)
            yield
        except (BadMessage, TimeoutError, ConnectionClosed, OSError, EOFError) as error:
            if not self._fault:
                self._fault = first_line(error) or type(error).__name__
                if isinstance(error, TimeoutError):
                    self._fault = f"no answer within {REPLY_S:g} s"
                with suppress(Exception):
                    self._opened.close()
            raise BadPlan(f"served: {self.address.url}: {self._fault:.400}.") from error


def _open(url: str, opened: ExitStack) -> "ClientConnection":
    """A socket, closed with `opened`, to a server that may just be starting.

    Raises: BadEndpoint.
    """
    from websockets.exceptions import InvalidHandshake
    from websockets.sync.client import connect

    for wait_s in (*TRIES_S, None):
        try:
            connecting = connect(
                url,
                compression=None,
                max_size=LARGEST_MESSAGE,
                additional_headers=authorization(),
                open_timeout=CONNECT_S,
                close_timeout=1.0,
                ping_interval=None,  # a server may not answer one while it computes
                proxy=None,
            )
            return opened.enter_context(connecting)
        except (OSError, InvalidHandshake, EOFError) as error:
            if wait_s is None or isinstance(error, InvalidHandshake):
                raise BadEndpoint(
                    f"served: {url} cannot be reached ({type(error).__name__}: "
                    f"{first_line(error):.120}); start the policy server, or name its address. A "
                    f"token that it wants stands in {TOKEN}."
                ) from error
            time.sleep(wait_s)
    raise AssertionError


class Session:
    """What an episode carries: its connection, which is closed with it."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        weakref.finalize(self, connection.close)

    def __deepcopy__(self, _: object) -> "Session":
        return self


class Served:
    """A frozen policy over a wire (policies.protocol.Policy).

    Raises: BadEndpoint: the server is not there; BadPolicy: it and the map do not fit the suite.
    """

    def __init__(self, address: Address, scene: AnyScene, suite: Suite) -> None:
        self.address = address
        self.label = address.label
        self.execute = 1 if address.wire.by_step else address.map.execute
        self._names = open_env(scene, scene.cameras, control=suite.control).action_names
        self._down = scene.robot.down_base
        self._origin_m = getattr(scene, "origin_m", (0.0, 0.0, 0.0))
        connection = Connection(address)
        connection.close()
        address.map.check(suite.cameras, self._names, connection.metadata)

    def start(self, rng: np.random.Generator) -> Session:
        connection = Connection(self.address)
        connection.start(self.address.map_name)
        return Session(connection)

    def plan(
        self, states: Sequence[Session], inputs: Sequence[PolicyInput]
    ) -> tuple[list[Session], list[Chunk]]:
        """Every request is sent before the first reply is waited for. Raises: BadPlan."""
        asked = self.address.map
        for i, (session, given) in enumerate(zip(states, inputs, strict=True)):
            for camera in asked.by_camera(list(given.images)):
                report_input(i, camera, given.images[camera])
            report_input(i, TEXT, given.text)
            session.connection.ask(asked.request(given, self._down, self._origin_m))
        chunks = []
        for session, given in zip(states, inputs, strict=True):
            reply = at(session.connection.answer(), asked.reply)
            try:
                chunks.append(asked.chunk(reply, given, self._names))
            except BadMessage as error:
                raise BadPlan(str(error)) from error
        return list(states), chunks


def served_for_suite(name: str, scene: AnyScene, suite: Suite) -> Served:
    """The policy at an address. Raises: as `Served`; UnknownName, BadPolicy for the address."""
    return Served(parse_address(name), scene, suite)
