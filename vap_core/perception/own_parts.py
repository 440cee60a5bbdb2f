"""What a stack of a caller's own is made of, so that another one of its name is another run."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from vap_core.base.version import source_digest
from vap_core.perception.protocols import Stack, Tracker


def describe_parts(make: Callable[[], Stack]) -> dict[str, Any]:
    """The stack that `make` returns, as JSON.

    Of each part it has the class, the class's source, and the attributes that are numbers (NumPy's,
    too), words, arrays, lists of these, dataclasses or further parts. Others are left out:
    dictionaries, a network's weights, what a closure or a partial holds.
    """
    stack = make()
    about: dict[str, Any] = {"made by": source_digest(make), "encoder name": stack.encoder.name}
    for field in fields(stack):
        about[field.name] = _describe(getattr(stack, field.name), ())
    return about


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
    about = {
        "kind": getattr(part, "__qualname__", type(part).__qualname__),
        "code": source_digest(part),
    }
    for name, value in _attributes(part):
        if _counts(value):
            about[name] = _describe(value, within)
    return about


def _counts(value: Any) -> bool:
    """Whether a value is one that `describe_parts` describes."""
    if isinstance(value, str | int | float | np.generic | np.ndarray | list | tuple):
        return True
    return callable(value) or isinstance(value, Tracker) or is_dataclass(value)


def _attributes(part: Any) -> Iterator[tuple[str, Any]]:
    """The attributes of an object itself; a class has none."""
    if isinstance(part, type):
        return
    names = dict.fromkeys(getattr(part, "__dict__", ()))
    for kind in type(part).__mro__:
        names |= dict.fromkeys(getattr(kind, "__slots__", ()))
    for name in names:
        yield name, getattr(part, name, None)
