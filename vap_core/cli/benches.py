"""The command that measures what a step, a start and a query cost."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vap_core.cli.options import (
    DetectorName,
    EncoderName,
    StackName,
    TrackerName,
    Workers,
    stack_of,
)

if TYPE_CHECKING:
    from vap_core.cli.bench.measurement import Measurement, Table

app = typer.Typer()
BENCHES = (
    "loop",
    "suites",
    "stack",
    "policy",
    "eval",
    "profile",
    "scale",
    "engine",
    "embeddings",
    "query",
    "style",
    "measured",
)


@app.command()
def bench(
    what: Annotated[
        str,
        typer.Argument(
            help="loop: the prompted control loop; suites: every benchmark's simulator; "
            "stack: a stack's models; policy: the shipped policies; "
            "eval: our loop against lerobot's own, on equal CPU and in wall time; "
            "profile: a control step of eval by part; "
            "scale: cost against cameras, image size, candidates, batch and workers, and memory; "
            "engine: a Ray cluster on this machine against local processes; "
            "query: a question to a thousand recordings; "
            "embeddings: tables of PaliGemma's size, compared; style: how the source reads; "
            "measured: write docs/measured.md from what ships."
        ),
    ] = "loop",
    steps: Annotated[int, typer.Option(min=5, help="loop: control steps to time.")] = 60,
    workers: Workers = 2,
    stack: StackName = "foundation",
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
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
            help="policy, eval, profile, scale, engine, query, embeddings: a few steps, to see "
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
    Example: python -m vap_core bench stack --random-weights --detector sam3 --tracker edgetam
    Example: python -m vap_core bench profile --json data/results/bench_profile.json
    """
    from vap_core.base.errors import one_of

    parts = stack_of(stack, detector, encoder, tracker)
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

            text = bench_stack.run(parts, random=random_weights, device=device)
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
        case "query":
            from vap_core.cli.bench import query

            text = query.run(quick=quick)
        case "style":
            from vap_core.cli.bench import style

            text = style.run()
        case "measured":
            from vap_core.cli.bench import measured

            text = measured.run()
        case _:
            raise one_of("bench:", what, BENCHES)
    print(text)


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
