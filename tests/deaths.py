"""Work that ends where a kill would show most: before each of its renames."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest


class Killed(BaseException):
    """No code catches it, as none catches SIGKILL."""


def renames_before_death(number: int) -> Callable[[Path, Path], None]:
    """os.replace, which works so often, and then raises Killed."""
    renames = iter([os.replace] * number)

    def die(*_: Path) -> None:
        raise Killed

    return lambda source, target: next(renames, die)(source, target)


def die_before_each_rename(
    work: Callable[[], object], check: Callable[[], None] = lambda: None
) -> int:
    """Do `work` again and again: the n-th time it ends before its n-th rename, the last time not.

    `check` is made after every end. Returns: how often the work was ended.
    """
    ends = 0
    while True:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "replace", renames_before_death(ends))
            try:
                work()
                return ends
            except Killed:
                ends += 1
        check()
