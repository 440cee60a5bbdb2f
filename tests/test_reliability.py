"""docs/reliability.md names tests that exist, and the numbers of fuzzed cases that they have."""

import ast
import re
from pathlib import Path

from tests import test_fuzz

ROOT = Path(__file__).resolve().parents[1]
DOC = (ROOT / "docs" / "reliability.md").read_text()


def rows() -> list[list[str]]:
    """The cells of the table of what was tried."""
    table = DOC[DOC.index("| what was tried") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[2:]]


def functions_in(file: Path) -> set[str]:
    return {
        node.name
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_row_names_tests_that_exist() -> None:
    assert len(rows()) > 20
    for tried, _, _, tests in rows():
        named = re.findall(r"`(test_\w+\.py)(?:::(\w+))?`", tests)
        assert named, tried
        for file, name in named:
            found = functions_in(ROOT / "tests" / file)
            assert found if not name else name in found, (tried, file, name)


def test_fuzzed_parsers_and_cases_are_those_of_the_tests() -> None:
    (tried, often, _, _), (_, recordings, _, _), *_ = rows()
    assert tried == f"{', '.join(test_fuzz.PARSERS)}: mutated"
    assert often == f"{test_fuzz.CASES:,} each, {test_fuzz.DAILY} daily"
    assert recordings == f"{test_fuzz.CASES:,}"
