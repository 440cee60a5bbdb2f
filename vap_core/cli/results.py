"""Commands about the rows of runs: report, publish."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import names

app = typer.Typer()


@app.command()
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Run folders of eval, rollout or demo, or published tables; several make one "
            "report."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for report.md, CSV and LaTeX tables and pictures. Default RUN/report; of "
            "a table data/runs/TABLE-report."
        ),
    ] = None,
    rescore: Annotated[
        bool,
        typer.Option(
            "--rescore",
            help="Judge finished runs again from their saved states, without a simulator, and say "
            "what changed.",
        ),
    ] = False,
) -> None:
    """Print and write what runs found: tables with intervals beside the paper's, paired
    comparisons, errors, provenance, pictures.

    Example: python -m vap_core report data/runs/demo
    Example: python -m vap_core report data/runs/expert-simpler-bridge --rescore
    Example: python -m vap_core report data/results/scripted.parquet --out data/runs/scripted-report
    """
    if rescore:
        from vap_core.evaluation.rescore import rescore as judge_again

        for run in runs:
            print(judge_again(run))
        return
    from vap_core.evaluation.report import report as conclude

    folder = out or _report_folder(runs[0])
    print(conclude(runs, folder))
    print(f"\nwrote {folder}: report.md, report.html, tables as CSV and LaTeX, pictures")


@app.command()
def publish(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Run folders of eval, rollout or demo, or tables that publish wrote."),
    ],
    to: Annotated[
        Path, typer.Option(help="The table to write, for example data/results/mine.parquet.")
    ],
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite that table.")] = False,
    supersede: Annotated[
        bool,
        typer.Option(
            "--supersede",
            help="Where a later source has read a method again, leave the earlier rows out.",
        ),
    ] = False,
    suite: Annotated[
        list[str] | None, typer.Option(help="Take the runs of this suite alone; repeatable.")
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            help="Take these methods alone, divided by commas; the others may be unfinished. "
            "Default all."
        ),
    ] = "",
) -> None:
    """Keep the results of finished runs as one small table, with their configurations.

    Example: python -m vap_core publish data/runs/expert-all data/runs/random-all
        --to data/results/bounds.parquet --replace
    Example: python -m vap_core publish data/results/mine.parquet data/runs/more
        --to data/results/mine.parquet --replace
    Example: python -m vap_core publish data/results/mine.parquet data/runs/vap-again
        --to data/results/mine.parquet --replace --supersede
    Example: python -m vap_core publish data/results/mine.parquet --suite simpler-bridge
        --methods generic,vap --to data/results/bridge.parquet
    """
    from vap_core.evaluation.publish import publish as write_table

    n_episodes = write_table(
        runs,
        to,
        replace=replace,
        supersede=supersede,
        suite_names=suite or (),
        methods=names(methods),
    )
    print(f"wrote {to}: {n_episodes} episodes")


def _report_folder(first_run: Path) -> Path:
    """Where a report goes: into the first run, or beside the runs where that is a table."""
    if first_run.suffix == ".parquet":
        return Path("data/runs") / f"{first_run.stem}-report"
    return first_run / "report"
