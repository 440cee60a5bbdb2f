"""The command that measures where a policy looks."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import Workers, names

app = typer.Typer()


@app.command()
def attention(
    run: Annotated[
        Path, typer.Argument(help="Run folder of eval or rollout, or a table that publish wrote.")
    ],
    suite: Annotated[
        str, typer.Option(help="Only these suites, with commas. Default: all of the run.")
    ] = "",
    method: Annotated[
        str,
        typer.Option(
            "--methods", "--method", help="Only these methods, with commas. Default: all."
        ),
    ] = "",
    policy: Annotated[
        str,
        typer.Option(
            help="Only the policy whose label in the table holds this, such as tabletop-longer@."
        ),
    ] = "",
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes per task and method, spread evenly. Default: all of the run."
        ),
    ] = None,
    explain: Annotated[
        int,
        typer.Option(
            min=0,
            help="Episodes per task and method that also get the causal measures: gradient times "
            "activation, and masked patches.",
        ),
    ] = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the tables; what is found there goes on. Default: RUN/attention, or "
            "data/runs/attention-TABLE."
        ),
    ] = None,
    publish: Annotated[
        Path | None,
        typer.Option(
            help="Keep the tables in this folder, too: data/results. What is there of other suites "
            "and methods stays."
        ),
    ] = None,
    record: Annotated[
        str,
        typer.Option(
            metavar="SUITE/TASK/METHOD/EPISODE",
            help="Measure nothing: record this episode with its maps, in the folder of --out.",
        ),
    ] = "",
    workers: Workers = 2,
) -> None:
    """Run the episodes of a run again, measure where every query looks, and print the patterns; or
    record one of them with its maps.

    Example: python -m vap_core measure attention data/results/mini_pi0.parquet --method soft,vap
        --suite vlabench
    Example: python -m vap_core measure attention data/results/first_policy.parquet
        --record simpler-bridge/put-camera/soft/22
    """
    from vap_core.analysis.attention import examples, replay, report
    from vap_core.analysis.attention.tables import publish as publish_tables
    from vap_core.base.commands import command

    if out is None:
        table = run.suffix == ".parquet"
        out = Path("data/runs") / f"attention-{run.stem}" if table else run / "attention"
    if record:
        path, step = examples.record(run, record, out / "recordings", out / "memory", policy)
        words = ("view", path, "--png", f"{path.stem}.png", "--attention", "--frame", str(step))
        print(f"wrote {path}\nnext: {command(*words)}")
        return
    wanted = replay.Wanted(
        suites=tuple(names(suite)),
        methods=tuple(names(method)),
        policy=policy,
        episodes=episodes,
        explain=explain,
    )
    found = replay.run_replay(run, out, wanted, workers=workers)
    if publish is not None:
        publish_tables(out, publish)
    print(report.text(found))
