"""Prompters that change words only: the images pass unchanged (P 5.2; SPEC section 4)."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from vap_core.base.errors import BadMemory
from vap_core.base.types import Attended, PersonalObject, Rgb
from vap_core.instruction import parse
from vap_core.rollout.prompters.protocol import PromptContext, unchanged
from vap_core.simulation.types import Observation


@dataclass(frozen=True)
class HardPrompt:
    """The object's description, short or long, is appended to the instruction."""

    length: Literal["short", "long"]


@dataclass(frozen=True)
class SoftPrompt:
    """The personal span is replaced by a reserved, learned word (SPEC section 4).

    It is learned in the model that the policy was initialised from and copied, as the paper does;
    learned there and rotated into the policy's space; or learned in the policy's own weights.
    """

    space: Literal["copied", "aligned", "own"] = "copied"


@dataclass(frozen=True)
class OtherCommand:
    """The policy reads another command than the episode's.

    None at all, or that of the suite's next task.
    """

    command: Literal["blank", "next task"]


class TextPrompter:
    """Passes images unchanged; the policy reads `rewrite(instruction)` in every step."""

    needs_truth: Literal["never", "start", "always"] = "never"
    highlights = False
    references: Mapping[str, tuple[Rgb, ...]] = MappingProxyType({})

    def __init__(self, rewrite: Callable[[str], str]) -> None:
        self.rewrite = rewrite

    def start(self, observation: Observation, context: PromptContext) -> tuple[str, Attended]:
        """The state of an episode is its text."""
        text = self.rewrite(context.instruction)
        return text, unchanged(observation.images, text)

    def steps(
        self,
        states: Sequence[str],
        observations: Sequence[Observation],
        contexts: Sequence[PromptContext],
    ) -> list[tuple[str, Attended]]:
        results = []
        for text, observation in zip(states, observations, strict=True):
            results.append((text, unchanged(observation.images, text)))
        return results


def generic() -> TextPrompter:
    """The generic policy: raw images, raw instruction."""
    return TextPrompter(str)


def say(text: str) -> TextPrompter:
    """Raw images and `text`, whatever the instruction is."""

    def replace_all(instruction: str) -> str:
        return text

    return TextPrompter(replace_all)


def hard_prompt(obj: PersonalObject, how: HardPrompt) -> TextPrompter:
    """The object's description is appended to the instruction.

    "pick up my cup" -> "pick up my cup. My cup is white with blue spots."

    Raises: BadMemory when the object was never described.
    """
    if obj.description is None:
        raise BadMemory(
            f"hard_prompt: {obj.name!r} has no description; register it again with --replace, or "
            "delete its file."
        )
    phrase = obj.description.short if how.length == "short" else obj.description.long

    def append(instruction: str) -> str:
        return f"{instruction.rstrip(' .')}. My {obj.category} is {phrase}."

    return TextPrompter(append)


def soft_prompt(word: str, categories: Collection[str] = ()) -> TextPrompter:
    """The personal span is replaced: "pick up my cup" -> "pick up <my_0>" for `word` "<my_0>".

    With the objects' `categories` it is the span that the method replaces; without, it is all words
    up to the first stop word.
    """

    def replace_span(instruction: str) -> str:
        target = parse(instruction, categories).targets[0]
        return instruction[: target.start] + word + instruction[target.stop :]

    return TextPrompter(replace_span)
