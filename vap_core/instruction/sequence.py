"""An instruction in several steps, taken apart by rule into one command a step (P multi-user).

"put my brother's camera on the plate, then my owl figurine in the basket" becomes "put my brother's
camera on the plate" and "put my owl figurine in the basket". Owners stay: the parser reads them.
"""

import re

from vap_core.base.errors import BadInstruction
from vap_core.instruction.expressions import ACTION, PLACING

_NEXT = r"(?:and\s+)?(?:then|after that|afterwards)\b"
STEP = re.compile(
    rf"\s*(?:[,;.!?]+\s*{_NEXT}|\s{_NEXT}"
    r"|(?:[;!?]+|(?<!\bDr)(?<!\bMr)(?<!\bMrs)(?<!\bMs)(?<!\bSt)\.)(?=\s+\S)"
    r"|[\r\n]+)\s*,?\s*",
    re.IGNORECASE,
)
"""What stands between two steps: "then", "and then", "after that", the end of a sentence, of which
"!" and "?" are one, too, or of a line."""
_NOTHING = re.compile(rf"(?:and|{_NEXT})?\W*", re.IGNORECASE)
"""What is no command: "then" or "and" alone, or no word at all."""
_BEFORE = r"(?:(?:first|now|please|(?:could|can|would|will) you)\s*,?\s+)*"
VERB = re.compile(rf"{_BEFORE}(?P<verb>{ACTION})\b", re.IGNORECASE)
PLACE = re.compile(rf"{_BEFORE}(?:{PLACING})\b", re.IGNORECASE)
DESTINATION = re.compile(
    r"\s(?:into|onto|in|on|near|next to|beside|to|at|inside|under)\s.*", re.IGNORECASE
)
IT = re.compile(r"\b(?:it|them)\b", re.IGNORECASE)


def decompose(text: str) -> tuple[str, ...]:
    """The commands of an instruction, in order: one for each step, at least one.

    A step without a verb repeats the one before it, and where that places something, its place,
    unless it names one of its own.

    Raises: BadInstruction: no step, or "it" in a later step, which could be several objects.
    """
    steps: list[str] = []
    for part in STEP.split(text.strip().rstrip(".!?")):
        step = " ".join(part.split())
        if _NOTHING.fullmatch(step):
            continue
        if steps and IT.search(step):
            raise BadInstruction(
                f"decompose: 'it' in {step!r} could be any object of {steps[-1]!r} or before; name "
                "the object."
            )
        if steps and not VERB.match(step):
            step = _completed(step, steps[-1])
        steps.append(step)
    if not steps:
        raise BadInstruction(
            f'decompose: no command in {text!r}; say one, for example "bring my cup, then my mug".'
        )
    return tuple(steps)


def _completed(step: str, before: str) -> str:
    """A step without a verb, with that of the step before it, and its place where it places."""
    verb = VERB.match(before)
    if verb is None:
        return step
    completed = f"{verb['verb']} {step}"
    if PLACE.match(before) and not DESTINATION.search(step):
        place = DESTINATION.search(before)
        completed += "" if place is None else place.group()
    return completed
