"""The commands.

Each parses its options, calls one function of the package, and prints. An error that the user can
correct is one line, with status 2.
"""

import inspect
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from traceback import walk_stack
from typing import Any

import typer

from vap_core.base import errors
from vap_core.base.errors import BadOutput, VapError, missing_part, printable
from vap_core.cli import bench, look, machine, measure, own, run, serve

HELP = """Visual Attentive Prompting: steer a frozen policy to your own object, and see why it
worked or failed.

Start with: ./vap doctor, then ./vap demo."""
INTERRUPTED = 130
PATIENCE_S = 5.0
AS_WRITTEN = re.compile(r"^(?:--[\w-]+=)?(~\w*|\$\w+|\$\{\w+\})(?:/|$)")
"""How a word begins that the shell expands unless it is quoted."""

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
    help=HELP,
)
for module in (run, look, own, serve, machine, bench):
    app.add_typer(module.app)
app.add_typer(measure.app, name="measure")


def keep_examples(app: typer.Typer) -> None:
    """Have --help print every example on a line of its own, to be copied.

    Click would fill them into one paragraph. In a docstring, the further lines of a long example
    are indented.
    """
    for command in app.registered_commands:
        text = inspect.getdoc(command.callback) or ""
        text = text.replace("\n    ", " ")
        command.help = text.replace("\n\nExample:", "\n\n\b\nExample:")
    for group in app.registered_groups:
        if group.typer_instance is not None:
            keep_examples(group.typer_instance)


keep_examples(app)


class Terminal:
    """A stream whose text is `printable`; `kept` are the control characters that pass.

    The bars of tqdm move by two: a carriage return, and one line up.
    """

    def __init__(self, stream: Any, kept: str = "\n\t") -> None:
        self._stream = stream
        self._kept = kept

    def write(self, text: str) -> int:
        """Write the text; the number of its characters."""
        shown = "\x1b[A".join(printable(p, self._kept) for p in text.split("\x1b[A"))
        with self._writing():
            self._stream.write(shown)
        return len(text)

    def flush(self) -> None:
        with self._writing():
            self._stream.flush()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Raises: BadOutput where nothing can be printed; notes and bars are left out then."""
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            if self._stream is not sys.__stderr__:
                why = error.strerror or error
                raise BadOutput(f"print: what was found cannot be printed ({why}).") from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def tell(thread: int) -> None:
    """Keep the clocks of bars moving; without one say in longer and longer intervals which
    functions run, and how long.
    """
    start, wait_s = time.monotonic(), PATIENCE_S
    while True:
        time.sleep(1.0)
        from tqdm import tqdm  # a command of less than a second needs none

        bars = list(tqdm._instances)
        for bar in bars:
            bar.refresh()
        seconds = time.monotonic() - start
        if bars or seconds < wait_s:
            continue
        codes = [frame.f_code for frame, _ in walk_stack(sys._current_frames()[thread])]
        names = [
            code.co_name.strip("_").replace("_", " ")
            for code in codes
            if re.search("vap_core/(?!cli)", code.co_filename) and code.co_name.isidentifier()
        ]
        told = ", ".join([sys.argv[1], *reversed(names[-2:])])
        print(f"{told}: {seconds:.0f} s so far", file=sys.stderr)
        wait_s *= 2


def main() -> None:
    """Run the command line; an error that the user can correct is printed as one line."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    nowhere = open(os.devnull, "w")  # noqa: SIM115  for a stream that was closed
    out = Terminal(sys.stdout or nowhere)
    errors = Terminal(sys.stderr or nowhere, "\n\t\r")
    with nowhere, redirect_stdout(out), redirect_stderr(errors):
        if sys.__stderr__ is not None and sys.__stderr__.isatty() and "serve" not in sys.argv:
            threading.Thread(target=tell, args=(threading.get_ident(),), daemon=True).start()
        _run()


def _own_suites() -> str:
    """The command again, with the files of the own suites of the runs that it names."""
    kept = [Path(word, ".suites") for word in sys.argv[1:]]
    files = [file.read_text() for file in kept if file.is_file()] or ["FILE.py"]
    line = errors.command(*sys.argv[1:], environment={"VAP_SUITES": ":".join(files)})
    return f" An own suite is found by its file: {line}"


def _run() -> None:
    """Run the command that the words name."""
    try:
        try:
            for word in sys.argv[1:]:
                if found := AS_WRITTEN.search(word):
                    raise VapError(
                        f"{word}: the shell left {found[1]} as it is; write the path without "
                        "quotes, and a blank for the =."
                    )
            app(prog_name="./vap")
        finally:
            sys.stdout.flush()
    except VapError as error:
        said = str(error) + (_own_suites() if "VAP_SUITES" in str(error) else "")
        print(f"error: {printable(said, '')}", file=sys.stderr)
        sys.exit(2)
    except ModuleNotFoundError as error:
        part = missing_part(error)
        if part is None:
            raise
        print(f"error: {part}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            print(
                "interrupted; a run folder keeps what is finished. To go on: "
                + errors.command(*sys.argv[1:]),
                file=sys.stderr,
            )
        raise
