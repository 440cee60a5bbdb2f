"""The first import of the server that workers are forked from.

It ignores Ctrl-C: its parent handles that, and ends it and the workers without a traceback of
theirs. Until `server_ready` is imported it collects no garbage, which takes an eighth of the
imports' time, and says nothing about an import that fails: its parent imports the same, and says it
in one line. transformers finds no sklearn, which it needs for a search that no policy does, and is
not given the packages of every module, for which it would read the files of all: a quarter of the
imports' time.
"""

import gc
import signal
import sys
from importlib import metadata
from typing import Any


def silent(*error: Any) -> None:
    """Say nothing."""


class OfOneName(dict[str, list[str]]):
    """Every module is of the package of its name."""

    def __missing__(self, name: str) -> list[str]:
        return [name]


packages_distributions = metadata.packages_distributions
metadata.packages_distributions = OfOneName
sys.modules["sklearn"] = None  # type: ignore[assignment]
signal.signal(signal.SIGINT, signal.SIG_IGN)
gc.disable()
sys.excepthook = silent
