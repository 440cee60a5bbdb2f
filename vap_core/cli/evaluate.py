"""Commands that run episodes: demo, suites, rollout, eval."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from vap_core.cli.options import (
    DetectorName,
    EncoderName,
    StackName,
    TrackerName,
    Workers,
    stack_of,
)
from vap_core.cli.studies import (
    POLICIES,
    RECORDED,
    Attention,
    Meshes,
    Methods,
    OwnObject,
    PerTask,
    PolicyName,
    PolicyTimeout,
    Recorded,
    Retries,
    Seed,
    SplitName,
    Video,
    all_tasks,
    check_quickly,
    default_folder,
    named_suites,
    run_study,
    study_of,
)

app = typer.Typer()


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/demo"
    ),
    workers: Workers = 2,
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
    run_study(study, out, workers=workers, record_option="all", retries=1)


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
) -> None:
    """Run tasks of a suite in closed loop, record every episode, and print the table.

    Example: python -m vap_core rollout --suite widowx-pick --task pick-bottle --episodes 4
        --out data/runs/bottle
    Example: python -m vap_core rollout --suite tabletop --task select-cup --object mug
        --episodes 4 --out data/runs/mug
    """
    check_quickly([suite], policy, record)
    from vap_core.evaluation.worker_server import start_server

    start_server(policy, out)
    (suite_name,), files = named_suites([suite])
    tasks = tuple((suite_name, name) for name in dict.fromkeys(task))
    study = study_of(
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
    run_study(
        study,
        out,
        workers=workers,
        record_option=record,
        retries=retries,
        policy_timeout_s=policy_timeout,
        video=video,
        attention=attention,
    )


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
    episodes: PerTask = None,
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
    split: SplitName = "",
) -> None:
    """Run whole suites, and print the table with 95 % intervals. Interrupted, the same command goes
    on. With --object, the tasks of its category.

    Example: python -m vap_core eval --suite simpler-bridge --methods generic,vap --episodes 4
        --out data/runs/bridge
    Example: python -m vap_core eval --suite simpler-bridge --policy expert
    Example: python -m vap_core eval --suite tabletop --object mug --out data/runs/mug
    Example: python -m vap_core eval --suite all --methods generic,vap --episodes 4
        --out data/runs/all
    Example: python -m vap_core eval --suite all --engine ray --address 10.0.0.5:6379
    """
    from vap_core.base.errors import BadStudy

    check_quickly(suite, policy, record)
    from vap_core.evaluation.worker_server import probable_policy, start_server

    likely = policy or probable_policy(suite)
    if likely and engine == "local":
        start_server(likely, out or default_folder(likely, suite, object, split))
    from vap_core.evaluation.policy_names import PRIVILEGED, default_policy

    suite_names, files = named_suites(suite)
    policy = policy or default_policy(suite_names)
    study = study_of(
        tasks=all_tasks(suite_names, object),
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
        split=split,
    )
    if address and engine != "ray":
        raise BadStudy("eval: --address needs --engine ray.")
    if engine == "ray":
        address = address or "127.0.0.1:6379"
    run_study(
        study,
        out or default_folder(policy, suite, object, split),
        workers=workers,
        record_option=record or ("none" if policy in PRIVILEGED else "failures"),
        retries=retries,
        policy_timeout_s=policy_timeout,
        address=address,
        video=video,
        attention=attention,
    )
