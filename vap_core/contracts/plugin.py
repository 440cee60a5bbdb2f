"""The options of the contract tests; pytest loads this module wherever the package is installed."""

import pytest

PROTOCOLS = ("detector", "encoder", "segmenter", "tracker", "prompter", "policy", "suite")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("vap_core", "pytest --pyargs vap_core.contracts")
    for name in PROTOCOLS:
        group.addoption(
            f"--{name}",
            metavar="MODULE:NAME",
            help=f"your {name}: an object, or what makes one when it is called without arguments",
        )
    group.addoption(
        "--on",
        metavar="SUITE/TASK",
        default="widowx-pick/pick-straw-cup",
        help="where a policy or prompter is run; default widowx-pick/pick-straw-cup",
    )
