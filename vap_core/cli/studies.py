"""Options of the commands that run episodes, the study that they name, and how it is run."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vap_core.cli.options import names
from vap_core.evaluation.run_schema import LARGEST_SEED

if TYPE_CHECKING:
    from vap_core.evaluation.jobs import Record
    from vap_core.evaluation.study import Study
    from vap_core.simulation.types import EpisodeRow

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
PerTask = Annotated[
    int | None,
    typer.Option(
        "--episodes",
        min=1,
        help="Episodes per task, spread evenly over its list. Default the whole list.",
    ),
]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        max=LARGEST_SEED - 1,
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
SplitName = Annotated[
    str,
    typer.Option(
        "--split",
        help="One split of a suite's list: simpler-fractal has 'visual matching' and 'variant "
        "aggregation'. Default all.",
    ),
]


def check_quickly(suite_names: list[str], policy: str | None, record: str | None) -> None:
    """Check what can be checked before anything large is imported.

    Raises: BadStudy, BadSuite, UnknownName.
    """
    from vap_core.base.errors import BadSuite
    from vap_core.policies.names import check_policy_name

    if record is not None:
        record_of(record)
    for name in suite_names:
        if name.endswith(".py") and not Path(name).is_file():
            raise BadSuite(f"suites: {name} is no Python file; name one that ends in .py.")
    if policy is not None:
        check_policy_name(policy)


def default_folder(policy: str, suite_names: list[str], object: str = "", split: str = "") -> Path:
    """The folder of a run for which none was named."""
    parts = [Path(policy).name, *dict.fromkeys(Path(name).stem for name in suite_names)]
    parts += filter(None, (object, split.replace(" ", "-")))
    return Path("data/runs", "-".join(parts))


def named_suites(given: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """The suites that are named, each once, and the files of own suites among them.

    "all" names every benchmark; a name that ends in .py is a file, which is executed.

    Raises: BadSuite for a file that is no suite.
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


def all_tasks(suite_names: list[str], object: str = "") -> tuple[tuple[str, str], ...]:
    """Suite and task of every task of some suites; of those for the category of `object`, if any.

    Raises: BadStudy when no task has its category.
    """
    from vap_core.base.errors import BadStudy
    from vap_core.simulation.assets.objects import get_object
    from vap_core.simulation.suites import tasks_of

    tasks = tasks_of(suite_names, object)
    if not tasks:
        raise BadStudy(
            f"--object: {object} is a {get_object(object).category}, and no task of "
            f"{', '.join(suite_names)} asks for one; python -m vap_core suites lists the tasks."
        )
    return tasks


def study_of(
    tasks: tuple[tuple[str, str], ...], methods: list[str] | None, policy: str, **options: Any
) -> "Study":
    """The study of some tasks.

    Where `methods` is None they are generic, and vap unless the policy reads the simulator.

    Raises: BadStudy where `methods` are given and name none; else as `Study`.
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.policy_names import PRIVILEGED
    from vap_core.evaluation.study import Study

    if methods is None:
        methods = ["generic"] if policy in PRIVILEGED else ["generic", "vap"]
    chosen = tuple(names(",".join(methods)))
    if not chosen:
        raise BadStudy(
            f"--methods: {','.join(methods)!r} names no method; name one, or leave the option out "
            "for the default, generic,vap."
        )
    return Study(tasks, chosen, policy=policy, **options)


def record_of(option: str) -> "Record":
    """What --record says. Raises: BadStudy."""
    from vap_core.base.errors import BadStudy

    match option:
        case "all" | "failures" | "none":
            return option
        case _ if option.isdecimal():
            return int(option)
    raise BadStudy(f"--record {option}: say all, failures, none, or how many per task and method.")


def run_study(
    study: "Study",
    out: Path,
    *,
    workers: int | None,
    record_option: str,
    retries: int,
    policy_timeout_s: float | None = None,
    address: str | None = None,
    video: bool = False,
    attention: str = "",
) -> None:
    """Run a study, on the Ray cluster at `address` if there is one, and print its table.

    Raises: BadStudy for options that exclude each other; UnknownName, as `named_queries`;
        BadCluster when there is none at `address`; BadOutput, WorkerDied, as `engine.run`.
    """
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
    record = record_of(record_option)
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
