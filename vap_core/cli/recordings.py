"""Commands that find and open recordings: diagnose, query, view."""

import threading
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer

from vap_core.cli.options import refuse_dropped

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
    limit: Annotated[int, typer.Option(min=1, help="Failures to list.")] = 20,
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
            help='With --open: what it really is, "case 3: slip"; kept as a layer beside the '
            "recording."
        ),
    ] = None,
    note: Annotated[str, typer.Option(help="With --correct: why you think so.")] = "",
) -> None:
    """Say why episodes failed, list them, and open one at the frame that decided it; one that was
    not recorded is run again.

    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --method vap
    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --suite vlabench --case 2
        --open 0
    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --method generic --open 0
        --against vap --png beside.png
    Example: python -m vap_core diagnose data/runs/demo --where "margin < 0.3" --open 0
        --png why.png
    Example: python -m vap_core diagnose data/runs/demo --open 0 --correct "case 3: slip"
        --note "it held for a moment"
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.diagnosis.failures import failures_text, list_failures
    from vap_core.evaluation.diagnosis.recordings import correct_failure, recording_to_show

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
        layer = correct_failure(failures, number, correct, note)
        row = failures.table.iloc[number]
        named = f"{row['suite']} {row['task']} {row['method']} {row['episode']}"
        print(f"{named}: was {row['case']}, {row['sub_case']}; is {correct}\nwrote {layer}")
        return
    if show is None and png is None and mp4 is None:
        print(failures_text(failures, limit))
        return
    path, frame = recording_to_show(failures, number, against)
    print(f"{path}, frame {frame}: {failures.table['case_sentence'].iloc[number]}")
    _show_frame(path, frame, png, mp4)


@app.command()
def query(
    run: Annotated[Path, typer.Argument(help="Run folder with recordings.")],
    where: Annotated[
        str | None,
        typer.Argument(
            help="SQL condition on steps: margin, track_score, gap_cm, lift_cm, frame_index, "
            "method, outcome, case, steps, ...; with --serve on recordings."
        ),
    ] = None,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Recordings to list. Default 20.")
    ] = None,
    show: Annotated[
        int | None,
        typer.Option(
            "--open",
            min=0,
            help="Open this one of the list in the Rerun viewer, at the first such step.",
        ),
    ] = None,
    png: PictureInstead = None,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="Browse the recordings: a table to filter in Rerun's viewer, with a link to the "
            "deciding frame of each; served on 127.0.0.1 until Ctrl-C.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="With --serve: the port. Default a free one."),
    ] = None,
) -> None:
    """Ask all recordings of a run at once: in which of them, and at which steps, does a
    condition hold? Or browse them.

    Example: python -m vap_core query data/runs/demo "margin < 0.05 and success = false"
    Example: python -m vap_core query data/runs/demo
        "gap_cm < 1 and lift_cm < 1 and frame_index > 20" --open 0 --png near.png
    Example: python -m vap_core query data/runs/demo --serve
    Example: python -m vap_core query data/runs/demo "outcome = 'failure'" --serve
    """
    from vap_core.base.errors import BadStudy
    from vap_core.recording.query import first_match, format_result, run_query

    if serve:
        shown = {"--open": show, "--png": png, "--limit": limit}
        refuse_dropped("query: --serve shows every recording in a browser", shown)
        _serve(run, where, port)
        return
    if where is None:
        raise BadStudy('query: name a condition, such as "margin < 0.05", or add --serve.')
    refuse_dropped("query: --port is of --serve", {"--port": port})
    result = run_query(run, where)
    if show is None and png is None:
        print(format_result(result, limit or 20))
        return
    path, frame = first_match(result, show or 0)
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

    Example: python -m vap_core view data/runs/demo/recordings/*franka*000*vap.rrd
    Example: python -m vap_core view data/runs/demo/recordings/NAME.rrd --png shot.png --frame 20
    Example: python -m vap_core view data/runs/demo/recordings/*franka*000*vap.rrd --mp4 talk.mp4
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
        recording = _combined(recording, beside)
    if attention and png is not None:
        from vap_core.recording.attention_picture import attention_screenshot

        _check(recording)
        attention_screenshot(recording, png, frame_index=frame)
        print(f"wrote {png}")
    else:
        _show_frame(recording, frame, png, mp4)


def _combined(one: Path, other: Path) -> Path:
    """Two recordings in one file, beside the first."""
    from vap_core.recording import combine_recordings

    out = one.with_name(f"{one.stem}-beside-{other.stem}.rrd")
    combine_recordings({one.stem: one, other.stem: other}, out)
    print(f"wrote {out}")
    return out


def _serve(run: Path, where: str | None, port: int | None) -> None:
    """Serve a run's recordings until Ctrl-C, and open the viewer where there is a display."""
    from vap_core.recording.browser import serve_run
    from vap_core.recording.viewer import has_display, open_address

    with serve_run(run, where, port) as browser:
        n_failures = sum(row["outcome"] == "failure" for row in browser.rows)
        print(f"{len(browser.rows)} recordings, {n_failures} of failures, at {browser.url}")
        if where is not None:
            print(f"{browser.n_matching} match: {where}")
        for path, reason in browser.unreadable.items():
            print(f"note: {path} was left out: {reason}")
        if has_display():
            open_address(browser.url)
        else:
            print(_tunnel_text(browser.url))
        print("Ctrl-C ends it.", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            print()


def _tunnel_text(url: str) -> str:
    """How to open an address of this machine, which has no display, from one that has one.

    The links in the table hold the port, so it is the same one at both ends.
    """
    port = urlsplit(url).port
    return (
        "there is no display here; on a machine that has one, with the name of this one for HOST:\n"
        f"  ssh -N -L {port}:127.0.0.1:{port} HOST\n"
        f"  python -m rerun {url}"
    )


def _check(recording: Path) -> None:
    """Check that a recording can be read. Raises: BadRecording; of a leftover it names the mend."""
    from vap_core.base.commands import command
    from vap_core.base.errors import BadRecording
    from vap_core.recording import check_recording
    from vap_core.recording.file import LEFTOVER

    try:
        check_recording(recording)
    except BadRecording as error:
        if not (LEFTOVER.fullmatch(recording.name) and recording.is_file()):
            raise
        raise BadRecording(
            f"{recording} is a recording that was not finished; once the process that makes it has "
            f"ended, `{command('view', recording, '--recover')}` saves its steps."
        ) from error


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
