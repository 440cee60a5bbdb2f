"""Work that SIGKILL ends at random moments.

`python -m tests.random_kills` imports once what the work needs, then forks a process for every
piece of work that it is asked for: a kill costs no second of imports.
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
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

LIMIT_S = 120.0
"""After which a piece of work counts as hung."""


def write_report(run: Path, out: Path) -> None:
    from vap_core.evaluation import readings
    from vap_core.evaluation.report import report

    readings.LOCAL = readings.PUBLISHED = run / "no readings.csv"
    report([run], out)


def ground(clip: Path, bank: Path, out: Path) -> None:
    from tests.toys import MeanColour, SameColour, detector, segmenter
    from vap_core.analysis.ground_clip import ground_clip
    from vap_core.perception import stacks
    from vap_core.perception.protocols import Stack

    stacks.STACKS["toy"] = lambda: Stack("toy", detector, MeanColour(), segmenter, SameColour())
    ground_clip(clip, "bring my cup", bank, "toy", out)


def replace_object(folder: Path) -> None:
    """The same object, imported again and again under its name."""
    from tests.test_scan_storage import METADATA, cube
    from vap_core.simulation.assets.scans import storage

    for _ in range(20):
        storage.save_scan(folder, METADATA, cube(), replace=True)


WORK: dict[str, Callable[..., None]] = {
    "report": write_report,
    "ground": ground,
    "import": replace_object,
}


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
            os.kill(pid, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(int(self.process.stdout.readline()))
        assert status in (0, -signal.SIGKILL), f"{name} ends with {status}"
        return status != 0


@contextmanager
def serving() -> Iterator[Server]:
    command = [sys.executable, "-m", "tests.random_kills"]
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
    import matplotlib.backends.backend_agg  # noqa: F401

    import vap_core.analysis.ground_clip
    import vap_core.evaluation.report
    import vap_core.recording  # noqa: F401

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the work prints is no answer
    serve(sys.stdin, answers)


if __name__ == "__main__":
    main()
