"""Served policies and the prompting proxy over real sockets: what passes, what starts an episode,
and every fault of a wire."""

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests.command import vap
from tests.toys import TOYS, personal, scene
from vap_core.attend import Attender
from vap_core.base.errors import BadEndpoint, BadPlan, NothingPersonal, VapError
from vap_core.policies import served
from vap_core.policies.protocol import PolicyInput
from vap_core.policies.served import Connection, parse_address
from vap_core.policies.wire_map import MAPS
from vap_core.policies.wires import TOKEN, WIRES, Message, decoded, node_of, pack, unpack
from vap_core.rollout.prompters import unchanged
from vap_core.serve.proxy import Keeper, Options, Proxy, find_pictures
from vap_core.serve.records import Records
from vap_core.serve.server import PolicyServer, listen
from vap_core.study import store
from vap_core.study.steps import query

GREY, TEAL, SAND = (90, 90, 90), (40, 120, 110), (150, 140, 130)
MEMORY = {"mug": personal("mug", "cup", TEAL, TEAL, TEAL)}
OPENPI, VLA_EVAL = WIRES["openpi"], WIRES["vla-eval"]
ACTIONS = np.arange(14, dtype=np.float64).reshape(2, 7)
COMMAND, REWRITTEN = "bring my cup", "bring the red cup"


def line(x: int = 24) -> np.ndarray:
    return scene([(4, 20, GREY), (x, 20, TEAL), (44, 20, SAND)])


def attender() -> Attender:
    return Attender(TOYS, MEMORY)


@contextmanager
def running(main: Callable[[Callable[[int], None]], Awaitable[None]]) -> Iterator[int]:
    """Inside, a server answers from a thread of its own; gives its port."""
    loop, began, ports = asyncio.new_event_loop(), threading.Event(), []

    def ready(port: int) -> None:
        ports.append(port)
        began.set()

    task = loop.create_task(main(ready))

    def go() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            began.set()

    thread = threading.Thread(target=go)
    thread.start()
    began.wait(10)
    try:
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(10)
        loop.close()


def ours(handler: Any, wire: Any = OPENPI) -> Any:
    return running(partial(listen, partial(handler, wire=wire), wire, 0, "127.0.0.1"))


type Behaviour = Callable[[ServerConnection], Awaitable[None]]


@contextmanager
def stand_in(behaviour: Behaviour, port: int = 0) -> Iterator[int]:
    async def main(ready: Callable[[int], None]) -> None:
        limits = {"max_size": None, "compression": None, "close_timeout": 0.2}
        async with serve(behaviour, "127.0.0.1", port, **limits) as server:
            ready(next(iter(server.sockets)).getsockname()[1])
            await asyncio.Future()

    with running(main) as there:
        yield there


class Upstream:
    """A policy server that keeps every frame it got and answers ACTIONS."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    async def openpi(self, socket: ServerConnection) -> None:
        await socket.send(pack({"server": "stand-in"}, str.encode))
        async for frame in socket:
            self.frames.append(frame)  # type: ignore[arg-type]
            reset = unpack(frame).get("endpoint") == "reset"  # type: ignore[arg-type]
            await socket.send("reset successful" if reset else reply())

    async def vla_eval(self, socket: ServerConnection) -> None:
        async for frame in socket:
            message = VLA_EVAL.read(frame, of_client=True)
            self.frames.append(frame)  # type: ignore[arg-type]
            around = {"seq": message.seq}
            if message.kind == "hello":
                await socket.send(VLA_EVAL.write(Message("hello", {}, around)))
            elif message.kind == "observation":
                payload = {"actions": ACTIONS[0]}
                await socket.send(VLA_EVAL.write(Message("action", payload, around)))


def reply() -> bytes:
    return pack({"actions": ACTIONS, "server_timing": {"infer_ms": 1.5}}, str.encode)


def observation(rgb: np.ndarray, text: str = COMMAND, **more: Any) -> dict[str, Any]:
    state = np.array([0.1, 0.2, 0.3])
    return {"observation/image": rgb, "observation/state": state, "prompt": text, **more}


def ask(client: ClientConnection, payload: dict[str, Any]) -> Any:
    client.send(pack(payload, str.encode))
    return client.recv(5)


@contextmanager
def proxied(
    keeper: Keeper | None = None, dry: bool = False, **options: Any
) -> Iterator[tuple[Upstream, Callable[[], ClientConnection]]]:
    """A proxy between a stand-in server and clients that the caller makes."""
    upstream, models = Upstream(), None if dry else attender()
    with ExitStack() as stack:
        behind = stack.enter_context(stand_in(upstream.openpi))
        url = f"ws://127.0.0.1:{behind}"
        proxy = Proxy(url, models, Options(**options), keeper or Keeper())
        port = stack.enter_context(ours(proxy))

        def client() -> ClientConnection:
            socket = stack.enter_context(connect(f"ws://127.0.0.1:{port}", compression=None))
            assert unpack(socket.recv(5)) == {"server": "stand-in"}  # type: ignore[arg-type]
            return socket

        yield upstream, client


def test_pictures_and_command_are_prompted_and_nothing_else() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(3, 4)
    chw = np.ascontiguousarray(line(30).transpose(2, 0, 1))[None]
    sent = observation(line(), extra=[1, b"x", None], depth=depth, deep={"wrist": chw})
    with proxied() as (upstream, client):
        assert ask(client(), sent) == reply()
        (frame,) = upstream.frames
        got = decoded(unpack(frame))
    _, wanted = attender().start({"image": line(), "wrist": line(30)}, COMMAND)
    assert got["prompt"] == REWRITTEN
    assert_array_equal(got["observation/image"], wanted.images["image"])
    assert_array_equal(got["deep"]["wrist"][0].transpose(1, 2, 0), wanted.images["wrist"])
    assert (got["observation/image"] != line()).any()
    rest = ("observation/state", "extra", "depth")
    assert list(got) == list(sent)
    for name in rest:
        assert pack({"": got[name]}, str.encode) == pack({"": sent[name]}, str.encode)


@pytest.mark.parametrize("dry", [False, True])
def test_what_is_not_to_be_prompted_passes_as_the_same_bytes(dry: bool) -> None:
    payload = observation(line(), COMMAND if dry else "bring a cup")
    with proxied(dry=dry) as (upstream, client):
        ask(client(), payload)
        assert upstream.frames == [pack(payload, str.encode)]


def test_a_step_tracks_and_a_repeated_request_is_answered_alike() -> None:
    with proxied() as (upstream, client):
        socket = client()
        for x in (24, 26, 26, 28):
            ask(socket, observation(line(x)))
        got = [decoded(unpack(frame))["observation/image"] for frame in upstream.frames]
    models = attender()
    state, first = models.start({"image": line(24)}, COMMAND)
    state, second = models.step(state, {"image": line(26)})
    _, third = models.step(state, {"image": line(28)})
    for shown, attended in zip(got, (first, second, second, third), strict=True):
        assert_array_equal(shown, attended.images["image"])


class Starts(Keeper):
    def __init__(self) -> None:
        self.why: list[str] = []

    def observed(self, stream: object, found: Any) -> None:
        if found.call == 0:
            self.why.append(found.starts.split(",")[0].split(";")[0])


def drive(socket: ClientConnection, n: int = 5, shift: float = 0.0, **more: Any) -> None:
    """An episode of a robot that goes away from where it began."""
    for i in range(n):
        state = np.array([0.1, 0.2, 0.3]) + 0.05 * i + shift
        payload = observation(line(24 + i), **more) | {"observation/state": state}
        assert isinstance(ask(socket, payload), bytes)


FIRST = "the first observation of the connection"
BACK = "the robot is back where the episode began"


@pytest.mark.parametrize(
    ("mode", "again"), [("auto", [BACK]), ("prompt", []), ("connection", []), ("never", [])]
)
def test_a_robot_that_is_put_back_starts_an_episode_and_is_told(mode: str, again: list) -> None:
    starts = Starts()
    with proxied(starts, new_episode=mode) as (_, client):
        socket = client()
        drive(socket)
        drive(socket)
    assert starts.why == [FIRST, *again]


def test_another_command_connection_session_or_reset_starts_an_episode() -> None:
    starts = Starts()
    with proxied(starts) as (_, client):
        one, other = client(), client()
        drive(one)
        drive(other)
        drive(one, text="take my cup", shift=0.2)
        drive(one, text="take my cup", session_id="b")
        assert ask(one, {"endpoint": "reset"}) == "reset successful"
        drive(one, text="take my cup", shift=0.4)
    assert starts.why == [FIRST, FIRST, "another command", FIRST, "the client says so"]


def test_a_jump_of_every_view_starts_an_episode() -> None:
    starts = Starts()
    with proxied(starts) as (_, client):
        socket = client()
        for x in (20, 21, 22, 23):
            ask(socket, {"image": line(x), "prompt": COMMAND})
        ask(socket, {"image": np.roll(line(20), 30, axis=0), "prompt": COMMAND})
    assert starts.why == [FIRST, "every view changes at once (12 levels)"] or len(starts.why) == 2


PICTURE = node_of(line(), str.encode)
REFUSED = [
    ({"prompt": COMMAND}, "no picture of uint8"),
    ({"image": line() / np.float32(255), "prompt": COMMAND}, "is a picture of float32"),
    ({"image": np.stack([line(), line()]), "prompt": COMMAND}, "several moments"),
    ({"image": [line(), line()], "prompt": COMMAND}, "several moments"),
    ({"image": line()}, "no command among"),
    ({"image": line(), "prompt": "bring my hat"}, "hat"),
    ({"image": line(), "prompt": 3}, "no command among"),
    ({"image": {**PICTURE, b"shape": [9, 9, 3]}, "prompt": COMMAND}, "say that they are"),
    ({"image": {**PICTURE, b"dtype": "|O"}, "prompt": COMMAND}, "an array of type"),
]


def test_what_cannot_be_prompted_is_refused_and_never_passed_on() -> None:
    with proxied() as (upstream, client):
        socket = client()
        for payload, words in REFUSED:
            said = ask(socket, payload)
            assert isinstance(said, str)
            assert words in said, (words, said)
        socket.send(b"\xc1")
        assert "no message in msgpack" in socket.recv(5)  # type: ignore[operator]
        assert upstream.frames == []
        ask(socket, observation(line()))  # the connection goes on
        assert len(upstream.frames) == 1
        ask(socket, observation(line(25)[:40]))  # another size within an episode
        assert len(upstream.frames) == 1
    with proxied(new_episode="connection") as (upstream, client):
        socket = client()
        ask(socket, observation(line()))
        assert "the command changed" in ask(socket, observation(line(), "take my cup"))
    with proxied(cameras=("observation/wrist",)) as (upstream, client):
        assert "there is no picture observation/wrist" in ask(client(), observation(line()))


def test_cameras_can_be_named() -> None:
    payload = {"a": {"b": PICTURE}, "c": PICTURE}
    assert list(find_pictures(payload, ("a/b",))) == [("a", "b")]
    assert list(find_pictures(payload)) == [("a", "b"), ("c",)]


def test_vla_evals_wire_through_the_proxy() -> None:
    upstream = Upstream()
    with stand_in(upstream.vla_eval) as behind:
        proxy = Proxy(f"ws://127.0.0.1:{behind}", attender(), Options(), Keeper())
        with ours(proxy, VLA_EVAL) as port, connect(f"ws://127.0.0.1:{port}") as socket:
            payload = {"images": {"primary": line()}, "task_description": COMMAND}
            messages = [
                Message("hello", {}, {"seq": 1}),
                Message("start", {"task": {"name": "x"}}, {"seq": 2}),
                Message("observation", payload, {"seq": 3, "timestamp": 1.0}),
            ]
            for message in messages:
                socket.send(VLA_EVAL.write(message))
            assert VLA_EVAL.read(socket.recv(5), of_client=False).kind == "hello"
            answer = VLA_EVAL.read(socket.recv(5), of_client=False)
            assert (answer.kind, answer.seq) == ("action", 3)
            socket.send(VLA_EVAL.write(Message("observation", {"images": {}}, {"seq": 4})))
            refused = VLA_EVAL.read(socket.recv(5), of_client=False)
            assert (refused.kind, refused.seq) == ("error", 4)
    got = [VLA_EVAL.read(frame, of_client=True) for frame in upstream.frames]
    assert [message.kind for message in got] == ["hello", "start", "observation"]
    assert decoded(got[2].payload)["task_description"] == REWRITTEN
    assert got[2].around["timestamp"] == 1.0


def test_a_server_behind_that_is_away_or_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vap_core.serve.proxy.TRIES_S", (0.01,))
    proxy = Proxy("ws://127.0.0.1:9", attender(), Options(), Keeper())
    with (
        ours(proxy) as port,
        connect(f"ws://127.0.0.1:{port}") as socket,
        pytest.raises(ConnectionClosed) as closed,
    ):
        socket.recv(5)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1013
    assert "cannot be reached" in closed.value.rcvd.reason

    async def leaves(socket: ServerConnection) -> None:
        await socket.send(pack({}, str.encode))
        await socket.recv()
        await socket.close(4000, "out of memory")

    with stand_in(leaves) as behind:
        proxy = Proxy(f"ws://127.0.0.1:{behind}", attender(), Options(), Keeper())
        with ours(proxy) as port, connect(f"ws://127.0.0.1:{port}") as socket:
            socket.recv(5)
            socket.send(pack(observation(line()), str.encode))
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv(5)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.reason == "upstream closed (4000: out of memory)"


def test_one_clients_end_is_no_others() -> None:
    with proxied() as (upstream, client):
        one, other = client(), client()
        ask(one, observation(line()))
        one.socket.close()  # without a close frame, as a process that is killed
        for x in (24, 25, 26):
            assert ask(other, observation(line(x))) == reply()
        assert len(upstream.frames) == 4


def test_a_token_and_an_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN, "secret")
    server = PolicyServer(Countdown(), MAPS["ours"], ["front"])
    with ours(server) as port:
        url = f"ws://127.0.0.1:{port}"
        with urlopen(f"http://127.0.0.1:{port}/healthz") as answer:
            assert answer.read() == b"OK\n"
        key = {"Authorization": "Api-Key secret"}
        for headers, origin, status in ((None, None, 401), (key, "https://evil.example", 403)):
            with pytest.raises(InvalidStatus) as refused:
                connect(url, additional_headers=headers, origin=origin)  # type: ignore[arg-type]
            assert refused.value.response.status_code == status
        Connection(parse_address(url)).close()  # it sends the token
        monkeypatch.delenv(TOKEN)
        with pytest.raises(BadEndpoint, match="HTTP 401.*VAP_TOKEN"):
            Connection(parse_address(url))
    with pytest.raises(BadEndpoint, match="set VAP_TOKEN to a secret"):
        asyncio.run(listen(server, OPENPI, 0, "0.0.0.0", print))  # type: ignore[arg-type]
    with stand_in(Upstream().openpi) as taken, pytest.raises(BadEndpoint, match="cannot be used"):
        asyncio.run(listen(server, OPENPI, taken, "127.0.0.1", print))  # type: ignore[arg-type]


class Countdown:
    """A policy whose state counts its calls; its action is that count, then the state's numbers."""

    label, execute = "countdown", 2

    def start(self, rng: np.random.Generator) -> int:
        return 0

    def plan(self, states: Any, inputs: Any) -> Any:
        if inputs[0].text == "fail":
            raise RuntimeError("no such thing\nsecond line")
        rows = [np.append(np.float32(n), each.state[:6]) for n, each in zip(states, inputs)]  # noqa: B905
        return [n + 1 for n in states], [np.stack([row, row + 1, row + 2]) for row in rows]


GIVEN = PolicyInput({"front": line()}, COMMAND, np.arange(13, dtype=np.float32))
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize("wire", ["openpi", "vla-eval"])
def test_our_policies_behind_a_wire(wire: str) -> None:
    name = {"openpi": "ours", "vla-eval": "ours-vla-eval"}[wire]
    server = PolicyServer(Countdown(), MAPS[name], ["front"])
    with ours(server, WIRES[wire]) as port:
        address = parse_address(f"ws://127.0.0.1:{port}?map={name}")
        connection = Connection(address)
        assert connection.metadata["model_server"] == "countdown"
        connection.start("x")
        got = []
        for _ in range(3):
            connection.ask(address.map.request(GIVEN, DOWN))
            got.append(np.atleast_2d(connection.answer()["actions"])[:, 0].tolist())
        by_call, by_step = [[0, 1], [1, 2], [2, 3]], [[0], [1], [1]]
        assert got == (by_step if wire == "vla-eval" else by_call)
        connection.ask({})
        with pytest.raises(BadPlan, match="wire map: .* has nothing where a picture"):
            connection.answer()


def test_robo_arenas_reset_and_a_policy_that_fails() -> None:
    server = PolicyServer(Countdown(), MAPS["ours"], ["front"])
    with ours(server) as port, connect(f"ws://127.0.0.1:{port}") as socket:
        socket.recv(5)
        request = MAPS["ours"].request(GIVEN, DOWN)
        for _ in range(2):
            last = decoded(unpack(ask(socket, request)))["actions"][0, 0]
        assert last == 1
        assert ask(socket, {"endpoint": "reset"}) == "reset successful"
        assert decoded(unpack(ask(socket, request)))["actions"][0, 0] == 0
        assert ask(socket, {**request, "prompt": "fail"}) == "RuntimeError: no such thing"


def answering(*frames: Any) -> Behaviour:
    """A server that answers requests with these, and then closes; a number is a pause in seconds."""

    async def behave(socket: ServerConnection) -> None:
        await socket.send(pack({}, str.encode))
        for frame in frames:
            await socket.recv()
            if isinstance(frame, float):
                await asyncio.sleep(frame)
            elif frame is not None:
                await socket.send(frame)
            else:
                socket.transport.abort()

    return behave


LIES = pack(
    {"actions": {b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [2**40]}}, str
)
FAULTS = [
    (answering(None), "the connection is closed|no close frame"),
    (answering(), "received 1000"),
    (answering(9.0), "no answer within 0.3 s"),
    (answering("Traceback ...\nValueError: too hot"), "answers with an error: .*too hot"),
    (answering(b"\xc1\xc1"), "no message in msgpack"),
    (answering(LIES), "0 bytes say that they are"),
    (answering(bytes(2**20)), "exceeds limit|too big"),
    (answering(*[pack({"actions": np.zeros((2, 5))}, str.encode)] * 2), "is 7 numbers"),
    (answering(*[pack({"actions": np.full((2, 7), np.nan)}, str.encode)] * 2), "finite numbers"),
    (answering(*[pack({"actions": "go"}, str.encode)] * 2), "finite numbers"),
    (answering(*[pack({}, str.encode)] * 2), "has nothing where"),
]


@pytest.mark.parametrize(("behaviour", "words"), FAULTS, ids=range(len(FAULTS)))
def test_a_fault_of_the_wire_ends_the_episode_with_its_cause(
    behaviour: Behaviour, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(served, "REPLY_S", 0.3)
    monkeypatch.setattr(served, "LARGEST_MESSAGE", 2**19)
    with stand_in(behaviour) as port:
        policy = policy_at(port)
        state = policy.start(np.random.default_rng(0))
        for _ in range(2):  # asked again, as after a batch that failed, the cause is the same
            with pytest.raises(BadPlan, match=words):
                policy.plan([state], [GIVEN])


def policy_at(port: int) -> served.Served:
    policy = object.__new__(served.Served)
    policy.address = parse_address(f"ws://127.0.0.1:{port}")
    policy._names, policy._down = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper"), DOWN
    policy._origin_m = (0.0, 0.0, 0.0)
    return policy


def test_a_batch_in_which_one_fails_leaves_the_others_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    replies = [pack({"actions": np.full((1, 7), n)}, str.encode) for n in range(3)]
    with stand_in(answering(*replies)) as good, stand_in(answering("broken")) as bad:
        policy = policy_at(good)
        one, other = (
            policy.start(np.random.default_rng(0)),
            policy_at(bad).start(np.random.default_rng(0)),
        )
        with pytest.raises(BadPlan, match="broken"):
            policy.plan([other, one], [GIVEN, GIVEN])
        for wanted in (1, 2):  # the first reply was to the batch
            _, (chunk,) = policy.plan([one], [GIVEN])
            assert chunk[0, 0] == wanted


def test_a_server_that_is_started_again_is_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(Upstream().openpi) as port:
        policy_at(port).start(np.random.default_rng(0))
    later = threading.Timer(0.5, lambda: None)
    later.start()
    with ExitStack() as stack:
        opened = threading.Timer(
            0.4, lambda: stack.enter_context(stand_in(Upstream().openpi, port))
        )
        opened.start()
        state = policy_at(port).start(np.random.default_rng(0))
        _, (chunk,) = policy_at(port).plan([state], [GIVEN])
        opened.join()
    assert chunk.shape == (2, 7)
    monkeypatch.setattr(served, "TRIES_S", ())
    with pytest.raises(BadEndpoint, match="cannot be reached .*; start the policy server"):
        policy_at(port).start(np.random.default_rng(0))


def test_records_are_recordings_and_rows_to_query(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from vap_core.recording import read_summary

    out = tmp_path / "served"
    about = {"method": "vap", "policy": "ws://127.0.0.1:1", "wire": "openpi"}
    for expected in (2, 4):  # a server that is started again goes on in the folder
        with proxied(Records(out, MEMORY, about)) as (_, client):
            socket = client()
            drive(socket)
            drive(socket, text="bring a cup")
            socket.close()
            time.sleep(0.3)
        episodes = store.read(out)
        assert len(episodes) == expected
    assert episodes["episode"].tolist() == [1, 3, 0, 2]
    assert set(episodes["outcome"]) == {"unknown"}
    assert episodes["rewritten"].tolist() == ["bring a cup"] * 2 + [REWRITTEN] * 2
    assert episodes["views_found"].tolist() == [0, 0, 1, 1]
    found = query(out, "select task, count(*) as n from steps group by task order by task")
    assert found["n"].tolist() == [10, 10]
    recordings = sorted((out / "recordings").glob("*.rrd"))
    assert [path.name for path in recordings] == [
        *(f"served.bring-a-cup.00{n}.s0.vap.rrd" for n in (1, 3)),
        *(f"served.bring-my-cup.00{n}.s0.vap.rrd" for n in (0, 2)),
    ]
    assert read_summary(recordings[2])["frames"] == 5
    said = capsys.readouterr().err
    assert f"'{COMMAND}' -> '{REWRITTEN}'; image yes; starts: {FIRST}" in said
    assert "nothing personal: passed as it is" in said


def test_names_and_texts_from_outside_reach_no_terminal_and_stop_no_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    about = {"method": "vap", "policy": "ws://127.0.0.1:1", "wire": "openpi"}
    with proxied(Records(tmp_path / "run", MEMORY, about)) as (_, client):
        socket = client()
        for name in ("a b/\x1b[2J", "../..", "\udcff", ""):
            ask(socket, {f"observation/{name}": line(), "prompt": f"bring my cup \x1b]0;{name}"})
        for n in range(70):
            answer = ask(socket, {"image": line(), "prompt": COMMAND, "session_id": str(n)})
        assert "over 64 sessions" in answer
        socket.close()
        time.sleep(0.5)
    said = capsys.readouterr().err
    assert "nothing more is recorded" not in said
    assert len(store.read(tmp_path / "run")) == 4 + 63
    assert "\x1b" not in "".join(store.read(tmp_path / "run")["instruction"])


def test_actions_that_cannot_be_recorded_reach_the_client(tmp_path: Path) -> None:
    about = {"method": "vap", "policy": "ws://127.0.0.1:1", "wire": "openpi"}
    empty = pack({"actions": np.zeros((0, 7))}, str.encode)
    with stand_in(answering(empty, empty, empty)) as behind:
        records = Records(tmp_path / "run", MEMORY, about)
        proxy = Proxy(f"ws://127.0.0.1:{behind}", attender(), Options(), records)
        with ours(proxy) as port, connect(f"ws://127.0.0.1:{port}") as socket:
            socket.recv(5)
            for x in (24, 25, 26):
                assert ask(socket, observation(line(x))) == empty


def test_a_thousand_faults_tint_no_wrong_episode_and_pass_nothing_in_silence() -> None:
    """Whatever a client sends, the server behind gets what the method itself gives, or nothing."""
    rng, models = np.random.default_rng(7), attender()
    with proxied(new_episode="prompt") as (upstream, client):
        socket, state, before, text = client(), None, None, ""
        wanted: list[tuple[str, np.ndarray]] = []
        refused = 0
        for n in range(1000):
            said = COMMAND if rng.random() < 0.8 else ["take my cup", "bring my hat"][n % 2]
            rgb = line(int(rng.integers(18, 30)))
            frame = bytearray(pack(observation(rgb, said), str.encode))
            kind = rng.integers(6)
            if kind == 0:
                frame = frame[: rng.integers(1, len(frame))]
            elif kind == 1:  # one byte of the head, where keys, types and sizes stand
                frame[rng.integers(0, 60)] ^= 1 << int(rng.integers(8))
            elif kind == 2:
                frame[rng.integers(len(frame) - 120, len(frame))] ^= 1 << int(rng.integers(8))
            elif kind == 3:
                frame += bytes(rng.integers(0, 255, 3).tolist())
            try:
                got = decoded(unpack(bytes(frame)))
                pictures = find_pictures(unpack(bytes(frame)))
                ((_, picture),) = pictures.items()
                pixels = picture.rgb
                said = next(got[k] for k in ("prompt", "task") if isinstance(got.get(k), str))
                (name,) = (path[-1].rpartition("/")[2] for path in pictures)
                if text != said:
                    state, text, before = None, "", None
                    try:
                        state, attended = models.start({name: pixels}, said)
                    except NothingPersonal:
                        attended = unchanged({name: pixels}, said)
                elif state is None:
                    attended = unchanged({name: pixels}, said)
                elif before and name in before[1].images and (pixels == before[0]).all():
                    attended = before[1]
                else:
                    state, attended = models.step(state, {name: pixels})
                before, text = (pixels, attended), said
                wanted.append((attended.text, attended.images[name]))
                is_refused = False
            except (VapError, StopIteration, ValueError):
                is_refused = True
            socket.send(bytes(frame))
            answer = socket.recv(10)
            assert isinstance(answer, str) == is_refused, (n, kind, answer)
            refused += is_refused
        assert len(upstream.frames) == len(wanted) == 1000 - refused
        assert 300 < refused < 800
        for frame, (said, pixels) in zip(upstream.frames, wanted, strict=True):
            payload = unpack(frame)
            ((_, shown),) = find_pictures(payload).items()
            assert_array_equal(shown.rgb, pixels)
            assert said in payload.values()
            assert "my cup" not in said.lower()


def test_a_lerobot_checkpoint_of_liberos_shapes_behind_openpis_wire(tmp_path: Path) -> None:
    """lerobot's PI0 (tiny, random), two cameras, eight numbers of state, OSC's seven of action."""
    from vap_core.policies.lerobot.adapter import load_policy
    from vap_core.policies.lerobot.toy_pi0 import Toy, save_toy, toy_sizes
    from vap_core.rollout import rollout
    from vap_core.study.trials import Study, make_trial

    toy = Toy(image=32, layers=1, denoise=2)
    folder = save_toy(tmp_path / "libero", ("image", "image2"), 8, 7, toy)
    with toy_sizes(toy):
        policy = load_policy(folder, "cpu")
        server = PolicyServer(policy, MAPS["libero"], policy.cameras())
        with ours(server) as port:
            address = f"ws://127.0.0.1:{port}?map=libero"
            study = Study((("franka-pick", "pick-cup"),), ("generic",), episodes=1, policy=address)
            rows = study.rows("franka-pick", "pick-cup")
            trial = make_trial(study, rows, "generic", tmp_path / "memory")
            (episode,) = rollout(trial, rows)
    assert episode.outcome.status != "error", episode.outcome.detail
    assert episode.header.policy.startswith("openpi:127.0.0.1:")
    moved = np.stack([frame.action for frame in episode.frames if frame.action is not None])
    assert moved.shape[1] == 7
    assert 0 < np.abs(moved[:, :3]).max() < 0.05


def test_a_served_policy_keeps_the_contract() -> None:
    """That of every policy, for one behind openpi's wire."""
    from tests.contract import kept
    from vap_core.contracts import test_policy
    from vap_core.contracts.given import short_rows, trial_of
    from vap_core.simulation import suites

    where = "widowx-pick/pick-straw-cup"
    suite = suites.suite("widowx-pick")
    scene = trial_of(Reaching(), short_rows(where, 2)).scene
    with ours(PolicyServer(Reaching(), MAPS["ours"], suite.cameras)) as port:
        asked = served.served_for_suite(f"ws://127.0.0.1:{port}", scene, suite)
        kept(test_policy, policy=asked, where=where)
    scene.close()


class Reaching:
    """Moves by what it sees and where its hand is."""

    label, execute = "reaching", 2

    def start(self, rng: np.random.Generator) -> None:
        return None

    def plan(self, states: Any, inputs: Any) -> Any:
        chunks = []
        for each in inputs:
            seen = sum(float(rgb.mean()) for rgb in each.images.values()) / 255
            row = np.float32([0.01 * seen, 0.02 * each.state[1], -0.01, 0, 0, 0, 1])
            chunks.append(np.stack([row, row / 2]))
        return list(states), chunks


@pytest.mark.timeout(240)
def test_the_real_commands_give_what_the_policy_gives_in_process(tmp_path: Path) -> None:
    """eval through the proxy, generic, equals vap in process: episodes, outcomes, steps."""
    import subprocess
    import sys

    def server(*words: str) -> str:
        command = [sys.executable, "-m", "vap_core", "serve", *words, "--port", "0"]
        process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(process.communicate, timeout=30)  # what it prints at its end
        stack.callback(process.terminate)
        assert process.stdout is not None
        told = next(line for line in process.stdout if "serving" in line)
        processes.append(process)
        return "ws://" + told.rpartition("ws://")[2].split()[0]

    processes: list[subprocess.Popen[str]] = []
    common = ("--suite", "simpler-bridge", "--task", "put-owl-figurine", "--episodes", "1")
    common = (*common, "--workers", "1", "--record", "none")
    out, record = tmp_path / "through", tmp_path / "flight"
    vap("eval", *common, "--methods", "vap", "--out", str(tmp_path / "vap"))
    with ExitStack() as stack:
        behind = server("--policy", "mini-pi0", "--suite", "simpler-bridge")
        memory = str(tmp_path / "vap" / "memory")
        through = server("--upstream", behind, "--memory", memory, "--record", str(record))
        vap("eval", *common, "--policy", through, "--methods", "generic", "--out", str(out))
    assert [process.returncode for process in processes] == [0, 0]
    columns = ["episode", "outcome"]
    assert store.read(out)[columns].equals(store.read(tmp_path / "vap")[columns])
    assert len(store.read(record)) == 1
