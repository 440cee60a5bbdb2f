"""Makes this process ignore Ctrl-C.

The first import of the server that workers are forked from: its parent hears Ctrl-C, and ends it
and the workers without a traceback of theirs.
"""

import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)
