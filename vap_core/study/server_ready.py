"""The last import of the server that workers are forked from.

From now on it and its workers collect garbage again, but never look through what was imported, and
say what they raise.
"""

import gc
import sys

gc.freeze()
gc.enable()
sys.excepthook = sys.__excepthook__
