"""The words of a study's instructions that its mini-pi0 does not know, and reads as <unk>."""

import re
from collections.abc import Iterable

from vap_core.base.files import parse_json
from vap_core.evaluation.study import Study
from vap_core.policies.lerobot.checkpoints import CONFIG, config_field, locate

KIND = "mini_pi0"
"""The type of policy whose words are few, and in its configuration."""


def unknown_words(known: Iterable[str], instructions: Iterable[str]) -> list[str]:
    """The words of some instructions, in lower case, that are none of `known`; each once."""
    words: dict[str, None] = {}
    for instruction in instructions:
        words |= dict.fromkeys(re.findall(r"[\w']+", instruction.lower()))
    kept = set(known)
    return [word for word in words if word not in kept]


def unknown_words_notes(study: Study) -> list[str]:
    """A line for each suite whose instructions have such words. Raises: BadPolicy."""
    lines = []
    for suite in dict.fromkeys(suite for suite, _ in study.tasks):
        checkpoint = study.checkpoint(suite)
        if not checkpoint or config_field(checkpoint, "type") != KIND:
            continue
        folder = locate(checkpoint)
        known = parse_json((folder / CONFIG).read_text()).get("words", ())
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
