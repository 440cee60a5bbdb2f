"""Every test runs with the shapes in vap_core's signatures checked."""

from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

install_import_hook("vap_core", "beartype.beartype")

settings.register_profile("vap", deadline=None, derandomize=True)
settings.load_profile("vap")

ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def _one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
