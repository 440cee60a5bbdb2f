"""Commands that measure perception: on scenes, photos and objects; and its thresholds."""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import StackName, Workers

app = typer.Typer()


@app.command("perception")
def eval_perception(
    stack: StackName = "embedded",
    suite: Annotated[
        list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Opening frames per task, as episodes spread evenly over its list."
        ),
    ] = None,
    jobs: Workers = 2,
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/perception"
    ),
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Two opening frames per task and one tracked episode per suite."
        ),
    ] = False,
    publish: Annotated[
        Path | None,
        typer.Option(help="Keep the tables in this folder too, as perception_NAME.parquet."),
    ] = None,
) -> None:
    """Measure perception against the simulator: opening frames, tracks through whole expert
    episodes, and time. Interrupted, it goes on.

    Example: python -m vap_core measure perception --suite simpler-bridge --quick
    """
    from vap_core.evaluation.perception.report import conclude
    from vap_core.evaluation.perception.run import Survey, run_survey
    from vap_core.evaluation.perception.run import publish as write_tables
    from vap_core.perception.foundation.store import check_present
    from vap_core.perception.stacks import check_stack
    from vap_core.simulation.suites import BENCHMARKS

    check_stack(stack)
    check_present(stack)
    suite_names = tuple(dict.fromkeys(suite or BENCHMARKS))
    survey = Survey(stack, suite_names, episodes, quick)
    tables = run_survey(survey, out, jobs=jobs)
    print(conclude(tables, survey.stack, out))
    if publish is not None:
        written = ", ".join(map(str, write_tables(out, publish)))
        print(f"wrote {written}")


@app.command("photos")
def eval_photos(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Holds references/OBJECT/*.jpg; scenes/*.jpg; scenes.csv with a line "
            "scene,object,x0,y0,x1,y1 for every object of every scene, without box where the "
            "object is absent; optional references/boxes.csv with photo,x0,y0,x1,y1 (photo as "
            "OBJECT/FILE) and objects.csv with object,category (else an object's name is its "
            "kind), masks/SCENE/OBJECT.png. Pixels of the upright photo, far corner exclusive.",
        ),
    ],
    stack: StackName = "embedded",
    clips: Annotated[
        bool,
        typer.Option(
            "--clips",
            help="Follow objects through clips, too: a window pans from each scene to a copy of "
            "it and back, with every object twice.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run folder; a run found there is resumed. Default data/runs/photos-NAME."
        ),
    ] = None,
) -> None:
    """Measure registering, grounding and the vote on photos of your own, against the boxes that you
    give. Interrupted, it goes on.

    Example: python -m vap_core measure photos my-photos
    Example: python -m vap_core measure photos my-photos --clips
    """
    from vap_core.evaluation.photos.run import measure_photos

    folder_of_run = out or Path(f"data/runs/photos-{folder.resolve().name}")
    print(measure_photos(folder, folder_of_run, stack, clips=clips))


@app.command("objects")
def eval_objects(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Objects that `objects import --out` made; or 3-D files with objects.csv: a line "
            "file,category,height_cm,groups each, the last two may be empty.",
        ),
    ],
    suite: Annotated[
        list[str] | None,
        typer.Option(help="A suite; repeatable. Each object takes its tasks of the same category."),
    ] = None,
    episodes: Annotated[
        int, typer.Option(min=1, help="Episodes per object and task, spread over its list.")
    ] = 4,
    policy: Annotated[
        str, typer.Option(help="Default mini-pi0 where one ships for the suite, else scripted.")
    ] = "",
    views_only: Annotated[
        bool, typer.Option("--views-only", help="Look at the opening views, and run no episodes.")
    ] = False,
    stack: StackName = "embedded",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run folder; a run found there is resumed. Default data/runs/objects-NAME."
        ),
    ] = None,
) -> None:
    """Measure objects of your own in a suite's scenes, each in the target's place among its
    look-alikes: found in opening views, and fetched by VAP where the expert can. Interrupted, it
    goes on.

    Example: python -m vap_core measure objects data/designs
    """
    from vap_core.evaluation.own_objects.run import ObjectSurvey, measure_objects

    asked = ObjectSurvey(
        suites=tuple(dict.fromkeys(suite or ["tabletop"])),
        episodes=episodes,
        stack=stack,
        policy=policy,
        views_only=views_only,
    )
    print(measure_objects(folder, out or Path(f"data/runs/objects-{folder.resolve().name}"), asked))


@app.command("calibration")
def calibrate(
    stack: StackName = "embedded",
    photos: Annotated[
        list[Path] | None,
        typer.Option(help="A photo set in the form of measure photos; repeatable."),
    ] = None,
    scenes: Annotated[
        int, typer.Option(min=0, help="Rendered development scenes; 0: photos alone.")
    ] = 24,
    price: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=50.0,
            help="Per cent of the rightly elected objects that may be refused.",
        ),
    ] = 3.0,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep",
            help="Write the chosen thresholds beside the weights of a foundation stack, which then "
            "uses them. Of the embedded stack it is the threshold for photos, which ground and "
            "inspect-dataset then use, and measure photos and attached checkpoints do not; of a "
            "stack of your own without thresholds it is both. A stack with an embedded part needs "
            "--photos.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder; what it holds is kept. Default data/runs/calibrate-STACK."),
    ] = None,
) -> None:
    """Measure from which cosine on an object is in view: what each threshold costs and brings, on
    development scenes with and without the object. Interrupted, it goes on.

    Example: python -m vap_core measure calibration --scenes 8
    Example: python -m vap_core measure calibration --photos my-photos --scenes 0 --keep
    """
    from vap_make.calibration.run import calibrate, keep_choice, refuse_keep

    if keep:
        refuse_keep(stack, photos or ())
    report, chosen = calibrate(
        stack,
        out or Path(f"data/runs/calibrate-{stack}"),
        scenes=scenes,
        photos=photos or (),
        price=price / 100,
    )
    print(report)
    if keep:
        print(f"wrote {keep_choice(stack, chosen)}")
