"""The command that measures how well parsers find the object that is meant."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import names

app = typer.Typer()


@app.command("parsers")
def eval_parsers(
    parser: Annotated[
        str,
        typer.Option(
            help="Parsers, with commas: rule, embedding, chat, or addresses of endpoints."
        ),
    ] = "rule,embedding",
    suite: Annotated[str, typer.Option(help="Only these suites, with commas. Default: all.")] = "",
    part: Annotated[
        str,
        typer.Option(
            help="Only these parts, with commas: tune, check-1 to check-4, and the held-out test. "
            "Default: all."
        ),
    ] = "",
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="So many paraphrases of every suite and part. Default: all."),
    ] = None,
    wrong: Annotated[
        bool, typer.Option("--wrong", help="List the paraphrases that are parsed wrongly, too.")
    ] = False,
    publish: Annotated[
        Path | None, typer.Option(help="Keep every answer as a table in this folder: data/results.")
    ] = None,
) -> None:
    """Parse over 200 paraphrased instructions a suite, and print how often the object is right.

    Example: python -m vap_core measure parsers
    Example: python -m vap_core measure parsers --parser chat --part test --limit 20
    """
    from vap_core.base.errors import BadStudy, one_of
    from vap_core.evaluation.parsers import report
    from vap_core.evaluation.parsers.measure import answer_table, measure
    from vap_core.evaluation.parsers.paraphrases import PARTS, suite_names
    from vap_core.instruction.parsers import load_parser

    parsers = names(parser)
    if not parsers:
        raise BadStudy(
            f"measure parsers: --parser {parser!r} names no parser; name one, or leave the option "
            "out for the default, rule,embedding."
        )
    suites = names(suite) or list(suite_names())
    parts = names(part) or list(PARTS)
    for what, given, known in (("suite", suites, suite_names()), ("part", parts, PARTS)):
        for name in given:
            if name not in known:
                raise one_of(f"measure parsers: {what}", name, known)
    answers = []
    for name in parsers:
        answers += measure(name, partial(load_parser, name), suites, parts, limit)
    table = answer_table(answers)
    if wrong:
        for answer in answers:
            if not answer.right:
                found = answer.found or answer.error or "nothing"
                print(f"{answer.parser}: {answer.text!r} means {answer.meant or 'none'}: {found}")
    print(report.text(table))
    if publish is not None:
        print(f"wrote {', '.join(map(str, report.publish(table, publish)))}")
