"""The fields that only rows of shared scenes have, from and to JSON: speaker, owners, sub-goals."""

from collections.abc import Mapping
from typing import Any, get_args

from vap_core.simulation.types import EpisodeRow, Owned, SubGoal, SuccessRule

SUBGOAL = ("instruction", "category", "target", "max_steps", "rule", "goal")
"""The fields of a sub-goal, all of them."""


class BadField(Exception):
    """A field that a row may not have."""

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(field, reason)
        self.field = field
        self.reason = reason


def to_json(row: EpisodeRow) -> dict[str, Any]:
    """The fields of a row in a shared scene; none for any other."""
    if not (row.speaker or row.owned or row.subgoals):
        return {}
    owned = [[each.model, each.owner, list(each.known_as)] for each in row.owned]
    subgoals = []
    for each in row.subgoals:
        subgoals.append({name: getattr(each, name) for name in SUBGOAL})
    return {"speaker": row.speaker, "owned": owned, "subgoals": subgoals}


def from_json(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The same fields as values, none where there are none. Raises: BadField."""
    if not {"speaker", "owned", "subgoals"} & set(fields):
        return {}
    placed = [place[0] for place in fields["placements"]]
    if not isinstance(fields.get("speaker"), str):
        raise BadField("speaker", f"{fields.get('speaker')!r} is no text")
    if not isinstance(fields.get("owned"), list):
        raise BadField("owned", f"{fields.get('owned')!r} is no list")
    if not isinstance(fields.get("subgoals"), list):
        raise BadField("subgoals", f"{fields.get('subgoals')!r} is no list")
    owned = tuple(_owned(each, placed) for each in fields["owned"])
    subgoals = tuple(_subgoal(each, placed) for each in fields["subgoals"])
    if subgoals and subgoals[0].target != placed[0]:
        raise BadField("subgoals", f"the first is about {subgoals[0].target!r}, not the target")
    return {"speaker": fields["speaker"], "owned": owned, "subgoals": subgoals}


def _owned(given: Any, placed: list[str]) -> Owned:
    fits = isinstance(given, list) and len(given) == 3 and isinstance(given[2], list)
    if not fits or not all(isinstance(word, str) for word in (*given[:2], *given[2])):
        raise BadField("owned", f"{given!r} is not [model, owner, [other words for that person]]")
    if given[0] not in placed:
        raise BadField("owned", f"{given[0]!r} is not placed")
    return Owned(given[0], given[1], tuple(given[2]))


def _subgoal(given: Any, placed: list[str]) -> SubGoal:
    if not isinstance(given, dict) or set(given) != set(SUBGOAL):
        raise BadField("subgoals", f"{given!r} does not have {', '.join(SUBGOAL)}")
    for name in SUBGOAL:
        if name != "max_steps" and not isinstance(given[name], str):
            raise BadField("subgoals", f"{name} is {given[name]!r}, no text")
    if type(given["max_steps"]) is not int or given["max_steps"] < 1:
        raise BadField("subgoals", f"max_steps is {given['max_steps']!r}, no count of steps")
    if given["rule"] not in get_args(SuccessRule):
        raise BadField("subgoals", f"rule is {given['rule']!r}; known: {get_args(SuccessRule)}")
    needs_goal = given["rule"] in ("near", "put")
    if given["target"] not in placed or (needs_goal and given["goal"] not in placed):
        raise BadField("subgoals", f"{given['target']!r} or {given['goal']!r} is not placed")
    if given["goal"] == given["target"] or (given["goal"] and not needs_goal):
        raise BadField("subgoals", f"{given['rule']} has no goal {given['goal']!r}")
    return SubGoal(**given)
