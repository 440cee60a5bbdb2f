"""Commands that run episodes: demo, suites, rollout, eval, ablate."""

import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vap_core.base.errors import LARGEST_SEED
from vap_core.cli.command import RunFolder, StackName, Workers, names, takes

if TYPE_CHECKING:
    from vap_core.study.engine import Record
    from vap_core.study.trials import Study

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
Policy = Annotated[
    str | None,
    typer.Option(
        help="scripted; mini-pi0; a lerobot checkpoint, as folder or hub id; the bounds: expert "
        "(reads the simulator), random. Default: mini-pi0 where one ships for every suite, else "
        "scripted."
    ),
]
PerTask = Annotated[
    int | None,
    typer.Option(
        min=1, help="Episodes per task, spread evenly over its list. Default the whole list."
    ),
]
SplitName = Annotated[
    str,
    typer.Option(
        help="One split of a suite's list: simpler-fractal has 'visual matching' and 'variant "
        "aggregation'. Default all.",
    ),
]
Recorded = Annotated[
    str | None,
    typer.Option(
        metavar="all|failures|none|N",
        help="Which episodes become a .rrd file: all; failures and one success in ten; none; or N "
        "per task and method. A retried error always does. Default failures; all for rollout, none "
        "for the bounds and ablate.",
    ),
]


@dataclass(frozen=True)
class Asked:
    """The options of rollout, which eval shares; those that a Study has are its fields."""

    suite: Annotated[
        list[str],
        typer.Option(
            help="A suite; all four benchmarks: all; or the file of your own, .py. Repeatable."
        ),
    ]
    task: Annotated[
        list[str] | None, typer.Option(help="Task of the suite; repeatable. Default all.")
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run folder; a run found there is resumed. Default data/runs/POLICY-SUITE."
        ),
    ] = None
    methods: Methods = None
    policy: Policy = None
    episodes: PerTask = None
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=LARGEST_SEED - 1,
            help="Seed of the policy, the sensors and the starts: 0 starts every episode as it is "
            "listed, another moves arm, objects and light a little. Of a warm-up suite the seed of "
            "its list.",
        ),
    ] = 0
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Jobs at once. Default 2 processes; on a cluster, its CPUs."),
    ] = None
    record: Recorded = None
    attention: Annotated[
        str,
        typer.Option(
            metavar="all|token,colour,category,action",
            help="Record where a pi0, pi0.5, mini-pi0 or smolvla looks when it decides, over every "
            "view: the learned token, the colour word, the category word, the action expert.",
        ),
    ] = ""
    stack: StackName = "embedded"
    object: Annotated[
        str,
        typer.Option(
            help="An object that takes the target's place among its look-alikes, for example a "
            "scan that `objects import` brought; of the task's category. The expert tries its "
            "episodes first.",
        ),
    ] = ""


@dataclass(frozen=True)
class AskedOfAll(Asked):
    """The options of eval."""

    seeds: Annotated[
        int, typer.Option(min=1, help="Run every episode with so many seeds, from --seed on.")
    ] = 1
    split: SplitName = ""
    temperature: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR",
            help="mini-pi0: factor of the sampling noise, with which seeds differ in the policy, "
            "too. Default as its checkpoint says; the shipped ones have 0, no noise.",
        ),
    ] = None
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Run on this Ray cluster, not in processes of this machine."
        ),
    ] = None
    video: Annotated[
        bool,
        typer.Option(
            "--video",
            help="Record AV1 video instead of JPEG pictures: far smaller, for about twice the "
            "recording time.",
        ),
    ] = False
    retries: Annotated[
        int, typer.Option(min=0, help="How often an episode that ended in an error is tried again.")
    ] = 1
    policy_timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=0.1,
            help="A call of the policy that takes longer ends its episode as an error. Default: "
            "none; after a minute a note says which episode waits.",
        ),
    ] = None
    follow: Annotated[
        Literal["call", "step"],
        typer.Option(
            help="Take images and track when the policy is asked, or at every control step "
            "(smoother recordings)."
        ),
    ] = "call"
    audit: Annotated[
        bool,
        typer.Option(
            "--audit",
            help="Prove that tint and text reach the policy: every call is made with the raw "
            "input, too.",
        ),
    ] = False
    robots: Annotated[
        str,
        typer.Option(
            help="plain, or menagerie: MuJoCo Menagerie's meshes, downloaded or found in "
            "MENAGERIE_ROOT.",
        ),
    ] = "plain"


@dataclass(frozen=True)
class AskedOfDemo:
    """The options of demo."""

    out: RunFolder = Path("data/runs/demo")
    workers: Workers = 2
    episodes: Annotated[int, typer.Option(min=1, help="Episodes per task and method.")] = 20
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode list.")] = 0


@app.command()
@takes(AskedOfDemo)
def demo(asked: AskedOfDemo) -> None:
    """The main job: personalise a scripted policy on two robots, generic against VAP, with
    recordings of every episode.

    Example: ./vap demo --episodes 20
    """
    from vap_core.study.engine import start_server

    start_server("scripted", asked.out)
    from vap_core.study.trials import DEMO

    study = replace(DEMO, episodes=asked.episodes, seed=asked.seed)
    run_study(study, AskedOfAll([], out=asked.out, workers=asked.workers, record="all"))


@app.command()
def suites() -> None:
    """List the benchmarks: robots, cameras, tasks, episodes, and the hashes of their episode lists.

    Example: ./vap suites
    """
    from vap_core.study.report import suites_table

    print(suites_table())


@app.command()
@takes(Asked)
def rollout(asked: Asked) -> None:
    """Run tasks of a suite in closed loop, 20 episodes each, track at every step, record every
    episode, and print the table.

    Example: ./vap rollout --suite widowx-pick --task pick-bottle --episodes 4
        --out data/runs/bottle
    Example: ./vap rollout --suite tabletop --task select-cup --object mug
        --episodes 4 --out data/runs/mug
    """
    given = {field.name: getattr(asked, field.name) for field in fields(Asked)}
    usual = {"policy": "scripted", "episodes": 20, "record": "all"}
    given |= {name: given[name] or value for name, value in usual.items()}
    run_suites(AskedOfAll(**given, follow="step"))


@app.command("eval")
@takes(AskedOfAll)
def evaluate(asked: AskedOfAll) -> None:
    """Run whole suites, and print the table with 95 % intervals. Interrupted, the same command goes
    on. With --object, the tasks of its category.

    Example: ./vap eval --suite simpler-bridge --policy scripted
        --methods generic,vap --episodes 4 --out data/runs/bridge
    Example: ./vap eval --suite simpler-bridge --policy expert
    Example: ./vap eval --suite tabletop --object mug --out data/runs/mug-all
    Example: ./vap eval --suite all --methods generic,vap --episodes 4
        --out data/runs/all
    Example: ./vap eval --suite all --ray 10.0.0.5:6379
    """
    run_suites(asked)


@dataclass(frozen=True)
class AskedOfAblation:
    """The options of ablate."""

    name: Annotated[
        str | None,
        typer.Argument(help="The ablation; without a name they are listed with their arms."),
    ] = None
    suite: Annotated[
        list[str] | None,
        typer.Option(help="A suite; repeatable. Default that of the ablation."),
    ] = None
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the runs, one an arm; ablations share their arms, and what is there "
            "is not run again."
        ),
    ] = Path("data/runs/ablations")
    policy: Policy = None
    episodes: PerTask = None
    seeds: Annotated[int, typer.Option(min=1, help="Run every episode with so many seeds.")] = 1
    split: SplitName = ""
    workers: Workers = 2


@app.command()
@takes(AskedOfAblation)
def ablate(asked: AskedOfAblation) -> None:
    """Change one thing of the method at a time, and compare every arm with the method itself on the
    same episodes; draws OUT/NAME.png. Interrupted, the same command goes on.

    Example: ./vap ablate
    Example: ./vap ablate form --suite simpler-bridge --episodes 6
    Example: ./vap ablate rewrite --suite simpler-fractal --split "visual matching"
    """
    from vap_core.base.errors import one_of
    from vap_core.study.methods import ABLATIONS

    name = asked.name
    if name is None:
        from vap_core.study.table import printed

        rows = [["ablation", "question", "arms"]]
        for each, about in ABLATIONS.items():
            rows.append([each, about.question, ", ".join(about.names)])
        print(printed(rows))
        print("next: ./vap ablate form --suite simpler-bridge --episodes 6")
        return
    if name not in ABLATIONS:
        raise one_of("ablate: ablation", name, ABLATIONS)
    from vap_core.study.ablations import ablate_text

    about = ABLATIONS[name]
    given: dict[str, Any] = {"suite": asked.suite or list(about.suites)}
    given |= {"methods": list(about.names), "policy": asked.policy}
    of_study = {field: getattr(asked, field) for field in ("episodes", "seeds", "split")}
    study = study_of(AskedOfAll(**given, **of_study))
    print(ablate_text(name, study, asked.out, workers=asked.workers))


def run_suites(asked: AskedOfAll) -> None:
    """Run the study that some options name. Raises: as `run_study`; BadSuite, UnknownName.

    What can be checked before anything large is imported is checked first.
    """
    from vap_core.base.errors import BadSuite
    from vap_core.policies.names import check_policy_name

    if asked.record is not None:
        record_of(asked.record)
    for name in asked.suite:
        if name.endswith(".py") and not Path(name).is_file():
            raise BadSuite(f"suites: {name} is no Python file; name one that ends in .py.")
    if asked.policy is not None:
        check_policy_name(asked.policy)
    from vap_core.study.engine import probable_policy, start_server

    likely = asked.policy or probable_policy(asked.suite)
    if likely and not asked.ray:
        start_server(likely, asked.out or default_folder(likely, asked))
    study = study_of(asked)
    run_study(study, replace(asked, out=asked.out or default_folder(study.policy, asked)))


def default_folder(policy: str, asked: Asked) -> Path:
    """The folder of a run for which none was named."""
    parts = [Path(policy).name, *dict.fromkeys(Path(name).stem for name in asked.suite)]
    split = getattr(asked, "split", "").replace(" ", "-")
    return Path("data/runs", "-".join([*parts, *filter(None, (asked.object, split))]))


def study_of(asked: AskedOfAll) -> "Study":
    """The study that some options name: all tasks of the suites, or those for the category of
    --object; generic, and vap unless the policy reads the simulator.

    Raises: BadStudy for names of methods that name none, or when no task has the category;
        BadSuite; else as `Study`.
    """
    from vap_core.base.errors import BadStudy, an
    from vap_core.policies.names import PRIVILEGED
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.suites import BENCHMARKS, open_file, tasks_of
    from vap_core.study.trials import Study, default_policy

    suite_names: list[str] = []
    files: dict[str, None] = {}
    for name in asked.suite:
        if name.endswith(".py"):
            suite_names.append(open_file(Path(name)).name)
            files[str(Path(name).resolve())] = None
        else:
            suite_names += BENCHMARKS if name == "all" else [name]
    suite_names = list(dict.fromkeys(suite_names))
    if asked.task:
        if len(suite_names) > 1:
            raise BadStudy("--task is of one suite; name one by --suite.")
        tasks = tuple((suite_names[0], name) for name in dict.fromkeys(asked.task))
    else:
        tasks = tasks_of(suite_names, asked.object)
    if not tasks:
        raise BadStudy(
            f"--object: {asked.object} is {an(get_object(asked.object).category)}, and no task of "
            f"{', '.join(suite_names)} asks for one; ./vap suites lists the tasks."
        )
    policy = asked.policy or default_policy(suite_names)
    methods = asked.methods
    if methods is None:
        methods = ["generic"] if policy in PRIVILEGED else ["generic", "vap"]
    chosen = tuple(names(",".join(methods)))
    if not chosen:
        raise BadStudy(
            f"--methods: {','.join(methods)!r} names no method; name one, or leave the option out "
            "for the default, generic,vap."
        )
    settings = {
        field.name: getattr(asked, field.name)
        for field in fields(Study)
        if hasattr(asked, field.name) and field.name not in ("methods", "policy")
    }
    return Study(tasks, chosen, policy=policy, suite_files=tuple(files), **settings)


def record_of(option: str) -> "Record":
    """What --record says. Raises: BadStudy."""
    from vap_core.base.errors import BadStudy

    match option:
        case "all" | "failures" | "none":
            return option
        case _ if option.isdecimal():
            return int(option)
    raise BadStudy(f"--record {option}: say all, failures, none, or how many per task and method.")


def run_study(study: "Study", asked: AskedOfAll) -> None:
    """Run a study, on the Ray cluster if one is asked for, and print its table.

    Raises: BadStudy for options that exclude each other; UnknownName, as `named_queries`;
        BadCluster when there is none at the address; BadOutput, WorkerDied, as `engine.run`.
    """
    from vap_core.base.errors import BadStudy
    from vap_core.policies.names import PRIVILEGED
    from vap_core.rollout.calls import named_queries
    from vap_core.study.engine import run
    from vap_core.study.report import conclude
    from vap_core.study.stats import detectable_effect_text
    from vap_core.study.store import MANIFEST
    from vap_core.study.workers import ray_executor, results

    out = asked.out or default_folder(study.policy, asked)
    if study.object and asked.ray:
        raise BadStudy("--object: other machines do not have your objects; leave --ray out.")
    record = record_of(asked.record or ("none" if study.policy in PRIVILEGED else "failures"))
    queries = named_queries(names(asked.attention))
    if record == "none" and (asked.video or queries):
        raise BadStudy(
            "--video and --attention say how to record; with --record none leave them out."
        )
    if len(study.methods) > 1:
        tracks: dict[str, list[Any]] = {}
        for row in (row for task in study.tasks for row in study.rows(*task)):
            track = f"{row.suite} ({row.split})" if row.split else row.suite
            tracks.setdefault(track, []).append(row)
        for track, rows in tracks.items():
            print(f"{track}: {detectable_effect_text(rows)}", file=sys.stderr)
    if study.object and study.policy != "expert" and not (out / MANIFEST).exists():
        from vap_core.study.trials import check_feasible

        print("the expert tries the episodes first ...", file=sys.stderr)
        for tried in check_feasible(study):
            print(tried, file=sys.stderr)
    table = run(
        study,
        out,
        workers=asked.workers or (0 if asked.ray else 2),
        record=record,
        retries=asked.retries,
        policy_timeout_s=asked.policy_timeout,
        executor=ray_executor(asked.ray) if asked.ray else results,
        video=asked.video,
        attention=queries,
    )
    print(conclude(study, table, out))
    if study.audit:
        from vap_core.study.logs import verdict

        print("\n" + verdict(out))
    if len(table) and (table["outcome"] == "error").all():
        causes = table["detail"].fillna("").str.strip().str.split("\n").str[-1].value_counts()
        raise BadStudy(
            f"every one of the {len(table)} episodes in {out} is an error; of {causes.iloc[0]} of "
            f"them: {causes.index[0]}. Mend that and run the same command again."
        )
