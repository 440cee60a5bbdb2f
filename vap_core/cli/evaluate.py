"""Commands that run episodes: demo, suites, rollout, eval."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vap_core.cli.options import (
    DetectorName,
    EncoderName,
    StackName,
    TrackerName,
    Workers,
    names,
    stack_of,
)

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
        help="generic, hard-short, hard-long, soft, soft-aligned, soft-own, vap, vap-always-tint, "
        "mask-only, rewrite-only, vap-associated; bounds, which read the simulator: oracle-box, "
        "oracle-mask, oracle-track, wrong-mask; and the arms that `ablate` lists. With commas, or "
        "repeated. Default: generic,vap.",
    ),
]
POLICIES = (
    "scripted; mini-pi0; a lerobot checkpoint, as folder or hub id; "
    "the bounds: expert (reads the simulator), random."
)
PolicyName = Annotated[str, typer.Option("--policy", help=POLICIES)]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        help="Seed of the policy, the sensors and the starts: 0 starts every episode as it is "
        "listed, another moves arm, objects and light a little. Of a warm-up suite the seed of its "
        "list.",
    ),
]
RECORDED = (
    "Which episodes become a .rrd file: all; failures and one success in ten; none; "
    "or N per task and method. A retried error always does."
)
Recorded = Annotated[str, typer.Option("--record", metavar="all|failures|none|N", help=RECORDED)]
Video = Annotated[
    bool,
    typer.Option(
        "--video",
        help="Record AV1 video instead of JPEG pictures: far smaller, for about twice the "
        "recording time.",
    ),
]
Attention = Annotated[
    str,
    typer.Option(
        "--attention",
        metavar="all|token,colour,category,action",
        help="Record where a pi0, pi0.5, mini-pi0 or smolvla looks when it decides, over every "
        "view: the learned token, the colour word, the category word, the action expert.",
    ),
]
Retries = Annotated[
    int, typer.Option(min=0, help="How often an episode that ended in an error is tried again.")
]
PolicyTimeout = Annotated[
    float | None,
    typer.Option(
        "--policy-timeout",
        metavar="SECONDS",
        min=0.1,
        help="A call of the policy that takes longer ends its episode as an error. Default: none; "
        "after a minute a note says which episode waits.",
    ),
]
Meshes = Annotated[
    str,
    typer.Option(
        "--robots",
        help="plain, or menagerie: MuJoCo Menagerie's meshes, downloaded or found in "
        "MENAGERIE_ROOT.",
    ),
]


OwnObject = Annotated[
    str,
    typer.Option(
        "--object",
        help="An object that takes the target's place among its look-alikes, for example a scan "
        "that `objects import` brought; of the task's category. The expert tries its episodes "
        "first.",
    ),
]
WhatFor = Annotated[
    str,
    typer.Option(
        "--what-for", help="Why the list is read, in a few words, for the log: see `readings`."
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
    """The main job: personalise a scripted policy on two robots, generic against VAP, with
    recordings of every episode.

    Example: python -m vap_core demo --episodes 20
    """
    from dataclasses import replace

    from vap_core.evaluation.worker_server import start_server

    start_server("scripted", out)
    from vap_core.evaluation.study import DEMO

    study = replace(DEMO, episodes=episodes, seed=seed)
    _run(study, out, workers=workers, record_option="all", retries=1)


@app.command()
def suites() -> None:
    """List the benchmarks: robots, cameras, tasks, episodes, and the hashes of their episode lists.

    Example: python -m vap_core suites
    """
    from vap_core.evaluation.report import suites_table

    print(suites_table())


@app.command()
def rollout(
    suite: Annotated[
        str,
        typer.Option(help="A suite: see python -m vap_core suites; or the file of your own, .py."),
    ],
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
    attention: Attention = "",
    retries: Retries = 1,
    policy_timeout: PolicyTimeout = None,
    robots: Meshes = "plain",
    stack: StackName = "embedded",
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
    object: OwnObject = "",
    what_for: WhatFor = "",
) -> None:
    """Run tasks of a suite in closed loop, record every episode, and print the table.

    Example: python -m vap_core rollout --suite widowx-pick --task pick-bottle --episodes 4
        --out data/runs/bottle
    Example: python -m vap_core rollout --suite tabletop --task select-cup --object mug
        --episodes 4 --out data/runs/mug
    """
    _check_quickly([suite], policy, record)
    from vap_core.evaluation.worker_server import start_server

    start_server(policy, out)
    (suite_name,), files = _suite_names([suite])
    tasks = tuple((suite_name, name) for name in dict.fromkeys(task))
    study = _study(
        tasks=tasks,
        methods=method,
        policy=policy,
        episodes=episodes,
        seed=seed,
        robots=robots,
        stack=stack_of(stack, detector, encoder, tracker),
        object=object,
        suite_files=files,
    )
    _run(
        study,
        out,
        workers=workers,
        record_option=record,
        retries=retries,
        policy_timeout_s=policy_timeout,
        what_for=what_for,
        video=video,
        attention=attention,
    )


@app.command()
def ablate(
    name: Annotated[
        str | None,
        typer.Argument(help="The ablation; without a name they are listed with their arms."),
    ] = None,
    suite: Annotated[
        list[str] | None,
        typer.Option(help="A suite; repeatable. Default that of the ablation."),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the runs, one an arm; ablations share their arms, and what is there "
            "is not run again."
        ),
    ] = Path("data/runs/ablations"),
    policy: Annotated[
        str | None,
        typer.Option(help=f"{POLICIES} Default: mini-pi0 where one ships, else scripted."),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Episodes per task, spread evenly over its list. Default the whole list."
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Run every episode with so many seeds.")] = 1,
    workers: Workers = 2,
    record: Recorded = "none",
) -> None:
    """Change one thing of the method at a time, and compare every arm with the method itself on the
    same episodes. Interrupted, the same command goes on.

    Example: python -m vap_core ablate
    Example: python -m vap_core ablate form --suite simpler-bridge --episodes 6
    """
    from vap_core.base.errors import BadStudy, one_of
    from vap_core.base.tables import align
    from vap_core.evaluation.ablations.arms import ABLATIONS

    if name is None:
        rows = [["ablation", "question", "arms"]]
        for each, about in ABLATIONS.items():
            of = f"; of the policies {', '.join(about.policies)}" if about.policies else ""
            rows.append([each, about.question, ", ".join(about.names) + of])
        print(align(rows))
        print("next: python -m vap_core ablate form --suite simpler-bridge --episodes 6")
        return
    if name not in ABLATIONS:
        raise one_of("ablate: ablation", name, ABLATIONS)
    from vap_core.evaluation.ablations.run import ablate_text
    from vap_core.evaluation.policy_names import default_policy

    suite_names, files = _suite_names(suite or list(ABLATIONS[name].suites))
    if ABLATIONS[name].policies:
        if policy is not None:
            raise BadStudy(f"ablate {name}: it compares policies of its own; leave --policy out.")
        policy = next(iter(ABLATIONS[name].policies.values()))
    study = _study(
        tasks=_all_tasks(suite_names),
        suite_files=files,
        methods=list(ABLATIONS[name].names),
        policy=policy or default_policy(suite_names),
        episodes=episodes,
        seeds=seeds,
        follow="call",
    )
    print(ablate_text(name, study, out, workers=workers, record=_record(record)))


@app.command("eval")
def evaluate(
    suite: Annotated[
        list[str],
        typer.Option(
            help="A suite; all four benchmarks: all; or the file of your own, .py. Repeatable."
        ),
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
    temperature: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="mini-pi0: factor of the sampling noise, with which seeds differ in the policy, "
            "too. Default as its checkpoint says; the shipped ones have 0, no noise.",
        ),
    ] = None,
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
    attention: Attention = "",
    retries: Retries = 1,
    policy_timeout: PolicyTimeout = None,
    follow: Annotated[
        Literal["call", "step"],
        typer.Option(
            help="Take images and track when the policy is asked, or at every control step "
            "(smoother recordings)."
        ),
    ] = "call",
    audit: Annotated[
        bool,
        typer.Option(
            "--audit",
            help="Prove that tint and text reach the policy: every call is made with the raw "
            "input, too.",
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
    detector: DetectorName = "",
    encoder: EncoderName = "",
    tracker: TrackerName = "",
    object: OwnObject = "",
    what_for: WhatFor = "",
) -> None:
    """Run whole suites, and print the table with 95 % intervals. Interrupted, the same command goes
    on. With --object, the tasks of its category.

    Example: python -m vap_core eval --suite simpler-bridge --policy expert
    Example: python -m vap_core eval --suite tabletop --object mug --out data/runs/mug
    Example: python -m vap_core eval --suite all --methods generic,vap --episodes 4
        --out data/runs/all
    Example: python -m vap_core eval --suite all --engine ray --address 10.0.0.5:6379
    """
    from vap_core.base.errors import BadStudy

    _check_quickly(suite, policy, record)
    from vap_core.evaluation.worker_server import probable_policy, start_server

    likely = policy or probable_policy(suite)
    if likely and engine == "local":
        start_server(likely, out or _default_folder(likely, suite, object))
    from vap_core.evaluation.policy_names import PRIVILEGED, default_policy

    suite_names, files = _suite_names(suite)
    policy = policy or default_policy(suite_names)
    study = _study(
        tasks=_all_tasks(suite_names, object),
        suite_files=files,
        object=object,
        methods=method,
        policy=policy,
        episodes=episodes,
        seed=seed,
        robots=robots,
        stack=stack_of(stack, detector, encoder, tracker),
        seeds=seeds,
        images_every=images_every,
        follow=follow,
        audit=audit,
        temperature=temperature,
    )
    if address and engine != "ray":
        raise BadStudy("eval: --address needs --engine ray.")
    if engine == "ray":
        address = address or "127.0.0.1:6379"
    _run(
        study,
        out or _default_folder(policy, suite, object),
        workers=workers,
        record_option=record or ("none" if policy in PRIVILEGED else "failures"),
        retries=retries,
        policy_timeout_s=policy_timeout,
        address=address,
        what_for=what_for,
        video=video,
        attention=attention,
    )


def _check_quickly(suite_names: list[str], policy: str | None, record: str | None) -> None:
    """Check what can be checked before anything large is imported.

    Raises: BadStudy, BadSuite, UnknownName.
    """
    from vap_core.base.errors import BadSuite
    from vap_core.policies.names import check_policy_name

    if record is not None:
        _record(record)
    for name in suite_names:
        if name.endswith(".py") and not Path(name).is_file():
            raise BadSuite(f"suites: {name} is no Python file; name one that ends in .py.")
    if policy is not None:
        check_policy_name(policy)


def _default_folder(policy: str, suite_names: list[str], object: str) -> Path:
    """The folder of a run for which none was named."""
    parts = [Path(policy).name, *dict.fromkeys(Path(name).stem for name in suite_names)]
    if object:
        parts.append(object)
    return Path("data/runs", "-".join(parts))


def _suite_names(given: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """The suites that are named, each once, and the files of own suites among them.

    "all" names every benchmark; a name that ends in .py is a file, which is executed.
    """
    from vap_core.simulation.suites import BENCHMARKS, open_file

    suite_names: list[str] = []
    files = []
    for name in given:
        if name == "all":
            suite_names += BENCHMARKS
        elif name.endswith(".py"):
            suite_names.append(open_file(Path(name)).name)
            files.append(str(Path(name).resolve()))
        else:
            suite_names.append(name)
    return list(dict.fromkeys(suite_names)), tuple(dict.fromkeys(files))


def _all_tasks(suite_names: list[str], object: str = "") -> tuple[tuple[str, str], ...]:
    """Suite and task of every task of some suites; of those for the category of `object`, if any.

    Raises: BadStudy when no task has its category.
    """
    from vap_core.base.errors import BadStudy
    from vap_core.simulation.suites import suite

    category = ""
    if object:
        from vap_core.simulation.assets.objects import get_object

        category = get_object(object).category
    tasks = []
    for name in suite_names:
        for task in suite(name).tasks:
            if not object or task.category == category:
                tasks.append((name, task.name))
    if not tasks:
        raise BadStudy(
            f"--object: {object} is a {category}, and no task of {', '.join(suite_names)} asks for "
            "one; python -m vap_core suites lists the tasks."
        )
    return tuple(tasks)


def _study(
    tasks: tuple[tuple[str, str], ...], methods: list[str] | None, policy: str, **options: Any
) -> "Study":
    """The study of some tasks.

    Without `methods`, they are generic, and vap unless the policy reads the simulator.
    """
    from vap_core.evaluation.policy_names import PRIVILEGED
    from vap_core.evaluation.study import Study

    chosen = tuple(dict.fromkeys(names(",".join(methods or ()))))
    if not chosen:
        chosen = ("generic",) if policy in PRIVILEGED else ("generic", "vap")
    return Study(tasks, chosen, policy=policy, **options)


def _record(option: str) -> "Record":
    """What --record says. Raises: BadStudy."""
    from vap_core.base.errors import BadStudy

    match option:
        case "all" | "failures" | "none":
            return option
        case _ if option.isdigit():
            return int(option)
    raise BadStudy(f"--record {option}: say all, failures, none, or how many per task and method.")


def _run(
    study: "Study",
    out: Path,
    *,
    workers: int | None,
    record_option: str,
    retries: int,
    policy_timeout_s: float | None = None,
    address: str | None = None,
    what_for: str = "",
    video: bool = False,
    attention: str = "",
) -> None:
    """Run a study, on the Ray cluster at `address` if there is one, and print its table."""
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.cluster import ray_executor
    from vap_core.evaluation.engine import run
    from vap_core.evaluation.power import detectable_effect_text
    from vap_core.evaluation.processes import results
    from vap_core.evaluation.report import conclude
    from vap_core.evaluation.store import MANIFEST
    from vap_core.rollout.queries import named_queries

    if study.object and address:
        raise BadStudy("--object: other machines do not have your objects; use --engine local.")
    record = _record(record_option)
    queries = named_queries(names(attention))
    if record == "none" and (video or queries):
        raise BadStudy(
            "--video and --attention say how to record; with --record none leave them out."
        )
    if len(study.methods) > 1:
        for track, rows in _rows_by_track(study).items():
            print(f"{track}: {detectable_effect_text(rows)}", file=sys.stderr)
    if study.object and study.policy != "expert" and not (out / MANIFEST).exists():
        from vap_core.evaluation.feasibility import check_feasible

        print("the expert tries the episodes first ...", file=sys.stderr)
        for tried in check_feasible(study):
            print(tried, file=sys.stderr)
    if workers is None:
        workers = 0 if address else 2
    table = run(
        study,
        out,
        workers=workers,
        record=record,
        retries=retries,
        policy_timeout_s=policy_timeout_s,
        executor=ray_executor(address) if address else results,
        what_for=what_for,
        video=video,
        attention=queries,
    )
    print(conclude(study, table, out))
    if study.audit:
        from vap_core.evaluation.input_audit import verdict

        print("\n" + verdict(out))


def _rows_by_track(study: "Study") -> dict[str, list["EpisodeRow"]]:
    """The episodes of a study by suite and, where it has one, split."""
    tracks: dict[str, list[EpisodeRow]] = {}
    for suite, task in study.tasks:
        for row in study.rows(suite, task):
            track = row.suite
            if row.split:
                track = f"{row.suite} ({row.split})"
            tracks.setdefault(track, []).append(row)
    return tracks
