"""What a run's manifest and its table of episodes have to look like, checked where they enter."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput

if TYPE_CHECKING:
    import pandas as pd

TEXT_COLUMNS = ("suite", "task", "method", "policy", "outcome")
OPTIONAL_TEXT_COLUMNS = ("split", "variant", "case", "sub_case", "detail")
WHOLE_NUMBER_COLUMNS = ("seed", "episode", "steps")
NUMBER_COLUMNS = ("attempt", "deciding_frame", "case_confidence")
FLAG_COLUMNS = ("success", "success_once", "cmr", "wrong_object", "first_object_correct", "touched")
"""True, False, or nothing."""
EXECUTED = "suite_files"
"""A study's files of own suites. They are the user's to name: none is taken from a file of results.
"""
LARGEST = 1_000_000
"""Counts are smaller."""
LARGEST_SEED = 2**32
"""Seeds are smaller: a date is one."""
NEEDED_SETTINGS = {"tasks", "methods", "episodes", "seed", "policy"}
"""What the configuration of a run of eval, rollout or demo holds."""


def _is_whole_number(value: Any, end: int = LARGEST) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < end


def _is_count(value: Any) -> bool:
    return _is_whole_number(value) and value > 0


def _is_seed(value: Any) -> bool:
    return _is_whole_number(value, LARGEST_SEED)


def _is_count_or_all(value: Any) -> bool:
    return value is None or _is_count(value)


def _is_temperature(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < LARGEST


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_text, value))


def _are_tasks(value: Any) -> bool:
    return (
        isinstance(value, list)
        and bool(value)
        and all(_are_texts(pair) and len(pair) == 2 for pair in value)
    )


def _are_digests(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


SETTINGS: Mapping[str, Callable[[Any], bool]] = {
    "tasks": _are_tasks,
    "methods": _are_texts,
    "episodes": _is_count_or_all,
    "seed": _is_seed,
    "seeds": _is_count,
    "policy": _is_text,
    "temperature": _is_temperature,
    "object": _is_text,
    "lists": _are_digests,
}
"""Settings of a study that are read back, and what they must be where they are there."""


def check_run(source: Path, manifest: Any, episodes: "pd.DataFrame") -> None:
    """Check the types of a run's manifest and of its columns.

    Raises: BadOutput, which names what is wrong.
    """
    wrong = _wrong_setting(manifest) or _wrong_column(episodes)
    if wrong:
        raise BadOutput(
            f"run: {source} is damaged: {wrong}; run the same command again with another --out, or "
            "publish the table anew."
        )


def require_episodes(source: Path, configuration: Mapping[str, Any], command: str) -> None:
    """Raises: BadOutput for a run of another command than eval, rollout or demo."""
    if not configuration.keys() >= NEEDED_SETTINGS:
        raise BadOutput(
            f"{command}: {source} holds no run of eval, rollout or demo; name the folder that one "
            "of them wrote."
        )


def _wrong_setting(manifest: Any) -> str:
    if not isinstance(manifest, dict) or not isinstance(manifest.get("configuration"), dict):
        return "its manifest has no configuration"
    if not _is_text(manifest.get("digest")):
        return "its manifest has no digest"
    configuration = manifest["configuration"]
    if EXECUTED in configuration:  # no run writes it
        return f"its manifest has {EXECUTED}, which name code to execute"
    for name, fits in SETTINGS.items():
        if name in configuration and not fits(configuration[name]):
            return f"the setting {name} is {str(configuration[name])[:40]!r}"
    return ""


def _wrong_column(episodes: "pd.DataFrame") -> str:
    from pandas.api.types import is_integer_dtype, is_numeric_dtype

    for name in episodes.columns.intersection([*TEXT_COLUMNS, *OPTIONAL_TEXT_COLUMNS]):
        kept = episodes[name]
        if name in OPTIONAL_TEXT_COLUMNS:
            kept = kept.dropna()
        if not kept.map(_is_text).all():
            return f"the column {name} holds what is no text"
    for name in episodes.columns.intersection(WHOLE_NUMBER_COLUMNS):
        if len(episodes) and not is_integer_dtype(episodes[name]):
            return f"the column {name} holds what is no whole number"
    for name in episodes.columns.intersection(NUMBER_COLUMNS):
        if len(episodes) and not is_numeric_dtype(episodes[name]):
            return f"the column {name} holds what is no number"
    for name in episodes.columns.intersection(FLAG_COLUMNS):
        if not episodes[name].dropna().isin([True, False]).all():
            return f"the column {name} holds what is neither true nor false"
    return ""
