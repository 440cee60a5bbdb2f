"""Methods that only change words: what an object looks like is said, and no picture is touched (P 5.2; SPEC section 4)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from vap_core.errors import BadMemory
from vap_core.values import Attended, PersonalObject, Views


@dataclass(frozen=True)
class Described:
    """The hard prompt: the description in the object's memory file, short or long, is appended to the instruction."""

    length: Literal["short", "long"]


class Reworded:
    """Attends to nothing: images pass as they are, and the policy reads `say(instruction)` from the first step of an episode to its last."""

    highlights = False
    memory: Mapping[str, PersonalObject] = MappingProxyType({})

    def __init__(self, say: Callable[[str], str]) -> None:
        self.say = say

    def start(self, views: Views, instruction: str, *, cameras: Mapping[str, Any] | None = None) -> tuple[str, Attended]:
        """The state of an episode is its text."""
        text = self.say(instruction)
        return text, _passed(views, text)

    def steps(self, states: Sequence[str], views: Sequence[Views]) -> list[tuple[str, Attended]]:
        return [(text, _passed(seen, text)) for text, seen in zip(states, views, strict=True)]


def hard_prompt(obj: PersonalObject, how: Described) -> Reworded:
    """ "pick up my cup" -> "pick up my cup. My cup is white with blue spots." Raises: BadMemory when the object was never described."""
    if obj.description is None:
        raise BadMemory(f"hard_prompt: {obj.name!r} has no description; register it again with --replace, or delete its file.")
    phrase = obj.description.short if how.length == "short" else obj.description.long
    return Reworded(lambda instruction: f"{instruction.rstrip(' .')}. My {obj.category} is {phrase}.")


def _passed(views: Views, text: str) -> Attended:
    return Attended(views, text, (), {}, {}, ())
