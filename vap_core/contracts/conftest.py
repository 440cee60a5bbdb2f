"""The fixtures of the contract tests: one for each option, and a rendered scene."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vap_core.contracts import given
from vap_core.contracts.given import RenderedScene
from vap_core.contracts.plugin import PROTOCOLS


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Collect the tests of what is given only."""
    name = collection_path.stem.removeprefix("test_")
    if name in PROTOCOLS and not config.getoption(name):
        return True
    return None


def _fixture(name: str) -> Callable[[pytest.FixtureRequest], Any]:
    @pytest.fixture(scope="module", name=name)
    def fixture(request: pytest.FixtureRequest) -> Any:
        return given.made(request.config.getoption(name))

    return fixture


detector = _fixture("detector")
encoder = _fixture("encoder")
segmenter = _fixture("segmenter")
tracker = _fixture("tracker")
prompter = _fixture("prompter")
policy = _fixture("policy")
suite = _fixture("suite")


@pytest.fixture(scope="session")
def scene() -> RenderedScene:
    return given.rendered_scene()


@pytest.fixture(scope="session")
def where(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("on"))
