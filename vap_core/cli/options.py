"""Options that several commands share."""

from typing import Annotated

import typer

StackName = Annotated[
    str,
    typer.Option(
        "--stack",
        help="Perception stack: embedded (offline, CPU), foundation or foundation-small "
        "(see weights).",
    ),
]
Workers = Annotated[int, typer.Option(min=1, help="Processes.")]


def names(text: str) -> list[str]:
    """The names in "a,b,c"; empty ones are left out."""
    return [name for name in text.split(",") if name]
