"""Names of recording properties in files written before they took the names of results tables."""

from collections.abc import Mapping
from typing import Any

FORMER_NAMES = {
    "outcome": {
        "outcome": "status",
        "steps": "length",
        "case": "failure_case",
        "case_confidence": "confidence",
        "case_sentence": "why",
    },
    "correction": {
        "case": "failure_case",
        "case_sentence": "why",
    },
}
"""By property group: the name that a property has now, and the name that it had before."""


def with_current_names(group: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The properties of one group by their current names, whenever they were written."""
    current = {former: name for name, former in FORMER_NAMES.get(group, {}).items()}
    renamed = {}
    for name, value in values.items():
        renamed[current.get(name, name)] = value
    return renamed
