"""The words of a study's instructions that its mini-pi0 does not know, and reads as <unk>."""

from collections.abc import Container, Iterable

from vap_core.evaluation.study import Study
from vap_core.policies.lerobot.checkpoints import config_field, locate
from vap_core.policies.token_groups import vocabulary_of, words_of

KIND = "mini_pi0"
"""The type of policy whose words are few."""


def unknown_words(known: Container[str], instructions: Iterable[str]) -> list[str]:
    """The words of some instructions, in lower case, that are none of `known`; each once."""
    words: dict[str, None] = {}
    for instruction in dict.fromkeys(instructions):
        words |= dict.fromkeys(words_of(instruction))
    return [word for word in words if word not in known]


def unknown_words_notes(study: Study) -> list[str]:
    """A line for each suite whose instructions have such words. Raises: BadPolicy."""
    lines = []
    for suite in dict.fromkeys(suite for suite, _ in study.tasks):
        checkpoint = study.checkpoint(suite)
        if not checkpoint or config_field(checkpoint, "type") != KIND:
            continue
        folder = locate(checkpoint)
        known, _ = vocabulary_of(folder) or ((), None)
        said = []
        for of_task, task in study.tasks:
            if of_task == suite:
                said += [row.instruction for row in study.rows(suite, task)]
        words = unknown_words(known, said)
        if words:
            lines.append(
                f"note: {folder.name} does not know {', '.join(words)}, which instructions of "
                f"{suite} say; where that reaches it, it reads <unk>. It was trained on the words "
                "of the benchmarks."
            )
    return lines
