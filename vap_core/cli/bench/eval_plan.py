"""What the evaluation benchmark runs: the episodes, and the ways to run them."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from vap_core.policies.lerobot.toy_pi0 import Toy
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

SUITE = "simpler-bridge"
TASK = "put-camera"
TOY = Toy(image=128, patch=16, width=128, layers=4, expert=96, chunk=4, denoise=10)
BATCH = 4
"""Episodes of ours that are run at once in a process."""
FOLLOW = {"step": "", "call": ", at calls"}
"""rollout.Trial's, and how an arm is named.

At every step is the work that lerobot's loop does; at the policy's calls is less, which that loop
cannot leave out.
"""


@dataclass(frozen=True)
class Plan:
    """How much is measured: `episodes` of `steps` control steps, `repeats` times over.

    `workers` of ours run, and one alone; 0: in this process.
    """

    episodes: int = 8
    steps: int = 40
    repeats: int = 4
    workers: int = 2
    toy: Toy = TOY
    loops: tuple[tuple[int, bool], ...] = ((1, False), (4, False), (4, True))
    """lerobot's number of environments, and whether each is a process."""
    threads: tuple[int, ...] = tuple(sorted({1, len(os.sched_getaffinity(0))}))
    """torch's, in lerobot's process; its default is one per core. Ours always has one."""

    def rows(self) -> list[EpisodeRow]:
        """The episodes, cut to `steps`."""
        rows = suites.rows(SUITE, TASK)[: self.episodes]
        return shorten(rows, self.steps)


QUICK = Plan(
    episodes=2,
    steps=2,
    repeats=2,
    workers=0,
    toy=Toy(image=64, patch=16, width=32, layers=1, expert=32, denoise=2),
    loops=((1, False),),
    threads=(1,),
)
"""A smoke test; its figures mean nothing."""
Work = Callable[[], Mapping[str, float]]
"""Runs all episodes once; returns seconds by part."""


@dataclass
class Arm:
    """One way to run all episodes.

    Wall seconds of every repeat, and seconds by part summed over all of them.
    """

    name: str
    run: Work
    seconds: list[float]
    parts: dict[str, float]

    def repeat(self) -> None:
        """Run all episodes once more."""
        start = time.perf_counter()
        parts = self.run()
        self.seconds.append(time.perf_counter() - start)
        add_parts(self.parts, parts)


def shorten(rows: Sequence[EpisodeRow], steps: int) -> list[EpisodeRow]:
    """The same episodes, over after so many steps."""
    shortened = []
    for row in rows:
        shortened.append(replace(row, max_steps=steps))
    return shortened


def add_parts(total: dict[str, float], parts: Mapping[str, float]) -> None:
    """Add seconds by part to a total."""
    for part, seconds in parts.items():
        total[part] = total.get(part, 0.0) + seconds


def count_of(n: int, noun: str) -> str:
    """A number with its noun, as in 2 threads."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
