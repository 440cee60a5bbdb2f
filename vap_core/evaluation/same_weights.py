"""A run goes on with the weights with which it began."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadPolicy
from vap_core.evaluation.store import MANIFEST, read_manifest
from vap_core.evaluation.study import Study
from vap_core.policies.lerobot.checkpoints import fingerprint, stamp
from vap_core.simulation import suites

SHORT = 12
"""Digits of a digest in messages."""


def require_same_weights(study: Study, suite: str, folder: Path) -> None:
    """Compare a suite's checkpoint, as it is now, with the manifest of the run in `folder`.

    A folder without one is passed over: on a cluster the machine has compared before.

    Raises: BadPolicy when the checkpoint was replaced, or a file of it is missing.
    """
    checkpoint = study.checkpoint(suite)
    if not checkpoint or not (folder / MANIFEST).exists():
        return
    begun_with = weights_by_suite(read_manifest(folder)["configuration"]).get(suite)
    now = _fingerprint(checkpoint, stamp(checkpoint))[:SHORT]
    if begun_with and now != begun_with:
        raise BadPolicy(
            f"engine: the weights in {checkpoint} changed while the run in {folder} went on "
            f"({begun_with} at first, {now} now). What was finished is kept. Let the training that "
            "writes them end, and choose another folder with --out."
        )


@cache
def _fingerprint(checkpoint: str, _: tuple[object, ...]) -> str:
    """The fingerprint of a checkpoint with this stamp; it takes seconds where it is large."""
    return fingerprint(checkpoint)


def weights_by_suite(configuration: Mapping[str, Any]) -> dict[str, str]:
    """The beginning of the weights' digest of every suite of a run's configuration."""
    names = {suite for suite, _ in configuration["tasks"]}
    if "checkpoint" in configuration:
        return dict.fromkeys(names, str(configuration["checkpoint"])[:SHORT])
    digests = configuration.get("checkpoints", [])
    benchmarks = sorted(set(map(suites.benchmark_name, names)))
    if len(digests) != len(benchmarks):
        return {}
    by_benchmark = dict(zip(benchmarks, digests, strict=True))
    return {name: str(by_benchmark[suites.benchmark_name(name)])[:SHORT] for name in names}
