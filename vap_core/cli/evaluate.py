"""Commands that run episodes, and that read what runs left: demo, rollout, eval; rescore, report, publish."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vap_core.cli.options import StackName, Workers, names

if TYPE_CHECKING:
    from vap_core.evaluation.jobs import Record
    from vap_core.evaluation.study import Study
    from vap_core.simulation.types import EpisodeRow

app = typer.Typer()

Methods = Annotated[
    list[str] | None,
    typer.Option(
        "--methods",
        "--method",
        help="generic, hard-short, hard-long, soft, vap, mask-only, rewrite-only, vap-associated; bounds, which read the simulator: oracle-box, "
        "oracle-mask, oracle-track, wrong-mask. With commas, or repeated. Default: generic,vap.",
    ),
]
POLICIES = "scripted; mini-pi0; a lerobot checkpoint, as folder or hub id; the bounds: expert (reads the simulator), random."
PolicyName = Annotated[str, typer.Option("--policy", help=POLICIES)]
Seed = Annotated[
    int,
    typer.Option(
        min=0, help="Seed of the policy and the sensors; of a warm-up suite's episode list, too."
    ),
]
RECORDED = "Which episodes become a .rrd file: all; failures and one success in ten; none; or N per task and method. A retried error always does."
Recorded = Annotated[str, typer.Option("--record", metavar="all|failures|none|N", help=RECORDED)]
Video = Annotated[
    bool,
    typer.Option(
        "--video",
        help="Record AV1 video instead of JPEG pictures: far smaller, for about twice the recording time.",
    ),
]
Attention = Annotated[
    bool,
    typer.Option(
        "--attention", help="Record where a pi0 or mini-pi0 looks when it decides, over every view."
    ),
]
Retries = Annotated[
    int, typer.Option(min=0, help="How often an episode that ended in an error is tried again.")
]
Meshes = Annotated[
    str,
    typer.Option(
        "--robots",
        help="plain, or menagerie: MuJoCo Menagerie's meshes, downloaded or found in MENAGERIE_ROOT.",
    ),
]


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/demo"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and method.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode list.")] = 0,
) -> None:
    """The main job: personalise a scripted policy on two robots, generic against VAP, with recordings of every episode.

    Example: python -m vap_core demo --episodes 20
    """
    from dataclasses import replace

    from vap_core.evaluation.study import DEMO

    _run(replace(DEMO, episodes=episodes, seed=seed), out, workers, "all", retries=1)


@app.command()
def suites() -> None:
    """List the benchmarks: robots, cameras, tasks, episodes, and the hashes of their episode lists.

    Example: python -m vap_core suites
    """
    from vap_core.evaluation.report import suites_table

    print(suites_table())


@app.command()
def rollout(
    suite: Annotated[str, typer.Option(help="A suite: see python -m vap_core suites.")],
    task: Annotated[
        list[str], typer.Option(help="Task of the suite, for example pick-cup; repeatable.")
    ],
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")],
    method: Methods = None,
    policy: PolicyName = "scripted",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and method.")] = 20,
    seed: Seed = 0,
    workers: Workers = 2,
    record: Recorded = "all",
    video: Video = False,
    attention: Attention = False,
    retries: Retries = 1,
    robots: Meshes = "plain",
    stack: StackName = "embedded",
) -> None:
    """Run tasks of a suite in closed loop, record every episode, and print the table.

    Example: python -m vap_core rollout --suite widowx-pick --task pick-bottle --episodes 4 --out data/runs/bottle
    """
    tasks = tuple((suite, name) for name in dict.fromkeys(task))
    study = _study(
        tasks, method, policy=policy, episodes=episodes, seed=seed, robots=robots, stack=stack
    )
    _run(study, out, workers, record, retries, video=video, attention=attention)


@app.command("eval")
def evaluate(
    suite: Annotated[
        list[str], typer.Option(help="A suite, or all four benchmarks: all; repeatable.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run folder; a run found there is resumed. Default data/runs/POLICY-SUITE."
        ),
    ] = None,
    method: Methods = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help=f"{POLICIES} Default: mini-pi0 where one ships for every suite, else scripted."
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes per task, spread evenly over its list. Default the whole list."
        ),
    ] = None,
    seed: Seed = 0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Run every episode with so many seeds, from --seed on.")
    ] = 1,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Jobs at once. Default 2 processes; on a cluster, its CPUs."),
    ] = None,
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="local: processes of this machine; ray: a Ray cluster."),
    ] = "local",
    address: Annotated[
        str | None, typer.Option(help="ray: host:port of the cluster. Default 127.0.0.1:6379.")
    ] = None,
    record: Annotated[
        str | None,
        typer.Option(
            "--record",
            metavar="all|failures|none|N",
            help=f"{RECORDED} Default failures; none for the bounds.",
        ),
    ] = None,
    video: Video = False,
    attention: Attention = False,
    retries: Retries = 1,
    follow: Annotated[
        Literal["call", "step"],
        typer.Option(
            help="Take images and track when the policy is asked, or at every control step (smoother recordings)."
        ),
    ] = "call",
    audit: Annotated[
        bool,
        typer.Option(
            "--audit",
            help="Prove that tint and text reach the policy: every call is made with the raw input, too.",
        ),
    ] = False,
    images_every: Annotated[
        int,
        typer.Option(
            min=0, help="Expert and random: render all cameras every so many steps; 0 never."
        ),
    ] = 0,
    robots: Meshes = "plain",
    stack: StackName = "embedded",
) -> None:
    """Run whole suites, and print the table with 95 % intervals. Interrupted, the same command goes on.

    Example: python -m vap_core eval --suite simpler-bridge --policy expert
    Example: python -m vap_core eval --suite all --methods generic,vap --episodes 4 --out data/runs/all
    Example: python -m vap_core eval --suite all --engine ray --address 10.0.0.5:6379
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.policy_names import PRIVILEGED, default_policy
    from vap_core.simulation import suites as known

    names = dict.fromkeys(
        name for each in suite for name in (known.BENCHMARKS if each == "all" else [each])
    )
    tasks = tuple((name, task.name) for name in names for task in known.suite(name).tasks)
    policy = policy or default_policy(names)
    options = {"seeds": seeds, "images_every": images_every, "follow": follow, "audit": audit}
    study = _study(
        tasks,
        method,
        policy=policy,
        episodes=episodes,
        seed=seed,
        robots=robots,
        stack=stack,
        **options,
    )
    if address and engine != "ray":
        raise BadStudy("eval: --address needs --engine ray.")
    folder = out or Path(f"data/runs/{Path(policy).name}-{'-'.join(dict.fromkeys(suite))}")
    record = record or ("none" if policy in PRIVILEGED else "failures")
    _run(
        study,
        folder,
        workers,
        record,
        retries,
        (address or "127.0.0.1:6379") if engine == "ray" else None,
        video=video,
        attention=attention,
    )


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
            help="1 wrong mask, 2 views disagree, 3 right prompt but failed hand; unprompted; unlabelled."
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
    png: Annotated[
        Path | None,
        typer.Option(help="With --open: save a picture of it instead, without a display."),
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
            help='With --open: what it really is, "case 3: slip"; kept as a layer beside the recording.'
        ),
    ] = None,
    note: Annotated[str, typer.Option(help="With --correct: why you think so.")] = "",
) -> None:
    """Say why episodes failed, list them, and open one at the frame that decided it; one that was not recorded is run again.

    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --method vap
    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --suite vlabench --case 2 --open 0
    Example: python -m vap_core diagnose data/results/mini_pi0.parquet --method generic --open 0 --against vap --png beside.png
    Example: python -m vap_core diagnose data/runs/demo --where "margin < 0.3" --open 0 --png why.png
    Example: python -m vap_core diagnose data/runs/demo --open 0 --correct "case 3: slip" --note "it held for a moment"
    """
    from vap_core.evaluation.diagnosis.failures import (
        deciding_frame,
        failures_text,
        list_failures,
    )
    from vap_core.evaluation.diagnosis.recordings import (
        correct_failure,
        recording_of,
        side_by_side_recording,
    )

    failures = list_failures(
        *runs, suite=suite, task=task, method=method, case=case, sub_case=sub_case, where=where
    )
    if correct is not None:
        print(f"wrote {correct_failure(failures, show or 0, correct, note)}")
        return
    if show is None and png is None:
        print(failures_text(failures, limit))
        return
    number = show or 0
    path = (
        side_by_side_recording(failures, number, against)
        if against
        else recording_of(failures, number)
    )
    frame = deciding_frame(failures, number)
    print(f"{path}, frame {frame}: {failures.table['case_sentence'].iloc[number]}")
    _look(path, frame, png)


@app.command()
def query(
    run: Annotated[Path, typer.Argument(help="Run folder with recordings.")],
    where: Annotated[
        str,
        typer.Argument(
            help="SQL condition on steps: margin, track_score, gap_cm, lift_cm, frame_index, method, outcome, case, steps, ..."
        ),
    ],
    limit: Annotated[int, typer.Option(min=1, help="Recordings to list.")] = 20,
    show: Annotated[
        int | None,
        typer.Option(
            "--open",
            min=0,
            help="Open this one of the list in the Rerun viewer, at the first such step.",
        ),
    ] = None,
    png: Annotated[
        Path | None,
        typer.Option(help="With --open: save a picture of it instead, without a display."),
    ] = None,
) -> None:
    """Ask all recordings of a run at once: in which of them, and at which steps, does a condition hold?

    Example: python -m vap_core query data/runs/demo "margin < 0.05 and success = false"
    Example: python -m vap_core query data/runs/demo "gap_cm < 1 and lift_cm < 1 and frame_index > 20" --open 0 --png near.png
    """
    from vap_core.recording.query import first_match, format_result, run_query

    result = run_query(run, where)
    if show is None and png is None:
        print(format_result(result, limit))
        return
    path, frame = first_match(result, show or 0)
    print(f"{path}, frame {frame}")
    _look(path, frame, png)


@app.command()
def rescore(
    run: Annotated[Path, typer.Argument(help="Run folder of eval, rollout or demo.")],
) -> None:
    """Judge a finished run again from its saved states, without a simulator, and say what changed.

    Example: python -m vap_core rescore data/runs/expert-simpler-bridge
    """
    from vap_core.evaluation.rescore import rescore as judge_again

    print(judge_again(run))


@app.command()
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Run folders of eval, rollout or demo, or published tables; several make one report."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for report.md, CSV and LaTeX tables and pictures. Default RUN/report."
        ),
    ] = None,
) -> None:
    """Print and write what runs found: tables with intervals beside the paper's, paired comparisons, errors, provenance, pictures.

    Example: python -m vap_core report data/runs/demo
    Example: python -m vap_core report data/results/scripted.parquet --out data/runs/scripted-report
    """
    from vap_core.evaluation.report import report as conclude

    place = out or (
        Path("data/runs") / f"{runs[0].stem}-report"
        if runs[0].suffix == ".parquet"
        else runs[0] / "report"
    )
    print(conclude(runs, place))
    print(f"\nwrote {place}: report.md, tables as CSV and LaTeX, pictures")


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
) -> None:
    """Keep the results of finished runs as one small table, with their configurations.

    Example: python -m vap_core publish data/runs/expert-all data/runs/random-all --to data/results/bounds.parquet --replace
    Example: python -m vap_core publish data/results/mine.parquet data/runs/more --to data/results/mine.parquet --replace
    """
    from vap_core.evaluation.publish import publish as keep

    print(f"wrote {to}: {keep(runs, to, replace=replace)} episodes")


def _study(
    tasks: tuple[tuple[str, str], ...], methods: list[str] | None, *, policy: str, **options: Any
) -> "Study":
    from vap_core.evaluation.policy_names import PRIVILEGED
    from vap_core.evaluation.study import Study

    asked = names(",".join(methods or ()))
    usual = ("generic",) if policy in PRIVILEGED else ("generic", "vap")
    return Study(tasks, tuple(dict.fromkeys(asked)) or usual, policy=policy, **options)


def _look(recording: Path, frame: int, png: Path | None) -> None:
    """Open a recording in the viewer at one step, or picture it."""
    from vap_core.recording import open_viewer, screenshot

    if png is None:
        open_viewer(recording, frame_index=frame)
    else:
        screenshot(recording, png, frame_index=frame, size=(1920, 1080))
        print(f"wrote {png}")


def _record(said: str) -> "Record":
    from vap_core.base.errors import BadStudy

    match said:
        case "all" | "failures" | "none":
            return said
        case _ if said.isdigit():
            return int(said)
    raise BadStudy(f"--record {said}: say all, failures, none, or how many per task and method.")


def _run(
    study: "Study",
    out: Path,
    workers: int | None,
    said: str,
    retries: int,
    address: str | None = None,
    **recorded: Any,
) -> None:
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.cluster import ray_executor
    from vap_core.evaluation.engine import run
    from vap_core.evaluation.power import detectable_effect_text
    from vap_core.evaluation.processes import results
    from vap_core.evaluation.report import conclude

    record = _record(said)
    if record == "none" and any(recorded.values()):
        raise BadStudy(
            "--video and --attention say how to record; with --record none leave them out."
        )
    if len(study.methods) > 1:
        tracks: dict[str, list[EpisodeRow]] = {}
        for row in (row for suite, task in study.tasks for row in study.rows(suite, task)):
            tracks.setdefault(f"{row.suite} ({row.split})" if row.split else row.suite, []).append(
                row
            )
        for track, rows in tracks.items():
            print(f"{track}: {detectable_effect_text(rows)}", file=sys.stderr)
    table = run(
        study,
        out,
        workers=workers or (0 if address else 2),
        record=record,
        retries=retries,
        executor=ray_executor(address) if address else results,
        **recorded,
    )
    print(conclude(study, table, out))
    if study.audit:
        from vap_core.evaluation.input_audit import verdict

        print("\n" + verdict(out))
