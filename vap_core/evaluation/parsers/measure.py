"""Every paraphrase through a parser: which object it finds, and what the rewrite keeps."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from hashlib import sha256
from typing import TYPE_CHECKING

from vap_core.base.errors import BadEndpoint, VapError
from vap_core.base.types import Instruction, value
from vap_core.evaluation.parsers.paraphrases import FOLDER, Paraphrase, paraphrases
from vap_core.instruction import Parser
from vap_core.instruction.context import Context
from vap_core.memory import recall

if TYPE_CHECKING:
    import pandas as pd


@value
class Answer:
    """What a parser makes of one paraphrase.

    `found` are the names of the objects that it finds, with commas; "" where it abstains, and
    `error` says why. `right` says whether that is the object that is meant, or whether it abstains
    where none is. `kept` says whether the expression begins where it should and leaves the rest of
    the command.
    """

    parser: str
    suite: str
    part: str
    kind: str
    family: str
    text: str
    meant: str
    found: str
    right: bool
    kept: bool
    error: str


def measure(
    name: str,
    load: Callable[[Context], Parser],
    suites: Sequence[str],
    parts: Sequence[str],
    limit: int | None = None,
) -> list[Answer]:
    """The answers of a parser to every paraphrase; to the first `limit` of a suite and part.

    Raises: BadEndpoint: the parser's server fails, which is no abstention.
    """
    answers = []
    for suite in suites:
        for part in parts:
            for paraphrase in paraphrases(suite, part)[:limit]:
                answers.append(_answer(name, load(paraphrase.context), paraphrase))
    return answers


def answer_table(answers: Sequence[Answer]) -> "pd.DataFrame":
    """One row an answer."""
    import pandas as pd

    return pd.DataFrame([asdict(answer) for answer in answers])


def paraphrase_digest() -> str:
    """A digest of what the paraphrases are made from."""
    found = sha256()
    for path in (FOLDER / "families.csv", FOLDER / "objects.json"):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def _answer(name: str, parser: Parser, paraphrase: Paraphrase) -> Answer:
    context = paraphrase.context
    categories = {obj.category for obj in context.objects.values()}
    found: list[str] = []
    error = ""
    kept = True
    try:
        parsed = parser(paraphrase.text, categories)
        for target in parsed.targets:
            found.append(recall(context.objects, target, speaker=context.speaker).name)
        kept = _keeps(parsed, paraphrase)
    except BadEndpoint:
        raise
    except VapError as problem:
        error = str(problem)
        found = []
    meant = [] if paraphrase.object is None else [paraphrase.object]
    return Answer(
        parser=name,
        suite=paraphrase.suite,
        part=paraphrase.part,
        kind=paraphrase.kind,
        family=paraphrase.family,
        text=paraphrase.text,
        meant=paraphrase.object or "",
        found=",".join(found),
        right=found == meant,
        kept=kept,
        error=error,
    )


def _keeps(parsed: Instruction, paraphrase: Paraphrase) -> bool:
    target = parsed.targets[0]
    rest = f"{parsed.text[: target.start]}|{parsed.text[target.stop :]}"
    return target.start == paraphrase.start and paraphrase.kept in rest
