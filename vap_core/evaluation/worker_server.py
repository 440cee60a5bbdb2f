"""Starts the server of a run's workers before the run's tasks are known.

What workers import takes longest, and depends on the policy alone.
"""

from collections.abc import Sequence
from pathlib import Path

from vap_core.evaluation.processes import prepare
from vap_core.evaluation.store import MANIFEST
from vap_core.policies.names import MINI, POLICIES, shipped_checkpoint


def worker_modules(policy: str) -> tuple[str, ...]:
    """What a worker of a study with this policy imports first."""
    modules: tuple[str, ...] = (
        "vap_core.evaluation.jobs",
        "vap_core.rollout.loop",
        "vap_core.recording.recorder",
        "onnxruntime",
        "scipy.special",
    )
    if policy in POLICIES:
        return modules
    modules = (
        *modules,
        "vap_core.policies.lerobot.adapter",
        "vap_core.policies.lerobot.preload",
    )
    if Path(policy).name.startswith(MINI):
        return (*modules, "vap_core.policies.mini_pi0.processor_mini_pi0")
    return modules


def start_server(policy: str, folder: Path) -> None:
    """Have the server import what workers need, while this process finds out what they do.

    Where a run has begun in `folder` perhaps nothing is left to do: then `engine.run` starts it.
    """
    if not (folder / MANIFEST).exists():
        prepare(worker_modules(policy))


def probable_policy(suite_names: Sequence[str]) -> str:
    """The default policy of suites, as far as their names alone say it; else ""."""
    for name in suite_names:
        if name != "all" and not shipped_checkpoint(name).is_dir():
            return ""
    return MINI
