"""A run's rows are of one set of weights: those with which it began."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vap_core.base.errors import BadPolicy
from vap_core.evaluation.store import digest, read_manifest
from vap_core.evaluation.study import Study
from vap_core.policies.lerobot.checkpoints import stamp


class SameWeights:
    """Compares the weights of each finished job with those of the run.

    It is made before the run takes the fingerprint of its checkpoints.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self.stamps = _stamps(study)
        self.first: dict[tuple[str, str], str] = {}
        """The first checksum that this process received, by suite and policy."""

    def check(self, folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
        """Raises: BadPolicy when the rows are of other weights than the run in `folder`."""
        self._check_files(folder)
        for row in rows:
            checksum = row.get("policy_sha256")
            if checksum is None:  # its worker died
                continue
            first = self.first.setdefault((row["suite"], row["policy"]), checksum)
            if checksum != first:
                raise _changed(f"{row['policy']} ({first} at first, {checksum} now)", folder)

    def _check_files(self, folder: Path) -> None:
        """Read the checkpoints again where a file was written. Raises: BadPolicy."""
        now = _stamps(self.study)
        if now == self.stamps:
            return
        if digest(self.study.configuration()) != read_manifest(folder)["digest"]:
            raise _changed(self.study.policy, folder)
        self.stamps = now


def _stamps(study: Study) -> dict[str, tuple[object, ...]]:
    """The stamp of every checkpoint of a study. Raises: BadPolicy when a file is missing."""
    stamps = {}
    for suite, _ in study.tasks:
        checkpoint = study.checkpoint(suite)
        if checkpoint and checkpoint not in stamps:
            stamps[checkpoint] = stamp(checkpoint)
    return stamps


def _changed(policy: str, folder: Path) -> BadPolicy:
    return BadPolicy(
        f"engine: the weights of {policy} changed while the run in {folder} went on; what has just "
        "ended is not kept. Let the training that writes them end, and choose another folder with "
        "--out."
    )
