"""The check of every signature in the packages, made when a function is first called, done once a call.

jaxtyping's own hook makes two checks of each function while its module is imported, and does both
at each call. A worker of the tests pays seconds for functions that it never calls, and a rollout a
fifth of its time. Here beartype alone checks a function, and jaxtyping compares the dimensions
where the signature names a shape.
"""

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import beartype
from jaxtyping import AbstractArray, install_import_hook
from jaxtyping._import_hook import Typechecker
from jaxtyping._storage import pop_shape_memo, push_shape_memo

WHOLE = jaxtyping.jaxtyped


def check_signatures(*packages: str) -> None:
    """From now on the packages' modules are imported with their signatures checked."""
    install_import_hook(packages, "beartype.beartype")
    of_the_hook = list(Typechecker.lookup.values())

    def jaxtyped(*things: Any, typechecker: Any) -> Any:
        """As jaxtyping's own, but what the hook decorates is checked in the short way."""
        if typechecker not in of_the_hook:
            return WHOLE(*things, typechecker=typechecker)
        return _checked(*things) if things else _checked

    jaxtyping.jaxtyped = jaxtyped


def _checked(thing: Any) -> Any:
    """A function, or a class, which is checked where it is a dataclass: when it is built."""
    if not isinstance(thing, type):
        return _function(thing)
    init = thing.__init__
    ours, its = hasattr(init, "checked"), getattr(init, "__globals__", {}).get("__name__")
    done = ours or its == WHOLE.__module__
    if dataclasses.is_dataclass(thing) and not done:
        thing.__init__ = _function(init)
    return thing


def _function(function: Callable[..., Any]) -> Callable[..., Any]:
    check: Callable[..., Any] | None = None

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        nonlocal check
        if check is None:
            check = _check(function)
        return check(*args, **kwargs)

    called.checked = True
    return called


def _check(function: Callable[..., Any]) -> Callable[..., Any]:
    hints = {}
    for name, hint in function.__annotations__.items():
        hints[name] = _resolved(hint, function)
    function.__annotations__ = hints
    checked = beartype(function)
    dims = " ".join(filter(None, map(_dimensions, hints.values())))
    if "{" in dims or inspect.isgeneratorfunction(inspect.unwrap(function)):
        return WHOLE(checked, typechecker=None)
    return _in_a_scope(checked) if dims else checked


def _in_a_scope(checked: Callable[..., Any]) -> Callable[..., Any]:
    """Dimensions of one name are equal in a call; none is an argument's value, so none is bound."""

    def scoped(*args: Any, **kwargs: Any) -> Any:
        push_shape_memo({})
        try:
            return checked(*args, **kwargs)
        finally:
            pop_shape_memo()

    return scoped


def _resolved(hint: Any, function: Callable[..., Any]) -> Any:
    """The type that is meant, Any where it is imported for type checkers only, as jaxtyping does."""

    def named(value: hint) -> None: ...

    try:
        return typing.get_type_hints(named, function.__globals__, include_extras=True)["value"]
    except NameError:
        return Any


def _dimensions(hint: Any) -> str:
    """The dimensions of all shapes that a type names."""
    if isinstance(hint, typing.TypeAliasType):
        return _dimensions(hint.__value__)
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return f"{hint.dim_str} ."
    parts = hint if isinstance(hint, list) else typing.get_args(hint)
    return " ".join(filter(None, map(_dimensions, parts)))
