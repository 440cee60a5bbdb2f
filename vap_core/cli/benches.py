"""The command that measures what a step, a start and a query cost."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperCommand

from vap_core.cli.command import StackName, refuse_dropped

if TYPE_CHECKING:
    from vap_core.cli.bench.measurement import Measurement, Table

app = typer.Typer()
STACK_PARTS = ("stack",)
BENCHES = {
    "loop": ("steps",),
    "suites": ("workers",),
    "stack": (*STACK_PARTS, "random_weights", "device"),
    "policy": ("quick",),
    "eval": ("workers", "quick", "repeats", "lerobot_from", "json"),
    "profile": ("quick", "json"),
    "scale": ("episodes", "quick", "json"),
    "engine": ("workers", "quick"),
    "embeddings": ("quick", "json"),
}
"""The options that each bench reads, by parameter."""


class BenchCommand(TyperCommand):
    """A command whose context is of the type that its parameter is annotated with."""

    context_class = typer.Context


@app.command(cls=BenchCommand)
def bench(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            help="loop: the prompted control loop; suites: every benchmark's simulator; "
            "stack: a stack's models; policy: the shipped policies; "
            "eval: our loop against lerobot's own, on equal CPU and in wall time; "
            "profile: a control step of eval by part; "
            "scale: cost against cameras, image size, candidates, batch and workers, and memory; "
            "engine: a Ray cluster on this machine against local processes; "
            "embeddings: tables of PaliGemma's size, compared."
        ),
    ] = "loop",
    steps: Annotated[int, typer.Option(min=5, help="loop: control steps to time.")] = 60,
    workers: Annotated[int, typer.Option(min=1, help="suites, eval, engine: processes.")] = 2,
    stack: StackName = "foundation",
    random_weights: Annotated[
        bool,
        typer.Option(
            "--random-weights", help="stack: without weights; they change nothing about speed."
        ),
    ] = False,
    device: Annotated[
        str | None,
        typer.Option(help="stack: cpu or cuda; default VAP_DEVICE, or a GPU where there is one."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="policy, eval, profile, scale, engine, embeddings: a few steps, to see "
            "that it runs; its numbers mean nothing.",
        ),
    ] = False,
    repeats: Annotated[
        int, typer.Option(min=2, help="eval: how often every way to run is measured.")
    ] = 5,
    lerobot_from: Annotated[
        Path | None,
        typer.Option(
            help="eval: a checkout of this repository at an earlier commit (git worktree add DIR "
            "COMMIT), whose lerobot loop is measured, too, as the fixed denominator."
        ),
    ] = None,
    episodes: Annotated[
        int, typer.Option(min=5, help="scale: episodes over which memory is watched.")
    ] = 200,
    json: Annotated[
        Path | None,
        typer.Option(
            help="eval, profile, scale, embeddings: keep the measurement in this file, too. eval "
            "that was interrupted goes on after its last whole repeat, in FILE.part.json."
        ),
    ] = None,
) -> None:
    """Measure what a step, a start and a query cost, as shares and ratios within one run.

    Example: python -m vap_core bench suites
    Example: python -m vap_core bench stack --random-weights
        --stack foundation:detector=sam3,tracker=edgetam
    Example: python -m vap_core bench profile --json data/results/bench_profile.json
    """
    from vap_core.base.errors import one_of

    if what not in BENCHES:
        raise one_of("bench:", what, BENCHES)
    _refuse_unread(what, context)
    if json is not None:
        _check_writable(json)
    part = None if json is None else json.with_suffix(".part.json")
    # Each case imports its own benchmark alone: most are large, and some need an extra.
    match what:
        case "loop":
            from vap_core.cli.bench import loop

            text = loop.run(steps)
        case "suites":
            from vap_core.cli.bench import suites

            text = suites.run(workers)
        case "stack":
            from vap_core.cli.bench import stack as bench_stack

            text = bench_stack.run(stack, random=random_weights, device=device)
        case "policy":
            from vap_core.cli.bench import policy

            text = policy.run(quick)
        case "eval":
            from vap_core.cli.bench import eval as bench_eval
            from vap_core.cli.bench import eval_report

            found = bench_eval.measure(
                workers, lerobot_from, repeats=repeats, quick=quick, part=part
            )
            text = _kept(found, eval_report.tables, json)
        case "profile":
            from vap_core.cli.bench import profile

            text = _kept(profile.measure(quick=quick), profile.tables, json)
        case "scale":
            from vap_core.cli.bench import scale, scale_report

            text = _kept(scale.measure(episodes, quick), scale_report.tables, json)
        case "engine":
            from vap_core.cli.bench import engine

            text = engine.run(workers, quick)
        case "embeddings":
            from vap_core.cli.bench import embeddings

            text = _kept(embeddings.measure(quick), embeddings.tables, json)
    print(text)


def _refuse_unread(what: str, context: typer.Context) -> None:
    """Refuse options that the chosen bench does not read. Raises: BadStudy."""
    read = BENCHES[what]
    given = {}
    for name in context.params:
        source = context.get_parameter_source(name)
        if name != "what" and name not in read and source and source.name == "COMMANDLINE":
            given[_option(name)] = context.params[name]
    listed = ", ".join(map(_option, read)) or "no option"
    refuse_dropped(f"bench: {what} reads {listed}", given)


def _option(parameter: str) -> str:
    return "--" + parameter.replace("_", "-")


def _check_writable(json: Path) -> None:
    """Check, before the measurement, that its file can be written. Raises: BadOutput."""
    from vap_core.base.errors import BadOutput
    from vap_core.base.files import make_folder

    mend = "give --json another name"
    if json.is_dir():
        raise BadOutput(f"bench: {json} is a folder; {mend}.")
    make_folder(json.parent, "bench", mend)


def _kept(
    measurement: "Measurement",
    tables: "Callable[[Measurement], list[Table]]",
    json: Path | None,
) -> str:
    """A measurement as text; it is kept in the file `json`, too, where one is named."""
    from vap_core.cli.bench.measurement import as_text, write

    if json is not None:
        write(measurement, json)
        json.with_suffix(".part.json").unlink(missing_ok=True)
    return as_text(measurement, tables(measurement))
