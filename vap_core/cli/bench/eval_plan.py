"""What the evaluation benchmark runs: the episodes, and the ways to run them."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from vap_core.cli.bench.measurement import n_cores
from vap_core.policies.lerobot.toy_pi0 import Toy
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

SUITE = "simpler-bridge"
TASK = "put-camera"
TOY = Toy(image=128, patch=16, width=128, layers=4, expert=96, chunk=4, denoise=10)
BATCH = 4
"""Episodes of ours that are run at once in a process."""
FOLLOW = {"step": "every step", "call": "at calls"}
"""rollout.Trial's, and how an arm is named.

At every step is the work that lerobot's loop does; at the policy's calls is less, which that loop
cannot leave out.
"""


@dataclass(frozen=True)
class Plan:
    """How much is measured: `episodes` of `steps` control steps, `repeats` times over."""

    episodes: int = 8
    steps: int = 40
    repeats: int = 5
    workers: int = 2
    toy: Toy = TOY
    loops: tuple[tuple[int, bool], ...] = ((1, False), (4, False), (4, True))
    """lerobot's number of environments, and whether each is a process."""

    def rows(self) -> list[EpisodeRow]:
        """The episodes, cut to `steps`."""
        rows = []
        for row in suites.rows(SUITE, TASK)[: self.episodes]:
            rows.append(replace(row, max_steps=self.steps))
        return rows

    def for_lerobot(self) -> dict[str, Any]:
        """What lerobot_process.py needs of it, as JSON."""
        return {
            "suite": SUITE,
            "task": TASK,
            "episodes": self.episodes,
            "steps": self.steps,
            "toy": asdict(self.toy),
            "loops": self.loops,
        }


QUICK = Plan(
    episodes=2,
    steps=2,
    repeats=2,
    workers=2,
    toy=Toy(image=64, patch=16, width=32, layers=1, expert=32, denoise=2),
    loops=((1, False), (2, False)),
)
"""A smoke test; its figures mean nothing."""


@dataclass(frozen=True)
class Cost:
    """What running all episodes once took.

    `wall` and `cpu` in seconds, the latter of all processes that ran them, and `parts` of it.
    """

    wall: float
    cpu: float
    parts: Mapping[str, float]


@dataclass
class Arm:
    """One way to run all episodes, and what it cost in every repeat.

    `name` says how it runs. `loop` is "lerobot" or "ours", `code` the version of the package whose
    loop it is. `equal_cpu` names its part in the table of equal CPU ("" for none): one process, one
    thread. `wall` likewise in the table of wall time, which takes the fastest of lerobot's "best".
    """

    name: str
    loop: str
    code: str
    run: Callable[[], Cost]
    equal_cpu: str = ""
    wall: str = ""
    costs: list[Cost] = field(default_factory=list)

    def repeat(self) -> None:
        """Run all episodes once more."""
        self.costs.append(self.run())

    def values(self) -> dict[str, Any]:
        """As JSON, without the work."""
        return {
            "name": self.name,
            "loop": self.loop,
            "code": self.code,
            "equal_cpu": self.equal_cpu,
            "wall": self.wall,
            "costs": [asdict(cost) for cost in self.costs],
        }


def threads() -> tuple[int, ...]:
    """torch's threads that lerobot is tried with; its default is one per core."""
    return tuple(sorted({1, n_cores()}))


def count_of(n: int, noun: str) -> str:
    """A number with its noun, as in 2 threads."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
