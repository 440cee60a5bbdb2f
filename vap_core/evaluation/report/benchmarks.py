"""The benchmarks and shared scenes as tables."""

from collections import Counter

from vap_core.base.tables import align
from vap_core.simulation import suites
from vap_core.simulation.types import EpisodeRow

LISTED = {**suites.BENCHMARKS, **suites.SHARED}
"""The suites with a hashed list: benchmarks, and shared scenes."""
MATCHED = (
    "protocol-matched in MuJoCo: other physics, renderings and objects than SIMPLER's and "
    "VLABench's own."
)


def suites_table() -> str:
    """Benchmarks and shared scenes as their hashed lists hold them; the warm-up suites.

    Raises: BadSuite for a damaged list.
    """
    notes = "\n".join([MATCHED, *_development_lists(), *_warm_ups()])
    parts = [align(_track_rows()), align(_task_rows()), notes]
    return "\n\n".join(parts)


def _track_rows() -> list[list[str]]:
    rows = [
        ["suite", "robot", "cameras", "Hz", "control", "track", "episodes", "sha256 of the list"]
    ]
    for name, suite in LISTED.items():
        columns = [name, suite.robot, " ".join(suite.cameras), f"{suite.hz:g}", suite.control]
        digest = suites.lists.digest(name)[:12]
        tracks = Counter(row.split for row in suites.lists.read(name))
        for split, count in tracks.items():
            rows.append([*columns, split or "-", str(count), digest])
    return rows


def _task_rows() -> list[list[str]]:
    rows = [["suite", "task", "instruction", "success when", "max steps", "episodes"]]
    for name, suite in LISTED.items():
        for task in suite.tasks:
            listed = suites.rows(name, task.name)
            counts = Counter(row.split for row in listed).values()
            rows.append(
                [
                    name,
                    task.name,
                    task.instruction,
                    " and ".join(_rules(listed[0])),
                    str(task.max_steps),
                    " + ".join(map(str, counts)),
                ]
            )
    return rows


def _rules(row: EpisodeRow) -> list[str]:
    """The rule of every sub-goal in order."""
    return [row.at(stage).rule for stage in range(row.stages)]


def _development_lists() -> list[str]:
    counts = []
    for name in suites.BENCHMARKS:
        counts.append(f"{name}-dev {len(suites.benchmark(f'{name}-dev'))}")
    return [
        f"to tune on, other layouts and objects: {', '.join(counts)}",
        "with -absent after its name, a suite of these is the same without the target",
    ]


def _warm_ups() -> list[str]:
    lines = []
    for name, suite in suites.WARM_UPS.items():
        lines.append(
            f"warm-up {name}: {suite.robot}, {len(suite.tasks)} picks of "
            f"{suite.tasks[0].max_steps} steps, any number of episodes"
        )
    return lines
