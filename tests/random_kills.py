"""Work that SIGKILL ends at random moments.

`python -m tests.random_kills MODULES` imports them once, then forks a process for every piece of
work that it is asked for: a kill costs no second of imports.
"""

import json
import os
import random
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TextIO

LIMIT_S = 120.0
"""After which a piece of work counts as hung."""


def write_report(run: Path, out: Path) -> None:
    from vap_core.study.report import report

    report([run], out)


def ground(clip: Path, bank: Path, out: Path) -> None:
    from tests.toys import MeanColour, SameColour, detector, segmenter
    from vap_core.perception import stacks
    from vap_core.perception.protocols import Stack
    from vap_core.study.grounding import ground_clip

    stacks.STACKS["toy"] = lambda: Stack("toy", detector, MeanColour(), segmenter, SameColour())
    ground_clip(clip, "bring my cup", bank, "toy", out)


def replace_object(folder: Path) -> None:
    """The same object, imported again and again under its name."""
    from tests.test_scan_storage import METADATA, cube
    from vap_core.simulation.assets.scans import storage

    for _ in range(20):
        storage.save_scan(folder, METADATA, cube(), replace=True)


def train_policy(cache: Path, out: Path) -> None:
    from tests.test_policy_training import TINY
    from vap_make.films import demonstrations
    from vap_make.policy import train as policy

    demonstrations.EPISODES = 2
    policy.HELD_OUT = 9
    recipe = replace(TINY, stages=1, steps=6, batch=2, draws=1)
    policy.train(recipe, out, cache=cache, every=1)


def train_vlm(cache: Path, out: Path) -> None:
    import pytest

    from tests.test_policy_training import SUITE, vlm_inputs
    from vap_make.films.demonstrations import cached
    from vap_make.policy.train import FILMS
    from vap_make.vlm import train as vlm

    films = cache / FILMS
    schedule = vlm.Schedule
    with pytest.MonkeyPatch.context() as patch:
        pool, recipe = vlm_inputs((films, cached(films, SUITE, 0, 1)), patch)
        assert pool
        patch.setattr(vlm, "Schedule", lambda **told: schedule(**{**told, "every": 1}))
        vlm.train(recipe, out)


WORK: dict[str, Callable[..., None]] = {
    "report": write_report,
    "ground": ground,
    "import": replace_object,
    "policy": train_policy,
    "vlm": train_vlm,
}
FILES = ("report", "ground", "import")
"""The work that leaves whole files, whenever it ends; the rest are trainings, which go on."""


class Server:
    """The process that forks."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process

    def whole(self, name: str, *paths: Path) -> float:
        """Do the work undisturbed; returns the seconds that it took."""
        start = time.monotonic()
        assert not self.killed(LIMIT_S, name, *paths), f"{name} hangs"
        return time.monotonic() - start

    def killed(self, after_s: float, name: str, *paths: Path) -> bool:
        """Do the work and kill its process group after that time; whether it was not done."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([name, *map(str, paths)]) + "\n")
        self.process.stdin.flush()
        pid = int(self.process.stdout.readline())
        ended, _, _ = select.select([self.process.stdout], [], [], after_s)
        if not ended:
            with suppress(ProcessLookupError):  # it may end just now
                os.kill(pid, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(int(self.process.stdout.readline()))
        assert status in (0, -signal.SIGKILL), f"{name} ends with {status}"
        return status != 0


NEEDED = (
    "matplotlib.backends.backend_agg",
    "vap_core.study.grounding",
    "vap_core.study.report",
    "vap_core.recording",
)
"""What the work of `FILES` imports."""


@contextmanager
def serving(*modules: str) -> Iterator[Server]:
    """A server that has imported these modules, or what is needed."""
    command = [sys.executable, "-m", "tests.random_kills", *(modules or NEEDED)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        yield Server(process)
        process.kill()


def kill_in(
    seconds: float, work: Callable[[float], bool], kills: int, rng: random.Random
) -> Iterator[int]:
    """Kill work that takes so long undisturbed at random moments; yields after every kill.

    `work` takes the time after which it is killed, and says whether it was not done by then. A
    machine may become slower or faster: three times as many attempts are allowed.
    """
    done = 0
    for _ in range(3 * kills):
        if work(rng.uniform(0.0, seconds)):
            done += 1
            yield done
        if done == kills:
            return
    raise AssertionError(f"only {done} of {kills} kills met work that was going on")


def serve(asked: TextIO, answers: TextIO) -> None:
    """Fork for every line, and answer with the process, then with its status."""
    for line in asked:
        name, *paths = json.loads(line)
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                os.setsid()
                WORK[name](*map(Path, paths))
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)
        print(pid, file=answers, flush=True)
        _, ended = os.waitpid(pid, 0)
        print(ended, file=answers, flush=True)


def main() -> None:
    for name in sys.argv[1:]:
        import_module(name)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the work prints is no answer
    serve(sys.stdin, answers)


if __name__ == "__main__":
    main()
