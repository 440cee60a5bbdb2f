"""A server of either wire on this machine, and our policies behind it.

It listens on 127.0.0.1 unless another address is named, which needs a token. A web page cannot
connect: browsers name their origin, and none is let in.
"""

import asyncio
import hmac
import os
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import numpy as np
from websockets.asyncio.server import Request, Response, ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from vap_core.base.errors import BadEndpoint, VapError, first_line
from vap_core.policies.protocol import Policy, PolicyInput
from vap_core.policies.wire_map import FORMATS, WireMap
from vap_core.policies.wires import (
    LARGEST_MESSAGE,
    TOKEN,
    Frame,
    Message,
    Wire,
    authorization,
    decoded,
    put,
)

LOCAL = ("127.0.0.1", "localhost", "::1")
WAITING = 4
"""Messages of one client that wait; a client that sends more is slowed down."""
BROKEN, AWAY = 1011, 1013
"""Close codes: a fault on this side, and "try again later"."""
RESET = "reset successful"
"""RoboArena's reply to a reset, a text that is no error."""

type Handler = Callable[[ServerConnection], Awaitable[None]]


async def listen(
    handler: Handler, wire: Wire, port: int, host: str, ready: Callable[[int], None]
) -> None:
    """Serve until SIGINT or SIGTERM; `ready` gets the port, which the system chooses for 0.

    Raises: BadEndpoint: the port is taken, or another host than this one is named without a token.
    """
    wanted = authorization().get("Authorization", "")
    if host not in LOCAL and not wanted:
        raise BadEndpoint(
            f"serve: {host} can be reached from other machines; set {TOKEN} to a secret that "
            "clients send (Authorization: Api-Key ...), or leave --host out."
        )

    def admit(connection: ServerConnection, request: Request) -> Response | None:
        if request.path == wire.health:
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "")
        if wanted and not hmac.compare_digest(given.encode(), wanted.encode()):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "a token is wanted\n")
        return None

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        with suppress(NotImplementedError, RuntimeError, ValueError):  # not in a thread
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    try:
        server = await serve(
            handler,
            host,
            port,
            process_request=admit,
            compression=None,
            max_size=LARGEST_MESSAGE,
            max_queue=WAITING,
            origins=[None],
            ping_interval=None,
            close_timeout=1,
            server_header=None,
        )
    except OSError as error:
        raise BadEndpoint(
            f"serve: port {port} of {host} cannot be used ({error.strerror}); choose another with "
            "--port."
        ) from error
    async with server:
        ready(next(iter(server.sockets)).getsockname()[1])
        await stopped.wait()


class PolicyServer:
    """One of our policies, behind a wire: what a client calls things is in the map.

    Numbers of the state and of the actions are the policy's own. Calls run one after the other.
    """

    def __init__(self, policy: Policy[Any], convention: WireMap, cameras: Sequence[str]) -> None:
        self.policy = policy
        self.map = convention
        self.cameras = tuple(cameras)
        convention.by_camera(cameras)
        self._calls = ThreadPoolExecutor(1, "policy")
        self._episodes = 0

    async def __call__(self, socket: ServerConnection, wire: Wire) -> None:
        """One client: episodes one after the other."""
        state: Any = None
        queue: deque[np.ndarray] = deque()
        if not wire.marks_episodes:
            await socket.send(wire.write(Message("hello", self._metadata(wire))))
        with suppress(ConnectionClosed):
            async for frame in socket:
                around: dict[str, Any] = {}
                try:
                    message = wire.read(frame, of_client=True)
                    around = {"seq": message.seq}
                    if message.kind == "hello":
                        reply = Message("hello", self._metadata(wire), around)
                        await socket.send(wire.write(reply))
                    elif message.kind in ("start", "end"):
                        state = None
                        queue.clear()
                        if message.kind == "start":
                            state = self._start(message)
                            if not wire.marks_episodes:
                                await socket.send(RESET)
                    elif message.kind == "observation":
                        given = self.map.observation(decoded(message.payload), self.cameras)
                        state = self._start(message) if state is None else state
                        if not queue:
                            state, chunk = await self._plan(state, given)
                            queue.extend(chunk[: self.policy.execute])
                        actions: Any = queue.popleft() if wire.by_step else np.stack(queue)
                        if not wire.by_step:
                            queue.clear()
                        payload = put({}, self.map.reply, actions)
                        await socket.send(wire.write(Message("action", payload, around)))
                except ConnectionClosed:
                    raise
                except Exception as error:  # one client's fault is no other's
                    await socket.send(fault(wire, error, around))

    def _metadata(self, wire: Wire) -> dict[str, Any]:
        """What the server says of itself."""
        about: dict[str, Any] = {"model_server": self.policy.label, "cameras": list(self.cameras)}
        if wire.by_step:
            parts = {part: FORMATS[part] for part in self.map.actions if part in FORMATS}
            specs = {part: {"name": part, "dims": 0, "format": f} for part, f in parts.items()}
            raw = {"name": "actions", "dims": 0, "format": "raw"}
            about["action_spec"] = specs or {"actions": raw}
        return about

    def _start(self, message: Message) -> Any:
        """A new episode's state; its noise is that of the episode's number, where one is given."""
        task = message.payload.get("task")
        number = task.get("episode_idx") if isinstance(task, dict) else None
        number = number if isinstance(number, int) and number >= 0 else self._episodes
        self._episodes += 1
        return self.policy.start(np.random.default_rng([0, number]))

    async def _plan(self, state: Any, given: PolicyInput) -> tuple[Any, np.ndarray]:
        def call() -> tuple[Any, np.ndarray]:
            (after,), (chunk,) = self.policy.plan([state], [given])
            return after, chunk

        return await asyncio.get_running_loop().run_in_executor(self._calls, call)


def fault(wire: Wire, error: BaseException, around: dict[str, Any]) -> Frame:
    """The message of an error; what is no remedy of ours is named by its kind alone."""
    said = str(error) if isinstance(error, VapError) else f"{type(error).__name__}: "
    if not isinstance(error, VapError):
        said += first_line(error)[:200]
    return wire.write(Message("error", {"error": said}, around))


def cores() -> int:
    """How many threads may compute at once."""
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
