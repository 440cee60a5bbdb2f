"""The command that changes one thing of the method at a time."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import Workers
from vap_core.cli.studies import (
    PerTask,
    Recorded,
    SplitName,
    all_tasks,
    named_suites,
    record_of,
    study_of,
)

app = typer.Typer()


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
        typer.Option(
            help="scripted; mini-pi0; or a lerobot checkpoint, as folder or hub id. Default: "
            "mini-pi0 where one ships, else scripted."
        ),
    ] = None,
    episodes: PerTask = None,
    seeds: Annotated[int, typer.Option(min=1, help="Run every episode with so many seeds.")] = 1,
    split: SplitName = "",
    workers: Workers = 2,
    record: Recorded = "none",
) -> None:
    """Change one thing of the method at a time, and compare every arm with the method itself on the
    same episodes; draws OUT/NAME.png. Interrupted, the same command goes on.

    Example: python -m vap_core ablate
    Example: python -m vap_core ablate form --suite simpler-bridge --episodes 6
    Example: python -m vap_core ablate rewrite --suite simpler-fractal --split "visual matching"
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

    suite_names, files = named_suites(suite or list(ABLATIONS[name].suites))
    if ABLATIONS[name].policies:
        if policy is not None:
            raise BadStudy(f"ablate {name}: it compares policies of its own; leave --policy out.")
        policy = next(iter(ABLATIONS[name].policies.values()))
    study = study_of(
        tasks=all_tasks(suite_names),
        suite_files=files,
        methods=list(ABLATIONS[name].names),
        policy=policy or default_policy(suite_names),
        episodes=episodes,
        seeds=seeds,
        follow="call",
        split=split,
    )
    print(ablate_text(name, study, out, workers=workers, record=record_of(record)))
