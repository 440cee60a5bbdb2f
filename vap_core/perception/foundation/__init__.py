"""The foundation stacks: Grounding DINO, DINOv2 and SAM 2.1 behind the protocols of every stack.

Other models may stand for each of the three.

Within perception, only this package imports transformers.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from vap_core.base.errors import device_name, require
from vap_core.perception.foundation.weights import EMBEDDED, parts_of
from vap_core.perception.protocols import Stack, Thresholds, read_thresholds


def load(kind: str, device: str | None = None, store: Path | None = None) -> Stack:
    """A stack of `sources.KINDS`, from verified local weights, which are read once.

    It has thresholds where `measure calibration --keep` has written them beside the weights.

    Raises:
        MissingPart: torch or transformers is not installed.
        MissingWeights: what is not on this machine, and both ways to get it.
        UnknownName: no such device.
        BadOutput: the file of thresholds is damaged.
    """
    require("foundation", f"the stack {kind}")
    from vap_core.perception.foundation.weights import store_folder

    store = store or store_folder()
    stack = _load_networks(kind, device_name(device), store)
    return replace(stack, thresholds=read_thresholds(store, kind, stack.encoder.name))


@cache
def _load_networks(kind: str, device: str, store: Path) -> Stack:
    """The stack without thresholds, kept for the next call with the same three."""
    return Stack(name=kind, **load_parts(kind, device, store))


def load_parts(name: str, device: str | None = None, store: Path | None = None) -> dict[str, Any]:
    """The fields of a `Stack` that a mixed stack takes from here; from verified local weights.

    Raises: as `load`.
    """
    require("foundation", f"the stack {name}")
    from vap_core.perception.foundation import architectures
    from vap_core.perception.foundation.models import select_runtime
    from vap_core.perception.foundation.weights import models_of, verify_stack

    runtime = select_runtime(device)
    weights = dict(zip(models_of(name), verify_stack(name, store), strict=True))
    loaded: dict[str, Any] = {}
    for role, model in parts_of(name).items():
        if model in weights:
            loaded |= architectures.read_part(role, model, weights[model], runtime)
    return loaded


def kept_thresholds(name: str, encoder: str) -> Thresholds | None:
    """The thresholds of a mixed stack that were measured and kept. Raises: BadOutput."""
    from vap_core.perception.foundation.weights import store_folder

    return read_thresholds(store_folder(), name, encoder)


def random_parts(name: str, device: str | None = None) -> dict[str, Any]:
    """As `load_parts`, with random weights in the real architectures.

    Raises: MissingPart: torch or transformers is not installed; UnknownName: no such stack or
        device.
    """
    require("foundation", f"the stack {name}")
    from vap_core.perception.foundation import architectures
    from vap_core.perception.foundation.models import select_runtime

    runtime = select_runtime(device)
    filled: dict[str, Any] = {}
    for role, model in parts_of(name).items():
        if model == EMBEDDED:
            continue
        filled |= architectures.fill_part(
            role=role,
            network=architectures.random_network(role, model),
            tokenizer=architectures.letter_tokenizer(),
            name=f"{model}-random",
            runtime=runtime,
        )
    return filled
