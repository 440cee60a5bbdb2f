"""The commands. Each parses, calls one function of the house, and prints; errors the user can mend are one line, status 2."""

import inspect
import os
import sys

import typer

from vap_core.base.errors import VapError
from vap_core.cli import evaluate as runs
from vap_core.cli import objects as own
from vap_core.cli import setup as machine

HELP = """Visual Attentive Prompting: steer a frozen policy to your own object, and see why it worked or failed.

Start with: python -m vap_core doctor, then python -m vap_core demo."""

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
    help=HELP,
)
for room in (own, runs, machine):
    app.add_typer(room.app)
INTERRUPTED = 130


def keep_examples(app: typer.Typer) -> None:
    """Have --help print every example on a line of its own, to be copied: click would fill them into one paragraph."""
    for command in app.registered_commands:
        command.help = (inspect.getdoc(command.callback) or "").replace(
            "\n\nExample:", "\n\n\b\nExample:"
        )
    for group in app.registered_groups:
        if group.typer_instance is not None:
            keep_examples(group.typer_instance)


keep_examples(app)


def main() -> None:
    """Run the command line; what the user can mend is printed as one line."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        app()
    except VapError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            print(
                "interrupted; run the same command again, it goes on where it stopped.",
                file=sys.stderr,
            )
        raise
