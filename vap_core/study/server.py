"""The first import of the server that workers are forked from.

It ignores Ctrl-C: its parent handles that, and ends it and the workers without a traceback of
theirs. Until `server_ready` is imported it collects no garbage, which takes an eighth of the
imports' time, and says nothing about an import that fails: its parent imports the same, and says it
in one line.
"""

import gc
import signal
import sys
from typing import Any


def silent(*error: Any) -> None:
    """Say nothing."""


signal.signal(signal.SIGINT, signal.SIG_IGN)
gc.disable()
sys.excepthook = silent
