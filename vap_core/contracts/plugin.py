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


def pytest_configure(config: pytest.Config) -> None:
    """Refuse a run of the contracts in which nothing is given to test."""
    asked = any(config.getoption(name) for name in PROTOCOLS)
    if not asked and "vap_core.contracts" in config.args:
        options = ", ".join(f"--{name}" for name in PROTOCOLS)
        raise pytest.UsageError(f"give what is to be tested, as MODULE:NAME: {options}")
