"""What the proxy adds to a call (`bench proxy`): the real command between clients and a stand-in
for a served policy that takes its time.

The pictures are those of four episodes of the expert, 256 px, every other control step a call.
"""

import asyncio
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.server import ServerConnection
from websockets.sync.client import connect

from vap_core.attend import Attender
from vap_core.base.types import Views
from vap_core.memory import load_bank
from vap_core.perception.stacks import load_stack
from vap_core.policies.scripted.expert import Expert
from vap_core.policies.wires import WIRES, node_of, pack
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters import generic
from vap_core.serve.proxy import Options, Stream
from vap_core.serve.server import listen
from vap_core.simulation import suites
from vap_core.simulation.suites.open_row import build_scene, models_of
from vap_core.study.measurement import Row
from vap_core.study.trials import Study, register_personal

SUITE, TASK = "vlabench", "select-cat-figurine"
SIDE_PX, EVERY, EPISODES = 256, 2, 4
CAMERAS = (("front",), ("front", "wrist"))
CLIENTS = (1, 4, 16)
POLICY_S = 0.1
"""What a served pi0.5 takes for a call, about."""


type Call = tuple[Views, np.ndarray, str]


def episodes(folder: Path, n: int) -> list[list[Call]]:
    """Views, state and command of every call of some episodes; their object is remembered."""
    study = Study(((SUITE, TASK),), ("vap",), episodes=n)
    rows = study.rows(SUITE, TASK)
    register_personal(study, folder)
    suite = suites.suite(SUITE)
    found = []
    with build_scene(SUITE, models_of(rows), rows[0].variant) as scene:
        trial = Trial(
            method="generic",
            scene=scene,
            policy=Expert(),
            prompter=generic(),
            control=suite.control,
            images_every=EVERY,
            image_size=SIDE_PX,
        )
        for done in rollout(trial, rows, keep_images=True):
            seen = [f for f in done.frames if f.images and f.frame_index % EVERY == 0]
            text = done.header.instruction
            found.append([(frame.images, frame.state, text) for frame in seen])
    return found


def payload(views: Views, cameras: Sequence[str], state: np.ndarray, text: str) -> dict[str, Any]:
    found: dict[str, Any] = {name: node_of(views[name], str.encode) for name in cameras}
    return found | {"state": node_of(state, str.encode), "prompt": text}


def alone(folder: Path, quick: bool) -> list[Row]:
    """Milliseconds of the parts in one process, without a socket."""
    played = episodes(folder, 1 if quick else EPISODES)
    models = load_stack("embedded")
    attender = Attender(models, load_bank(folder, models.encoder.name))
    rows: list[Row] = []
    for cameras in CAMERAS:
        parts: list[dict[str, float]] = []
        for n, calls in enumerate([played[0], *played]):
            stream = Stream(attender, partial(next, count()), Options(new_episode="prompt"))
            for views, state, text in calls:
                began = time.process_time()
                _, found = stream.prompt(payload(views, cameras, state, text))
                cpu = time.process_time() - began
                if n:  # the first is warm-up
                    parts.append({**found.seconds, "cpu": cpu, "first": not found.call})
        for first in (True, False):
            of = [part for part in parts if part["first"] == first]
            row: Row = {
                "cameras": len(cameras),
                "call": "first" if first else "later",
                "n": len(of),
            }
            for name in ("decode", "attend", "encode", "cpu"):
                row[f"{name} p50"] = 1e3 * float(np.median([part[name] for part in of]))
            row["cpu p95"] = 1e3 * float(np.percentile([part["cpu"] for part in of], 95))
            rows.append(row)
    return rows


def between(folder: Path, quick: bool) -> list[Row]:
    """What a client waits beyond the policy's time, by clients at once and cameras."""
    played = episodes(folder, 1 if quick else EPISODES)
    rows: list[Row] = []
    with policy_server() as behind, proxy(folder, behind) as through:
        for cameras in CAMERAS:
            frames = [
                [pack(payload(v, cameras, state, text), str.encode) for v, state, text in calls]
                for calls in played
            ]
            direct, _ = waits(behind, frames[:1], 1)
            waits(through, frames[:1], 1)  # warm
            for clients in CLIENTS[: 1 if quick else None]:
                later, first = waits(through, frames, clients)
                added = 1e3 * (later - np.median(direct))
                rows.append(
                    {
                        "cameras": len(cameras),
                        "clients": clients,
                        "n": len(added),
                        "first call ms": 1e3 * float(np.median(first - np.median(direct))),
                        "added p50 ms": float(np.median(added)),
                        "added p95 ms": float(np.percentile(added, 95)),
                        "of the direct call": float(np.median(later) / np.median(direct)),
                    }
                )
    return rows


def waits(
    url: str, frames: Sequence[Sequence[bytes]], clients: int
) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of the later calls, and of the first ones, of so many clients at once.

    Each plays all episodes, on a connection each; clients begin with different ones.
    """
    later: list[float] = []
    first: list[float] = []

    def play(client: int) -> None:
        for n in range(len(frames)):
            with connect(url, compression=None, max_size=None) as socket:
                socket.recv()
                for call, frame in enumerate(frames[(n + client) % len(frames)]):
                    began = time.perf_counter()
                    socket.send(frame)
                    answer = socket.recv()
                    assert isinstance(answer, bytes), answer
                    (later if call else first).append(time.perf_counter() - began)

    threads = [threading.Thread(target=play, args=(client,)) for client in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return np.array(later), np.array(first)


@contextmanager
def policy_server() -> Iterator[str]:
    """A stand-in for a policy on a GPU elsewhere: it waits, and takes no time of this machine."""
    loop, ports, ready = asyncio.new_event_loop(), [], threading.Event()
    answer = pack({"actions": np.zeros((5, 7))}, str.encode)

    async def behave(socket: ServerConnection) -> None:
        await socket.send(pack({}, str.encode))
        async for _ in socket:
            await asyncio.sleep(POLICY_S)
            await socket.send(answer)

    def told(port: int) -> None:
        ports.append(port)
        ready.set()

    task = loop.create_task(listen(behave, WIRES["openpi"], 0, "127.0.0.1", told))
    thread = threading.Thread(target=lambda: loop.run_until_complete(asyncio.wait([task])))
    thread.start()
    ready.wait()
    try:
        yield f"ws://127.0.0.1:{ports[0]}"
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


@contextmanager
def proxy(memory: Path, behind: str) -> Iterator[str]:
    """The real command, in a process of its own."""
    words = ["serve", "--upstream", behind, "--memory", str(memory), "--port", "0"]
    words += ["--new-episode", "connection"]
    with ExitStack() as stack:
        process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-m", "vap_core", *words],
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        )
        stack.callback(process.terminate)
        assert process.stdout is not None
        told = next(line for line in process.stdout if "serving" in line)
        yield "ws://" + told.rpartition("ws://")[2].split()[0]
