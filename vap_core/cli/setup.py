"""Commands about this machine and what it measures.

They are eval-perception, eval-photos, paste-photos, eval-objects, calibrate, eval-policy,
eval-tokens, show and doctor.
"""

from pathlib import Path
from typing import Annotated

import typer

from vap_core.cli.options import StackName, Workers, names

app = typer.Typer()


@app.command("eval-perception")
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
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
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

    Example: python -m vap_core eval-perception --suite simpler-bridge --quick
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


@app.command("eval-photos")
def eval_photos(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Holds references/OBJECT/*.jpg; scenes/*.jpg; scenes.csv with a line "
            "scene,object,x0,y0,x1,y1 for every object of every scene, without box where the "
            "object is absent; optional references/boxes.csv with photo,x0,y0,x1,y1 (photo as "
            "OBJECT/FILE) and objects.csv with object,category (else an object's name is its "
            "kind), masks/SCENE/OBJECT.png. Pixels of the upright photo, far corner exclusive.",
        ),
    ] = None,
    benchmark: Annotated[
        str,
        typer.Option(help="Instead of a folder: pods, 70 things at home, fetched once (170 MB)."),
    ] = "",
    origin: Annotated[
        Path | None,
        typer.Option("--from", help="A copy of the benchmark, where there is no internet."),
    ] = None,
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

    Example: python -m vap_core eval-photos my-photos
    Example: python -m vap_core eval-photos my-photos --clips
    Example: python -m vap_core eval-photos --benchmark pods --stack foundation
    """
    from vap_core.base.errors import BadPhotoSet, one_of
    from vap_core.evaluation.photos.pods import pods
    from vap_core.evaluation.photos.run import measure_photos
    from vap_core.perception.foundation.store import check_present
    from vap_core.perception.stacks import check_stack

    benchmarks = {"pods": pods}
    if benchmark and benchmark not in benchmarks:
        raise one_of("eval-photos: benchmark", benchmark, benchmarks)
    if (folder is None) == (not benchmark):
        raise BadPhotoSet("eval-photos: give a folder or --benchmark pods, one of the two.")
    if folder is None:
        check_stack(stack)
        check_present(stack)
        folder = benchmarks[benchmark](origin=origin)
    folder_of_run = out or Path(f"data/runs/photos-{folder.resolve().name}")
    print(measure_photos(folder, folder_of_run, stack, clips=clips))


@app.command("paste-photos")
def paste_photos(
    photos: Annotated[
        Path,
        typer.Argument(
            help="Holds OBJECT/*.jpg, two photos of each object or more, best with a plain "
            "background; optional objects.csv with object,category, boxes.csv with "
            "photo,x0,y0,x1,y1, and masks/OBJECT/FILE.png."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="The set's new folder.")],
    scenes: Annotated[Path, typer.Option(help="Folder of pictures to paste into.")],
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the pictures.")] = "640x480",
    pictures: Annotated[int, typer.Option(min=1, help="How many.")] = 16,
    objects: Annotated[int, typer.Option(min=2, help="Objects in each, where they fit.")] = 5,
    share: Annotated[
        str, typer.Option(help="FROM,TO: an object's longer side in per cent of the width.")
    ] = "15,35",
    stack: StackName = "embedded",
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Make a photo set for eval-photos without drawing boxes: objects are cut out of some of their
    photos and pasted into pictures of a place; look at cuts.png.

    Example: python -m vap_core paste-photos my-things my-set --scenes my-desk
    Example: python -m vap_core paste-photos my-things my-small-set --scenes my-desk
        --size 1920x1080 --share 4,13 --objects 12
    """
    from vap_core.evaluation.photos.paste import parse_pasting
    from vap_core.evaluation.photos.paste import paste_photos as paste
    from vap_core.perception.stacks import load_stack

    asked = parse_pasting(size, share, pictures=pictures, objects=objects, seed=seed)
    print(paste(photos, scenes, out, asked, load_stack(stack)))
    print(f"look: {out / 'cuts.png'}\nnext: python -m vap_core eval-photos {out}")


@app.command("eval-objects")
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

    Example: python -m vap_core eval-objects data/designs
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


@app.command()
def calibrate(
    stack: StackName = "embedded",
    photos: Annotated[
        list[Path] | None,
        typer.Option(help="A photo set in the form of eval-photos; repeatable."),
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
            "uses them. Of the embedded stack it is the threshold for photos, which ground then "
            "uses; it needs --photos.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder; what it holds is kept. Default data/runs/calibrate-STACK."),
    ] = None,
) -> None:
    """Measure from which cosine on an object is in view: what each threshold costs and brings, on
    development scenes with and without the object. Interrupted, it goes on.

    Example: python -m vap_core calibrate --scenes 8
    Example: python -m vap_core calibrate --photos my-photos --scenes 0 --keep
    """
    from vap_core.analysis.calibration.run import calibrate, keep_choice, refuse_keep

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


@app.command("eval-policy")
def eval_policy(
    suite: Annotated[str, typer.Option(help="The benchmark that the policy was trained for.")],
    policy: Annotated[
        str, typer.Option(help="mini-pi0, or a checkpoint's folder or hub id.")
    ] = "mini-pi0",
    scenes: Annotated[
        int,
        typer.Option(min=1, help="Scenes of four episodes each, spread over the suite's tasks."),
    ] = 24,
    ways: Annotated[
        str,
        typer.Option(
            help="How the target is named, with commas: tinted, painted, described, plain; "
            "tinted-magenta, tinted-0.3 or tinted-yellow-0.7 force the colour and the opacity."
        ),
    ] = "tinted,painted,described,plain",
    execute: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Actions of each chunk to carry out before the policy is asked again. Default as "
            "the checkpoint says.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    workers: Workers = 2,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A table to add the episodes to, for example data/results/probe.parquet."
        ),
    ] = None,
) -> None:
    """Measure what a policy can do with generic objects that no film has shown, told by a tint, by
    paint, by words, or not at all.

    Example: python -m vap_core eval-policy --suite simpler-bridge --scenes 4
    Example: python -m vap_core eval-policy --suite tabletop --ways tinted --execute 10
    Example: python -m vap_core eval-policy --suite simpler-bridge --ways tinted,tinted-magenta
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.study import Study
    from vap_core.simulation import suites
    from vap_core.training.policy.probe import conclude, keep, probe

    tasks = tuple((suite, task.name) for task in suites.suite(suite).tasks)
    study = Study(tasks, ("generic",), policy=policy)
    checkpoint = study.checkpoint(suite)
    if not checkpoint:
        raise BadStudy(
            f"eval-policy: {policy!r} has no weights; "
            "take mini-pi0, or a lerobot checkpoint's folder or hub id."
        )
    table = probe(
        checkpoint,
        suite,
        scenes=scenes,
        ways=names(ways),
        execute=execute,
        seed=seed,
        workers=workers,
    )
    print(conclude(table))
    if out is not None:
        keep(table, out)
        print(f"wrote {out}")


@app.command("eval-tokens")
def eval_tokens(
    suite: Annotated[
        list[str] | None, typer.Option(help="A benchmark; repeatable. Default all four.")
    ] = None,
    k: Annotated[
        str, typer.Option("--k", help="Numbers of photos to learn from, with commas.")
    ] = "1,3,5,7",
    epochs: Annotated[
        int,
        typer.Option(min=1, help="Passes over the augmented photos; the soft prompt's own is 20."),
    ] = 20,
    learn_in: Annotated[
        str,
        typer.Option(help="vlm, policy or both: whose weights a token is learned in."),
    ] = "vlm,policy",
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    out: Annotated[Path, typer.Option(help="Run folder; a run found there is resumed.")] = Path(
        "data/runs/tokens"
    ),
    publish: Annotated[
        Path | None,
        typer.Option(help="Keep the tables in this folder too, as token_NAME.parquet."),
    ] = None,
) -> None:
    """Learn the token of every personal object from few and from many photos, in the
    vision-language model and in the policies; measure what it recognizes, and which object of
    listed episodes the model chooses by it. Interrupted, it goes on; about a minute and a half a
    token and core.

    Example: python -m vap_core eval-tokens --suite simpler-bridge --k 5 --epochs 2
        --out data/runs/few-tokens
    """
    from vap_core.base.errors import BadStudy
    from vap_core.evaluation.tokens.report import report
    from vap_core.evaluation.tokens.study import Tokens, run
    from vap_core.evaluation.tokens.study import publish as write_tables
    from vap_core.simulation.suites import BENCHMARKS

    ks = tuple(int(number) for number in names(k) if number.isdecimal() and int(number))
    if len(ks) != len(names(k)) or not ks:
        raise BadStudy(f"eval-tokens: --k {k}: give numbers of photos, such as 1,3,5,7.")
    asked = Tokens(tuple(dict.fromkeys(suite or BENCHMARKS)), ks, epochs, tuple(names(learn_in)))
    print(report(run(asked, out, workers=workers)))
    if publish is not None:
        written = ", ".join(map(str, write_tables(out, publish)))
        print(f"wrote {written}")


@app.command()
def show(
    recording: Annotated[Path, typer.Argument(help="A .rrd file.")],
    png: Annotated[Path, typer.Argument(help="Picture to write.")],
    frame: Annotated[
        int | None, typer.Option(help="Control step to show; default the middle one.")
    ] = None,
    attention: Annotated[
        bool,
        typer.Option("--attention", help="The attention maps of every view and query instead."),
    ] = False,
) -> None:
    """Take a picture of a recording as the viewer shows it, without a display.

    Example: python -m vap_core show data/runs/demo/recordings/NAME.rrd shot.png --frame 20
    """
    from vap_core.recording import screenshot
    from vap_core.recording.attention_picture import attention_screenshot

    if attention:
        attention_screenshot(recording, png, frame_index=frame)
    else:
        screenshot(recording, png, frame_index=frame)
    print(f"wrote {png}")


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to repair what does not; status 1 when the main job
    cannot run.

    Example: python -m vap_core doctor
    """
    from vap_core.cli.doctor import examine

    able = True
    for finding in examine():
        print(finding)
        if finding.needed and not finding.works:
            able = False
    if not able:
        raise typer.Exit(1)
