"""The contract tests of vap_core.contracts, called from tests with parts of their own."""

import inspect
from types import ModuleType
from typing import Any


def kept(module: ModuleType, *, sanity: bool = True, **given: Any) -> None:
    """Run every test of a contract; `sanity` off leaves out those that a trained model alone passes."""
    n = 0
    for name, test in vars(module).items():
        if not name.startswith("test_") or (name.startswith("test_sanity") and not sanity):
            continue
        test(**{part: given[part] for part in inspect.signature(test).parameters})
        n += 1
    assert n >= 3, module
