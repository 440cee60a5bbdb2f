"""Commands that look at what runs found: report, diagnose, query, view, publish."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.command import Replace, names, refuse_dropped

app = typer.Typer()

PictureInstead = Annotated[
    Path | None,
    typer.Option(help="With --open (default 0): save a picture of it instead, without a display."),
]


@app.command()
def diagnose(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Run folders of eval, rollout or demo, or tables that publish wrote."),
    ],
    suite: Annotated[str | None, typer.Option(help="Only failures of this suite.")] = None,
    task: Annotated[str | None, typer.Option(help="Only failures of this task.")] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="Only failures of this method.")
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(
            help="1 wrong mask, 2 views disagree, 3 right prompt but failed hand; unprompted; "
            "unlabelled."
        ),
    ] = None,
    sub_case: Annotated[
        str | None,
        typer.Option(help='Only this sub-case, for example "distractor vote" or "slip".'),
    ] = None,
    where: Annotated[
        str | None,
        typer.Option(
            help='SQL condition on the columns of the table: "margin < 0.3 and steps > 20".'
        ),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Failures to list.")] = 8,
    show: Annotated[
        int | None,
        typer.Option(
            "--open",
            min=0,
            help="Open this one of the list in the Rerun viewer, at its deciding frame.",
        ),
    ] = None,
    png: PictureInstead = None,
    mp4: Annotated[
        Path | None,
        typer.Option(
            help="With --open (default 0): write it as a film of what the policy saw instead."
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="With --open: another method on the same episode beside it, on one time line."
        ),
    ] = None,
    correct: Annotated[
        str | None,
        typer.Option(
            help='With --open: what it really is, "case 3: slip"; kept as a table beside the '
            "recordings."
        ),
    ] = None,
    note: Annotated[str, typer.Option(help="With --correct: why you think so.")] = "",
) -> None:
    """Say why episodes failed, list them, and open one at the frame that decided it; one that was
    not recorded is run again.

    Example: ./vap diagnose data/results/mini_pi0.parquet --method vap
    Example: ./vap diagnose data/results/mini_pi0.parquet --suite vlabench --case 2
        --open 0
    Example: ./vap diagnose data/results/mini_pi0.parquet --method generic --open 0
        --against vap --png beside.png
    Example: ./vap diagnose data/runs/demo --where "steps > 20" --open 0
        --png why.png
    Example: ./vap diagnose data/runs/demo --open 0 --correct "case 3: slip"
        --note "it held for a moment"
    """
    from vap_core.base.errors import BadStudy
    from vap_core.study.failures import (
        correct_failure,
        failures_text,
        list_failures,
        recording_to_show,
    )

    if against is not None and mp4 is not None:
        raise BadStudy(
            "diagnose: --mp4 films one recording, --against lays two side by side; leave one out."
        )
    if correct is None:
        refuse_dropped("diagnose: --note is of a correction", {"--note": note or None})
    else:
        shown = {"--png": png, "--mp4": mp4, "--against": against}
        refuse_dropped("diagnose: --correct shows nothing", shown)
    if show is None and (correct is not None or (against is not None and png is None)):
        option = "--against" if correct is None else "--correct"
        raise BadStudy(f"diagnose: {option} is of one failure; name it by --open and its number.")
    failures = list_failures(
        *runs, suite=suite, task=task, method=method, case=case, sub_case=sub_case, where=where
    )
    number = show or 0
    if correct is not None:
        table = correct_failure(failures, number, correct, note)
        row = failures.table.iloc[number]
        named = f"{row['suite']} {row['task']} {row['method']} {row['episode']}"
        print(f"{named}: was {row['case']}, {row['sub_case']}; is {correct}\nwrote {table}")
        return
    if show is None and png is None and mp4 is None:
        print(failures_text(failures, limit))
        return
    _check_viewer(png, mp4)
    path, frame = recording_to_show(failures, number, against)
    print(f"{path}, frame {frame}: {failures.table['case_sentence'].iloc[number]}")
    _show_frame(path, frame, png, mp4)


@app.command()
def query(
    run: Annotated[Path, typer.Argument(help="Run folder of eval, rollout or demo.")],
    question: Annotated[
        str | None,
        typer.Argument(
            help="SQL over the tables steps and episodes; or only a condition on steps, or the "
            "name of a ready one. Without it the columns and the ready ones are listed."
        ),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Lines to print.")] = 20,
    show: Annotated[
        int | None,
        typer.Option(
            "--open",
            min=0,
            help="Open the recording of this line in the Rerun viewer, at the first such step.",
        ),
    ] = None,
    png: PictureInstead = None,
) -> None:
    """Ask the steps and the episodes of a run: in which of them, and where, does a condition hold?

    Example: ./vap query data/runs/demo near-miss
    Example: ./vap query data/runs/demo "margin < 0.05 and success = false" --open 0
    Example: ./vap query data/runs/demo
        "select method, camera, avg(track_score) from steps group by method, camera"
    """
    from vap_core.study import steps
    from vap_core.study.table import printed

    if question is None:
        joined, episodes = steps.read(run)
        ready = "\n".join(f"  {name:14} {where}" for name, where in steps.QUESTIONS.items())
        print(f"steps: {', '.join(joined)}\n\nepisodes: {', '.join(episodes)}\n\n{ready}")
        return
    found = steps.query(run, question)
    if show is None and png is None:
        rows = [["#", *found.columns]]
        rows += [[str(i), *map(str, line)] for i, line in enumerate(found.head(limit).values)]
        print(f"{len(found)} found")
        print(printed(rows))
        return
    _check_viewer(png)
    path, frame = steps.recording_at(run, found, show or 0)
    print(f"{path}, frame {frame}")
    _show_frame(path, frame, png)


@app.command()
def view(
    recording: Annotated[Path, typer.Argument(help="A recording (.rrd) of eval, rollout or demo.")],
    frame: Annotated[
        int | None,
        typer.Option(min=0, help="The step to show first. Default 0; of a picture the middle one."),
    ] = None,
    png: Annotated[
        Path | None, typer.Option(help="Save a picture of that step instead, without a display.")
    ] = None,
    mp4: Annotated[
        Path | None,
        typer.Option(help="Write a film of what the policy saw, with the verdict, instead."),
    ] = None,
    attention: Annotated[
        bool,
        typer.Option("--attention", help="With --png: the attention maps of every view and query."),
    ] = False,
    beside: Annotated[
        Path | None,
        typer.Option(help="Another recording, to be shown beside it on one time line."),
    ] = None,
    recover: Annotated[
        bool,
        typer.Option(
            "--recover",
            help="First make a recording of .NAME.rrd.PID.tmp, which a killed process left.",
        ),
    ] = False,
) -> None:
    """Open a recording in Rerun's viewer, with its analytics and its look for updates turned off;
    or make a picture or a film of it.

    Example: ./vap view data/runs/demo/recordings/*franka*000*vap.rrd
    Example: ./vap view data/runs/demo/recordings/NAME.rrd --png shot.png --frame 20
    Example: ./vap view data/runs/demo/recordings/*franka*000*vap.rrd --mp4 talk.mp4
    """
    from vap_core.base.errors import BadStudy

    if mp4 is not None and png is None:
        refuse_dropped("view: --mp4 films every step", {"--frame": frame})
    if attention and png is None:
        raise BadStudy("view: --attention is a picture; name its file by --png.")
    if recover:
        from vap_core.recording import recover as recovered

        recording = recovered(recording)
        print(f"wrote {recording}")
    if beside is not None:
        from vap_core.recording import combine_recordings

        both = {recording.stem: recording, beside.stem: beside}
        recording = recording.with_name(f"{recording.stem}-beside-{beside.stem}.rrd")
        combine_recordings(both, recording)
        print(f"wrote {recording}")
    if attention and png is not None:
        from vap_core.recording.show import attention_screenshot

        _check(recording)
        _check_viewer(png)
        attention_screenshot(recording, png, frame_index=frame)
        print(f"wrote {png}")
    else:
        _show_frame(recording, frame, png, mp4)


def _check(recording: Path) -> None:
    """Check that a recording can be read. Raises: BadRecording; of a leftover it names the mend."""
    from vap_core.base.errors import BadRecording, command
    from vap_core.recording import read_summary
    from vap_core.recording.stream import LEFTOVER

    try:
        read_summary(recording)
    except BadRecording as error:
        if not (LEFTOVER.fullmatch(recording.name) and recording.is_file()):
            raise
        raise BadRecording(
            f"{recording} is a recording that was not finished; once the process that makes it has "
            f"ended, `{command('view', recording, '--recover')}` saves its steps."
        ) from error


def _check_viewer(png: Path | None, mp4: Path | None = None) -> None:
    """Before an episode is run again to be shown. Raises: MissingGL."""
    from vap_core.recording.show import check_viewer

    check_viewer(window=png is None and mp4 is None, picture=png is not None)


def _show_frame(
    recording: Path, frame: int | None, png: Path | None, mp4: Path | None = None
) -> None:
    """Open a recording in the viewer at one step, or make a picture of it, a film, or both."""
    from vap_core.recording import open_viewer, screenshot, write_film

    _check(recording)
    if mp4 is not None:
        n_pictures = write_film(recording, mp4)
        print(f"wrote {mp4}: {n_pictures} pictures")
    if png is not None:
        screenshot(recording, png, frame_index=frame, size=(1920, 1080))
        print(f"wrote {png}")
    if png is None and mp4 is None:
        open_viewer(recording, frame_index=frame or 0)


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
            help="Folder for report.md, report.html, tables and pictures. Default RUN/report; of "
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

    Example: ./vap report data/runs/demo
    Example: ./vap report data/runs/expert-simpler-bridge --rescore
    Example: ./vap report data/results/scripted.parquet --out data/runs/scripted-report
    """
    if rescore:
        from vap_core.study.report import rescore as judge_again

        for run in runs:
            print(judge_again(run))
        return
    from vap_core.study.report import report as conclude

    beside = runs[0] / "report"
    if runs[0].suffix == ".parquet":
        beside = Path("data/runs") / f"{runs[0].stem}-report"
    folder = out or beside
    print(conclude(runs, folder))
    print(f"\nwrote {folder}: report.md, tables as CSV, pictures\nopen {folder}/report.html")


@app.command()
def publish(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Run folders of eval, rollout or demo, or tables that publish wrote."),
    ],
    to: Annotated[
        Path, typer.Option(help="The table to write, for example data/results/mine.parquet.")
    ],
    replace: Replace = False,
    methods: Annotated[
        str,
        typer.Option(
            help="Take these methods alone, divided by commas; the others may be unfinished. "
            "Default all."
        ),
    ] = "",
) -> None:
    """Keep the results of finished runs as one small table, with their configurations.

    Example: ./vap publish data/runs/expert-all data/runs/random-all
        --to data/results/bounds.parquet --replace
    Example: ./vap publish data/results/mine.parquet data/runs/more
        --to data/results/mine.parquet --replace
    Example: ./vap publish data/runs/bridge --methods generic,vap
        --to data/results/bridge.parquet
    """
    from vap_core.study.results import publish as write_table

    n_episodes = write_table(runs, to, replace=replace, methods=names(methods))
    print(f"wrote {to}: {n_episodes} episodes")
