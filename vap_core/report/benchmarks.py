"""The benchmarks as tables."""

from collections import Counter

from vap_core import suites
from vap_core.report.text import align


def suites_table() -> str:
    """The benchmarks as their hashed lists hold them, one row per track; then the warm-up suites."""
    head = ["suite", "robot", "cameras", "Hz", "control", "track", "episodes", "sha256 of the list"]
    body, tasks = [], [["suite", "task", "instruction", "success when", "max steps", "episodes"]]
    for name, suite in suites.BENCHMARKS.items():
        listed = suites.lists.read(name)
        about = [name, suite.robot, " ".join(suite.cameras), f"{suite.hz:g}", suite.control]
        for split, count in Counter(row.split for row in listed).items():
            body.append([*about, split or "-", str(count), suites.lists.digest(name)[:12]])
        for task in suite.tasks:
            counts = Counter(row.split for row in listed if row.task == task.name)
            tasks.append([name, task.name, task.instruction, task.rule, str(task.max_steps), " + ".join(str(count) for count in counts.values())])
    lines = [
        align([head, *body]),
        "",
        align(tasks),
        "",
        "protocol-matched in MuJoCo: other physics, renderings and objects than SIMPLER's and VLABench's own.",
    ]
    for name, suite in suites.WARM_UPS.items():
        lines.append(f"warm-up {name}: {suite.robot}, {len(suite.tasks)} picks of {suite.tasks[0].max_steps} steps, any number of episodes")
    return "\n".join(lines)
