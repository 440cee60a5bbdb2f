"""The last import of the server that workers are forked from.

From now on it and its workers collect garbage again, but never look through what was imported, and
say what they raise. sklearn can be imported again.
"""

import gc
import sys
from importlib import metadata

from vap_core.study.server import packages_distributions

metadata.packages_distributions = packages_distributions
del sys.modules["sklearn"]
gc.freeze()
gc.enable()
sys.excepthook = sys.__excepthook__
