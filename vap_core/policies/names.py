"""The names of policies, and where those that ship are."""

from pathlib import Path

from vap_core.base.errors import one_of
from vap_core.base.files import SHIPPED as SHIPPED

MINI = "mini-pi0"
"""The shipped frozen policy, one checkpoint a suite."""
_NEWER = {
    "simpler-bridge": f"{MINI}-simpler-bridge-wide-seed-0",
    "simpler-fractal": f"{MINI}-simpler-fractal-wide",
    "tabletop": f"{MINI}-tabletop-longer",
}
"""The checkpoint of a benchmark whose first one, `mini-pi0-BENCHMARK`, was replaced."""
POLICIES = ("scripted", "expert", "random")
"""Policies without weights; each is built for one scene."""
PRIVILEGED = ("expert", "random")
"""Policies that read the simulator, or nothing at all: bounds, never results."""
TEMPERATURE = ", temperature "
"""What follows a label where the policy's sampling noise was scaled, before the factor."""


def policy_label(kind: str, name: str, digest: str) -> str:
    """What a run's rows call a lerobot checkpoint: its type, its folder's name, its fingerprint."""
    return f"{kind}:{name}@{digest[:8]}"


def label_of(checkpoint: str | Path, temperature: float | None = None) -> str:
    """The label of a checkpoint on this machine, with its own or another sampling noise.

    Raises: BadPolicy.
    """
    from vap_core.policies.lerobot.checkpoints import (
        config_field,
        fingerprint,
        local_folder,
        locate,
    )

    folder = locate(checkpoint)
    name = str(checkpoint)
    if local_folder(checkpoint) is not None:
        name = folder.name or folder.resolve().name  # "." has none
    label = policy_label(config_field(folder, "type"), name, fingerprint(folder))
    return label if temperature is None else f"{label}{TEMPERATURE}{temperature:g}"


def is_served(name: str) -> bool:
    """Whether a policy's name is the address of a policy server (policies.served)."""
    return name.startswith(("ws://", "wss://"))


def checkpoint_of(label: str) -> str:
    """The folder's name in a `policy_label`; nothing for a policy without weights."""
    return label.partition(":")[2].rpartition("@")[0]


def shipped_checkpoint(benchmark: str) -> Path:
    """Where the shipped policy of a benchmark is, if there is one."""
    return SHIPPED / _NEWER.get(benchmark, f"{MINI}-{benchmark}")


def check_policy_name(name: str) -> None:
    """Raises: UnknownName: no policy, no server's address, and no lerobot checkpoint's name."""
    from vap_core.policies.lerobot.checkpoints import is_checkpoint_name

    known = (*POLICIES, MINI)
    if name not in known and not is_served(name) and not is_checkpoint_name(name):
        raise one_of("Study: policy (or a checkpoint's folder or hub id, or ws://...)", name, known)
