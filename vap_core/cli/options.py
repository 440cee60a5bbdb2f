"""Options that several commands share."""

from collections.abc import Iterable, Mapping
from pathlib import Path
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
DetectorName = Annotated[
    str,
    typer.Option(
        "--detector", help="Another detector in the stack; `weights list` names them, or embedded."
    ),
]
EncoderName = Annotated[
    str, typer.Option("--encoder", help="Another encoder, which sees and compares the crops.")
]
TrackerName = Annotated[
    str, typer.Option("--tracker", help="Another tracker; it brings its segmenter.")
]
ObjectNames = Annotated[
    list[str] | None,
    typer.Option(
        "--object",
        help="Remembered object of each 'my ...', where the category alone does not decide.",
    ),
]
Speaker = Annotated[str, typer.Option(help='Whom "my" means, for example anna.')]
Memory = Annotated[Path, typer.Option(help="Folder of remembered objects.")]
BANK = Path("data/memory")
Workers = Annotated[int, typer.Option(min=1, help="Processes.")]


def stack_of(stack: str, detector: str, encoder: str, tracker: str) -> str:
    """The name of the stack with these parts ("" keeps the stack's). Raises: UnknownName."""
    from vap_core.perception.stacks import mixed

    return mixed(stack, detector=detector, encoder=encoder, tracker=tracker)


def names(text: str) -> list[str]:
    """The names in "a, b,c", each once; empty ones are left out."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def with_bar(starts: Iterable[int], label: str) -> Iterable[int]:
    """The starts of blocks, with a bar on a terminal."""
    from tqdm import tqdm

    return tqdm(starts, desc=label, unit="block", disable=None, leave=False)


def refuse_dropped(why: str, given: Mapping[str, object]) -> None:
    """Refuse options that would do nothing: those that are not None.

    Raises: BadStudy, which names them.
    """
    from vap_core.base.errors import BadStudy

    named = [name for name, setting in given.items() if setting is not None]
    if named:
        raise BadStudy(f"{why}; leave {' and '.join(named)} out.")
