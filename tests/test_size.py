"""How much there is to read may only fall: lower a limit when a change has made it true.

`python -m vap_core bench size` prints the counts.
"""

from pathlib import Path

import pytest

from vap_core.cli.bench import _size, commands, count

ROOT = Path(__file__).resolve().parents[1]
LIMITS = {
    "= vap_core": {"files": 181, "nodes": 222_300, "functions": 2_560},
    "= vap_make": {"files": 65, "nodes": 74_900, "functions": 790},
}
COMMANDS, OPTIONS = 20, 215


def test_nodes_do_not_change_by_formatting_and_docstrings() -> None:
    one = _size('"""A module."""\ndef f(a, b):\n    """Adds."""\n    return a + b\n')
    other = _size("def f(\n    a,\n    b,\n):\n    return (\n        a + b\n    )\n")
    assert (one["nodes"], one["functions"], one["code"]) == (10, 1, 2)
    assert (other["nodes"], other["code"]) == (one["nodes"], 7)


@pytest.mark.parametrize("folder", LIMITS)
def test_the_code_does_not_grow(folder: str) -> None:
    found = count([ROOT / folder.removeprefix("= ")])[folder]
    for name, limit in LIMITS[folder].items():
        assert found[name] <= limit, f"{found[name]:,} {name} in {folder}"


def test_commands_and_options_do_not_grow() -> None:
    listed = commands()
    assert len({name.split()[0] for name in listed}) <= COMMANDS
    assert sum(map(len, listed.values())) <= OPTIONS
