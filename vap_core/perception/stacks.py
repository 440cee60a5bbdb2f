"""The stacks by name, mixed stacks, and what a stack of a caller's own is made of."""

import hashlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from vap_core.base.errors import check_device, one_of
from vap_core.base.files import sha256_of, source_digest
from vap_core.perception.foundation.weights import EMBEDDED, KINDS, parts_of
from vap_core.perception.foundation.weights import mixed as mixed
from vap_core.perception.protocols import Stack, Thresholds, Tracker


def describe_parts(make: Callable[[], Stack]) -> dict[str, Any]:
    """The stack that `make` returns, as JSON.

    Of each part it has the class, the class's source, and the attributes that are numbers (NumPy's,
    too), words, arrays, lists of these, dataclasses or further parts. Others are left out:
    dictionaries, a network's weights, what a closure or a partial holds.
    """
    stack = make()
    parts = {field.name: _describe(getattr(stack, field.name), ()) for field in fields(stack)}
    return {"made by": source_digest(make), "encoder name": stack.encoder.name, **parts}


def _describe(part: Any, within: tuple[int, ...]) -> Any:
    """A part as JSON; `within` are the ids of the parts that hold it."""
    if part is None or isinstance(part, str | int | float):
        return part
    if isinstance(part, np.generic):
        number = part.item()
        return number if isinstance(number, str | int | float) else repr(number)
    if isinstance(part, np.ndarray):
        return hashlib.sha256(str((part.dtype, part.shape)).encode() + part.tobytes()).hexdigest()
    if id(part) in within:
        return ""
    within = (*within, id(part))
    if isinstance(part, list | tuple):
        return [_describe(each, within) for each in part if _counts(each)]
    names: dict[str, None] = {}
    if not isinstance(part, type):  # a class has no attributes of its own
        names = dict.fromkeys(getattr(part, "__dict__", ()))
        for kind in type(part).__mro__:
            names |= dict.fromkeys(getattr(kind, "__slots__", ()))
    values = {name: getattr(part, name, None) for name in names}
    return {
        "kind": getattr(part, "__qualname__", type(part).__qualname__),
        "code": source_digest(part),
        **{name: _describe(value, within) for name, value in values.items() if _counts(value)},
    }


def _counts(value: Any) -> bool:
    """Whether a value is one that `describe_parts` describes."""
    if isinstance(value, str | int | float | np.generic | np.ndarray | list | tuple):
        return True
    return callable(value) or isinstance(value, Tracker) or is_dataclass(value)


EMBEDDED_THRESHOLDS = Thresholds(familiar=0.5, unfamiliar=0.54, together=0.165)
"""Chosen on development views, five references each. Familiar: first frames of the suites' -dev and
-dev-absent lists at 448 px, whole or every second to fourth: 2.4 % of 546 views that elect the
object are refused, and 32 % of 170 episodes with only look-alikes in view are tinted anywhere.
Unfamiliar: 80 pictures with objects pasted into real photos, 15 photos of one object, 7 scenes; 64
of 67 are at least that like it, 5 % of 869 where the kind is absent, and 25 % of 40 with only
look-alikes."""


def load_embedded() -> Stack:
    """Boxes of a COCO detector; EfficientNet-Lite0 features with heads trained on renders.

    Raises: MissingWeights: a file of weights is absent, or its checksum differs from the
        manifest's.
    """
    from vap_core.perception.embedded import encoder, proposer, segmenter, tracker

    return Stack(
        name="embedded",
        detector=proposer.load_open(),
        encoder=encoder.load(),
        segmenter=segmenter.load_cut(),
        tracker=tracker.load(),
        by_category=proposer.load(),
        unfamiliar_encoder=encoder.load_unfamiliar(),
        thresholds=EMBEDDED_THRESHOLDS,
        verifier=encoder.load_local(),
    )


def load_foundation(kind: str = "foundation") -> Stack:
    """Grounding DINO, DINOv2 and SAM 2.1 (P 5.1), on a GPU where there is one.

    Raises: as `foundation.load`.
    """
    from vap_core.perception import foundation

    return foundation.load(kind)


STACKS: dict[str, Callable[[], Stack]] = {
    "embedded": load_embedded,
    "foundation": load_foundation,
    "foundation-small": partial(load_foundation, "foundation-small"),
}


def load_own(name: str) -> Stack:
    """The stack as `load_stack` gives it, for pictures of a user's own.

    Where calibrate --photos --keep has measured a threshold on such pictures, it is used. A stack
    without thresholds has those that calibrate --keep has measured. Runs on the benchmarks never
    depend on what is added here.

    Raises: as load_stack; BadOutput: the file of thresholds is damaged.
    """
    from vap_core.perception.foundation.weights import store_folder
    from vap_core.perception.protocols import read_thresholds

    stack = load_stack(name)
    kept = read_thresholds(store_folder(), name, stack.encoder.name)
    if kept is None:
        return stack
    if stack.thresholds is None:
        return replace(stack, thresholds=kept)
    return replace(stack, thresholds=replace(stack.thresholds, unfamiliar=kept.unfamiliar))


def is_own(name: str) -> bool:
    """Whether a stack of that name would be the caller's own."""
    return ":" not in name and name not in (EMBEDDED, *KINDS)


def ships_thresholds(name: str) -> bool:
    """Whether a stack has thresholds without a measurement on this machine.

    They belong to a detector and an encoder together: those of the embedded stack ship. A stack of
    another name than those of `sources` is the caller's, with its own. Raises: UnknownName.
    """
    if is_own(name):
        return True
    parts = parts_of(name)
    return parts["detector"] == parts["encoder"] == EMBEDDED


def checksums(name: str, kept: bool = True) -> dict[str, Any]:
    """What a stack's answers depend on, by SHA-256: entries of a run's configuration.

    `weights` has every file that the embedded stack reads; of a stack whose parts are not all
    embedded also the files of its other models, as their lock.json says. `thresholds` is that of
    the file that `measure calibration --keep` wrote; it is left out where there is none, of a stack
    that `ships_thresholds`, and where not `kept`. `parts` are those of a stack of the caller's own
    (`describe_parts`), which is made for that.

    Raises: UnknownName; MissingWeights: a model's files are not here; what the caller's stack
        raises.
    """
    from vap_core.perception.embedded.networks import weights_sha256
    from vap_core.perception.foundation.weights import locked_sha256, store_folder
    from vap_core.perception.protocols import thresholds_file

    found: dict[str, Any] = {"weights": weights_sha256()}
    if ":" in name or name in KINDS:
        found["weights"] = {**found["weights"], **locked_sha256(name)}
    elif is_own(name) and name in STACKS:
        found["parts"] = describe_parts(STACKS[name])
    file = thresholds_file(store_folder(), name)
    if kept and not ships_thresholds(name) and file.is_file():
        found["thresholds"] = sha256_of(file)
    return found


def load_stack(name: str) -> Stack:
    """The stack of that name, or a mixed one (`mixed`); loading its weights takes about a second.

    Raises: UnknownName: no such stack, or `VAP_DEVICE` names no device of this machine;
        MissingPart, MissingWeights, BadOutput, as `load_mixed`.
    """
    check_stack(name)
    check_device()
    if ":" in name:
        return load_mixed(name)
    return STACKS[name]()


def check_stack(name: str, what: str = "load_stack") -> None:
    """Raises: UnknownName: neither a stack nor a mixed one."""
    if ":" in name:
        parts_of(name)
    elif name not in STACKS:
        raise one_of(f"{what}: stack", name, STACKS)


def load_mixed(name: str, device: str | None = None) -> Stack:
    """A stack of parts of several; loads those alone that it has.

    It has thresholds where it `ships_thresholds`, or where `measure calibration --keep` has
    measured this very mixture.

    Raises: UnknownName, MissingPart, MissingWeights, BadOutput.
    """
    from vap_core.perception import foundation

    if set(parts_of(name).values()) == {EMBEDDED}:
        return load_embedded()
    stack = _mixture(name, foundation.load_parts(name, device))
    if ships_thresholds(name):
        return stack
    return replace(stack, thresholds=foundation.kept_thresholds(name, stack.encoder.name))


def load_random(name: str, device: str | None = None) -> Stack:
    """A stack, mixed or not, whose large models have random weights: as fast as trained ones.

    Raises: UnknownName, MissingPart.
    """
    from vap_core.perception import foundation

    check_stack(name)
    return _mixture(name, foundation.random_parts(name, device))


def _mixture(name: str, loaded: dict[str, Any]) -> Stack:
    """The loaded fields, and the embedded stack's where its parts are in the mixture.

    The rule is that of `Stack.with_parts`; fields that are loaded as None are empty.
    """
    if EMBEDDED not in parts_of(name).values():
        return Stack(name=name, **loaded)
    parts = {field: part for field, part in loaded.items() if part is not None}
    empty: dict[str, Any] = dict.fromkeys(loaded.keys() - parts.keys())
    return replace(load_embedded().with_parts(name, **parts), **empty)
