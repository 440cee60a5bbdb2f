"""docs/reliability.md is what its command writes, and names tests that exist and have passed."""

import json

import pytest

from tests import counts, reliability_page, test_fuzz
from tests.reliability_rows import ATTACKS, FUZZED, LEFT, TRIED

COUNTS = json.loads(counts.FILE.read_text())


def test_the_page_is_what_its_command_writes() -> None:
    assert reliability_page.of_today(COUNTS) == COUNTS, "run make reliability"
    written = reliability_page.page(COUNTS)
    assert written == reliability_page.PAGE.read_text(), "run make reliability"


@pytest.mark.parametrize("test", reliability_page.named())
def test_every_test_that_the_page_names_exists_and_passed(test: str) -> None:
    """One that has not been counted yet is "not run" on the page."""
    file, function = test.split("::")
    assert function in reliability_page.functions_in(reliability_page.ROOT / file)
    entries = [entry for name, entry in COUNTS.items() if name.split("[")[0] == test]
    assert {entry["outcome"] for entry in entries} <= {"passed", "skipped"}


def test_no_row_is_missing() -> None:
    numbers = [str(number) for number in range(1, 27)]
    numbers.insert(7, "7a")
    assert [attack.number for attack in ATTACKS] == numbers
    assert len(TRIED) > 30
    assert all(row.tests for row in TRIED)
    assert all(why for _, why in LEFT)


def test_the_fuzzed_parsers_are_those_of_the_tests() -> None:
    assert f"{', '.join(test_fuzz.PARSERS)}: mutated" == FUZZED


def test_cases_and_outcomes_are_added_up() -> None:
    def entry(cases: int, swept: bool, **more: object) -> dict[str, object]:
        about = {"outcome": "passed", "seconds": 1.0, "on": "2026-01-01"}
        return {**about, "cases": cases, "sweep": swept, **more}

    entries = [entry(30, False, refused=4), entry(10_000, True, refused=9_000, largest_a=1e-7)]
    assert reliability_page.how_often(entries) == "30, 10,000 in the sweep"
    assert reliability_page.counted(entries) == "refused: 9,004; largest a: 1.0e-07"
    counted = {"tests/test_a.py::test_b[0]": entries[0], "tests/test_a.py::test_b[1]": entries[1]}
    tests = ("test_a::test_b", "test_a::test_c")
    assert reliability_page.last_run(tests[:1], counted) == "passed, 2026-01-01"
    counted["tests/test_a.py::test_b[2]"] = entry(1, False, outcome="failed", on="2026-01-02")
    broken = "1 of 3 FAILED, 1 of 2 tests not run, 2026-01-02"
    assert reliability_page.last_run(tests, counted) == broken
    assert reliability_page.last_run(tests[1:], counted) == "not run"
