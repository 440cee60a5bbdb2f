"""The offline parser of implicit references: grammar, MiniLM, owners and history (SPEC section 3).

`expressions` finds what may refer to an object, `reading` decides which object one of them means,
and `meaning` compares words by their sentence embeddings.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from vap_core.base.errors import BadInstruction, VapError
from vap_core.base.types import Instruction, PersonalObject, Target
from vap_core.instruction.context import Context
from vap_core.instruction.expressions import (
    Expression,
    find_category,
    find_exclusions,
    find_expressions,
    person_pattern,
)
from vap_core.instruction.meaning import EmbedText
from vap_core.instruction.reading import Reading
from vap_core.instruction.rule import check_length, is_name


@dataclass(frozen=True)
class EmbeddingParser:
    """Finds the object that every expression means, by its name in the memory."""

    context: Context
    embed: EmbedText

    def __call__(self, text: str, categories: Collection[str] = ()) -> Instruction:
        """Parse one instruction; every target names its object.

        Raises: BadInstruction: no personal object, or several fit, or the text is too long;
            UnknownName: none is remembered; MissingWeights: `embed` has no weights here.
        """
        check_length(text)
        exclusions = find_exclusions(text)
        found: list[tuple[Expression, PersonalObject]] = []
        problem: VapError | None = None
        unmet: VapError | None = None
        people = person_pattern(self.context)
        expressions = list(find_expressions(text, exclusions, people))
        last = 0
        for expression in expressions:
            if expression.start < last:
                continue
            try:
                obj = Reading(
                    context=self.context,
                    embed=self.embed,
                    text=text,
                    expression=expression,
                    expressions=expressions,
                    exclusions=exclusions,
                ).object()
            except VapError as error:
                if problem is None or expression.governed:
                    problem = error
                if expression.kind == "owner" and self._is_wanted(expression):
                    unmet = unmet or error
                continue
            if obj is not None:
                found.append((expression, obj))
                last = max(last, expression.stop)
        targets = _targets(found)
        if targets and unmet is None:
            return Instruction(text, targets)
        nothing = BadInstruction(
            f'parse: no personal object in {text[:80]!r}; name one as "my <category>", or say what '
            "it is for."
        )
        raise unmet or problem or nothing

    def _is_wanted(self, expression: Expression) -> bool:
        """Whether the instruction cannot be followed without the object."""
        known = {obj.category for obj in self.context.objects.values()}
        named = find_category(expression.said, known) is not None
        return expression.argument or (expression.destination and named)


def _targets(found: Sequence[tuple[Expression, PersonalObject]]) -> tuple[Target, ...]:
    """One target per object: where a verb of action or a place is, only those that stand there.

    Wherever else the object is named again, as "my cup", that is a span of its target, too.
    """
    governed = [pair for pair in found if pair[0].governed]
    targets: dict[str, Target] = {}
    for expression, obj in governed or found:
        targets.setdefault(obj.name, _target(expression, obj))
    for expression, obj in found:
        target = targets.get(obj.name)
        if target is None or target.start == expression.start:
            continue
        if is_name(expression.said, obj.category):
            again = (*target.again, _target(expression, obj))
            targets[obj.name] = replace(target, again=again)
    return tuple(targets.values())


def _target(expression: Expression, obj: PersonalObject) -> Target:
    return Target(
        start=expression.start,
        stop=expression.stop,
        owner=obj.owner,
        category=obj.category,
        object=obj.name,
    )
