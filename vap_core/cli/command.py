"""How a command gets its options: they are the fields of a dataclass, or parameters that share
these types."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

StackName = Annotated[
    str,
    typer.Option(
        "--stack",
        help="Perception stack: embedded (offline, CPU), foundation or foundation-small (see "
        "weights); with other parts as embedded:encoder=dinov2-small,tracker=edgetam.",
    ),
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
RunFolder = Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")]
RunFolderOr = Annotated[
    Path | None,
    typer.Option(help="Run folder; a run found there is resumed. Default named after the input."),
]
Publish = Annotated[Path | None, typer.Option(help="Keep the tables in this folder, too.")]
Suites = Annotated[
    list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")
]
Replace = Annotated[bool, typer.Option("--replace", help="Overwrite what has this name.")]
RandomSeed = Annotated[int, typer.Option(min=0)]


def takes[T](cls: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """A command whose options are the fields of a dataclass, of which it gets a value."""
    hints = get_type_hints(cls, include_extras=True)
    parameters = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            annotation=hints[field.name],
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
        )
        for field in fields(cls)  # type: ignore[arg-type]
    ]

    def wrap(work: Callable[[T], None]) -> Callable[..., None]:
        def command(**given: Any) -> None:
            work(cls(**given))

        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__name__, command.__doc__ = work.__name__, work.__doc__
        return command

    return wrap


def made[T](cls: type[T], asked: Any, **more: Any) -> T:
    """A value of which the fields are options of the same names; lists become tuples."""
    given = {f.name: getattr(asked, f.name) for f in fields(cls) if hasattr(asked, f.name)}  # type: ignore[arg-type]
    given |= more
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


def names(text: str) -> list[str]:
    """The names in "a, b,c", each once; empty ones are left out."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def refuse_dropped(why: str, given: Mapping[str, object]) -> None:
    """Refuse options that would do nothing: those that are not None. Raises: BadStudy."""
    from vap_core.base.errors import BadStudy

    named = [name for name, setting in given.items() if setting is not None]
    if named:
        raise BadStudy(f"{why}; leave {' and '.join(named)} out.")
